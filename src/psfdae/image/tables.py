"""Tables of stars: names, units and digits of their columns, and how they are written.

`psfdae predict`, `psfdae photometry`, `Stars.table` and `Prediction.to_table` all give the table of
`star_table`; `COLUMNS` describes each of their columns.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.base.files import no_formula, write_bytes
from psfdae.base.types import BinTableHDU, Column, QTable, Table
from psfdae.image.containers import fits_unit
from psfdae.image.errors import ascii_line, silent

PIXEL_UNIT = "unit of the image"
"""Placeholder in `COLUMNS` for the unit of the image's pixels."""

COLUMNS: dict[str, tuple[str, str, str]] = {
    "image": ("", "", "file of the exposure"),
    "id": ("", "", "by the star list, else the number of the star"),
    "x": ("pix", ".4f", "position in the image, 0-based, columns"),
    "y": ("pix", ".4f", "position in the image, 0-based, rows"),
    "ra": ("deg", ".8f", "ICRS, of the fitted centre if there is one"),
    "dec": ("deg", ".8f", "ICRS, of the fitted centre if there is one"),
    "verdict": ("", "", "good, or why the star is not used for training"),
    "part": ("", "", "training, or held out"),
    "flux": (PIXEL_UNIT, ".7g", "light of the star; of predict, inside its stamp"),
    "flux_error": (PIXEL_UNIT, ".3g", "standard error; NaN if the flux was given"),
    "flux_total": (PIXEL_UNIT, ".7g", "within FLUXRAD; NaN if the model has no wings"),
    "flux_total_error": (PIXEL_UNIT, ".3g", "standard error"),
    "flux_model": (PIXEL_UNIT, ".7g", "light of the star within the model's stamp"),
    "flux_iso": (PIXEL_UNIT, ".7g", "light above the threshold of the detection"),
    "background": (PIXEL_UNIT, ".6g", "sky per pixel"),
    "noise": (PIXEL_UNIT, ".4g", "RMS of the sky noise in a pixel"),
    "snr": ("", ".1f", "of a matched filter, flux sqrt(sum of PSF^2) / noise"),
    "mag": ("mag", ".4f", "zero point - 2.5 log10(flux)"),
    "mag_error": ("mag", ".4f", "standard error"),
    "ratio95": ("", ".3f", "95 % of the errors are within UNCERT times this"),
    "ratio95_bright": ("", ".3f", "the same in the brightest 8 % of the pixels"),
    "chi2": ("", ".3f", "squared residuals over their expectation"),
    "distance": ("", ".2f", "Mahalanobis distance from the training set"),
    "outlier_score": ("", ".2f", "-2 ln of the probability density in the model"),
    "fwhm_px": ("pix", ".3f", "of the PSF, adaptive moments"),
    "ellipticity": ("", ".4f", "1 - b/a of the PSF"),
    "position_angle_deg": ("deg", ".1f", "of the major axis, from +x to +y"),
    "x_fit": ("pix", ".4f", "centre of the star, columns, 0-based"),
    "y_fit": ("pix", ".4f", "centre of the star, rows, 0-based"),
    "x_error": ("pix", ".3g", "standard error of x_fit, or of x"),
    "y_error": ("pix", ".3g", "standard error of y_fit, or of y"),
    "background_error": (PIXEL_UNIT, ".3g", "standard error of background"),
    **{
        f"corr_{pair}": ("", ".3f", "correlation of errors")
        for pair in ("flux_background", "flux_y", "flux_x", "background_y", "background_x", "y_x")
    },
    "shift_x": ("pix", "", "pixels by which the stamp was moved in +x"),
    "shift_y": ("pix", "", "pixels by which the stamp was moved in +y"),
    "group": ("", "", "label of the stars that were fitted together"),
    "group_size": ("", "", "number of these stars"),
    "photutils_flags": ("", "", "flags of photutils.psf.PSFPhotometry"),
    "flags": ("", "", "sum of the FLAG values of psfdae.StarFlag"),
}
"""Unit, format in which values are shown, and meaning of each column, by its name."""

