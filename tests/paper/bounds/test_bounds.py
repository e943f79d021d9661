"""Best possible estimates: the bank's symmetries, the posterior mean and the local floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import poisson

from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import monomial_coefficients, monomial_images, seidel_wavefronts
from psfdae_paper.bounds.estimates import build_stamp_model
from psfdae_paper.bounds.floor import Comparison, compute_local_error
from psfdae_paper.bounds.posterior import (
    Bank,
    Likelihood,
    compute_exact_posterior,
    compute_symmetry_weights,
    cut_templates,
    extrapolate,
    list_jitters,
    merge,
    sum_posterior,
)
from psfdae_paper.stars.fields import perturb, relative_field
from psfdae_paper.stars.framing import Propagation, brightest_pixel, normalise_flux
from psfdae_paper.stars.symmetry import SYMMETRIES, orbit

POINTS, SIDE = 3, 8


def framed_image(star_field, rng):
    """An image of a 3 × 3 grid's star, 12 px a side, brightest at index 6, field-dependent."""
    row, column = np.mgrid[:12, :12] - 6.0
    iy, ix = np.divmod(star_field, POINTS)
    width = rng.uniform(1.0, 1.6)
    tail = np.exp(-np.hypot(row - 1.5 * (iy - 1), column - 1.5 * (ix - 1)) / width)
    image = np.exp(-0.5 * (row**2 + column**2)) + 0.3 * tail + 0.01 * rng.random((12, 12))
    image[6, 6] = 2.0
    return image


@pytest.fixture(scope="module")
def bank():
    """Forty made-up stars on a 3 × 3 grid, stamps of 8 px."""
    rng = np.random.default_rng(5)
    field = np.arange(40) % POINTS**2
    framed = np.array([framed_image(f, rng) for f in field])
    peak = rng.integers(-5, 5, (40, 2))
    return Bank(framed.astype(np.float32), field, peak, np.zeros((40, 5)), POINTS, 1)


@pytest.fixture(scope="module")
def members(bank):
    """Every image of the bank, one by one: image, field, jitter number, weight."""
    weight = compute_symmetry_weights(bank.field, bank.peak, POINTS)
    rows = []
    for k in range(len(bank)):
        for s, symmetry in enumerate(SYMMETRIES):
            for j, jitter in enumerate(list_jitters(1)):
                row, column = symmetry.window(jitter, bank.margin)
                cut = bank.framed[k, row : row + SIDE, column : column + SIDE].astype(float)
                image = symmetry.image(cut / cut.sum())
                rows.append((image, symmetry.field(bank.field[k], POINTS), j, weight[k, s]))
    return [np.array(column) for column in zip(*rows, strict=True)]


@pytest.fixture(scope="module")
def stars(members):
    """Some of the bank's images as test stars."""
    return members[0][[0, 100, 777, 1500, 2400]]


def test_pixels_and_fields_move_with_the_image_of_eight_symmetries():
    images = np.random.default_rng(1).random((2, 5, 5))
    assert len({symmetry.image(images).tobytes() for symmetry in SYMMETRIES}) == 8
    field = np.zeros((4, 4))
    field[1, 3] = 1.0  # row iy = 1, column ix = 3
    for symmetry in SYMMETRIES:
        assert (symmetry.undo(symmetry.image(images)) == images).all()
        row, column = np.argwhere(symmetry.image(field) == 1.0)[0]
        assert symmetry.field(3 + 4 * 1, 4) == column + 4 * row
        # Pixels from the chief ray in the middle: index − 2.
        assert (symmetry.pixel(np.array([1, 3]) - 2) == np.array([row, column]) - 2).all()


def test_fields_stay_equally_likely():
    field, peak = np.arange(POINTS**2), np.tile([2, -4], (POINTS**2, 1))
    weight = compute_symmetry_weights(field, peak, POINTS)
    assert (weight.sum(axis=1) == 8).all()
    assert sorted(weight[4])[-1] == 8  # the centre: one image stands for all eight
    assert sorted(weight[0]) == [0, 0, 0, 0, 2, 2, 2, 2]  # a corner is on one diagonal
    total = np.zeros(POINTS**2)
    for s, symmetry in enumerate(SYMMETRIES):
        np.add.at(total, symmetry.field(field, POINTS), weight[:, s])
    assert (total == 8).all()


