"""Map of the PSF over the field: stamps at their positions, size and shape of all stars."""

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

UNUSABLE_FLAGS = (
    StarFlag.NO_FLUX
    | StarFlag.FAINT
    | StarFlag.MASKED
    | StarFlag.SATURATED
    | StarFlag.TRUNCATED
    | StarFlag.OFF_CENTRE
    | StarFlag.UNLIKE_TRAINING
)
"""Flags of stars whose measured size and shape mean nothing; they are not drawn."""


@dataclass(frozen=True)
class FieldStars:
    """Stars of a prediction as the map needs them: columns of its file, shape (n,) each.

    Attributes
    ----------
    x, y : ndarray
        Positions, 0-based pixels of the image; NaN if unknown.
    snr : ndarray
        Signal-to-noise ratio, by which stars are ordered.
    fwhm_px, ellipticity, position_angle_deg : ndarray
        Size and shape of the PSF of the star; the angle is from +x to +y.
    flags : ndarray of int
        Sum of the values of `StarFlag`.
    """

    x: np.ndarray
    y: np.ndarray
    snr: np.ndarray
    fwhm_px: np.ndarray
    ellipticity: np.ndarray
    position_angle_deg: np.ndarray
    flags: np.ndarray

    def usable_stars(self) -> np.ndarray:
        """Return indices of the stars that can be drawn, brightest first."""
        is_finite = np.isfinite(self.x) & np.isfinite(self.y) & np.isfinite(self.fwhm_px)
        usable = np.flatnonzero(is_finite & ((self.flags & int(UNUSABLE_FLAGS)) == 0))
        return usable[np.argsort(-self.snr[usable], kind="stable")]

    def stamp_spacing_px(self) -> float:
        """Return the least distance of two drawn stamps along an axis, in pixels of the image."""
        stars = self.usable_stars()
        extent = max((np.ptp(axis[stars]) for axis in (self.x, self.y) if stars.size), default=0.0)
        # Nine stamps along the longer side of the field.
        return float(extent) / 8 if extent > 0 else 1.0

    def stamp_stars(self) -> np.ndarray:
        """Return indices of bright stars so far from each other that their stamps do not overlap.

        They are taken from the brightest down.
        """
        # Take the brightest star, drop all whose stamps would overlap with its stamp, and repeat.
        candidates, spacing_px, selected = self.usable_stars(), self.stamp_spacing_px(), []
        while candidates.size:
            star = candidates[0]
            selected.append(star)
            distance = np.maximum(
                *(np.abs(axis[candidates] - axis[star]) for axis in (self.x, self.y))
            )
            candidates = candidates[distance >= spacing_px]
        return np.array(selected, dtype=int)


def map_of_file(path: Path) -> Figure:
    """Draw the map of the PSFs in a FITS file of a prediction.

    Parameters
    ----------
    path : Path
        File of `psfdae predict`, with the extensions STARS and PSF.
    """
    from astropy.io import fits

    with fits.open(path, memmap=True) as file:
        table: Any = file["STARS"].data
        columns = (table[name] for name in FieldStars.__dataclass_fields__)
        # Copies in the machine's byte order.
        stars = FieldStars(*(values.astype(values.dtype.newbyteorder("=")) for values in columns))
        # Only the PSFs that are drawn are read: a file may have a million.
        psfs = [file["PSF"].section[int(star)] for star in stars.stamp_stars()]
        return psf_map(np.array(psfs, dtype=np.float32), stars, file[0].header["INFILE"])


