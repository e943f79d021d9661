"""Star catalogues: FITS tables (also FITS_LDAC), text tables, VOTable, DAOPHOT, DS9, VizieR.

Names of columns (`CONVENTIONS`) are found whatever their case, but that IRAF's XCENTER counts from
1 and photutils' xcenter from 0. The origin, the index of the centre of the first pixel, is 1 for
SExtractor, IRAF, DAOPHOT and DS9, and 0 for photutils and for psfdae's own results; plain x, y are
written with either: a wrong guess would shift every star by a pixel, so there is none. Pixel
columns go before sky columns. Columns of different programs in one catalogue are not guessed
between, either.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from psfdae.errors import Error
from psfdae.image import list_formats
from psfdae.image.containers import parts_of_array
from psfdae.image.errors import ObservationError, reading, shorten
from psfdae.image.fits_file import UNPACK, PlainFile, open_hdus, plain_file
from psfdae.image.stamps import StarFlag, raise_flag

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.table import Column, Table
    from numpy.typing import ArrayLike
    from pandas import DataFrame

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

SEXTRACTOR_HEADER = re.compile(r"#\s*(\d+)\s+[A-Za-z_]\w*")
SEXAGESIMAL = re.compile(r"[:hd\s]", re.IGNORECASE)
WHOLE = re.compile(r"\d{1,9}")  # hours or degrees of a sexagesimal text

MOST_STARS = 5_000_000  # rows of a catalogue
MOST_COLUMNS = 2000
LARGEST_TEXT = 2**26  # bytes of a text table; reading takes some ten times as much memory
LARGEST_ECSV_HEADER = 2**18  # characters; it is YAML and slow to read
# Characters of all rows of a text table, each as wide as its columns' widest cells: numpy keeps
# text in columns as wide as their longest cell, and one long cell makes every row as long.
WIDEST = 2**27
LONGEST_IDENTIFIER = 200  # characters; each row of the prediction is as long as the longest
ROWS = 10_000  # rows of a text table that are measured at a time


@dataclass(frozen=True)
class Convention:
    """Position columns of one program, pairs `x,y` from best to worst."""

    names: str
    sky: bool = False
    origin: int | None = None
    flags: str | None = None  # its column with the bits `FLAGGED`
    exact: bool = False  # in capitals or not as it is written here
    beside: tuple[str, ...] = ()  # columns that the program writes, too

    @property
    def pairs(self) -> list[list[str]]:
        """Both names of every pair."""
        return [pair.split(",") for pair in self.names.split()]


def _each(names: str, sky: bool = False) -> list[Convention]:
    """A convention for every pair."""
    return [Convention(pair, sky) for pair in names.split()]


# Tables that psfdae itself writes; they may hold columns of other programs, too.
RESULTS = [
    Convention("x,y", origin=0, beside=("shift_x", "shift_y")),  # predict
    Convention("x,y", origin=0, beside=("x_error", "y_error", "flux_model")),  # photometry
    Convention("x,y", origin=0, beside=("snr", "verdict", "part")),  # from-stars
]
CONVENTIONS = [
    Convention(
        "XWIN_IMAGE,YWIN_IMAGE XPSF_IMAGE,YPSF_IMAGE XMODEL_IMAGE,YMODEL_IMAGE "
        "X_IMAGE,Y_IMAGE XPEAK_IMAGE,YPEAK_IMAGE",
        origin=1,
        flags="FLAGS",
    ),
    Convention("x_fit,y_fit x_centroid,y_centroid xcentroid,ycentroid", origin=0),
    Convention("xcenter,ycenter", origin=0, exact=True),
    Convention("XCENTER,YCENTER", origin=1, exact=True),
    Convention("XCenter,YCenter"),
    *_each("x,y xpos,ypos x_pos,y_pos xpix,ypix x_pix,y_pix x_pixel,y_pixel"),
    Convention(
        "ALPHAWIN_J2000,DELTAWIN_J2000 ALPHAPSF_J2000,DELTAPSF_J2000 ALPHA_J2000,DELTA_J2000 "
        "ALPHAWIN_SKY,DELTAWIN_SKY ALPHA_SKY,DELTA_SKY",
        sky=True,
        flags="FLAGS",
    ),
    *_each(
        "ra,dec RAJ2000,DEJ2000 RAJ2000,DECJ2000 _RAJ2000,_DEJ2000 RA_ICRS,DE_ICRS "
        "RA_ICRS,DEC_ICRS RA_J2000,DEC_J2000 ra_deg,dec_deg raMean,decMean radeg,decdeg "
        "radeg,dedeg",
        sky=True,
    ),
]
# SExtractor's bits that say something against a star; 1, a neighbour nearby, is no reason.
FLAGGED = {2: StarFlag.BLENDED, 4: StarFlag.SATURATED, 8: StarFlag.TRUNCATED}
# Columns that identify a star; the first of these that a catalogue has is used.
ID_COLUMNS: tuple[str, ...] = ("id", "source_id", "number", "star_id", "objid", "obj_id")
ID_COLUMNS += ("object_id", "label", "name")


class ColumnError(Error, ValueError):
    """The position columns of a catalogue are missing or not the only ones."""


@dataclass(frozen=True)
class Positions:
    """Columns that hold the positions of a list, and how to read them."""

    first: str
    second: str
    sky: bool
    origin: int | None
    flags: str | None


def choose_positions(names: Sequence[str]) -> Positions:
    """Find the position columns among the names of a catalogue, or raise ColumnError."""
    for result in RESULTS:
        if set(names).issuperset((*result.pairs[0], *result.beside)):
            first_name, second_name = result.pairs[0]
            return Positions(first_name, second_name, result.sky, result.origin, None)
    choices: list[Positions] = []
    for convention in CONVENTIONS:
        for pair in convention.pairs:
            first, second = (_in_any_case(names, name) for name in pair)
            if first is None or second is None or (convention.exact and [first, second] != pair):
                continue
            if all(first != choice.first for choice in choices):
                meaning = (convention.sky, convention.origin, convention.flags)
                choices.append(Positions(first, second, *meaning))
            break
    # Tables of astropy keep sky coordinates as NAME.ra and NAME.dec in FITS files.
    stems = [name[:-3] for name in names if name.endswith(".ra") and f"{name[:-3]}.dec" in names]
    if len(stems) == 1 and not choices:
        choices = [Positions(f"{stems[0]}.ra", f"{stems[0]}.dec", True, None, None)]
    choices = [choice for choice in choices if not choice.sky] or choices
    if not choices:
        raise ColumnError("no position columns")
    if len(choices) > 1:
        pairs = " or ".join(f"{choice.first},{choice.second}" for choice in choices)
        raise ColumnError(f"ambiguous position columns {pairs}; keep one pair")
    return choices[0]


def _in_any_case(names: Sequence[str], name_wanted: str) -> str | None:
    matches = [name for name in names if name.strip().lower() == name_wanted.lower()]
    if len(matches) > 1:
        raise ColumnError(f"columns {' and '.join(matches)} differ in their case only; keep one")
    return matches[0] if matches else None


@dataclass(frozen=True)
class _FitsTable:
    """Columns of a FITS table, each read when it is asked for: the others may be large."""

    file: PlainFile
    index: int
    colnames: list[str]
    formats: list[str]
    rows: int

    def __len__(self) -> int:
        return self.rows

    @property
    def names_of_values(self) -> list[str]:
        """Names of the columns that hold one number, or one text such as 20A, for each star."""
        array = re.compile(r"\d*[PQ]|0*([2-9]|1\d)\d*[^\dA]")
        pairs = zip(self.colnames, self.formats, strict=True)
        return [name for name, form in pairs if not array.match(form)]

    def __getitem__(self, name: str) -> Column:
        from astropy.table import Column, MaskedColumn
        from astropy.units import Unit

        with reading(self.file.name), open_hdus(self.file, memmap=True) as hdus:
            hdu, place = hdus[self.index], self.colnames.index(name)
            column = hdu.columns[place]
            # Arrays of variable length may all be the same bytes of the file: 3 MB unfold to 1 TB.
            if re.match(r"\d*[PQ]", self.formats[place]):
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
    table: Table  # or what has columns like one

    def __len__(self) -> int:
        return len(self.table)

    def numbers(self, name: str, strict: bool = True) -> np.ndarray:
        """A column as float64, shape (n,); NaN where the catalogue has no value.

        A text that is no number is refused, or NaN unless `strict`.
        """
        column = self._column(name)
        if column.ndim != 1:
            raise ObservationError(self.path, f"column {name!r} holds arrays, not numbers")
        missing = np.ma.getmaskarray(column) if np.ma.isMaskedArray(column) else None
        values = np.asarray(np.ma.getdata(column))
        if values.dtype.kind in "iuf":
            numbers = values.astype(np.float64)
        elif values.dtype.kind in "SUO":
            numbers = self._parsed(name, values, missing, strict)
        else:
            raise ObservationError(self.path, f"column {name!r} does not hold numbers")
        if missing is not None:
            numbers[missing] = np.nan
        return numbers

    def coordinates(self, name: str) -> np.ndarray:
        """A column of finite numbers, NaN elsewhere; an error if no number is finite."""
        numbers = self.numbers(name, strict=False)
        finite = np.isfinite(numbers)
        if not finite.any():
            raise ObservationError(self.path, f"column {name!r} has no finite number in any row")
        return np.where(finite, numbers, np.nan)

    def pixels(self, name: str) -> np.ndarray:
        """A column of pixel positions, as `coordinates`; another unit than pixels is refused."""
        from astropy import units

        unit = getattr(self._column(name), "unit", None)
        if unit is not None:
            pixel_unit = units.Unit(unit, parse_strict="silent")
            plain = isinstance(pixel_unit, units.UnrecognizedUnit) or pixel_unit in (
                units.pix,
                units.dimensionless_unscaled,
            )
            if not plain:
                raise ObservationError(
                    self.path, f"column {name!r} has the unit {str(unit)!r}, expected pixels"
                )
        return self.coordinates(name)

    def flags(self, positions: Positions) -> np.ndarray:
        """Return flags of the list's own program as `StarFlag`s, (n,), uint16."""
        flags = np.zeros(len(self), dtype=np.uint16)
        if positions.flags is not None and positions.flags in self.table.colnames:
            list_flags = np.nan_to_num(self.numbers(positions.flags), posinf=0, neginf=0).astype(
                np.int64
            )
            for bit, flag in FLAGGED.items():
                raise_flag(flags, flag, (list_flags & bit) > 0)
        return flags

    def positions(self) -> Positions:
        """The columns with the positions, or an error that lists what would be accepted."""
        try:
            return choose_positions(self.table.colnames)
        except ColumnError as error:
            accepted = " ".join(f"{a},{b}" for c in CONVENTIONS for a, b in c.pairs)
            raise ObservationError(
                self.path, f"{error}; found {shorten(self.table.colnames)}; accepted {accepted}"
            ) from None

    def sky(self, positions: Positions) -> tuple[np.ndarray, np.ndarray]:
        """Right ascension and declination in degrees, each shape (n,).

        Columns without unit are in degrees; text with colons, blanks or letters is
        sexagesimal, then right ascensions are in hours unless one is beyond 24. Declinations
        off the sphere are NaN, and an error if all are.
        """
        ra = self._angles(positions.first, "hourangle")
        dec = self._angles(positions.second, "deg")
        on = np.abs(dec) <= 90
        if not on.any():
            row = np.flatnonzero(np.isfinite(dec))[0]
            raise ObservationError(
                self.path,
                f"column {positions.second!r} is {dec[row]:g}° in row {row + 1}, expected -90 … 90",
            )
        return ra, np.where(on, dec, np.nan)

    def identifiers(self) -> np.ndarray:
        """One identifier per star, int64 or str, shape (n,); row numbers from 0 without any."""
        name = self._identifier()
        if name is None:
            return np.arange(len(self), dtype=np.int64)
        identifiers = _as_identifiers(self._column(name))
        if identifiers.dtype.kind == "U" and identifiers.dtype.itemsize > 4 * LONGEST_IDENTIFIER:
            lengths = np.char.str_len(identifiers)
            row = lengths.argmax()
            raise ObservationError(
                self.path,
                f"column {name!r} has {lengths[row]} characters in row {row + 1}, "
                f"an identifier may have {LONGEST_IDENTIFIER}",
            )
        return identifiers

    def _identifier(self) -> str | None:
        """Name of the column that identifies the stars; None without one."""
        for alias in ID_COLUMNS:
            try:
                name = self._resolve(alias)
            except ColumnError:
                continue
            if name is not None and self._column(name).ndim == 1:
                return name
        return None

    def columns(self, rows: np.ndarray) -> Table:
        """Some rows of all columns of numbers and text but identifiers and pixel positions.

        Columns of arrays, such as images of the stars, are left out, and so is what comes after
        900 columns, as a FITS table has 999 at most.

        Parameters
        ----------
        rows : ndarray of int, shape (m,)
        """
        from astropy.table import Table

        further_columns, positions = Table(), self.positions()
        read = {self._identifier(), *(() if positions.sky else (positions.first, positions.second))}
        names = getattr(self.table, "names_of_values", self.table.colnames)
        for name in [name for name in names[:900] if name not in read]:
            column = self.table[name]
            # Times, coordinates and arrays have no place in a table of numbers.
            if not isinstance(column, np.ndarray) or column.ndim != 1:
                continue
            if column.dtype.kind == "O":
                column = column.astype(str)
            if column.dtype.kind in "biufUS":
                further_columns[name] = column[rows]
        return further_columns

    def _resolve(self, name_wanted: str) -> str | None:
        """The one column of that name, case aside if it is not written exactly so."""
        names = self.table.colnames
        return name_wanted if name_wanted in names else _in_any_case(names, name_wanted)

    def _column(self, name: str) -> Column:
        try:
            resolved = self._resolve(name)
        except ColumnError as error:
            raise ObservationError(self.path, str(error)) from None
        if resolved is None:
            raise ObservationError(
                self.path, f"no column {name!r}; found {shorten(self.table.colnames)}"
            )
        column = self.table[resolved]
        if not isinstance(column, np.ndarray):
            raise ObservationError(self.path, f"column {name!r} does not hold plain numbers")
        return column

    def _parsed(
        self, name: str, values: np.ndarray, missing: np.ndarray | None, strict: bool
    ) -> np.ndarray:
        numbers = np.full(len(values), np.nan)
        for row, value in enumerate(values):
            if missing is not None and missing[row]:
                continue
            try:
                numbers[row] = float(_text(value))
            except ValueError:
                if not strict:
                    continue
                raise ObservationError(
                    self.path,
                    f"column {name!r} holds {_text(value)[:40]!r} in row {row + 1}, "
                    "expected a number",
                ) from None
        return numbers

    def _angles(self, name: str, sexagesimal_unit: str) -> np.ndarray:
        from astropy import units
        from astropy.coordinates import Angle

        column = self._column(name)
        values = np.asarray(np.ma.getdata(column))
        is_text = values.dtype.kind in "SUO"
        if is_text and column.ndim == 1:
            has_value = ~np.ma.getmaskarray(column)
            texts = [_text(value).strip() for value in values[has_value]]
            if any(SEXAGESIMAL.search(text) for text in texts):
                # A right ascension of 150:00:12 cannot be in hours, nor can those beside it.
                whole_parts = [int(number[0]) for number in map(WHOLE.match, texts) if number]
                if max(whole_parts, default=0) > 24:
                    sexagesimal_unit = "deg"
                angles = np.full(len(values), np.nan)
                with reading(self.path):
                    angles[has_value] = Angle(texts, unit=sexagesimal_unit).deg
                return angles
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


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _as_identifiers(column: Column) -> np.ndarray:
    values, missing = np.ma.getdata(column), np.ma.getmaskarray(column)
    if values.dtype.kind in "iuf" and not missing.any():
        with np.errstate(all="ignore"):
            integers = values.astype(np.int64)
        # Unsigned ones beyond the largest signed one come back negative.
        if (integers.astype(values.dtype) == values).all() and (
            (integers < 0) == (values < 0)
        ).all():
            return integers
    texts = [
        "" if is_missing else _text(v).strip()
        for v, is_missing in zip(values.tolist(), missing, strict=True)
    ]
    return np.array(texts, dtype=str)


