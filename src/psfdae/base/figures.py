"""Style of all figures, and the figure of restored stars.

Inputs: stamps of stars, or a function that draws a figure. Outputs: figures of one width and
style, and PNG files.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.base.files import write_bytes
from psfdae.base.types import Axes, Figure

WIDTH_IN = 8.0
"""Width of every figure in inches."""

SERIES_COLORS = ("#0072b2", "#e69f00", "#cc79a7", "#009e73", "#56b4e9", "#d55e00")
"""Colours of lines that are not methods."""

Inches = tuple[float, float]
"""Position (x, y), or width and height, in inches."""

Drawing = Callable[..., "Figure"]


def use_style() -> AbstractContextManager[None]:
    """Return a context with the style of all figures, independent of the user's matplotlibrc."""
    import matplotlib.style

    # Sizes of text in points, for figures as wide as a page.
    style = {
        "figure.dpi": 150,
        "font.size": 9,
        "axes.titlesize": 10,
        "axes.labelsize": 9,
        "xtick.labelsize": 8,
        "ytick.labelsize": 8,
        "legend.fontsize": 8,
        "figure.titlesize": 11,
        "axes.grid": False,
        "grid.color": "#d9d9d9",
        "grid.linewidth": 0.6,
    }
    return matplotlib.style.context(["default", style])


def apply_style(draw: Drawing) -> Drawing:
    """Decorate a function that draws a figure, so that it uses the style of all figures.

    Texts are not parsed as formulae: a name may contain dollar signs.
    """

    @wraps(draw)
    def draw_in_style(*args: Any, **kwargs: Any) -> Figure:
        from matplotlib.text import Text

        with use_style():
            figure = draw(*args, **kwargs)
        # Labels of ticks, such as 10⁻³, are formulae. matplotlib makes them later, when it draws,
        # so that they are still empty here.
        for text in figure.findobj(Text):
            if text.get_text():
                text.set_parse_math(False)
        return figure

    return draw_in_style


