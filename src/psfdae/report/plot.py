"""Map of the PSF over the field: stamps at their positions, size and shape of all stars."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.base.figures import WIDTH_IN, apply_style, new_figure
from psfdae.base.types import Axes, Figure, LineCollection
from psfdae.image.stamps import StarFlag


def has_shape(flags: np.ndarray) -> np.ndarray:
    """Return True for stars whose measured size and shape mean something, by their flags (n,).

    It means nothing for stars without flux, faint, masked, saturated or truncated ones, and such
    that are off their centre or unlike the training.
    """
    unusable = (
        StarFlag.NO_FLUX
        | StarFlag.FAINT
        | StarFlag.MASKED
        | StarFlag.SATURATED
        | StarFlag.TRUNCATED
        | StarFlag.OFF_CENTRE
        | StarFlag.UNLIKE_TRAINING
    )
    return np.asarray((flags & int(unusable)) == 0)


def usable_stars(stars: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return indices of the stars that can be drawn, brightest first.

    Parameters
    ----------
    stars : mapping of str to ndarray, shape (n,)
        Columns of a prediction; see `psf_map`.
    """
    is_finite = np.isfinite([stars[name] for name in ("x", "y", "fwhm_px")]).all(axis=0)
    usable = np.flatnonzero(is_finite & has_shape(stars["flags"]))
    return usable[np.argsort(-stars["snr"][usable], kind="stable")]


def stars_with_stamps(stars: Mapping[str, np.ndarray]) -> tuple[np.ndarray, float]:
    """Choose bright stars so far from each other that their stamps do not overlap in a map.

    Parameters
    ----------
    stars : mapping of str to ndarray, shape (n,)
        Columns of a prediction; see `psf_map`.

    Returns
    -------
    selected_stars : ndarray of int
        Indices of stars, brightest first.
    spacing_px : float
        Least distance of two of them along an axis, in pixels of the image.
    """
    # Nine stamps along the longer side of the field.
    candidates, position = usable_stars(stars), np.stack([stars["x"], stars["y"]])
    extent = float(np.ptp(position[:, candidates], axis=1).max()) if candidates.size else 0.0
    spacing_px = extent / 8 if extent > 0 else 1.0
    # Take the brightest star, drop all whose stamps would overlap with its stamp, and repeat.
    selected_stars = []
    while candidates.size:
        star = candidates[0]
        selected_stars.append(star)
        distance = np.abs(position[:, candidates] - position[:, star, None]).max(axis=0)
        candidates = candidates[distance >= spacing_px]
    return np.array(selected_stars, dtype=int), spacing_px


def read_psf_map(path: Path) -> Figure:
    """Draw the map of the PSFs in a FITS file of a prediction.

    Parameters
    ----------
    path : Path
        File of `psfdae predict`, with the extensions STARS and PSF.
    """
    from astropy.io import fits

    with fits.open(path, memmap=True) as file:
        table: Any = file["STARS"].data
        # Copies in the machine's byte order.
        names = ("x", "y", "snr", "fwhm_px", "ellipticity", "position_angle_deg", "flags")
        stars = {name: table[name].astype(table[name].dtype.newbyteorder("=")) for name in names}

        # Only the PSFs that are drawn are read: a file may have a million.
        def read_psfs(selected_stars: np.ndarray) -> np.ndarray:
            psfs = [file["PSF"].section[int(star)] for star in selected_stars]
            return np.array(psfs, dtype=np.float32)

        return psf_map(stars, read_psfs, file[0].header["INFILE"])


@apply_style
def psf_map(
    stars: Mapping[str, np.ndarray], psfs_of: Callable[[np.ndarray], np.ndarray], image_name: str
) -> Figure:
    """Draw stamps at the positions of their stars, and beside them a whisker for every star.

    Parameters
    ----------
    stars : mapping of str to ndarray, shape (n,)
        Columns of a prediction: `x` and `y` in 0-based pixels of the image, NaN if unknown; `snr`,
        by which stars are ordered; `fwhm_px`, `ellipticity` and `position_angle_deg` (from +x to
        +y) of the PSF of each star; `flags`, sums of the values of `StarFlag`.
    psfs_of : callable
        It returns the PSFs (k, d, d) of the stars with the given indices (k,).
    image_name : str
        Name of the image in the title.
    """
    usable, (stamp_stars, spacing_px) = usable_stars(stars), stars_with_stamps(stars)
    psf = psfs_of(stamp_stars)
    # Limits of the axes: all usable stars with room for a stamp about each.
    x, y = stars["x"][usable], stars["y"][usable]
    margin = 0.6 * spacing_px
    limits = (0.0, 1.0, 0.0, 1.0)
    if usable.size:
        limits = (x.min() - margin, x.max() + margin, y.min() - margin, y.max() + margin)
    # Height over width of the field, within what a page can show.
    aspect = np.clip((limits[3] - limits[2]) / (limits[1] - limits[0]), 0.3, 2.0)
    figure = new_figure(0.46 * WIDTH_IN * aspect + 1.5, layout="constrained")
    stamp_axes, whisker_axes = figure.subplots(1, 2, sharex=True, sharey=True)
    # Stamps fill 92 % of their spacing. A square root shows core and wings in one picture.
    half = 0.46 * spacing_px
    for stamp, x0, y0 in zip(psf, stars["x"][stamp_stars], stars["y"][stamp_stars], strict=True):
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
    figure.suptitle(f"{image_name}: {len(usable)} of {len(stars['x'])} stars")
    return figure


def _draw_whiskers(
    axes: Axes, stars: Mapping[str, np.ndarray], selected_stars: np.ndarray, spacing_px: float
) -> LineCollection | None:
    """Draw a line along the major axis of each selected star, with a key for ellipticity 0.2.

    Parameters
    ----------
    axes : Axes
        Axes of the map, whose unit is a pixel of the image.
    stars : mapping of str to ndarray, shape (n,)
        As in `psf_map`.
    selected_stars : ndarray of int
        Numbers of the stars.
    spacing_px : float
        Distance of two stamps of the map.

    Returns
    -------
    LineCollection or None
        Lines, coloured by FWHM; None if no star is selected.
    """
    from matplotlib.collections import LineCollection

    if not selected_stars.size:
        axes.text(0.5, 0.5, "no unflagged star", ha="center", transform=axes.transAxes)
        return None
    # A whisker is as long as two stamps for an ellipticity of 1.
    px_per_ellipticity = 2.0 * spacing_px
    # Ends of a whisker: the centre plus and minus half its length along the major axis.
    angle = np.deg2rad(stars["position_angle_deg"][selected_stars])
    half = 0.5 * px_per_ellipticity * stars["ellipticity"][selected_stars]
    step = np.stack([half * np.cos(angle), half * np.sin(angle)], axis=1)
    centre = np.stack([stars["x"][selected_stars], stars["y"][selected_stars]], axis=1)
    ends = np.stack([centre - step, centre + step], axis=1)
    lines = LineCollection(list(ends), cmap="viridis", linewidths=1.3)
    # Colours leave out 2 % of the stars at either end, so that outliers do not flatten the scale.
    fwhm_px = stars["fwhm_px"][selected_stars]
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
