"""Wavefronts refined by the optics: closed forms, limits, and the maximum of the posterior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from psfdae.optics.wavefronts import monomial_coefficients
from psfdae.stars.noise import NoiseModel
from psfdae_paper.bounds.estimates import build_stamp_model
from psfdae_paper.bounds.mode_search import climb, select_best
from psfdae_paper.bounds.modes import Knowledge, Modes
from psfdae_paper.bounds.posterior import Likelihood
from psfdae_paper.bounds.refinement import (
    Combination,
    NetworkStarts,
    RefinedPsfs,
    Refiner,
    SeidelPrior,
    invert,
)
from psfdae_paper.bounds.sampling import sample_posterior
from psfdae_paper.bounds.stamp_model import StarPosteriors
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.configuration.consistency import SIMULATION

NOISE = NoiseModel(kappa=4.98, background=1e4)


@pytest.fixture(scope="module")
def model():
    """Stamps of dataset 3."""
    return build_stamp_model(load_stage(SIMULATION, ("dataset=dataset3",)))


def build_refiner(model, fields=slice(None)):
    return Refiner.from_model(replace(model, field=model.field[fields]), NOISE)


def propose(points, psf):
    """Proposals (n, K, 8), and a network whose PSFs have an RMS error of 0.001."""
    psf, precision = psf.reshape(len(psf), -1), np.zeros((*points.shape, 8))
    weight = np.full(points.shape[:2], 1.0 / points.shape[1])
    return NetworkStarts(points, precision, weight, psf, np.full_like(psf, 1e-6))


def draw_stars(model, count, seed):
    """Draw stars of the prior: noise-free stamps, their z, fields, offsets and coefficients."""
    rng = np.random.default_rng(seed)
    # Inner fields, whose stars are bright at the chief ray, the middle of the stamps.
    inner = np.flatnonzero(np.hypot(*model.field.T) < 0.7)
    z, field = rng.standard_normal((count, 5)), rng.choice(inner, count)
    offset = np.zeros((count, 2), int)
    stamps = model.stamps(z, field, offset).astype(np.float64)
    point = model.coefficients(z, field)
    return stamps, z, field, offset, point


def test_inverses_are_those_of_linear_algebra():
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((3, 4, 5, 5))
    matrices = roots @ roots.swapaxes(2, 3) + np.eye(5)
    inverse, log_determinant = invert(matrices)
    assert inverse == pytest.approx(np.linalg.inv(matrices), rel=1e-9, abs=1e-12)
    assert log_determinant == pytest.approx(np.linalg.slogdet(matrices)[1], rel=1e-12)


def test_posterior_of_a_linear_stamp_is_the_integral_over_the_prior():
    """One coefficient varies: mass and mean of each offset are integrals over a single z."""
    rng = np.random.default_rng(1)
    prior = SeidelPrior(
        np.array([0.5, 4.0, 4.2, 1.8, -0.1]),
        np.array([0.0, 0.4, 0.0, 0.0, 0.0]),
        np.array([[0.4, -0.2]]),
        pixel=0.9,
    )
    root = rng.standard_normal((8, 12))
    score, information = 20.0 * rng.standard_normal(8), 30.0 * root @ root.T
    # The expansion point is displaced by whole pixels and a little.
    point = prior.static[0] + 0.05 * rng.standard_normal(8)
    point[-2:] -= 0.5 * prior.pixel * np.array([3, -2])
    components = prior.condition(point[None], score[None], information[None], np.zeros((1, 1), int))
    z = np.linspace(-9.0, 9.0, 4001)
    wavefronts = monomial_coefficients(prior.mean + z[:, None] * prior.sd, prior.field[0])
    masses, sums = [], []
    for x in range(-6, 7):
        for y in range(-6, 7):
            delta = wavefronts - point
            delta[:, -2:] -= 0.5 * prior.pixel * np.array([x, y])
            log = delta @ score - 0.5 * ((delta @ information) * delta).sum(axis=1) - 0.5 * z**2
            density = np.exp(log) / np.sqrt(2.0 * np.pi)
            masses.append(np.trapezoid(density, z))
            sums.append(np.trapezoid(density[:, None] * delta, z, axis=0))
    # The four offsets next to the expansion point have nearly all of the mass.
    nearest = np.argsort(masses)[::-1][:4]
    best = nearest[0]
    assert np.exp(components.log_mass.max()) == pytest.approx(masses[best], rel=1e-6)
    assert components.mode[0] == pytest.approx(sums[best] / masses[best], rel=1e-6)
    assert np.sum(masses) == pytest.approx(np.exp(components.evidence[0]), rel=1e-3)
    mean, covariance = components.moments()
    assert mean[0] == pytest.approx(np.sum(sums, axis=0) / np.sum(masses), abs=1e-3)
    assert np.linalg.eigvalsh(covariance[0]).min() > -1e-12


def test_little_noise_gives_the_star_itself(model):
    """The error falls with λ², down to the error of the optics."""
    stamps, *_, point = draw_stars(model, 40, 2)
    rng = np.random.default_rng(3)
    start = point + 0.01 * rng.standard_normal(point.shape)
    errors = []
    for level in (1e-4, 1e-5):
        noisy = NOISE.draw(stamps, level, rng)
        starts = propose(start[:, None], stamps)
        refined = build_refiner(model).refine(noisy, np.full(40, level), starts)
        errors.append(np.median(np.square(refined.psf - stamps.reshape(40, -1)).mean(axis=1)))
        # All light is in the stamp.
        assert refined.psf.sum(axis=1) == pytest.approx(1.0, abs=1e-5)
    assert errors[0] < 0.05 * (4.98e-4) ** 2
    assert errors[1] < 0.05 * errors[0] + 2e-9


def test_errors_are_as_large_as_their_standard_deviations(model):
    stamps, *_, point = draw_stars(model, 150, 4)
    rng = np.random.default_rng(5)
    noisy = NOISE.draw(stamps, 1e-3, rng)
    start = point + 0.02 * rng.standard_normal(point.shape)
    starts = propose(start[:, None], stamps)
    refined = build_refiner(model).refine(noisy, np.full(150, 1e-3), starts)
    error = np.square(refined.psf - stamps.reshape(150, -1)).mean()
    assert error == pytest.approx(refined.variance.mean(), rel=0.25)


def test_a_second_proposal_is_used_where_the_first_one_fails(model):
    """A wavefront that is far away has a PSF unlike the network's, and little evidence."""
    stamps, *_, point = draw_stars(model, 30, 9)
    noisy = NOISE.draw(stamps, 1e-3, np.random.default_rng(10))
    level, wrong = np.full(30, 1e-3), np.roll(point, 7, axis=0)
    refiner = build_refiner(model)
    truth = stamps.reshape(30, -1)
    errors = [
        np.square(refiner.refine(noisy, level, propose(points, stamps)).psf - truth).mean()
        for points in (wrong[:, None], np.stack([wrong, point], axis=1), point[:, None])
    ]
    assert errors[0] > 20.0 * errors[2]
    assert errors[1] == pytest.approx(errors[2], rel=0.2)


