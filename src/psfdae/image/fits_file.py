"""Images in FITS files of any origin: checked, found and read piece by piece.

Astropy reads headers until they end, and files compressed as a whole through streams
that never do: 17 kB of gzip keep it busy for ever. Such files are therefore unpacked
to a temporary file first, no farther than `WHOLE` allows, and the length of every
header is checked before astropy sees it.

The decoders of tile-compressed images (.fz) are compiled code of CFITSIO and trust parts
of the file. Those of RICE and GZIP check the length of what they read and write; that of
HCOMPRESS is given the size of its buffer in bytes where it counts pixels (astropy 8.0,
`decompress_hcompress_1_c`) and that of PLIO takes the length of its input from the input,
so that one wrong byte writes or reads outside the memory of the tile. Files with these
two are refused; funpack of CFITSIO makes plain ones of them.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import math
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from psfdae.image.errors import ObservationError, reading, shorten

if TYPE_CHECKING:
    from astropy.io.fits import HDUList, Header
    from astropy.wcs import WCS
    from numpy.typing import DTypeLike

BLOCK_BYTES = 2880  # FITS files consist of blocks of this size
LONGEST_HEADERS = 8_000 * BLOCK_BYTES  # of a file, 288 000 cards; astropy takes ten times as much
MOST_HDUS = 3000  # those of multi-object spectrographs have two thousand
# Axes and columns, by the standard; astropy goes on for as long as a header says, and wcslib
# reads and writes outside its memory for tens of thousands of axes.
LARGEST_COUNT = 999
MOST_COMPRESSED = 2000  # pixels per byte of file that no compression reaches
LARGEST_ORDER = 9  # of distortion polynomials (SIP); astropy would be busy for ever with any number
LARGEST_TILE = 2**24  # pixels, 4096²; decompressing takes some 30 bytes for each
BLOCK_PX = 2**22  # pixels that are decompressed at a time, if a tile is no larger
PIECE = 2**20  # bytes that are unpacked at a time

FIRST_CARD = re.compile(rb"SIMPLE  = *T[ /]")
COUNT_CARD = re.compile(rb"(?:Z?NAXIS|TFIELDS|WCSAXES) *= *\+?([0-9]+)")
SIZE_CARD = re.compile(rb"Z?NAXIS[0-9]+ *= *'")
END_CARD = re.compile(rb"(?:.{80})*?END(?![A-Z0-9_-])", re.DOTALL)

SAFE_TILES = ("RICE_1", "RICE_ONE", "GZIP_1", "GZIP_2", "NOCOMPRESS")
RICE = {"BLOCKSIZE": (32, (16, 32)), "BYTEPIX": (4, (1, 2, 4))}  # default, and what is accepted

# Extensions that go with an image, by the pipelines of JWST, HST, LCO, LSST, Gemini, ccdproc.
MAPS = {
    "mask": re.compile("DQ|MASK|BPM|FLAGS?"),
    "error": re.compile("(ERR|ERROR|SIGMA|STDDEV|RMS|UNCERT)(_.*)?"),
    "variance": re.compile("(VAR|VARIANCE)(_.*)?"),  # VAR_POISSON, a part of it
    "weight": re.compile("IVAR|WEIGHT|WHT|WGT"),
}
NOT_SCIENCE = re.compile(
    "|".join(kind.pattern for kind in MAPS.values())
    + "|BKG|BACKGROUND|SKY|CTX|CON|SAMP|NSAMP|TIME|EXP|AREA|WMAP|PSFIMAGE"
    + "|WCSDVARR|D2IMARR"
)
SCIENCE = ("SCI", "IMAGE")  # of which there is one in a file, it is meant
# Types of astropy's uncertainties, which CCDData writes as UTYPE.
UNCERTAINTIES = {"STD": "error", "VAR": "variance", "IVAR": "weight"}
# Planes of an LSST mask of which the pixels show no light of stars; others mark good pixels.
LSST_BAD_PLANES = ("BAD", "SAT", "INTRP", "CR", "NO_DATA", "UNMASKEDNAN")

# Electrons per count; cameras that write the first two put a setting without unit into GAIN.
GAIN_KEYS = ("EGAIN", "GAIN", "ESO DET OUT1 CONAD", "ATODGAIN", "CCDGAIN", "GAIN1", "GAINA")
READ_NOISE_KEYS: tuple[str, ...] = ("RDNOISE", "READNOIS", "READNOISE", "RON", "ENOISE")
READ_NOISE_KEYS += ("ESO DET OUT1 RON", "CCDNOISE", "RDNOISE1", "RDNOISEA")  # electrons
SATURATION_KEYS = ("SATURATE", "SATLEVEL", "SATURATA", "MAXLIN")  # counts
# Arcseconds; the second is POPPY's.
SCALE_KEYS = ("PIXSCALE", "PIXELSCL", "SECPIX", "SECPIX1", "PIXSCAL1", "IM_SCALE", "SCALE")
LENS_KEYS = ("XPIXSZ", "FOCALLEN")  # micrometres and millimetres, of amateurs' cameras
# Where stamps come from, copied to whatever is made of them.
PROVENANCE_KEYS: tuple[str, ...] = ("OBJECT", "TELESCOP", "INSTRUME", "OBSERVER", "FILTER")
PROVENANCE_KEYS += ("DATE-OBS", "MJD-OBS", "EXPTIME", "AIRMASS", "BUNIT")
INSTRUMENT_KEYS = ("TELESCOP", "INSTRUME", "FILTER")  # of these, with which PSFs change

Card = tuple[str, str | float | None, str]  # key, value and comment
Said = tuple[float | None, str]  # a number, and the card that says it; or None, and words for that


@dataclass(frozen=True)
class Limit:
    """How large something packed may become: `least` bytes, or `ratio` times as large."""

    least: int
    ratio: int = 100

    def of(self, packed: int) -> tuple[int, str]:
        """Bytes allowed for so many packed ones, and the words for them."""
        folder = tempfile.gettempdir()
        free_bytes = shutil.disk_usage(folder).free // 2
        allowed_bytes = max(self.least, self.ratio * packed)
        if free_bytes < allowed_bytes:
            return (
                free_bytes,
                f"{free_bytes} bytes, half of what is free in {folder} (TMPDIR names another)",
            )
        return allowed_bytes, f"{allowed_bytes} bytes, the most for {packed} packed ones"


WHOLE = Limit(2**29)  # of files compressed as a whole
DECOMPRESSED = Limit(2**31)  # of images of tiles of which pixels are needed at random


# Files.


def _only_member(file: IO[bytes]) -> IO[bytes]:
    packed = zipfile.ZipFile(file)
    names = packed.namelist()
    if len(names) != 1:
        raise zipfile.BadZipFile(f"{len(names)} files in a zip file, expected one")
    return packed.open(names[0])


# How files compressed as a whole are read, by their first bytes.
UNPACK: dict[bytes, Callable[[IO[bytes]], Any]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ\x00": lzma.LZMAFile,
    b"PK\x03\x04": _only_member,
}


@dataclass(frozen=True)
class PlainFile:
    """A FITS file without compression as a whole: the file itself, or a copy of it.

    `path` is what to open, `name` what to call it; a temporary copy exists as long as
    this object.
    """

    name: Path
    path: Path
    _copy: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a temporary copy by its content."""
        if self._copy is None:
            return type(self), (self.name, self.path)
        return temporary_file, (self.name, self.path.read_bytes())


