"""An observation: the stars of one FITS file, described and ready to be streamed as stamps.

| input | stamps | positions |
|---|---|---|
| cube (n, d, d), or one stamp (d, d) | as stored | from the catalogue, row by row, or NaN |
| image (h, w) and a catalogue | cut at the rounded position | of the catalogue |

Whatever is wrong with a file ends in one `ObservationError` of one line that names it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.own_stars.catalogue import Catalogue, read_catalogue
from psfdae.own_stars.errors import ObservationError, reading
from psfdae.own_stars.images import (
    SATURATION_KEYS,
    SCALE_KEYS,
    Card,
    ImageFile,
    Pixels,
    find_image,
    open_pixels,
)
from psfdae.own_stars.stamps import Stamps

FAR = 2**30  # positions are clipped to ± this many pixels, far off any image
NEAR = 1.0  # stars farther off by this many image sizes are not corrected for distortion


@dataclass(frozen=True)
class Source:
    """A FITS file with stars, and what is stated about it."""

    path: Path  # FITS cube of stamps, or FITS image
    catalogue: Path | None = None  # needed for an image; positions and identifiers of a cube
    extension: str | int | None = None  # with the stars
    origin: int | None = None  # of the catalogue's pixels; by default that of its program
    mask: str | int | Path | None = None  # as large as the image; or (d, d) for all of a cube
    pixel_scale_arcsec: float | None = None  # what is given goes before the header
    gain: float | None = None  # electrons per count
    saturate: float | None = None  # counts
    flux_column: str | None = None  # of the catalogue: fluxes that are not to be estimated
    background_column: str | None = None  # the same for sky levels per pixel

    def open(self, stamp_px: int, margin: int = 0, larger: bool = False) -> Observation:
        """Check all that can be checked without reading pixels.

        Stamps of an image get a margin of so many pixels. Stamps of a cube may be `larger`
        than `stamp_px` if so asked, and keep their size then.
        """
        self._check(stamp_px, margin)
        image = find_image(self.path, self.extension)
        shape = image.shape
        if larger and len(shape) == 3 and shape[1] == shape[2] > stamp_px:
            stamp_px = shape[1]
        is_cube = self._is_cube(image, stamp_px)
        table = None if self.catalogue is None else read_catalogue(self.catalogue)
        count = len(table) if table is not None else shape[0] if len(shape) == 3 else 1
        identifiers = np.arange(count, dtype=np.int64)
        positions = None
        if table is not None:
            positions = self._positions(image, table, is_cube)
            identifiers = table.identifiers()
        scale, gain, saturate = self._stated(image)
        return Observation(
            self.path,
            count,
            stamp_px,
            margin=0 if is_cube else margin,
            shape=None if is_cube else shape,
            pixel_scale_arcsec=scale,
            gain=gain,
            saturate=saturate,
            positions=positions,
            header_cards=image.provenance(),
            _id=identifiers,
            _flux=self._column(table, self.flux_column, count),
            _background=self._column(table, self.background_column, count),
            _image=image,
            _mask=None if self.mask is None else _find_mask(image, self.mask),
        )

    def _check(self, stamp_px: int, margin: int) -> None:
        if stamp_px < 1:
            raise ObservationError(self.path, f"stamp size {stamp_px}, expected at least 1 pixel")
        if margin < 0:
            raise ObservationError(self.path, f"margin {margin}, expected at least 0 pixels")
        if self.origin not in (None, 0, 1):
            raise ObservationError(
                self.path, f"origin {self.origin!r} of pixel coordinates, expected 0 or 1"
            )
        stated = (self.pixel_scale_arcsec, self.gain, self.saturate)
        for name, value in zip(("pixel scale", "gain", "saturation"), stated, strict=True):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ObservationError(self.path, f"{name} {value!r}, expected a number above 0")

    def _is_cube(self, image: ImageFile, stamp_px: int) -> bool:
        shape = image.shape
        if len(shape) == 2 and self.catalogue is not None:
            return False
        if shape[-2:] == (stamp_px, stamp_px):
            return True
        size = f"{shape[-2]}×{shape[-1]}"
        if len(shape) == 2:
            raise ObservationError(image.path, f"an image of {size} pixels needs a star catalogue")
        raise ObservationError(
            image.path, f"stamps of {size} pixels, expected {stamp_px}×{stamp_px} pixels"
        )

    def _positions(self, image: ImageFile, table: Catalogue, is_cube: bool) -> np.ndarray | None:
        """Positions (n, 2) of the catalogue's stars; None for a cube if they are on the sky."""
        where = table.positions()
        if is_cube and len(table) != image.shape[0]:
            raise ObservationError(
                table.path, f"{len(table)} stars for the {image.shape[0]} stamps of {image.path}"
            )
        if where.sky and is_cube:
            return None
        if where.sky:
            ra, dec = table.sky(where)
            if image.wcs is None:
                raise ObservationError(
                    image.path,
                    f"no usable celestial WCS, which the sky coordinates {where.first},"
                    f"{where.second} of {table.path} need",
                )
            with reading(image.path):
                positions = np.stack(sky_to_pixel(image.wcs, ra, dec, image.shape), axis=1)
        else:
            origin = where.origin if self.origin is None else self.origin
            if origin is None:
                raise ObservationError(
                    table.path,
                    f"the origin of columns {where.first},{where.second} must be stated: "
                    "is the centre of the first pixel 0 or 1?",
                )
            columns = [table.finite(name) for name in (where.first, where.second)]
            positions = np.stack(columns, axis=1) - origin
        if not is_cube:
            _check_overlap(image, table, positions)
        return positions

    def _stated(self, image: ImageFile) -> tuple[float | None, float | None, float | None]:
        """Pixel scale, gain and saturation: what is given, else what the headers say."""
        scale, gain, saturate = self.pixel_scale_arcsec, self.gain, self.saturate
        if scale is None and image.wcs is not None:
            with reading(image.path):
                scale = pixel_scale(image.wcs)
            scale = scale if math.isfinite(scale) and scale > 0 else None
        return (
            image.positive(SCALE_KEYS) if scale is None else scale,
            image.gain() if gain is None else gain,
            image.positive(SATURATION_KEYS) if saturate is None else saturate,
        )

    def _column(self, table: Catalogue | None, name: str | None, count: int) -> np.ndarray:
        """A numeric column of the catalogue, NaN where it has no value or is not asked for."""
        if name is None:
            return np.full(count, np.nan)
        if table is None:
            raise ObservationError(self.path, f"no catalogue is given to take {name!r} from")
        return table.numbers(name)