def propose_ridge(point, shift_sd, rng):
    """One proposal per star, off by standard deviations along its axis of 0.5 waves.

    The other axes have standard deviations of 0.02 waves.
    """
    axes, _ = np.linalg.qr(rng.standard_normal((len(point), 8, 8)))
    sd = np.array([0.5, *[0.02] * 7])
    precision = (axes / sd**2) @ axes.swapaxes(1, 2)
    centre = point + shift_sd * sd[0] * axes[:, :, 0]
    psf = np.zeros((len(point), 256))
    ones = np.ones((len(point), 1))
    return NetworkStarts(centre[:, None], precision[:, None], ones, psf, psf + 1.0), axes[:, :, 0]


def test_starts_lie_along_the_axis_of_a_proposal():
    point, rng = np.zeros((3, 8)), np.random.default_rng(17)
    starts, axis = propose_ridge(point, 0.0, rng)
    # A second proposal of little weight, which is not used.
    doubled = NetworkStarts(
        np.repeat(starts.points, 2, axis=1),
        np.repeat(starts.precision, 2, axis=1),
        np.tile([0.99, 0.01], (3, 1)),
        *starts[3:],
    )
    star, points, precision = doubled.spread(2, 0.02, (-1.5, 0.0, 1.5), 0.6)
    assert star.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    # Standard deviation 0.5, with a limit of two waves.
    sd = (0.5**-2 + 2.0**-2) ** -0.5
    distance = (points.reshape(3, 3, 8) @ axis[:, :, None])[..., 0]
    assert np.abs(distance) == pytest.approx(np.tile([1.5 * sd, 0, 1.5 * sd], (3, 1)), abs=1e-12)
    assert distance.sum(axis=1) == pytest.approx(0.0, abs=1e-12)
    # Each start is 0.6 times as uncertain along the axis, and as uncertain across.
    covariance = np.linalg.inv(precision)
    along = np.einsum("na,nab,nb->n", axis[star], covariance, axis[star])
    assert along == pytest.approx(1.0 / (0.5**-2 + (0.6 * sd) ** -2))
    assert np.trace(covariance, axis1=1, axis2=2) - along == pytest.approx(7 * 0.02**2)