SUFFIXES = (".fits", ".ecsv", ".csv")
"""Suffixes of files that `write_table` writes."""


def star_table(
    columns: Mapping[str, np.ndarray], image_unit: str = "", star_list: Table | None = None
) -> QTable:
    """Return a table of n stars with units, and further columns of their star list.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (n,)
        Columns by their names, in this order; names that are not in `COLUMNS` have neither unit
        nor meaning.
    image_unit : str
        Unit of the image's pixels; "" where it is unknown, which is taken for adu.
    star_list : Table, optional
        n rows of the star list. Its columns follow the others; `_list` is added to names that
        exist already, in any case.
    """
    from astropy.table import QTable
    from astropy.units import Quantity, Unit

    # Columns with units, formats and meanings.
    table = QTable()
    for name, values in columns.items():
        unit, form, meaning = COLUMNS.get(name, ("", "", ""))
        # Unknown units are kept unchanged.
        text = (image_unit or "adu") if unit == PIXEL_UNIT else unit
        column_unit = Unit(text, parse_strict="silent")
        table[name] = Quantity(values, column_unit, dtype=values.dtype) if unit else values
        table[name].info.description = meaning
        if form:
            table[name].info.format = form
    if star_list is None:
        return table
    # Columns of the list behind them, under names of their own.
    for name in star_list.colnames:
        column_name, names = name, {column.lower() for column in table.colnames}
        while column_name.lower() in names:
            column_name += "_list"
        with silent():  # a unit that suits no quantity leaves a plain column
            table[column_name] = star_list[name]
    return table


def rows_to_table(rows: Sequence[Mapping[str, object]], form: str = ".4g") -> Table:
    """Build a table from rows that have the same keys; real numbers are shown in a format.

    Parameters
    ----------
    rows : sequence of mappings
        Values by column name, of at least one row.
    form : str
        Format in which real numbers are shown; all digits are kept.
    """
    from astropy.table import Table

    # Columns have the order of the keys of the first row.
    return set_format(Table({name: [row[name] for row in rows] for name in rows[0]}), form)


def set_format(table: Table, form: str = ".4g") -> Table:
    """Set the format in which a table's real numbers are shown; all digits are kept.

    Parameters
    ----------
    table : Table
        Table whose columns get the format.
    form : str
        Format in which real numbers are shown, such as ".4g".
    """
    for column in table.itercols():
        if column.dtype.kind == "f":
            column.info.format = form
    return table


