"""Files that are either whole or absent, and data products that describe themselves."""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import json
import os
import re
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from psfdae.errors import Error
from psfdae.version import __version__

if TYPE_CHECKING:
    from astropy.io.fits import HDUList
    from h5py import Dataset, File
    from pandas import DataFrame


class ProductError(Error, RuntimeError):
    """Error of a data product that is missing, damaged, or not what the stage expects."""


@contextmanager
def atomic_path(path: str | Path, digest: bool = True) -> Iterator[Path]:
    """Yield a new, empty file beside `path`; rename it onto `path` if the block succeeds.

    A reader therefore never sees a half-written file, an interrupted stage leaves nothing
    that looks finished, and what has its name is on the disk. Below a folder that holds
    `DIGESTS`, the file's digest is written, too. What a killed writer of the same file has
    left is removed.

    Parameters
    ----------
    path : path-like
        Its folder is made if missing.
    digest : bool
        Whether the file is a product; False for one that changes after it was written.

    Raises
    ------
    OSError
        If the system cannot write; the error names `path`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    sweep_stale(path.parent, _stem(path))
    # The name says which process writes, so that another one can see whether it is dead.
    writer = f"{_machine()}-{os.getpid()}-{_start_ticks(os.getpid())}"
    temporary = path.with_name(f"{_stem(path)}.{writer}-{secrets.token_hex(4)}.tmp")
    os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
    try:
        yield temporary
        _to_disk(temporary)
        if digest and (record := digest_path(path)):
            # First, so that no product stands without its digest.
            with atomic_path(record, digest=False) as noted:
                noted.write_text(digest_line(temporary, record), encoding="utf-8")
        temporary.replace(path)
        _to_disk(path.parent)
    except OSError as error:
        # Libraries leave out which file a full disk has no space for, or name the temporary one.
        is_temporary = error.filename in (temporary, str(temporary))
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        if is_full or is_temporary:
            name = str(path) if error.filename is None or is_temporary else error.filename
            raise OSError(error.errno, os.strerror(error.errno or 0), name) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _stem(path: Path) -> str:
    """Return the start of the names of temporary files of a path."""
    # Of 255 bytes that a name may have; a character takes up to four.
    return f".{path.name[:40]}"


def _to_disk(path: Path) -> None:
    """Wait until a file's content, or a folder's names, would outlive a loss of power."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # File systems that cannot do it for a folder say EINVAL.
        if error.errno != errno.EINVAL:
            raise
    finally:
        os.close(descriptor)


DIGESTS = ".digests"
"""Folder in a folder of results with the SHA-256 of every product, in a file each."""

UNDIGESTED = ("reference",)
"""Folders of results whose files have no digest: the run of record is in git."""


def digest_path(path: Path) -> Path | None:
    """Return the place of the digest of a product, if it lies in a folder with digests."""
    path = Path(os.path.abspath(path))  # noqa: PTH100 - symbolic links are names here
    for root in path.parents:
        if (root / DIGESTS).is_dir():
            parts = path.relative_to(root).parts
            if parts[0] in UNDIGESTED or any(part.startswith(".") for part in parts):
                return None
            return root / DIGESTS / Path(*parts[:-1]) / f"{path.name}.sha256"
    return None


def digest_line(path: Path, record: Path) -> str:
    """Return the line of `sha256sum` for a file, in the folder of results, with digest `record`."""
    parts = record.parts
    place = Path(*parts[len(parts) - parts[::-1].index(DIGESTS) :]).with_suffix("")
    with path.open("rb") as file:
        return f"{hashlib.file_digest(file, 'sha256').hexdigest()}  {place}\n"