def test_wavefronts_along_the_axis_of_a_proposal_are_found(model, monkeypatch):
    """Between a proposal 0.7 waves off and the star are other maxima of the likelihood."""
    count, rng = 40, np.random.default_rng(18)
    stamps, *_, point = draw_stars(model, count, 19)
    noisy, level = NOISE.draw(stamps, 1e-3, rng), np.full(count, 1e-3)
    starts, _ = propose_ridge(point, 1.4, rng)
    refiner, truth = build_refiner(model), stamps.reshape(count, -1)
    found = refiner.refine(noisy, level, starts)
    error = np.square(found.psf - truth).mean()
    # The result of a star does not depend on the others.
    last = NetworkStarts(*(values[-5:] for values in starts))
    again = refiner.refine(noisy[-5:], level[-5:], last)
    assert again.psf == pytest.approx(found.psf[-5:], abs=1e-7)
    monkeypatch.setattr(Refiner, "positions", (0.0,))
    without = np.square(refiner.refine(noisy, level, starts).psf - truth).mean()
    assert error < 0.1 * without


def test_fields_are_selected_by_the_prior_of_the_wavefronts(model):
    """The true field is among the first, for wavefronts of the prior at any tilt."""
    prior, rng = build_refiner(model).prior, np.random.default_rng(20)
    field = rng.integers(len(model.field), size=200)
    point = model.coefficients(rng.standard_normal((200, 5)), field)
    point[:, -2:] += rng.standard_normal((200, 2))
    selected = prior.select_fields(point, 32)
    assert selected.shape == (200, 32)
    assert np.mean((selected == field[:, None]).any(axis=1)) > 0.98
    # They are those of the largest densities, here by another formula.
    covariance = prior.directions[..., :6].swapaxes(1, 2) @ prior.directions[..., :6]
    covariance += 0.01 * np.eye(6)
    density = [
        multivariate_normal(mean, matrix).logpdf(point[:5, :6])
        for mean, matrix in zip(prior.static[:, :6], covariance, strict=True)
    ]
    expected = np.argsort(-np.array(density), axis=0)[:32].T
    assert [*map(set, selected[:5].tolist())] == [*map(set, expected.tolist())]
    # All fields if there are fewer.
    assert build_refiner(model, fields=slice(3)).prior.select_fields(point, 32).shape == (200, 3)


