"""PSFs of `psfdae psf --grid` as photutils draws them, of any release, with nothing of ours.

python photutils_grid.py grid.fits places.npy out.npy
"""

from __future__ import annotations

import sys

import numpy as np
from astropy.io import fits
from astropy.nddata import NDData
from photutils.psf import GriddedPSFModel


def gridded(path):
    """As docs/tutorial.md reads it: `GriddedPSFModel.read` takes 3.1."""
    cube, header = fits.getdata(path, header=True)
    yx = [header[f"DET_YX{k}"].strip("()").split(",") for k in range(len(cube))]
    xy = [(float(x), float(y)) for y, x in yx]
    meta = {"grid_xypos": xy, "oversampling": header["OVERSAMP"]}
    return GriddedPSFModel(NDData(cube, meta=meta))


def drawn(path, places):
    """PSFs (n, m, m) at places (n, 2), x and y, about the middle of their pixels."""
    grid = gridded(path)
    side, step = grid.data.shape[-1], int(grid.oversampling[0])
    axis = (np.arange(side) - side // 2) / step
    found = []
    for x, y in places:
        columns, rows = np.meshgrid(np.rint(x) + axis, np.rint(y) + axis)
        found.append(grid.evaluate(columns, rows, 1.0, x, y))
    return np.stack(found)


if __name__ == "__main__":
    grid, places, out = sys.argv[1:]
    try:
        read = GriddedPSFModel.read(grid).grid_xypos
    except ValueError as error:  # before 3.1
        assert "needs photutils 3.1" in str(error), error
    else:
        assert (read == gridded(grid).grid_xypos).all()
    np.save(out, drawn(grid, np.load(places)))
