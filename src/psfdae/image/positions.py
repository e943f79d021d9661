"""Positions of the stars of a list in an image: from its pixels or its sky coordinates, checked.

Inputs: a star list and an image. Output: 0-based positions (n, 2), x and y, NaN for stars that are
not in the plane of the image.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psfdae.base.errors import keyword
from psfdae.base.types import WCS
from psfdae.image.catalogue import Catalogue
from psfdae.image.errors import ObservationError, reading
from psfdae.image.fits_file import ImageFile, sky_frame
from psfdae.image.list_origin import TOLERANCE_PX
from psfdae.image.position_columns import Positions
from psfdae.image.stamps import LARGEST_POSITION_PX, central_pixel

SAME_STAR_PX = 0.1
"""Distance below which two rows of a list are one star."""


def positions_in_image(
    image: ImageFile, table: Catalogue, columns: Positions, is_cube: bool
) -> np.ndarray | None:
    """Return the positions of the catalogue's stars, NaN in rows without one.

    Parameters
    ----------
    image : ImageFile
        Image or cube, with the WCS.
    table : Catalogue
        The star list.
    columns : Positions
        Columns of the list, and the origin of its pixels.
    is_cube : bool
        The image is a cube of stamps, one for each row of the list.

    Returns
    -------
    ndarray or None, shape (n, 2)
        0-based x and y; None for a cube with a list of sky coordinates.

    Raises
    ------
    ObservationError
        If the list has no star on the image, more stars than pixels, another number of stars than
        the cube has stamps, or pixels of an unknown origin; or if a WCS is missing.
    """
    if is_cube and len(table) != image.shape[0]:
        raise ObservationError(
            table.path, f"{len(table)} stars for the {image.shape[0]} stamps of {image.path}"
        )
    names = f"{columns.first},{columns.second}"
    # From the sky by the WCS, or from pixels by their origin.
    if columns.sky:
        if is_cube:
            return None
        ra, dec = table.sky(columns)
        if image.wcs is None:
            raise ObservationError(
                image.path,
                f"no usable celestial WCS, which the sky coordinates {names} of {table.path} need",
            )
        with reading(image.path):
            positions = np.stack(sky_to_pixel(image.wcs, ra, dec, image.shape), axis=1)
    else:
        if columns.origin is None:
            raise ObservationError(
                table.path,
                f"the origin of columns {names} must be given: is the centre of the first pixel "
                f"0 or 1? {keyword('origin')} sets it",
            )
        list_pixels = [table.pixels(name) for name in (columns.first, columns.second)]
        positions = np.stack(list_pixels, axis=1) - columns.origin
    # Values far outside any image are not positions, and their squares overflow.
    positions = np.where(np.abs(positions) < LARGEST_POSITION_PX, positions, np.nan)
    if not is_cube:
        check_overlap(image, table, columns, positions)
    return positions


def is_on_image(positions: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return True for positions (n, 2), x and y, on an image (rows, columns)."""
    # Row and column of the pixel that a star is in.
    pixel = central_pixel(positions[:, ::-1])
    return np.asarray(((pixel >= 0) & (pixel < shape)).all(axis=1))


def check_overlap(
    image: ImageFile, table: Catalogue, columns: Positions, positions: np.ndarray
) -> None:
    """Reject a list without a star on the image, or with more stars there than pixels.

    Parameters
    ----------
    image : ImageFile
        Image of two dimensions.
    table : Catalogue
        The star list, named in messages.
    columns : Positions
        Columns of the list, named in messages.
    positions : ndarray, shape (n, 2)
        0-based x and y, NaN where unknown.
    """
    # A list with more stars than pixels belongs to another image.
    height, width = image.shape
    size = f"{image.path} of {width} columns and {height} rows"
    count = np.count_nonzero(is_on_image(positions, image.shape))
    if count > height * width:
        raise ObservationError(
            table.path, f"{count} stars are on the image {size}, more than it has pixels"
        )
    if count:
        return
    # The range of the positions shows a wrong unit, or another image.
    ranges = "nowhere in its projection"
    finite = positions[np.isfinite(positions).all(axis=1)]
    if len(finite):
        (x0, y0), (x1, y1) = finite.min(axis=0), finite.max(axis=0)
        ranges = f"at x {x0:.6g} … {x1:.6g}, y {y0:.6g} … {y1:.6g}"
    if columns.sky:
        ranges += f" ({columns.first},{columns.second} without a unit are degrees)"
    raise ObservationError(
        table.path, f"none of the {len(table)} stars is on the image {size}; they are {ranges}"
    )