def fits_values(column: Column) -> np.ndarray:
    """Return a column of a table with types of FITS tables, shape (n,).

    Text is ASCII, as wide as the column, with question marks for other characters. Missing
    real numbers are NaN, missing whole numbers the minimum of their type.

    Parameters
    ----------
    column : Column, MaskedColumn or Quantity
        Numbers or text, perhaps masked, perhaps with a unit, which is left out.
    """
    # Values without mask and unit, and which of them are missing.
    unmasked_column = getattr(column, "unmasked", column)
    values = np.ma.getdata(np.asarray(getattr(unmasked_column, "value", unmasked_column)))
    is_missing = np.broadcast_to(np.asarray(getattr(column, "mask", False)), values.shape)
    # Characters of four bytes become one byte each.
    if values.dtype.kind in "US":
        width = max(values.dtype.itemsize // (4 if values.dtype.kind == "U" else 1), 1)
        texts = ["" if m else v for v, m in zip(values.tolist(), is_missing, strict=True)]
        encoded_texts = [v if isinstance(v, bytes) else v.encode("ascii", "replace") for v in texts]
        return np.array(encoded_texts, dtype=f"S{width}")
    # FITS has 16, 32 and 64 bits of whole numbers with a sign, 32 and 64 of real ones.
    if values.dtype.kind == "u" or values.dtype == np.int8:
        values = values.astype(np.float64 if values.dtype.itemsize == 8 else np.int64)
    elif values.dtype.kind == "f" and values.dtype.itemsize not in (4, 8):
        values = values.astype(np.float64)
    # FITS lacks masks: a value represents missing ones.
    if is_missing.any():
        values = np.where(is_missing, _missing(values.dtype), values).astype(values.dtype)
    return values


def _missing(dtype: np.dtype) -> Any:
    """Return the value that represents a missing value in FITS.

    Parameters
    ----------
    dtype : dtype
        Type of the column: NaN for real numbers, the minimum for whole numbers, else False.
    """
    if dtype.kind == "f":
        return np.nan
    return np.iinfo(dtype).min if dtype.kind == "i" else False


def as_fits(table: QTable, name: str) -> BinTableHDU:
    """Return a table as an extension of a FITS file, with units, meanings and missing values.

    Parameters
    ----------
    table : QTable
        Table with units and meanings, as of `star_table`.
    name : str
        Name of the extension.
    """
    from astropy.io import fits
    from astropy.table import Table

    # A table of FITS's types; astropy keeps the formats in which columns are shown.
    plain = Table({column: fits_values(table[column]) for column in table.colnames})
    for column in table.colnames:
        if isinstance(form := table[column].info.format, str):
            plain[column].info.format = form
    with silent():
        hdu = fits.table_to_hdu(plain)
    hdu.name = name
    # Unit, value of missing entries, and meaning of each column.
    for number, column in enumerate(table.colnames, start=1):
        info = table[column].info
        if info.unit is not None and str(info.unit):
            hdu.columns[column].unit = ascii_line(fits_unit(info.unit))
        if plain[column].dtype.kind == "i" and hasattr(table[column], "mask"):
            hdu.columns[column].null = int(_missing(plain[column].dtype))
        if info.description:
            hdu.header[f"TCOMM{number}"] = ascii_line(info.description)
    for key, value in table.meta.items():
        hdu.header[key] = value
    return hdu


def write_table(path: Path, table: QTable) -> None:
    """Write a table of stars to a file, in the format of its suffix.

    FITS and ECSV have all digits, CSV the digits that are shown. In CSV, texts cannot be formulas
    of a spreadsheet. A missing real number is `nan` there, so that readers need no mask, and any
    other missing value an empty cell.

    Parameters
    ----------
    path : Path
        File whose name ends in one of `SUFFIXES`.
    table : QTable
        Table with units and meanings, as of `star_table`.
    """
    from astropy.io import ascii as text_tables
    from astropy.io import fits
    from astropy.table import Table

    plain = Table(table)  # columns with units in place of quantities
    # Into memory first: astropy does not name the file if a disk is full.
    content, text = io.BytesIO(), io.StringIO()
    with silent():
        if path.suffix.lower() == ".fits":
            # A table is an extension behind an empty primary one.
            fits.HDUList([fits.PrimaryHDU(), as_fits(table, "STARS")]).writeto(content)
        elif path.suffix.lower() == ".ecsv":
            plain.write(text, format="ascii.ecsv")
        else:
            # Texts of a list, in bytes or not, may begin like a formula.
            plain.convert_bytestring_to_unicode()
            for name in [n for n in plain.colnames if plain[n].dtype.kind == "U"]:
                plain[name] = [no_formula(text or "") for text in plain[name].tolist()]
            plain.rename_columns(plain.colnames, [*map(no_formula, plain.colnames)])
            # Numbers have the format of their column; missing ones are written as NaN.
            for column in [*plain.columns.values()]:
                if column.dtype.kind == "f" and hasattr(column, "filled"):
                    plain[column.name] = column.filled(np.nan)
            plain.write(text, format="ascii.csv", fill_values=[(text_tables.masked, "")])
    write_bytes(path, content.getvalue() or text.getvalue().encode())


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of HTML; cells of the rows are HTML, cells of the head are text.

    Parameters
    ----------
    head : sequence of str, length k
        Titles of the columns, which are escaped.
    rows : sequence of sequences of str, length k each
        Cells of each row, which are not escaped.
    """
    # Head, then a line for each row.
    cells = "".join(f"<th>{escape(name)}</th>" for name in head)
    lines = ("".join(f"<td>{cell}</td>" for cell in row) for row in rows)
    return f"<table><tr>{cells}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"
