"""A map of the PSF over the field: stamps at their positions, size and shape of all stars."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.figures import WIDTH_IN, new_figure, styled
from psfdae.image.stamps import StarFlag

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

CELLS = 9  # stamps along the longer side of the field
WHISKERS = 2500  # stars with a whisker, at most; more would be a carpet

SPOILT = (
    StarFlag.NO_FLUX
    | StarFlag.FAINT
    | StarFlag.MASKED
    | StarFlag.SATURATED
    | StarFlag.TRUNCATED
    | StarFlag.OFF_CENTRE
    | StarFlag.UNLIKE_TRAINING
)
"""Stars with one of these flags are not drawn."""


@dataclass(frozen=True)
class FieldStars:
    """Stars of a prediction as the map needs them: columns of its file, shape (n,) each."""

    x: np.ndarray
    y: np.ndarray
    snr: np.ndarray
    fwhm_px: np.ndarray
    ellipticity: np.ndarray
    position_angle_deg: np.ndarray
    flags: np.ndarray

    def drawable(self) -> np.ndarray:
        """Indices of the stars that can be drawn, brightest first."""
        finite = np.isfinite(self.x) & np.isfinite(self.y) & np.isfinite(self.fwhm_px)
        good = np.flatnonzero(finite & ((self.flags & int(SPOILT)) == 0))
        return good[np.argsort(-self.snr[good], kind="stable")]

    def cell(self) -> float:
        """Least distance of two stamps in pixels of the image."""
        drawn = self.drawable()
        extent = max((np.ptp(axis[drawn]) for axis in (self.x, self.y) if drawn.size), default=0.0)
        return float(extent) / (CELLS - 1) if extent > 0 else 1.0

    def chosen(self) -> np.ndarray:
        """Bright stars far enough from each other for their stamps not to overlap, indices."""
        left, side, chosen = self.drawable(), self.cell(), []
        while left.size:
            chosen.append(left[0])
            apart = np.maximum(*(np.abs(axis[left] - axis[left[0]]) for axis in (self.x, self.y)))
            left = left[apart >= side]
        return np.array(chosen, dtype=int)


def map_of_file(predicted: Path) -> Figure:
    """The map of the PSFs in a FITS file of a prediction."""
    from astropy.io import fits

    with fits.open(predicted, memmap=True) as file:
        table: Any = file["STARS"].data
        columns = (table[name] for name in FieldStars.__dataclass_fields__)
        # Copies in the machine's byte order.
        stars = FieldStars(*(values.astype(values.dtype.newbyteorder("=")) for values in columns))
        sections = [file["PSF"].section[int(star)] for star in stars.chosen()]
        title = f"{file[0].header['INFILE']}: {len(stars.drawable())} of {len(stars.x)} stars"
    return psf_map(np.array(sections, dtype=np.float32), stars, title)


@styled
def psf_map(psf: np.ndarray, stars: FieldStars, title: str) -> Figure:
    """Stamps (k, d, d) of the stars `stars.chosen` at their positions, a whisker for every star."""
    drawn, chosen, cell = stars.drawable(), stars.chosen(), stars.cell()
    x, y = stars.x[drawn], stars.y[drawn]
    margin = 0.6 * cell
    box = (
        (x.min() - margin, x.max() + margin, y.min() - margin, y.max() + margin)
        if drawn.size
        else (0.0, 1.0, 0.0, 1.0)
    )
    shape = np.clip((box[3] - box[2]) / (box[1] - box[0]), 0.3, 2.0)
    figure = new_figure(0.46 * WIDTH_IN * shape + 1.5, layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    half = 0.46 * cell
    for stamp, x0, y0 in zip(psf, stars.x[chosen], stars.y[chosen], strict=True):
        left.imshow(
            np.sqrt(np.clip(stamp / stamp.max(), 0.0, 1.0)),
            origin="lower",
            extent=(x0 - half, x0 + half, y0 - half, y0 + half),
            cmap="magma",
            vmin=0.0,
            vmax=1.0,
            interpolation="nearest",
        )
    shown = _whiskers(right, stars, drawn[:WHISKERS], cell)
    for axes, name in ((left, "PSF, each to its maximum"), (right, "ellipticity and FWHM")):
        axes.set(xlim=box[:2], ylim=box[2:], aspect="equal", xlabel="x (px)", title=name)
    left.set_ylabel("y (px)")
    if shown is not None:
        bar = figure.colorbar(shown, ax=[left, right], location="bottom", shrink=0.6, aspect=40)
        bar.set_label("FWHM of the PSF (px)")
    figure.suptitle(title, parse_math=False)
    return figure


def _whiskers(
    axes: Axes, stars: FieldStars, drawn: np.ndarray, cell: float
) -> LineCollection | None:
    """Lines along the major axes; a key tells the length of ellipticity 0.2."""
    from matplotlib.collections import LineCollection

    if not drawn.size:
        axes.text(0.5, 0.5, "no unflagged star", ha="center", transform=axes.transAxes)
        return None
    per_ellipticity = 2.0 * cell
    angle = np.deg2rad(stars.position_angle_deg[drawn])
    half = 0.5 * per_ellipticity * stars.ellipticity[drawn]
    step = np.stack([half * np.cos(angle), half * np.sin(angle)], axis=1)
    middle = np.stack([stars.x[drawn], stars.y[drawn]], axis=1)
    size = stars.fwhm_px[drawn]
    lines = LineCollection(
        list(np.stack([middle - step, middle + step], axis=1)), cmap="viridis", linewidths=1.3
    )
    lines.set_array(size)
    lines.set_clim(*np.percentile(size, [2, 98]))
    axes.add_collection(lines)
    key = 0.2 * per_ellipticity
    corner = middle.min(axis=0) - 0.45 * cell
    axes.plot([corner[0], corner[0] + key], [corner[1]] * 2, color="black", lw=2.0)
    axes.annotate(
        "0.2", (corner[0] + key, corner[1]), xytext=(3, 0), textcoords="offset points",
        va="center", fontsize=7,
    )  # fmt: skip
    return lines
