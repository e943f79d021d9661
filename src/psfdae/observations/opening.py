"""Opening an observation: all that can be checked without reading pixels is checked here."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from psfdae.observations.catalogue import Catalogue, read_catalogue
from psfdae.observations.columns import Pair, PositionColumns
from psfdae.observations.cutting import on_image
from psfdae.observations.errors import ObservationError, reading
from psfdae.observations.headers import (
    SATURATION_KEYS,
    SCALE_KEYS,
    electrons_per_count,
    positive_number,
    provenance,
)
from psfdae.observations.images import ImageFile, find_image
from psfdae.observations.observation import Observation
from psfdae.observations.sky import pixel_scale, sky_to_pixel


def open_observation(
    path: str | Path,
    *,
    stamp_px: int,
    catalogue: str | Path | None = None,
    extension: str | int | None = None,
    origin: int | None = None,
    columns: Pair | None = None,
    mask: str | int | Path | None = None,
    pixel_scale_arcsec: float | None = None,
    gain: float | None = None,
    saturate: float | None = None,
    margin: int = 0,
) -> Observation:
    """Open a FITS cube of stamps, or a FITS image with a star catalogue.

    Parameters
    ----------
    path : FITS file, see `psfdae.observations.images.find_image`
    stamp_px : side d of the stamps; a cube must have just this
    catalogue : star list, see `psfdae.observations.catalogue.read_catalogue`
        Needed for an image; gives the stamps of a cube positions and identifiers.
    extension : name or number of the extension with the image
    origin : index of the centre of the first pixel in the catalogue, 0 or 1
        By default that of the program that writes such columns.
    columns : names of the position columns, see `psfdae.observations.columns`
    mask : extension of the same file, or a FITS file; pixels other than 0 are bad
        As large as the image; one mask (d, d) may serve all stamps of a cube.
    pixel_scale_arcsec, gain, saturate : go before those of the header
        Arcseconds, electrons per count, counts from which a pixel is saturated.
    margin : pixels to add around each stamp of an image

    Raises
    ------
    ObservationError
        If an argument is out of range, a file is missing, damaged or of a wrong
        form, all stars are off the image, or more are on it than it has pixels.
    """
    path = Path(path)
    _check_arguments(path, stamp_px, margin, origin, pixel_scale_arcsec, gain, saturate)
    image = find_image(path, extension)
    is_cube = _is_cube(image, stamp_px, catalogue is not None)
    table = None if catalogue is None else read_catalogue(catalogue)
    count, identifiers, positions = _stars(image, is_cube, table, columns, origin)
    return Observation(
        path=path,
        count=count,
        stamp_px=stamp_px,
        **_stated(image, pixel_scale_arcsec, gain, saturate),
        shape=None if is_cube else image.shape,
        positions=positions,
        header_cards=provenance(image.headers),
        margin=0 if is_cube else margin,
        _id=identifiers,
        _image=image,
        _mask=None if mask is None else _find_mask(image, mask),
        _catalogue=table,
    )


def _stated(
    image: ImageFile, scale: float | None, gain: float | None, saturate: float | None
) -> dict[str, float | None]:
    """What is given, else what the headers say."""
    if scale is None and image.wcs is not None:
        scale = _scale_of_wcs(image)
    if scale is None:
        scale = positive_number(image.headers, SCALE_KEYS)
    if gain is None:
        gain = electrons_per_count(image.headers)
    if saturate is None:
        saturate = positive_number(image.headers, SATURATION_KEYS)
    return {"pixel_scale_arcsec": scale, "gain": gain, "saturate": saturate}


def _check_arguments(
    path: Path,
    stamp_px: int,
    margin: int,
    origin: int | None,
    *positive: float | None,
) -> None:
    if stamp_px < 1:
        raise ObservationError(path, f"stamp size {stamp_px}, expected at least 1 pixel")
    if margin < 0:
        raise ObservationError(path, f"margin {margin}, expected at least 0 pixels")
    if origin not in (None, 0, 1):
        raise ObservationError(path, f"origin {origin!r} of pixel coordinates, expected 0 or 1")
    for name, value in zip(("pixel scale", "gain", "saturation"), positive, strict=True):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ObservationError(path, f"{name} {value!r}, expected a number above 0")


def _is_cube(image: ImageFile, stamp_px: int, has_catalogue: bool) -> bool:
    shape = image.shape
    if len(shape) == 2 and has_catalogue:
        return False
    if shape[-2:] == (stamp_px, stamp_px):
        return True
    size = f"{shape[-2]}×{shape[-1]}"
    if len(shape) == 2:
        raise ObservationError(image.path, f"an image of {size} pixels needs a star catalogue")
    raise ObservationError(
        image.path, f"stamps of {size} pixels, expected {stamp_px}×{stamp_px} pixels"
    )


def _stars(
    image: ImageFile,
    is_cube: bool,
    table: Catalogue | None,
    columns: Pair | None,
    origin: int | None,
) -> tuple[int, np.ndarray, np.ndarray | None]:
    """Number, identifiers and positions of the stars."""
    if table is None:
        count = image.shape[0] if len(image.shape) == 3 else 1
        return count, np.arange(count, dtype=np.int64), None
    where = table.position_columns(columns)
    if is_cube and len(table) != image.shape[0]:
        raise ObservationError(
            table.path, f"{len(table)} stars for the {image.shape[0]} stamps of {image.path}"
        )
    if where.sky:
        positions = None if is_cube else _placed_by_wcs(image, table, where)
    else:
        positions = _pixel_positions(table, where, origin)
    if not is_cube:
        _check_overlap(image, table, positions)
    return len(table), table.identifiers(), positions


def _pixel_positions(table: Catalogue, where: PositionColumns, origin: int | None) -> np.ndarray:
    origin = where.origin if origin is None else origin
    if origin is None:
        raise ObservationError(
            table.path,
            f"the origin of columns {where.first},{where.second} must be stated: "
            "is the centre of the first pixel 0 or 1?",
        )
    return np.stack([table.finite(where.first), table.finite(where.second)], axis=1) - origin


def _placed_by_wcs(image: ImageFile, table: Catalogue, where: PositionColumns) -> np.ndarray:
    ra, dec = table.sky(where)
    if image.wcs is None:
        raise ObservationError(
            image.path,
            f"no usable celestial WCS, which the sky coordinates {where.first},{where.second} "
            f"of {table.path} need",
        )
    with reading(image.path):
        return np.stack(sky_to_pixel(image.wcs, ra, dec, image.shape), axis=1)


def _check_overlap(image: ImageFile, table: Catalogue, positions: np.ndarray) -> None:
    rows, columns = image.shape
    found = np.count_nonzero(on_image(*positions.T, image.shape))
    if found > rows * columns:
        raise ObservationError(
            table.path,
            f"{found} stars are on the image {image.path} of {columns} columns and {rows} rows, "
            "more than it has pixels",
        )
    if found:
        return
    with np.errstate(all="ignore"):
        placed = positions[np.isfinite(positions).all(axis=1)]
        ranges = "nowhere in its projection"
        if len(placed):
            (x0, y0), (x1, y1) = placed.min(axis=0), placed.max(axis=0)
            ranges = f"at x {x0:.6g} … {x1:.6g}, y {y0:.6g} … {y1:.6g}"
    raise ObservationError(
        table.path,
        f"none of the {len(table)} stars is on the image {image.path} of {columns} columns "
        f"and {rows} rows; they are {ranges}",
    )


def _scale_of_wcs(image: ImageFile) -> float | None:
    with reading(image.path):
        scale = pixel_scale(image.wcs)
    return scale if math.isfinite(scale) and scale > 0 else None


def _find_mask(image: ImageFile, mask: str | int | Path) -> ImageFile:
    outside = isinstance(mask, Path) or (isinstance(mask, str) and Path(mask).is_file())
    found = find_image(mask) if outside else find_image(image.file, mask)
    wanted = image.shape
    if found.shape != wanted and not (len(wanted) == 3 and found.shape == wanted[1:]):
        sizes = ["×".join(str(n) for n in shape) for shape in (found.shape, wanted)]
        raise ObservationError(found.path, f"a mask of {sizes[0]} pixels, expected {sizes[1]}")
    return found
