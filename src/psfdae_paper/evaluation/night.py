"""Verdicts on the images of a night, and the page that shows them.

Input: a table with a row for each image, in the order of time. Outputs: a verdict and its reason
for each image, figures of size and shape of the PSF against time, and an HTML page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import pandas as pd

from psfdae.base.figures import SERIES_COLORS, StripRow, apply_style, new_figure, restoration_strip
from psfdae.base.files import ProductError
from psfdae.base.reading import read_table
from psfdae.base.types import Figure
from psfdae.image.tables import html_table
from psfdae.report.page import image_tag
from psfdae.stars.moments import SIGMA_OF_MAD
from psfdae_paper.stars.nights import PLACES

VERDICTS = ("good", "poor", "failed")
"""Good images, those with a model that are unlike their neighbours in time, those without one."""

TEXT_COLUMNS = {"image", "name", "reason", "verdict", "start", "time"}
"""Columns of the table of a night that are texts, also if they look like numbers."""

TABLE_COLUMNS = {
    *(TEXT_COLUMNS - {"image"}),
    *("airmass", "order", "bright_stars", "stars", "flagged", "mag_20th"),
    *("zero_point", "zero_point_scatter", "chi2"),
    *(f"{quantity}_{place}" for quantity in ("fwhm_px", "ellipticity") for place in PLACES),
}
"""Columns that the table of a night has; one of a list with such a name gets `_list` at its end."""

PLAIN_NUMBER = r"(-?(0|[1-9][0-9]*)(\.[0-9]+)?)?"
"""Cells of a list's column of numbers; 007, 1e5 and NA are names."""

LIMITS = {
    "fwhm_px_centre": (
        0.5,
        "FWHM {value:.2f} px, median of its neighbours in time {median:.2f} px",
    ),
    "ellipticity_centre": (0.1, "elongated stars, ellipticity {value:.2f}: trailed?"),
    "mag_20th": (0.5, "stars fainter by {excess:.1f} mag than in its neighbours in time: clouds?"),
}
"""Minimum excess over the neighbours in time for which an image is poor, and the reason given."""


def add_verdicts(night: pd.DataFrame) -> pd.DataFrame:
    """Return a table of a night with a verdict on each image, and the reason for it.

    A quantity of an image is compared with its median over the eleven images about it in time. It
    is unusual if it is larger by 5 σ, with the robust σ of all such differences of the night, and
    by the minimum excess in `LIMITS`.

    Parameters
    ----------
    night : pd.DataFrame
        Rows in the order of time; the column `reason` says why an image has no model.
    """
    # A night without any model lacks the columns of measurements.
    night = night.reindex(columns=[*night, *(name for name in LIMITS if name not in night)])
    night = night.assign(verdict=np.where(night.reason == "", "good", "failed"))
    for column, (min_excess, sentence) in LIMITS.items():
        value = night[column].dropna()
        median = value.rolling(11, center=True, min_periods=1).median()
        excess = value - median
        sigma = SIGMA_OF_MAD * (excess - excess.median()).abs().median()
        for row in excess.index[excess > max(5.0 * sigma, min_excess)]:
            words = {"value": value[row], "median": median[row], "excess": excess[row]}
            reasons = [night.loc[row, "reason"], sentence.format(**words)]
            night.loc[row, ["verdict", "reason"]] = "poor", "; ".join(filter(None, reasons))
    return night


def read_night(path: Path, *columns: str) -> pd.DataFrame:
    """Return the table of a night, or of a part of it, with names as texts.

    Parameters
    ----------
    path : Path
        CSV file.
    *columns : str
        Names of columns that it must have.

    Raises
    ------
    ProductError
        If the file is missing or damaged, or lacks a column.
    """
    # Measurements, and columns of the list that are nothing but numbers, become numbers.
    table = read_table(path, *columns, dtype=str, keep_default_na=False)
    for name in table.columns.difference([*TEXT_COLUMNS]):
        cells = table[name]
        is_measured = name in TABLE_COLUMNS or name.startswith("telescope_")
        if is_measured or cells.str.fullmatch(PLAIN_NUMBER).all():
            try:
                table[name] = pd.to_numeric(cells)
            except ValueError as error:
                # Some columns of the telescope are texts, too.
                if name in TABLE_COLUMNS:
                    raise ProductError(f"{path}: column {name!r}: {error}") from None
    return table


def read_times(night: pd.DataFrame) -> tuple[Any, str]:
    """Return the time of each image, or its number where times are missing, and their label."""
    time = pd.to_datetime(night.time, errors="coerce", format="ISO8601")
    if time.notna().sum() == night.fwhm_px_centre.notna().sum():
        return time, "time (UT)"
    return night.index, "number of the image"


