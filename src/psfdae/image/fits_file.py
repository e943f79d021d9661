"""Images in FITS files of any origin, found and read piece by piece.

Inputs: a path and perhaps an extension. `find_image` returns an `ImageFile`, which describes one
image without its pixels; `open_pixels` reads the pixels. Files that are compressed as a whole (.gz,
.bz2, .xz, .zip) are unpacked to a temporary file first; astropy reads tile-compressed images (.fz).
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import math
import os
import re
import tempfile
import weakref
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from psfdae.base.errors import require_file
from psfdae.base.files import find_left_over, temporary_name
from psfdae.base.types import WCS, BaseCoordinateFrame, HDUList, Header, SkyCoord
from psfdae.image.errors import ObservationError, reading, shorten

BLOCK_BYTES = 2880
"""Bytes of a block, of which FITS files consist."""

SCIENCE = ("SCI", "IMAGE")
"""Usual names of the science image; if exactly one image has such a name, it is taken."""

Card = tuple[str, str | float | None, str]
"""Key, value and comment of a header card."""


# Files.


def open_member(file: IO[bytes]) -> IO[bytes]:
    """Open the only file in a zip file.

    Raises
    ------
    BadZipFile
        If the zip file holds another number of files.
    """
    archive = zipfile.ZipFile(file)
    names = archive.namelist()
    if len(names) != 1:
        raise zipfile.BadZipFile(f"{len(names)} files in a zip file, expected one")
    return archive.open(names[0])


UNPACK: dict[bytes, Callable[[IO[bytes]], Any]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ\x00": lzma.LZMAFile,
    b"PK\x03\x04": open_member,
}
"""How files that are compressed as a whole are read, by their first bytes."""

OTHER_FORMATS = {
    **{b"\x89HDF": "HDF5", b"#ASDF": "ASDF", b"PAR1\x15": "Parquet", b"ARROW1": "Feather"},
    **{b"\x93NUMPY": ".npy", b"\x80": "pickle", b"{": "JSON", b"[{": "JSON", b"[[": "JSON"},
    **{b"XISF": "XISF", b"II*": "TIFF", b"MM\0*": "TIFF", b"\x89PNG": "PNG", b"\xff\xd8": "JPEG"},
}
"""Names of formats that are not read here, for messages, by their first bytes."""


def name_other_format(start: bytes) -> str:
    """Return ", but " and the name of a format by the first bytes of its files, or ""."""
    # The first number of a safetensors file, the length of its header, may be any byte.
    if start[8:9] == b"{":
        return ""
    start = b"".join(start.split())
    names = (name for magic, name in OTHER_FORMATS.items() if start.startswith(magic))
    return next((f", but {name}" for name in names), "")


@dataclass(frozen=True)
class PlainFile:
    """FITS file that is not compressed as a whole: the file itself, or a copy of it.

    Attributes
    ----------
    name : Path
        Name of the file in messages.
    path : Path
        File to open. A temporary copy exists as long as this object.
    is_copy : bool
        True for a temporary copy.
    """

    name: Path
    path: Path
    is_copy: bool = False

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a temporary copy by its content."""
        if not self.is_copy:
            return type(self), (self.name, self.path)
        return write_temporary, (self.name, io.BytesIO(self.path.read_bytes()))


def plain_file(path: Path) -> PlainFile:
    """Return a FITS file that allows random access, unpacked if need be.

    Returns
    -------
    PlainFile
        The file itself, or a temporary copy of its unpacked content.

    Raises
    ------
    ObservationError
        If the file does not exist, or is not a FITS file.
    """
    file, start = unpack_file(path)
    if not start.startswith(b"SIMPLE  ="):
        raise ObservationError(path, f"not a FITS file{name_other_format(start)}")
    return file


