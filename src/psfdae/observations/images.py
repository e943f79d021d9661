"""Images in FITS files: finding the right extension and reading its pixels piece by piece."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.observations.errors import ObservationError, reading, shorten
from psfdae.observations.headers import card_value
from psfdae.observations.tiles import check_tiles, decompress
from psfdae.observations.unpacking import PlainFile, open_hdus, plain_file

MASKS = frozenset({"DQ", "MASK", "BPM", "FLAG", "FLAGS"})
ERRORS = frozenset({"ERR", "ERROR", "SIGMA", "STDDEV", "RMS", "VAR", "VARIANCE", "IVAR", "UNCERT"})
EXTRAS = frozenset({"WEIGHT", "WHT", "WGT", "BKG", "BACKGROUND", "SKY", "CTX", "SAMP", "TIME"})
NOT_SCIENCE = MASKS | ERRORS | EXTRAS
"""Names of extensions that go with an image; they are read on demand only."""

MOST_COMPRESSED = 2000
"""Pixels per byte of file that no compression reaches; a header that claims more is damaged."""

LARGEST_ORDER = 9
"""Of the distortion polynomials (SIP); astropy would take any number and be busy for ever."""


@dataclass(frozen=True)
class Scaling:
    """From stored to physical values: value = bscale·stored + bzero, NaN where blank."""

    bscale: float
    bzero: float
    blank: int | None

    def apply(self, stored: np.ndarray) -> np.ndarray:
        """Physical values of stored ones, float32 in native byte order, same shape."""
        if self.bscale == 1.0 and self.bzero == 0.0:
            values = stored.astype(np.float32)
        else:
            values = (stored.astype(np.float64) * self.bscale + self.bzero).astype(np.float32)
        if self.blank is not None and stored.dtype.kind in "iu":
            values[stored == self.blank] = np.nan
        return values


@dataclass(frozen=True)
class ImageFile:
    """One image of a FITS file, described but not read.

    `shape` is that of the image or cube without leading axes of length 1, of which
    `leading` were removed; `headers` are its own and the primary one; `wcs` is the
    celestial WCS or None.
    """

    file: PlainFile
    index: int
    shape: tuple[int, ...]
    leading: int
    scaling: Scaling
    headers: tuple[Any, ...]
    wcs: Any

    @property
    def path(self) -> Path:
        """The file's own name, for messages."""
        return self.file.name


def find_image(path: str | Path | PlainFile, extension: str | int | None = None) -> ImageFile:
    """Find an image in a FITS file and check that its data are all there.

    Parameters
    ----------
    path : path-like or PlainFile
        FITS file, also tile-compressed (.fz) or compressed as a whole (.gz, .bz2, .xz,
        .zip with one file).
    extension : str or int, optional
        Name (case does not matter), "NAME,version" or number (0 is the primary
        one) of the extension. Without it the only image that is not a mask, an
        error or the like (`NOT_SCIENCE`) is taken.

    Raises
    ------
    ObservationError
        If the file is no FITS file, damaged or truncated, has no such image or
        several, or the image is neither 2- nor 3-dimensional or without pixels.
    """
    file = path if isinstance(path, PlainFile) else plain_file(Path(path))
    path = file.name
    with reading(path), open_hdus(file, memmap=True, **_AS_STORED) as hdus:
        hdu = _choose(path, hdus, extension)
        index = hdus.index(hdu)
        shape = tuple(int(n) for n in hdu.shape)
        header = hdu.header.copy()
        headers = (header,) if index == 0 else (header, hdus[0].header.copy())
        _check_complete(file, hdu)
        wcs = _celestial(header, hdus)
    leading = 0
    while len(shape) > 3 and shape[0] == 1:
        shape, leading = shape[1:], leading + 1
    if len(shape) not in (2, 3):
        raise ObservationError(path, f"an image of {len(shape)} dimensions, expected 2 or 3")
    return ImageFile(file, index, shape, leading, _scaling(path, header), headers, wcs)


_AS_STORED = {"do_not_scale_image_data": True, "uint": False, "ignore_blank": True}


def _choose(path: Path, hdus: Any, extension: str | int | None) -> Any:
    listed = shorten([_label(k, hdu) for k, hdu in enumerate(hdus)])
    if extension is not None:
        hdu = _named(hdus, extension)
        if hdu is None:
            raise ObservationError(path, f"no extension {extension!r}; the file has {listed}")
        if not _has_pixels(hdu):
            raise ObservationError(
                path, f"extension {extension!r} holds no image; the file has {listed}"
            )
        return hdu
    images = [hdu for hdu in hdus if _has_pixels(hdu)]
    science = [hdu for hdu in images if hdu.name.upper() not in NOT_SCIENCE] or images
    if not science:
        raise ObservationError(path, f"no image; the file has {listed}")
    if len(science) > 1:
        raise ObservationError(path, f"several images, choose an extension of {listed}")
    return science[0]