def _check_overlap(image: ImageFile, table: Catalogue, positions: np.ndarray) -> None:
    rows, columns = image.shape
    column, row = central_pixel(positions.T)
    found = np.count_nonzero((column >= 0) & (column < columns) & (row >= 0) & (row < rows))
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


def _find_mask(image: ImageFile, mask: str | int | Path) -> ImageFile:
    outside = isinstance(mask, Path) or (isinstance(mask, str) and Path(mask).is_file())
    found = find_image(Path(mask)) if outside else find_image(image.file, mask)
    wanted = image.shape
    if found.shape != wanted and not (len(wanted) == 3 and found.shape == wanted[1:]):
        sizes = ["×".join(str(n) for n in shape) for shape in (found.shape, wanted)]
        raise ObservationError(found.path, f"a mask of {sizes[0]} pixels, expected {sizes[1]}")
    return found


@dataclass(frozen=True)
class Observation:
    """Stars of one FITS file. `Source.open` makes it."""

    path: Path
    count: int  # of stars, none is ever left out
    stamp_px: int
    margin: int  # pixels around each stamp, 0 for cubes
    shape: tuple[int, ...] | None  # (rows, columns) of the image, None for a cube
    pixel_scale_arcsec: float | None  # given, of the WCS, or of the header, in this order
    gain: float | None  # electrons per count
    saturate: float | None  # counts from which a pixel is saturated
    positions: np.ndarray | None  # (n, 2), 0-based x, y; NaN where the WCS cannot place a star
    header_cards: list[Card]  # provenance to copy into what is made of the stars
    _id: np.ndarray = field(repr=False)
    _flux: np.ndarray = field(repr=False)
    _background: np.ndarray = field(repr=False)
    _image: ImageFile = field(repr=False)
    _mask: ImageFile | None = field(repr=False)

    def chunks(self, rows: int) -> Iterator[Stamps]:
        """Stream the stars in their order, at most `rows` at a time.

        Only the pixels of a chunk are read. Tile-compressed cubes are decompressed
        chunk by chunk, tile-compressed images once per call, to a temporary file.
        """
        if rows < 1:
            raise ValueError(f"rows is {rows}, expected at least 1")
        cut = self._of_cube if self.shape is None else self._of_image
        with ExitStack() as files:
            pixels, mask = (
                image and files.enter_context(open_pixels(image, whole=self.shape is not None))
                for image in (self._image, self._mask)
            )
            for start in range(0, self.count, rows):
                part = slice(start, min(start + rows, self.count))
                yield self._stamps(part, *cut(part, pixels, mask))

    def _of_cube(self, part: slice, pixels: Pixels, mask: Pixels | None) -> tuple[np.ndarray, ...]:
        """Pixels, which of them are masked, and which stars are truncated."""
        size = (part.stop - part.start, self.stamp_px, self.stamp_px)
        data = _rows(pixels, part).reshape(size)
        masked = np.zeros(size, dtype=bool)
        if mask is not None:
            masked |= _rows(mask, part if len(mask.image.shape) == 3 else slice(0, 1)) != 0
        return data, masked, np.zeros(size[0], dtype=bool)

    def _of_image(self, part: slice, pixels: Pixels, mask: Pixels | None) -> tuple[np.ndarray, ...]:
        x, y = self.positions[part].T
        where = (self.shape, x, y, self.stamp_px, self.margin)
        data, inside, truncated = cut_image(pixels, *where)
        masked = ~inside
        if mask is not None:
            masked |= cut_image(mask, *where)[0] != 0
        return data, masked, truncated

    def _stamps(
        self, part: slice, data: np.ndarray, masked: np.ndarray, truncated: np.ndarray
    ) -> Stamps:
        if self.saturate is None:
            saturated = np.zeros(data.shape, dtype=bool)
        else:
            saturated = data >= self.saturate  # +inf is, NaN is not
        finite = np.isfinite(data)
        if not finite.all():
            data[~finite] = 0.0
            masked |= ~finite
        unknown = np.full(len(data), np.nan)
        x, y = (unknown, unknown) if self.positions is None else self.positions[part].T
        gain = unknown if self.gain is None else np.full(len(data), self.gain)
        known = (self._flux[part], self._background[part], unknown, gain)
        return Stamps(data, masked, saturated, truncated, self._id[part], x, y, *known)


