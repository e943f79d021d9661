"""How every figure looks: type sizes, colours, field angles."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.files import write_bytes

if TYPE_CHECKING:
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


def write_png(figure: Any, out: Path) -> None:
    """Write a matplotlib figure atomically; the same figure gives the same bytes."""
    write_bytes(out, as_png(figure))