def new_figure(height_in: float, **kwargs: Any) -> Figure:
    """Return an empty figure of the common width, outside of pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # The Agg canvas draws without a screen.
    figure = Figure(figsize=(WIDTH_IN, height_in), **kwargs)
    FigureCanvasAgg(figure)
    return figure


def as_png(figure: Figure, dpi: int = 150) -> bytes:
    """Return a figure as PNG; the same figure gives the same bytes."""
    # In memory first, so that a file is written atomically.
    content = BytesIO()
    # The style is needed again, because matplotlib makes ticks only now. Its default metadata
    # would contain its version.
    with use_style():
        figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None})
    return content.getvalue()


def write_png(figure: Figure, out: Path) -> None:
    """Write a matplotlib figure atomically; the same figure gives the same bytes."""
    write_bytes(out, as_png(figure))


# Restored stars: rows of stamps, a column for each star.

STAMP_MAP = "magma"
"""Colour map of stamps."""


@dataclass(frozen=True)
class StripRow:
    """Row of a restoration strip: stamps of one kind, a column for each star.

    Attributes
    ----------
    label : str
        Text at the left.
    images : ndarray, shape (n, d, d)
        Flux-normalised stamps, one per column.
    mse : ndarray, shape (n,), optional
        Error against the first row, printed under the stamps.
    own_scale : bool
        Scale each stamp by its own maximum instead of the first row's.
    """

    label: str
    images: np.ndarray
    mse: np.ndarray | None = None
    own_scale: bool = False

    @property
    def lines(self) -> list[str]:
        """Lines of the label: a part in brackets has a line of its own."""
        return self.label.replace(" (", "\n(").splitlines()


def spread_stars(position: np.ndarray, count: int) -> np.ndarray:
    """Select stars that lie evenly over the field, without any random choice.

    The targets ((k + ½)/n, fraction of ½ + k/φ), with φ the golden ratio, are a
    lattice that fills the unit square evenly. The star nearest to each target is
    selected; the targets go from left to right.

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        Field position (x, y) of the stars, any unit.
    count : int
        Number of stars to select; all if there are fewer.

    Returns
    -------
    ndarray of int, shape (min(count, n),)
        Indices of the stars, from left to right.
    """
    # Targets in the unit square, then in the range of the positions.
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    count = min(count, len(position))
    low, high = position.min(axis=0), position.max(axis=0)
    step = np.arange(count)
    target = np.stack([(step + 0.5) / count, (0.5 + step / golden) % 1.0], axis=1)
    target = low + target * (high - low)
    # The nearest star to each target that is not yet selected.
    available = np.ones(len(position), dtype=bool)
    indices = []
    for point in target:
        distance = np.where(available, np.hypot(*(position - point).T), np.inf)
        # Rounding must not choose between equally near stars.
        nearest = int(np.argmax(distance <= distance.min() * (1.0 + 1e-9)))
        available[nearest] = False
        indices.append(nearest)
    return np.array(indices, dtype=int)


@apply_style
def restoration_strip(rows: Sequence[StripRow], columns: Sequence[str], title: str) -> Figure:
    """Draw stars before and after restoration, as in the paper; the first row is the target.

    All stamps of a column share the colour scale 0 … maximum of the first row,
    on a square-root scale, except rows with `own_scale`.

    Parameters
    ----------
    rows : sequence of StripRow
        Rows from top to bottom.
    columns : sequence of str
        Heading of each star.
    title : str
        Title of the figure.
    """
    # Margins, height of a row and of the numbers below it, in inches.
    longest = max(len(line) for row in rows for line in row.lines)
    margin_left, margin_right = max(1.0, 0.08 * longest), 0.1
    top, bottom, cell, text = 0.85, 0.35, 0.86, 0.17
    # Numbers stand below the rows that have errors.
    height = top + bottom + len(rows) * cell + text * sum(row.mse is not None for row in rows)
    figure = new_figure(height)
    # Cells of equal width from the labels to the right margin.
    axes = add_axes_in(figure)
    step = (WIDTH_IN - margin_left - margin_right) / len(columns)
    # Stamps fill 97 % of their cells.
    middle = margin_left + step * (np.arange(len(columns)) + 0.5 * 0.97)
    y = height - top
    # From top to bottom: headings, and each row with its errors below.
    peak = rows[0].images.max(axis=(1, 2))
    for x, name in zip(middle, columns, strict=True):
        axes.text(x, y + 0.02, name, ha="center", va="bottom", fontsize=8)
    for row in rows:
        y -= cell
        draw_row(axes, row, (margin_left, y), (step, cell), peak)
        # Three digits of the MSE in units of 1e-6.
        if row.mse is not None:
            for x, error in zip(middle, row.mse, strict=True):
                number = f"{1e6 * error:#.3g}".rstrip(".")
                axes.text(x, y - 0.02, number, ha="center", va="top", fontsize=8)
            y -= text
    figure.suptitle(title, y=1.0 - 0.12 / height, va="top")
    explanation = (
        "Colour: √flux from 0 to the reference's maximum in each column; noisy stamps to their own"
        " maximum. Numbers: MSE × 10⁶."
    )
    if any(row.mse is not None for row in rows):
        axes.text(0.5 * WIDTH_IN, 0.09, explanation, ha="center", va="bottom", fontsize=8)
    return figure


def add_axes_in(figure: Figure) -> Axes:
    """Return empty axes over a whole figure, in inches from its lower left corner."""
    # One unit of the axes is an inch on the page.
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set(xlim=(0.0, figure.get_figwidth()), ylim=(0.0, figure.get_figheight()))
    axes.set_autoscale_on(False)
    return axes


def draw_row(axes: Axes, row: StripRow, corner: Inches, cell: Inches, peak: np.ndarray) -> None:
    """Draw the stamps of a row on a square-root scale, with its label at the left.

    Parameters
    ----------
    axes : Axes
        Axes in inches.
    row : StripRow
        The row.
    corner : tuple of float
        Lower left corner (x, y) of the first cell.
    cell : tuple of float
        Width and height of a cell.
    peak : ndarray, shape (n,)
        Value of the brightest colour for each star.
    """
    # The square of a stamp, in the middle of 97 % of its cell; the remainder is a gap.
    width, height = (0.97 * length for length in cell)
    side = min(width, height)
    lower = corner[1] + 0.5 * (height - side)
    for column, image in enumerate(row.images):
        # From 0 to the brightest pixel; a square root shows faint wings, too.
        scale = image.max() if row.own_scale else peak[column]
        x = corner[0] + column * cell[0] + 0.5 * (width - side)
        axes.imshow(
            np.sqrt(np.clip(image / scale, 0.0, 1.0)),
            extent=(x, x + side, lower, lower + side),
            origin="lower",
            cmap=STAMP_MAP,
            vmin=0.0,
            vmax=1.0,
            interpolation="nearest",
        )
    x, y, label = corner[0] - 0.06, lower + 0.5 * side, "\n".join(row.lines)
    axes.text(x, y, label, ha="right", va="center", ma="right", fontsize=9)
