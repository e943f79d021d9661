"""Star lists in files: FITS tables and LDAC, text tables, VOTable, DAOPHOT, DS9, VizieR.

In: a file. Out: its table as astropy has it, a row for each star in the order of the file.

The format follows from the content. astropy reads all tables once it is told their format; only
the lists of DAOPHOT itself and the regions of DS9 are read here.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfdae.image.errors import ObservationError, reading, shorten
from psfdae.image.fits_file import UNPACK, open_hdus, plain_file

if TYPE_CHECKING:
    from astropy.table import Table


def read_list_table(path: Path) -> Table:
    """Read the table of stars of a file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Table
        A row for each star, in the order of the file.

    Raises
    ------
    ObservationError
        If the file is missing, damaged, or of none of the formats.
    """
    with reading(path):
        content = path.read_bytes()
    # A FITS file, perhaps packed; of text, the first line that is not blank tells the format.
    if content.startswith((b"SIMPLE  =", *UNPACK)):
        return fits_table(path)
    # Text may begin with a mark of its encoding; a byte 0 is in no text.
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\x00"
    if "\x00" in text:
        raise ObservationError(path, "neither a FITS table nor text in UTF-8")
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        raise ObservationError(path, "the catalogue is empty")
    if lines[0].startswith("# Region file") or path.suffix.lower() == ".reg":
        return regions(path, lines)
    if lines[0].lstrip().startswith("<"):
        return votable(path, content)
    if re.match(r"\s*NL\s+NX\s+NY\b", lines[0]):
        return stetson(path, lines)
    return text_table(path, lines)


def fits_table(path: Path) -> Table:
    """Read the LDAC_OBJECTS or the only table of a FITS file; columns stay in the file till used.

    Parameters
    ----------
    path : Path

    Raises
    ------
    ObservationError
        If the file has not exactly one table that may be meant, or it is truncated.
    """
    from astropy.io import fits
    from astropy.table import Table

    file = plain_file(path)
    with reading(path), open_hdus(file, memmap=True) as hdus:
        # LDAC_IMHEAD has the header of the image, LDAC_OBJECTS the stars.
        tables = [
            hdu
            for hdu in hdus
            if isinstance(hdu, fits.BinTableHDU | fits.TableHDU) and hdu.name != "LDAC_IMHEAD"
        ]
        objects = [hdu for hdu in tables if hdu.name == "LDAC_OBJECTS"] or tables
        if len(objects) != 1:
            table_names = shorten([hdu.name or "(no name)" for hdu in objects])
            raise ObservationError(path, f"expected one table of stars, found {table_names}")
        # Rows that the header announces and the file does not have.
        size = objects[0].header["NAXIS1"] * objects[0].header["NAXIS2"]
        if objects[0].fileinfo()["datLoc"] + size > file.path.stat().st_size:
            raise ObservationError(path, "damaged: the table is larger than the file")
        return Table.read(objects[0], format="fits", mask_invalid=False, unit_parse_strict="silent")


def text_table(path: Path, lines: Sequence[str]) -> Table:
    """Read a text table from the lines of a file that are not blank.

    Parameters
    ----------
    path : Path
        The file, for messages.
    lines : sequence of str

    Raises
    ------
    ObservationError
        If there is no row of a star, or the text is no table.
    """
    from astropy.io import ascii as text_tables

    # IRAF's DAOPHOT, ECSV and SExtractor describe their columns in comments.
    options: dict[str, Any]
    if lines[0].startswith(("#K ", "#N ")):
        options = {"format": "daophot"}
    elif lines[0].startswith("# %ECSV"):
        options = {"format": "ecsv"}
    elif re.match(r"#\s*\d+\s+[A-Za-z_]\w*", lines[0]):
        options = {"format": "sextractor"}
    else:
        lines = plain_rows(lines)
        # The first mark that the line of names has.
        delimiter = next((mark for mark in ",;\t" if mark in lines[0]), " ") if lines else ","
        options = {"format": "basic", "delimiter": delimiter}
    if not lines:
        raise ObservationError(path, "the catalogue has no stars")
    with reading(path):
        # The line break at the end is what tells a table from the name of a file.
        return text_tables.read("\n".join(lines) + "\n", guess=False, **options)


def plain_rows(lines: Sequence[str]) -> Sequence[str]:
    """Return the rows of a text table, the names of its columns first, without comments.

    A comment right before numbers without names is the names. VizieR writes two lines of units and
    of dashes below the names, which are left out.

    Parameters
    ----------
    lines : sequence of str
        Lines that are not blank.
    """
    # Rows that are no comments, and the comments above the first of them.
    rows = [line for line in lines if not line.lstrip().startswith("#")]
    if not rows:
        return []
    preamble = lines[: lines.index(rows[0])]
    # The letter e may stand in a number.
    if preamble and not any(c.isalpha() for c in rows[0].replace("e", "").replace("E", "")):
        return [preamble[-1].lstrip("# \t"), *rows]
    has_dashes = len(rows) > 2 and re.fullmatch(r"[-\t;|, ]*---?[-\t;|, ]*", rows[2])
    return [rows[0], *rows[3:]] if has_dashes else rows


def votable(path: Path, content: bytes) -> Table:
    """Read the only table with rows of a VOTable.

    Data that lie elsewhere are refused: astropy would open any address that a file names.

    Parameters
    ----------
    path : Path
        The file, for messages.
    content : bytes
        Its content.

    Raises
    ------
    ObservationError
        If its data lie elsewhere, or not exactly one table has rows.
    """
    from astropy.io.votable import parse

    if re.search(rb"<!ENTITY|<(?:\w+:)?STREAM\b[^>]*\bhref", content):
        raise ObservationError(path, "a VOTable whose data are not in it; write them into it")
    # Tables of other things than stars may be there without rows.
    with reading(path):
        tables = [
            table.to_table(use_names_over_ids=True)
            for table in parse(io.BytesIO(content), verify="ignore").iter_tables()
            if len(table.array)
        ]
    if len(tables) != 1:
        raise ObservationError(path, f"{len(tables)} tables with stars in a VOTable, expected one")
    return tables[0]


def regions(path: Path, lines: Sequence[str]) -> Table:
    """Read the centres of DS9's circles, points, ellipses, boxes and annuli.

    Parameters
    ----------
    path : Path
        The file, for messages.
    lines : sequence of str
        Lines that are not blank.

    Returns
    -------
    Table
        Columns of positions as text: pixels from 1, or sky coordinates. The regions' text is the
        column `id`, if all have one. Regions that are excluded (−) are left out.

    Raises
    ------
    ObservationError
        If there is a region without a centre, or coordinates are not all of one system
        that is known.
    """
    from astropy.table import Table

    # Columns for positions by coordinates; pixels of DS9 count from 1, as SExtractor's do.
    systems_known = {
        "image": ("X_IMAGE", "Y_IMAGE"),
        "fk5": ("RAJ2000", "DEJ2000"),
        "j2000": ("RAJ2000", "DEJ2000"),
        "icrs": ("RA_ICRS", "DE_ICRS"),
    }
    other_systems = {"physical", "fk4", "b1950", "galactic", "ecliptic", "wcs", "detector"}
    shapes = ("circle", "point", "ellipse", "box", "annulus")
    form = re.compile(r"([+-]?)\s*([a-z]+)\s*[( ]\s*([^,\s)]+)[,\s]+([^,\s)]+)", re.IGNORECASE)
    system, systems = "", set()
    centres, labels = [], []
    for line in lines:
        if line.lstrip().startswith(("#", "global")):
            continue
        # Behind the # stand text, colour and the like.
        body, _, properties = line.partition("#")
        # Coordinates hold for what follows, or stand before a shape: "fk5; circle(…)".
        for part in filter(None, map(str.strip, body.split(";"))):
            if part.lower() in other_systems | systems_known.keys():
                system = part.lower()
                continue
            region = form.match(part)
            shape = region[2].lower() if region else part[:20]
            # A polygon or a line has no centre.
            if region is None or shape not in shapes:
                raise ObservationError(
                    path, f"region {shape!r}, expected one of {', '.join(shapes)}"
                )
            if region[1] == "-":
                continue
            systems.add(system)
            centres.append(region.group(3, 4))
            # Three ways to quote the text.
            label = re.search(r"text\s*=\s*(?:\{([^}]*)\}|\"([^\"]*)\"|'([^']*)')", properties)
            labels.append(next(filter(None, label.groups()), "") if label else "")
    if len(systems) > 1 or not systems <= systems_known.keys():
        raise ObservationError(
            path,
            f"regions in coordinates {', '.join(sorted(s or 'not stated' for s in systems))}; "
            f"expected one of {', '.join(systems_known)}: save them so in DS9",
        )
    # No region at all is an empty list, of which the caller says so.
    names = systems_known[systems.pop() if systems else "image"]
    table = Table(rows=centres or None, names=names, dtype=["U40", "U40"])
    if labels and all(labels):
        table["id"] = labels
    return table


def stetson(path: Path, lines: Sequence[str]) -> Table:
    """Read number, x and y, the first columns of a list of DAOPHOT (Stetson 1987, PASP 99, 191).

    Lists of the program itself have three head lines; those of IRAF's DAOPHOT are `text_table`'s.

    Parameters
    ----------
    path : Path
        The file, for messages.
    lines : sequence of str
        Lines that are not blank.

    Returns
    -------
    Table
        Columns `id`, `X_IMAGE` and `Y_IMAGE`, text; pixels count from 1, as SExtractor's do.

    Raises
    ------
    ObservationError
        If a row has fewer than three numbers.
    """
    from astropy.table import Table

    # Two of the three head lines are not blank.
    rows = [line.split()[:3] for line in lines[2:]]
    if any(len(row) < 3 for row in rows):
        raise ObservationError(path, "a list of DAOPHOT with rows of fewer than three numbers")
    return Table(rows=rows, names=("id", "X_IMAGE", "Y_IMAGE")) if rows else Table()