def test_the_same_wavefront_is_counted_once(model):
    """A proposal close to another one adds nothing: neither to the mean nor to the evidence."""
    stamps, *_, point = draw_stars(model, 10, 13)
    rng, level = np.random.default_rng(14), np.full(10, 2e-3)
    noisy = NOISE.draw(stamps, 2e-3, rng)
    refiner, wrong = build_refiner(model), np.roll(point, 3, axis=0)
    pair, three = np.stack([point, wrong], axis=1), np.stack([point, wrong, point + 1e-3], axis=1)
    once, twice = (refiner.refine(noisy, level, propose(p, stamps)) for p in (pair, three))
    distance = np.abs(twice.psf - once.psf) / np.sqrt(once.variance)
    assert distance.max() < 0.05
    assert twice.evidence == pytest.approx(once.evidence, abs=0.05)


def test_wavefronts_of_similar_images_are_weighed_as_by_importance_samples(model):
    """Two fields and several offsets explain a star: from one of them, all are found."""
    count, level, rng = 6, 3e-3, np.random.default_rng(15)
    two = replace(model, field=np.array([[0.6, 0.0], [0.6, 0.06]]))
    star, middle, z = np.arange(count), np.zeros(2, int), rng.standard_normal((count, 5))
    stamps = two.stamps(z, np.zeros(count, int), np.tile(middle, (count, 1))).astype(np.float64)
    noisy = NOISE.draw(stamps, level, rng)
    posteriors = StarPosteriors(noisy, Likelihood.from_noise(NOISE, level, stamps), two)
    # Modes in both fields and at offsets of up to a pixel, and the exact posterior around them.
    shifts = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    blind = np.full(count, Knowledge.NONE)
    starts = [
        Modes.make_starts(star, np.full(count, field), np.tile(shift, (count, 1)), blind, z)
        for field in range(2)
        for shift in shifts
    ]
    modes = climb(Modes.join(starts), posteriors)
    rngs = [np.random.default_rng([16, number]) for number in star]
    sampled, _ = sample_posterior(modes, posteriors, np.full(count, -1), 500, rngs)
    exact = sampled.with_truth
    probability = exact.template_weight.sum(axis=2) / exact.weight_sum[:, None]
    # Stars with enough samples, of which either field may be right.
    is_tested = (exact.effective_size > 200) & (probability > 0.1).all(axis=1)
    assert is_tested.sum() >= 3
    refiner, means = build_refiner(two), []
    for field in range(2):
        points = two.coefficients(z, np.full(count, field))[:, None]
        refined = refiner.refine(noisy, np.full(count, level), propose(points, stamps))
        error = np.square(refined.psf - exact.mean_image).sum(axis=1) / exact.variance.sum(axis=1)
        # The error is a small part of the posterior variance.
        assert error[is_tested].max() < 0.15
        means.append(refined.psf)
    # Where the start is does not matter.
    change = np.square(means[0] - means[1]).sum(axis=1) / exact.variance.sum(axis=1)
    assert change[is_tested].max() < 0.05


def test_a_star_with_a_companion_has_little_evidence(model):
    """Of a star alone, −2 ln of the evidence is near the number of pixels."""
    stamps, *_, point = draw_stars(model, 40, 11)
    companion = stamps + 0.3 * np.roll(stamps[::-1], 4, axis=2)
    companion /= companion.sum(axis=(1, 2), keepdims=True)
    refiner, level, rng = build_refiner(model), np.full(40, 1e-3), np.random.default_rng(12)
    usual, strange = (
        -2.0 * refiner.refine(NOISE.draw(p, level, rng), level, propose(point[:, None], p)).evidence
        for p in (stamps, companion)
    )
    assert 200 < np.median(usual) < 350
    assert np.mean(strange > np.quantile(usual, 0.95)) > 0.8


def test_a_star_off_centre_by_more_than_a_centring_error_has_a_large_misfit(model):
    refiner = build_refiner(model)
    psf, variance = np.full((4, 256), 1e-3), np.full((4, 256), 1e-6)
    reach, images = refiner.jitter_px, psf.reshape(4, 16, 16)
    images[0, 8, 8] = images[1, 8 + reach, 8 - reach] = images[2, 9 + reach, 8] = 0.1
    # A pixel outside that is brighter by two standard deviations of a difference.
    images[3, 8, 8], images[3, 7 - reach, 8] = 0.1, 0.1 + 2e-3 * np.sqrt(2.0)
    misfit = refiner.measure_misfit(RefinedPsfs(psf, variance, np.array([-5.0, -6.0, -7.0, -8.0])))
    assert misfit == pytest.approx([10.0, 12.0, 14.0 + 0.099**2 / 2e-6, 16.0 + 4.0])


