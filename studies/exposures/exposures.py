"""The field of an exposure with few stars, with and without another exposure.

    python exposures.py FIRST LAST TABLE      # draws FIRST … LAST − 1, a row for each

Each draw has three dithered exposures of 1000 × 1000 px, with 250, 250 and 10 stars of 20 000 to
200 000 electrons. Their Moffat profiles (β = 3, FWHM 3.2 px) change over the field, and from one
exposure to the next: the FWHM by 6 %, both ellipticities by 0.02 (standard deviations). The field
of the third exposure is fitted to its 10 stars with the first or the second exposure as prior, to
its 10 stars alone, and to 100 stars of its own; errors are mean squared errors at 25 places.
"""

from __future__ import annotations

import sys
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd

from psfdae.methods.field.residuals import MARGIN_PX
from psfdae.methods.field.search import fit_field, refit_field
from psfdae.stars.bright_stars import BrightStars
from psfdae_paper.source import git_commit

SIZE_PX, STAMP_PX, WIDE_PX, SAMPLES = 1000, 16, 32, 5
SKY, READ_NOISE, FWHM_PX, BETA = 400.0, 3.0, 3.2, 3.0
SEEING, SHEAR = 0.06, 0.02
ORDERS, SPACING_PX, SMOOTHNESS = (0, 1, 2, 3, 4), 0.5, 1.0
PLACES = np.stack(np.meshgrid(*[np.linspace(60, 940, 5).round()] * 2), axis=-1).reshape(-1, 2)
SIZES = (SKY + READ_NOISE**2, STAMP_PX + 2 * MARGIN_PX, STAMP_PX)


def psf(place, side, seeing, shear):
    """Moffat profile (side, side) of flux 1 of a star at a place, seen by pixels."""
    u, v = 2 * place / SIZE_PX - 1
    e1, e2 = shear + np.array([0.02 + 0.06 * u + 0.03 * v**2, -0.03 + 0.05 * v + 0.03 * u * v])
    fwhm = FWHM_PX * seeing * (1 + 0.06 * (u**2 + v**2) + 0.03 * u)
    scale = fwhm / (2 * np.sqrt(2 ** (1 / BETA) - 1))
    axis = (np.arange(side * SAMPLES) + 0.5) / SAMPLES - 0.5 - side // 2
    phase = place - np.floor(place + 0.5)
    x, y = np.meshgrid(axis - phase[0], axis - phase[1])
    square = (1 - e1) * x**2 - 2 * e2 * x * y + (1 + e1) * y**2
    square = square / np.sqrt(1 - e1**2 - e2**2) / scale**2
    light = (1 + square) ** -BETA * (BETA - 1) / (np.pi * scale**2)
    return light.reshape(side, SAMPLES, side, SAMPLES).mean(axis=(1, 3))


def exposure(rng, count, conditions):
    """Bright stars with Poisson and read noise."""
    place = rng.uniform(20, SIZE_PX - 20, (count, 2))
    flux = 10 ** rng.uniform(4.3, 5.3, count)
    light = np.array([f * psf(p, WIDE_PX, *conditions) for f, p in zip(flux, place, strict=True)])
    wide_stamps = rng.poisson(light + SKY) + rng.normal(0, READ_NOISE, light.shape) - SKY
    margin = (WIDE_PX - STAMP_PX) // 2
    stamps = wide_stamps[:, margin:-margin, margin:-margin]
    noise = np.full(count, np.sqrt(SIZES[0]))
    snr = np.sqrt(np.square(stamps).sum(axis=(1, 2))) / noise
    phase = (place - np.floor(place + 0.5))[:, ::-1]
    at = np.zeros((count, 2), int), phase, place, stamps.sum(axis=(1, 2)), noise, snr
    return BrightStars(wide_stamps, *at, np.arange(count), phase, np.full(count, np.nan))


def error(model, conditions):
    """Mean squared error of PSFs of the sum 1 in their stamps."""
    place = np.hstack([PLACES, np.full(PLACES.shape, np.nan)])
    psfs = model.images(model.terms(place), np.zeros((len(PLACES), 2)), STAMP_PX)
    true = np.array([psf(p, STAMP_PX, *conditions) for p in PLACES])
    unit = (a / a.sum(axis=(1, 2), keepdims=True) for a in (psfs, true))
    return np.square(np.subtract(*unit)).mean()


def fitted(stars, orders=ORDERS):
    return fit_field(stars, *SIZES, orders, SPACING_PX, SMOOTHNESS).model


def draw(number):
    """Errors of one draw."""
    rng = np.random.default_rng(number)
    seeing = 1 + rng.normal(0, SEEING, 3)
    conditions = list(zip(seeing, rng.normal(0, SHEAR, (3, 2)), strict=True))
    first, second = (fitted(exposure(rng, 250, at)) for at in conditions[:2])
    hundred = exposure(rng, 100, conditions[2])
    ten = hundred.select(np.arange(10))
    models = {"own_100": fitted(hundred), "own_10": fitted(ten, (0,))}
    for name, prior in (("first", first), ("second", second)):
        models[f"10_and_{name}"] = refit_field(prior, ten, *SIZES, SMOOTHNESS).model
        models[f"{name}_alone"] = prior
    return {"draw": number} | {name: error(m, conditions[2]) for name, m in models.items()}


if __name__ == "__main__":
    first, last, table = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
    for number in range(first, last):
        row = draw(number) | {"date": date.today().isoformat(), "commit": git_commit()}
        new = not table.exists()
        pd.DataFrame([row]).to_csv(table, mode="a", header=new, index=False, float_format="%.4g")
