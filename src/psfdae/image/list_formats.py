"""Star lists in files: FITS tables and LDAC, text, VOTable, Parquet, DAOPHOT, DS9, VizieR.

Input: a file. Output: its table in astropy's form, a row for each star in the order of the file.

The format follows from the content. astropy and pyarrow read all tables; only the regions of DS9
are read here.
"""

from __future__ import annotations

import codecs
import io
import math
import operator
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.base.errors import require_extra
from psfdae.base.types import Table
from psfdae.image.errors import ObservationError, reading, shorten
from psfdae.image.fits_file import (
    PlainFile,
    compute_unpacked_max,
    name_other_format,
    open_hdus,
    unpack_file,
)
from psfdae.image.position_columns import find_identifier, has_positions

COLUMNS_MAX = 2000
"""Maximum number of columns of a text list; LSST's have 1300."""


def read_list_table(path: Path) -> Table:
    """Read the table of stars of a file.

    Parameters
    ----------
    path : Path
        File of any of the formats, which may be compressed.

    Returns
    -------
    Table
        A row for each star, in the order of the file.

    Raises
    ------
    ObservationError
        If the file is missing, damaged, or of none of the formats.
    """
    # A FITS file or a Parquet file; for text, the first line that is not blank shows the format.
    file, start = unpack_file(path)
    if start.startswith(b"SIMPLE  ="):
        return read_fits_table(file)
    if start.startswith(b"PAR1\x15"):  # PAR1 alone could be the name of a column
        return read_parquet_table(file)
    with reading(path):
        content = file.path.read_bytes()
    # Text may begin with a mark of its encoding; a byte 0 is in no text.
    is_utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\x00"
    format_name = name_other_format(start)
    if "\x00" in text or format_name:
        raise ObservationError(path, f"neither a FITS table nor text in UTF-8{format_name}")
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        raise ObservationError(path, "the catalogue is empty")
    if lines[0].startswith("# Region file") or path.suffix.lower() == ".reg":
        return read_regions(path, lines)
    if lines[0].lstrip().startswith("<"):
        return read_votable(path, content)
    # A list of DAOPHOT itself (Stetson 1987, PASP 99, 191) begins with number, x and y. Its pixels
    # count from 1, as SExtractor's do. Two of its three head lines are not blank.
    if re.match(r"\s*+NL\s++NX\s++NY\b", lines[0]):
        rows = (" ".join(line.split()[:3]) for line in lines[2:])
        lines = ["id X_IMAGE Y_IMAGE", *rows]
    return read_text_table(path, lines)


def read_fits_table(file: PlainFile) -> Table:
    """Read the LDAC_OBJECTS or the only table of a FITS file; columns stay in the file till used.

    Parameters
    ----------
    file : PlainFile
        FITS file, which messages call by its `name`.

    Raises
    ------
    ObservationError
        If the file has not exactly one table that may be meant, or it is truncated.
    """
    from astropy.io import fits
    from astropy.table import Table

    path = file.name
    with reading(path), open_hdus(file, memmap=True) as hdus:
        # LDAC_IMHEAD has the header of the image, LDAC_OBJECTS the stars.
        tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)]
        tables = [hdu for hdu in tables if hdu.name != "LDAC_IMHEAD"]
        objects = [hdu for hdu in tables if hdu.name == "LDAC_OBJECTS"] or tables
        if len(objects) != 1:
            table_names = shorten([hdu.name or "(no name)" for hdu in objects])
            raise ObservationError(path, f"expected one table of stars, found {table_names}")
        # Rows that the header announces and the file does not have, or arrays that share bytes.
        file_size, header = file.path.stat().st_size, objects[0].header
        if objects[0].fileinfo()["datLoc"] + header["NAXIS1"] * header["NAXIS2"] > file_size:
            raise ObservationError(path, "damaged: the table is larger than the file")
        rows = np.asarray(objects[0].data)
        arrays = [c.name for c in objects[0].columns if re.match(r"\d*[PQ]", str(c.format))]
        if sum(np.abs(rows[name][:, 0]).sum() for name in arrays) > 8 * file_size:
            raise ObservationError(path, "damaged: its arrays are larger than the file")
        return Table.read(objects[0], format="fits", mask_invalid=False, unit_parse_strict="silent")


def read_parquet_table(file: PlainFile) -> Table:
    """Read the columns of a Parquet file of which each row is a star.

    Parameters
    ----------
    file : PlainFile
        File to read.

    Raises
    ------
    ObservationError
        If the file is damaged.
    MissingExtraError
        If pyarrow or pandas is not installed.
    """
    from astropy.table import Table

    with require_extra(f"the star list {file.name}"), reading(file.name):
        from pyarrow import parquet

        # Rows that are equal take no space in the file.
        metadata = parquet.read_metadata(file.path)
        size = 8 * metadata.num_rows * metadata.num_columns
        if size > compute_unpacked_max(file.path.stat().st_size):
            raise ObservationError(file.name, f"unpacks to {size} bytes; write it as FITS")
        # Damaged pages are found by their checksums, if the file has them.
        rows = parquet.read_table(file.path, page_checksum_verification=True)
        return Table.from_pandas(rows.to_pandas())