@styled
def psf_map(psf: np.ndarray, stars: FieldStars, image_name: str) -> Figure:
    """Draw stamps at the positions of their stars, and beside them a whisker for every star.

    Parameters
    ----------
    psf : ndarray, shape (k, d, d)
        PSFs of the stars `stars.stamp_stars()`.
    stars : FieldStars
    image_name : str
        Name of the image in the title.
    """
    usable, stamp_stars = stars.usable_stars(), stars.stamp_stars()
    spacing_px = stars.stamp_spacing_px()
    # Limits of the axes: all usable stars with room for a stamp about each.
    x, y = stars.x[usable], stars.y[usable]
    margin = 0.6 * spacing_px
    limits = (0.0, 1.0, 0.0, 1.0)
    if usable.size:
        limits = (x.min() - margin, x.max() + margin, y.min() - margin, y.max() + margin)
    aspect = np.clip((limits[3] - limits[2]) / (limits[1] - limits[0]), 0.3, 2.0)
    figure = new_figure(0.46 * WIDTH_IN * aspect + 1.5, layout="constrained")
    stamp_axes, whisker_axes = figure.subplots(1, 2, sharex=True, sharey=True)
    # Stamps fill 92 % of their spacing. A square root shows core and wings in one picture.
    half = 0.46 * spacing_px
    for stamp, x0, y0 in zip(psf, stars.x[stamp_stars], stars.y[stamp_stars], strict=True):
        stamp_axes.imshow(
            np.sqrt(np.clip(stamp / stamp.max(), 0.0, 1.0)),
            origin="lower",
            extent=(x0 - half, x0 + half, y0 - half, y0 + half),
            cmap="magma",
            vmin=0.0,
            vmax=1.0,
            interpolation="nearest",
        )
    # More than 2500 whiskers would cover each other.
    whiskers = _draw_whiskers(whisker_axes, stars, usable[:2500], spacing_px)
    titles = ((stamp_axes, "PSF, each to its maximum"), (whisker_axes, "ellipticity and FWHM"))
    for axes, title in titles:
        axes.set(xlim=limits[:2], ylim=limits[2:], aspect="equal", xlabel="x (px)", title=title)
    stamp_axes.set_ylabel("y (px)")
    if whiskers is not None:
        both_axes = [stamp_axes, whisker_axes]
        bar = figure.colorbar(whiskers, ax=both_axes, location="bottom", shrink=0.6, aspect=40)
        bar.set_label("FWHM of the PSF (px)")
    figure.suptitle(f"{image_name}: {len(usable)} of {len(stars.x)} stars", parse_math=False)
    return figure


def _draw_whiskers(
    axes: Axes, stars: FieldStars, selected: np.ndarray, spacing_px: float
) -> LineCollection | None:
    """Draw a line along the major axis of each selected star, with a key for ellipticity 0.2.

    Parameters
    ----------
    axes : Axes
    stars : FieldStars
    selected : ndarray of int
        Numbers of the stars.
    spacing_px : float
        Distance of two stamps of the map.

    Returns
    -------
    LineCollection or None
        Lines, coloured by FWHM; None if no star is selected.
    """
    from matplotlib.collections import LineCollection

    if not selected.size:
        axes.text(0.5, 0.5, "no unflagged star", ha="center", transform=axes.transAxes)
        return None
    # A whisker is as long as two stamps for an ellipticity of 1.
    px_per_ellipticity = 2.0 * spacing_px
    angle = np.deg2rad(stars.position_angle_deg[selected])
    half = 0.5 * px_per_ellipticity * stars.ellipticity[selected]
    step = np.stack([half * np.cos(angle), half * np.sin(angle)], axis=1)
    centre = np.stack([stars.x[selected], stars.y[selected]], axis=1)
    ends = np.stack([centre - step, centre + step], axis=1)
    lines = LineCollection(list(ends), cmap="viridis", linewidths=1.3)
    # Colours leave out 2 % of the stars at either end, so that outliers do not flatten the scale.
    fwhm_px = stars.fwhm_px[selected]
    lines.set_array(fwhm_px)
    lines.set_clim(*np.percentile(fwhm_px, [2, 98]))
    axes.add_collection(lines)
    # The key is below the lowest star on the left.
    length = 0.2 * px_per_ellipticity
    x, y = centre.min(axis=0) - 0.45 * spacing_px
    axes.plot([x, x + length], [y, y], color="black", lw=2.0)
    axes.annotate(
        "0.2", (x + length, y), xytext=(3, 0), textcoords="offset points", va="center", fontsize=7
    )
    return lines