def plain_file(path: Path) -> PlainFile:
    """A FITS file, unpacked if need be."""
    with reading(path), path.open("rb") as file:
        start = file.read(80)
        if not start:
            raise ObservationError(path, "the file is empty")
        unpack = next(
            (unpacker for magic, unpacker in UNPACK.items() if start.startswith(magic)), None
        )
        if unpack is None:
            _check_start(path, start)
            return PlainFile(path, path)
        file.seek(0)
        with unpack(file) as content:
            return _unpacked(path, content)


def temporary_file(name: Path, content: bytes) -> PlainFile:
    """A FITS file of this content, which exists as long as the object that is returned."""
    copy = tempfile.NamedTemporaryFile(prefix="psfdae-", suffix=".fits")  # noqa: SIM115
    copy.write(content)
    copy.flush()
    return PlainFile(name, Path(copy.name), copy)


def _check_start(path: Path, start: bytes) -> None:
    if not start.startswith(b"SIMPLE  ="):
        raise ObservationError(path, "not a FITS file")
    if not FIRST_CARD.match(start):
        raise ObservationError(path, "not a FITS file of the standard: SIMPLE is not T")


def _unpacked(path: Path, content: IO[bytes]) -> PlainFile:
    start = content.read(BLOCK_BYTES)
    _check_start(path, start)
    allowed_bytes, words = WHOLE.of(path.stat().st_size)
    copy = tempfile.NamedTemporaryFile(prefix="psfdae-", suffix=".fits")  # noqa: SIM115
    written_bytes = copy.write(start)
    while piece := content.read(PIECE):
        written_bytes += len(piece)
        if written_bytes > allowed_bytes:
            copy.close()
            raise ObservationError(path, f"unpacks to more than {words}; unpack it beforehand")
        copy.write(piece)
    copy.flush()
    return PlainFile(path, Path(copy.name), copy)


