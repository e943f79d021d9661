"""An observation: the stars of one FITS file, described and ready to be streamed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from psfdae.observations.catalogue import Catalogue
from psfdae.observations.cutting import cut_stamps
from psfdae.observations.errors import ObservationError
from psfdae.observations.headers import Card
from psfdae.observations.images import ImageFile, open_pixels


@dataclass(frozen=True)
class Stamps:
    """One chunk of n stamps, s = stamp_px + 2·margin pixels wide.

    `data` float32 (n, s, s): counts as in the image, sky included; 0 where a pixel
    is not finite or off the image. `bad` (n, s, s): such pixels and masked ones.
    `saturated` (n, s, s). `id` (n,): int64 or str. `x`, `y` (n,): position of the
    star in the image, 0-based pixel centres, NaN where unknown. `truncated` (n,):
    part of the stamp, margin aside, is off the image.
    """

    data: np.ndarray
    bad: np.ndarray
    saturated: np.ndarray
    id: np.ndarray
    x: np.ndarray
    y: np.ndarray
    truncated: np.ndarray

    def __len__(self) -> int:
        return len(self.data)


@dataclass(frozen=True)
class Observation:
    """Stars of one FITS file. `open_observation` makes it.

    Attributes
    ----------
    path : Path
    count : int
        Number of stars, none is ever left out.
    stamp_px : int
    pixel_scale_arcsec : float or None
        Given, of the WCS, or of the header, in this order.
    gain : float or None
        Electrons per count.
    saturate : float or None
        Counts from which a pixel is saturated.
    shape : (rows, columns) of the image, None for a cube
    positions : ndarray, shape (n, 2), or None
        (x, y), 0-based pixel centres; NaN for stars that the WCS cannot place.
    header_cards : list of (key, value, comment)
        Provenance to copy into what is made of the stars.
    margin : int
        Pixels around each stamp in a chunk, 0 for cubes.
    """

    path: Path
    count: int
    stamp_px: int
    pixel_scale_arcsec: float | None
    gain: float | None
    saturate: float | None
    shape: tuple[int, int] | None
    positions: np.ndarray | None
    header_cards: list[Card]
    margin: int
    _id: np.ndarray = field(repr=False)
    _image: ImageFile = field(repr=False)
    _mask: ImageFile | None = field(repr=False)
    _catalogue: Catalogue | None = field(repr=False)

    def column(self, name: str) -> np.ndarray:
        """A numeric column of the catalogue, float64 (n,), NaN where it has no value.

        Raises
        ------
        ObservationError
            If there is no catalogue or no such column, or it is not numeric.
        """
        if self._catalogue is None:
            raise ObservationError(self.path, f"no catalogue is given to take {name!r} from")
        return self._catalogue.numbers(name)

    def chunks(self, rows: int) -> Iterator[Stamps]:
        """Stream the stars in their order, at most `rows` at a time.

        Only the pixels of a chunk are read. Tile-compressed cubes are decompressed
        chunk by chunk, tile-compressed images once per call, to a temporary file.

        Raises
        ------
        ObservationError
            If the pixels cannot be read.
        """
        if rows < 1:
            raise ValueError(f"rows is {rows}, expected at least 1")
        cube = self.shape is None
        with ExitStack() as files:
            pixels = files.enter_context(open_pixels(self._image, whole=not cube))
            mask = None
            if self._mask is not None:
                mask = files.enter_context(open_pixels(self._mask, whole=not cube))
            for start in range(0, self.count, rows):
                part = slice(start, min(start + rows, self.count))
                yield (self._rows if cube else self._cut)(part, pixels, mask)

    def _rows(self, part: slice, pixels: object, mask: object) -> Stamps:
        size = (part.stop - part.start, self.stamp_px, self.stamp_px)
        data = _slice(pixels, self._image, part).reshape(size)
        masked = np.zeros(size, dtype=bool)
        if mask is not None:
            per_stamp = len(self._mask.shape) == 3
            masked |= _slice(mask, self._mask, part if per_stamp else slice(0, 1)) != 0
        return self._stamps(part, data, masked, np.zeros(size[0], dtype=bool))

    def _cut(self, part: slice, pixels: object, mask: object) -> Stamps:
        x, y = self.positions[part].T
        where = (self.shape, x, y, self.stamp_px, self.margin)
        data, inside, truncated = cut_stamps(pixels, *where)
        masked = ~inside
        if mask is not None:
            masked |= cut_stamps(mask, *where)[0] != 0
        return self._stamps(part, data, masked, truncated)

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
        if self.positions is None:
            x = y = np.full(len(data), np.nan)
        else:
            x, y = self.positions[part].T
        return Stamps(data, masked, saturated, self._id[part], x, y, truncated)


def _slice(pixels: object, image: ImageFile, part: slice) -> np.ndarray:
    """Stamps of a cube; a 2-d image counts as a cube of one."""
    if len(image.shape) == 3:
        return pixels[part]
    return pixels[slice(None)][None]
