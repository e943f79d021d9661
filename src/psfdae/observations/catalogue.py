"""Star catalogues: FITS tables (also FITS_LDAC), CSV and other text tables, ECSV, SExtractor."""

from __future__ import annotations

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

SEXTRACTOR_HEADER = re.compile(r"#\s*\d+\s+[A-Za-z_]\w*")
SEXAGESIMAL = re.compile(r"[:hd\s]", re.IGNORECASE)


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
            if name is not None and self._column(name).ndim == 1:
                return _as_identifiers(self._column(name))
        return np.arange(len(self), dtype=np.int64)

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
    with reading(path):
        content = path.read_bytes()
    if not content.strip():
        raise ObservationError(path, "the catalogue is empty")
    if content.startswith((b"SIMPLE  =", b"\x1f\x8b")):
        table = _fits_table(path)
    else:
        table = _text_table(path, content)
    if len(table) == 0:
        raise ObservationError(path, "the catalogue has no stars")
    return Catalogue(path, table)


def _fits_table(path: Path) -> Any:
    from astropy.io import fits
    from astropy.table import Table

    with reading(path), fits.open(path, memmap=True) as hdus:
        tables = [
            hdu
            for hdu in hdus
            if isinstance(hdu, fits.BinTableHDU | fits.TableHDU) and hdu.name != "LDAC_IMHEAD"
        ]
        objects = [hdu for hdu in tables if hdu.name == "LDAC_OBJECTS"] or tables
        if len(objects) != 1:
            names = shorten([hdu.name or "(no name)" for hdu in objects])
            raise ObservationError(path, f"expected one table of stars, found {names}")
        size = objects[0].header["NAXIS1"] * objects[0].header["NAXIS2"]
        if size > 2000 * path.stat().st_size:
            raise ObservationError(path, "damaged: the table is larger than the file")
        # Masked NaN would look like text without value; here both end in one message.
        return Table.read(objects[0], format="fits", mask_invalid=False)


def _text_table(path: Path, content: bytes) -> Any:
    from astropy.io import ascii as text_tables

    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ObservationError(path, "neither a FITS table nor text in UTF-8") from None
    if "\x00" in text:
        raise ObservationError(path, "neither a FITS table nor text")
    lines = [line for line in text.splitlines() if line.strip()]
    if lines[0].startswith("# %ECSV"):
        kind: dict[str, Any] = {"format": "ecsv"}
    elif SEXTRACTOR_HEADER.match(lines[0]):
        kind = {"format": "sextractor"}
    else:
        lines = _without_comments(lines)
        delimiter = next((c for c in ",;\t" if c in lines[0]), " ") if lines else ","
        kind = {"format": "basic", "delimiter": delimiter}
    if not lines:
        raise ObservationError(path, "the catalogue has no stars")
    with reading(path):
        # The line break at the end is what tells a table from the name of a file.
        return text_tables.read("\n".join(lines) + "\n", guess=False, **kind)


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