def test_mirrored_crops_are_the_stars_of_mirrored_fields(scene1):
    """Fields on axes, diagonals, in the centre and elsewhere, and all their mirror images."""
    position = relative_field(scene1.grid)
    field = np.array([60, 5, 115, 57, 0, 108, 32, 85])
    rng = np.random.default_rng(8)
    seidel = perturb(np.tile(scene1.wavefront.coefficients, (field.size, 1)), 0.5, rng)
    targets = np.stack([s.field(field, 11) for s in SYMMETRIES], axis=1)
    everything = Propagation(
        seidel_wavefronts(np.repeat(seidel, 8, axis=0), position[targets.ravel()]),
        *(scene1.telescope, scene1.optics, scene1.framing, 64),
    )
    peaks = everything.brightest()
    originals = peaks[::8]  # the identity comes first
    framed = everything.stamps(20, np.repeat(originals, 8, axis=0))[::8]
    bank = Bank(framed, field, originals, seidel, 11, 1)
    weight = compute_symmetry_weights(field, originals, 11)
    jitter = (1, 0)
    direct, _ = normalise_flux(everything.stamps(16, peaks - np.array([jitter])))
    for s, symmetry in enumerate(SYMMETRIES):
        cut = symmetry.image(bank.stamps(symmetry.window(jitter, bank.margin)))
        expected = direct.reshape(field.size, 8, 16, 16)[:, s]
        close = np.abs(cut - expected).max(axis=(1, 2)) < 1e-4 * expected.max(axis=(1, 2))
        assert close[weight[:, s] > 0].all()
    # On a mirror axis some symmetries would frame the other of two equal maxima.
    assert (weight > 0).sum() < weight.size
    assert (weight > 0).any(axis=1).all()


def test_templates_of_all_jitters_are_framed_and_normalised(bank):
    stamps = cut_templates(bank.framed[:5, 1:-1, 1:-1], jitter_px=1)
    assert stamps.shape == (5, 9, SIDE, SIDE)
    assert stamps.sum(axis=(2, 3)) == pytest.approx(np.ones((5, 9)), rel=1e-6)
    for shifted in stamps:
        brightest = [brightest_pixel(stamp, 1e-4) for stamp in shifted]
        assert brightest == [(4 + row, 4 + column) for row, column in list_jitters(1)]


def brute_force(members, noisy, flux, background):
    """Normalised weights of all images by the Poisson distribution itself."""
    images, _, _, weight = members
    counts = np.rint(flux * noisy.astype(float)) + background
    log_l = poisson.logpmf(counts[:, None], flux * images + background).sum(axis=(2, 3))
    with np.errstate(divide="ignore"):
        log_l += np.log(weight)
    w = np.exp(log_l - log_l.max(axis=1, keepdims=True))
    return w / w.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("level", [3e-5, 1e-3, 2e-2])
def test_posterior_mean_is_that_of_the_poisson_distribution(level, bank, members, stars, noise):
    noisy = noise.draw(stars, level, np.random.default_rng(2))
    likelihood = Likelihood.from_noise(noise, level, bank.stamps((2, 2)))
    halves = [replace(bank, chunk=7).take(np.arange(half, 40, 2)) for half in (0, 1)]
    sums = merge([sum_posterior(half, noisy, likelihood) for half in halves])
    w = brute_force(members, noisy, likelihood.flux, noise.background)
    images, field, jitter, _ = members
    flat = images.reshape(len(images), -1)
    assert np.abs(sums.mean_image - w @ flat).max() < 1e-4 * (w @ flat).max()
    assert sums.effective_size == pytest.approx(1 / (w**2).sum(axis=1), rel=2e-2)
    templates = np.random.default_rng(3).random((POINTS**2, 9, SIDE, SIDE))
    static = templates[field, jitter].reshape(len(images), -1)
    mean, variance = sums.template(templates)
    assert mean == pytest.approx(w @ static, rel=1e-2)
    for values, spread, rounding in ((static, variance, 1e-6), (flat, sums.variance, 1e-8)):
        expected = w @ (values**2) - (w @ values) ** 2
        assert spread == pytest.approx(expected, rel=2e-2, abs=rounding)
    # At the highest noise the data say little, at the lowest everything.
    assert (sums.effective_size > 50).all() if level > 1e-2 else True
    assert (sums.effective_size < 1.01).all() if level < 1e-4 else True


@pytest.mark.parametrize("level", [1e-3, 2e-2])
@pytest.mark.parametrize("corners", [[4], [0, 2, 6, 8]])
def test_given_the_field_only_its_images_count(level, corners, bank, members, noise):
    """The centre is its own orbit; corners are mirror images of each other."""
    images, field, _, weight = members
    orbit_bank = replace(bank, chunk=7).take(np.flatnonzero(np.isin(bank.field, corners)))
    for corner in corners:
        noisy = noise.draw(images[field == corner][[3, 50]], level, np.random.default_rng(2))
        likelihood = Likelihood.from_noise(noise, level, bank.stamps((2, 2)))
        sums = sum_posterior(orbit_bank, noisy, likelihood, np.full(2, corner))
        inside = (images, field, None, weight * (field == corner))
        w = brute_force(inside, noisy, likelihood.flux, noise.background)
        expected = np.einsum("nk,khw->nhw", w, images).reshape(2, -1)
        assert np.abs(sums.mean_image - expected).max() < 1e-4 * expected.max()
        assert sums.template_weight.sum(axis=(0, 2)).nonzero()[0].tolist() == [corner]
    assert (orbit(np.array(corners), POINTS) == corners[0]).all()


def test_extrapolation_recovers_a_power_law():
    draws = 500 * 2 ** np.arange(5)
    limit, exponent, residual = extrapolate(draws, 2e-6 + 3e-4 / draws**0.8)
    assert (limit, exponent) == (pytest.approx(2e-6, rel=1e-3), pytest.approx(0.8, rel=1e-3))
    assert residual < 1e-5
    assert np.isnan(extrapolate(draws[:3], np.ones(3))).all()


