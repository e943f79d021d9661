"""Figures of scenes 1 and 2 from tiny synthetic inputs."""

from __future__ import annotations

import numpy as np

from psfdae_paper.evaluation.figures import draw_templates
from psfdae_paper.stars.fields import square_grid


def small_field():
    index, angle_deg = square_grid(3, 1.1)
    return index, np.deg2rad(angle_deg)


def one_bright_pixel(fields, bright, row, column, side=4):
    psf = np.full((fields, side, side), 1e-6)
    psf[:, 0, 0] = 1e-3
    psf[bright] = 0.0
    psf[bright, row, column] = 1.0
    return psf


def rgb_at(figure, axes, x, y):
    """Colour that the drawn figure shows at data coordinates."""
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba())
    column, row = axes.transData.transform((x, y))
    return picture[picture.shape[0] - 1 - int(row), int(column), :3] / 255.0


def test_template_map_shows_the_bright_pixel_where_it_belongs():
    row, column = 3, 0
    index, field = small_field()
    bright = int(np.flatnonzero((index == [2, 0]).all(axis=1))[0])
    figure = draw_templates(one_bright_pixel(9, bright, row, column), index, field, "templates")
    axes = figure.axes[0]
    x, y = np.rad2deg(field[bright])
    pixel = 1.1 / 5  # four pixels and a gap per field
    at = (x + (column - 1.5) * pixel, y + (row - 1.5) * pixel)
    opposite = (x - (column - 1.5) * pixel, y - (row - 1.5) * pixel)
    assert rgb_at(figure, axes, *at).min() > 0.7
    assert rgb_at(figure, axes, *opposite).max() < 0.1
