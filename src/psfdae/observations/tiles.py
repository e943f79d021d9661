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
from pathlib import Path
from typing import Any

from psfdae.observations.errors import ObservationError

SAFE = ("RICE_1", "RICE_ONE", "GZIP_1", "GZIP_2", "NOCOMPRESS")

RICE_DEFAULTS = {"BLOCKSIZE": 32, "BYTEPIX": 4}
RICE_ACCEPTED = {"BLOCKSIZE": (16, 32), "BYTEPIX": (1, 2, 4)}


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