def unpack_file(path: Path) -> tuple[PlainFile, bytes]:
    """Return a file of any format, unpacked if need be, and its first 80 bytes."""
    require_file(path)
    with reading(path), path.open("rb") as file:
        # The first bytes show how the file is compressed, if it is. A model of psfdae begins with
        # eight bytes of any value, and a brace.
        start = file.read(80)
        file.seek(0)
        for magic, unpack in UNPACK.items():
            if start.startswith(magic) and start[8:9] != b"{":
                with unpack(file) as content:
                    copy = write_temporary(path, content, compute_unpacked_max(path.stat().st_size))
                with copy.path.open("rb") as plain:
                    return copy, plain.read(80)
    return PlainFile(path, path), start


def compute_unpacked_max(packed_bytes: int) -> int:
    """Return the maximum number of bytes to unpack from a number of packed bytes.

    It is the memory of the machine, or less: deflate packs at most 1032 bytes into one, and Rice's
    coding fewer. No image of the sky with noise comes near that. Small files may have 64 MB.
    """
    memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min(memory_bytes, max(2**26, 1032 * packed_bytes))


def write_temporary(name: Path, content: IO[bytes], bytes_max: float = math.inf) -> PlainFile:
    """Write a temporary FITS file of this content, which exists as long as the returned object.

    Temporary files of processes that were killed are removed.

    Parameters
    ----------
    name : Path
        Name of the file in messages.
    content : file
        File open for reading bytes, at the start of the content to copy.
    bytes_max : float
        Largest size of the copy.

    Raises
    ------
    ObservationError
        If there are more bytes than `bytes_max`.
    """
    folder = Path(tempfile.gettempdir())
    for left_over in find_left_over(folder, "psfdae"):
        left_over.unlink(missing_ok=True)
    plain, process = PlainFile(name, folder / temporary_name("psfdae"), is_copy=True), os.getpid()
    # Only the user reads it.
    plain.path.touch(0o600, exist_ok=False)
    try:
        with plain.path.open("wb") as copy:
            while block := content.read(2**20):
                copy.write(block)
                if copy.tell() > bytes_max:
                    problem = f"unpacks to more than {bytes_max / 2**20:.0f} MB"
                    raise ObservationError(name, f"{problem}; unpack it yourself")
    except BaseException:
        plain.path.unlink(missing_ok=True)
        raise

    def remove(path: Path) -> None:
        # A forked process has this object too, but must not delete the file.
        if os.getpid() == process:
            path.unlink(missing_ok=True)

    weakref.finalize(plain, remove, plain.path)
    return plain


def open_hdus(file: PlainFile, as_stored: bool = False, **options: Any) -> HDUList:
    """Open a file with astropy.

    Call it inside `reading`, which turns errors into `ObservationError`.

    Parameters
    ----------
    file : PlainFile
        File, not compressed as a whole.
    as_stored : bool
        Leave pixels as they are stored, for `ImageFile`: neither scaled nor with blank
        pixels as NaN.
    **options
        Options of `astropy.io.fits.open`.
    """
    from astropy.io import fits

    if as_stored:
        options |= {"do_not_scale_image_data": True, "uint": False, "ignore_blank": True}
    check_counts(file.path)
    return fits.open(file.path, **options)


def check_counts(path: Path) -> None:
    """Raise ValueError if a header of a FITS file announces more axes or columns than FITS has.

    astropy would make a list of as many, whatever the size of the file.
    """
    from astropy.io import fits

    # Header after header, to the end of the file; astropy reports a header without an end.
    with path.open("rb") as file, suppress(OSError, EOFError):
        while header := fits.Header.fromfile(file):
            for key in ("NAXIS", "ZNAXIS", "TFIELDS"):
                if header.get(key, 0) not in range(1000):
                    raise ValueError(f"{key} = {header[key]}, expected 0 … 999")
            file.seek(max(int(header.data_size_padded), 0), os.SEEK_CUR)


# Images.