def read_text_table(path: Path, lines: Sequence[str]) -> Table:
    """Read a text table from the lines of a file that are not blank.

    Parameters
    ----------
    path : Path
        The file, for messages.
    lines : sequence of str
        Lines that are not blank.

    Raises
    ------
    ObservationError
        If a row of a star or the names of columns are missing, or the text is not a table.
    """
    from astropy.io import ascii as text_tables

    head = "\n".join(line[:1000] for line in lines[:200])
    names = (name for name, form in TEXT_FORMATS.items() if re.match(form, head, re.MULTILINE))
    options = {"format": next(names, "basic")}
    if options["format"] == "basic" and (lines := select_rows(lines)):
        # The first mark that the line of names has; of tabs, the first name may be blank.
        options["delimiter"] = next((mark for mark in ",;\t" if mark in lines[0]), " ")
        if lines[0].lstrip(" ").startswith("\t"):
            options = {"format": "tab"}
    if not lines:
        raise ObservationError(path, "the catalogue has no stars")
    if has_mostly_numbers(lines[0]):
        problem = f"no names of columns: its first row is {lines[0].strip()[:40]!r}"
        raise ObservationError(path, f"{problem}; write a row such as 'x y' above it")
    if "X(FITS)_T1" in lines[0]:
        raise ObservationError(path, "a table of AstroImageJ with a row for each image")
    # The time of astropy grows with the square of the length of a name, and of their number.
    for line in [lines[0], *(line for line in lines if line.startswith("|"))]:
        words = re.split(r"[,;|\s]+", line)
        if max(len(words), *map(len, words)) > COLUMNS_MAX:
            raise ObservationError(path, f"more than {COLUMNS_MAX} columns, or letters in a name")
    with reading(path):
        # The line break at the end distinguishes a table from the name of a file.
        table = text_tables.read("\n".join(lines) + "\n", guess=False, **options)
        return keep_identifier_texts(table, lines, options)


def keep_identifier_texts(table: Table, lines: Sequence[str], options: Mapping[str, Any]) -> Table:
    """Keep the identifiers of a text table as they are written: 001 is not 1, nor 1e5 100000.0.

    Parameters
    ----------
    table : Table
        The table as astropy reads it.
    lines : sequence of str
        Lines of the table.
    options : mapping
        Options with which astropy reads them.
    """
    from astropy.io import ascii as text_tables

    # ECSV and the formats of IRAF and CDS have types of their own.
    name, form = find_identifier(table.colnames), options["format"]
    if name is None or form not in ("basic", "tab", "sextractor", "ipac"):
        return table
    # astropy's fast reader takes no types, but a column with a second row of names is text.
    options = {"guess": False, **options, "include_names": [name]}
    if form in ("basic", "tab"):
        lines = [lines[0], *lines]
    else:
        options["converters"] = {name: [text_tables.convert_numpy(str)]}
    texts = text_tables.read("\n".join(lines) + "\n", **options)[name][-len(table) :]
    # Whole numbers stay numbers if their texts are the same.
    if table[name].dtype.kind != "i" or (table[name].astype(str) != texts).any():
        table[name] = texts
    return table


TEXT_FORMATS = {
    "daophot": r"#[KN] ",
    "ecsv": r"# %ECSV",
    # Each comment is of a column. Siril's first one begins with a number, too.
    "sextractor": r"#\s*\d+\s+[A-Za-z_].*\n#\s*\d+\s+[A-Za-z_]",
    "ipac": r"[|\\]",
    "cds": r"(?s:.*)^Byte-by-byte Description",
}
"""Formats of astropy that describe their columns above the rows, by their beginning; any other text
table is "basic"."""


def has_mostly_numbers(row: str) -> bool:
    """Return True if most words of a row of a text table are numbers, or sexagesimal angles."""
    words = re.split(r"[,;|\s]+", row.strip())
    form = re.compile(r"[-+.:\d]++(?:[eE][-+]?\d++)?")
    return 2 * sum(form.fullmatch(word) is not None for word in words) > len(words)


