"""Photon noise of an image of unknown gain, from the pixels of its stars.

The variance of a pixel with the light L of a star in it is

    v = σ² + L/g + (ε L)²,

with the noise σ of the sky, the gain g in electrons per count, and what the PSF of the star is off
by, ε (photon transfer: Janesick 2007, Photon Transfer, SPIE). The residuals of fainter and brighter
stars separate the last two.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psfdae.image.camera import CameraValue
from psfdae.image.image import Image
from psfdae.psf.grid import PsfGrid
from psfdae.psf.interface import FieldPsfs
from psfdae.stars.moments import SIGMA_OF_MAD, middle_value


def pixel_error(noise: np.ndarray, light: np.ndarray, gain: float | None) -> np.ndarray:
    """Return σ (h, w) of pixels, σ² = noise² of the sky + light of stars over the gain."""
    return np.hypot(noise, np.sqrt(np.maximum(light, 0.0) / gain)) if gain else noise


def add_measured_gain(model: FieldPsfs, observation: Image) -> Image:
    """Return the observation with the gain that its stars show, if it is not known.

    It stays unknown where they do not show it at 5 σ, as in an image without photon noise.

    Raises
    ------
    PredictionError
        If the model knows no PSF of a position.
    ObservationError
        If the sky cannot be measured.
    """
    if observation.gain is not None:
        return observation
    sky, (_, limit) = observation.sky(), observation.camera_in_sky_unit()
    bad = sky.bad | (sky.signal + sky.level >= limit)
    gain_and_error = measure_gain(model, sky.signal, sky.noise, bad, observation.positions)
    if gain_and_error is None:
        return observation
    gain = gain_and_error[0] * observation.unit_factor
    value = CameraValue(gain, "about, by the scatter of the pixels of stars")
    return replace(observation, camera=observation.camera | {"gain": value})


def measure_gain(
    model: FieldPsfs, flat: np.ndarray, noise: np.ndarray, bad: np.ndarray, position: np.ndarray
) -> tuple[float, float] | None:
    """Measure the gain of an image, and its standard error.

    Parameters
    ----------
    model : FieldPsfs
        Model that knows the PSF at every position.
    flat, noise : ndarray, shape (h, w)
        Sky-subtracted counts, and σ of the sky.
    bad : ndarray of bool, shape (h, w)
        Pixels that are not used.
    position : ndarray, shape (n, 2)
        x and y of stars, NaN where unknown.

    Returns
    -------
    (float, float) or None
        Electrons per count. None if fewer than ten stars stand alone, or no photon noise is seen
        at 5 σ: errors of the PSF follow the law above only about.

    Raises
    ------
    PredictionError
        If the model knows no PSF of a position.
    """
    # Stars alone in a box of about 1.6 FWHM, and without a neighbour within 3 FWHM.
    fwhm = model.fwhm_px()
    half = min(int(np.ceil(0.8 * fwhm)), model.stamp_px // 2 - 1)
    axis = np.arange(-half, half + 1)
    position = position[stars_alone(position, bad, half, 3.0 * fwhm)]
    # The brightest 300 of these: fainter ones show no photon noise.
    column, row = np.floor(position + 0.5).astype(int).T
    brightest = np.argsort(-flat[row, column], kind="stable")[:300]
    position, column, row = position[brightest], column[brightest], row[brightest]
    if len(position) < 10:
        return None
    pixels = row[:, None, None] + axis[:, None], column[:, None, None] + axis
    # Pixels (n, P) in units of a typical σ of the sky.
    data, sigma = (image[pixels].reshape(len(position), -1) for image in (flat, noise))
    unit = float(np.median(sigma))
    data, sigma = data / unit, sigma / unit
    psfs, photons, off = PsfGrid.sample(model), 0.0, 0.0
    light = np.zeros(data.shape)
    for _ in range(4):
        # Weighted least squares of flux, centre and sky, its design (n, P, 4) and weights 1/v.
        # Columns are the light of a star of flux 1, F ∂/∂x and F ∂/∂y for F = 1, and the sky.
        corner = np.stack([column, row], axis=1) - half
        design = np.ones((len(position), 4, len(axis) ** 2))
        star_light = psfs.stamps_and_slopes(position, corner, len(axis))
        design[:, :3] = star_light.reshape(len(position), 3, -1)
        design = design.transpose(0, 2, 1)
        variance = sigma**2 + photons * light + (off * light) ** 2
        weighted_design = design / variance[..., None]
        inverse = np.linalg.inv(weighted_design.transpose(0, 2, 1) @ design)
        parameters = (inverse @ (weighted_design.transpose(0, 2, 1) @ data[..., None]))[..., 0]
        light = np.maximum(parameters[:, :1] * design[..., 0], 0.0)
        # A residual has the part 1 − h of its pixel's variance, with the leverage h of the fit.
        leverage = np.einsum("npi,nij,npj->np", design, inverse, weighted_design)
        residual = data - (design @ parameters[..., None])[..., 0]
        residual /= np.sqrt(np.clip(1.0 - leverage, 0.05, 1.0))
        # Stars that are off by far more than others have neighbours that are on no list.
        chi2 = (residual**2 / variance).mean(axis=1)
        is_fitted = chi2 < 4.0 * np.median(chi2)
        photons, error, off = photon_transfer(
            light[is_fitted], residual[is_fitted], sigma[is_fitted]
        )
        # Centres stay in their pixel, about which the box lies.
        move = np.clip(parameters[:, 1:3] / np.maximum(parameters[:, :1], 1e-12), -0.2, 0.2)
        middle = np.stack([column, row], axis=1)
        position = np.clip(position + move, middle - 0.49, middle + 0.49)
    # g = 1 / (photons · unit), and σ_g = g σ_photons / photons.
    if not photons > 5.0 * error:
        return None
    return 1.0 / (photons * unit), error / (photons**2 * unit)


def stars_alone(
    position: np.ndarray, bad: np.ndarray, half_px: int, distance_px: float
) -> np.ndarray:
    """Return which stars at positions (n, 2) have neither bad pixels in their box nor neighbours.

    The box has 2 `half_px` + 1 pixels along each side and is whole in the image, of which `bad`
    (h, w) pixels do not count.
    """
    from scipy.ndimage import maximum_filter
    from scipy.spatial import cKDTree

    rows_with_position = np.flatnonzero(np.isfinite(position).all(axis=1))
    is_alone = np.zeros(len(position), dtype=bool)
    if len(rows_with_position) < 2:
        return is_alone
    # The nearest star of the list but the star itself.
    points = position[rows_with_position]
    distance = cKDTree(points).query(points, k=2)[0][:, 1]
    # Beyond its edges, an image has only bad pixels.
    has_bad_pixel = maximum_filter(bad, 2 * half_px + 1, mode="constant", cval=True)
    column, row = np.floor(points + 0.5).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < bad.shape[1]) & (row < bad.shape[0])
    has_bad_pixel = has_bad_pixel[np.where(inside, row, 0), np.where(inside, column, 0)]
    is_alone[rows_with_position] = inside & ~has_bad_pixel & (distance > distance_px)
    return is_alone


def photon_transfer(
    light: np.ndarray, residual: np.ndarray, sigma: np.ndarray
) -> tuple[float, float, float]:
    """Return 1/g, its standard error, and ε from pixels of any shape, by robust variances.

    Bins of about 60 pixels of equal light have the variance (1.48 median |r/σ|)² ± 2.33/√n of
    itself, and v/σ² − 1 = (L/σ²)/g + ε² L²/σ² is fitted to them; both terms are at least 0.
    """
    from scipy.optimize import nnls

    # Bins of pixels in the order of L/σ²; pixels where it is below 0.02 show no photon noise.
    light, residual, sigma = light.ravel(), residual.ravel(), sigma.ravel()
    light_over_variance = light / sigma**2
    order = np.argsort(light_over_variance, kind="stable")
    order = order[light_over_variance[order] > 0.02]
    bins = np.array_split(order, max(len(order) // 60, 1))
    if len(bins) < 6:
        return 0.0, np.inf, 0.0
    count = np.array([len(members) for members in bins])
    # Terms of the law in each bin, L/σ² and L²/σ², and the variance of r/σ.
    linear, square = (
        np.array([values[members].mean() for members in bins])
        for values in (light_over_variance, light * light_over_variance)
    )
    modulus = np.abs(residual / sigma)
    variance = np.array([SIGMA_OF_MAD * middle_value(modulus[members]) for members in bins]) ** 2
    # Weighted least squares of a and b ≥ 0 in v/σ² − 1 = a L/σ² + b L²/σ²; weights follow from the
    # variances that the last fit expects.
    expected_variance = np.maximum(variance, 1.0)
    for _ in range(5):
        weight = np.sqrt(count) / (2.33 * expected_variance)
        design = np.stack([linear, square], axis=1) * weight[:, None]
        coefficients, residual_norm = nnls(design, (variance - 1.0) * weight)
        expected_variance = 1.0 + coefficients[0] * linear + coefficients[1] * square
    # Standard error of a; where the law does not hold, it is known as badly as χ² says.
    excess = max(residual_norm**2 / (len(bins) - 2), 1.0)
    error = np.sqrt(excess * np.linalg.inv(design.T @ design)[0, 0])
    return float(coefficients[0]), float(error), float(np.sqrt(coefficients[1]))