@dataclass(frozen=True)
class ImageFile:
    """One image of a FITS file, of which `open_pixels` makes the values readable by index.

    Attributes
    ----------
    file : PlainFile
        File with the image.
    index : int
        Number of the extension, from 0.
    shape : tuple of int
        (h, w) or (n, h, w), without the `leading` axes of length 1 before these.
    leading : int
        Number of these axes.
    bscale, bzero, blank : float, float, int or None
        Values are bscale·raw + bzero, and NaN where the raw value is `blank`.
    headers : tuple of Header
        Its own, then the primary one if it is another; none for an array.
    wcs : WCS or None
        Celestial WCS.
    raw : array-like or None
        Pixels as stored: an array that is in no file (`array_image`), or, of an open file, a
        section that is read where it is indexed.
    dtype : dtype
        Type of the values.
    unit_factor : float
        Factor from the file's unit to the unit of the pixels that are read (`to_single_precision`).
    base_level : float
        Level in the file's unit that is subtracted from these pixels.
    """

    file: PlainFile
    index: int
    shape: tuple[int, ...]
    leading: int = 0
    bscale: float = 1.0
    bzero: float = 0.0
    blank: int | None = None
    headers: tuple[Header, ...] = ()
    wcs: WCS | None = None
    raw: Any = None
    dtype: type[np.floating] = np.float32
    unit_factor: float = 1.0
    base_level: float = 0.0

    @property
    def path(self) -> Path:
        """Name of the file in messages (`file.name`); not the path that is opened."""
        return self.file.name

    @property
    def label(self) -> str:
        """Name of the extension, else of the file."""
        return str(self.card("EXTNAME") or self.path)

    @property
    def unit(self) -> str:
        """Unit of the pixels by BUNIT; "" if no header says it."""
        units = (card_value(header, "BUNIT") for header in self.headers)
        return next((u.strip() for u in units if isinstance(u, str) and u.strip()), "")

    def card(self, key: str) -> Any:
        """Return the value of a card of its own header; None if absent or not parseable."""
        return card_value(self.headers[0], key) if self.headers else None

    def __getitem__(self, key: Any) -> np.ndarray:
        """Return physical values of an open image, in native byte order."""
        key = key if isinstance(key, tuple) else (key,)
        with reading(self.path):
            # Index 0 along each leading axis; values as stored are neither scaled nor NaN if blank.
            raw = np.asarray(self.raw[(0,) * self.leading + key])
            # value = bscale · raw + bzero, in double precision; without a scale, values are
            # converted once.
            if self.bscale == 1.0 and self.bzero == 0.0:
                values = raw.astype(self.dtype)
            else:
                values = (raw.astype(np.float64) * self.bscale + self.bzero).astype(self.dtype)
            if self.blank is not None and raw.dtype.kind in "iu":
                values[raw == self.blank] = np.nan
        return values

    def read(self, dtype: type[np.floating] = np.float32) -> np.ndarray:
        """Return the values of all pixels."""
        with open_pixels(self, in_pieces=False, dtype=dtype) as pixels:
            return pixels[:]

    def times(self, factor: float) -> ImageFile:
        """Return the image with all pixels times a factor."""
        names = ("bscale", "bzero", "unit_factor")
        return replace(self, **{name: getattr(self, name) * factor for name in names})

    def to_single_precision(self) -> ImageFile:
        """Return the image with pixels whose noise and squares fit into single precision.

        A level of most pixels that is more than 2¹² times the noise is subtracted: with it, single
        precision would round the noise. It is the value of a pixel, so that whole counts stay
        whole. The unit is a power of 2⁴⁰, so that nothing is rounded and most images keep their
        own: the median deviation of 32 rows, or stamps of a cube, is between 2⁻²⁰ and 2²⁰ then.
        Where most pixels are the same, the largest deviation is.
        """
        # Rows, spread evenly over the image.
        rows = np.unique(np.linspace(0, self.shape[0] - 1, 32).astype(int))
        with open_pixels(self, in_pieces=True, dtype=np.float64) as pixels:
            bands = np.concatenate([pixels[row : row + 1] for row in rows])
        values = bands[np.isfinite(bands)]
        if not values.size:
            return self
        level = float(np.quantile(values, 0.5, method="lower"))
        deviation = np.abs(values - level)
        scatter = float(np.median(deviation)) or float(deviation.max())
        if not 0.0 < scatter < np.inf:
            return self
        # Neighbours in a row show the noise where the sky is not even: their difference has √2 σ.
        with np.errstate(invalid="ignore"):
            steps = np.abs(np.diff(bands, axis=-1))
        noise = float(np.median(steps[np.isfinite(steps)])) if np.isfinite(steps).any() else 0.0
        image = self
        if abs(level) > max(2.0**12 * (noise or scatter), 4.0 * scatter):
            image = replace(self, bzero=self.bzero - level, base_level=level)
        return image.times(2.0 ** (-40.0 * round(np.log2(scatter) / 40.0)))

    def one_plane(self) -> ImageFile:
        """Return the image without its first axis, which has length 1 (NAXIS3 = 1)."""
        return replace(self, shape=self.shape[1:], leading=self.leading + 1)

    def provenance(self) -> list[Card]:
        """Return the cards that describe the origin of the stars and can be parsed.

        These are object, telescope, instrument, observer, filter, dates, exposure time, air mass
        and unit.
        """
        # Of a key in both headers, the value of the image's own is used.
        cards: list[Card] = []
        for key in (
            *("OBJECT", "TELESCOP", "INSTRUME", "OBSERVER", "FILTER"),
            *("DATE-OBS", "MJD-OBS", "EXPTIME", "AIRMASS", "BUNIT"),
        ):
            for header in self.headers:
                value = card_value(header, key)
                if isinstance(value, str | int | float | bool) and value != "":
                    cards.append((key, value, str(card_value(header.comments, key) or "")))
                    break
        return cards


