"""Simulated fields of stars with their truth: Moffat profiles that change over the field.

`simulate_field` returns the image with its stars, and `compare` a measured table with the truth, in
ranges of the S/N that an ideal fit of each star has.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from astropy.table import Table
from scipy.spatial import cKDTree

from psfdae.psf.interface import FieldPsfs
from psfdae.stars.moments import robust_scatter

SKY, READ_NOISE = 400.0, 3.0  # electrons, which are the counts of the image
CAMERA = {"gain": 1.0, "read_noise": READ_NOISE, "pixel_scale_arcsec": 0.5, "saturate": 1e7}
SNR_EDGES = (4.0, 7.0, 14.0, 35.0, 80.0, np.inf)
SAMPLES, HALF_PX, BRIGHT_HALF_PX, CORE_PX = 5, 16, 40, 10
BRIGHT_FROM = 3e4  # electrons, from which a star is drawn with BRIGHT_HALF_PX


@dataclass(frozen=True)
class SimulatedField:
    """An image and its true stars.

    Attributes
    ----------
    image : ndarray of float32, shape (size, size)
        Counts of sky and stars with Poisson and read noise.
    stars : Table
        `x`, `y` (0-based pixels), `flux` (all light, counts) and `snr`: that of a fit with the true
        PSF at the true position, the light of all other stars known but for its noise.
    """

    image: np.ndarray
    stars: Table


def moffat(dx, dy, u, v, fwhm_px, beta):
    """Moffat profile of flux 1 at distances dx, dy in px from a star at u, v, each from −1 to 1.

    Its FWHM is the lowest of `fwhm_px` in the middle and the highest in two corners of the field.
    """
    low, high = fwhm_px
    e1, e2 = 0.02 + 0.06 * u + 0.03 * v**2, -0.03 + 0.05 * v + 0.03 * u * v
    fwhm = low + (high - low) * (0.4 * (u**2 + v**2) + 0.1 * (u + v))
    scale = fwhm / (2.0 * np.sqrt(2.0 ** (1.0 / beta) - 1.0))
    square = (1 - e1) * dx**2 - 2 * e2 * dx * dy + (1 + e1) * dy**2
    square = square / np.sqrt(1 - e1**2 - e2**2) / scale**2
    return (1 + square) ** -beta * (beta - 1) / (np.pi * scale**2)


class TrueField(FieldPsfs):
    """The true PSFs of a field as a model, of the sum 1 in stamps of 24 px."""

    name, stamp_px, sha256, order, image_px = "true", 24, "0" * 64, 0, None

    def __init__(self, size_px, fwhm_px, beta=3.0):
        self.size_px, self.profile = size_px, (fwhm_px, beta)

    def field_range(self):
        return np.array([10.0, 10.0]), np.array([self.size_px - 11.0] * 2)

    def check_scale(self, pixel_scale_arcsec, source):
        pass

    def draw_psfs(self, position, oversampling):
        psfs = []
        for x, y in position[:, :2]:
            u, v = 2 * x / self.size_px - 1, 2 * y / self.size_px - 1
            side = self.stamp_px if oversampling == 1 else oversampling * self.stamp_px + 1
            # Points within a pixel about each value; those of the stamp of a star in the middle of
            # its pixel are the unit of the flux.
            inside = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
            axis = ((np.arange(side) - side // 2)[:, None] / oversampling + inside).ravel()
            dx, dy = axis - (x - np.rint(x)), axis - (y - np.rint(y))
            psf = moffat(dx, dy[:, None], u, v, *self.profile)
            axis = ((np.arange(self.stamp_px) - self.stamp_px // 2)[:, None] + inside).ravel()
            total = moffat(axis, axis[:, None], u, v, *self.profile).sum() / SAMPLES**2
            psfs.append(psf.reshape((side, SAMPLES) * 2).mean(axis=(1, 3)) / total)
        return np.array(psfs)


def power_law_fluxes(rng, count, low, high, slope):
    """Return fluxes (count,) from low to high of which the number above F goes as F^−slope."""
    share = rng.uniform(size=count)
    return (low**-slope + share * (high**-slope - low**-slope)) ** (-1.0 / slope)


def simulate_field(
    size_px, count, fwhm_px, *, beta=3.0, flux=(400.0, 1e5), slope=0.25, seed=1, nebula=0.0
):
    """Return a field of `count` stars at random positions, which may overlap.

    Parameters
    ----------
    size_px, count : int
        Side of the image, and number of its stars.
    fwhm_px : tuple of float
        FWHM in the middle and in the corners of the field.
    beta : float
        Exponent of the Moffat profile.
    flux : tuple of float
        Lowest and highest flux, counts.
    slope : float
        The number of stars brighter than F goes as F^−slope.
    seed : int
    nebula : float
        Height of filaments that vary within some 20 px, counts.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(6, size_px - 7, (2, count))
    fluxes = power_law_fluxes(rng, count, *flux, slope)
    edge = BRIGHT_HALF_PX + 1
    light, cores = np.zeros((size_px + 2 * edge,) * 2), []
    for px, py, f in zip(x, y, fluxes, strict=True):
        # The mean of SAMPLES × SAMPLES points is the light of a pixel over the star's flux.
        half = BRIGHT_HALF_PX if f > BRIGHT_FROM else HALF_PX
        row, column = round(py), round(px)
        axis = (np.arange((2 * half + 1) * SAMPLES) + 0.5) / SAMPLES - 0.5 - half
        dx, dy = axis + column - px, (axis + row - py)[:, None]
        stamp = moffat(dx, dy, 2 * px / size_px - 1, 2 * py / size_px - 1, fwhm_px, beta)
        stamp = stamp.reshape((2 * half + 1, SAMPLES) * 2).mean(axis=(1, 3))
        first_row, first_column = row + edge - half, column + edge - half
        side = 2 * half + 1
        light[first_row : first_row + side, first_column : first_column + side] += f * stamp
        cores.append(
            stamp[half - CORE_PX : half + CORE_PX + 1, half - CORE_PX : half + CORE_PX + 1]
        )
    if nebula:
        rows, columns = np.indices(light.shape)
        waves = np.sin(columns / 9.0 + 2.0 * np.sin(rows / 31.0)) * np.sin(rows / 13.0)
        light += nebula * np.square(waves)
    expected = light + SKY
    # S/N = F √(Σ P²/σ²) over the pixels about the star, σ² = all light + read noise².
    variance = expected + READ_NOISE**2
    information = np.empty(count)
    for star, (px, py, core) in enumerate(zip(x, y, cores, strict=True)):
        rows, columns = (
            slice(round(p) + edge - CORE_PX, round(p) + edge + CORE_PX + 1) for p in (py, px)
        )
        on_image = np.pad(np.ones((size_px, size_px)), edge)[rows, columns]
        information[star] = (on_image * core**2 / variance[rows, columns]).sum()
    image = rng.poisson(expected) + rng.normal(0, READ_NOISE, expected.shape)
    image = image[edge:-edge, edge:-edge].astype(np.float32)
    stars = Table({"x": x, "y": y, "flux": fluxes, "snr": fluxes * np.sqrt(information)})
    return SimulatedField(image, stars)


