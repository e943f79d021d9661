"""Figures made of stamps: a telescope's PSFs and their light over the field.

Every function takes arrays and returns a matplotlib figure; nothing is read or
written here. Row 0 of a stamp is at its lowest field angle y, so stamps and
field are both drawn with y upwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from psfdae.figures import STAMP_MAP, in_field_unit, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

MAX_NUMBERED, MAX_NUMBERED_SMALL = 15, 7
"""Grids with more points a side get no numbers in their cells: they would touch."""

GAP = 1
"""Pixels between stamps."""

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
        As `psfdae.moments.Shapes`.
    """

    psf: np.ndarray
    grid: np.ndarray
    field: np.ndarray
    energy: np.ndarray
    fwhm_arcsec: np.ndarray
    ellipticity: np.ndarray
    position_angle_deg: np.ndarray


def mosaic(stamps: np.ndarray, grid: np.ndarray, gap: int = 1) -> np.ndarray:
    """Stamps side by side at their grid positions.

    Stamp (ix, iy) starts at row gap + iy (d + gap) and column gap + ix (d + gap)
    and is not flipped.

    Parameters
    ----------
    stamps : ndarray, shape (F, d, d)
    grid : ndarray of int, shape (F, 2)
        Grid index (ix, iy) of every stamp.
    gap : int
        Pixels between and around the stamps.

    Returns
    -------
    ndarray, shape (P_y (d + gap) + gap, P_x (d + gap) + gap)
        NaN where there is no stamp.
    """
    side = stamps.shape[-1]
    pitch = side + gap
    columns, rows = grid.max(axis=0) + 1
    canvas = np.full((rows * pitch + gap, columns * pitch + gap), np.nan)
    for stamp, (ix, iy) in zip(stamps, grid, strict=True):
        row, column = gap + iy * pitch, gap + ix * pitch
        canvas[row : row + side, column : column + side] = stamp
    return canvas


@styled
def template_map(psf: np.ndarray, grid: np.ndarray, field: np.ndarray, title: str) -> Figure:
    """All templates (F, d, d) at their field positions, as one mosaic.

    `grid` holds grid indices (ix, iy), `field` angles (x, y) in radians, both of shape (F, 2).
    """
    figure = new_figure(7.1, layout="constrained")
    axes = figure.add_subplot()
    shown = _draw_psfs(axes, psf, grid, field)
    axes.set_title(title)
    bar = figure.colorbar(shown, ax=axes, shrink=0.8, pad=0.02)
    bar.set_label("pixel flux / maximum of the stamp (square-root scale)")
    share_ticks = np.array([0.0, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0])
    bar.set_ticks(np.sqrt(share_ticks), labels=[f"{value:g}" for value in share_ticks])
    return figure


@styled
def stamp_energy_map(
    energy: np.ndarray, grid: np.ndarray, field: np.ndarray, stamp_px: int
) -> Figure:
    """Fraction of a star's light that its stamp holds, 0 … 1, shape (F,), over the field.

    `grid` and `field` as for `template_map`.
    """
    figure = new_figure(7.1, layout="constrained")
    axes = figure.add_subplot()
    shown = _draw_values(axes, energy, grid, field, "viridis")
    _field_axes(axes, field)
    if grid.max() < MAX_NUMBERED:
        _write_values(axes, shown, energy, field, fontsize=8)
    axes.set_title(
        f"Light inside the stamp of {stamp_px} × {stamp_px} px: min {energy.min():.2f}, "
        f"median {np.median(energy):.2f}, max {energy.max():.2f}"
    )
    bar = figure.colorbar(shown, ax=axes, shrink=0.8, pad=0.02)
    bar.set_label("fraction of the star's light")
    return figure