def card_value(header: Header, key: str) -> Any:
    """Return the value of a card; None if it is absent or cannot be parsed."""
    with suppress(Exception):  # astropy parses on access, and raises errors of any kind
        return header[key]
    return None


def array_image(values: np.ndarray, name: str = "array") -> ImageFile:
    """Return an array (h, w), or a cube of stamps (n, s, s), as an image without a header.

    Parameters
    ----------
    values : ndarray
        Pixels, of any type of numbers.
    name : str
        Name of the array in messages.

    Raises
    ------
    ObservationError
        If the array does not hold numbers, does not have two or three axes, or is empty.
    """
    # A plane, or stamps along the first axis, of any type of numbers.
    values, path = np.asarray(values), Path(name)
    if values.dtype.kind not in "fiu" or values.ndim not in (2, 3) or not values.size:
        shape = "×".join(map(str, values.shape))
        raise ObservationError(
            path, f"{values.dtype} of shape {shape}, expected numbers of 2 or 3 dimensions"
        )
    return ImageFile(PlainFile(path, path), 0, values.shape, raw=values)


def find_image(
    path: Path | PlainFile | np.ndarray, extension: str | int | None = None
) -> ImageFile:
    """Find an image in a FITS file, and check that its data are all there.

    Parameters
    ----------
    path : Path, PlainFile, or ndarray
        File; an array is an image itself.
    extension : str or int, optional
        A name (case does not matter), "NAME,version" or a number (0 is the primary one). By default
        the only image is taken that is not a mask, an error or the like (`is_science`), or the
        only one called as in `SCIENCE`.

    Raises
    ------
    ObservationError
        If the file cannot be read or is truncated, or if no image, or several, may be meant; or if
        its axes are not two or three, or its tiles are compressed in a way that is not safe to
        read.
    """
    from astropy.io import fits

    if isinstance(path, np.ndarray):
        return array_image(path)
    file = path if isinstance(path, PlainFile) else plain_file(path)
    path = file.name
    with reading(path), open_hdus(file, as_stored=True) as hdus:
        hdu = choose_extension(path, hdus, extension)
        # Its own header, then the file's primary one.
        index, header = hdus.index(hdu), hdu.header.copy()
        headers = (header,) if index == 0 else (header, hdus[0].header.copy())
        shape = tuple(int(n) for n in hdu.shape)
        # The size in the file follows from shape and type; a tile-compressed image is stored as a
        # table, for which astropy lacks a public attribute.
        table = hdu._bintable if isinstance(hdu, fits.CompImageHDU) else hdu
        # The decoders of two codings (astropy 8.0) take lengths and sizes from the tiles: a wrong
        # byte makes them write outside of their memory.
        coding = table.header.get("ZCMPTYPE")
        if coding in ("HCOMPRESS_1", "PLIO_1"):
            raise ObservationError(path, f"tiles compressed with {coding}; decompress the file")
        missing = hdu.fileinfo()["datLoc"] + table.size - file.path.stat().st_size
        if missing > 0:
            raise ObservationError(path, f"truncated: the last {missing} bytes are missing")
        # Tiles can share their bytes, so that a small file unpacks to any size.
        size = math.prod(shape) * abs(header["BITPIX"]) // 8
        if table is not hdu and size > compute_unpacked_max(table.size):
            raise ObservationError(path, f"damaged: {size} bytes in tiles of {table.size} bytes")
        # values = BSCALE · raw + BZERO
        bscale, bzero, blank = (card_value(header, key) for key in ("BSCALE", "BZERO", "BLANK"))
        bscale, bzero = float(1.0 if bscale is None else bscale), float(bzero or 0.0)
        wcs = read_wcs(header, hdus)
    # Leading axes of length 1 are dropped while more than three remain.
    leading = 0
    while len(shape) > 3 and shape[0] == 1:
        shape, leading = shape[1:], leading + 1
    if len(shape) not in (2, 3):
        raise ObservationError(path, f"an image of {len(shape)} dimensions, expected 2 or 3")
    blank = blank if isinstance(blank, int) else None
    return ImageFile(file, index, shape, leading, bscale, bzero, blank, headers, wcs)