@apply_style
def draw_telescope_numbers(night: pd.DataFrame, names: Sequence[str]) -> Figure:
    """Draw numbers of the telescope, columns of the night's table, with their errors against time.

    The columns with the errors have `_error` at the end of their names.
    """
    figure = new_figure(0.4 + 0.8 * len(names), layout="constrained")
    panels: Any = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    x, label_of_x = read_times(night)
    is_measured = night[names[0]].notna()
    for axes, name in zip(panels, names, strict=True):
        columns = night[name][is_measured], night[f"{name}_error"][is_measured]
        axes.errorbar(x[is_measured], *columns, fmt=".-", ms=4, lw=0.7, color="black")
        # Name of the number above its unit.
        axes.set_ylabel("\n".join(name.removeprefix("telescope_").rsplit("_", 1)))
        axes.grid(True)
    panels[-1].set_xlabel(label_of_x)
    figure.suptitle("The telescope, as one image of each job shows it")
    return figure


@apply_style
def draw_night(night: pd.DataFrame) -> Figure:
    """Draw FWHM and ellipticity at five positions, and the brightness of stars, against time."""
    figure = new_figure(6.5, layout="constrained")
    panels: Any = figure.subplots(3, 1, sharex=True)
    x, label_of_x = read_times(night)
    for axes, column, label in (
        (panels[0], "fwhm_px", "FWHM (px)"),
        (panels[1], "ellipticity", "ellipticity"),
    ):
        for place, color in zip(PLACES, SERIES_COLORS, strict=False):
            values = night[f"{column}_{place}"]
            axes.plot(x, values, ".-", ms=4, lw=0.7, color=color, label=place.replace("_", " "))
        axes.set_ylabel(label)
        # Good images decide the range: an outlier must not flatten all others.
        good_values = night[night.verdict == "good"][[f"{column}_{place}" for place in PLACES]]
        if len(good_values) > 1:
            low, high = good_values.min().min(), good_values.max().max()
            axes.set_ylim(low - 0.2 * (high - low), high + 0.4 * (high - low))
    panels[2].plot(x, -night.mag_20th, ".-", ms=4, lw=0.7, color="black")
    panels[2].set(ylabel="20th brightest star,\n2.5 log₁₀ of counts", xlabel=label_of_x)
    for row in night.index[night.verdict == "poor"]:
        for axes in panels:
            axes.axvline(x[row], color=SERIES_COLORS[5], lw=0.8, ls=":")
        in_axes = {"transform": panels[0].get_xaxis_transform(), "rotation": 90, "ha": "right"}
        panels[0].text(x[row], 0.02, night.name[row], fontsize=6, **in_axes)
    for axes in panels:
        axes.grid(True)
    panels[0].legend(ncols=5, loc="upper center")
    return figure


def night_page(night: pd.DataFrame, psfs: Mapping[str, np.ndarray], folder: str) -> str:
    """Return the page of a night as HTML.

    Parameters
    ----------
    night : pd.DataFrame
        Table with verdicts.
    psfs : mapping of str to ndarray, shape (5, d, d)
        PSFs at `PLACES` of some images, by label.
    folder : str
        Folder of the report pages of the images, as the page links them.
    """

    def cells(row: Any) -> list[str]:
        """Return the cells of an image; those with a model link its report."""
        name, link = escape(str(row.name_)), escape(f"{folder}/{row.name_}.html")
        word = f"<b class={row.verdict}>{row.verdict}</b>"
        reason = escape(str(row.reason)) if isinstance(row.reason, str) else ""
        if row.verdict == "failed":
            return [name, word, reason, "", "", ""]
        numbers = f"{row.fwhm_px_centre:.2f}", f"{row.ellipticity_centre:.3f}"
        return [f'<a href="{link}">{name}</a>', word, reason, *numbers, f"{row.bright_stars:.0f}"]

    head = ("image", "verdict", "reason", "FWHM (px)", "ellipticity", "bright stars")
    rows = {row.Index: row for row in night.rename(columns={"name": "name_"}).itertuples()}
    unusual = [cells(row) for row in rows.values() if row.verdict != "good"]
    # Figures of a night with models: how the PSF moved, and its PSFs in the order of `PLACES`.
    figures = ""
    if psfs:
        places = [place.replace("_", " ") for place in PLACES]
        strip = [StripRow(label, stamps, own_scale=True) for label, stamps in psfs.items()]
        figures = image_tag(draw_night(night))
        figures += image_tag(restoration_strip(strip, places, "Best, median and worst PSF"))
    # Where the optics are known: the state of the telescope, or why it is not.
    state = night.filter(regex="^telescope_")
    numbers = {str(column) for column in state.select_dtypes("number")}
    names = [str(column) for column in state if {column, f"{column}_error"} <= numbers]
    if names:
        figures += image_tag(draw_telescope_numbers(night, names))
    for reason in (
        state.get("telescope_reason", night.reason[:0]).replace("", None).dropna().unique()
    ):
        figures += f"<p>State of the telescope: {escape(reason)}</p>"
    counts = ", ".join(f"{(night.verdict == verdict).sum()} {verdict}" for verdict in VERDICTS)
    template = Path(__file__).with_name("night.html").read_text(encoding="utf-8")
    return Template(template).substitute(
        count=len(night),
        verdicts=counts,
        inspect=html_table(head, unusual) if unusual else "<p>None.</p>",
        figures=figures,
        images=html_table(head, [cells(row) for row in rows.values()]),
    )
