"""Star catalogues: FITS tables (also FITS_LDAC), CSV and other text tables, ECSV, SExtractor."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.observations.columns import (
    ID_COLUMNS,
    ColumnError,
    Pair,
    PositionColumns,
    accepted,
    choose_positions,
    resolve,
)
from psfdae.observations.errors import ObservationError, reading, shorten
from psfdae.observations.unpacking import UNPACK, PlainFile, open_hdus, plain_file

SEXTRACTOR_HEADER = re.compile(r"#\s*(\d+)\s+[A-Za-z_]\w*")
SEXAGESIMAL = re.compile(r"[:hd\s]", re.IGNORECASE)

MOST_STARS = 5_000_000
MOST_COLUMNS = 2000
"""Rows and columns of a catalogue."""

LARGEST_TEXT = 2**26
"""Bytes of a text table; reading takes some ten times as much memory."""

LARGEST_ECSV_HEADER = 2**18
"""Characters of an ECSV header, which is YAML and slow to read."""

WIDEST = 2**27
"""Characters of all rows of a text table, each as wide as its columns' widest cells.

numpy keeps text in columns as wide as their longest cell, four bytes a character:
one long cell makes every row as long.
"""

LONGEST_IDENTIFIER = 200
"""Characters; each row of the prediction is as long as the longest."""

ROWS = 10_000
"""Rows of a text table that are measured at a time."""


@dataclass(frozen=True)
class _FitsTable:
    """Columns of a FITS table, each read when it is asked for: the others may be large."""

    file: PlainFile
    index: int
    colnames: list[str]
    rows: int

    def __len__(self) -> int:
        return self.rows

    def __getitem__(self, name: str) -> Any:
        from astropy.table import Column, MaskedColumn
        from astropy.units import Unit

        with reading(self.file.name), open_hdus(self.file, memmap=True) as hdus:
            hdu, place = hdus[self.index], self.colnames.index(name)
            column = hdu.columns[place]
            # Arrays of variable length may all be the same bytes of the file: 3 MB unfold to 1 TB.
            if re.match(r"\d*[PQ]", str(column.format)):
                raise ObservationError(self.file.name, f"column {name!r} holds arrays, not numbers")
            values = hdu.data.field(place)
            unit = column.unit and Unit(column.unit, format="fits", parse_strict="silent")
            if column.null is None:
                return Column(values, name, unit=unit, copy=True)
            return MaskedColumn(values, name, mask=values == column.null, unit=unit, copy=True)


@dataclass(frozen=True)
class Catalogue:
    """A table of stars; rows keep their order, none is left out."""

    path: Path
    table: Any

    def __len__(self) -> int:
        return len(self.table)

    def numbers(self, name: str) -> np.ndarray:
        """A column as float64, shape (n,); NaN where the catalogue has no value.

        Raises
        ------
        ObservationError
            If there is no such column, or it holds anything but real numbers.
        """
        column = self._column(name)
        if column.ndim != 1:
            raise ObservationError(self.path, f"column {name!r} holds arrays, not numbers")
        missing = np.ma.getmaskarray(column) if np.ma.isMaskedArray(column) else None
        values = np.asarray(np.ma.getdata(column))
        if values.dtype.kind in "iuf":
            numbers = values.astype(np.float64)
        elif values.dtype.kind in "SUO":
            numbers = self._parsed(name, values, missing)
        else:
            raise ObservationError(self.path, f"column {name!r} does not hold numbers")
        if missing is not None:
            numbers[missing] = np.nan
        return numbers

    def finite(self, name: str) -> np.ndarray:
        """As `numbers`, and an error where a value is missing or not finite."""
        numbers = self.numbers(name)
        bad = np.flatnonzero(~np.isfinite(numbers))
        if len(bad):
            raise ObservationError(
                self.path,
                f"column {name!r} has no finite number in {len(bad)} of {len(numbers)} rows, "
                f"the first is row {bad[0] + 1}",
            )
        return numbers

    def position_columns(self, columns: Pair | None) -> PositionColumns:
        """The columns with the positions, chosen as `psfdae.observations.columns` says."""
        try:
            return choose_positions(self.table.colnames, columns)
        except ColumnError as error:
            raise ObservationError(
                self.path,
                f"{error}; found {shorten(self.table.colnames)}; accepted {accepted()}",
            ) from None

    def sky(self, where: PositionColumns) -> tuple[np.ndarray, np.ndarray]:
        """Right ascension and declination in degrees, each shape (n,).

        Columns without unit are in degrees; text with colons, blanks or letters is
        sexagesimal, then right ascensions are in hours.
        """
        ra = self._angles(where.first, "hourangle")
        dec = self._angles(where.second, "deg")
        off = np.flatnonzero(np.abs(dec) > 90)
        if len(off):
            raise ObservationError(
                self.path,
                f"column {where.second!r} is {dec[off[0]]:g}° in row {off[0] + 1}, "
                "expected -90 … 90",
            )
        return ra, dec

    def identifiers(self) -> np.ndarray:
        """One identifier per star, int64 or str, shape (n,); row numbers from 0 without any."""
        for alias in ID_COLUMNS:
            try:
                name = resolve(self.table.colnames, alias)
            except ColumnError:
                continue
            if name is None:
                continue
            column = self._column(name)
            if column.ndim == 1:
                return self._short(name, _as_identifiers(column))
        return np.arange(len(self), dtype=np.int64)

    def _short(self, name: str, found: np.ndarray) -> np.ndarray:
        if found.dtype.kind == "U" and found.dtype.itemsize > 4 * LONGEST_IDENTIFIER:
            lengths = np.char.str_len(found)
            row = lengths.argmax()
            raise ObservationError(
                self.path,
                f"column {name!r} has {lengths[row]} characters in row {row + 1}, "
                f"an identifier may have {LONGEST_IDENTIFIER}",
            )
        return found

    def _column(self, name: str) -> Any:
        try:
            found = resolve(self.table.colnames, name)
        except ColumnError as error:
            raise ObservationError(self.path, str(error)) from None
        if found is None:
            raise ObservationError(
                self.path, f"no column {name!r}; found {shorten(self.table.colnames)}"
            )
        column = self.table[found]
        if not isinstance(column, np.ndarray):
            raise ObservationError(self.path, f"column {name!r} does not hold plain numbers")
        return column

    def _parsed(self, name: str, values: np.ndarray, missing: np.ndarray | None) -> np.ndarray:
        numbers = np.full(len(values), np.nan)
        for row, value in enumerate(values):
            if missing is not None and missing[row]:
                continue
            try:
                numbers[row] = float(_text(value))
            except ValueError:
                raise ObservationError(
                    self.path,
                    f"column {name!r} holds {_text(value)[:40]!r} in row {row + 1}, "
                    "expected a number",
                ) from None
        return numbers

    def _angles(self, name: str, sexagesimal_unit: str) -> np.ndarray:
        from astropy.coordinates import Angle

        column = self._column(name)
        values = np.asarray(np.ma.getdata(column))
        is_text = values.dtype.kind in "SUO"
        if is_text and column.ndim == 1 and not np.ma.getmaskarray(column).any():
            texts = [_text(value).strip() for value in values]
            if any(SEXAGESIMAL.search(text) for text in texts):
                with reading(self.path):
                    return np.asarray(Angle(texts, unit=sexagesimal_unit).deg, dtype=np.float64)
        numbers = self.finite(name)
        unit = getattr(column, "unit", None)
        if unit is None or is_text:
            return numbers
        return numbers * self._degrees(name, unit)

    def _degrees(self, name: str, unit: Any) -> float:
        from astropy import units

        try:
            return float(units.Unit(unit).to("deg"))
        except (units.UnitConversionError, TypeError, ValueError):
            raise ObservationError(
                self.path, f"column {name!r} has the unit {str(unit)!r}, expected an angle"
            ) from None


def read_catalogue(path: str | Path) -> Catalogue:
    """Read a star catalogue.

    The format is told from the content: a FITS file, of which the LDAC_OBJECTS or
    the only table is taken; ECSV; the ASCII_HEAD format of SExtractor; or a text
    table with a line of column names, separated by commas, semicolons, tabs or
    blanks. Lines that begin with # are comments.

    Raises
    ------
    ObservationError
        If the file is none of these, damaged, or has no rows.
    """
    path = Path(path)
    with reading(path), path.open("rb") as file:
        start = file.read(16)
        fits = start.startswith((b"SIMPLE  =", *UNPACK))
        lines = [] if fits else _lines(path, start + file.read(LARGEST_TEXT))
    table = _fits_table(path) if fits else _text_table(path, lines)
    if len(table) == 0:
        raise ObservationError(path, "the catalogue has no stars")
    return Catalogue(path, table)


def _fits_table(path: Path) -> _FitsTable:
    from astropy.io import fits

    file = plain_file(path)
    with reading(path), open_hdus(file, memmap=True) as hdus:
        tables = [
            hdu
            for hdu in hdus
            if isinstance(hdu, fits.BinTableHDU | fits.TableHDU) and hdu.name != "LDAC_IMHEAD"
        ]
        objects = [hdu for hdu in tables if hdu.name == "LDAC_OBJECTS"] or tables
        if len(objects) != 1:
            names = shorten([hdu.name or "(no name)" for hdu in objects])
            raise ObservationError(path, f"expected one table of stars, found {names}")
        rows = int(objects[0].header["NAXIS2"])
        size = objects[0].header["NAXIS1"] * rows
        if objects[0].fileinfo()["datLoc"] + size > file.path.stat().st_size:
            raise ObservationError(path, "damaged: the table is larger than the file")
        # A damaged table has columns without a name, or of the same one.
        names = [str(name or f"col{k}") for k, name in enumerate(objects[0].columns.names, 1)]
        _check_size(path, rows, len(names))
        return _FitsTable(file, hdus.index(objects[0]), names, rows)


def _check_size(path: Path, rows: int, columns: int) -> None:
    for what, found, most in (("stars", rows, MOST_STARS), ("columns", columns, MOST_COLUMNS)):
        if found > most:
            raise ObservationError(path, f"{found} {what} in a catalogue, at most {most}")


def _lines(path: Path, content: bytes) -> list[str]:
    """Lines of a text file that are not blank."""
    if not content.strip():
        raise ObservationError(path, "the catalogue is empty")
    if len(content) > LARGEST_TEXT:
        raise ObservationError(
            path, f"a text table of more than {LARGEST_TEXT} bytes; a FITS table may be larger"
        )
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ObservationError(path, "neither a FITS table nor text in UTF-8") from None
    if "\x00" in text:
        raise ObservationError(path, "neither a FITS table nor text")
    return [line for line in text.splitlines() if line.strip()]


def _text_table(path: Path, lines: list[str]) -> Any:
    """Table of the lines, which are gone then: they take twice the memory of the file."""
    from astropy.io import ascii as text_tables

    if lines[0].startswith("# %ECSV"):
        kind: dict[str, Any] = {"format": "ecsv"}
        rows = _without_comments(lines)
        if sum(map(len, lines)) - sum(map(len, rows)) > LARGEST_ECSV_HEADER:
            raise ObservationError(
                path, f"an ECSV header of more than {LARGEST_ECSV_HEADER} characters"
            )
    elif SEXTRACTOR_HEADER.match(lines[0]):
        kind = {"format": "sextractor"}
        rows = _without_comments(lines)
        numbered = filter(None, map(SEXTRACTOR_HEADER.match, lines))
        _check_size(path, 0, max(int(found[1][:9]) for found in numbered))
    else:
        rows = _without_comments(lines)
        lines[:] = rows
        kind = {"format": "basic", "delimiter": _delimiter(rows)}
    if not rows:
        raise ObservationError(path, "the catalogue has no stars")
    # astropy looks for the end of the quotation through the whole file, many times.
    if rows[0].count('"') % 2:
        raise ObservationError(path, "not a text table (a quote without an end in its header)")
    _check_widths(path, rows)
    # The line break at the end is what tells a table from the name of a file.
    text = "\n".join(lines) + "\n"
    lines.clear()
    rows.clear()
    with reading(path):
        return text_tables.read(text, guess=False, **kind)


def _delimiter(rows: list[str]) -> str:
    return next((c for c in ",;\t" if c in rows[0]), " ") if rows else ","


def _check_widths(path: Path, rows: list[str]) -> None:
    """Refuse a table of which numpy would make far more than it is; see `WIDEST`."""
    delimiter = _delimiter(rows)
    columns = len(rows[0].split(None if delimiter == " " else delimiter))
    _check_size(path, len(rows), columns)
    widest = [0] * columns
    for start in range(0, len(rows), ROWS):
        part = rows[start : start + ROWS]
        split = map(str.split, part) if delimiter == " " else csv.reader(part, delimiter=delimiter)
        try:
            cells = list(split)
        except csv.Error as error:
            raise ObservationError(path, f"not a text table ({error})") from None
        if all(len(row) == columns for row in cells):
            found = [max(map(len, column)) for column in zip(*cells, strict=True)]
        else:
            # Quoted otherwise than we think, or no table at all.
            found = [max(map(len, part))] * columns
        widest = list(map(max, widest, found))
    if len(rows) * sum(widest) > WIDEST:
        column = max(range(columns), key=widest.__getitem__)
        raise ObservationError(
            path,
            f"column {column + 1} is {widest[column]} characters wide; {len(rows)} rows may have "
            f"{WIDEST // len(rows)} characters in all columns",
        )


def _without_comments(lines: list[str]) -> list[str]:
    """Lines of the table; a comment right before numbers without a header is the header."""
    table = [line for line in lines if not line.lstrip().startswith("#")]
    if not table:
        return []
    before = lines[: lines.index(table[0])]
    if before and not any(c.isalpha() for c in table[0].replace("e", "").replace("E", "")):
        return [before[-1].lstrip("# \t"), *table]
    return table


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _as_identifiers(column: Any) -> np.ndarray:
    values, missing = np.ma.getdata(column), np.ma.getmaskarray(column)
    if values.dtype.kind in "iu" and not missing.any():
        within = values.dtype.kind == "i" or values.max() <= np.iinfo(np.int64).max
        if within:
            return values.astype(np.int64)
    if values.dtype.kind == "f" and not missing.any():
        with np.errstate(all="ignore"):
            whole = values.astype(np.int64)
        if np.array_equal(whole.astype(values.dtype), values):
            return whole
    texts = [
        "" if gone else _text(v).strip() for v, gone in zip(values.tolist(), missing, strict=True)
    ]
    return np.array(texts, dtype=str)