def test_refined_wavefront_is_the_maximum_of_the_posterior(model, monkeypatch):
    """In its field, at little noise, the refined PSF is the stamp of the climb's mode."""
    stamps, z, field, offset, point = draw_stars(model, 12, 6)
    level, rng = 5e-4, np.random.default_rng(7)
    noisy = NOISE.draw(stamps, level, rng)
    likelihood = Likelihood.from_noise(NOISE, level, stamps)
    star = np.arange(12)
    starts = Modes.make_starts(star, field, offset, np.full(12, Knowledge.FIELD), z)
    modes = select_best(climb(starts, StarPosteriors(noisy, likelihood, model)), field)
    expected = model.stamps(modes.z, modes.field, modes.offset).reshape(12, -1)
    # Expansions until the maximum.
    monkeypatch.setattr(Refiner, "linear_waves", 1e-3)
    monkeypatch.setattr(Refiner, "max_steps", 10)
    monkeypatch.setattr(Refiner, "pupil_samples", (126, 158, 190, 222, 254))
    for number in star:
        own = build_refiner(model, fields=[field[number]])
        starts = propose(point[[number], None], stamps[[number]])
        refined = own.refine(noisy[[number]], np.array([level]), starts)
        # The climb's last gain is up to 0.02 in ln L: a fraction of the standard deviation.
        distance = np.abs(refined.psf[0] - expected[number]) / np.sqrt(refined.variance[0])
        assert np.sqrt(np.mean(distance**2)) < 0.15


def test_a_combination_is_better_than_network_and_optics():
    """Stars of which either the network or the optics has the larger variance."""
    rng, count, pixels = np.random.default_rng(8), 4000, 16
    truth = rng.random((count, pixels))
    sd_network, sd_refined = np.exp(rng.uniform(-2, 2, (2, count, 1)))
    network = truth + sd_network * rng.standard_normal(truth.shape)
    refined = truth + sd_refined * rng.standard_normal(truth.shape)
    # The optics have another wavefront for every tenth star, whose PSF is far from the network's.
    is_wrong = np.arange(count) % 10 == 0
    refined[is_wrong] += 50.0
    ones = np.ones_like(truth)
    no_points = np.empty((count, 1, 8)), np.empty((count, 1, 8, 8)), np.ones((count, 1))
    starts = NetworkStarts(*no_points, network, sd_network**2 * ones)
    posterior = RefinedPsfs(refined, sd_refined**2 * ones, np.zeros(count))
    level = np.repeat([1e-3, 3e-3], count // 2)
    combination = Combination.fit(level, starts, posterior, truth)
    psf, sigma = combination.combine(level, starts, posterior)
    # The best weights are those of the variances.
    weight = sd_network**2 / (sd_network**2 + sd_refined**2) * ~is_wrong[:, None]
    ideal = np.square(network + weight * (refined - network) - truth).mean()
    assert np.square(psf - truth).mean() < 1.1 * ideal
    assert ideal < 0.7 * np.square(network - truth).mean()
    assert (np.abs(psf - truth) < sigma).mean() == pytest.approx(0.6827, abs=0.001)
    ratio95 = np.repeat(combination.sigma_ratio95, count // 2)[:, None]
    assert (np.abs(psf - truth) < ratio95 * sigma).mean() == pytest.approx(0.95, abs=0.001)
    # Between two levels, the factors are between theirs.
    half = replace(combination, factors=np.array([[-99.0, 0, 0], [99.0, 0, 0]]))
    middle, _ = half.combine(np.full(count, np.sqrt(3) * 1e-3), starts, posterior)
    assert middle == pytest.approx(0.5 * (network + refined))