# Reading.


def read_catalogue(path: Path) -> Catalogue:
    """Read a star catalogue.

    The format follows from the content: a FITS file, of which the LDAC_OBJECTS or
    the only table is taken; VOTable; ECSV; the ASCII_HEAD format of SExtractor; lists of
    IRAF's DAOPHOT and of DAOPHOT itself; regions of DS9; or a text table with a line of
    column names, separated by commas, semicolons, tabs or blanks, also with VizieR's lines
    of units and dashes. Lines that begin with # are comments.
    """
    with reading(path), path.open("rb") as file:
        start = file.read(16)
        fits = start.startswith((b"SIMPLE  =", *UNPACK))
        lines = [] if fits else _lines(path, start + file.read(LARGEST_TEXT))
    table = _fits_table(path) if fits else _text_table(path, lines)
    if len(table) == 0:
        raise ObservationError(path, "the catalogue has no stars")
    return Catalogue(path, table)


def as_catalogue(star_list: StarList) -> Catalogue:
    """A star list from a file, a table, or positions.

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
    path = Path("catalogue")
    with reading(path):
        if isinstance(star_list, SkyCoord):
            star_list = {"sky": star_list.reshape(-1)}
        elif _is_positions(star_list):
            star_list = _pairs(path, star_list)
        records = getattr(star_list, "to_records", None)  # of a DataFrame
        # Quantities become columns with units.
        table = Table(star_list if records is None else records(index=False))
        table = _with_sky_columns(table)
    if len(table) == 0:
        raise ObservationError(path, "the catalogue has no stars")
    return Catalogue(path, table)


def _is_positions(star_list: Any) -> bool:
    """Return True for an array without names of columns, and for a sequence that is no table."""
    if isinstance(star_list, np.ndarray):
        return star_list.dtype.names is None
    return isinstance(star_list, Sequence) and not any(
        isinstance(row, Mapping) for row in star_list
    )


def _pairs(path: Path, star_list: Any) -> dict[str, np.ndarray]:
    """Return the columns of positions (x, y), NaN where they are masked."""
    values, mask, unit = parts_of_array(star_list)
    if unit not in ("", "pix", "pixel"):
        raise ObservationError(
            path, f"positions in {unit}, expected pixels; sky coordinates go as a SkyCoord"
        )
    shape = values.shape
    if values.ndim != 2 or shape[1] != 2 or values.dtype.kind not in "fiu":
        raise ObservationError(path, f"positions of shape {shape}, expected numbers of (n, 2)")
    values = values.astype(np.float64)
    if mask is not None:
        values[mask] = np.nan
    return {"x_fit": values[:, 0], "y_fit": values[:, 1]}


def _with_sky_columns(table: Table) -> Table:
    """Return a table whose only column of SkyCoord is replaced by RA and Dec in degrees, ICRS."""
    from astropy.coordinates import SkyCoord
    from astropy.table import Table

    sky = [name for name in table.colnames if isinstance(table[name], SkyCoord)]
    if len(sky) != 1:
        return table
    icrs = table[sky[0]].icrs
    further = [name for name in table.colnames if name not in (sky[0], "ra", "dec")]
    plain = Table({name: table[name] for name in further})
    for name, angle in (("ra", icrs.ra), ("dec", icrs.dec)):
        values, mask, _ = parts_of_array(angle.deg)
        plain[name] = values.astype(np.float64)
        if mask is not None:
            plain[name][mask] = np.nan
    return plain


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
            table_names = shorten([hdu.name or "(no name)" for hdu in objects])
            raise ObservationError(path, f"expected one table of stars, found {table_names}")
        rows = int(objects[0].header["NAXIS2"])
        size = objects[0].header["NAXIS1"] * rows
        if objects[0].fileinfo()["datLoc"] + size > file.path.stat().st_size:
            raise ObservationError(path, "damaged: the table is larger than the file")
        # A damaged table has columns without a name, or of the same one.
        names = [str(name or f"col{k}") for k, name in enumerate(objects[0].columns.names, 1)]
        _check_size(path, rows, len(names))
        formats = [str(form) for form in objects[0].columns.formats]
        return _FitsTable(file, hdus.index(objects[0]), names, formats, rows)


def _check_size(path: Path, rows: int, columns: int) -> None:
    for noun, count, limit in (("stars", rows, MOST_STARS), ("columns", columns, MOST_COLUMNS)):
        if count > limit:
            raise ObservationError(path, f"{count} {noun} in a catalogue, at most {limit}")


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


def _text_table(path: Path, lines: list[str]) -> Table:
    """Table of the lines, which are gone then: they take twice the memory of the file."""
    from astropy.io import ascii as text_tables

    if lines[0].startswith("# Region file") or path.suffix.lower() == ".reg":
        return list_formats.regions(path, lines)
    if lines[0].lstrip().startswith("<"):
        return list_formats.votable(path, lines, WIDEST)
    if list_formats.STETSON.match(lines[0]):
        return list_formats.stetson(path, lines)
    rows = _without_comments(lines)
    if lines[0].startswith(("#K ", "#N ")):
        kind: dict[str, Any] = {"format": "daophot"}
    elif lines[0].startswith("# %ECSV"):
        kind = {"format": "ecsv"}
        if sum(map(len, lines)) - sum(map(len, rows)) > LARGEST_ECSV_HEADER:
            raise ObservationError(
                path, f"an ECSV header of more than {LARGEST_ECSV_HEADER} characters"
            )
    elif SEXTRACTOR_HEADER.match(lines[0]):
        kind = {"format": "sextractor"}
        numbered = filter(None, map(SEXTRACTOR_HEADER.match, lines))
        _check_size(path, 0, max(int(match[1][:9]) for match in numbered))
    else:
        lines[:] = rows = list_formats.without_vizier_head(rows)
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
        return _with_sky_columns(text_tables.read(text, guess=False, **kind))


def _delimiter(rows: list[str]) -> str:
    return next((c for c in ",;\t" if c in rows[0]), " ") if rows else ","


def _check_widths(path: Path, rows: list[str]) -> None:
    """Refuse a table of which numpy would make far more than it is; see `WIDEST`."""
    delimiter = _delimiter(rows)
    columns = len(rows[0].split(None if delimiter == " " else delimiter))
    _check_size(path, len(rows), columns)
    widths = [0] * columns
    for start in range(0, len(rows), ROWS):
        part = rows[start : start + ROWS]
        split = map(str.split, part) if delimiter == " " else csv.reader(part, delimiter=delimiter)
        try:
            cells = list(split)
        except csv.Error as error:
            raise ObservationError(path, f"not a text table ({error})") from None
        if all(len(row) == columns for row in cells):
            lengths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        else:
            # Quoted otherwise than we think, or no table at all.
            lengths = [max(map(len, part))] * columns
        widths = list(map(max, widths, lengths))
    if len(rows) * sum(widths) > WIDEST:
        column = max(range(columns), key=widths.__getitem__)
        raise ObservationError(
            path,
            f"column {column + 1} is {widths[column]} characters wide; {len(rows)} rows may have "
            f"{WIDEST // len(rows)} characters in all columns",
        )


def _without_comments(lines: list[str]) -> list[str]:
    """Lines of the table; a comment right before numbers without a header is the header."""
    table = [line for line in lines if not line.lstrip().startswith("#")]
    if not table:
        return []
    preamble = lines[: lines.index(table[0])]
    if preamble and not any(c.isalpha() for c in table[0].replace("e", "").replace("E", "")):
        return [preamble[-1].lstrip("# \t"), *table]
    return table