@cache
def _machine() -> str:
    """Return a hash of host, its boot and the namespace of processes.

    A process number is unique within these three.
    """
    boot = Path("/proc/sys/kernel/random/boot_id")
    namespace = Path("/proc/self/ns/pid")
    parts = [
        os.uname().nodename,
        boot.read_text() if boot.exists() else secrets.token_hex(16),
        str(namespace.readlink()) if namespace.exists() else "",
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def _start_ticks(pid: int | str) -> str:
    """Return when a process started, in ticks since the boot: its number may be used again."""
    try:
        # The name of the program may hold blanks and brackets.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except OSError:
        return ""


def sweep_stale(folder: Path, stem: str) -> None:
    """Remove temporary files of `atomic_path` whose writer is certainly dead.

    A writer is certainly dead if it ran on this host since its last boot and has ended. Files of
    others are left alone, such as those of another node of a cluster.

    Parameters
    ----------
    folder : Path
        Folder with the temporary files.
    stem : str
        Start of their names.
    """
    for path in _stale(folder, stem):
        path.unlink(missing_ok=True)


def _stale(folder: Path, stem: str) -> Iterator[Path]:
    """Yield the temporary files in a folder whose writer is certainly dead."""
    pattern = re.compile(r"\.([0-9a-f]{12})-([0-9]+)-([0-9]+)-[0-9a-f]{8}\.tmp")
    for entry in os.scandir(folder):
        match = pattern.search(entry.name) if entry.name.startswith(stem) else None
        if match and match[1] == _machine() and _has_ended(int(match[2]), match[3]):
            yield Path(entry.path)


def interrupted(path: Path) -> bool:
    """Return True if a killed writer of a file has left its temporary file.

    Other files of that run may exist already then.
    """
    return path.parent.is_dir() and any(_stale(path.parent, _stem(path)))


def _has_ended(pid: int, start_ticks: str) -> bool:
    """Return True if a process of this machine has certainly ended."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except OSError:
        # The process of another user, which may be hidden from us.
        return False
    return _start_ticks(pid) not in (start_ticks, "")


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_csv(path: str | Path, table: DataFrame, digits: int = 8) -> None:
    """Write a DataFrame as CSV, numbers with so many digits, atomically."""
    write_text(path, table.to_csv(index=False, float_format=f"%.{digits}g"))


def write_columns(
    path: str | Path, columns: Mapping[str, Iterable[object]], digits: int = 8
) -> None:
    """Write columns of equal length as CSV, numbers with so many digits, NaN as nothing."""

    def cell(value: object) -> object:
        if not isinstance(value, float | np.floating):
            return value
        return "" if np.isnan(value) else f"{value:.{digits}g}"

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(map(cell, row) for row in zip(*columns.values(), strict=True))
    write_text(path, text.getvalue())


def write_parquet(path: str | Path, table: DataFrame) -> None:
    """Write a DataFrame as Parquet with checksums, atomically."""
    with atomic_path(path) as temporary:
        table.to_parquet(temporary, index=False, write_page_checksum=True)


def as_csv(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows with equal keys as CSV, the numbers with all digits."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_yaml(tree: Mapping[str, Any]) -> str:
    """Return a resolved configuration as YAML, keys sorted."""
    import yaml

    return str(yaml.safe_dump(tree, sort_keys=True))


def write_fits(path: str | Path, hdus: HDUList) -> None:
    """Write an astropy `HDUList` atomically."""
    content = io.BytesIO()
    hdus.writeto(content, output_verify="exception")
    # Not by astropy, which hides the error of a full disk.
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.getbuffer())


@dataclass(frozen=True)
class Column:
    """Array of a product with its unit and a line of explanation."""

    values: np.ndarray
    unit: str
    about: str


@dataclass(frozen=True)
class Empty:
    """Column that is created at its full length and filled slice by slice."""

    shape: tuple[int, ...]
    dtype: type | np.dtype
    unit: str
    about: str


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
    columns : mapping of str to Column
        Arrays by name.
    config : mapping
        Resolved configuration of the stage.
    """
    import h5py

    # In memory, because HDF5 crashes where a full disk keeps it from closing a file.
    # A name of its own, because HDF5 opens no file twice.
    with h5py.File(secrets.token_hex(16), "w", driver="core", backing_store=False) as file:
        _create_datasets(file, kind, columns, config, lambda column: id(column.values))
        file.flush()
        content = file.id.get_file_image()
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def stream_product(
    path: str | Path, kind: str, columns: Mapping[str, Column | Empty], config: Mapping[str, Any]
) -> Iterator[Mapping[str, Dataset]]:
    """Write a product piece by piece, so that it never has to fit into memory.

    Yields the HDF5 datasets by name; the block fills those of the `Empty`
    columns, best in the order of their rows: `data["psf"][start:stop] = …`. The
    file is that of `write_product` but for the shape of the chunks, and appears
    under its name only when the block has succeeded. An `Empty` that is the very
    object of an earlier one is stored as a link. The space that it takes is reserved
    before anything is written.

    Parameters are those of `write_product`.

    Raises
    ------
    ProductError
        If the block has left a chunk of a column unwritten.
    OSError
        If the disk has too little space.
    """
    with atomic_path(path) as temporary, _reserved(temporary, columns) as file:
        names = _create_datasets(file, kind, columns, config, id)
        yield {name: file[name] for name in columns}
        file.flush()
        # HDF5 creates the chunks of an array when they are written.
        for name in names:
            data = file[name]
            filled_rows = data.id.get_num_chunks() * data.chunks[0]
            if isinstance(columns[name], Empty) and filled_rows < data.shape[0]:
                raise ProductError(f"{path}: array {name!r} was not filled to its end")


@contextmanager
def _reserved(path: Path, columns: Mapping[str, Column | Empty]) -> Iterator[File]:
    """Yield a new HDF5 file whose space on the disk is reserved.

    HDF5 crashes if a full disk keeps it from closing a file.
    """
    import h5py

    max_bytes = sum(_max_bytes(column) for column in columns.values()) + 2**20
    with path.open("wb") as space:
        # HDF5 truncates the file when it opens it. Reserve the space before, too, to fail while
        # that is safe.
        _reserve(space, max_bytes)
        with h5py.File(path, "w") as file:
            _reserve(space, max_bytes)
            yield file
            file.flush()
            size = file.id.get_filesize()
        space.truncate(size)


def _reserve(file: IO[bytes], size: int) -> None:
    """Reserve space on the disk for a file, in bytes, where the file system can."""
    try:
        os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):
            raise


