"""How every figure looks: type sizes, colours, field angles; and the figure of restored stars."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.files import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN = 8.0
"""Width of every figure in inches."""

DPI = 150
"""Dots per inch of every PNG."""

SERIES_COLORS = ("#0072b2", "#e69f00", "#cc79a7", "#009e73", "#56b4e9", "#d55e00")
"""Colours of lines that are not methods."""

REFERENCES = {
    "realisation": "against the star's own noise-free image (realisation)",
    "template": "against the static PSF of the field (template)",
}
"""What each reference is, for titles."""

RC: dict[str, Any] = {
    "figure.dpi": DPI,
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

Drawing = Callable[..., "Figure"]


def styled(draw: Drawing) -> Drawing:
    """Draw in the style above, whatever matplotlibrc the user has."""

    @wraps(draw)
    def wrapped(*args: Any, **kwargs: Any) -> Figure:
        import matplotlib.style

        with matplotlib.style.context(["default", RC]):
            return draw(*args, **kwargs)

    return wrapped


def new_figure(height_in: float, **kwargs: Any) -> Figure:
    """An empty figure of the common width, outside pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, height_in), **kwargs)
    FigureCanvasAgg(figure)
    return figure


def as_png(figure: Figure) -> bytes:
    """The figure as PNG; the same figure gives the same bytes."""
    content = BytesIO()
    # The default metadata name matplotlib's version.
    figure.savefig(content, format="png", dpi=DPI, metadata={"Software": None})
    return content.getvalue()


def in_field_unit(field: np.ndarray) -> tuple[np.ndarray, str]:
    """Field angles in degrees, or in arc minutes if the whole field is within ±1°.

    Parameters
    ----------
    field : ndarray
        Angles in radians.

    Returns
    -------
    values : ndarray
    unit : str
        "deg" or "arcmin".
    """
    degrees = np.rad2deg(field)
    if np.abs(degrees).max() >= 1.0:
        return degrees, "deg"
    return 60.0 * degrees, "arcmin"


def write_png(figure: Figure, out: Path) -> None:
    """Write a matplotlib figure atomically; the same figure gives the same bytes."""
    write_bytes(out, as_png(figure))


# Restored stars: rows of stamps, a column for each star.

STAMP_MAP = "magma"


@dataclass(frozen=True)
class StripRow:
    """One row of a restoration strip.

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


def spread_stars(position: np.ndarray, count: int) -> np.ndarray:
    """Stars that lie evenly over the field, the same for the same stars.

    The targets ((k + ½)/n, fraction of ½ + k/φ), with φ the golden ratio, are a
    lattice that fills the square evenly; the first star nearest to each is
    taken, so the result goes from left to right.

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        Field position (x, y) of the stars, any unit.
    count : int
        Stars wanted; fewer come back if there are fewer.

    Returns
    -------
    ndarray of int, shape (min(count, n),)
    """
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    count = min(count, len(position))
    low, high = position.min(axis=0), position.max(axis=0)
    step = np.arange(count)
    target = np.stack([(step + 0.5) / count, (0.5 + step / golden) % 1.0], axis=1)
    target = low + target * (high - low)
    free = np.ones(len(position), dtype=bool)
    picks = []
    for point in target:
        distance = np.where(free, np.hypot(*(position - point).T), np.inf)
        # Rounding must not choose between equally near stars.
        nearest = int(np.argmax(distance <= distance.min() * (1.0 + 1e-9)))
        free[nearest] = False
        picks.append(nearest)
    return np.array(picks, dtype=int)


@styled
def restoration_strip(rows: Sequence[StripRow], columns: Sequence[str], title: str) -> Figure:
    """Stars before and after restoration, as in the paper; the first row is the reference.

    All stamps of a column share the colour scale 0 … maximum of the first row,
    on a square-root scale, except rows with `own_scale`. `columns` are headings of the stars.
    """
    longest = max(len(line) for row in rows for line in _lines(row.label))
    left, right, top, bottom, cell, text = max(1.0, 0.07 * longest), 0.1, 0.85, 0.35, 0.86, 0.17
    height = top + bottom + len(rows) * cell + text * sum(row.mse is not None for row in rows)
    figure = new_figure(height)
    width = figure.get_figwidth()
    step = (width - left - right) / len(columns)
    y = height - top
    peak = rows[0].images.max(axis=(1, 2))
    for number, row in enumerate(rows):
        y -= cell
        for i in range(len(row.images)):
            box = ((left + i * step) / width, y / height, 0.97 * step / width, 0.97 * cell / height)
            axes = draw_cell(figure, box, row, i, peak)
            if number == 0:
                axes.set_title(columns[i], fontsize=8, pad=3)
            if row.mse is not None:
                number_text = f"{1e6 * row.mse[i]:#.3g}".rstrip(".")
                axes.set_xlabel(number_text, fontsize=8, labelpad=1.5)
        y -= text if row.mse is not None else 0.0
    figure.suptitle(title, y=1.0 - 0.12 / height, va="top")
    figure.text(
        0.5,
        0.09 / height,
        "Colour: √flux from 0 to the reference's maximum in each column; noisy stamps to their own"
        " maximum. Numbers: MSE × 10⁶.",
        ha="center",
        va="bottom",
        fontsize=8,
    )
    return figure


def draw_cell(
    figure: Figure,
    box: tuple[float, float, float, float],
    row: StripRow,
    column: int,
    peak: np.ndarray,
) -> Axes:
    """A stamp of a row on a square-root scale up to `peak`, (n,); the first one has the label."""
    image = row.images[column]
    scale = image.max() if row.own_scale else peak[column]
    axes = figure.add_axes(box, xticks=[], yticks=[])
    axes.imshow(
        np.sqrt(np.clip(image / scale, 0.0, 1.0)),
        origin="lower",
        cmap=STAMP_MAP,
        vmin=0.0,
        vmax=1.0,
        interpolation="nearest",
    )
    if column == 0:
        label = "\n".join(_lines(row.label))
        axes.set_ylabel(label, rotation=0, ha="right", va="center", ma="right", labelpad=5)
    return axes


def _lines(label: str) -> list[str]:
    """Lines of a label: what is in brackets has one of its own."""
    return label.replace(" (", "\n(").splitlines()