@styled
def field_of_psfs(fields: FieldOfPsfs, name: str, pixel_scale_arcsec: float) -> Figure:
    """Mosaic of all stamps; beside it maps of the light in the stamp and of the FWHM.

    Whiskers in the map of the FWHM show the direction of the longer axis, their
    length the ellipticity. `name` is the telescope's.
    """
    figure = new_figure(5.3, layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(2.1, 1.0))
    side = fields.psf.shape[-1]
    axes = figure.add_subplot(grid[:, 0])
    shown = _draw_psfs(axes, fields.psf, fields.grid, fields.field)
    ticks = np.array([0.0, 0.01, 0.1, 0.25, 0.5, 1.0])
    bar = figure.colorbar(shown, ax=axes, orientation="horizontal", shrink=0.8, aspect=40)
    bar.set_ticks(np.sqrt(ticks), labels=[f"{tick:g}" for tick in ticks])
    bar.set_label("pixel flux / maximum of the stamp")
    light = figure.add_subplot(grid[0, 1])
    shown = _small_map(light, fields, fields.energy, "viridis", "light inside the stamp")
    if fields.grid.max() < MAX_NUMBERED_SMALL:
        _write_values(light, shown, fields.energy, fields.field, fontsize=6.5)
    width = figure.add_subplot(grid[1, 1])
    _small_map(width, fields, fields.fwhm_arcsec, "cividis", "FWHM (arcsec)")
    position, _ = in_field_unit(fields.field)
    points = int(fields.grid[:, 0].max()) + 1
    step = float(np.ptp(position[:, 0])) / (points - 1) if points > 1 else 1.0
    angle = np.deg2rad(fields.position_angle_deg)
    reach = 0.5 * WHISKER * step * fields.ellipticity
    ends = reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for start, stop in zip(position - ends, position + ends, strict=True):
        width.plot(*np.stack([start, stop], axis=1), color="white", linewidth=1.6)
        width.plot(*np.stack([start, stop], axis=1), color="#c2185b", linewidth=0.9)
    figure.suptitle(
        f"{name}: {len(fields.psf)} static PSFs, stamps of {side} × {side} px = "
        f"{side * pixel_scale_arcsec:.3g}″ × {side * pixel_scale_arcsec:.3g}″"
    )
    return figure


def _small_map(
    axes: Axes, fields: FieldOfPsfs, values: np.ndarray, cmap: str, title: str
) -> AxesImage:
    middle = 0.5 * (values.min() + values.max())
    half = 0.5 * max(float(np.ptp(values)), LEAST_RANGE * middle)
    shown = _draw_values(
        axes, values, fields.grid, fields.field, cmap, middle - half, middle + half
    )
    axes.set_ylabel(f"y ({in_field_unit(fields.field)[1]})")
    axes.set_title(f"{title}: {values.min():.2f} … {values.max():.2f}")
    axes.figure.colorbar(shown, ax=axes, shrink=0.9)
    return shown


def _draw_psfs(axes: Axes, psf: np.ndarray, grid: np.ndarray, field: np.ndarray) -> AxesImage:
    """Mosaic of stamps (F, d, d), each by its maximum, on a square-root scale."""
    from matplotlib import colormaps

    share = psf / psf.max(axis=(1, 2), keepdims=True)
    shown = axes.imshow(
        mosaic(np.sqrt(np.clip(share, 0.0, None)), grid, GAP),
        origin="lower",
        extent=_extent(grid, field, psf.shape[-1], GAP),
        cmap=colormaps[STAMP_MAP].with_extremes(bad="#b0b0b0"),
        vmin=0.0,
        vmax=1.0,
        interpolation="nearest",
    )
    _field_axes(axes, field)
    return shown


def _draw_values(
    axes: Axes,
    values: np.ndarray,
    grid: np.ndarray,
    field: np.ndarray,
    cmap: str,
    vmin: float | None = None,
    vmax: float | None = None,
) -> AxesImage:
    """A value per field point (F,) as a coloured cell."""
    return axes.imshow(
        mosaic(values[:, None, None], grid, gap=0),
        origin="lower",
        extent=_extent(grid, field, 1, 0),
        cmap=cmap,
        vmin=vmin,
        vmax=vmax,
        interpolation="nearest",
    )


def _write_values(
    axes: Axes, shown: AxesImage, values: np.ndarray, field: np.ndarray, fontsize: float
) -> None:
    """The numbers into their cells, dark on light or light on dark."""
    position, _ = in_field_unit(field)
    for (x, y), value in zip(position, values, strict=True):
        red, green, blue, _ = shown.cmap(shown.norm(value))
        color = "white" if 0.299 * red + 0.587 * green + 0.114 * blue < 0.5 else "black"
        axes.text(x, y, f"{value:.2f}", ha="center", va="center", color=color, fontsize=fontsize)


def _extent(
    grid: np.ndarray, field: np.ndarray, side: int, gap: int
) -> tuple[float, float, float, float]:
    """Edges of a mosaic (left, right, bottom, top) that put each stamp's centre on its field."""
    position, _ = in_field_unit(field)
    pitch = side + gap

    def edges(axis: int) -> tuple[float, float]:
        points = int(grid[:, axis].max()) + 1
        first, last = position[:, axis].min(), position[:, axis].max()
        # A single field point has no spacing; any width will do.
        pixel = ((last - first) / (points - 1) if points > 1 else 1.0) / pitch
        margin = (gap + 0.5 * side) * pixel
        return first - margin, last + margin

    return *edges(0), *edges(1)


def _field_axes(axes: Axes, field: np.ndarray) -> None:
    _, unit = in_field_unit(field)
    axes.set_xlabel(f"field angle x ({unit})")
    axes.set_ylabel(f"field angle y ({unit})")