def test_exact_posterior_is_the_poisson_one(noise, members):
    templates = members[0][:27].reshape(3, 9, SIDE, SIDE)
    field, images = np.array([0, 1, 2, 0]), templates.reshape(27, SIDE, SIDE)
    truth = templates[field, [4, 0, 8, 3]]
    for level, certain in ((1e-3, True), (1e-2, False), (10.0, False)):
        noisy = noise.draw(truth, level, np.random.default_rng(4))
        likelihood = Likelihood.from_noise(noise, level, truth)
        mean, variance, probability = compute_exact_posterior(noisy, templates, likelihood)
        flat = (images, None, None, np.ones(27))
        w = brute_force(flat, noisy, likelihood.flux, noise.background)
        assert probability == pytest.approx(w.reshape(4, 3, 9).sum(axis=2), abs=1e-8)
        assert mean == pytest.approx(np.einsum("nk,khw->nhw", w, images), abs=1e-8)
        spread = ((images - mean[:, None]) ** 2).mean(axis=(2, 3))
        assert variance == pytest.approx((w * spread).sum(axis=1), abs=1e-12)
        assert (probability[np.arange(4), field] > 0.99).all() == certain
    assert probability == pytest.approx(np.full((4, 3), 1 / 3), abs=0.02)
    mean, _, probability = compute_exact_posterior(noisy, templates, likelihood, field)
    assert probability == pytest.approx(np.eye(3)[field])
    inside = w * (np.repeat(np.arange(3), 9) == field[:, None])
    inside /= inside.sum(axis=1, keepdims=True)
    assert mean == pytest.approx(np.einsum("nk,khw->nhw", inside, images), abs=1e-8)


def test_derivatives_are_those_of_the_propagated_stamp(scene1):
    """The star is away from every mirror axis, at N = 160."""
    field, offset, step = np.array([0.2, -0.6]), np.array([-3, 2]), 1e-4
    star = np.array([0.55, 3.7, 4.3, 1.7, -0.12])
    pupil = annular_pupil(160, scene1.telescope.obscuration)
    propagate = StampPropagator(pupil, 16, scene1.telescope.pixel)
    images = monomial_images(pupil.axis[None, :], pupil.axis[:, None])

    def stamp(seidel):
        opd = np.tensordot(monomial_coefficients(seidel, field), images, axes=1)
        return normalise_flux(propagate(opd[None], offset[None]))[0][0]

    stamps, jacobians = build_stamp_model(scene1).derivatives(
        monomial_coefficients(star, field)[None],
        monomial_coefficients(np.eye(5), field[None])[None],
        offset[None],
        np.array([160]),
        "complex128",
    )
    assert stamps.reshape(16, 16) == pytest.approx(stamp(star), abs=1e-12)
    for jacobian, direction in zip(jacobians.reshape(5, 16, 16), step * np.eye(5), strict=True):
        difference = (stamp(star + direction) - stamp(star - direction)) / (2 * step)
        assert np.abs(jacobian).max() > 1e-4
        assert np.abs(jacobian - difference).max() < 1e-5 * np.abs(jacobian).max()


def test_floor_of_a_linear_gaussian_problem():
    """The error of the optimal linear estimator, in closed form and by simulation."""
    rng = np.random.default_rng(6)
    jacobian = rng.standard_normal((1, 3, 16))
    sd = np.array([0.5, 2.0, 0.0])
    variance = rng.uniform(0.5, 2.0, (1, 16))
    error = compute_local_error(jacobian, sd, variance)[0]
    h, prior, noise_cov = jacobian[0].T, np.diag(sd**2), np.diag(variance[0])
    gain = prior @ h.T @ np.linalg.inv(h @ prior @ h.T + noise_cov)
    uncertainty = prior - gain @ h @ prior
    assert error == pytest.approx(np.trace(h @ uncertainty @ h.T) / 16, rel=1e-10)
    truth = sd[:, None] * rng.standard_normal((3, 20000))
    data = h @ truth + np.sqrt(variance.reshape(16, 1)) * rng.standard_normal((16, 20000))
    assert error == pytest.approx(((h @ (gain @ data - truth)) ** 2).mean(), rel=0.03)


def test_comparison_is_paired_and_tolerant():
    rng = np.random.default_rng(9)
    field, bound = np.arange(400) % 20, rng.exponential(1.0, 400)
    equal = Comparison.from_pairs(bound, bound, field)
    assert (equal.efficiency, equal.difference, equal.beaten) == (1.0, 0.0, False)
    shifted = Comparison.from_pairs(bound + 0.1, bound, field)
    assert shifted.difference == pytest.approx(0.1)
    assert shifted.stderr < 1e-12  # the stars' own scatter is common to both
    assert not shifted.beaten
    assert not Comparison.from_pairs(0.96 * bound, bound, field).beaten
    assert Comparison.from_pairs(0.8 * bound, bound, field).beaten
    assert np.isnan(Comparison.from_pairs(bound, 0 * bound, field).efficiency)