def _named(hdus: Any, extension: str | int) -> Any:
    """The extension, or None."""
    text = str(extension).strip()
    if re.fullmatch("[0-9]{1,6}", text):
        return hdus[int(text)] if int(text) < len(hdus) else None
    name, _, version = text.rpartition(",") if "," in text else (text, "", "")
    for hdu in hdus:
        if hdu.name.upper() == name.strip().upper() and version.strip() in ("", str(hdu.ver)):
            return hdu
    return None


def _has_pixels(hdu: Any) -> bool:
    from astropy.io import fits

    if not isinstance(hdu, fits.PrimaryHDU | fits.ImageHDU | fits.CompImageHDU):
        return False
    if isinstance(hdu, fits.GroupsHDU):
        return False
    # A damaged header may hold texts there; their product would be one as long.
    sizes = all(isinstance(size, int) for size in hdu.shape)
    return sizes and len(hdu.shape) > 0 and math.prod(hdu.shape) > 0


def _label(index: int, hdu: Any) -> str:
    shape = getattr(hdu, "shape", None) or ()
    size = "×".join(str(n) for n in shape) if _has_pixels(hdu) else "no image"
    return f"{index} {hdu.name or '(no name)'} ({size})"


def _check_complete(file: PlainFile, hdu: Any) -> None:
    """Refuse data that end before the header says, or that cannot be as large as it says."""
    from astropy.io import fits

    path, on_disk = file.name, file.path.stat().st_size
    if math.prod(hdu.shape) > MOST_COMPRESSED * on_disk:
        raise ObservationError(path, f"damaged: {on_disk} bytes cannot hold {hdu.shape} pixels")
    if isinstance(hdu, fits.CompImageHDU):
        check_tiles(path, hdu)
        return
    missing = hdu.fileinfo()["datLoc"] + hdu.size - on_disk
    if missing > 0:
        raise ObservationError(path, f"truncated: the last {missing} bytes are missing")


def _scaling(path: Path, header: Any) -> Scaling:
    factors = {}
    for key, default in (("BSCALE", 1.0), ("BZERO", 0.0)):
        value = card_value(header, key)
        factors[key] = default if value is None else value
    if not all(isinstance(f, int | float) and math.isfinite(f) for f in factors.values()):
        raise ObservationError(path, "BSCALE or BZERO is not a number")
    blank = card_value(header, "BLANK")
    return Scaling(
        float(factors["BSCALE"]),
        float(factors["BZERO"]),
        blank if isinstance(blank, int) else None,
    )


def _celestial(header: Any, hdus: Any) -> Any:
    """Celestial WCS with a stated scale, or None; a WCS that is damaged counts as missing."""
    from astropy.wcs import WCS

    if not any(card_value(header, key) is not None for key in ("CD1_1", "CD1_2", "CDELT1")):
        return None
    orders = [card_value(header, f"{name}_ORDER") or 0 for name in ("A", "B", "AP", "BP")]
    if not all(isinstance(order, int) and order <= LARGEST_ORDER for order in orders):
        return None
    try:
        wcs = WCS(header, fobj=hdus)
        return wcs.celestial if wcs.has_celestial else None
    except Exception:  # wcslib and astropy raise many kinds, all of which mean the same here
        return None


@contextmanager
def open_pixels(image: ImageFile, *, whole: bool) -> Iterator[Any]:
    """The stored values of an image as something to index, without the leading axes.

    Parameters
    ----------
    image : ImageFile
    whole : bool
        True: an array, mapped into memory where the file allows, for access at
        random; False: for slices `[start:stop]` along the first axis, of which
        only what is asked for is read.

    Raises
    ------
    ObservationError
        If the file has become unreadable; also when indexing, inside `reading`.
    """
    from astropy.io import fits

    with ExitStack() as files:
        with reading(image.path):
            hdus = files.enter_context(open_hdus(image.file, memmap=whole, **_AS_STORED))
            hdu = hdus[image.index]
            if tuple(hdu.shape)[image.leading :] != image.shape:
                raise ObservationError(image.path, "has changed since it was opened")
            if not whole:
                stored = hdu.section
            elif isinstance(hdu, fits.CompImageHDU):
                copy = files.enter_context(tempfile.TemporaryFile(prefix="psfdae-"))
                stored = decompress(image.path, hdu, copy)
            else:
                stored = hdu.data
        yield _Array(stored, image)


@dataclass(frozen=True)
class _Array:
    """Physical values of an array or section of stored ones."""

    stored: Any
    image: ImageFile

    def __getitem__(self, key: Any) -> np.ndarray:
        key = key if isinstance(key, tuple) else (key,)
        with reading(self.image.path):
            stored = np.asarray(self.stored[(0,) * self.image.leading + key])
            return self.image.scaling.apply(stored)
