"""FITS files as they may safely be handed to astropy: plain ones, with headers that end.

Astropy reads headers until they end, and files compressed as a whole through streams
that never do: 17 kB of gzip keep it busy for ever. Such files are therefore unpacked
to a temporary file first, no farther than `Limit` allows, and the length of every
header is checked before astropy sees it.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from psfdae.observations.errors import ObservationError, reading

BLOCK_BYTES = 2880
"""FITS files consist of blocks of this size."""

LONGEST_HEADERS = 8_000 * BLOCK_BYTES
"""Bytes of all headers of a file, 288 000 cards; astropy takes some ten times the memory."""

LARGEST_COUNT = 999
"""Of axes and of columns, by the standard; astropy goes on for as long as a header says.

wcslib reads and writes outside its memory for tens of thousands of axes.
"""

MOST_HDUS = 3000
"""Extensions of a file; those of multi-object spectrographs have two thousand."""

FIRST_CARD = re.compile(rb"SIMPLE  = *T[ /]")
COUNT_CARD = re.compile(rb"(?:Z?NAXIS|TFIELDS|WCSAXES) *= *\+?([0-9]+)")
SIZE_CARD = re.compile(rb"Z?NAXIS[0-9]+ *= *'")
END_CARD = re.compile(rb"(?:.{80})*?END(?![A-Z0-9_-])", re.DOTALL)

PIECE = 2**20


def _only_member(file: IO[bytes]) -> IO[bytes]:
    packed = zipfile.ZipFile(file)
    names = packed.namelist()
    if len(names) != 1:
        raise zipfile.BadZipFile(f"{len(names)} files in a zip file, expected one")
    return packed.open(names[0])


UNPACK: dict[bytes, Callable[[IO[bytes]], Any]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ\x00": lzma.LZMAFile,
    b"PK\x03\x04": _only_member,
}
"""How files compressed as a whole are read, by their first bytes."""


@dataclass(frozen=True)
class Limit:
    """How large something packed may become: `least` bytes, or `ratio` times as large."""

    least: int
    ratio: int = 100

    def of(self, packed: int) -> tuple[int, str]:
        """Bytes allowed for so many packed ones, and the words for them."""
        folder = tempfile.gettempdir()
        free = shutil.disk_usage(folder).free // 2
        allowed = max(self.least, self.ratio * packed)
        if free < allowed:
            return free, f"{free} bytes, half of what is free in {folder} (TMPDIR names another)"
        return allowed, f"{allowed} bytes, the most for {packed} packed ones"


WHOLE = Limit(2**29)
"""Of files compressed as a whole."""


@dataclass(frozen=True)
class PlainFile:
    """A FITS file without compression as a whole: the file itself, or a copy of it.

    `path` is what to open, `name` what to call it; a temporary copy exists as long as
    this object.
    """

    name: Path
    path: Path
    _copy: Any = None


def plain_file(path: Path) -> PlainFile:
    """A FITS file, unpacked if need be.

    Raises
    ------
    ObservationError
        If it is missing, empty, no FITS file, damaged, or larger than `WHOLE` allows.
    """
    with reading(path), path.open("rb") as file:
        start = file.read(80)
        if not start:
            raise ObservationError(path, "the file is empty")
        unpack = next((found for magic, found in UNPACK.items() if start.startswith(magic)), None)
        if unpack is None:
            _check_start(path, start)
            return PlainFile(path, path)
        file.seek(0)
        with unpack(file) as content:
            return _unpacked(path, content)


def _check_start(path: Path, start: bytes) -> None:
    if not start.startswith(b"SIMPLE  ="):
        raise ObservationError(path, "not a FITS file")
    if not FIRST_CARD.match(start):
        raise ObservationError(path, "not a FITS file of the standard: SIMPLE is not T")


def _unpacked(path: Path, content: IO[bytes]) -> PlainFile:
    start = content.read(BLOCK_BYTES)
    _check_start(path, start)
    allowed, words = WHOLE.of(path.stat().st_size)
    copy = tempfile.NamedTemporaryFile(prefix="psfdae-", suffix=".fits")  # noqa: SIM115
    done = copy.write(start)
    while piece := content.read(PIECE):
        done += len(piece)
        if done > allowed:
            copy.close()
            raise ObservationError(path, f"unpacks to more than {words}; unpack it beforehand")
        copy.write(piece)
    copy.flush()
    return PlainFile(path, Path(copy.name), copy)


@contextmanager
def open_hdus(file: PlainFile, **options: Any) -> Iterator[Any]:
    """The file's `astropy.io.fits.HDUList` with all headers read; `options` are those of `open`.

    Raises
    ------
    ObservationError
        If the headers are longer than `LONGEST_HEADERS` or more than `MOST_HDUS`; inside
        `reading` for all else.
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


def _header_bytes(name: Path, raw: IO[bytes], place: int, before: int) -> int:
    """`before` and the bytes of the header at a place of the file, up to its end or the file's."""
    raw.seek(place)
    for size in range(before + BLOCK_BYTES, LONGEST_HEADERS, BLOCK_BYTES):
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