def select_rows(lines: Sequence[str]) -> Sequence[str]:
    """Select the rows of a text table, the names of its columns first, without comments.

    A comment above numbers without names gives the names if it has as many words as the numbers'
    first row: of several comments, the last with names of positions, or else the last. VizieR
    writes two lines of units and of dashes below the names, which are left out.

    Parameters
    ----------
    lines : sequence of str
        Lines that are not blank.
    """
    # Rows that are not comments, and the comments above the first row.
    rows = [line for line in lines if not line.lstrip().startswith("#")]
    if not rows:
        return []
    preamble = lines[: lines.index(rows[0])]
    if preamble and has_mostly_numbers(rows[0]):
        mark = next((mark for mark in ",;\t" if mark in rows[0]), None)
        texts = [line.lstrip("# \t") for line in reversed(preamble[-50:])]
        names = [text for text in texts if len(text.split(mark)) == len(rows[0].split(mark))]
        header_row = max(names, key=lambda text: has_positions(text.split(mark)), default=None)
        return rows if header_row is None else [header_row, *rows]
    has_dashes = len(rows) > 2 and "--" in rows[2] and not rows[2].strip("-\t;|, ")
    return [rows[0], *rows[3:]] if has_dashes else rows


def read_votable(path: Path, content: bytes) -> Table:
    """Read the only table with rows of a VOTable.

    Data outside the file are rejected: astropy would open any address that a file names.

    Parameters
    ----------
    path : Path
        The file, for messages.
    content : bytes
        Its content.

    Raises
    ------
    ObservationError
        If its data lie outside the file, or not exactly one table has rows.
    """
    from astropy.io.votable import parse
    from astropy.utils.xml.iterparser import get_xml_iterator

    with reading(path):
        # The elements as the reader of VOTables gets them, whatever their spelling in the file. It
        # has memory for the rows and values that they announce, 256 rows at least.
        rows, widths = 256, [0]
        with get_xml_iterator(io.BytesIO(content)) as elements:
            for _, tag, attributes, _ in filter(operator.itemgetter(0), elements):
                if tag == "STREAM" and "href" in attributes:
                    problem = "a VOTable whose data are not in it"
                    raise ObservationError(path, f"{problem}; write them into it")
                rows = max(rows, int(attributes.get("nrows", 0)))
                if tag == "FIELD":
                    sizes = re.findall(r"\d+", attributes.get("arraysize", "")[:1000])
                    widths.append(8 * math.prod(map(int, sizes)))
        if len(widths) > COLUMNS_MAX or rows * sum(widths) > compute_unpacked_max(len(content)):
            raise ObservationError(path, f"damaged: {len(widths)} columns, {rows} rows")
        # Tables of other things than stars may be there without rows.
        all_tables = parse(io.BytesIO(content), verify="ignore").iter_tables()
        tables = [t.to_table(use_names_over_ids=True) for t in all_tables if len(t.array)]
    if len(tables) != 1:
        raise ObservationError(path, f"{len(tables)} tables with stars in a VOTable, expected one")
    return tables[0]


def read_regions(path: Path, lines: Sequence[str]) -> Table:
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
        If a region lacks a centre, or the coordinates are not all of one known system.
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
    # Sign, shape and centre. No part gives back what it has matched (++), so that the time grows
    # with the length of a line, and not with its square.
    form = re.compile(
        r"([+-]?)\s*+([a-z]++)(?:\s*+\(|\s)\s*+([^,\s)]++)[,\s]++([^,\s)]++)", re.IGNORECASE
    )
    system, systems = "", set()
    centres, labels = [], []
    for line in lines:
        if line.lstrip().startswith(("#", "global")):
            continue
        # Behind the # stand text, colour and the like.
        body, _, properties = line.partition("#")
        # A system holds for the shapes that follow, or stands before a shape: "fk5; circle(…)".
        for part in filter(None, map(str.strip, body.split(";"))):
            if part.lower() in other_systems | systems_known.keys():
                system = part.lower()
                continue
            region = form.match(part)
            shape = region[2].lower() if region else part[:20]
            # A polygon or a line does not have a centre.
            if region is None or shape not in shapes:
                raise ObservationError(
                    path, f"region {shape!r}, expected one of {', '.join(shapes)}"
                )
            if region[1] == "-":
                continue
            systems.add(system)
            centres.append(region.group(3, 4))
            # Three ways to quote the text.
            label = re.search(r"text\s*+=\s*+(?:\{([^}]*+)|\"([^\"]*+)|'([^']*+))", properties)
            labels.append(next(filter(None, label.groups()), "") if label else "")
    if len(systems) > 1 or not systems <= systems_known.keys():
        raise ObservationError(
            path,
            f"regions in coordinates {', '.join(sorted(s or 'not given' for s in systems))}; "
            f"expected one of {', '.join(systems_known)}: save them so in DS9",
        )
    # Without any region the list is empty, which the caller reports.
    names = systems_known[systems.pop() if systems else "image"]
    table = Table(rows=centres or None, names=names, dtype=["U40", "U40"])
    if labels and all(labels):
        table["id"] = labels
    return table