def match(table, stars, distance_px=1.5):
    """Return the row (n,) of the table for each true star, −1 where there is none.

    From the brightest star on, each takes the nearest row that no brighter star has taken.
    """
    tree = cKDTree(np.stack([table["x"], table["y"]], axis=1))
    rows, taken = np.full(len(stars), -1), set()
    near = tree.query_ball_point(np.stack([stars["x"], stars["y"]], axis=1), distance_px)
    for star in np.argsort(-np.array(stars["flux"]), kind="stable"):
        free = [row for row in near[star] if row not in taken]
        if free:
            off = [
                np.hypot(*(tree.data[row] - (stars["x"][star], stars["y"][star]))) for row in free
            ]
            rows[star] = free[int(np.argmin(off))]
            taken.add(rows[star])
    return rows


def false_share(table, stars, distance_px=2.0):
    """Return the part of the rows of a table without a true star within a distance."""
    true, found = (np.stack([t["x"], t["y"]], axis=1) for t in (stars, table))
    return float(np.mean(cKDTree(true).query(found)[0] > distance_px))


def compare(table, stars, edges=SNR_EDGES):
    """Return a row for each range of the S/N of an ideal fit.

    Columns: `low`, `high` (S/N), `stars`, `found` (part of them), `bias` (median of the relative
    error of the flux), `scatter` (robust, in units of an ideal fit's) and `within` (part of the
    stars within one given error).
    """
    row = match(table, stars)
    snr, is_found = np.array(stars["snr"]), row >= 0
    ratio = np.array(table["flux"])[row] / np.array(stars["flux"]) - 1.0
    error = np.array(table["flux_error"])[row] / np.array(stars["flux"])
    bins = []
    for low, high in pairwise(edges):
        is_here = (snr >= low) & (snr < high)
        part = is_here & is_found & np.isfinite(ratio)
        scaled = ratio[part] * snr[part]
        bins.append(
            {
                "low": low,
                "high": high,
                "stars": int(is_here.sum()),
                "found": float(is_found[is_here].mean()),
                "bias": float(np.median(ratio[part])),
                "scatter": float(robust_scatter(scaled[:, None])[0]),
                "within": float(np.mean(np.abs(ratio[part]) < error[part])),
            }
        )
    return Table(bins)
