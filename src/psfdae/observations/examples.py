"""Small observations to try things on: a cube of stamps, an image with its catalogue."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.files import atomic_path, write_fits
from psfdae.observations.cutting import central_pixel


def write_cube(
    path: str | Path, stamps: np.ndarray, *, compress: bool = False, **cards: Any
) -> None:
    """Write stamps as the FITS cube that `open_observation` reads.

    Parameters
    ----------
    path : path-like
        Replaced atomically.
    stamps : ndarray, shape (n, d, d)
        Stored as they are, float64 as float32.
    compress : bool
        Tile compression (RICE for integers; floats lose what is below the noise),
        100 stamps to a tile: tiles of one row, the usual default, take astropy ten
        times as long to read.
    **cards
        Header cards, such as PIXSCALE=1.0.
    """
    _write_image(path, stamps, cards, compress)


def write_field(
    path: str | Path,
    catalogue: str | Path,
    stamps: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    *,
    shape: tuple[int, int],
    background: float | np.ndarray = 0.0,
    pixel_scale_arcsec: float = 1.0,
    centre_deg: tuple[float, float] = (150.0, 2.0),
    compress: bool = False,
    **cards: Any,
) -> None:
    """Write an image into which stamps are added, and a CSV catalogue of its stars.

    The image has a tangential WCS with north up; the catalogue has the columns id,
    X_IMAGE, Y_IMAGE (1-based, as in SExtractor) and ra, dec (degrees).

    Parameters
    ----------
    path, catalogue : path-like
        FITS image and CSV file, each replaced atomically.
    stamps : ndarray, shape (n, d, d)
        In counts, without background; overlaps add up, what is off the image is lost.
    x, y : ndarray, shape (n,)
        0-based positions; the stamp's pixel (d/2, d/2) goes to the nearest pixel.
    shape : (rows, columns) of the image
    background : float or ndarray of that shape
        Counts per pixel, where noise goes in as well.
    pixel_scale_arcsec : float
    centre_deg : (right ascension, declination) of the middle of the image
    compress : bool
        As in `write_cube`.
    **cards
        Header cards, such as GAIN=2.0.
    """
    from astropy.table import Table

    image = np.zeros(shape) + background
    _add_stamps(image, stamps, x, y)
    wcs = _tangential(shape, pixel_scale_arcsec, centre_deg)
    _write_image(path, image, {**wcs.to_header(), **cards}, compress)
    ra, dec = wcs.all_pix2world(x, y, 0)
    rows = {"id": np.arange(len(x)), "X_IMAGE": x + 1, "Y_IMAGE": y + 1, "ra": ra, "dec": dec}
    with atomic_path(catalogue) as temporary:
        formats = {"X_IMAGE": "%.4f", "Y_IMAGE": "%.4f", "ra": "%.8f", "dec": "%.8f"}
        Table(rows).write(temporary, format="ascii.csv", formats=formats, overwrite=True)


def _add_stamps(image: np.ndarray, stamps: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Add each stamp around its position to the image, in place."""
    d = stamps.shape[-1]
    rows = central_pixel(y)[:, None, None] - d // 2 + np.arange(d)[:, None]
    columns = central_pixel(x)[:, None, None] - d // 2 + np.arange(d)
    rows, columns = np.broadcast_arrays(rows, columns)
    inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
    np.add.at(image, (rows[inside], columns[inside]), stamps[inside])


def _tangential(
    shape: tuple[int, int], pixel_scale_arcsec: float, centre_deg: tuple[float, float]
) -> Any:
    from astropy.wcs import WCS

    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = centre_deg
    wcs.wcs.crpix = [(shape[1] + 1) / 2, (shape[0] + 1) / 2]
    wcs.wcs.cdelt = [-pixel_scale_arcsec / 3600.0, pixel_scale_arcsec / 3600.0]
    return wcs


def _write_image(
    path: str | Path, pixels: np.ndarray, cards: Mapping[str, Any], compress: bool
) -> None:
    from astropy.io import fits

    if pixels.dtype == np.float64:
        pixels = pixels.astype(np.float32)
    header = fits.Header(list(cards.items()))
    if compress:
        tile = (min(len(pixels), 100), *pixels.shape[1:])
        image = fits.CompImageHDU(pixels, header, tile_shape=tile)
        hdus = fits.HDUList([fits.PrimaryHDU(), image])
    else:
        hdus = fits.HDUList([fits.PrimaryHDU(pixels, header)])
    write_fits(path, hdus)