def _max_bytes(column: Column | Empty) -> int:
    """Return an upper limit of what HDF5 stores of a column, with the table of its chunks."""
    if isinstance(column, Column):
        # Chunks at the border are whole; h5py gives them at least half of an axis' length.
        return (int(column.values.nbytes) << column.values.ndim) + 2**17
    rows = _storage(column)["chunks"][0]
    count = -(-column.shape[0] // rows)
    row_bytes = int(np.prod(column.shape[1:], dtype=int)) * np.dtype(column.dtype).itemsize
    return int(count * (rows * row_bytes + 256)) + 2**17


def _storage(column: Column | Empty) -> dict[str, Any]:
    """Return the arguments with which h5py creates the dataset of a streamed column."""
    if isinstance(column, Column):
        return {"data": column.values, "chunks": True}
    dtype = np.dtype(column.dtype)
    row_bytes = int(np.prod(column.shape[1:], dtype=int)) * dtype.itemsize
    rows = max(1, min(column.shape[0], 2**18 // row_bytes))  # chunks of whole rows, 256 KiB
    return {"shape": column.shape, "dtype": dtype, "chunks": (rows, *column.shape[1:])}


def _create_datasets(
    file: File,
    kind: str,
    columns: Mapping[str, Any],
    config: Mapping[str, Any],
    identity: Callable[[Any], int],
) -> list[str]:
    """Write the attributes of a product, and create a dataset for each of its columns.

    A column with the `identity` of an earlier one becomes a link to it.

    Returns
    -------
    list of str
        Names of the columns that are no links.
    """
    import h5py

    file.attrs["kind"] = kind
    file.attrs["psfdae_version"] = __version__
    file.attrs["config"] = json.dumps(config, sort_keys=True)
    names: dict[int, str] = {}
    for name, column in columns.items():
        if identity(column) in names:
            file[name] = h5py.SoftLink(f"/{names[identity(column)]}")
            continue
        names[identity(column)] = name
        data = file.create_dataset(name, fletcher32=True, **_storage(column))
        data.attrs["unit"] = column.unit
        data.attrs["about"] = column.about
    return list(names.values())


@dataclass(frozen=True)
class Product:
    """Data product: its configuration, and its arrays, each read when it is first used.

    `kind` is that of `read_product`; "" for a product that is in memory as a whole, of which
    `path` is only a name.
    """

    path: Path
    config: dict[str, Any]
    arrays: dict[str, np.ndarray]
    kind: str = ""

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.arrays and self.kind:
            self.arrays.update(read_product(self.path, self.kind, (name,)).arrays)
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
            file_kind = file.attrs.get("kind")
            if file_kind != kind:
                raise ProductError(f"{path}: a product of kind {file_kind!r}, expected {kind!r}")
            names = tuple(file) if names is None else names
            missing = [name for name in names if name not in file]
            if missing:
                raise ProductError(f"{path}: array {missing[0]!r} is missing")
            arrays = {name: file[name][()] for name in names}
            return Product(path, json.loads(file.attrs["config"]), arrays, kind)
    except FileNotFoundError:
        raise ProductError(f"{path}: no such file") from None
    except (OSError, KeyError, ValueError) as error:
        raise ProductError(f"{path}: damaged ({error}); delete it and run again") from error


class OutputError(Error, ValueError):
    """Output that would replace one of the inputs."""


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[object]) -> None:
    """Refuse outputs that are inputs, too.

    Inputs that are no paths, such as arrays, and outputs that are None are passed over.

    Raises
    ------
    OutputError
        For the first output that is an input.
    """
    input_paths = {Path(name).resolve() for name in inputs if isinstance(name, str | Path)}
    for out in outputs:
        if out is not None and out.resolve() in input_paths:
            raise OutputError(f"{out}: is an input, too; choose another name")