@contextmanager
def open_hdus(file: PlainFile, **options: Any) -> Iterator[HDUList]:
    """The file's `astropy.io.fits.HDUList` with all headers read; `options` are those of `open`.

    Belongs inside `reading`: only headers that are too long or too many are refused here.
    """
    from astropy.io import fits

    with ExitStack() as files:
        raw = files.enter_context(file.path.open("rb"))
        size = _header_bytes(file.name, raw, 0, 0)
        # To open a file astropy reads the header of the first extension, too.
        raw.seek(0)
        data = fits.PrimaryHDU.fromstring(raw.read(size)).size
        _header_bytes(file.name, raw, size + -(-data // BLOCK_BYTES) * BLOCK_BYTES, 0)
        hdus = files.enter_context(fits.open(file.path, **options))
        for index in range(MOST_HDUS + 1):
            try:
                place = hdus[index].fileinfo()
            except IndexError:
                break
            size = _header_bytes(file.name, raw, place["datLoc"] + place["datSpan"], size)
        else:
            raise ObservationError(file.name, f"more than {MOST_HDUS} extensions")
        yield hdus


def _header_bytes(name: Path, raw: IO[bytes], place: int, bytes_before: int) -> int:
    """`before` and the bytes of the header at a place of the file, up to its end or the file's."""
    raw.seek(place)
    for size in range(bytes_before + BLOCK_BYTES, LONGEST_HEADERS, BLOCK_BYTES):
        block = raw.read(BLOCK_BYTES)
        for card in COUNT_CARD.finditer(block):
            if card.start() % 80 == 0 and int(card[1]) > LARGEST_COUNT:
                raise ObservationError(name, f"damaged: {card[0].decode()}")
        for card in SIZE_CARD.finditer(block):  # astropy would repeat the text so many times
            if card.start() % 80 == 0:
                text = block[card.start() :][:80].decode("ascii", "replace").rstrip()
                raise ObservationError(name, f"damaged: {text}, expected a number")
        if len(block) < BLOCK_BYTES or END_CARD.match(block):
            return size
    raise ObservationError(name, f"damaged: headers of more than {LONGEST_HEADERS} bytes")


# Images.


@dataclass(frozen=True)
class ImageFile:
    """One image of a FITS file, described but not read.

    `shape` is without leading axes of length 1, of which `leading` were removed. Values
    are `bscale`·stored + `bzero`, and NaN where `blank` is stored. `headers` are its own
    and the primary one: what is missing, not a number or out of range in both counts as
    not given. `wcs` is the celestial WCS or None. `values` are the pixels of an image that
    is an array and in no file; `array_image` makes one.
    """

    file: PlainFile
    index: int
    shape: tuple[int, ...]
    leading: int
    bscale: float
    bzero: float
    blank: int | None
    headers: tuple[Header, ...]
    wcs: WCS | None
    values: np.ndarray | None = None

    @property
    def path(self) -> Path:
        """The file's own name, for messages."""
        return self.file.name

    def physical(self, stored: np.ndarray, dtype: DTypeLike = np.float32) -> np.ndarray:
        """Physical values of stored ones, in native byte order, same shape.

        They are of double precision where all are below 1e-15.
        """
        if self.bscale == 1.0 and self.bzero == 0.0:
            values = stored.astype(dtype)
        else:
            values = (stored.astype(np.float64) * self.bscale + self.bzero).astype(dtype)
        if self.blank is not None and stored.dtype.kind in "iu":
            values[stored == self.blank] = np.nan
        # In a unit in which stars have 1e-20, squares of single precision would be 0.
        largest = np.abs(values).max(initial=0.0, where=np.isfinite(values))
        if values.dtype == np.float32 and 0.0 < largest < 1e-15:
            values = values.astype(np.float64)
        return values

    def positive(self, keys: Sequence[str]) -> Said:
        """First finite positive number under one of the keys, in the order of the keys."""
        for key in keys:
            for header in self.headers:
                value = card_value(header, key)
                try:
                    number = float("nan" if isinstance(value, bool) else value)
                except (TypeError, ValueError):
                    continue
                if np.isfinite(number) and number > 0:
                    return number, key
        return None, "not known"

    def gain(self) -> Said:
        """Electrons per count.

        Images in electrons (BUNIT) have 1 whatever the camera's gain was; for images
        of a rate, counts per second, or of a calibrated brightness, the gain of the camera is
        not that of the pixels.
        """
        name = self.unit.lower().replace(" ", "")
        if name in {"electron", "electrons", "e-", "e"}:
            return 1.0, "BUNIT"
        if name.endswith(("/s", "/sec", "/second", "s-1", "s**-1", "s^-1")):
            return None, "not known, the image is a rate"
        if "jy" in name or "erg" in name:
            return None, f"not known, the image is in {self.unit}"
        gain = self.positive(GAIN_KEYS)
        if gain[1] == "GAIN" and self._is_camera_setting():
            return None, f"not known, GAIN = {gain[0]:g} is a setting of the camera"
        return gain

    def _is_camera_setting(self) -> bool:
        """Return True if GAIN is a whole number from 20 without unit, as of amateurs' cameras."""
        for header in self.headers:
            value = card_value(header, "GAIN")
            if value is not None:
                unit = re.search("e-|electron|adu", str(card_value(header.comments, "GAIN")), re.I)
                return isinstance(value, int) and value >= 20 and unit is None
        return False

    @property
    def unit(self) -> str:
        """Unit of the pixels by BUNIT; "" if no header says it."""
        for header in self.headers:
            unit = card_value(header, "BUNIT")
            if isinstance(unit, str) and unit.strip():
                return unit.strip()
        return ""

    def one_plane(self) -> ImageFile:
        """The only plane of an image with NAXIS3 = 1."""
        return replace(self, shape=self.shape[1:], leading=self.leading + 1)

    def scale(self) -> Said:
        """Arcseconds per pixel by the header's cards, the WCS aside."""
        width, focus = (self.positive((key,))[0] for key in LENS_KEYS)
        header_scale = self.positive(SCALE_KEYS)
        if header_scale[0] is None and width and focus:
            return float(np.rad2deg(width * 1e-3 / focus)) * 3600.0, " and ".join(LENS_KEYS)
        return header_scale

    def provenance(self) -> list[Card]:
        """Cards of `PROVENANCE_KEYS`, those that can be parsed."""
        cards: list[Card] = []
        for key in PROVENANCE_KEYS:
            for header in self.headers:
                value = card_value(header, key)
                if isinstance(value, str | int | float | bool) and value != "":
                    cards.append((key, value, str(card_value(header.comments, key) or "")))
                    break
        return cards


def card_value(header: Header, key: str) -> Any:
    """Value of a card; None if it is absent or cannot be parsed."""
    try:
        return header[key]
    except Exception:  # astropy parses on access, and raises what the damage brings about
        return None


def array_image(values: np.ndarray, name: str = "array") -> ImageFile:
    """An image that is an array (h, w) or a cube of stamps (n, s, s), without a header."""
    values, path = np.asarray(values), Path(name)
    if values.dtype.kind not in "fiu" or values.ndim not in (2, 3) or not values.size:
        shape = "×".join(map(str, values.shape))
        raise ObservationError(
            path, f"{values.dtype} of shape {shape}, expected numbers of 2 or 3 dimensions"
        )
    file = PlainFile(path, path)
    return ImageFile(file, 0, values.shape, 0, 1.0, 0.0, None, (), None, values)


def find_image(
    path: Path | PlainFile | np.ndarray, extension: str | int | None = None
) -> ImageFile:
    """Find an image in a FITS file and check that its data are all there.

    Parameters
    ----------
    path : Path, PlainFile, or ndarray
        An array is an image itself.
    extension : str or int, optional

    The file may be tile-compressed (.fz) or compressed as a whole (.gz, .bz2, .xz, .zip with
    one file). The extension is a name (case does not matter), "NAME,version" or a number (0
    is the primary one); without it the only image is taken that is not a mask, an error or
    the like (`NOT_SCIENCE`), or the only one called as in `SCIENCE`.
    """
    if isinstance(path, np.ndarray):
        return array_image(path)
    file = path if isinstance(path, PlainFile) else plain_file(path)
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
    bscale, bzero, blank = (card_value(header, key) for key in ("BSCALE", "BZERO", "BLANK"))
    bscale, bzero = 1.0 if bscale is None else bscale, 0.0 if bzero is None else bzero
    if not all(isinstance(f, int | float) and math.isfinite(f) for f in (bscale, bzero)):
        raise ObservationError(path, "BSCALE or BZERO is not a number")
    blank = blank if isinstance(blank, int) else None
    return ImageFile(file, index, shape, leading, float(bscale), float(bzero), blank, headers, wcs)


def science_images(path: Path) -> dict[str, int]:
    """Numbers of all images of a file but masks, errors and the like, by a name for files.

    That is the extension's own, or its number where it has none of its own, or one that looks
    like the number of another.
    """
    with reading(path), open_hdus(plain_file(path)) as hdus:
        names_by_number = {k: hdu.name for k, hdu in enumerate(hdus) if _has_pixels(hdu)}
    names_by_number = {k: name for k, name in names_by_number.items() if _is_science(name)}
    if not names_by_number:
        raise ObservationError(path, "no image")
    names = list(names_by_number.values())
    plain = re.compile("(?![0-9]+$)[A-Za-z0-9_+-]+")
    unique = {
        k for k, name in names_by_number.items() if names.count(name) == 1 and plain.fullmatch(name)
    }
    return {name if k in unique else str(k): k for k, name in names_by_number.items()}


def _is_science(name: str) -> bool:
    """Return False for an extension that goes with an image, such as DQ, by its name."""
    return NOT_SCIENCE.fullmatch(name.strip().upper()) is None


def map_kind(image: ImageFile) -> str | None:
    """Return which of `MAPS` an extension is by its name or UTYPE, None if neither says it."""
    header = image.headers[0] if image.headers else {}
    name = str(card_value(header, "EXTNAME") or "").strip().upper()
    kind = next((kind for kind, names in MAPS.items() if names.fullmatch(name)), None)
    if kind != "error":
        return kind
    return UNCERTAINTIES.get(str(card_value(header, "UTYPE") or "STD").strip().upper(), kind)


def layers_beside(image: ImageFile) -> dict[str, ImageFile]:
    """Find the mask and the map of noise that a file has for an image, by the names in `MAPS`.

    They have its size. If names repeat, their versions (EXTVER) belong together; of a file with
    several science images that do not, none is taken.

    Returns
    -------
    dict of str to ImageFile
        Under "mask"; under one of "error", "variance".
    """
    if image.values is not None:
        return {}
    with reading(image.path), open_hdus(image.file, memmap=True, **_AS_STORED) as hdus:
        images = [(k, hdu) for k, hdu in enumerate(hdus) if _has_pixels(hdu)]
        science_hdu = hdus[image.index]
        science = [hdu for _, hdu in images if _is_science(hdu.name)]
        of_pipeline = science_hdu.name.upper() in SCIENCE
        if not _is_science(science_hdu.name) or (len(science) > 1 and not of_pipeline):
            return {}
        places = [
            k
            for k, hdu in images
            if not _is_science(hdu.name)
            and "_" not in hdu.name
            and tuple(hdu.shape)[-2:] == image.shape[-2:]
            and hdu.ver == science_hdu.ver
        ]
    layers: dict[str, ImageFile] = {}
    for place in places:
        layer = find_image(image.file, place)
        if len(layer.shape) > len(image.shape):
            layer = layer.one_plane()
        if layer.shape != image.shape:
            continue
        kind = map_kind(layer)
        if kind in MAPS:
            layers.setdefault(kind, layer)
    # A standard deviation goes before a variance; weights have no unit that could be trusted.
    names = ("mask", "error" if "error" in layers else "variance")
    return {name: layers[name] for name in names if name in layers}


def bits_of_bad_pixels(mask: ImageFile) -> tuple[int, str] | None:
    """Return the sum of the mask's bits that are bad by its header, and who says so.

    None if the header does not say it. LSST names its planes (MP_BAD = 0 for bit 0); JWST's and
    Roman's bit 1 is DO_NOT_USE.
    """
    for header in mask.headers:
        planes = {name: card_value(header, f"MP_{name}") for name in LSST_BAD_PLANES}
        bits = {name: bit for name, bit in planes.items() if isinstance(bit, int) and 0 <= bit < 63}
        if bits:
            return sum(1 << bit for bit in set(bits.values())), ", ".join(bits)
        if str(card_value(header, "TELESCOP")).strip().upper() in ("JWST", "ROMAN"):
            return 1, "DO_NOT_USE"
    return None


_AS_STORED = {"do_not_scale_image_data": True, "uint": False, "ignore_blank": True}


def _choose(path: Path, hdus: HDUList, extension: str | int | None) -> Any:
    listed = shorten([_label(k, hdu) for k, hdu in enumerate(hdus)])
    if extension is not None:
        hdu = _named(hdus, str(extension).strip())
        if hdu is None:
            raise ObservationError(path, f"no extension {extension!r}; the file has {listed}")
        if not _has_pixels(hdu):
            raise ObservationError(
                path, f"extension {extension!r} holds no image; the file has {listed}"
            )
        return hdu
    images = [hdu for hdu in hdus if _has_pixels(hdu)]
    science = [hdu for hdu in images if _is_science(hdu.name)] or images
    if not science:
        raise ObservationError(path, f"no image; the file has {listed}")
    # The science image of a pipeline, if there is just one, whatever other layers are called.
    for name in SCIENCE:
        named = [hdu for hdu in science if hdu.name.upper() == name]
        science = named if len(named) == 1 else science
    if len(science) > 1:
        raise ObservationError(path, f"several images, choose an extension of {listed}")
    return science[0]


def _named(hdus: HDUList, text: str) -> Any:
    """The extension of that number or name, or None."""
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
        _check_tiles(path, hdu)
        return
    missing = hdu.fileinfo()["datLoc"] + hdu.size - on_disk
    if missing > 0:
        raise ObservationError(path, f"truncated: the last {missing} bytes are missing")


def _celestial(header: Header, hdus: HDUList) -> WCS | None:
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


# Tiles.


def _check_tiles(path: Path, hdu: Any) -> None:
    """Refuse a compressed image whose tiles do not cover it, or are coded unsafely."""
    table = hdu._bintable  # astropy has no public way to the table that holds the tiles
    coding = str(table.header.get("ZCMPTYPE")).strip()
    if coding not in SAFE_TILES:
        raise ObservationError(
            path,
            f"tiles compressed with {coding}, accepted are {', '.join(SAFE_TILES)}; "
            "decompress the file",
        )
    if coding.startswith("RICE"):
        settings = _tile_settings(table.header)
        for name, (default, accepted) in RICE.items():
            value = settings.get(name, default)
            if value not in accepted:
                raise ObservationError(path, f"damaged: {name} {value}, expected one of {accepted}")
    if math.prod(hdu.tile_shape) > LARGEST_TILE:
        size = "×".join(str(n) for n in hdu.tile_shape)
        raise ObservationError(
            path,
            f"tiles of {size} pixels, accepted are {LARGEST_TILE} pixels; decompress the file",
        )
    tiles = math.prod(-(-n // t) for n, t in zip(hdu.shape, hdu.tile_shape, strict=True))
    if tiles != len(table.data):
        raise ObservationError(path, f"damaged: {len(table.data)} tiles instead of {tiles}")


def _tile_settings(header: Header) -> dict[str, Any]:
    """Parameters of the coding, stored as pairs ZNAMEi, ZVALi."""
    settings = {}
    for i in range(1, 1000):
        if f"ZNAME{i}" not in header:
            break
        settings[str(header[f"ZNAME{i}"]).strip().upper()] = header.get(f"ZVAL{i}")
    return settings


def decompress(file: PlainFile, hdu: Any, copy: IO[bytes]) -> np.ndarray:
    """The stored values of an image, written to a file block by block and mapped from there.

    Only the tiles of a block of `BLOCK_PX` pixels are in memory; the file `copy` holds the
    values as long as they are used.
    """
    first = (0,) * (len(hdu.shape) - 2)
    dtype = hdu.section[(*first, slice(0, 1), slice(0, 1))].dtype
    allowed_bytes, words = DECOMPRESSED.of(file.path.stat().st_size)
    needed = math.prod(hdu.shape) * dtype.itemsize
    if needed > allowed_bytes:
        raise ObservationError(file.name, f"decompresses to {needed} bytes, more than {words}")
    # Room for all of it now: a disk that fills up later would kill the process.
    os.posix_fallocate(copy.fileno(), 0, needed)
    values = np.memmap(copy, dtype, "r+", shape=hdu.shape)
    rows, columns = hdu.shape[-2:]
    # Blocks of whole tiles, as wide as the image if that is few pixels.
    tile_rows, tile_columns = hdu.tile_shape[-2:]
    if columns * tile_rows <= BLOCK_PX:
        tile_rows, tile_columns = BLOCK_PX // (columns * tile_rows) * tile_rows, columns
    else:
        tile_columns *= max(1, BLOCK_PX // (tile_rows * tile_columns))
    for row in range(0, rows, tile_rows):
        for column in range(0, columns, tile_columns):
            block: tuple[int | slice, ...] = (
                *first,
                slice(row, row + tile_rows),
                slice(column, column + tile_columns),
            )
            values[block] = hdu.section[block]
    return values


# Pixels.


@dataclass(frozen=True)
class Pixels:
    """Physical values of an array or section of stored ones."""

    stored: Any
    image: ImageFile
    dtype: DTypeLike = np.float32

    def __getitem__(self, key: Any) -> np.ndarray:
        key = key if isinstance(key, tuple) else (key,)
        with reading(self.image.path):
            stored = np.asarray(self.stored[(0,) * self.image.leading + key])
            return self.image.physical(stored, self.dtype)


@contextmanager
def open_pixels(
    image: ImageFile, *, whole: bool, dtype: DTypeLike = np.float32
) -> Iterator[Pixels]:
    """The values of an image as something to index, without the leading axes.

    As a `whole` it is an array, mapped into memory where the file allows, for access at
    random; else for slices `[start:stop]` along the first axis, of which only what is
    asked for is read.
    """
    from astropy.io import fits

    if image.values is not None:
        yield Pixels(image.values, image, dtype)
        return
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
                stored = decompress(image.file, hdu, copy)
            else:
                stored = hdu.data
        yield Pixels(stored, image, dtype)
