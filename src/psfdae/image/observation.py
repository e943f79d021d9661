"""An observation: the stars of one FITS file, described and ready to be streamed as stamps.

| input | class | stamps | positions |
|---|---|---|---|
| cube (n, s, s), or one stamp (s, s) | `StampCube` | their middle | of the catalogue, or NaN |
| image (h, w) and a catalogue | `Image` | cut at the rounded position | of the catalogue |
| image (h, w) to be searched | `Image` | the same | of the stars found (`detection`) |

`psfdae.image.opening.open_observation` opens both. Faults of a file raise `ObservationError`, with
one line that names the file.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import numpy as np

from psfdae.base.errors import keyword
from psfdae.base.types import WCS, Table
from psfdae.image.camera import CameraValue
from psfdae.image.catalogue import Catalogue
from psfdae.image.detector_frame import detector_frames
from psfdae.image.errors import reading, shorten
from psfdae.image.fits_file import Card, ImageFile, open_pixels, pixel_to_sky
from psfdae.image.layers import Mask
from psfdae.image.stamps import Stamps


class ListedStars(NamedTuple):
    """Columns of n stars; NaN where the list gives no number.

    Attributes
    ----------
    id : ndarray, shape (n,), int64 or str
        Identifiers from the list, or numbers of its rows from 0.
    row : ndarray of int, shape (n,)
        Row of the list, from 0.
    flux, background, colour : ndarray, shape (n,)
        Flux inside the stamp, sky per pixel, and colour, from the columns that the user names.
    flags : ndarray, shape (n,), uint16
        `StarFlag`s from the list.
    """

    id: np.ndarray
    row: np.ndarray
    flux: np.ndarray
    background: np.ndarray
    colour: np.ndarray
    flags: np.ndarray

    def select(self, stars: np.ndarray | slice) -> ListedStars:
        """Return copies of the columns for some of the stars."""
        return ListedStars(*(np.array(column[stars]) for column in self))


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation(ABC):
    """Stars of one FITS file or array: of an image, or of a cube with a stamp of each.

    Attributes
    ----------
    path : Path
        The file, for messages.
    data : ImageFile
        Pixels, which are read where they are needed.
    mask : Mask or None
        Their mask.
    shape : tuple of int
        Rows and columns of an image; shape of a cube, or of one stamp.
    stamp_px, margin : int
        Side of the stamps, and pixels around each.
    camera : dict of str to CameraValue
        Pixel scale, gain, read noise and saturation, in this order.
    least_noise : float
        Read noise in counts, below which no measured noise counts; 0 where it or the gain of the
        header is not known.
    noise_correlation : float
        Ratio of the noise of sums of pixels to the noise of sums of independent ones, at least 1.
    stars : ListedStars
        Columns of the stars, one value for each.
    positions : ndarray or None, shape (n, 2)
        0-based x and y; NaN where neither list nor WCS has one. None for a cube without positions.
    star_list : Catalogue or None
        The star list, with all of its rows.
    detections : Catalogue or None
        The list of detected stars, used in place of a star list.
    colour_column : str or None
        Column of the star list with colours.
    header_cards : list of Card
        Provenance, copied into the products.
    remarks : tuple of str
        Warnings about the file and the list: values that are used or ignored.
    """

    path: Path
    data: ImageFile
    mask: Mask | None
    shape: tuple[int, ...]
    stamp_px: int
    margin: int
    camera: dict[str, CameraValue]
    least_noise: float
    noise_correlation: float = 1.0
    stars: ListedStars = field(default_factory=lambda: ListedStars(*np.empty((6, 0))))
    positions: np.ndarray | None = None
    star_list: Catalogue | None
    detections: Catalogue | None = None
    colour_column: str | None
    header_cards: list[Card]
    remarks: tuple[str, ...]
    assumed_scale_arcsec: ClassVar[float] = 1.0
    """Pixel scale that is assumed if neither header nor user gives one."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r}, {self.count} stars)"

    @property
    def count(self) -> int:
        """Number of stars, flagged ones included."""
        return len(self.stars.id)

    @property
    def catalogue(self) -> Path | None:
        """File of the star list."""
        return None if self.star_list is None else self.star_list.path

    @property
    def pixel_scale_arcsec(self) -> float | None:
        """Arcseconds per pixel."""
        return self.camera["pixel scale"].value

    @property
    def gain(self) -> float | None:
        """Electrons per count."""
        return self.camera["gain"].value

    @property
    def saturate(self) -> float | None:
        """Counts from which a pixel is saturated."""
        return self.camera["saturation"].value

    @property
    def instrument(self) -> dict[str, str]:
        """Telescope, camera and filter, by the key of the header that names them."""
        # PSFs change with each of the three.
        keys = ("TELESCOP", "INSTRUME", "FILTER")
        return {key: str(value) for key, value, _ in self.header_cards if key in keys}

    @property
    def unit(self) -> str:
        """Unit of the image's pixels from its header; "" if the header gives none."""
        return self.data.unit

    @property
    def name_with_scale(self) -> str:
        """Name of the file for messages on its pixel scale, with a note if that is assumed."""
        advice = f" (scale assumed, {keyword('pixel_scale_arcsec')} sets it)"
        return f"{self.path}{advice * self.scale_assumed}"

    @property
    def scale_assumed(self) -> bool:
        """True if neither header nor user gives the pixel scale."""
        return self.camera["pixel scale"].provenance == "assumed"

    def assume_scale(self) -> Self:
        """Return the observation with `assumed_scale_arcsec` if the scale is unknown."""
        if self.pixel_scale_arcsec is not None:
            return self
        # The provenance shows that the scale is an assumption.
        scale = CameraValue(self.assumed_scale_arcsec, "assumed")
        return replace(self, camera=self.camera | {"pixel scale": scale})

    @property
    def detector_frames(self) -> dict[str, list[float]]:
        """Positions of the image's pixels on the detector, if the header gives them."""
        return detector_frames(self.data)

    @property
    def unit_factor(self) -> float:
        """Factor from the unit of the image, which stamps have, to the unit of `Image.sky`."""
        return self.data.unit_factor

    def to_image_unit(self, values: np.ndarray) -> np.ndarray:
        """Return pixels that are in the unit of the sky, and without `base_level`, as in the image.

        They become double precision unless both are the same.
        """
        if (self.unit_factor, self.data.base_level) == (1.0, 0.0):
            return values
        return values / np.float64(self.unit_factor) + self.data.base_level

    @property
    def wcs(self) -> WCS | None:
        """Celestial WCS of the image; None without one, and of a cube of stamps."""
        return self.data.wcs

    def sky_columns(self, x: np.ndarray, y: np.ndarray) -> dict[str, np.ndarray]:
        """Return ICRS coordinates in degrees of 0-based pixels (n,).

        Empty without a celestial WCS, and for a cube of stamps.

        Parameters
        ----------
        x, y : ndarray, shape (n,)
            Positions in the image, 0-based.

        Returns
        -------
        dict of str to ndarray
            Right ascension `ra` and declination `dec`, shape (n,) each.
        """
        if (wcs := self.wcs) is None:
            return {}
        with reading(self.path):
            coordinates = pixel_to_sky(wcs, x, y)
        return {"ra": coordinates.ra.deg, "dec": coordinates.dec.deg}

    def summary(self) -> str:
        """Return lines: camera values with their provenance, remarks, pixels and rows left out."""
        # The camera: number and unit with their provenance, or why the number is not known.
        units = ("arcsec", "electrons per count", "electrons", "counts")
        words = [
            f"{name} {source if value is None else f'{value:.6g} {unit} ({source})'}"
            for (name, (value, source)), unit in zip(self.camera.items(), units, strict=True)
        ]
        lines = [f"{self.path}: {', '.join(words)}", *self.remarks]
        # Pixels of the image that are bad, and rows of the list without a position.
        if notes := self.describe_bad_pixels():
            lines.append(f"{self.path}: left out: {', '.join(notes)}")
        if (no_position := self.lacks_position()).any():
            rows = shorten([str(row + 1) for row in np.flatnonzero(no_position)])
            lines.append(
                f"{self.catalogue}: no position in row {rows}: flagged, and not trained on"
            )
        return "\n".join(lines)

    def describe_bad_pixels(self) -> tuple[str, ...]:
        """Return each kind of bad pixels that were searched, with the number of pixels."""
        return ()

    def lacks_position(self) -> np.ndarray:
        """Return True for stars of a list with positions that have none themselves, shape (n,).

        Detected stars all have one, and a cube need not have any.
        """
        if self.positions is None or self.detections is not None:
            return np.zeros(self.count, dtype=bool)
        return np.asarray(~np.isfinite(self.positions).all(axis=1))

    def find_repeated_stars(self) -> np.ndarray:
        """Return True for stars of an image's list that are the same as an earlier one, (n,)."""
        return np.zeros(self.count, dtype=bool)

    @cached_property
    def list_columns(self) -> Table | None:
        """Further columns of the star list, with a row for each star; None without a list."""
        return None if self.star_list is None else self.star_list.columns(self.stars.row)

    def select(self, stars: np.ndarray) -> Self:
        """Return the observation with the stars for which a mask of shape (n,) is True."""
        assert self.positions is not None
        return replace(self, positions=self.positions[stars], stars=self.stars.select(stars))

    def sha256(self) -> str:
        """Return SHA-256 of all pixels of the image or cube, as float32.

        It does not depend on how the file is compressed or scaled, nor on its header.
        """
        # 256 rows of an image, or stamps of a cube, are in memory at a time.
        digest, rows = hashlib.sha256(), 256
        with open_pixels(self.data, in_pieces=True) as pixels:
            for start in range(0, self.data.shape[0], rows):
                values = self.to_image_unit(pixels[start : start + rows])
                digest.update(values.astype(np.float32, copy=False).tobytes())
        return digest.hexdigest()

    def replace_margin(self, margin: int) -> Self:
        """Return the observation with stamps of another margin in px; a cube limits it."""
        return replace(self, margin=margin)

    @abstractmethod
    def chunks(self, rows: int) -> Iterator[Stamps]:
        """Yield the stars in their order, at most `rows` at a time."""

    def _split(self, rows: int) -> Iterator[slice]:
        """Yield slices of at most `rows` stars, in their order."""
        if rows < 1:
            raise ValueError(f"rows is {rows}, expected at least 1")
        for start in range(0, self.count, rows):
            yield slice(start, min(start + rows, self.count))

    def _build_stamps(
        self,
        part: slice,
        data: np.ndarray,
        is_masked: np.ndarray,
        noise: np.ndarray,
        sky_level: np.ndarray,
        centre: np.ndarray,
    ) -> Stamps:
        """Return stamps (n, s, s) of some of the stars, with flags, positions and columns.

        Parameters
        ----------
        part : slice
            Stars of the stamps.
        data : ndarray, shape (n, s, s)
            Counts, changed here: pixels without a number become 0.
        is_masked : ndarray of bool, shape (n, s, s)
            Pixels that are ignored; pixels without a number are added here.
        noise : ndarray, shape (n,)
            σ of the sky, NaN where it is to be estimated.
        sky_level : ndarray, shape (n,)
            Median of the pixels around the stamp; NaN where it was not measured.
        centre : ndarray, shape (n, 2)
            Centres from the list, row and column from the middle of the central pixel.
        """
        # Before infinite pixels become 0: where a saturation is known, +inf is above it, and NaN is
        # not.
        saturate = self.saturate
        is_saturated = np.zeros(data.shape, dtype=bool) if saturate is None else data >= saturate
        # Pixels without a number are masked, and 0.
        finite = np.isfinite(data)
        if not finite.all():
            data[~finite] = 0.0
            is_masked |= ~finite
        unknown, stars = np.full(len(data), np.nan), self.stars.select(part)
        x, y = (unknown, unknown) if self.positions is None else self.positions[part].T
        columns = stars._asdict()
        del columns["row"]
        return Stamps(
            data,
            bad=is_masked,
            saturated=is_saturated,
            x=x,
            y=y,
            noise=noise,
            sky_level=sky_level,
            noise_correlation=np.full(len(data), self.noise_correlation),
            gain=unknown if self.gain is None else np.full(len(data), self.gain),
            magnitude=unknown,
            listed=centre,
            **columns,
        )
