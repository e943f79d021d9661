"""Photometry of a crowded field with PSFs of several packages, and with the true one.

    python crowded_sky.py image SEED OUT                   # OUT.fits and OUT.csv
    python crowded_sky.py photometry OUT TABLE NAME=GRID   # appends a row
    python crowded_sky.py completeness OUT TABLE NAME=CATALOGUE  # likewise, a program's catalogue
    python crowded_sky.py with_truth OUT CATALOGUE         # psfdae's search with the true PSF
    python crowded_sky.py pipeline OUT CATALOGUE GRID      # photutils' own search, for the same
    python crowded_sky.py apertures OUT TABLE BUNDLE       # aperture corrections over the field

A GRID is a cube of `psfdae psf --grid`, a .psf of PSFEx, or the word true; a CATALOGUE is of
`psfdae photometry`. The stars are Moffat profiles (β = 3, FWHM 3.2 px) whose width and ellipticity
change over the field.
"""

from __future__ import annotations

import sys
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd
from astropy.io import fits
from astropy.nddata import NDData
from astropy.table import Table
from photutils.aperture import CircularAperture
from photutils.background import Background2D
from photutils.detection import DAOStarFinder
from photutils.psf import (
    GriddedPSFModel,
    IterativePSFPhotometry,
    PSFPhotometry,
    SourceGrouper,
)
from scipy.spatial import cKDTree

from psfdae import load_model
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.photometry import crowded
from psfdae_paper.source import git_commit

SIZE_PX, STARS, BRIGHT = 1000, 2000, 600
SKY, READ_NOISE, BETA, FWHM_PX = 400.0, 3.0, 3.0, 3.2
SAMPLES, HALF_PX = 5, (20, 40)  # in a pixel and axis; of the frames of faint and of bright stars
BRIGHT_FROM = 3e4  # electrons, from which a star has the larger frame
FALSE_PX = 1.5  # from the nearest star, from which a star is false
MARGIN_PX, NODES, OVERSAMPLING, INTEGRATED = 15, 7, 4, 9  # of the grid of true PSFs


def moffat(dx, dy, x, y):
    """Moffat profile of flux 1 that a star at x, y of the field has at distances dx, dy in px."""
    u, v = 2 * x / SIZE_PX - 1, 2 * y / SIZE_PX - 1
    e1, e2 = 0.02 + 0.06 * u + 0.03 * v**2, -0.03 + 0.05 * v + 0.03 * u * v
    fwhm = FWHM_PX * (1 + 0.06 * (u**2 + v**2) + 0.03 * u)
    scale = fwhm / (2 * np.sqrt(2 ** (1 / BETA) - 1))
    square = (1 - e1) * dx**2 - 2 * e2 * dx * dy + (1 + e1) * dy**2
    square = square / np.sqrt(1 - e1**2 - e2**2) / scale**2
    return (1 + square) ** -BETA * (BETA - 1) / (np.pi * scale**2)


def image(seed: str, out: str) -> None:
    """Simulate a field of stars with Poisson and read noise, and write the list of its stars."""
    rng = np.random.default_rng(int(seed))
    x, y = rng.uniform(MARGIN_PX, SIZE_PX - MARGIN_PX, (2, STARS))
    flux = 1500 * 10 ** (0.4 * 6 * (1 - rng.power(2.2, STARS)))
    edge = HALF_PX[1] + 1
    light = np.zeros((SIZE_PX + 2 * edge,) * 2)
    for px, py, f in zip(x, y, flux, strict=True):
        half, row, column = HALF_PX[int(f > BRIGHT_FROM)], int(np.rint(py)), int(np.rint(px))
        axis = (np.arange((2 * half + 1) * SAMPLES) + 0.5) / SAMPLES - 0.5 - half
        dx, dy = np.meshgrid(axis + column - px, axis + row - py)
        shape = (2 * half + 1, SAMPLES) * 2
        stamp = moffat(dx, dy, px, py).reshape(shape).mean(axis=(1, 3))
        rows, columns = (slice(a - half + edge, a + half + 1 + edge) for a in (row, column))
        light[rows, columns] += f * stamp
    counts = light[edge:-edge, edge:-edge] + SKY
    counts = rng.poisson(counts) + rng.normal(0, READ_NOISE, counts.shape)
    hdu = fits.PrimaryHDU(counts.astype(np.float32))
    hdu.header.update({"GAIN": 1.0, "PIXSCALE": 0.5, "RDNOISE": READ_NOISE})
    hdu.writeto(f"{out}.fits", overwrite=True)
    columns = {"id": np.arange(STARS), "x": x, "y": y, "flux": flux}
    Table(columns).write(f"{out}.csv", overwrite=True)