def science_images(path: Path) -> dict[str, int]:
    """Return the numbers of all images of a file but masks, errors and the like, by their names.

    The name is meant for file names: the extension's own, or its number where it lacks a name, or
    the name is not unique, looks like a number, or contains other characters.

    Parameters
    ----------
    path : Path
        FITS file, which may be compressed.

    Raises
    ------
    ObservationError
        If the file does not contain such an image, or cannot be read.
    """
    with reading(path), open_hdus(plain_file(path)) as hdus:
        images = {k: hdu.name for k, hdu in enumerate(hdus) if has_pixels(hdu)}
    images = {k: name for k, name in images.items() if is_science(name)}
    if not images:
        raise ObservationError(path, "no image")
    # Names that are unique, of letters, digits, _, + and - only, and not just a number.
    names = list(images.values())
    suits_files = re.compile("(?![0-9]+$)[A-Za-z0-9_+-]+")
    return {
        name if names.count(name) == 1 and suits_files.fullmatch(name) else str(k): k
        for k, name in images.items()
    }


def map_kind_by_name(name: str) -> str | None:
    """Return the kind of map of an extension: "mask", "error", "variance", "weight", "other".

    By the names that JWST, HST, LCO, LSST, Gemini and ccdproc give them; None for another name.
    """
    # Others are sky, context and exposure maps, samples up the ramp, distortions of the WCS, and
    # the pixels whose sum is the flux of a star of Kepler or TESS.
    names_by_kind = {
        "mask": "DQ|MASK|BPM|FLAGS?",
        "error": "(ERR|ERROR|SIGMA|STDDEV|RMS|UNCERT)(_.*)?",
        "variance": "(VAR|VARIANCE)(_.*)?",  # also VAR_POISSON, a part of the variance
        "weight": "IVAR|WEIGHT|WHT|WGT",
        "other": "BKG|BACKGROUND|SKY|CTX|CON|SAMP|NSAMP|TIME|EXP|AREA|WMAP|PSFIMAGE|WCSDVARR|"
        "D2IMARR|APERTURE",
    }
    name = name.strip().upper()
    return next((kind for kind, form in names_by_kind.items() if re.fullmatch(form, name)), None)


