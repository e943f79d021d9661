"""Tile-compressed images (.fz): what must hold before their tiles may be decompressed.

The decoders that astropy takes from CFITSIO are compiled code and trust parts of
the file. Those of RICE and GZIP check the length of what they read and write; that
of HCOMPRESS is told the size of its buffer in bytes where it counts pixels (astropy
8.0, `decompress_hcompress_1_c`) and that of PLIO takes the length of its input from
the input, so that one wrong byte writes or reads outside the memory of the tile.
Files with these two are refused; funpack of CFITSIO makes plain ones of them.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import IO, Any

import numpy as np

from psfdae.observations.errors import ObservationError
from psfdae.observations.unpacking import Limit

SAFE = ("RICE_1", "RICE_ONE", "GZIP_1", "GZIP_2", "NOCOMPRESS")

RICE_DEFAULTS = {"BLOCKSIZE": 32, "BYTEPIX": 4}
RICE_ACCEPTED = {"BLOCKSIZE": (16, 32), "BYTEPIX": (1, 2, 4)}

LARGEST_TILE = 2**24
"""Pixels of a tile, 4096²; decompressing takes some 30 bytes for each."""

BLOCK_PX = 2**22
"""Pixels that are decompressed at a time, if a tile is no larger."""

DECOMPRESSED = Limit(2**31)
"""How large an image of which pixels are needed at random may become."""


def check_tiles(path: Path, hdu: Any) -> None:
    """Refuse a compressed image whose tiles cannot be trusted.

    Parameters
    ----------
    path : Path
    hdu : astropy CompImageHDU

    Raises
    ------
    ObservationError
        If the tiles do not cover the image, or their coding is not accepted.
    """
    table = hdu._bintable  # astropy has no public way to the table that holds the tiles
    coding = str(table.header.get("ZCMPTYPE")).strip()
    if coding not in SAFE:
        raise ObservationError(
            path,
            f"tiles compressed with {coding}, accepted are {', '.join(SAFE)}; decompress the file",
        )
    if coding.startswith("RICE"):
        settings = _settings(table.header)
        for name, accepted in RICE_ACCEPTED.items():
            value = settings.get(name, RICE_DEFAULTS[name])
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


def _settings(header: Any) -> dict[str, Any]:
    """Parameters of the coding, stored as pairs ZNAMEi, ZVALi."""
    settings = {}
    for i in range(1, 1000):
        if f"ZNAME{i}" not in header:
            break
        settings[str(header[f"ZNAME{i}"]).strip().upper()] = header.get(f"ZVAL{i}")
    return settings


def decompress(path: Path, hdu: Any, copy: IO[bytes]) -> np.ndarray:
    """The stored values of an image, written to a file block by block and mapped from there.

    Only the tiles of a block of `BLOCK_PX` pixels are in memory.

    Parameters
    ----------
    path : Path
        For messages.
    hdu : astropy CompImageHDU
    copy : file, empty
        Holds the values as long as they are used.

    Returns
    -------
    memmap, shape of the image

    Raises
    ------
    ObservationError
        If the image is larger than `DECOMPRESSED` allows.
    """
    first = (0,) * (len(hdu.shape) - 2)
    dtype = hdu.section[(*first, slice(0, 1), slice(0, 1))].dtype
    allowed, words = DECOMPRESSED.of(path.stat().st_size)
    needed = math.prod(hdu.shape) * dtype.itemsize
    if needed > allowed:
        raise ObservationError(path, f"decompresses to {needed} bytes, more than {words}")
    # Room for all of it now: a disk that fills up later would kill the process.
    os.posix_fallocate(copy.fileno(), 0, needed)
    values = np.memmap(copy, dtype, "r+", shape=hdu.shape)
    rows, columns = hdu.shape[-2:]
    high, wide = _block(columns, *hdu.tile_shape[-2:])
    for row in range(0, rows, high):
        for column in range(0, columns, wide):
            block = (*first, slice(row, row + high), slice(column, column + wide))
            values[block] = hdu.section[block]
    return values


def _block(columns: int, tile_high: int, tile_wide: int) -> tuple[int, int]:
    """Rows and columns of a block of whole tiles, as wide as the image if that is few pixels."""
    if columns * tile_high <= BLOCK_PX:
        return BLOCK_PX // (columns * tile_high) * tile_high, columns
    return tile_high, max(1, BLOCK_PX // (tile_high * tile_wide)) * tile_wide
