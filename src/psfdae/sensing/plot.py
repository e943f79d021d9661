"""Figure of the wavefronts over the field: of single stars, of the model, and residual stamps.

Inputs: `psfdae.sensing.results.Wavefronts`. Outputs: a figure with three panels that show the
pupil, or the stamp, of each star at its field angle.
"""

from __future__ import annotations

import numpy as np

from psfdae.base.figures import WIDTH_IN, apply_style, new_figure
from psfdae.base.types import Figure
from psfdae.sensing.results import Wavefronts, flat_modes


@apply_style
def wavefront_map(wavefronts: Wavefronts, title: str) -> Figure:
    """Draw measured and modelled wavefronts of bright stars over the field, and residual stamps.

    The model is the fitted state of the telescope, or else the mean of the prior.

    Parameters
    ----------
    wavefronts : Wavefronts
        Measured wavefronts, with a joint fit or without.
    title : str
        Title above the three panels.
    """
    # At most 8 pupils along a side of the field, one in each cell.
    low, high = wavefronts.field_deg.min(axis=0), wavefronts.field_deg.max(axis=0)
    cell_deg = (high - low).max() / 8
    stars = bright_separate_stars(wavefronts, cell_deg)
    # OPD of the most probable mode of each star, and of the model.
    summary, joint = wavefronts.summary, wavefronts.joint
    first = np.searchsorted(summary["star"], stars)
    star_opd = pupil_opd(wavefronts, stars, summary["mean"][first])
    model_waves = wavefronts.terms.mean
    if joint is not None:
        model_waves = joint.model.coefficients(joint.value)
    model = pupil_opd(wavefronts, stars, model_waves[stars])
    # Residuals in units of the sky noise, minus the median of each stamp.
    residual = wavefronts.residual[stars]
    residual -= np.nanmedian(residual, axis=(1, 2), keepdims=True)
    residual /= wavefronts.search.photons.sky_noise[stars, None, None]
    # The colour scale ends at the 98th percentile: otherwise it would only show the rim.
    peak = float(np.nanpercentile(np.abs([star_opd, model]), 98)) if len(stars) else 1.0
    model_name = "fitted telescope" if joint else "prior's mean"
    panels = (
        ("measured", star_opd, peak, "RdBu_r", "OPD (waves)"),
        (model_name, model, peak, "RdBu_r", "OPD (waves)"),
        ("residuals of the stars", residual, 4.0, "Greys", "residual / noise of the sky"),
    )
    # Three panels over the field.
    figure = new_figure(0.5 * WIDTH_IN, layout="constrained")
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    # Each image fills its cell about the star's field angle, except a gap to the next cell. If all
    # stars have the same field angle, any size of the cell is right.
    cell = 0.92 * (cell_deg or 0.125)
    half = 0.5 * cell
    for panel, (name, images, limit, colours, unit) in zip(axes, panels, strict=True):
        # Rows of images run along +y, as the field angles do.
        for (x, y), image in zip(wavefronts.field_deg[stars], images, strict=True):
            mappable = panel.imshow(
                image,
                origin="lower",
                extent=(x - half, x + half, y - half, y + half),
                cmap=colours,
                vmin=-limit,
                vmax=limit,
                interpolation="nearest",
            )
        panel.set(
            xlim=(low[0] - cell, high[0] + cell),
            ylim=(low[1] - cell, high[1] + cell),
            aspect="equal",
            xlabel="x (deg)",
            title=name,
        )
        # Without stars there is no image that a colour bar could explain.
        if len(stars):
            figure.colorbar(mappable, ax=panel, location="bottom", shrink=0.8, label=unit)
    axes[0].set_ylabel("y (deg)")
    figure.suptitle(title)
    return figure


def bright_separate_stars(wavefronts: Wavefronts, cell_deg: float) -> np.ndarray:
    """Return the indices of the brightest explained stars, a cell or more from each other."""
    stars = np.intersect1d(wavefronts.star, np.flatnonzero(wavefronts.explained))
    # Brightest first: the brightest star of a cell is drawn.
    stars = stars[np.argsort(-wavefronts.snr[stars], kind="stable")]
    # Rounding must not drop stars of a regular grid.
    distance_deg = (1.0 - 1e-6) * cell_deg
    separate = []
    while stars.size:
        separate.append(stars[0])
        offset = np.abs(wavefronts.field_deg[stars] - wavefronts.field_deg[stars[0]])
        is_separate = (offset.max(axis=1) >= distance_deg) & (cell_deg > 0)
        stars = stars[is_separate]
    return np.array(separate, int)


def pupil_opd(wavefronts: Wavefronts, star: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return the OPD in waves over the pupil, without piston and tilts, (m, 50, 50).

    NaN where less than half of a sample is lit. `coefficients` (m, K) are in waves.
    """
    # OPD Σ c_k T_kj M_j of each star.
    images, weight = flat_modes(wavefronts.terms, wavefronts.telescope.obscuration, 48)
    opd = np.einsum("mk,mkj->mj", coefficients, wavefronts.terms.to_modes[star]) @ images
    opd[:, weight < 0.5 * weight.max()] = np.nan
    return np.asarray(opd.reshape(len(star), 50, 50))
