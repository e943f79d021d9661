"""Files that are either whole or absent, and data products that describe themselves."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import psfdae


class ProductError(RuntimeError):
    """A data product is missing, damaged, or not what the stage expects."""


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name beside `path`; rename onto it if the block succeeds.

    A reader therefore never sees a half-written file, and an interrupted stage
    leaves nothing that looks finished.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class Column:
    """One array of a product with its unit and a line of explanation."""

    values: np.ndarray
    unit: str
    about: str


@dataclass(frozen=True)
class Empty:
    """A column that is created at its full length and filled slice by slice."""

    shape: tuple[int, ...]
    dtype: type | np.dtype
    unit: str
    about: str


CHUNK_BYTES = 2**18
"""Size of the chunks of an `Empty` column, which hold whole rows."""


def write_product(
    path: str | Path, kind: str, columns: Mapping[str, Column], config: Mapping[str, Any]
) -> None:
    """Write arrays as a self-describing HDF5 file.

    The file carries its kind, the package version, the resolved config of the
    stage as JSON (seed included) and per array the unit and a description.
    Chunks are checksummed (Fletcher-32), no time stamps are stored: the same
    config gives the same bytes. A column that is the very object of an earlier
    one is stored as a link.

    Parameters
    ----------
    path : path-like
        Target; replaced atomically.
    kind : str
        Product type that `read_product` checks, such as "stars".
    columns : mapping of name to Column
    config : mapping
        Resolved config sub-tree of the stage.
    """
    import h5py

    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        _describe(file, kind, config)
        stored: dict[int, str] = {}
        for name, column in columns.items():
            if id(column.values) in stored:
                file[name] = h5py.SoftLink(f"/{stored[id(column.values)]}")
                continue
            stored[id(column.values)] = name
            data = file.create_dataset(name, data=column.values, chunks=True, fletcher32=True)
            data.attrs["unit"] = column.unit
            data.attrs["about"] = column.about


@contextmanager
def stream_product(
    path: str | Path,
    kind: str,
    columns: Mapping[str, Column | Empty],
    config: Mapping[str, Any],
) -> Iterator[Mapping[str, Any]]:
    """Write a product piece by piece, so that it never has to fit into memory.

    Yields the HDF5 datasets by name; the block fills those of the `Empty`
    columns, best in the order of their rows: `data["psf"][start:stop] = …`. The
    file is that of `write_product` but for the shape of the chunks, and appears
    under its name only when the block has succeeded. An `Empty` that is the very
    object of an earlier one is stored as a link.

    Parameters are those of `write_product`.

    Raises
    ------
    ProductError
        If the block has left a chunk of a column unwritten.
    """
    import h5py

    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        _describe(file, kind, config)
        stored: dict[int, str] = {}
        for name, column in columns.items():
            if id(column) in stored:
                file[name] = h5py.SoftLink(f"/{stored[id(column)]}")
                continue
            stored[id(column)] = name
            data = file.create_dataset(name, fletcher32=True, **_storage(column))
            data.attrs["unit"] = column.unit
            data.attrs["about"] = column.about
        yield {name: file[name] for name in columns}
        file.flush()
        for name in stored.values():
            data = file[name]
            written = data.id.get_num_chunks() * data.chunks[0]
            if isinstance(columns[name], Empty) and written < data.shape[0]:
                raise ProductError(f"{path}: array {name!r} was not filled to its end")


def _storage(column: Column | Empty) -> dict[str, Any]:
    """Arguments with which h5py creates the dataset of a streamed column."""
    if isinstance(column, Column):
        return {"data": column.values, "chunks": True}
    dtype = np.dtype(column.dtype)
    row_bytes = int(np.prod(column.shape[1:], dtype=int)) * dtype.itemsize
    rows = max(1, min(column.shape[0], CHUNK_BYTES // row_bytes))
    return {"shape": column.shape, "dtype": dtype, "chunks": (rows, *column.shape[1:])}


def _describe(file: Any, kind: str, config: Mapping[str, Any]) -> None:
    file.attrs["kind"] = kind
    file.attrs["psfdae_version"] = psfdae.__version__
    file.attrs["config"] = json.dumps(config, sort_keys=True)


@dataclass(frozen=True)
class Product:
    """Arrays and config read from a data product."""

    path: Path
    config: dict[str, Any]
    arrays: dict[str, np.ndarray]

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]


def read_product(path: str | Path, kind: str, names: tuple[str, ...] | None = None) -> Product:
    """Read a data product, or only some of its arrays.

    Raises
    ------
    ProductError
        If the file is missing, damaged, of another kind or lacks an array; the
        message names the file and says what to do.
    """
    import h5py

    path = Path(path)
    try:
        with h5py.File(path, "r") as file:
            found = file.attrs.get("kind")
            if found != kind:
                raise ProductError(f"{path}: a product of kind {found!r}, expected {kind!r}")
            wanted = tuple(file) if names is None else names
            missing = [name for name in wanted if name not in file]
            if missing:
                raise ProductError(f"{path}: array {missing[0]!r} is missing")
            arrays = {name: file[name][()] for name in wanted}
            return Product(path, json.loads(file.attrs["config"]), arrays)
    except FileNotFoundError:
        raise ProductError(f"{path}: no such file") from None
    except (OSError, KeyError, ValueError) as error:
        raise ProductError(f"{path}: damaged ({error}); delete it and run again") from error
