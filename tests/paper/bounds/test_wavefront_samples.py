"""Samples of refined wavefronts: their density, their evidence, and the posterior of the bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_t

from psfdae.stars.noise import NoiseModel
from psfdae_paper.bounds.estimates import build_stamp_model
from psfdae_paper.bounds.mode_search import climb
from psfdae_paper.bounds.modes import Knowledge, Modes
from psfdae_paper.bounds.posterior import Likelihood
from psfdae_paper.bounds.refinement import NetworkStarts, Refiner
from psfdae_paper.bounds.sampling import sample_posterior
from psfdae_paper.bounds.stamp_model import StarPosteriors
from psfdae_paper.bounds.wavefront_samples import WavefrontSampler
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.configuration.consistency import SIMULATION

NOISE = NoiseModel(kappa=4.98, background=1e4)


@pytest.fixture(scope="module")
def model():
    """Stamps of dataset 3."""
    return build_stamp_model(load_stage(SIMULATION, ("dataset=dataset3",)))


@pytest.fixture(scope="module")
def stars(model):
    """Noisy stars at two neighbouring fields, and the posterior of the bounds about their modes."""
    count, level, rng = 12, 5e-3, np.random.default_rng(1)
    model = replace(model, field=np.array([[0.6, 0.0], [0.6, 0.06]]))
    star, z = np.arange(count), rng.standard_normal((count, 5))
    field = star % 2
    stamps = model.stamps(z, field, np.zeros((count, 2), int)).astype(np.float64)
    noisy = NOISE.draw(stamps, level, rng)
    posteriors = StarPosteriors(noisy, Likelihood.from_noise(NOISE, level, stamps), model)
    # Modes in both fields, at offsets of up to a pixel.
    shifts = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    starts = [
        Modes.make_starts(
            star,
            np.full(count, number),
            np.tile(shift, (count, 1)),
            np.full(count, Knowledge.NONE),
            z,
        )
        for number in range(2)
        for shift in shifts
    ]
    rngs = [np.random.default_rng([2, number]) for number in star]
    modes = climb(Modes.join(starts), posteriors)
    exact, _ = sample_posterior(modes, posteriors, np.full(count, -1), 4000, rngs)
    point = model.coefficients(z, field)
    return model, noisy, np.full(count, level), point, exact.with_truth


def propose(points):
    """Proposals (n, K, 8) of the same weight, without a network's PSF."""
    count, number, size = points.shape
    psf = np.zeros((count, 256))
    precision, weight = np.zeros((count, number, size, size)), np.full((count, number), 1 / number)
    return NetworkStarts(points, precision, weight, psf, psf + 1.0)


def test_samples_have_the_mean_and_the_variance_of_the_posterior(stars, monkeypatch):
    model, noisy, level, point, exact = stars
    is_tested = exact.effective_size > 300
    assert is_tested.sum() >= 8
    variance = exact.variance.sum(axis=1)
    monkeypatch.setattr(WavefrontSampler, "samples", 512)
    linear, sampled = (
        kind.from_model(model, NOISE, seed=0).refine(noisy, level, propose(point[:, None]))
        for kind in (Refiner, WavefrontSampler)
    )
    linear_error, error = (
        np.median((np.square(refined.psf - exact.mean_image).sum(axis=1) / variance)[is_tested])
        for refined in (linear, sampled)
    )
    ratio = sampled.variance.sum(axis=1) / variance
    assert np.median(ratio[is_tested]) == pytest.approx(1.0, abs=0.1)
    # The noise of the samples; linear stamps are farther away.
    assert error < 0.02
    assert linear_error > 2.0 * error


