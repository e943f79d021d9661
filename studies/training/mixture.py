"""Stars that the shipped mixture itself holds for usual, and the errors of what restores them.

python studies/training/mixture.py draw CUBE.fits TRUTH.npy 100000
psfdae predict CUBE.fits --threads 2 --out PSFS.fits
python studies/training/mixture.py errors PSFS.fits TRUTH.npy
"""

from __future__ import annotations

import sys

import numpy as np
from astropy.io import fits

import psfdae

SKY = 1000.0  # photons per pixel
PARTS = 5  # by noise, of equally many stars


def draw(cube: str, truth: str, count: int) -> None:
    """Noisy stamps of stars drawn from the mixture, and their noise-free images of sum 1."""
    model, rng = psfdae.load_model(), np.random.default_rng(0)
    law, info = model.method, model.info
    side, ends = info.stamp_px, law.rows.cumsum()
    cluster = rng.choice(len(law.count), count, p=law.count / law.count.sum())
    coordinates = law.mean[cluster].astype(float)
    for star, k in enumerate(cluster):
        deviation = law.deviation[ends[k] - law.rows[k] : ends[k]] / np.sqrt(law.count[k])
        coordinates[star, : deviation.shape[1]] += rng.standard_normal(len(deviation)) @ deviation
    images = (coordinates @ law.axes.T).reshape(count, side, side)
    images /= images.sum(axis=(1, 2), keepdims=True)
    noise = np.exp(rng.uniform(np.log(info.noise_min), np.log(info.noise_max), count))
    light = (np.sqrt(SKY) / noise)[:, None, None] * images
    stars = fits.PrimaryHDU(rng.poisson(np.maximum(light + SKY, 0.0)).astype(np.float32))
    stars.header["PIXSCALE"], stars.header["GAIN"] = info.pixel_scale_arcsec, 1.0
    stars.writeto(cube, overwrite=True)
    np.save(truth, images.astype(np.float32))


def errors(restored: str, truth: str) -> None:
    """MSE of the PSFs, and the part of the errors within UNCERT, from little noise to much."""
    with fits.open(restored) as file:
        psf, uncertainty, stars = (file[name].data for name in ("PSF", "UNCERT", "STARS"))
        flux = np.asarray(stars["flux"], float)[:, None, None]
        noise = np.asarray(stars["noise"], float) / flux[:, 0, 0]
        off = np.abs(psf / flux - np.load(truth))
        is_within = off < uncertainty / flux
    has_flux = np.isfinite(off).all(axis=(1, 2)) & (flux[:, 0, 0] > 0)
    order = np.flatnonzero(has_flux)[np.argsort(noise[has_flux])]
    print(f"{has_flux.sum()} of {len(has_flux)} stars have a flux")
    for part in np.array_split(order, PARTS):
        mse, share = np.square(off[part]).mean(), is_within[part].mean()
        print(f"noise over flux to {noise[part[-1]]:.2g}: MSE {mse:.4g}, within UNCERT {share:.3f}")


if __name__ == "__main__":
    action, first, second, *count = sys.argv[1:]
    if action == "draw":
        draw(first, second, int(count[0]))
    else:
        errors(first, second)
