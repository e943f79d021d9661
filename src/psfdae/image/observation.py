"""An observation: the stars of one FITS file, described and ready to be streamed as stamps.

| input | stamps | positions |
|---|---|---|
| cube (n, s, s), or one stamp (s, s) | their middle | from the catalogue, row by row, or NaN |
| image (h, w) and a catalogue | cut at the rounded position | of the catalogue |
| image (h, w) to be searched | the same | of the stars found (`detection`) |

Whatever is wrong with a file ends in one `ObservationError` of one line that names it.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.image.bad_pixels import BadPixels, ClippedSkyError, find_bad_pixels
from psfdae.image.catalogue import Catalogue, as_catalogue
from psfdae.image.containers import in_unit
from psfdae.image.detection import Sky, sky_of
from psfdae.image.errors import ObservationError, reading, shorten, silent
from psfdae.image.fits_file import (
    INSTRUMENT_KEYS,
    READ_NOISE_KEYS,
    SATURATION_KEYS,
    Card,
    ImageFile,
    Pixels,
    PlainFile,
    Said,
    array_image,
    bits_of_bad_pixels,
    card_value,
    find_image,
    layers_beside,
    map_kind,
    open_pixels,
)
from psfdae.image.header_checks import (
    checked_camera,
    refuse_mosaic_of_colours,
    sky_coordinate_remarks,
    sky_sample,
)
from psfdae.image.list_origin import TOLERANCE_PX, origin_of
from psfdae.image.position_columns import Positions
from psfdae.image.stamps import Stamps, StarFlag, cut, raise_flag, sky_around
from psfdae.image.trails import with_trails

if TYPE_CHECKING:
    from astropy.table import Table
    from astropy.units import Quantity
    from astropy.wcs import WCS

    from psfdae.image.catalogue import StarList

FAR = 2**30  # positions are clipped to ± this many pixels, far off any image
NEAR = 1.0  # stars farther off by this many image sizes are not corrected for distortion
ASSUMED_SCALE = 1.0  # arcseconds per pixel where nothing says it
FARTHEST_OFF = 1.0  # px, per axis, of the stars of a list from its positions, in the median
FEWEST_OFF = 5  # stars of which that is said
SEEN = 2.0  # σ above the sky from which a position of a list is on a source
COLOURS = (3, 4)  # planes of a colour image, the fourth for luminance or transparency
LARGEST_STAMP_PX = 256  # of a model; a margin of stamps is small beside it
RING_PX = 8  # around a stamp, at least: there the noise of the sky is that of no star
HASHED_ROWS = 256  # of an image, or stamps of a cube, that are read at a time for its checksum
SAME_PX = 0.1  # nearer to each other than this, two rows of a list are one star
NO_LAYER = "none"  # in place of an extension: none of the image's own file, either
NOISE_MAPS = {"weight": "a weight map", "variance": "a variance map", "error": "a map of σ"}
FITS_SUFFIXES = re.compile(r"(\.(fits|fit|fts|fz|gz|bz2|xz|zip))+$", re.IGNORECASE)


@dataclass(frozen=True)
class Source:
    """A FITS file with stars, and what is stated about it."""

    image: Path | PlainFile | np.ndarray  # cube of stamps, or image
    catalogue: StarList | None = (
        None  # of an image, as `as_catalogue` takes it; of a cube, row by row
    )
    detect: float | None = None  # in its place: σ above the sky from which stars are searched
    extension: str | int | None = None  # with the stars
    on_image: bool = False  # stars of the catalogue that are off the image are left out
    origin: int | None = None  # of the catalogue's pixels; by default that of its program
    # Extension, file or array as large as the image; or a mask (d, d) for all of a cube.
    # "none": without that of the image's own file.
    mask: str | int | Path | np.ndarray | None = None
    bad_bits: int | None = None  # of the mask; any by default
    weight: str | int | Path | np.ndarray | None = None  # 1/σ² of every pixel, but for a factor
    variance: str | int | Path | np.ndarray | None = None  # σ² in its place
    error: str | int | Path | np.ndarray | None = None  # σ in its place; "none" as of the mask
    # What is given goes before the header; quantities are converted.
    pixel_scale_arcsec: float | Quantity | None = None
    gain: float | Quantity | None = None  # electrons per count
    read_noise: float | Quantity | None = None  # electrons
    saturate: float | Quantity | None = None  # counts
    flux_column: str | None = None  # of the catalogue: fluxes that are not to be estimated
    background_column: str | None = None  # the same for sky levels per pixel
    colour_column: str | None = None  # of the catalogue: colours, on which the PSF may depend
    accept_offset: bool = False  # of the catalogue's positions from the stars

    @property
    def path(self) -> Path:
        """The image's file, or what an array is called in messages."""
        if isinstance(self.image, PlainFile):
            return self.image.name
        return self.image if isinstance(self.image, Path) else Path("array")

    @property
    def name(self) -> str:
        """Default name of a model of its stars: the file's name without its suffixes."""
        return FITS_SUFFIXES.sub("", self.path.name) or "model"

    def files(self) -> tuple[object, ...]:
        """All that is read."""
        return (self.image, self.catalogue, self.mask, self.weight, self.variance, self.error)

    def of_each(self, images: Sequence[Path | PlainFile | np.ndarray]) -> list[Source]:
        """The same of each image; stars of the list of several are of those on which they are."""
        on_image = self.on_image
        if self.catalogue is not None and len(images) > 1:
            require_sky(self.catalogue, "a training on several images")
            on_image = True
        return [replace(self, image=image, on_image=on_image) for image in images]

    def open(self, stamp_px: int, margin: int = 0) -> Observation:
        """Check all that can be checked without reading pixels.

        Pixels are read to find stars, and where there is a map of noise. Stamps get a margin
        of so many pixels, those of a cube as many of these as they have.
        """
        if stamp_px < 1:
            raise ObservationError(self.path, f"stamp size {stamp_px}, expected at least 1 pixel")
        if margin < 0:
            raise ObservationError(self.path, f"margin {margin}, expected at least 0 pixels")
        if self.origin not in (None, 0, 1):
            raise ObservationError(
                self.path, f"origin {self.origin!r} of pixel coordinates, expected 0 or 1"
            )
        image = find_image(self.image, self.extension)
        return self._in_units(image)._opened(image, stamp_px, margin)

    def _in_units(self, image: ImageFile) -> Source:
        """The same with plain numbers in place of quantities."""
        units = {
            "pixel_scale_arcsec": "arcsec/pix arcsec",
            "gain": "electron/adu electron/ct electron/DN",
            "read_noise": "electron",
            "saturate": "adu ct DN",
        }
        if image.unit:
            units["saturate"] = f"{units['saturate']} {image.unit.replace(' ', '')}"
        numbers: dict[str, Any] = {
            name: in_unit(getattr(self, name), accepted, name, self.path)
            for name, accepted in units.items()
        }
        return replace(self, **numbers)

    def _opened(self, image: ImageFile, stamp_px: int, margin: int) -> Observation:
        self._check_numbers()
        table = None if self.catalogue is None else as_catalogue(self.catalogue)
        image = self._as_image(image, table)
        shape = image.shape
        is_cube = self._is_cube(image, stamp_px)
        is_stated = self.catalogue is not None or self.origin is not None
        if self.detect is not None and (is_cube or is_stated):
            raise ObservationError(
                self.path, "--detect takes an image, no cube; no list, and no origin of one"
            )
        camera = self._camera(image)
        remarks: list[str] = []
        if not is_cube:
            # The header's values are used as far as the pixels do not contradict them.
            refuse_mosaic_of_colours(image)
            camera, remarks = checked_camera(image, camera, sky_sample(image))
            remarks += sky_coordinate_remarks(image)
        layers, layer_notes = self._layers(image, is_cube, camera)
        remarks += layer_notes
        listed = None if table is None else table.path
        if self.detect is not None or layers.noise is not None:
            sky = layers.sky()
            remarks += [f"{self.path}: {note}" for note in sky.notes]
            if layers.noise is not None:
                layers = replace(layers, noise_scale=sky.noise_scale)
                layers, camera, remark = _with_photons(layers, camera, sky)
                remarks += remark
            table = table if self.detect is None else self._detected(sky, self.detect)
        count = len(table) if table is not None else shape[0] if len(shape) == 3 else 1
        identifiers = np.arange(count, dtype=np.int64)
        positions, flags = None, np.zeros(count, dtype=np.uint16)
        if table is not None:
            positions_choice = table.positions()
            if (
                self.origin is None
                and positions_choice.origin is None
                and not (positions_choice.sky or is_cube)
            ):
                positions_choice, remark = self._with_origin(table, positions_choice, layers)
                remarks += remark
            positions = self._positions(image, table, positions_choice, is_cube)
            identifiers, flags = table.identifiers(), table.flags(positions_choice)
            if positions is not None and not is_cube and self.detect is None:
                is_repeated = listed_again(positions)
                raise_flag(flags, StarFlag.BLENDED, is_repeated)
                remarks += _on_pairs(table, is_repeated)
        names = (self.flux_column, self.background_column, self.colour_column)
        of_list = (self._column(table, name, count) for name in names)
        columns = [identifiers, np.arange(count), *of_list, flags]
        if self.on_image and positions is not None and not is_cube:
            on_image = _inside(positions, shape)
            columns, positions = [column[on_image] for column in columns], positions[on_image]
        return Observation(
            self.path,
            len(columns[0]),
            stamp_px,
            margin=min(margin, (shape[-1] - stamp_px) // 2) if is_cube else margin,
            shape=None if is_cube else shape,
            camera=camera,
            positions=positions,
            header_cards=image.provenance(),
            catalogue=listed,
            found=table if self.detect is not None else None,
            colour_column=self.colour_column,
            remarks=tuple(remarks),
            _list=table if self.detect is None else None,
            _columns=columns,
            _layers=layers,
        )

    def _as_image(self, image: ImageFile, table: Catalogue | None) -> ImageFile:
        """The only plane of a cube with one, if it is no stamp of the only star of a list."""
        stars_wanted = self.detect is not None or (table is not None and len(table) != 1)
        if len(image.shape) != 3 or image.shape[0] != 1:
            return image
        large = max(image.shape) > LARGEST_STAMP_PX
        return image.one_plane() if stars_wanted or large else image

    def _with_origin(
        self, table: Catalogue, columns: Positions, layers: Layers
    ) -> tuple[Positions, list[str]]:
        """The columns of a list with the origin that the stars of the image say, in words, too.

        Unchanged if they do not say it clearly.
        """
        places = np.stack([table.pixels(columns.first), table.pixels(columns.second)], axis=1)
        try:
            data_origin = origin_of(layers.sky(), places)
        except ObservationError:  # no sky can be measured
            data_origin = None
        if data_origin is None:
            return columns, []
        origin, offset, count = data_origin
        words = (
            f"{table.path}: {columns.first},{columns.second} count from {origin}, as {count} stars "
            f"show (their centroids are off by x {offset[0]:+.2f}, y {offset[1]:+.2f} px); "
            "--origin states it"
        )
        return replace(columns, origin=origin), [words]

    def _check_numbers(self) -> None:
        """Refuse a camera value or a threshold that is no number above 0."""
        for name, value in (*self._given().items(), ("threshold", self.detect)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ObservationError(self.path, f"{name} {value!r}, expected a number above 0")

    def _is_cube(self, image: ImageFile, stamp_px: int) -> bool:
        shape = image.shape
        _refuse_colours(image)
        if len(shape) == 2 and (self.catalogue is not None or self.detect is not None):
            return False
        square = shape[-2] == shape[-1] >= stamp_px
        if square and (len(shape) == 3 or shape[-1] == stamp_px):
            return True
        size = f"{shape[-2]}×{shape[-1]}"
        if len(shape) == 2:
            raise ObservationError(
                image.path, f"an image of {size} pixels needs a star catalogue, or --detect"
            )
        raise ObservationError(
            image.path, f"stamps of {size} pixels, expected {stamp_px}×{stamp_px} pixels or larger"
        )

    def _positions(
        self, image: ImageFile, table: Catalogue, positions_choice: Positions, is_cube: bool
    ) -> np.ndarray | None:
        """Positions (n, 2) of the catalogue's stars; None for a cube if they are on the sky.

        NaN in rows without one.
        """
        if is_cube and len(table) != image.shape[0]:
            raise ObservationError(
                table.path, f"{len(table)} stars for the {image.shape[0]} stamps of {image.path}"
            )
        if positions_choice.sky and is_cube:
            return None
        if positions_choice.sky:
            ra, dec = table.sky(positions_choice)
            if image.wcs is None:
                raise ObservationError(
                    image.path,
                    f"no usable celestial WCS, which the sky coordinates {positions_choice.first},"
                    f"{positions_choice.second} of {table.path} need",
                )
            with reading(image.path):
                positions = np.stack(sky_to_pixel(image.wcs, ra, dec, image.shape), axis=1)
        else:
            origin = positions_choice.origin if self.origin is None else self.origin
            if origin is None:
                raise ObservationError(
                    table.path,
                    "the origin of columns "
                    f"{positions_choice.first},{positions_choice.second} must be stated: "
                    "is the centre of the first pixel 0 or 1? --origin says it",
                )
            columns = [
                table.pixels(name) for name in (positions_choice.first, positions_choice.second)
            ]
            positions = np.stack(columns, axis=1) - origin
        # What is beyond any image is no position: its squares would not even be numbers.
        positions = np.where(np.abs(positions) < FAR, positions, np.nan)
        if not is_cube:
            _check_overlap(image, table, positions_choice, positions)
        return positions

    def _given(self) -> dict[str, float | None]:
        return {
            "pixel scale": self.pixel_scale_arcsec,
            "gain": self.gain,
            "read noise": self.read_noise,
            "saturation": self.saturate,
        }

    def _camera(self, image: ImageFile) -> dict[str, Said]:
        """Return values that are stated, else those of WCS and headers, each with its source."""
        scale = image.scale()
        if image.wcs is not None:
            with reading(image.path):
                wcs_scale = pixel_scale(image.wcs)
            scale = (wcs_scale, "WCS") if math.isfinite(wcs_scale) and wcs_scale > 0 else scale
        saturation, noise = map(image.positive, (SATURATION_KEYS, READ_NOISE_KEYS))
        headers = dict(zip(self._given(), (scale, image.gain(), noise, saturation), strict=True))
        stated = {name: (v, "given") for name, v in self._given().items() if v is not None}
        return headers | stated

    def _layers(
        self, image: ImageFile, is_cube: bool, camera: dict[str, Said]
    ) -> tuple[Layers, list[str]]:
        """The image with its mask and map of noise, and what is said of those of its own file."""
        files = {} if is_cube else layers_beside(image)
        mask, bad_bits, remarks = self._mask_and_bits(image, files.get("mask"))
        notes = [f"{_label(mask)} as mask"] if mask is not None and self.mask is None else []
        gain, read_noise = (camera[name][0] for name in ("gain", "read noise"))
        layers = Layers(
            image,
            mask,
            bad_bits,
            least_noise=read_noise / gain if read_noise and gain else 0.0,
            saturate=camera["saturation"][0],
        )

        maps = {"weight": self.weight, "variance": self.variance, "error": self.error}
        stated = {k: v for k, v in maps.items() if v is not None and not _is_none(v)}
        if len(stated) > 1 or (stated and is_cube):
            raise ObservationError(
                self.path,
                "an image takes one map of weight, variance or error, a cube of stamps none",
            )
        for kind, place in stated.items():
            noise = _find_beside(image, place, NOISE_MAPS[kind])
            layers = _with_stated_noise(layers, noise, kind)
        if all(value is None for value in maps.values()):
            for kind in files.keys() & NOISE_MAPS.keys():
                layers, problem = _with_own_noise(layers, files[kind], kind)
                symbol = "σ" if kind == "error" else "σ²"
                notes = [problem or f"{_label(files[kind])} as {symbol}", *notes]
        if notes:
            # A bit may mark pixels that are fine; then good stars would be lost.
            line = f"{self.path}: uses {' and '.join(notes)}"
            share = layers.masked_part() if mask is not None and self.mask is None else 0.0
            if share > 0.2:
                line += (
                    f"; {100 * share:.0f} % of the pixels have a bit of {_label(files['mask'])}: "
                    "state --bad-bits, or --mask none"
                )
            remarks.insert(0, line)
        return layers, remarks

    def _mask_and_bits(
        self, image: ImageFile, layer_file: ImageFile | None
    ) -> tuple[ImageFile | None, int | None, list[str]]:
        """The mask that is stated, else that of the image's file; its bad bits, and who says so."""
        mask = layer_file
        if self.mask is not None:
            mask = None if _is_none(self.mask) else _find_beside(image, self.mask, "a mask")
        if self.bad_bits is not None and mask is None:
            raise ObservationError(self.path, "bits are given, but no mask that has them")
        by_header = None if mask is None else bits_of_bad_pixels(mask)
        if mask is None or self.bad_bits is not None or by_header is None:
            return mask, self.bad_bits, []
        bits, planes = by_header
        note = f"{self.path}: bad pixels by {_label(mask)}: {planes} (bits {bits})"
        return mask, bits, [note]

    def _detected(self, sky: Sky, threshold: float) -> Catalogue:
        """The stars of an image."""
        from astropy.table import Table

        with silent():
            table = Table(sky.stars(threshold))
        if len(table) == 0:
            raise ObservationError(self.path, f"no star {threshold:g} σ above the sky")
        return Catalogue(self.path, table)

    def _column(self, table: Catalogue | None, name: str | None, count: int) -> np.ndarray:
        """A numeric column of the catalogue, NaN where it has no value or is not asked for."""
        if name is None:
            return np.full(count, np.nan)
        if table is None:
            raise ObservationError(self.path, f"no catalogue is given to take {name!r} from")
        return table.numbers(name)


def other_instruments(
    training_instrument: Mapping[str, object], image_instrument: Mapping[str, str]
) -> list[tuple[str, str, str]]:
    """Keys of headers by which two images' telescope, camera or filter differ, and both values."""
    return [
        (key, str(value), image_instrument[key])
        for key, value in training_instrument.items()
        if key in image_instrument
        and image_instrument[key].strip().casefold() != str(value).strip().casefold()
    ]


def require_sky(stars: StarList, purpose: str) -> None:
    """Refuse a star list of several images that has no sky coordinates."""
    table = as_catalogue(stars)
    if not table.positions().sky:
        raise ObservationError(
            table.path,
            f"{purpose} takes a list with sky coordinates, or --detect: pixels do not say which "
            "image they are of",
        )


def _refuse_colours(image: ImageFile) -> None:
    """Refuse an image with a plane for each colour; a few large planes are no stamps of stars."""
    shape = image.shape
    if len(shape) != 3:
        return
    first, last = shape[0] in COLOURS, shape[-1] in COLOURS
    stamps = max(shape[-2:]) <= LARGEST_STAMP_PX
    if last or (first and not stamps):
        plane, size = ("[0]", shape[1:]) if first else ("[..., 0]", shape[:-1])
        raise ObservationError(
            image.path,
            f"{shape[0] if first else shape[-1]} planes of {size[0]}×{size[1]} pixels, as of a "
            "colour image; a PSF belongs to one colour: write one plane to a file of its own, "
            f"such as astropy.io.fits.getdata(…){plane}, or their sum",
        )


def _check_overlap(
    image: ImageFile, table: Catalogue, positions_of: Positions, positions: np.ndarray
) -> None:
    rows, columns = image.shape
    inside_count = np.count_nonzero(_inside(positions, image.shape))
    if inside_count > rows * columns:
        raise ObservationError(
            table.path,
            f"{inside_count} stars are on the image {image.path} of {columns} columns and {rows} "
            "rows, more than it has pixels",
        )
    if inside_count:
        return
    with np.errstate(all="ignore"):
        located = positions[np.isfinite(positions).all(axis=1)]
        ranges = "nowhere in its projection"
        if len(located):
            (x0, y0), (x1, y1) = located.min(axis=0), located.max(axis=0)
            ranges = f"at x {x0:.6g} … {x1:.6g}, y {y0:.6g} … {y1:.6g}"
    raise ObservationError(
        table.path,
        f"none of the {len(table)} stars is on the image {image.path} of {columns} columns "
        f"and {rows} rows; they are {ranges}"
        + (
            f" ({positions_of.first},{positions_of.second} without a unit are degrees)"
            if positions_of.sky
            else ""
        ),
    )


def list_offset(path: Path | None, off: np.ndarray, accept: bool) -> str | None:
    """Return a sentence on a list of which the stars are `off` (n, 2), x and y, its positions.

    Rows that are not known are left out; None if there are few, or no list. ObservationError says
    that they are farther off than `FARTHEST_OFF`, unless that is to be accepted.
    """
    offsets = off[~np.isnan(off).any(axis=1)]
    if path is None or len(offsets) < FEWEST_OFF:
        return None
    (x, y), distance = (
        np.median(offsets, axis=0),
        np.median(np.abs(offsets), axis=0),
    )
    sentence = (
        f"stars are off its positions by x {x:+.2f}, y {y:+.2f} px in the median, half of them "
        f"by more than {distance[0]:.2f}, {distance[1]:.2f} px either way ({len(offsets)} stars)"
    )
    # A list whose pixels count from the other origin is off by one pixel along both axes.
    x1, y1 = round(x), round(y)
    one_px = x1 == y1 and abs(x1) == 1 and max(abs(x - x1), abs(y - y1)) < TOLERANCE_PX
    if one_px and not accept:
        origin = int(x1 < 0)
        raise ObservationError(
            path,
            f"{sentence}: its positions count from {origin}? --origin {origin} says so "
            "(--accept-offset takes it as it is)",
        )
    if (distance > FARTHEST_OFF).any() and not accept:
        raise ObservationError(
            path,
            f"{sentence}: a list of another image or origin, or x and y exchanged? --accept-offset "
            "takes it as it is",
        )
    return f"{path}: {sentence}"


def _inside(positions: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return True for positions (n, 2), x and y, on an image (rows, columns)."""
    place = central_pixel(positions[:, ::-1])
    return np.asarray(((place >= 0) & (place < shape)).all(axis=1))


def _find_beside(image: ImageFile, place: Any, role: str) -> ImageFile:
    """An extension, or another file, with a pixel for every one of the image."""
    array = isinstance(place, np.ndarray)
    outside = isinstance(place, Path) or (isinstance(place, str) and Path(place).is_file())
    if image.values is not None and not (array or outside):
        raise ObservationError(image.path, f"{role} of an array is an array, too, or a file")
    if array:
        layer = array_image(np.asarray(place, dtype=np.float64), role)
    else:
        layer = find_image(Path(place)) if outside else find_image(image.file, place)
    expected_shape = image.shape
    if len(layer.shape) == 3 and layer.shape[0] == 1 and len(expected_shape) == 2:
        layer = layer.one_plane()
    if layer.shape != expected_shape and not (
        len(expected_shape) == 3 and layer.shape == expected_shape[1:]
    ):
        sizes = ["×".join(str(n) for n in shape) for shape in (layer.shape, expected_shape)]
        raise ObservationError(layer.path, f"{role} of {sizes[0]} pixels, expected {sizes[1]}")
    return layer


def _is_none(place: object) -> bool:
    """Return True for the word that takes no layer, not even that of the image's file."""
    return isinstance(place, str) and place.strip().lower() == NO_LAYER


def _label(layer: ImageFile) -> str:
    """Name of an extension, else of its file."""
    header = layer.headers[0] if layer.headers else {}
    return str(card_value(header, "EXTNAME") or layer.path)


def _with_stated_noise(layers: Layers, noise: ImageFile, kind: str) -> Layers:
    """Layers with a map of noise that is stated; one whose name says another kind is refused."""
    is_kind = map_kind(noise)
    if is_kind in NOISE_MAPS and is_kind != kind:
        raise ObservationError(
            noise.path,
            f"extension {_label(noise)} is {NOISE_MAPS[is_kind]}, not {NOISE_MAPS[kind]}: "
            f"--{is_kind} {_label(noise)}",
        )
    with open_pixels(noise, whole=True) as pixels:
        values = pixels[:]
    negative, zero = (int(np.count_nonzero(is_invalid)) for is_invalid in (values < 0, values == 0))
    may_be_0 = kind != "variance"
    if negative or (zero and not may_be_0):
        raise ObservationError(
            noise.path,
            f"{NOISE_MAPS[kind]} of which {negative + (not may_be_0) * zero} of {values.size} "
            f"pixels are not {'at least' if may_be_0 else 'above'} 0; NaN is for bad pixels, "
            "or a mask",
        )
    return replace(layers, noise=noise, kind=kind, empty=zero)


def _with_own_noise(layers: Layers, noise: ImageFile, kind: str) -> tuple[Layers, str]:
    """Layers with the map of noise of the image's own file, in which 0 is for bad pixels.

    Without it, and with the reason, if it has values for fewer than half of the pixels.
    """
    with open_pixels(noise, whole=True) as pixels:
        good = np.mean(np.nan_to_num(pixels[:], posinf=0.0) > 0)
    if good < 0.5:
        return layers, f"not {_label(noise)} ({100 * good:.0f} % of its pixels are above 0)"
    return replace(layers, noise=noise, kind=kind), ""


def _with_photons(
    layers: Layers, camera: dict[str, Said], sky: Sky
) -> tuple[Layers, dict[str, Said], list[str]]:
    """Layers that know how the map of noise grows with the light of stars, and the gain by that.

    Where photons make the noise, variance = variance of the sky + light/gain. A map of the sky
    alone does not grow, and nothing changes. A gain that is known otherwise stays.
    """
    with layers.open(is_whole=True) as (_, _, noise):
        assert noise is not None
        sigma = layers.sigma(noise[slice(None), slice(None)])
    good = ~sky.bad & np.isfinite(sigma)
    variance, snr = sigma**2, sky.flat / np.where(sky.noise > 0, sky.noise, np.inf)
    stars = good & (sky.flat > 0)
    # Pixels of stars in which photons of the star are a large part of the variance, if any are.
    stars &= snr >= np.quantile(snr[stars], 0.9) if stars.any() else False
    faint = good & (np.abs(snr) < 1.0)
    if np.count_nonzero(stars) < 50 or not faint.any():
        return layers, camera, []
    growth = (variance[stars] - np.median(variance[faint])) / sky.flat[stars]
    slope = float(np.median(growth))
    spread = 1.48 * float(np.median(np.abs(growth - slope)))
    if not (slope > 0 and spread < 0.3 * slope):
        return layers, camera, []
    # σ is scaled by the measured noise of the sky, and so is the slope of its square.
    layers = replace(layers, photons=slope / layers.noise_scale**2)
    if camera["gain"][0] is not None:
        return layers, camera, []
    assert layers.noise is not None
    name = _label(layers.noise)
    words = f"{layers.image.path}: {name} grows with the light of the stars: gain {1 / slope:.4g}"
    return layers, camera | {"gain": (1.0 / slope, name)}, [words]


def listed_again(positions: np.ndarray) -> np.ndarray:
    """Return which positions (n, 2) are nearer than `SAME_PX` to an earlier one, bool, (n,)."""
    from scipy.spatial import cKDTree

    located = np.flatnonzero(np.isfinite(positions).all(axis=1))
    is_repeated = np.zeros(len(positions), dtype=bool)
    pairs = cKDTree(positions[located]).query_pairs(SAME_PX, output_type="ndarray")
    is_repeated[located[pairs.max(axis=1)]] = True
    return is_repeated


def _on_pairs(table: Catalogue, is_repeated: np.ndarray) -> list[str]:
    """Return a sentence on rows of a list that are the same star as an earlier one."""
    rows = [str(row + 1) for row in np.flatnonzero(is_repeated)]
    if not rows:
        return []
    subject = "row is" if len(rows) == 1 else "rows are"
    return [
        f"{table.path}: {len(rows)} {subject} within {SAME_PX:g} px of an earlier one "
        f"({shorten(rows)}): flagged BLENDED, and not learnt from"
    ]


@dataclass(frozen=True, eq=False)
class Layers:
    """An image, what lies beside it, and how that is read."""

    image: ImageFile
    mask: ImageFile | None = None
    bad_bits: int | None = None
    noise: ImageFile | None = None
    kind: str = "variance"  # of the map of noise: "weight", "variance" or "error"
    empty: int = 0  # pixels of the weight 0, which are bad
    noise_scale: float = 1.0  # of σ by this map
    photons: float = 0.0  # variance by this map for a unit of light above the sky
    least_noise: float = 0.0  # counts; the read noise
    saturate: float | None = None  # counts
    _bad_pixels: list[BadPixels] = field(default_factory=list, repr=False)  # once they are found

    @contextmanager
    def open(self, is_whole: bool) -> Iterator[tuple[Pixels, Pixels | None, Pixels | None]]:
        """Pixels of the image, the mask and the map of noise, None for what there is not."""
        with ExitStack() as files:

            def opened(image: ImageFile, dtype: type[np.floating] = np.float32) -> Pixels:
                return files.enter_context(open_pixels(image, whole=is_whole, dtype=dtype))

            pixels = opened(self.image)
            # Bits of whole numbers do not fit into the mantissa of a float32.
            mask = None if self.mask is None else opened(self.mask, np.float64)
            noise = None if self.noise is None else opened(self.noise)
            yield pixels, mask, noise

    def bad(self, values: np.ndarray) -> np.ndarray:
        """Return the pixels that the mask calls bad; those without a value are."""
        if self.bad_bits is None:
            return np.asarray(values != 0)
        with np.errstate(invalid="ignore"):  # what is beyond any number has no bits
            return np.asarray((np.nan_to_num(values, nan=-1).astype(np.int64) & self.bad_bits) != 0)

    def sigma(self, values: np.ndarray, light: np.ndarray | float = 0.0) -> np.ndarray:
        """σ of the sky in pixels by the map, NaN where it has none.

        The photons of stars, `light` above the sky, are taken out of a map that has them.
        """
        with np.errstate(all="ignore"):
            if self.kind == "weight":
                variance = 1.0 / values
            else:
                variance = values**2 if self.kind == "error" else values
            is_known = np.isfinite(variance) & (variance > 0)
            # Light is noisy, too; at least a hundredth of the variance is of the sky.
            variance = np.clip(variance - self.photons * light, 0.01 * variance, 2.0 * variance)
        return self.noise_scale * np.sqrt(np.where(is_known, variance, np.nan))

    def masked_part(self) -> float:
        """Part of the pixels that the mask calls bad."""
        everything = (slice(None), slice(None))
        with self.open(is_whole=True) as (_, mask, _):
            return 0.0 if mask is None else float(np.mean(self.bad(mask[everything])))

    def sky(self) -> Sky:
        """The image as a whole with its sky."""
        return _sky(self)

    @property
    def bad_pixels(self) -> BadPixels:
        """Pixels of the image that are left out; ObservationError if its sky was clipped."""
        return self._bad_pixels[0] if self._bad_pixels else self._found(*self._whole()[:2])

    def _whole(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """The image (h, w), its masked pixels, and σ of all pixels if there is a map of it."""
        everything = (slice(None), slice(None))
        sigma = None
        with self.open(is_whole=True) as (pixels, mask, noise):
            image = pixels[everything]
            masked = ~np.isfinite(image)
            if mask is not None:
                masked |= self.bad(mask[everything])
            if noise is not None:
                sigma = replace(self, photons=0.0).sigma(noise[everything])
                masked |= np.isnan(sigma)
        return image, masked, sigma

    def _found(self, image: np.ndarray, masked: np.ndarray) -> BadPixels:
        """Bad pixels of the image, searched for once."""
        if not self._bad_pixels:
            with silent():
                try:
                    bad_pixels = find_bad_pixels(image, masked, self.image.headers, self.saturate)
                    bad_pixels = with_trails(image, bad_pixels)
                except ClippedSkyError as error:
                    raise ObservationError(self.image.path, str(error)) from None
            self._bad_pixels.append(bad_pixels)
        return self._bad_pixels[0]


@lru_cache(maxsize=1)
def _sky(layers: Layers) -> Sky:
    """The image of layers as a whole with its sky; that of the last ones is kept for more calls."""
    image, masked, sigma = layers._whole()
    bad_pixels = layers._found(image, masked)
    with silent():
        try:
            measured = bad_pixels.sky
            sky = sky_of(image, bad_pixels.mask, sigma, layers.least_noise, measured)
        except ValueError:  # nothing to measure the sky on
            problem = "too few pixels of the image have a value that is not masked"
            if layers.mask is not None and layers.bad_bits is None:
                problem += "; --bad-bits says which bits are bad, --mask none takes no mask"
            raise ObservationError(layers.image.path, problem) from None
    if sigma is None or not layers.photons:
        return sky
    with layers.open(is_whole=True) as (_, _, noise):
        assert noise is not None
        stated_sigma = layers.sigma(noise[:], sky.flat)
    return replace(sky, noise=(sky.noise_scale * stated_sigma).astype(np.float32))


@dataclass(frozen=True)
class Observation:
    """Stars of one FITS file. `Source.open` makes it."""

    path: Path
    count: int  # of stars, none is ever left out
    stamp_px: int
    margin: int  # pixels around each stamp
    shape: tuple[int, ...] | None  # (rows, columns) of the image, None for a cube
    camera: dict[str, Said]  # given, of the WCS, or of the header, in this order, and which
    positions: np.ndarray | None  # (n, 2), 0-based x, y; NaN where neither list nor WCS has one
    header_cards: list[Card]  # provenance to copy into what is made of the stars
    catalogue: Path | None  # the star list
    found: Catalogue | None  # that made in its place
    colour_column: str | None  # of the star list
    remarks: tuple[str, ...]  # sentences on what was found in the file or the list, and used or not
    _list: Catalogue | None = field(repr=False)  # all of it, also stars that are off the image
    # Identifiers, rows of the list, flux, sky, colour and flags.
    _columns: list[np.ndarray] = field(repr=False)
    _layers: Layers = field(repr=False)
    # Light of other stars in the stamps of a part of the list, of a side and with a margin in px.
    others: Callable[[slice, int, int], np.ndarray] | None = field(default=None, repr=False)

    @property
    def pixel_scale_arcsec(self) -> float | None:
        return self.camera["pixel scale"][0]

    @property
    def instrument(self) -> dict[str, str]:
        """Telescope, camera and filter, by the key of the header that names them."""
        return {key: str(value) for key, value, _ in self.header_cards if key in INSTRUMENT_KEYS}

    @property
    def gain(self) -> float | None:
        """Electrons per count."""
        return self.camera["gain"][0]

    @property
    def saturate(self) -> float | None:
        """Counts from which a pixel is saturated."""
        return self.camera["saturation"][0]

    @property
    def least_noise(self) -> float:
        """Read noise in counts; 0 where it or the gain is not known."""
        return self._layers.least_noise

    @property
    def scale_assumed(self) -> bool:
        return self.camera["pixel scale"][1] == "assumed"

    def assuming(self) -> Observation:
        """The same with `ASSUMED_SCALE` if nothing says the scale."""
        if self.pixel_scale_arcsec is not None:
            return self
        return replace(self, camera=self.camera | {"pixel scale": (ASSUMED_SCALE, "assumed")})

    def sky(self) -> Sky:
        """The whole image, and its sky; ObservationError if none can be measured."""
        return self._layers.sky()

    def on_sky(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """ICRS coordinates in degrees of 0-based pixels (n,).

        None without a celestial WCS, and of a cube of stamps.
        """
        from astropy.wcs.utils import pixel_to_skycoord

        if self.shape is None or (wcs := self._layers.image.wcs) is None:
            return None
        with reading(self.path):
            place = pixel_to_skycoord(x, y, wcs).icrs
        return place.ra.deg, place.dec.deg

    def said(self) -> str:
        """Return camera values and their sources in words."""
        units = ("arcsec", "electrons per count", "electrons", "counts")
        words = []
        for (name, (value, origin)), unit in zip(self.camera.items(), units, strict=True):
            words.append(f"{name} {origin if value is None else f'{value:.6g} {unit} ({origin})'}")
        text = "\n".join([f"{self.path}: {', '.join(words)}", *self.remarks])
        if (empty := self._layers.empty) and (noise := self._layers.noise) is not None:
            text += f"\n{noise.path}: {self._layers.kind} 0, bad pixels: {empty}"
        if self.shape is not None and (notes := self._layers.bad_pixels.notes):
            text += f"\n{self.path}: left out: {', '.join(notes)}"
        is_lost = self.without_position()
        if is_lost.any():
            rows = shorten([str(row + 1) for row in np.flatnonzero(is_lost)])
            text += f"\n{self.catalogue}: no position in row {rows}: flagged, and not learnt from"
        return text

    def without_position(self) -> np.ndarray:
        """Return True for stars without a position in a list that has others, shape (n,)."""
        if self.positions is None or self.found is not None:
            return np.zeros(self.count, dtype=bool)
        return np.asarray(~np.isfinite(self.positions).all(axis=1))

    def listed_again(self) -> np.ndarray:
        """Return True for stars of a list that are the same as an earlier one, shape (n,)."""
        if self.positions is None or self.found is not None or self.shape is None:
            return np.zeros(self.count, dtype=bool)
        return listed_again(self.positions)

    @property
    def identifiers(self) -> np.ndarray:
        """Names of the stars, by the list if it says any, shape (n,)."""
        return self._columns[0]

    @cached_property
    def list_columns(self) -> Table | None:
        """Further columns of the star list, with a row for each star; None without a list."""
        return None if self._list is None else self._list.columns(self._columns[1])

    @property
    def list_flags(self) -> np.ndarray:
        """`StarFlag`s of the stars by the list, shape (n,), uint16."""
        return self._columns[-1]

    @property
    def unit(self) -> str:
        """Unit of the image's pixels by its header; "" where that says none."""
        return self._layers.image.unit

    def of(self, selected: np.ndarray) -> Observation:
        """The same with some of the stars of the list, by a bool for each, shape (n,)."""
        assert self.positions is not None
        return replace(
            self,
            count=int(selected.sum()),
            positions=self.positions[selected],
            _columns=[column[selected] for column in self._columns],
        )

    def check_list(self) -> None:
        """Refuse a star list of another image.

        At least half of its positions must be on a source.
        """
        if self.shape is None or self.catalogue is None or self.positions is None:
            return
        located = np.flatnonzero(np.isfinite(self.positions).all(axis=1))
        sky = self._layers.sky()
        with silent():
            column, row = central_pixel(self.positions.T)
            hits = int(sky.covered(column, row, SEEN).sum())
        if hits < 0.5 * located.size:
            raise ObservationError(
                self.catalogue,
                f"{hits} of {located.size} positions are on a source of {self.path}, at least half "
                "are expected: a list of another image, or with stars too faint for this one?",
            )

    def sha256(self) -> str:
        """SHA-256 of all pixels of the image or cube, as float32."""
        digest = hashlib.sha256()
        with open_pixels(self._layers.image, whole=False) as pixels:
            for start in range(0, pixels.image.shape[0], HASHED_ROWS):
                values = pixels[slice(start, start + HASHED_ROWS)]
                digest.update(values.astype(np.float32, copy=False).tobytes())
        return digest.hexdigest()

    def with_margin(self, margin: int) -> Observation:
        """The same with stamps of so wide a margin, those of a cube as far as they have it."""
        return replace(self, margin=margin if self.shape else min(margin, self.margin))

    def chunks(self, rows: int) -> Iterator[Stamps]:
        """Stream the stars in their order, at most `rows` at a time.

        Only the pixels of a chunk are read. Tile-compressed cubes are decompressed
        chunk by chunk, tile-compressed images once per call, to a temporary file.
        """
        if rows < 1:
            raise ValueError(f"rows is {rows}, expected at least 1")
        stamps_of = self._of_cube if self.shape is None else self._of_image
        with self._layers.open(is_whole=self.shape is not None) as opened:
            for start in range(0, self.count, rows):
                part = slice(start, min(start + rows, self.count))
                yield self._stamps(part, *stamps_of(part, *opened))

    def _of_cube(
        self, part: slice, pixels: Pixels, mask: Pixels | None, _: Pixels | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Pixels, which of them are masked, which stars are truncated, and their noise."""
        side, count = self.stamp_px + 2 * self.margin, part.stop - part.start
        data = cut(_rows(pixels, part), side)
        masked = np.zeros(data.shape, dtype=bool)
        if mask is not None:
            mask_rows = part if len(mask.image.shape) == 3 else slice(0, 1)
            masked |= self._layers.bad(cut(_rows(mask, mask_rows), side))
        return data, masked, np.zeros(count, dtype=bool), np.full(count, np.nan)

    def _of_image(
        self, part: slice, pixels: Pixels, _mask: Pixels | None, noise: Pixels | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        assert self.shape is not None and self.positions is not None
        x, y = self.positions[part].T
        margin = max(self.margin, RING_PX)
        cut_of = (self.shape, x, y, self.stamp_px, margin)
        data, inside, truncated = cut_image(pixels, *cut_of)
        pixels_of_stars = data
        if self.others is not None:
            full = np.inf if self.saturate is None else self.saturate
            cleaned = data - self.others(part, self.stamp_px, margin)
            data = np.where(data >= full, data, cleaned)  # or saturated pixels would not be seen
        bad = self._layers.bad_pixels
        masked = ~inside | (cut_image(bad.mask, *cut_of)[0] != 0)
        stamp_part = slice(margin - self.margin, margin + self.stamp_px + self.margin)
        if noise is not None:
            light: np.ndarray | float = 0.0
            if self._layers.photons:
                level, _ = sky_around(pixels_of_stars, masked, self.stamp_px)
                light = pixels_of_stars - level[:, None, None]
            sigma = self._layers.sigma(cut_image(noise, *cut_of)[0], light)
            stamp_sigma = np.ma.array(sigma, mask=masked)[:, stamp_part, stamp_part]
            level = np.ma.median(stamp_sigma, axis=(1, 2)).filled(np.nan).astype(float)
        else:
            # In the stamp of a bright star, light that no PSF explains would pass for noise.
            _, level = sky_around(data, masked | ~np.isfinite(data), self.stamp_px)
            level = np.where(level > 0, np.maximum(level, self.least_noise), np.nan)
        return data[:, stamp_part, stamp_part], masked[:, stamp_part, stamp_part], truncated, level

    def _stamps(
        self,
        part: slice,
        data: np.ndarray,
        masked: np.ndarray,
        truncated: np.ndarray,
        noise: np.ndarray,
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
        listed = np.full((len(data), 2), np.nan)
        if self.shape is not None:
            listed = np.stack([y - central_pixel(y), x - central_pixel(x)], axis=1)
        ids, _, flux, background, colour, flags = (column[part].copy() for column in self._columns)
        raise_flag(flags, StarFlag.TRUNCATED, truncated)
        if self.shape is not None:
            # A cosmic ray within a pixel of the position: it may be no star.
            cosmic = cut_image(self._layers.bad_pixels.cosmic, self.shape, x, y, 3, 0)[0]
            raise_flag(flags, StarFlag.SHARP, cosmic.any(axis=(1, 2)))
        facts = (flux, background, noise, gain, unknown, colour, listed)
        return Stamps(data, masked, saturated, flags, ids, x, y, *facts)


def _rows(pixels: Pixels, part: slice) -> np.ndarray:
    """Stamps of a cube; a 2-d image counts as a cube of one."""
    return pixels[part] if len(pixels.image.shape) == 3 else pixels[slice(None)][None]


def central_pixel(position: np.ndarray) -> np.ndarray:
    """The pixel in which a 0-based position lies, int64; −`FAR` where it is NaN.

    Pixel k covers k − ½ ≤ position < k + ½.
    """
    rounded = np.floor(np.nan_to_num(position, nan=-FAR, posinf=FAR, neginf=-FAR) + 0.5)
    return np.asarray(np.clip(rounded, -FAR, FAR), np.int64)


def cut_image(
    pixels: Pixels | np.ndarray,
    shape: tuple[int, ...],
    x: np.ndarray,
    y: np.ndarray,
    stamp_px: int,
    margin: int,
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
    row_inside: np.ndarray = (rows >= 0) & (rows < shape[0])
    column_inside: np.ndarray = (columns >= 0) & (columns < shape[1])
    stamps: np.ndarray = pixels[
        np.clip(rows, 0, shape[0] - 1)[:, :, None], np.clip(columns, 0, shape[1] - 1)[:, None, :]
    ]
    inside = row_inside[:, :, None] & column_inside[:, None, :]
    stamp = slice(margin, margin + stamp_px)
    is_whole = row_inside[:, stamp].all(axis=1) & column_inside[:, stamp].all(axis=1)
    if not inside.all():
        stamps = np.where(inside, stamps, 0)
    return stamps, inside, np.asarray(~is_whole)


def pixel_scale(wcs: WCS) -> float:
    """Side in arcseconds of a square as large as a pixel at the reference point."""
    from astropy.wcs.utils import proj_plane_pixel_area

    return float(np.sqrt(proj_plane_pixel_area(wcs))) * 3600.0


def sky_to_pixel(
    wcs: WCS, ra: np.ndarray, dec: np.ndarray, shape: tuple[int, ...]
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
    is_near = (np.abs(x - columns / 2) < (0.5 + NEAR) * columns) & (
        np.abs(y - rows / 2) < (0.5 + NEAR) * rows
    )
    if wcs.has_distortion and is_near.any():
        try:
            x[is_near], y[is_near] = skycoord_to_pixel(stars[is_near], wcs, mode="all")
        except NoConvergence as error:
            solution = np.array(error.best_solution, dtype=np.float64)
            if error.divergent is not None:
                solution[error.divergent] = np.nan
            x[is_near], y[is_near] = solution.T
    return x, y