def _rows(pixels: Pixels, part: slice) -> np.ndarray:
    """Stamps of a cube; a 2-d image counts as a cube of one."""
    return pixels[part] if len(pixels.image.shape) == 3 else pixels[slice(None)][None]


def central_pixel(position: np.ndarray) -> np.ndarray:
    """The pixel in which a 0-based position lies, int64; −`FAR` where it is NaN.

    Pixel k covers k − ½ ≤ position < k + ½.
    """
    rounded = np.floor(np.nan_to_num(position, nan=-FAR, posinf=FAR, neginf=-FAR) + 0.5)
    return np.clip(rounded, -FAR, FAR).astype(np.int64)


def cut_image(
    pixels: Any, shape: tuple[int, int], x: np.ndarray, y: np.ndarray, stamp_px: int, margin: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a stamp around each star, with the star's pixel at index d//2 + margin.

    Parameters
    ----------
    pixels : array-like of that shape, indexed once with arrays of rows and columns
    x, y : ndarray, shape (n,)
        0-based positions; NaN is off the image.
    stamp_px, margin : int
        d, and pixels added on every side.

    Returns
    -------
    stamps : ndarray, shape (n, d + 2·margin, d + 2·margin), 0 off the image
    inside : ndarray of bool, the same shape: the pixel is on the image
    truncated : ndarray of bool, shape (n,): a pixel of the stamp, margin aside, is not
    """
    side = np.arange(stamp_px + 2 * margin) - stamp_px // 2 - margin
    rows = central_pixel(y)[:, None] + side
    columns = central_pixel(x)[:, None] + side
    row_inside = (rows >= 0) & (rows < shape[0])
    column_inside = (columns >= 0) & (columns < shape[1])
    stamps = pixels[
        np.clip(rows, 0, shape[0] - 1)[:, :, None], np.clip(columns, 0, shape[1] - 1)[:, None, :]
    ]
    inside = row_inside[:, :, None] & column_inside[:, None, :]
    stamp = slice(margin, margin + stamp_px)
    truncated = ~(row_inside[:, stamp].all(axis=1) & column_inside[:, stamp].all(axis=1))
    if not inside.all():
        stamps = np.where(inside, stamps, 0)
    return stamps, inside, truncated


def pixel_scale(wcs: Any) -> float:
    """Side in arcseconds of a square as large as a pixel at the reference point."""
    from astropy.wcs.utils import proj_plane_pixel_area

    return float(np.sqrt(proj_plane_pixel_area(wcs))) * 3600.0


def sky_to_pixel(
    wcs: Any, ra: np.ndarray, dec: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Positions of stars in an image (rows, columns) from their ICRS coordinates in degrees.

    0-based x and y, shape (n,); NaN for stars that the projection cannot show. Distortions
    are inverted by iteration, and only for stars near the image: far from it their
    polynomials fold back, and a star degrees away would seem to be in the image (Shupe et
    al. 2005, ASP Conf. 347, 491 define them for the image).
    """
    from astropy.coordinates import SkyCoord
    from astropy.wcs import NoConvergence
    from astropy.wcs.utils import skycoord_to_pixel

    stars = SkyCoord(ra, dec, unit="deg")
    x, y = (np.array(v, dtype=np.float64) for v in skycoord_to_pixel(stars, wcs, mode="wcs"))
    rows, columns = shape
    near = (np.abs(x - columns / 2) < (0.5 + NEAR) * columns) & (
        np.abs(y - rows / 2) < (0.5 + NEAR) * rows
    )
    if wcs.has_distortion and near.any():
        try:
            x[near], y[near] = skycoord_to_pixel(stars[near], wcs, mode="all")
        except NoConvergence as error:
            solution = np.array(error.best_solution, dtype=np.float64)
            if error.divergent is not None:
                solution[error.divergent] = np.nan
            x[near], y[near] = solution.T
    return x, y
