"""Verdicts on the images of a night, and the page that shows them.

In goes a table with a row for each image, in the order of time; out come a verdict and its reason
for each, figures of size and shape of the PSF against time, and an HTML page.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.base.figures import SERIES_COLORS, STAMP_MAP, as_png, new_figure, styled
from psfdae.image.tables import html_table
from psfdae.stars.moments import SIGMA_OF_MAD
from psfdae_paper.stars.nights import PLACES

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

VERDICTS = ("good", "poor", "failed")
"""Good images, those with a model that are unlike their neighbours in time, those without one."""

LIMITS = {
    "fwhm_px_centre": (0.5, "stars of {value:.2f} px, those of its neighbours in time {usual:.2f}"),
    "ellipticity_centre": (0.1, "elongated stars, ellipticity {value:.2f}: trailed?"),
    "mag_20th": (0.5, "stars fainter by {excess:.1f} mag than in its neighbours in time: clouds?"),
}
"""Least excess over the neighbours in time for which an image is poor, and what is said of it."""


def with_verdicts(night: DataFrame) -> DataFrame:
    """Return a table of a night with a verdict on each image, and the reason for it.

    A quantity of an image is compared with its median over the eleven images about it in time. It
    is unusual if it is larger by 5 σ, with the robust σ of all such differences of the night, and
    by the least excess of `LIMITS`.

    Parameters
    ----------
    night : DataFrame
        Rows in the order of time, with the column `reason` of images that have no model.
    """
    # A night without any model has no measurements.
    night = night.reindex(columns=[*night, *(name for name in LIMITS if name not in night)])
    night = night.assign(verdict=np.where(night.reason == "", "good", "failed"))
    for column, (least_excess, sentence) in LIMITS.items():
        value = night[column].dropna()
        usual = value.rolling(11, center=True, min_periods=1).median()
        excess = value - usual
        sigma = SIGMA_OF_MAD * (excess - excess.median()).abs().median()
        for row in excess.index[excess > max(5.0 * sigma, least_excess)]:
            words = {"value": value[row], "usual": usual[row], "excess": excess[row]}
            reasons = [night.loc[row, "reason"], sentence.format(**words)]
            night.loc[row, ["verdict", "reason"]] = "poor", "; ".join(filter(None, reasons))
    return night


@styled
def night_figure(night: DataFrame) -> Figure:
    """Draw FWHM and ellipticity at five places, and the brightness of stars, against time."""
    import pandas as pd

    figure = new_figure(6.5, layout="constrained")
    panels: Any = figure.subplots(3, 1, sharex=True)
    # Images without a time are drawn by their number.
    time = pd.to_datetime(night.time, errors="coerce", format="ISO8601")
    x = time if time.notna().sum() == night.fwhm_px_centre.notna().sum() else night.index
    for axes, column, label in (
        (panels[0], "fwhm_px", "FWHM (px)"),
        (panels[1], "ellipticity", "ellipticity"),
    ):
        for place, color in zip(PLACES, SERIES_COLORS, strict=False):
            values = night[f"{column}_{place}"]
            axes.plot(x, values, ".-", ms=4, lw=0.7, color=color, label=place.replace("_", " "))
        axes.set_ylabel(label)
        # The range is that of good images: an outlier must not flatten all others.
        usual = night[night.verdict == "good"][[f"{column}_{place}" for place in PLACES]]
        low, high = usual.min().min(), usual.max().max()
        if low < high:
            axes.set_ylim(low - 0.2 * (high - low), high + 0.3 * (high - low))
    panels[2].plot(x, -night.mag_20th, ".-", ms=4, lw=0.7, color="black")
    panels[2].set_ylabel("20th brightest star,\n2.5 log₁₀ of counts")
    panels[2].set_xlabel("time (UT)" if x is time else "number of the image")
    for axes in panels:
        axes.grid(True)
        for row in night.index[night.verdict == "poor"]:
            axes.axvline(x[row], color=SERIES_COLORS[5], lw=0.8, ls=":")
            if axes is panels[0]:
                name = night.name[row]
                axes.annotate(name, (x[row], 0.02), xycoords=axes.get_xaxis_transform(),
                              rotation=90, fontsize=6, ha="right")  # fmt: skip
    panels[0].legend(ncols=5, loc="upper center")
    return figure


@styled
def psf_figure(psfs: Mapping[str, np.ndarray]) -> Figure:
    """Draw PSFs (5, d, d) at `PLACES` of some images, by the label of the image, a row for each."""
    figure = new_figure(1.7 * len(psfs), layout="constrained")
    grid: Any = figure.subplots(len(psfs), len(PLACES), squeeze=False)
    for axes_row, (label, stamps) in zip(grid, psfs.items(), strict=True):
        axes_row[0].set_ylabel(label.replace(": ", "\n"), fontsize=7)
        for axes, place, stamp in zip(axes_row, PLACES, stamps, strict=True):
            # A square root shows core and outskirts in one picture.
            root = np.sqrt(np.clip(stamp / stamp.max(), 0.0, 1.0))
            axes.imshow(root, origin="lower", cmap=STAMP_MAP, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            if axes in grid[0]:
                axes.set_title(place.replace("_", " "), fontsize=8)
    return figure


PAGE = Template("""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>A night</title><style>
body { font: 15px/1.45 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em }
table { border-collapse: collapse; margin: 1em 0; font-size: .9em }
td, th { padding: .2em .7em; border-bottom: 1px solid #ddd; text-align: left }
.good { color: #007a5a } .poor { color: #b04000 } .failed { color: #a00000 }
img { max-width: 100%; display: block; margin: 1em 0 }
</style></head><body>
<h1>A night of $count images</h1><p><b>$verdicts</b></p>
<h2>Images to look at</h2>$inspect
$figures
<h2>All images</h2>$images
</body></html>
""")


def night_page(night: DataFrame, psfs: Mapping[str, np.ndarray], folder: str) -> str:
    """Return the page of a night as HTML.

    Parameters
    ----------
    night : DataFrame
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
    figures = ""
    if psfs:
        for title, figure in (
            ("Size and shape of the PSF against time", night_figure(night)),
            ("Best, median and worst PSF", psf_figure(psfs)),
        ):
            image = base64.b64encode(as_png(figure, dpi=110)).decode()
            figures += f'<h2>{title}</h2><img alt="" src="data:image/png;base64,{image}">'
    counts = ", ".join(f"{(night.verdict == verdict).sum()} {verdict}" for verdict in VERDICTS)
    return PAGE.substitute(
        count=len(night),
        verdicts=counts,
        inspect=html_table(head, unusual) if unusual else "<p>None.</p>",
        figures=figures,
        images=html_table(head, [cells(row) for row in rows.values()]),
    )