def find_repeated_rows(positions: np.ndarray) -> np.ndarray:
    """Return True for positions (n, 2) within `SAME_STAR_PX` of an earlier one, shape (n,)."""
    from scipy.spatial import cKDTree

    indices = np.flatnonzero(np.isfinite(positions).all(axis=1))
    is_repeated = np.zeros(len(positions), dtype=bool)
    # Of each pair of rows at one position, the later one is a repetition.
    pairs = cKDTree(positions[indices]).query_pairs(SAME_STAR_PX, output_type="ndarray")
    is_repeated[indices[pairs.max(axis=1)]] = True
    return is_repeated


def list_offset(path: Path | None, off: np.ndarray, accept: bool) -> str | None:
    """Check how far stars are off the positions of their list; return a sentence on it.

    Parameters
    ----------
    path : Path or None
        The list.
    off : ndarray, shape (n, 2)
        Position of each star less its position in the list, x and y in px; NaN where unknown.
    accept : bool
        Accept the list whatever the offset is.

    Returns
    -------
    str or None
        None if fewer than five offsets are known, or without a list.

    Raises
    ------
    ObservationError
        If half of the stars are off by more than 1 px along an axis, or the median offset is 1 px
        along both.
    """
    offsets = off[~np.isnan(off).any(axis=1)]
    if path is None or len(offsets) < 5:
        return None
    # Medians: neighbours and defects move some stars.
    x, y = np.median(offsets, axis=0)
    distance = np.median(np.abs(offsets), axis=0)
    sentence = (
        f"stars are off its positions by x {x:+.2f}, y {y:+.2f} px in the median, half of them "
        f"by more than {distance[0]:.2f}, {distance[1]:.2f} px either way ({len(offsets)} stars)"
    )
    if accept:
        return f"{path}: {sentence}"
    # A list with the other pixel origin is off by one pixel along both axes.
    x1, y1 = round(x), round(y)
    if x1 == y1 and abs(x1) == 1 and max(abs(x - x1), abs(y - y1)) < TOLERANCE_PX:
        origin = int(x1 < 0)
        raise ObservationError(
            path,
            f"{sentence}: its positions count from {origin}? {keyword('origin', origin)} sets this "
            f"({keyword('accept_offset', True)} accepts it unchanged)",
        )
    # Half of the stars are more than 1 px off: the list belongs to another image.
    if (distance > 1.0).any():
        raise ObservationError(
            path,
            f"{sentence}: a list of another image or origin, or x and y exchanged? "
            f"{keyword('accept_offset', True)} accepts it unchanged",
        )
    return f"{path}: {sentence}"


def sky_to_pixel(
    wcs: WCS, ra: np.ndarray, dec: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions of stars in an image from their ICRS coordinates.

    Distortions are inverted by iteration, and only for stars near the image: far from it their
    polynomials fold back, and a star degrees away would seem to be in the image (Shupe et al. 2005,
    ASP Conf. 347, 491 define them for the image).

    Parameters
    ----------
    wcs : WCS
        Celestial WCS of the image, with its distortions.
    ra, dec : ndarray, shape (n,)
        Right ascension and declination in degrees.
    shape : tuple of int
        Rows and columns of the image.

    Returns
    -------
    x, y : ndarray, shape (n,)
        0-based pixels; NaN for stars outside the projection.
    """
    from astropy.coordinates import SkyCoord
    from astropy.wcs import NoConvergence

    # Longitude and latitude in the order of the header's axes.
    stars = SkyCoord(ra, dec, unit="deg").transform_to(sky_frame(wcs)).spherical
    world = np.stack([stars.lon.deg, stars.lat.deg])[:: 1 if wcs.wcs.lng < wcs.wcs.lat else -1]
    # First the linear part and the projection, without SIP or look-up tables.
    x, y = wcs.wcs_world2pix(*world, 0)
    # Stars at most one size of the image off its edge.
    rows, columns = shape
    is_near = (np.abs(x - columns / 2) < 1.5 * columns) & (np.abs(y - rows / 2) < 1.5 * rows)
    if wcs.has_distortion and is_near.any():
        try:
            x[is_near], y[is_near] = wcs.all_world2pix(*world[:, is_near], 0)
        # Where the iteration does not converge, use its last step, unless it diverges.
        except NoConvergence as error:
            solution = np.array(error.best_solution, dtype=np.float64)
            if error.divergent is not None:
                solution[error.divergent] = np.nan
            x[is_near], y[is_near] = solution.T
    return x, y