def gridded(cubes, places, oversampling):
    """Photutils' model of PSFs (n, m, m) at places (x, y)."""
    meta = {"grid_xypos": places, "oversampling": oversampling}
    return GriddedPSFModel(NDData(np.array(cubes), meta=meta))


def nodes():
    """Places of a grid over the field."""
    axis = np.linspace(MARGIN_PX, SIZE_PX - MARGIN_PX, NODES)
    return [(x, y) for y in axis for x in axis]


def true_psf():
    """Return the true profile, integrated over whole pixels, at the nodes of the field."""
    side = 2 * HALF_PX[0] * OVERSAMPLING + 1
    axis = (np.arange(side) - side // 2) / OVERSAMPLING
    inside = (np.arange(INTEGRATED) - INTEGRATED // 2) / INTEGRATED
    cubes = []
    for x, y in nodes():
        parts = [moffat(*np.meshgrid(axis + a, axis + b), x, y) for a in inside for b in inside]
        cubes.append(np.mean(parts, axis=0))
    return gridded(cubes, nodes(), OVERSAMPLING)


def of_psfex(path):
    """The same of a file of PSFEx, of the sum 1."""
    hdu = fits.open(path)[1]
    basis, header = np.squeeze(hdu.data["PSF_MASK"][0]), hdu.header
    degree, step = header["POLDEG1"], round(1 / header["PSF_SAMP"])
    cubes = []
    for x, y in nodes():
        u = (x + 1 - header["POLZERO1"]) / header["POLSCAL1"]
        v = (y + 1 - header["POLZERO2"]) / header["POLSCAL2"]
        terms = [u**i * v**j for j in range(degree + 1) for i in range(degree + 1 - j)]
        psf = np.tensordot(terms, basis, 1)
        cubes.append(psf * step**2 / psf.sum())
    return gridded(cubes, nodes(), step)


def of_psfdae(path):
    """The same of `psfdae psf --grid`."""
    cube, header = fits.getdata(path, header=True)
    yx = [header[f"DET_YX{k}"].strip("()").split(",") for k in range(len(cube))]
    return gridded(cube, [(float(x), float(y)) for y, x in yx], header["OVERSAMP"])


def of_file(path):
    """The same of a file, or the true one."""
    if path == "true":
        return true_psf()
    return of_psfex(path) if path.endswith(".psf") else of_psfdae(path)


def photometry(stem: str, table: str, named: str) -> None:
    """Fit all stars with a PSF, from their true places and fluxes on, and append a row.

    One in a process: photutils 3.0.0 fits groups with the first model of a class.
    """
    stars = Table.read(f"{stem}.csv")
    counts = fits.getdata(f"{stem}.fits").astype(float) - SKY
    error = np.sqrt(np.maximum(counts, 0) + SKY + READ_NOISE**2)
    order = np.argsort(-np.array(stars["flux"]))[:BRIGHT]
    name, path = named.split("=", 1)
    grouper = SourceGrouper(4.5)
    fit = PSFPhotometry(of_file(path), (7, 7), grouper=grouper, aperture_radius=3)
    fitted = fit(counts, error=error, init_params=Table(stars["x", "y", "flux"]))
    fitted.sort("id")
    ratio = (np.array(fitted["flux_fit"]) / np.array(stars["flux"]))[order]

    append(table, {"image": Path(stem).name, "psf": name} | compared(ratio))


def scatter(part):
    """Robust standard deviation in per cent."""
    return 148.26 * np.median(np.abs(part - np.median(part)))


def compared(ratio):
    """Return bias and scatter of fluxes over the true ones, of bright stars in order of flux."""
    half = len(ratio) // 2
    row = {"bias_percent": 100 * (np.median(ratio) - 1), "scatter_percent": scatter(ratio)}
    return row | {"brighter_half": scatter(ratio[:half]), "fainter_half": scatter(ratio[half:])}


def append(table, row):
    """A row more in a table, with its date and commit."""
    row = row | {"date": date.today().isoformat(), "commit": git_commit()}
    new = not Path(table).exists()
    pd.DataFrame([row]).to_csv(table, mode="a", header=new, index=False, float_format="%.4g")


def completeness(stem: str, table: str, named: str) -> None:
    """Compare a catalogue with the true stars: those within a pixel of one are found."""
    name, path = named.split("=", 1)
    stars, rows = Table.read(f"{stem}.csv"), Table.read(path)
    rows = rows[np.isfinite(rows["flux"])]
    true, place = (np.stack([t["x"], t["y"]], axis=1) for t in (stars, rows))
    off, nearest = cKDTree(place).query(true)
    bright = np.argsort(-np.array(stars["flux"]))[:BRIGHT]
    detected = bright[off[bright] < 1]
    flux, error = (np.array(rows[c])[nearest] for c in ("flux", "flux_error"))
    pull = ((flux - stars["flux"]) / error)[off < 1]
    row = {"image": Path(stem).name, "catalogue": name, "stars": len(rows)}
    row |= {"completeness": np.mean(off < 1), "bright_completeness": len(detected) / BRIGHT}
    row |= {"false": int((cKDTree(true).query(place)[0] > FALSE_PX).sum())}
    row |= compared(flux[detected] / stars["flux"][detected])
    append(table, row | {"coverage68": np.mean(np.abs(pull) < 1)})


class TrueField:
    """The true profile with the attributes that `psfdae photometry` asks of a model."""

    stamp_px, wings = 2 * HALF_PX[0], None

    def to_photutils(self):
        return true_psf()

    def fwhm_px(self):
        return FWHM_PX

    def draw_on_pixels(self, place):
        axis = np.arange(self.stamp_px) - self.stamp_px // 2
        return np.stack([moffat(*np.meshgrid(axis, axis), *at) for at in place])


def with_truth(stem: str, catalogue: str) -> None:
    """The catalogue of `psfdae photometry --detect` with the true PSF."""
    observation = open_observation(ImageInput(Path(f"{stem}.fits"), detect=5.0), TrueField.stamp_px)
    crowded.photometry(TrueField(), observation).stars.write(catalogue, overwrite=True)


def pipeline(stem: str, catalogue: str, psf: str) -> None:
    """Photutils' own search: DAOStarFinder, and iterative fits of the whole list."""
    counts = fits.getdata(f"{stem}.fits").astype(float)
    sky = Background2D(counts, 64)
    counts, noise = counts - sky.background, float(np.median(sky.background_rms))
    error = np.sqrt(np.maximum(counts, 0) + sky.background_rms**2)
    finder = DAOStarFinder(5 * noise, FWHM_PX)
    fit = IterativePSFPhotometry(
        of_file(psf), (9, 9), finder, grouper=SourceGrouper(9), aperture_radius=3, mode="all"
    )
    rows = fit(counts, error=error)
    names = {"x_fit": "x", "y_fit": "y", "flux_fit": "flux", "flux_err": "flux_error"}
    Table({new: rows[old] for old, new in names.items()}).write(catalogue, overwrite=True)


def apertures(stem: str, table: str, bundle: str) -> None:
    """Compare aperture corrections with the true ones, at places over the field."""
    model = load_model(bundle)
    source = ImageInput(Path(f"{stem}.fits"), detect=5.0)
    measured = crowded.photometry(model, open_observation(source, model.info.stamp_px))
    side = 2 * HALF_PX[1] + 1
    axis = (np.arange(side * INTEGRATED) + 0.5) / INTEGRATED - 0.5 - side // 2
    shape = (side, INTEGRATED) * 2
    for radius in (3.0, 5.0, 8.0, 16.0):
        off, aperture = [], CircularAperture((side // 2,) * 2, radius)
        for x in np.linspace(100, 900, 5):
            for y in np.linspace(100, 900, 5):
                star = moffat(*np.meshgrid(axis, axis), x, y).reshape(shape).mean(axis=(1, 3))
                inside = aperture.do_photometry(star)[0][0]
                off.append(measured.aperture_correction(x, y, radius) * inside - 1)
        off = 100 * np.array(off)
        row = {"image": Path(stem).name, "radius_px": radius, "places": len(off)}
        row |= {"mean_percent": off.mean(), "rms_percent": np.sqrt(np.mean(off**2))}
        append(table, row | {"worst_percent": np.abs(off).max()})


if __name__ == "__main__":
    commands = (image, photometry, completeness, with_truth, pipeline, apertures)
    {function.__name__: function for function in commands}[sys.argv[1]](*sys.argv[2:])