def is_science(name: str) -> bool:
    """Return True unless the name belongs to a map that accompanies an image, such as DQ."""
    return map_kind_by_name(name) is None


def choose_extension(path: Path, hdus: HDUList, extension: str | int | None) -> Any:
    """Return the extension with the image; see `find_image`.

    Raises
    ------
    ObservationError
        If the given extension does not exist or is not an image, or if none is given and no image,
        or several, may be meant; the message lists the extensions of the file.
    """
    # Number, name and size of each extension, for messages.
    labels = []
    for k, hdu in enumerate(hdus):
        size = "×".join(map(str, hdu.shape)) if has_pixels(hdu) else "no image"
        labels.append(f"{k} {hdu.name or '(no name)'} ({size})")
    choices = shorten(labels)
    # The given extension.
    if extension is not None:
        hdu = _find_extension(hdus, str(extension).strip())
        if hdu is None:
            raise ObservationError(path, f"no extension {extension!r}; the file has {choices}")
        if not has_pixels(hdu):
            raise ObservationError(
                path, f"extension {extension!r} holds no image; the file has {choices}"
            )
        return hdu
    # Else the only image that is not a mask, error or the like.
    images = [hdu for hdu in hdus if has_pixels(hdu)]
    science = [hdu for hdu in images if is_science(hdu.name)]
    # The images of a star of Kepler or TESS are cells of a table.
    if not science and "APERTURE" in (hdu.name for hdu in images):
        problem = "a target pixel file: its images are in a table; write one as an image"
        raise ObservationError(path, f"{problem}; the file has {choices}")
    # In a file with only such extensions, any may be meant.
    science = science or images
    if not science:
        raise ObservationError(path, f"no image; the file has {choices}")
    # The science image of a pipeline, if there is just one, whatever other layers are called.
    for name in SCIENCE:
        matches = [hdu for hdu in science if hdu.name.upper() == name]
        science = matches if len(matches) == 1 else science
    if len(science) > 1:
        raise ObservationError(path, f"several images, choose an extension of {choices}")
    return science[0]


def _find_extension(hdus: HDUList, text: str) -> Any:
    """Find the extension of a number, or of a name with perhaps a version; None without one."""
    if re.fullmatch("[0-9]{1,6}", text):
        return hdus[int(text)] if int(text) < len(hdus) else None
    # A name alone means its first extension, whatever the version.
    name, _, version = text.rpartition(",") if "," in text else (text, "", "")
    for hdu in hdus:
        if hdu.name.upper() == name.strip().upper() and version.strip() in ("", str(hdu.ver)):
            return hdu
    return None


def has_pixels(hdu: Any) -> bool:
    """Return True if an extension holds an image that is not empty."""
    from astropy.io import fits

    is_image = isinstance(hdu, fits.PrimaryHDU | fits.ImageHDU | fits.CompImageHDU)
    # Without axes, or with an axis of length 0, an extension is empty.
    has_size = is_image and bool(hdu.shape) and 0 not in hdu.shape
    return has_size and not isinstance(hdu, fits.GroupsHDU)


