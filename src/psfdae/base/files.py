"""Files that are either complete or absent, and data products that describe themselves.

`write_text`, `write_csv`, `write_fits` and others write tables, texts and images. A product is an
HDF5 file with arrays, their units and the configuration that made them: `write_product` and
`stream_product` write it, `read_product` reads it.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import platform
import secrets
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.base.errors import Error, no_such_file, require_file
from psfdae.base.types import DataFrame, Dataset, File, HDUList
from psfdae.base.version import __version__


class ProductError(Error, RuntimeError):
    """Error of a data product that is missing, damaged, or not the product that is expected."""


class OutputError(Error, ValueError):
    """Output that would replace one of the inputs, or a device."""


def temporary_name(name: str) -> str:
    """Return a new name, .NAME.HOST-PROCESS-RANDOM.tmp, which `find_left_over` looks for."""
    # A name has at most 255 bytes, and a character up to four of them.
    host = zlib.crc32(platform.node().encode())
    return f".{name[:40]}.{host:08x}-{os.getpid()}-{secrets.token_hex(4)}.tmp"


def find_left_over(folder: Path, name: str) -> list[Path]:
    """Return the files of a `temporary_name` whose process was killed.

    Parameters
    ----------
    folder : Path
        Folder in which they are.
    name : str
        Argument of `temporary_name`. Files of processes that run, or of other hosts, are left out.
    """
    # All but the number of the process and the random digits is the same.
    start = temporary_name(name).rsplit("-", 2)[0]
    left_over = []
    for path in folder.glob(f"{escape(start)}-*-????????.tmp"):
        try:
            os.kill(int(path.name.split("-")[-2]), 0)  # signal 0 only asks whether it exists
        except (ProcessLookupError, OverflowError):
            left_over.append(path)
        except (PermissionError, ValueError):  # a process of another user, or another name
            continue
    return left_over


def resolve_output(path: Path) -> Path:
    """Return the file that an output replaces or creates; symbolic links are followed.

    Raises
    ------
    OutputError
        If `path` exists and is not a regular file: a device, a pipe, a folder, or a symbolic link
        in a circle.
    """
    path = Path(os.path.realpath(path))
    if os.path.lexists(path) and not path.is_file():
        kind = "folder" if path.is_dir() else "device, a pipe or a circle of links"
        raise OutputError(f"{path}: is a {kind}, not a file; choose another name")
    return path


_pending_renames: ContextVar[list[tuple[Path, Path]] | None] = ContextVar("pending", default=None)
"""Whole temporary files and their paths inside `rename_together`; None outside of it."""


@contextmanager
def rename_together(main: Path) -> Iterator[None]:
    """Give the files of a block their names at its end, `main` last; if it fails, write none.

    A command writes several outputs inside it. If `main` exists, all outputs are complete. If the
    process is killed between two renames, the temporary file of `main` is left. `is_cut_off` finds
    it, so that the same command may replace the other outputs.

    Parameters
    ----------
    main : Path
        The output whose existence means that everything is done.
    """
    main, renames = resolve_output(main), list[tuple[Path, Path]]()
    token = _pending_renames.set(renames)
    try:
        yield
        # The content of each file is on the disk already: renames need no space. Ctrl-C comes after
        # them, so that new files never lie beside earlier ones.
        pending, interrupt = sorted(renames, key=lambda pair: pair[1] == main), None
        while pending:
            try:
                temporary, path = pending[0]
                if temporary.exists():  # else it was renamed just before the interrupt
                    temporary.replace(path)
                del pending[0]
            except KeyboardInterrupt as error:
                interrupt = error
        if interrupt is not None:
            raise interrupt
    finally:
        _pending_renames.reset(token)
        for temporary, _ in renames:
            temporary.unlink(missing_ok=True)


def is_cut_off(main: Path) -> bool:
    """Return whether a command was killed before its outputs had their names, `main` the last."""
    # Names as `temporary_name` makes them, of any process.
    main = resolve_output(main)
    return not main.exists() and any(main.parent.glob(f".{escape(main.name[:40])}.*.tmp"))


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a new, empty file next to `path`; rename it to `path` if the block succeeds.

    A reader therefore never sees an incomplete file, and an interrupted stage leaves no file that
    looks complete. A file that is replaced keeps its permissions, and a symbolic link to it
    stays. A writer that is killed leaves its temporary file, which the next writer of `path`
    removes.

    Parameters
    ----------
    path : path-like
        Its folder is made if missing.

    Yields
    ------
    Path
        The temporary file.

    Raises
    ------
    OSError
        If the system cannot write; the error names `path`.
    OutputError
        If `path` is a device, a pipe or a folder.
    """
    path = resolve_output(Path(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    for left_over in find_left_over(path.parent, path.name):
        left_over.unlink(missing_ok=True)
    temporary = path.with_name(temporary_name(path.name))
    # Permissions of the file that is replaced; a new one follows the user's mask.
    mode = path.stat().st_mode if path.exists() else None
    try:
        # Nobody else reads the content before it has its permissions.
        temporary.touch(0o666 if mode is None else 0o600, exist_ok=False)
        yield temporary
        # Some file systems have the same permissions for all files, and refuse a change.
        if mode not in (None, temporary.stat().st_mode):
            temporary.chmod(mode)
        # The content is on the disk before the rename, in case the power fails in between.
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        if (renames := _pending_renames.get()) is None:
            temporary.replace(path)
        else:
            renames.append((temporary, path))
    except OSError as error:
        # If the disk is full, libraries name the temporary file, or none.
        if error.errno is not None and error.filename in (None, temporary, str(temporary)):
            error.filename = str(path)
        raise
    finally:
        if (temporary, path) not in (_pending_renames.get() or ()):
            temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    write_bytes(path, text.encode())


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def no_formula(cell: Any) -> Any:
    """Return a text with an apostrophe before it if a spreadsheet would execute it.

    Spreadsheets execute cells that begin with = + - @, a tab or a carriage return. Numbers such as
    -1.5, also as texts, are unchanged. A carriage return, which would end the row, becomes a blank.
    """
    if not isinstance(cell, str):
        return cell
    cell = cell.replace("\r", " ") if "\r" in cell else cell
    if not cell.startswith(("=", "+", "-", "@", "\t")):
        return cell
    try:
        float(cell)  # numbers stay
    except ValueError:
        return "'" + cell
    return cell


def strip_apostrophe(cell: Any) -> Any:
    """Undo `no_formula`: return its argument; cells without such an apostrophe are unchanged."""
    is_changed = isinstance(cell, str) and cell[:1] == "'" and no_formula(cell[1:]) == cell
    return cell[1:] if is_changed else cell


def map_texts(table: DataFrame, change: Callable[[Any], Any]) -> DataFrame:
    """Return the table with a function applied to its texts and the names of its columns."""
    table = table.copy(deep=False)
    for name in [name for name in table if table[name].dtype.kind == "O"]:
        values = table[name].tolist()
        new_values = [*map(change, values)]
        # A column without changes keeps its type.
        if any(new is not old for new, old in zip(new_values, values, strict=True)):
            table[name] = new_values
    return table.rename(columns=change)


def write_csv(path: str | Path, table: DataFrame, digits: int = 8) -> None:
    """Write a DataFrame as CSV, atomically; numbers have `digits` significant digits.

    No text is a formula for a spreadsheet; `psfdae.base.reading.read_table` undoes this.
    """
    table = map_texts(table, no_formula)
    write_text(path, table.to_csv(index=False, float_format=f"%.{digits}g"))


def write_columns(
    path: str | Path, columns: Mapping[str, Iterable[object]], digits: int = 8
) -> None:
    """Write columns of equal length as CSV, atomically.

    Parameters
    ----------
    path : path-like
        The file to write; replaced atomically.
    columns : mapping of str to iterable
        Values by the name of the column.
    digits : int
        Significant digits of numbers; NaN is an empty cell.
    """

    def cell(value: object) -> object:
        if not isinstance(value, float | np.floating):
            return value
        return "" if np.isnan(value) else f"{value:.{digits}g}"

    # One row after the other, below the row of the names.
    rows = (map(cell, row) for row in zip(*columns.values(), strict=True))
    write_text(path, _csv_text([columns, *rows]))


def write_parquet(path: str | Path, table: DataFrame) -> None:
    """Write a DataFrame as Parquet with checksums, atomically."""
    # pyarrow writes pages one after the other, each with a checksum.
    with atomic_path(path) as temporary:
        table.to_parquet(temporary, index=False, write_page_checksum=True)


def as_csv(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows with equal keys as CSV, numbers with all digits, texts by `no_formula`."""
    # The first row gives the names and the order of the columns.
    names = [*rows[0]] if rows else []
    return _csv_text([names, *([row[name] for name in names] for row in rows)])


def _csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Return rows of cells as CSV, the first of them the names of the columns."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(no_formula, row) for row in rows)
    return text.getvalue()


def as_yaml(tree: Mapping[str, Any]) -> str:
    """Return a resolved configuration as YAML, keys sorted."""
    import yaml

    return str(yaml.safe_dump(tree, sort_keys=True))


def write_fits(path: str | Path, hdus: HDUList) -> None:
    """Write an astropy `HDUList` atomically."""
    content = io.BytesIO()
    hdus.writeto(content, output_verify="exception")
    # astropy itself would hide the error of a full disk.
    write_bytes(path, content.getvalue())


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
    config gives the same bytes. Columns with the same array share it by links.

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
    with stream_product(path, kind, columns, config):
        pass


@contextmanager
def stream_product(
    path: str | Path, kind: str, columns: Mapping[str, Column | Empty], config: Mapping[str, Any]
) -> Iterator[Mapping[str, Dataset]]:
    """Write a product piece by piece, so that it never has to fit into memory.

    The block fills the arrays of the `Empty` columns, best in the order of their rows:
    `data["psf"][start:stop] = …`. The file differs from one by `write_product` only in the shape
    of its chunks, and appears under its name only when the block has succeeded.

    Parameters
    ----------
    path, kind, columns, config
        As for `write_product`. An `Empty` that is the same object as an earlier one is a link.

    Yields
    ------
    mapping of str to h5py.Dataset
        Arrays by name.

    Raises
    ------
    ProductError
        If the block has left a chunk of a column unwritten.
    OSError
        If the disk has too little space.
    """
    import h5py

    with atomic_path(path) as temporary, _SafeFile(temporary) as disk, h5py.File(disk, "w") as file:
        # Description of the file, without the time of writing: equal products are equal bytes.
        file.attrs["kind"] = kind
        file.attrs["psfdae_version"] = __version__
        file.attrs["config"] = json.dumps(config, sort_keys=True)
        names = _create_datasets(file, columns)
        yield {name: file[name] for name in columns}
        # An error of the disk is raised here, before the file is renamed.
        file.flush()
        # HDF5 creates the chunks of an array when they are written.
        for name in names:
            data = file[name]
            filled_rows = data.id.get_num_chunks() * data.chunks[0]
            if isinstance(columns[name], Empty) and filled_rows < data.shape[0]:
                raise ProductError(f"{path}: array {name!r} was not filled to its end")


class _SafeFile(io.FileIO):
    """File for HDF5 to write to, which raises an error of the disk when it is closed.

    HDF5 2.0 ends the process by a segmentation fault if it cannot write its buffers. Therefore
    the error is hidden from HDF5, and everything that it writes afterwards is dropped.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self.error: OSError | None = None

    def write(self, content: Any) -> int:
        """Write all bytes, or none after an error."""
        unwritten = memoryview(content).cast("B")
        size = len(unwritten)
        # The system may write fewer bytes than requested, for example just before an error.
        while self.error is None and unwritten:
            unwritten = unwritten[self._call(super().write, unwritten) :]
        return size

    def truncate(self, size: int | None = None) -> int:
        """Change the size of the file, or do nothing after an error."""
        return self._call(super().truncate, size)

    def _call(self, change: Callable[[Any], int], value: Any) -> int:
        """Call a method of the file and return its result; keep an error, and return 0 then."""
        try:
            return change(value) if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0

    def __exit__(self, *details: object) -> None:
        """Close the file; raise its first error in place of HDF5's, which follow from it."""
        super().__exit__(*details)  # type: ignore[arg-type]
        if self.error is not None:
            raise self.error


def _create_datasets(file: File, columns: Mapping[str, Column | Empty]) -> list[str]:
    """Create a dataset for each array of a product.

    Returns
    -------
    list of str
        Names of the columns that are not links to others.
    """
    import h5py

    # The first name of each array; further names of the same array become links to it.
    names: dict[int, str] = {}
    for name, column in columns.items():
        array = column.values if isinstance(column, Column) else column
        first = names.setdefault(id(array), name)
        if first != name:
            file[name] = h5py.SoftLink(f"/{first}")
            continue
        if isinstance(column, Column):
            # h5py chooses chunks; checksums need them.
            storage = {"data": column.values, "chunks": True}
        else:
            # Chunks of whole rows, 256 KiB, because rows are written in their order.
            dtype = np.dtype(column.dtype)
            row_bytes = int(np.prod(column.shape[1:], dtype=int)) * dtype.itemsize
            chunk_rows = max(1, min(column.shape[0], 2**18 // row_bytes))
            chunks = (chunk_rows, *column.shape[1:])
            storage = {"shape": column.shape, "dtype": dtype, "chunks": chunks}
        data = file.create_dataset(name, fletcher32=True, **storage)
        data.attrs["unit"] = column.unit
        data.attrs["about"] = column.about
    return list(names.values())


@dataclass(frozen=True)
class Product:
    """Data product: its configuration and its arrays, each read when it is first used.

    Attributes
    ----------
    path : Path
        The file; for a product that is entirely in memory, only a name for messages.
    config : dict
        Resolved configuration of the stage that wrote it.
    arrays : dict of str to ndarray
        Arrays that have been read.
    kind : str
        Product type, as for `read_product`; "" for a product that is entirely in memory.
    """

    path: Path
    config: dict[str, Any]
    arrays: dict[str, np.ndarray]
    kind: str = ""

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the array of a name, which is read from the file if it is not in memory."""
        # A large product is read array by array, when they are used.
        if name not in self.arrays and self.kind:
            self.arrays.update(read_product(self.path, self.kind, (name,)).arrays)
        return self.arrays[name]


def read_product(path: str | Path, kind: str, names: tuple[str, ...] | None = None) -> Product:
    """Read a data product, or only some of its arrays.

    Parameters
    ----------
    path : path-like
        The HDF5 file.
    kind : str
        Product type that the file must have.
    names : tuple of str, optional
        Arrays to read now; all by default. Others are read when they are used.

    Raises
    ------
    ProductError
        If the file is missing, damaged, of another kind or lacks an array; the
        message names the file and says what to do.
    """
    import h5py

    # Reading a damaged chunk raises OSError, because its checksum is wrong.
    path = Path(path)
    require_file(path)
    try:
        with h5py.File(path, "r") as file:
            # The kind is checked before any array is read.
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
        raise ProductError(no_such_file(path)) from None
    except (OSError, KeyError, ValueError) as error:
        raise ProductError(f"{path}: damaged ({error}); delete it and run again") from error


def compute_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits."""
    # The file is read in blocks: products may be larger than the memory.
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[object]) -> None:
    """Raise an error if an output is also an input, or exists and is not a regular file.

    Parameters
    ----------
    outputs : iterable of Path or None
        Files to write; None is skipped.
    inputs : iterable
        Files to read; inputs that are not paths, such as arrays, are skipped.

    Raises
    ------
    OutputError
        For the first output that is an input, a device, a pipe or a folder.
    """
    # Links and relative names are resolved, because two names may be the same file.
    input_paths = {Path(os.path.realpath(name)) for name in inputs if isinstance(name, str | Path)}
    for out in outputs:
        if out is not None and resolve_output(out) in input_paths:
            raise OutputError(f"{out}: is an input, too; choose another name")