def test_density_of_draws_is_a_sum_over_expansions(stars):
    """Components of the same field and offset, of two expansions, overlap."""
    model, noisy, level, point, _ = stars
    sampler = WavefrontSampler.from_model(model, NOISE, seed=0)
    flux = NOISE.flux(level)
    counts = flux[:, None] * noisy.reshape(len(noisy), -1) + NOISE.background
    fields = np.tile([0, 1], (2, 1))
    # Two expansions of one star, 0.05 waves apart in focus.
    points = point[[0, 0]] + np.outer([0.0, 0.05], np.eye(8)[3] + np.eye(8)[5])
    expansion = sampler.expand(points, counts[[0, 0]], flux[[0, 0]], fields)
    draws = sampler.draw(np.array([0, 0]), expansion)
    components, offsets = expansion.components, sampler.count_offsets(expansion)
    share = np.exp(expansion.log_mass - np.logaddexp.reduce(expansion.log_mass, axis=None))
    for number in range(sampler.samples):
        z, coefficients = draws.z[0, number], draws.point[0, number]
        density = 0.0
        for row, field, corner in np.ndindex(2, 2, 4):
            # The wavefront of z in this field and at this offset is the wavefront of the draw.
            offset = 0.5 * model.telescope.pixel * offsets[row, 4 * field + corner]
            expected = model.coefficients(z[None], np.array([field]))[0]
            expected[-2:] += offset
            if not np.allclose(expected, coefficients, atol=1e-6):
                continue
            mean, covariance = components.z[row, field, corner], components.covariance[row, field]
            part = multivariate_t(mean, covariance, df=sampler.freedom).pdf(z)
            density += share[row, 4 * field + corner] * part
        assert np.log(density) == pytest.approx(draws.log_density[0, number], abs=1e-6)


def test_evidence_is_the_integral_over_the_prior(model):
    """Only coma varies, at one field: the sum over the prior is exact."""
    level, count = 5e-3, 5
    sd = np.array([0.0, 0.4, 0.0, 0.0, 0.0])
    one = replace(model, field=np.array([[0.3, -0.1]]), sd=sd)
    field, rng = np.zeros(count, int), np.random.default_rng(3)
    z = rng.standard_normal((count, 5))
    stamps = one.stamps(z, field, np.zeros((count, 2), int)).astype(np.float64)
    noisy = NOISE.draw(stamps, level, rng)
    sampler, levels = WavefrontSampler.from_model(one, NOISE, seed=0), np.full(count, level)
    starts = propose(one.coefficients(z, field)[:, None])
    evidence = sampler.refine(noisy, levels, starts).evidence
    # Sum of prior × likelihood over a fine grid of z and the offsets of up to two pixels.
    likelihood = Likelihood.from_noise(NOISE, level, stamps)
    grid = np.zeros((401, 5))
    grid[:, 1] = np.linspace(-5.0, 5.0, 401)
    log_terms = []
    for row, column in np.ndindex(5, 5):
        offset = np.tile([row - 2, column - 2], (len(grid), 1))
        images = one.stamps(grid, np.zeros(len(grid), int), offset).reshape(len(grid), -1)
        mean = likelihood.flux * images[:, None].astype(np.float64) + NOISE.background
        counts = likelihood.counts(noisy)
        log_ratio = np.log(np.maximum(counts, 1e-9) / mean)
        deviance = 2.0 * (counts * log_ratio - (counts - mean)).sum(axis=2)
        log_prior = -0.5 * grid[:, 1] ** 2 - 0.5 * np.log(2.0 * np.pi) + np.log(10.0 / 400)
        is_framed = sampler.is_framed(images)
        log_terms.append(np.where(is_framed[:, None], log_prior[:, None] - 0.5 * deviance, -np.inf))
    expected = np.logaddexp.reduce(np.concatenate(log_terms), axis=0)
    assert evidence == pytest.approx(expected, abs=0.25)


def test_only_stamps_with_a_small_centring_error_are_framed(model):
    sampler = WavefrontSampler.from_model(model, NOISE, seed=0)
    stamps = np.zeros((4, 16, 16))
    reach = sampler.jitter_px
    for star, pixel in enumerate([(8, 8), (8 + reach, 8 - reach), (9 + reach, 8)]):
        stamps[(star, *pixel)] = 1.0
    # Of two equal pixels, the first is framed.
    stamps[3, 8, 8] = 1.0 + 0.1 * sampler.tie
    stamps[3, 7 - reach, 8] = 1.0
    assert sampler.is_framed(stamps.reshape(4, -1)).tolist() == [True, True, False, False]


def test_a_star_that_no_draw_explains_keeps_its_linear_mean(stars, monkeypatch):
    model, noisy, level, point, _ = stars
    monkeypatch.setattr(WavefrontSampler, "is_framed", lambda self, stamps: stamps[..., 0] > 1.0)
    refined, linear = (
        kind.from_model(model, NOISE, seed=0).refine(noisy, level, propose(point[:, None]))
        for kind in (WavefrontSampler, Refiner)
    )
    assert np.array_equal(refined.psf, linear.psf)
    assert np.array_equal(refined.evidence, linear.evidence)
