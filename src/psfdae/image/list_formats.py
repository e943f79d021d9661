"""Star lists that astropy reads once it is told the format, and regions of DS9.

Every function takes the lines of a text file that are not blank.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from psfdae.image.errors import ObservationError, reading

if TYPE_CHECKING:
    from astropy.table import Table

REGION = re.compile(r"([+-]?)\s*([a-z]+)\s*[( ]\s*([^,\s)]+)[,\s]+([^,\s)]+)", re.IGNORECASE)
# Columns under which DS9's positions go; its pixels count from 1, as those of SExtractor do.
SYSTEMS = {
    "image": ("X_IMAGE", "Y_IMAGE"),
    "fk5": ("RAJ2000", "DEJ2000"),
    "j2000": ("RAJ2000", "DEJ2000"),
    "icrs": ("RA_ICRS", "DE_ICRS"),
}
OTHER_SYSTEMS = ("physical", "fk4", "b1950", "galactic", "ecliptic", "wcs", "detector", "amplifier")
CENTRED = ("circle", "point", "ellipse", "box", "annulus")
STETSON = re.compile(r"\s*NL\s+NX\s+NY\b")
STETSON_COLUMNS = ("id", "X_IMAGE", "Y_IMAGE")  # from 1, like SExtractor's


def votable(path: Path, lines: list[str], most_bytes: int) -> Table:
    """Read the only table with rows of a VOTable.

    Data that lie outside the file are refused, and columns that are far larger than it.
    """
    from astropy.io.votable import parse

    text = "\n".join(lines)
    if re.search(r"<!(DOCTYPE|ENTITY)", text):
        raise ObservationError(path, "a VOTable with entities of its own; write it without")
    for stream in re.findall(r"<(?:\w+:)?STREAM\b[^>]*", text):
        if "href" in stream or re.search(r"encoding\s*=\s*.(?!base64)", stream):
            raise ObservationError(path, "a VOTable whose data are not in it; write them into it")
    # Cells of a fixed size take their room in every row, also where a row has none.
    sizes = re.findall(r"arraysize\s*=\s*[\"']([0-9x]+)", text)
    cells = sum(float(np.prod([float(n) for n in size.split("x") if n])) for size in sizes)
    if 8 * cells * (text.count("TR>") + 1) > most_bytes:
        raise ObservationError(path, "a VOTable with arrays larger than the file")
    # The number of rows is counted; astropy would make room for as many as are announced.
    text = re.sub(r"\snrows\s*=\s*(\"[^\"]*\"|'[^']*')", " ", text)
    with reading(path):
        tables = [
            table.to_table(use_names_over_ids=True)
            for table in parse(io.BytesIO(text.encode()), verify="ignore").iter_tables()
            if len(table.array)
        ]
    if len(tables) != 1:
        raise ObservationError(path, f"{len(tables)} tables with stars in a VOTable, expected one")
    return tables[0]


def regions(path: Path, lines: list[str]) -> Table:
    """Read the centres of DS9's circles, points, ellipses, boxes and annuli.

    Their text is the column `id`, if all have one. Regions that are excluded (−) are left out.
    """
    from astropy.table import Table

    system, used = "", set()
    first, second, texts = [], [], []
    for line in lines:
        if line.lstrip().startswith(("#", "global")):
            continue
        body, _, properties = line.partition("#")
        # Coordinates hold for what follows, or stand before a shape: "fk5; circle(…)".
        for part in filter(None, map(str.strip, body.split(";"))):
            if part.lower() in SYSTEMS or part.lower() in OTHER_SYSTEMS:
                system = part.lower()
                continue
            circles = REGION.match(part)
            shape = circles[2].lower() if circles else part[:20]
            if circles is None or shape not in CENTRED:
                raise ObservationError(
                    path, f"region {shape!r}, expected one of {', '.join(CENTRED)}"
                )
            if circles[1] == "-":
                continue
            used.add(system)
            text = re.search(r"text\s*=\s*(?:\{([^}]*)\}|\"([^\"]*)\"|'([^']*)')", properties)
            first.append(circles[3])
            second.append(circles[4])
            texts.append("" if text is None else next(filter(None, text.groups()), ""))
    if len(used) > 1 or not used <= SYSTEMS.keys():
        raise ObservationError(
            path,
            f"regions in coordinates {', '.join(sorted(s or 'not stated' for s in used))}; "
            f"expected one of {', '.join(SYSTEMS)}: save them so in DS9",
        )
    names = SYSTEMS[used.pop()] if used else SYSTEMS["image"]
    table = Table(dict(zip(names, (first, second), strict=True)), dtype=["U40", "U40"])
    if texts and all(texts):
        table["id"] = texts
    return table


def stetson(path: Path, lines: list[str]) -> Table:
    """Read the first columns, number, x and y, of a list of DAOPHOT itself (three head lines)."""
    from astropy.table import Table

    rows = [line.split()[:3] for line in lines[2:]]
    if any(len(row) < 3 for row in rows):
        raise ObservationError(path, "a list of DAOPHOT with rows of fewer than three numbers")
    return Table(rows=rows, names=STETSON_COLUMNS) if rows else Table()


def without_vizier_head(rows: list[str]) -> list[str]:
    """Return the rows of a table without VizieR's lines of units and dashes below the names."""
    dashes = len(rows) > 2 and re.fullmatch(r"[-\t;|, ]*---?[-\t;|, ]*", rows[2])
    return [rows[0], *rows[3:]] if dashes else rows
