"""Figures of stamps: a telescope's PSFs and their light over the field.

Every function takes arrays and returns a matplotlib figure; nothing is read or
written here. Row 0 of a stamp is at its lowest field angle y, so stamps and
field are both drawn with y upwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from psfdae.base.figures import STAMP_MAP, apply_style, new_figure
from psfdae.base.types import Axes, AxesImage, Figure


@dataclass(frozen=True)
class FieldOfPsfs:
    """Static PSFs of F field points, and their measured shapes.

    Attributes
    ----------
    psf : ndarray, shape (F, d, d)
        Fraction of the light on each pixel.
    grid : ndarray of int, shape (F, 2)
        Grid index (ix, iy).
    field : ndarray, shape (F, 2)
        Field angle (x, y) in radians.
    table : DataFrame
        A row for each: x_deg, y_deg, the field angle in degrees; energy, the fraction of the light
        inside the stamp; fwhm_arcsec, ellipticity and position_angle_deg, as
        `psfdae.stars.moments.Shapes` explains them; pupil_samples.
    """

    psf: np.ndarray
    grid: np.ndarray
    field: np.ndarray
    table: pd.DataFrame


def make_mosaic(stamps: np.ndarray, grid: np.ndarray, gap: int = 1) -> np.ndarray:
    """Put stamps side by side at their grid positions.

    Stamp (ix, iy) starts at row gap + iy (d + gap) and column gap + ix (d + gap),
    and is not flipped.

    Parameters
    ----------
    stamps : ndarray, shape (F, d, d)
        Stamps, one per field point.
    grid : ndarray of int, shape (F, 2)
        Grid index (ix, iy) of every stamp.
    gap : int
        Pixels between and around the stamps.

    Returns
    -------
    ndarray, shape (P_y (d + gap) + gap, P_x (d + gap) + gap)
        NaN outside the stamps.
    """
    # Pixels outside the stamps are NaN, which is drawn in grey.
    side = stamps.shape[-1]
    pitch = side + gap  # pixels from one stamp to the next
    # Columns run along x, rows along y.
    columns, rows = grid.max(axis=0) + 1
    canvas = np.full((rows * pitch + gap, columns * pitch + gap), np.nan)
    for stamp, (ix, iy) in zip(stamps, grid, strict=True):
        row, column = gap + iy * pitch, gap + ix * pitch
        canvas[row : row + side, column : column + side] = stamp
    return canvas


@apply_style
def draw_templates(psf: np.ndarray, grid: np.ndarray, field: np.ndarray, title: str) -> Figure:
    """Draw all templates (F, d, d) at their field positions, as one mosaic.

    `grid` holds grid indices (ix, iy), `field` angles (x, y) in radians, both of shape (F, 2).
    """
    figure = new_figure(7.1, layout="constrained")
    axes = figure.add_subplot()
    # Each stamp at its field point, on a square-root scale of its own maximum.
    image = _draw_psfs(axes, psf, grid, field)
    axes.set_title(title)
    bar = figure.colorbar(image, ax=axes, shrink=0.8, pad=0.02)
    bar.set_label("pixel flux / maximum of the stamp (square-root scale)")
    # Ticks at fractions of the maximum, whose square roots are drawn.
    share_ticks = np.array([0.0, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0])
    bar.set_ticks(np.sqrt(share_ticks), labels=[f"{value:g}" for value in share_ticks])
    return figure


@apply_style
def draw_energy(energy: np.ndarray, grid: np.ndarray, field: np.ndarray, stamp_px: int) -> Figure:
    """Draw the fraction of a star's light inside its stamp, shape (F,), over the field.

    `grid` and `field` as for `draw_templates`; the stamps have `stamp_px` pixels a side.
    """
    figure = new_figure(7.1, layout="constrained")
    axes = figure.add_subplot()
    # A coloured cell for each field point, with its number where there is room.
    image = _draw_mosaic(axes, energy[:, None, None], grid, field, gap=0, cmap="viridis")
    _label_axes(axes, field)
    # On grids with more than 15 points a side the numbers would touch.
    if grid.max() < 15:
        _write_values(axes, image, energy, field, fontsize=8)
    axes.set_title(
        f"Light inside the stamp of {stamp_px} × {stamp_px} px: min {energy.min():.2f}, "
        f"median {np.median(energy):.2f}, max {energy.max():.2f}"
    )
    figure.colorbar(image, ax=axes, shrink=0.8, pad=0.02, label="fraction of the star's light")
    return figure


@apply_style
def draw_field(fields: FieldOfPsfs, name: str, pixel_scale_arcsec: float) -> Figure:
    """Draw a mosaic of all stamps, and maps of the light in the stamp and of the FWHM.

    Whiskers in the map of the FWHM have the direction of the longer axis and a length in
    proportion to the ellipticity. `name` is the telescope's.
    """
    figure = new_figure(5.3, layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(2.1, 1.0))
    side = fields.psf.shape[-1]
    axes = figure.add_subplot(grid[:, 0])
    # Mosaic of the stamps at the left, with the colour bar below it.
    image = _draw_psfs(axes, fields.psf, fields.grid, fields.field)
    ticks = np.array([0.0, 0.01, 0.1, 0.25, 0.5, 1.0])
    bar = figure.colorbar(image, ax=axes, orientation="horizontal", shrink=0.8, aspect=40)
    bar.set_ticks(np.sqrt(ticks), labels=[f"{tick:g}" for tick in ticks])
    bar.set_label("pixel flux / maximum of the stamp")
    # Light inside the stamp, with numbers unless they would touch.
    energy = fields.table.energy.to_numpy()
    light_axes = figure.add_subplot(grid[0, 1])
    image = _draw_map(light_axes, fields, energy, "viridis", "light inside the stamp")
    if fields.grid.max() < 7:
        _write_values(light_axes, image, energy, fields.field, fontsize=6.5)
    # FWHM, with whiskers: at ellipticity 1 they are 1.6 distances of field points long.
    fwhm_axes = figure.add_subplot(grid[1, 1])
    _draw_map(fwhm_axes, fields, fields.table.fwhm_arcsec.to_numpy(), "cividis", "FWHM (arcsec)")
    # Spacing of the field points in the unit of the axes, for the length of the whiskers.
    position, unit = to_field_unit(fields.field)
    fwhm_axes.set_xlabel(f"x ({unit})")
    points = int(fields.grid[:, 0].max()) + 1
    spacing = float(np.ptp(position[:, 0])) / (points - 1) if points > 1 else 1.0
    angle = np.deg2rad(fields.table.position_angle_deg.to_numpy())
    half_length = 0.5 * 1.6 * spacing * fields.table.ellipticity.to_numpy()
    half_whisker = half_length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # A white line below each whisker sets it off from the map.
    for start, stop in zip(position - half_whisker, position + half_whisker, strict=True):
        fwhm_axes.plot(*np.stack([start, stop], axis=1), color="white", linewidth=1.6)
        fwhm_axes.plot(*np.stack([start, stop], axis=1), color="#c2185b", linewidth=0.9)
    figure.suptitle(
        f"{name}: {len(fields.psf)} static PSFs, stamps of {side} × {side} px = "
        f"{side * pixel_scale_arcsec:.3g}″ × {side * pixel_scale_arcsec:.3g}″"
    )
    return figure


def _draw_map(
    axes: Axes, fields: FieldOfPsfs, values: np.ndarray, cmap: str, title: str
) -> AxesImage:
    """Draw values of all field points with their range in the title."""
    # Colours span at least 5 % of the values, so that rounding errors do not look like structure.
    middle = 0.5 * (values.min() + values.max())
    half_range = 0.5 * max(float(np.ptp(values)), 0.05 * middle)
    style = {"cmap": cmap, "vmin": middle - half_range, "vmax": middle + half_range}
    # A value is a stamp of one pixel, drawn without gaps.
    image = _draw_mosaic(axes, values[:, None, None], fields.grid, fields.field, gap=0, **style)
    title = f"{title}: {values.min():.2f} … {values.max():.2f}"
    axes.set(ylabel=f"y ({to_field_unit(fields.field)[1]})", title=title)
    axes.figure.colorbar(image, ax=axes, shrink=0.9)
    return image


def _draw_psfs(axes: Axes, psf: np.ndarray, grid: np.ndarray, field: np.ndarray) -> AxesImage:
    """Draw a mosaic of stamps (F, d, d) over their maxima, on a square-root scale."""
    from matplotlib import colormaps

    # Square roots make the wings visible, which have a few per cent of the maximum.
    root = np.sqrt(np.clip(psf / psf.max(axis=(1, 2), keepdims=True), 0.0, None))
    colors = colormaps[STAMP_MAP].with_extremes(bad="#b0b0b0")
    image = _draw_mosaic(axes, root, grid, field, gap=1, cmap=colors, vmin=0.0, vmax=1.0)
    _label_axes(axes, field)
    return image


def _draw_mosaic(
    axes: Axes, stamps: np.ndarray, grid: np.ndarray, field: np.ndarray, gap: int, **style: Any
) -> AxesImage:
    """Draw stamps (F, d, d), the centre of each at its field point, with `gap` pixels between."""
    (position, _), side = to_field_unit(field), stamps.shape[-1]
    # Width of a pixel of the mosaic in the unit of the axes, from the spacing of the field points.
    # A single field point has an arbitrary width.
    intervals = grid.max(axis=0)
    low, high = position.min(axis=0), position.max(axis=0)
    spacing = np.where(intervals > 0, (high - low) / np.maximum(intervals, 1), 1.0)
    # The centre of the outermost stamps is gap + side/2 pixels from the edge of the mosaic.
    margin = (gap + 0.5 * side) * (spacing / (side + gap))
    (x_min, y_min), (x_max, y_max) = low - margin, high + margin
    return axes.imshow(
        make_mosaic(stamps, grid, gap),
        origin="lower",
        extent=(x_min, x_max, y_min, y_max),
        interpolation="nearest",
        **style,
    )


def _write_values(
    axes: Axes, image: AxesImage, values: np.ndarray, field: np.ndarray, fontsize: float
) -> None:
    """Write numbers into the cells of an image, dark on light or light on dark."""
    position, _ = to_field_unit(field)
    for (x, y), value in zip(position, values, strict=True):
        # The number is white on dark cells, and black on light ones.
        red, green, blue, _ = image.cmap(image.norm(value))
        # Luma of ITU-R BT.601, the brightness that the eye perceives.
        color = "white" if 0.299 * red + 0.587 * green + 0.114 * blue < 0.5 else "black"
        axes.text(x, y, f"{value:.2f}", ha="center", va="center", color=color, fontsize=fontsize)


def _label_axes(axes: Axes, field: np.ndarray) -> None:
    """Label both axes with the field angle and its unit."""
    _, unit = to_field_unit(field)
    axes.set(xlabel=f"field angle x ({unit})", ylabel=f"field angle y ({unit})")


def to_field_unit(field: np.ndarray) -> tuple[np.ndarray, str]:
    """Return field angles in degrees, or in arc minutes if the whole field is within ±1°.

    Parameters
    ----------
    field : ndarray
        Angles in radians.

    Returns
    -------
    values : ndarray
        Angles in this unit.
    unit : str
        "deg" or "arcmin".
    """
    # The unit suits the whole field, so that axes of one telescope agree.
    degrees = np.rad2deg(field)
    if np.abs(degrees).max() >= 1.0:
        return degrees, "deg"
    return 60.0 * degrees, "arcmin"
