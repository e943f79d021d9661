"""Wavefronts over the field: as measured, as the telescope's model has them, and what is left."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from psfdae.figures import WIDTH_IN, new_figure, styled
from psfdae.sensing.results import Wavefronts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SAMPLES = 48
"""Samples of a pupil along its diameter."""

CELLS = 8
"""Pupils along a side of the field, at most."""


@styled
def wavefront_map(found: Wavefronts, title: str) -> Figure:
    """Wavefronts of bright stars at their places, those of the model, and residual stamps.

    The model is the telescope's state if it was fitted, else the mean of the prior.
    """
    chosen = _apart(found)
    first = np.array([np.flatnonzero(found.summary["star"] == star)[0] for star in chosen], int)
    measured = _pupils(found, chosen, found.summary["mean"][first])
    joint = found.joint
    expected = found.terms.mean if joint is None else joint.model.coefficients(joint.value)
    model = _pupils(found, chosen, expected[chosen])
    rows = found.search.photons
    residual = found.stamps.data - rows.level[:, None, None] - found.model
    residual[found.stamps.bad | found.stamps.saturated] = np.nan
    residual -= np.nanmedian(residual, axis=(1, 2), keepdims=True)
    residual = (residual / rows.noise[:, None, None])[chosen]
    field = found.field_deg[chosen]
    reach = np.ptp(found.field_deg, axis=0).max() or 1.0
    cell = 0.92 * reach / CELLS
    figure = new_figure(0.5 * WIDTH_IN, layout="constrained")
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    # The rim alone would take the whole scale.
    peak = float(np.nanpercentile(np.abs([measured, model]), 98)) if len(chosen) else 1.0
    names = ("measured", "fitted telescope" if joint else "prior's mean", "residuals of the stars")
    for panel, images, limit, colours, name in zip(
        axes,
        (measured, model, residual),
        (peak, peak, 4.0),
        ("RdBu_r", "RdBu_r", "Greys"),
        names,
        strict=True,
    ):
        for (x, y), image in zip(field, images, strict=True):
            half = 0.5 * cell
            shown = panel.imshow(
                image,
                origin="lower",
                extent=(x - half, x + half, y - half, y + half),
                cmap=colours,
                vmin=-limit,
                vmax=limit,
                interpolation="nearest",
            )
        low, high = (getattr(found.field_deg, end)(axis=0) for end in ("min", "max"))
        panel.set(
            xlim=(low[0] - cell, high[0] + cell),
            ylim=(low[1] - cell, high[1] + cell),
            aspect="equal",
            xlabel="x (deg)",
            title=name,
        )
        if len(chosen):
            unit = "noise of the sky" if colours == "Greys" else "OPD (waves)"
            figure.colorbar(shown, ax=panel, location="bottom", shrink=0.8, label=unit)
    axes[0].set_ylabel("y (deg)")
    figure.suptitle(title, parse_math=False)
    return figure


def _apart(found: Wavefronts) -> np.ndarray:
    """Bright stars that are explained, far enough from each other to be drawn at their places."""
    left = np.intersect1d(found.star, np.flatnonzero(found.explained))
    left = left[np.argsort(-found.snr[left], kind="stable")]
    cell = (1.0 - 1e-6) * np.ptp(found.field_deg, axis=0).max() / CELLS
    chosen = []
    while left.size:
        chosen.append(left[0])
        gap = np.abs(found.field_deg[left] - found.field_deg[left[0]]).max(axis=1)
        left = left[gap >= cell] if cell > 0 else left[:0]
    return np.array(chosen, int)


def _pupils(found: Wavefronts, star: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """OPD in waves over the lit pupil, without piston and tilts, NaN outside, (m, s, s)."""
    axis = np.linspace(-1.0, 1.0, SAMPLES)
    x, y = axis[None, :], axis[:, None]
    radius = np.hypot(x, y)
    lit = (radius <= 1.0) & (radius >= found.telescope.obscuration)
    images = found.terms.modes(x, y)[:, lit]
    opd = np.einsum("mk,mkj->mj", coefficients, found.terms.to_modes[star]) @ images
    planes = np.stack([np.broadcast_to(each, lit.shape)[lit] for each in (1.0, x, y)], axis=1)
    opd -= (planes @ np.linalg.lstsq(planes, opd.T, rcond=None)[0]).T
    out = np.full((len(star), *lit.shape), np.nan)
    out[:, lit] = opd
    return out