def read_wcs(header: Header, hdus: HDUList) -> WCS | None:
    """Read the WCS of the first two pixel axes if they are celestial, in the order of the header.

    Right ascension may be its second axis: pixels stay x and y (`WCS.celestial` would exchange
    them). None without a scale, for other axes, for a frame that astropy does not know, and if the
    WCS is damaged or cannot be inverted.

    Parameters
    ----------
    header : Header
        Header of the image.
    hdus : HDUList
        Its file, in which look-up tables of distortions may be.
    """
    # Without a scale, astropy would take a pixel for 1 degree.
    if not any(card_value(header, key) is not None for key in ("CD1_1", "CD1_2", "CDELT1")):
        return None
    from astropy.wcs import WCS

    # wcslib and astropy raise many kinds of errors, all of which mean the same here.
    with suppress(Exception):
        # Axes beyond the plane of the image, such as a wavelength, do not mix with the sky.
        wcs = WCS(header, fobj=hdus).sub([1, 2])
        # The reference pixel has a position on the sky, in a frame that converts to ICRS, and this
        # position has the same pixel: wcslib exchanges signs of TPV where declination is the first
        # axis.
        pixel_to_sky(wcs, *wcs.wcs.crpix[:, None])
        pixel = wcs.wcs_world2pix(wcs.wcs_pix2world([wcs.wcs.crpix], 1), 1)
        return wcs if np.allclose(pixel, wcs.wcs.crpix, rtol=0.0, atol=1e-3) else None
    return None


def sky_frame(wcs: WCS) -> BaseCoordinateFrame:
    """Return the frame of a celestial WCS.

    astropy does not read ecliptic frames of headers, and lets RADESYS, which belongs to equatorial
    coordinates alone, override galactic axes.

    Raises
    ------
    ValueError
        If the frame is not known.
    """
    from astropy.coordinates import BarycentricMeanEcliptic, Galactic, Supergalactic
    from astropy.wcs.utils import wcs_to_celestial_frame

    # Ecliptic of the mean equinox, of 2000 if the header lacks one (Calabretta & Greisen 2002, A&A
    # 395, 1077, sect. 3.1).
    year = 2000.0 if np.isnan(wcs.wcs.equinox) else wcs.wcs.equinox
    ecliptic = BarycentricMeanEcliptic(equinox=f"J{year}")
    frames = {"GLON": Galactic(), "SLON": Supergalactic(), "ELON": ecliptic}
    kind = wcs.wcs.lngtyp
    return frames[kind] if kind in frames else wcs_to_celestial_frame(wcs)


def pixel_to_sky(wcs: WCS, x: np.ndarray, y: np.ndarray) -> SkyCoord:
    """Return ICRS coordinates (n,) of 0-based pixels (n,), distortions included."""
    from astropy.coordinates import SkyCoord

    world = wcs.all_pix2world(x, y, 0)
    longitude, latitude = world[wcs.wcs.lng], world[wcs.wcs.lat]
    return SkyCoord(longitude, latitude, unit="deg", frame=sky_frame(wcs)).icrs


# Pixels.


@contextmanager
def open_pixels(
    image: ImageFile, *, in_pieces: bool, dtype: type[np.floating] = np.float32
) -> Iterator[ImageFile]:
    """Yield an image whose values are read where it is indexed, without the leading axes.

    Parameters
    ----------
    image : ImageFile
        Image to read.
    in_pieces : bool
        True: each slice `[start:stop]` of the first axis is read when it is indexed. False: for
        random access, the file is mapped into memory, or its tiles unpacked there.
    dtype : dtype
        Type of the values.

    Raises
    ------
    ObservationError
        If the file cannot be read, or its image has changed since it was found.
    """
    if image.raw is not None:
        yield replace(image, dtype=dtype)
        return
    with ExitStack() as files:
        with reading(image.path):
            # Sections of the file, or all of its pixels.
            hdus = files.enter_context(open_hdus(image.file, as_stored=True, memmap=not in_pieces))
            hdu = hdus[image.index]
            if tuple(hdu.shape)[image.leading :] != image.shape:
                raise ObservationError(image.path, "has changed since it was opened")
            raw = hdu.section if in_pieces else hdu.data
        yield replace(image, raw=raw, dtype=dtype)
