"""The PSFs of a telescope over its field, with their light and their width.

Arrays in, a matplotlib figure out. Stamps and field are drawn with y upwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.evaluation.figure_style import in_field_unit, new_figure, styled
from psfdae.evaluation.figures import STAMP_MAP, mosaic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GAP = 1
"""Pixels between stamps."""

MAX_NUMBERED = 7
"""Grids with more points a side get no numbers in their cells: they would touch."""

LEAST_RANGE = 0.05
"""Colours span at least this fraction of the values: rounding errors are no structure."""

WHISKER = 1.6
"""Length of the whisker of a line (ellipticity 1), in distances of field points."""


@dataclass(frozen=True)
class FieldOfPsfs:
    """Static PSFs of F field points.

    Attributes
    ----------
    psf : ndarray, shape (F, d, d)
    grid : ndarray of int, shape (F, 2)
        Grid index (ix, iy).
    field : ndarray, shape (F, 2)
        Field angle (x, y) in radians.
    energy : ndarray, shape (F,)
        Fraction of the light inside the stamp.
    fwhm_arcsec, ellipticity, position_angle_deg : ndarray, shape (F,)
        As `psfdae.own_stars.shapes.Shapes`.
    """

    psf: np.ndarray
    grid: np.ndarray
    field: np.ndarray
    energy: np.ndarray
    fwhm_arcsec: np.ndarray
    ellipticity: np.ndarray
    position_angle_deg: np.ndarray


@styled
def field_of_psfs(fields: FieldOfPsfs, name: str, pixel_scale_arcsec: float) -> Figure:
    """Mosaic of all stamps; beside it maps of the light in the stamp and of the FWHM.

    Whiskers in the map of the FWHM show the direction of the longer axis, their
    length the ellipticity.

    Parameters
    ----------
    fields : FieldOfPsfs
    name : str
        The telescope, for the title.
    pixel_scale_arcsec : float
    """
    figure = new_figure(5.3, layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(2.1, 1.0))
    side = fields.psf.shape[-1]
    _stamps(figure.add_subplot(grid[:, 0]), fields)
    light = figure.add_subplot(grid[0, 1])
    shown = _map(light, fields, fields.energy, "viridis", "light inside the stamp")
    if fields.grid.max() < MAX_NUMBERED:
        _numbers(light, fields, fields.energy, shown)
    width = figure.add_subplot(grid[1, 1])
    _map(width, fields, fields.fwhm_arcsec, "cividis", "FWHM (arcsec)")
    _whiskers(width, fields)
    figure.suptitle(
        f"{name}: {len(fields.psf)} static PSFs, stamps of {side} × {side} px = "
        f"{side * pixel_scale_arcsec:.3g}″ × {side * pixel_scale_arcsec:.3g}″"
    )
    return figure


def _stamps(axes: Axes, fields: FieldOfPsfs) -> None:
    from matplotlib import colormaps

    share = fields.psf / fields.psf.max(axis=(1, 2), keepdims=True)
    image = mosaic(np.sqrt(np.clip(share, 0.0, None)), fields.grid, GAP)
    shown = axes.imshow(
        image,
        origin="lower",
        extent=_extent(fields, fields.psf.shape[-1], GAP),
        cmap=colormaps[STAMP_MAP].with_extremes(bad="#b0b0b0"),
        vmin=0.0,
        vmax=1.0,
        interpolation="nearest",
    )
    _label(axes, fields, both=True)
    ticks = np.array([0.0, 0.01, 0.1, 0.25, 0.5, 1.0])
    bar = axes.figure.colorbar(shown, ax=axes, orientation="horizontal", shrink=0.8, aspect=40)
    bar.set_ticks(np.sqrt(ticks), labels=[f"{tick:g}" for tick in ticks])
    bar.set_label("pixel flux / maximum of the stamp")


def _map(axes: Axes, fields: FieldOfPsfs, values: np.ndarray, colours: str, title: str) -> Any:
    image = mosaic(values[:, None, None], fields.grid, gap=0)
    middle = 0.5 * (values.min() + values.max())
    half = 0.5 * max(float(np.ptp(values)), LEAST_RANGE * middle)
    shown = axes.imshow(
        image,
        origin="lower",
        extent=_extent(fields, 1, 0),
        cmap=colours,
        vmin=middle - half,
        vmax=middle + half,
        interpolation="nearest",
    )
    _label(axes, fields, both=False)
    axes.set_title(f"{title}: {values.min():.2f} … {values.max():.2f}")
    axes.figure.colorbar(shown, ax=axes, shrink=0.9)
    return shown


def _numbers(axes: Axes, fields: FieldOfPsfs, values: np.ndarray, shown: Any) -> None:
    position, _ = in_field_unit(fields.field)
    for (x, y), value in zip(position, values, strict=True):
        red, green, blue, _ = shown.cmap(shown.norm(value))
        colour = "white" if 0.299 * red + 0.587 * green + 0.114 * blue < 0.5 else "black"
        axes.text(x, y, f"{value:.2f}", ha="center", va="center", color=colour, fontsize=6.5)


def _whiskers(axes: Axes, fields: FieldOfPsfs) -> None:
    position, _ = in_field_unit(fields.field)
    angle = np.deg2rad(fields.position_angle_deg)
    reach = 0.5 * WHISKER * _step(fields) * fields.ellipticity
    ends = reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for start, stop in zip(position - ends, position + ends, strict=True):
        axes.plot(*np.stack([start, stop], axis=1), color="white", linewidth=1.6)
        axes.plot(*np.stack([start, stop], axis=1), color="#c2185b", linewidth=0.9)


def _step(fields: FieldOfPsfs) -> float:
    """Distance of neighbouring field points in the unit of the axes; 1 if there is one."""
    position, _ = in_field_unit(fields.field)
    points = int(fields.grid[:, 0].max()) + 1
    return float(np.ptp(position[:, 0])) / (points - 1) if points > 1 else 1.0


def _extent(fields: FieldOfPsfs, side: int, gap: int) -> tuple[float, ...]:
    """Edges (left, right, bottom, top) that put each stamp's centre on its field point."""
    position, _ = in_field_unit(fields.field)
    margin = (gap + 0.5 * side) * _step(fields) / (side + gap)
    low, high = position.min(axis=0) - margin, position.max(axis=0) + margin
    return (low[0], high[0], low[1], high[1])


def _label(axes: Axes, fields: FieldOfPsfs, both: bool) -> None:
    _, unit = in_field_unit(fields.field)
    if both:
        axes.set_xlabel(f"field angle x ({unit})")
    axes.set_ylabel(f"field angle y ({unit})" if both else f"y ({unit})")
