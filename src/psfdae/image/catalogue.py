"""Star catalogues: positions, identifiers, fluxes and flags of the stars of a list.

Inputs: a file (`list_formats`), a table of astropy or pandas, sky coordinates or positions. Output:
`Catalogue`, whose methods return one value for each star. The case of column names is ignored;
`position_columns` chooses the columns of positions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from psfdae.base.errors import did_you_mean, keyword
from psfdae.base.types import Column, DataFrame, SkyCoord, Table
from psfdae.image.containers import split_array
from psfdae.image.errors import ObservationError, reading, shorten
from psfdae.image.list_formats import read_list_table
from psfdae.image.position_columns import (
    CONVENTIONS,
    ColumnError,
    Positions,
    choose_positions,
    find_identifier,
    name_in_any_case,
)
from psfdae.image.stamps import StarFlag, raise_flag

StarList: TypeAlias = (
    str
    | Path
    | np.ndarray
    | Sequence[Sequence[float]]
    | SkyCoord
    | Mapping[str, ArrayLike]
    | Table
    | DataFrame
)
"""Star list that public functions accept; see `as_catalogue`."""

_MISSING = ("None", "nan", "<NA>", "NaT")
"""Missing values of Python, numpy and pandas, as text."""


@dataclass(frozen=True)
class Catalogue:
    """A table of stars, with all rows of the list in their order.

    Attributes
    ----------
    path : Path
        File of the list; for a list in memory, its name in messages.
    table : Table
        All columns, as astropy reads them.
    """

    path: Path
    table: Table

    def __len__(self) -> int:
        return len(self.table)

    def numbers(self, name: str, strict: bool = True) -> np.ndarray:
        """Return a column as float64, shape (n,); NaN where a value is missing.

        Parameters
        ----------
        name : str
            Name of the column; case is ignored unless a column has exactly this name.
        strict : bool
            If True, a text that is not a number is an error; if False, it is NaN, but a text with a
            comma remains an error.

        Raises
        ------
        ObservationError
            If the column does not exist, or does not hold one number for each star.
        """
        # One value for each star.
        column = self._column(name)
        if column.ndim != 1:
            raise ObservationError(self.path, f"column {name!r} holds arrays, not numbers")
        # Numbers; masked ones become NaN.
        if column.dtype.kind in "iuf":
            return np.ma.filled(np.ma.array(column).astype(np.float64), np.nan)
        if column.dtype.kind not in "SUO":
            raise ObservationError(self.path, f"column {name!r} does not hold numbers")
        # Numbers as text, such as when one row has a word.
        numbers = np.full(len(column), np.nan)
        for row, text in enumerate(_texts(column)):
            try:
                numbers[row] = float(text or "nan")
            except ValueError:
                if strict or "," in text:
                    raise ObservationError(
                        self.path,
                        f"column {name!r} holds {text[:40]!r} in row {row + 1}, expected a number "
                        "with a decimal point",
                    ) from None
        return numbers

    def coordinates(self, name: str) -> np.ndarray:
        """Return a column of finite numbers, (n,), NaN where there is none.

        Raises
        ------
        ObservationError
            If the column does not exist, or does not contain a finite number.
        """
        numbers = self.numbers(name, strict=False)
        # Infinite numbers are taken as missing.
        finite = np.isfinite(numbers)
        if not finite.any():
            raise ObservationError(self.path, f"column {name!r} has no finite number in any row")
        return np.where(finite, numbers, np.nan)

    def pixels(self, name: str) -> np.ndarray:
        """Return a column of pixel positions, as `coordinates`; other units raise an error."""
        from astropy import units

        # A column without a unit is in pixels.
        unit = getattr(self._column(name), "unit", None)
        pixel_unit = units.Unit(unit or "", parse_strict="silent")
        # A unit that astropy does not know may be another word for pixels.
        is_unit = not isinstance(pixel_unit, units.UnrecognizedUnit)
        if is_unit and pixel_unit not in (units.pix, units.dimensionless_unscaled):
            raise ObservationError(
                self.path, f"column {name!r} has the unit {str(unit)!r}, expected pixels"
            )
        return self.coordinates(name)

    def positions(self) -> Positions:
        """Return the columns of the positions; the error if none fit lists the accepted names."""
        try:
            return choose_positions(self.table.colnames)
        except ColumnError as error:
            choices = " ".join(f"{p.first},{p.second}" for pairs in CONVENTIONS for p in pairs)
            raise ObservationError(
                self.path, f"{error}; found {shorten(self.table.colnames)}; accepted {choices}"
            ) from None

    def sky(self, positions: Positions) -> tuple[np.ndarray, np.ndarray]:
        """Return right ascension and declination in degrees, each of shape (n,).

        Columns without unit are in degrees. Text with colons, blanks, h or d is sexagesimal; right
        ascensions are then in hours unless one is above 24. Declinations outside ±90° are NaN.
        LSST's `coord_ra` and `coord_dec` without a unit are in radians if all right ascensions are
        below 2π.

        Raises
        ------
        ObservationError
            If no declination is within ±90°, or if a column is missing or does not hold angles.
        """
        ra = self._angles(positions.first, "hourangle")
        dec = self._angles(positions.second, "deg")
        # Nearly everywhere on the sky, right ascensions in degrees are above 2π.
        has_unit = getattr(self._column(positions.first), "unit", None) is not None
        if positions.first.lower() == "coord_ra" and not has_unit and np.nanmax(ra) < 2 * np.pi:
            ra, dec = np.rad2deg(ra), np.rad2deg(dec)
        # Declinations beyond a pole are not positions on the sky.
        is_on_sky = np.abs(dec) <= 90
        if not is_on_sky.any():
            row = np.flatnonzero(np.isfinite(dec))[0]
            raise ObservationError(
                self.path,
                f"column {positions.second!r} is {dec[row]:g}° in row {row + 1}, expected -90 … 90",
            )
        return ra, np.where(is_on_sky, dec, np.nan)

    def _angles(self, name: str, sexagesimal_unit: str) -> np.ndarray:
        """Return a column of angles in degrees, shape (n,), NaN where a value is missing.

        Parameters
        ----------
        name : str
            Column of numbers or texts.
        sexagesimal_unit : str
            Unit of text such as 10:00:12: "hourangle" or "deg".
        """
        from astropy import units
        from astropy.coordinates import Angle

        # Sexagesimal text.
        column = self._column(name)
        is_text = column.dtype.kind in "SUO"
        texts = _texts(column) if is_text and column.ndim == 1 else []
        if any(re.search(r"[:hd\s]", text, re.IGNORECASE) for text in texts):
            # A right ascension of 150:00:12 cannot be in hours, nor can the others of the column.
            whole_parts = filter(None, map(re.compile(r"\d+").match, texts))
            if max((float(number[0]) for number in whole_parts), default=0) > 24:
                sexagesimal_unit = "deg"
            # Rows without a text stay NaN.
            angles = np.full(len(texts), np.nan)
            rows = [row for row, text in enumerate(texts) if text]
            with reading(self.path):
                angles[rows] = Angle([texts[row] for row in rows], unit=sexagesimal_unit).deg
            return angles
        # Numbers, in degrees unless the column has a unit.
        numbers = self.coordinates(name)
        unit = getattr(column, "unit", None)
        if unit is None or is_text:
            return numbers
        try:
            return numbers * float(units.Unit(unit).to("deg"))
        except (units.UnitConversionError, TypeError, ValueError):
            raise ObservationError(
                self.path, f"column {name!r} has the unit {str(unit)!r}, expected an angle"
            ) from None

    def flags(self, positions: Positions) -> np.ndarray:
        """Return the flags of the program that wrote the list, as `StarFlag`s.

        Parameters
        ----------
        positions : Positions
            Columns of the positions, whose names identify the program and its column of flags.

        Returns
        -------
        ndarray of uint16, shape (n,)
            0 without such a column.
        """
        flags = np.zeros(len(self), dtype=np.uint16)
        if positions.flags is not None and positions.flags in self.table.colnames:
            values = np.nan_to_num(self.numbers(positions.flags), posinf=0, neginf=0)
            # SExtractor's bits that matter for a PSF; bit 1, a bright neighbour nearby, is ignored.
            bits = {2: StarFlag.BLENDED, 4: StarFlag.SATURATED, 8: StarFlag.TRUNCATED}
            for bit, flag in bits.items():
                raise_flag(flags, flag, (values.astype(np.int64) & bit) > 0)
        return flags

    def identifiers(self) -> np.ndarray:
        """Return one identifier per star, int64 or str, shape (n,).

        It is the first column of the list among id, source_id, number and similar names
        (`find_identifier`); without any, the number of the row from 0.
        """
        # Without such a column, the number of the row.
        name = self._identifier()
        if name is None:
            return np.arange(len(self), dtype=np.int64)
        # Whole numbers stay numbers, also those in a column of floats; all else becomes text. The
        # readers of text files leave identifiers such as 001 or 1e5 as text.
        column = self._column(name)
        values = np.ma.getdata(column)
        if values.dtype.kind in "iuf" and not np.ma.getmaskarray(column).any():
            with np.errstate(all="ignore"):
                integers = values.astype(np.int64)
            # Unsigned numbers above the largest signed number become negative.
            is_same = (integers.astype(values.dtype) == values) & ((integers < 0) == (values < 0))
            if is_same.all():
                return integers
        return np.array(_texts(column), dtype=str)

    def _identifier(self) -> str | None:
        """Return the name of the column that identifies the stars; None without one."""
        columns = {name: self.table[name] for name in self.table.colnames}
        is_plain = {n: isinstance(c, np.ndarray) and c.ndim == 1 for n, c in columns.items()}
        return find_identifier([name for name in columns if is_plain[name]])

    def columns(self, rows: np.ndarray) -> Table:
        """Return rows of the columns of numbers and text, without identifiers and pixel positions.

        Columns of arrays, such as images of the stars, are left out, and all columns after the
        first 900, as a FITS table has at most 999.

        Parameters
        ----------
        rows : ndarray of int, shape (m,)
            Numbers of the rows, from 0.
        """
        from astropy.table import Table

        # Positions on the sky stay; the result has identifiers and pixel positions of its own.
        further_columns, positions = Table(), self.positions()
        left_out = {
            self._identifier(),
            *(() if positions.sky else (positions.first, positions.second)),
        }
        for name in self.table.colnames[:900]:
            column = self.table[name]
            # Times, coordinates and arrays do not belong in a table of numbers.
            if name in left_out or not isinstance(column, np.ndarray) or column.ndim != 1:
                continue
            # Texts of pandas are objects, and so are the variable-length arrays of FITS tables.
            if column.dtype.kind == "O" and not isinstance(column[0], np.ndarray):
                column = column.astype(str)
            if column.dtype.kind in "biufUS":
                further_columns[name] = column[rows]
        return further_columns

    def _column(self, name: str) -> Column:
        """Return a column; ObservationError if it does not exist, or is not an array.

        The case of the name is ignored unless a column has exactly this name.
        """
        names = self.table.colnames
        try:
            column_name = name if name in names else name_in_any_case(names, name)
        except ColumnError as error:
            raise ObservationError(self.path, str(error)) from None
        if column_name is None:
            hint = did_you_mean(name, names)
            raise ObservationError(self.path, f"no column {name!r}; found {shorten(names)}{hint}")
        # Coordinates and times are objects of astropy, not arrays.
        column = self.table[column_name]
        if not isinstance(column, np.ndarray):
            raise ObservationError(self.path, f"column {name!r} does not hold plain numbers")
        return column


def _texts(column: Column) -> list[str]:
    """Return the values of a column as text without blanks around it.

    Bytes are decoded as UTF-8. Masked values, and None, NaN or NA of pandas, are "".
    """
    # FITS has text as bytes.
    values = np.where(np.ma.getmaskarray(column), "", np.ma.getdata(column).astype(object))
    texts = [v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in values]
    # Columns of Python objects mark a missing value by an object that is not a text.
    is_missing = [not isinstance(v, str | bytes) and str(v) in _MISSING for v in values]
    return [
        "" if missing else text.strip() for text, missing in zip(texts, is_missing, strict=True)
    ]


def read_catalogue(path: Path) -> Catalogue:
    """Read a star catalogue from a file in one of the formats of `list_formats`.

    Raises
    ------
    ObservationError
        If the file cannot be read, or does not contain stars.
    """
    return _make_catalogue(path, read_list_table(path))


def as_catalogue(star_list: StarList) -> Catalogue:
    """Convert a star list, a file, table or positions, to a `Catalogue`.

    Parameters
    ----------
    star_list : path-like, table, SkyCoord, array of shape (n, 2), or sequence of n pairs
        A table is one of astropy or pandas, or a mapping of columns, with names as in files
        (`CONVENTIONS`) or with a column of SkyCoord; positions are (x, y), 0-based.
    """
    from astropy.coordinates import SkyCoord
    from astropy.table import Table

    if isinstance(star_list, Catalogue):
        return star_list
    if isinstance(star_list, str | Path):
        return read_catalogue(Path(star_list))
    # Positions become columns of a table.
    path = Path("catalogue")
    with reading(path):
        # A table of sky coordinates; an array or a sequence of pairs; else a table.
        is_pairs = isinstance(star_list, np.ndarray) and star_list.dtype.names is None
        if isinstance(star_list, Sequence):
            is_pairs = not any(isinstance(row, Mapping) for row in star_list)
        if isinstance(star_list, SkyCoord):
            star_list = {"sky": star_list.reshape(-1)}
        elif is_pairs:
            star_list = _split_pairs(path, star_list)
        # A DataFrame becomes a structured array. Quantities become columns with units.
        to_records = getattr(star_list, "to_records", None)
        table = Table(star_list if to_records is None else to_records(index=False))
    return _make_catalogue(path, table)


def _split_pairs(path: Path, star_list: Any) -> dict[str, np.ndarray]:
    """Return the columns x and y of positions (n, 2), NaN where they are masked.

    They have the column names of photutils, `x_fit` and `y_fit`, which are 0-based.

    Raises
    ------
    ObservationError
        If the positions have another unit than pixels, or are not numbers of shape (n, 2).
    """
    # Only pixels: an array of angles does not have a frame, such as the ICRS.
    values, mask, unit = split_array(star_list)
    if unit not in ("", "pix", "pixel"):
        raise ObservationError(
            path, f"positions in {unit}, expected pixels; pass sky coordinates as a SkyCoord"
        )
    if values.ndim != 2 or values.shape[1] != 2 or values.dtype.kind not in "fiu":
        raise ObservationError(
            path, f"positions of shape {values.shape}, expected numbers of shape (n, 2)"
        )
    values = values.astype(np.float64)
    if mask is not None:
        values[mask] = np.nan
    return {"x_fit": values[:, 0], "y_fit": values[:, 1]}


def _make_catalogue(path: Path, table: Table) -> Catalogue:
    """Return a catalogue with a table of stars; a single column of SkyCoord becomes ra and dec.

    Raises
    ------
    ObservationError
        If the table is empty.
    """
    from astropy.coordinates import SkyCoord

    if len(table) == 0:
        raise ObservationError(path, "the catalogue has no stars")
    # A table may have a column of SkyCoord in place of two columns of numbers.
    sky_names = [name for name in table.colnames if isinstance(table[name], SkyCoord)]
    if len(sky_names) == 1:
        # In degrees of the ICRS, NaN where a coordinate is masked.
        with reading(path):
            icrs, table = table[sky_names[0]].icrs, table.copy(copy_data=False)
            for name, angle in (("ra", icrs.ra), ("dec", icrs.dec)):
                values, mask, _ = split_array(angle.deg)
                table[name] = np.where(mask if mask is not None else False, np.nan, values)
            table.remove_column(sky_names[0])
    return Catalogue(path, table)


def require_sky(stars: StarList, purpose: str) -> None:
    """Raise an error if a star list of several images lacks sky coordinates.

    Parameters
    ----------
    stars : path-like, table or positions
        The list (`as_catalogue`).
    purpose : str
        Task that needs sky coordinates, for the message.

    Raises
    ------
    ObservationError
        If the list does not have sky coordinates.
    """
    table = as_catalogue(stars)
    if not table.positions().sky:
        raise ObservationError(
            table.path,
            f"{purpose} takes a list with sky coordinates, or {keyword('detect', True)}: pixel "
            "positions do not identify their image",
        )
