"""The exact posterior mean of stars without random aberrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from psfdae.methods import method
from psfdae.methods.interface import FitError, TrainingSet
from psfdae.stars.noise import NoiseModel
from psfdae_paper.bounds.estimates import propagate_static_psfs
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.configuration.consistency import SIMULATION

NOISE = NoiseModel(kappa=4.98, background=1e4)
WORDS = ("dataset=dataset8", "preset=smoke", "grid.points=2", "wavefront.waves=64")


@pytest.fixture(scope="module")
def training():
    """Stars of three of four fields behind static turbulence."""
    config = load_stage(SIMULATION, WORDS)
    field = np.array([0, 1, 3, 3])
    images = propagate_static_psfs(config)[field, 4]
    positions = np.stack(np.divmod(field, 2)[::-1], axis=1)
    parts = {"fit": np.arange(4), "validation": np.empty(0, int), "levels": np.array([2e-3])}
    simulation = config.model_dump()
    return TrainingSet(
        images, images, noise=NOISE, positions=positions, simulation=simulation, **parts
    )


def test_estimate_is_the_mean_over_all_static_psfs_with_their_poisson_likelihoods(training):
    fitted = method("static_posterior").fit(training)
    assert fitted.static.shape == (3, 9, 24, 24)
    levels, rng = np.array([2e-3, 8e-3, 8e-3]), np.random.default_rng(0)
    noisy = NOISE.draw(fitted.static[[0, 1, 2], [4, 0, 8]], levels, rng)
    estimate = fitted.estimate(noisy, levels)
    static = fitted.static.reshape(27, -1).astype(np.float64)
    for star, level in enumerate(levels):
        flux = NOISE.flux(level)
        counts = np.rint(flux * noisy[star].ravel()) + 1e4
        mean = flux * static + 1e4
        log_likelihood = (counts * np.log(mean) - mean).sum(axis=1)
        weight = np.exp(log_likelihood - log_likelihood.max())
        weight /= weight.sum()
        expected = weight @ static
        assert estimate.psf[star].ravel() == pytest.approx(expected, abs=1e-7)
        variance = (weight @ static**2 - expected**2).mean()
        assert np.square(estimate.sigma[star]) == pytest.approx(variance, rel=1e-3, abs=1e-15)
    # Without noise, the star itself.
    clear = fitted.estimate(fitted.static[:, 2], 1e-5)
    assert clear.psf == pytest.approx(fitted.static[:, 2], abs=1e-6)


def test_stars_with_random_aberrations_are_rejected(training):
    simulation = {**training.simulation, "scene": {"name": "seidel"}}
    with pytest.raises(FitError, match="without random aberrations"):
        method("static_posterior").fit(replace(training, simulation=simulation))
