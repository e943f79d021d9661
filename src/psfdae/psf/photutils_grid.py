"""The PSF over a field as photutils' `GriddedPSFModel`, and its pickling."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from psfdae.base.types import GriddedPSFModel
from psfdae.psf.grid import PsfGrid
from psfdae.psf.interface import FieldPsfs


def make_photutils_grid(model: FieldPsfs, nodes: int, oversampling: int) -> GriddedPSFModel:
    """Return a field as photutils' `GriddedPSFModel`, whose PSFs have an odd number of values.

    Parameters
    ----------
    model : FieldPsfs
        Model that has the PSF at every position.
    nodes : int
        Positions along either axis, over the field of the training stars.
    oversampling : int
        Values per pixel and axis.

    Raises
    ------
    PredictionError
        As `FieldPsfs.psf_at`.
    """
    from astropy.nddata import NDData

    # photutils takes PSFs on a regular grid, x changing fastest, and interpolates between them.
    grid = PsfGrid.sample(model, nodes, oversampling)
    positions = np.stack(np.meshgrid(grid.columns, grid.rows), axis=-1).reshape(-1, 2)
    meta = {"grid_xypos": [*map(tuple, positions)], "oversampling": oversampling}
    model_class = grid_class(f"FieldPSF_{model.sha256[:12]}_{nodes}_{oversampling}")
    return model_class(NDData(grid.psfs.reshape(-1, *grid.psfs.shape[2:]), meta=meta))


@cache
def grid_class(name: str) -> type[GriddedPSFModel]:
    """Return a class of photutils' `GriddedPSFModel` with a name of its own.

    photutils 3.0 fits groups with the first model of a class, so that each model has its class.
    """
    from photutils.psf import GriddedPSFModel

    # A class that is made at run time is pickled as its name.
    return type(name, (GriddedPSFModel,), {"__reduce__": reduce_grid})


def reduce_grid(grid: GriddedPSFModel) -> tuple[Any, ...]:
    """Return what pickle stores of a grid: how to make one without values, and its values."""
    return blank_grid, (type(grid).__name__,), vars(grid)


def blank_grid(name: str) -> GriddedPSFModel:
    """Return an object of the class `grid_class(name)` without values, for unpickling."""
    return object.__new__(grid_class(name))
