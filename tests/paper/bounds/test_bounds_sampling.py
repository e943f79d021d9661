"""Importance sampling of single stars against the posterior mean over a fine grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_t

from psfdae.base.rng import stream
from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae_paper.bounds.mode_search import (
    climb,
    find_twins,
    find_unexplained,
    propose_starts,
    recentre,
    select_best,
)
from psfdae_paper.bounds.modes import Knowledge, Modes, Positions
from psfdae_paper.bounds.posterior import Likelihood, list_jitters, merge
from psfdae_paper.bounds.sampling import sample_posterior
from psfdae_paper.bounds.stamp_model import StampModel, StarPosteriors
from psfdae_paper.stars.framing import Propagation, crop_jittered, normalise_flux

LEVEL = 3e-3
FIELDS = np.array([[0.4, 0.2], [0.416, 0.208], [-0.4, 0.6]])
OPEN = (1, 2)
"""Coefficients that vary: coma and astigmatism."""

GRID = np.linspace(-3.6, 3.6, 25)


@pytest.fixture(scope="module")
def model(scene1):
    mean = np.array(scene1.wavefront.coefficients)
    spread = np.where(np.isin(np.arange(5), OPEN), 0.04 * np.abs(mean), 0.0)
    return StampModel(mean, spread, FIELDS, scene1.telescope, scene1.optics, scene1.framing)


def simulated(model, z, field):
    """Stamps at all jitters and brightest pixels, framed by the simulator itself."""
    source = seidel_wavefronts(model.mean + model.sd * z, model.field[field])
    propagation = Propagation(source, model.telescope, model.optics, model.framing, 24)
    framed, peak = propagation.frame(model.framing.stamp_px + 2)
    cuts = [crop_jittered(framed, np.array(jitter), 1) for jitter in list_jitters(1)]
    return np.stack([normalise_flux(cut)[0] for cut in cuts], axis=1), peak


@pytest.fixture(scope="module")
def stars(model, noise):
    """Four stars of the first field: truth, noisy images and where their stamps are centred."""
    z = np.zeros((4, 5))
    z[:, OPEN] = np.random.default_rng(1).standard_normal((4, 2))
    images, peak = simulated(model, z, np.zeros(4, int))
    jitter = np.array([0, 4, 5, 8])
    truth = images[np.arange(4), jitter]
    noisy = noise.draw(truth, LEVEL, np.random.default_rng(2))
    return z, truth, noisy, peak - np.array(list_jitters(1))[jitter]


@pytest.fixture(scope="module")
def exact(model, stars, noise):
    """Posterior mean and probability of field and jitter, summed over a grid."""
    z = np.zeros((GRID.size**2, 5))
    z[:, OPEN] = np.stack(np.meshgrid(GRID, GRID), axis=-1).reshape(-1, 2)
    field = np.repeat(np.arange(len(FIELDS)), len(z))
    z = np.tile(z, (len(FIELDS), 1))
    images, _ = simulated(model, z, field)
    images = images.reshape(len(z) * 9, -1)
    likelihood = Likelihood.from_noise(noise, LEVEL, stars[1])
    ratio, offset = likelihood.factors(images)
    scores = likelihood.residuals(stars[2]) @ ratio.T + offset
    scores -= 0.5 * np.repeat((z**2).sum(axis=1), 9)
    weight = np.exp(scores - scores.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    share = weight.reshape(4, len(FIELDS), -1, 9).sum(axis=2)
    inside = np.where(np.repeat(field, 9) == 0, weight, 0.0)
    return weight @ images, share, inside @ images / inside.sum(axis=1, keepdims=True)


@pytest.fixture(scope="module")
def modes(model, stars, noise):
    """Modes found from one start in the right field, at no aberration."""
    none = np.zeros(4, int)
    start = Modes.make_starts(np.arange(4), none, stars[3], none, np.zeros((4, 5)))
    likelihood = Likelihood.from_noise(noise, LEVEL, stars[1])
    posteriors = StarPosteriors(stars[2], likelihood, model)
    first = climb(start, posteriors)
    return climb(Modes.join([first, find_twins(first, posteriors)]), posteriors)


def sampled(model, modes, stars, noise, draws=2000, **blocks):
    likelihood = Likelihood.from_noise(noise, LEVEL, stars[1])
    rngs = [stream(1, "test", star) for star in range(4)]
    posteriors = StarPosteriors(stars[2], likelihood, model)
    return sample_posterior(modes, posteriors, np.zeros(4, int), draws, rngs, **blocks)


def test_draws_have_the_posterior_mean_of_the_grid(model, modes, stars, noise, exact):
    unknown_field, known_field = sampled(model, modes, stars, noise)
    mean, share, mean_in_field = exact
    blind, own_field = merge(unknown_field.parts), merge(known_field.parts)
    error = ((mean - stars[1].reshape(4, -1)) ** 2).mean()
    assert ((blind.mean_image - mean) ** 2).mean() < 0.01 * error
    assert ((own_field.mean_image - mean_in_field) ** 2).mean() < 0.01 * error
    probability = blind.template_weight / blind.weight_sum[:, None, None]
    assert probability == pytest.approx(share, abs=0.03)
    # Fields in one direction can give nearly the same image.
    assert (share[:, 1].sum(axis=1) > 0.01).any()
    assert (own_field.template_weight[:, 1:] == 0).all()
    assert unknown_field.with_truth.mean_image == pytest.approx(blind.mean_image, abs=1e-12)
    assert ((blind.effective_size > 500) & (blind.effective_size < 2100)).all()


def test_same_streams_give_the_same_bytes_in_any_blocks(model, modes, stars, noise):
    first, second = (sampled(model, modes, stars, noise, 80)[0].with_truth for _ in range(2))
    assert first.image_sum.tobytes() == second.image_sum.tobytes()
    single = sampled(model, modes, stars, noise, 80, stars_at_once=1)[0].with_truth
    assert single.mean_image == pytest.approx(first.mean_image, abs=1e-6)


def test_stamps_are_those_of_the_simulator(model, stars):
    z, truth, _, offset = stars
    stamps = model.stamps(z, np.zeros(4, int), offset)
    assert stamps == pytest.approx(truth, abs=1e-4)
    assert ((stamps - truth) ** 2).mean() < 1e-9


def test_twins_give_the_same_image(model, noise):
    """Twice as far from the axis: half the coma, a quarter of the astigmatism."""
    field = np.array([[0.4, 0.2], [0.8, 0.4], [-0.4, 0.6]])
    broad = replace(model, mean=np.zeros(5), sd=np.ones(5), field=field)
    z = np.array([[0.0, 0.8, 0.4, 0.8, 0.0]])
    z_far = z / [1, 2, 4, 4, 8]
    middle = np.array([[1, 2]])
    images = [broad.stamps(c, np.array([k]), middle) for k, c in enumerate((z, z_far))]
    assert images[1] == pytest.approx(images[0], abs=1e-5)
    z_negated = z * [-1, 1, -1, -1, 1]  # the even part negated
    assert broad.stamps(z_negated, np.array([0]), middle) == pytest.approx(images[0], abs=1e-5)
    none = np.zeros(1, int)
    start = Modes.make_starts(none, none, middle, none, z)
    likelihood = Likelihood.from_noise(noise, 1e-4, images[0])
    twins = find_twins(start, StarPosteriors(images[0], likelihood, broad))
    at_twin = (twins.field == 1) & (twins.offset == middle).all(axis=1)
    assert twins.z[at_twin][0] == pytest.approx(z_far[0], abs=0.02)
    # A pixel aside is a tilt, which distortion can make up for where it is large.
    assert len(twins.star) > 1


def test_the_twin_of_a_mode_at_its_own_place_weighs_as_the_mode(model, noise):
    """Two modes with nearly the same evidence: the one with more comes first."""
    field = np.array([[0.4, 0.2], [0.8, 0.4], [-0.4, 0.6]])
    broad = replace(model, mean=np.zeros(5), sd=np.ones(5), field=field)
    z = np.array([[0.0, 0.3, 0.2, 0.3, 0.0], [0.5, 2.0, 1.0, 2.0, 0.5]])
    number, middle = np.arange(2), np.array([[1, 2], [0, 0]])
    images = broad.stamps(z, 2 * number, middle)
    likelihood = Likelihood.from_noise(noise, 1e-4, images)
    start = Modes.make_starts(number, 2 * number, middle, 0 * number, z)
    posteriors = StarPosteriors(images, likelihood, broad)
    modes = climb(start, posteriors)
    for first in range(2):
        evidence = np.where(number == first, 100.0, 99.0)
        two_modes = replace(modes, star=0 * number, evidence=evidence)
        twins = find_twins(two_modes, posteriors)
        at = [
            np.flatnonzero((twins.field == f) & (twins.offset == o).all(axis=1))[0]
            for f, o in zip(2 * number, middle, strict=True)
        ]
        assert at[first] < at[1 - first]
        assert twins.z[at] == pytest.approx(modes.z, abs=0.1)


def test_density_of_draws_is_students_t():
    rng = np.random.default_rng(5)
    factor = np.tril(rng.normal(0, 0.3, (2, 5, 5))) + np.eye(5)
    number, none = np.arange(2), np.zeros(2, int)
    start = Modes.make_starts(
        none, number, np.array([[0, 1], [2, 3]]), none, rng.normal(size=(2, 5))
    )
    modes = replace(start, factor=factor)
    z, field = rng.normal(0, 3, (30, 5)), np.arange(30) % 2
    offset = np.where(np.arange(30) < 20, modes.offset[field].T, 7).T
    density = modes.log_density(Positions(field, offset, z), modes.compute_squared_distance(z))
    for mode in number:
        scale = factor[mode] @ factor[mode].T
        law = multivariate_t(modes.z[mode], scale, Modes.freedom)
        at_mode = (field == mode) & (np.arange(30) < 20)
        assert density[mode, at_mode] == pytest.approx(law.logpdf(z[at_mode]), abs=1e-9)
        assert (density[mode, ~at_mode] == -np.inf).all()


def aside(stars, model, noise, level, shift):
    """A star in the noise of `level`, its mode `shift` pixels beside the right one."""
    z, truth, _, offset = (part[:1] for part in stars)
    noisy = noise.draw(truth, level, np.random.default_rng(7))
    likelihood = Likelihood.from_noise(noise, level, truth)
    posteriors = StarPosteriors(noisy, likelihood, model)
    none = np.zeros(1, int)
    start = Modes.make_starts(none, none, offset + shift, np.full(1, Knowledge.FIELD), z)
    truth = Modes.make_starts(none, none, offset, np.full(1, Knowledge.TRUTH), z)
    return climb(start, posteriors), truth, posteriors


def test_stamps_beside_their_place_are_recentred(stars, model, noise):
    z, truth, noisy, offset = stars
    likelihood = Likelihood.from_noise(noise, LEVEL, truth)
    posteriors = StarPosteriors(noisy, likelihood, model)
    number, back = np.arange(len(z)), []
    for shift in set(list_jitters(1)) - {(0, 0)}:
        start = Modes.make_starts(
            number, 0 * number, offset + shift, np.full(len(z), Knowledge.FIELD), z
        )
        modes, is_moved = recentre(start, posteriors)
        assert (is_moved == (modes.offset != start.offset).any(axis=1)).all()
        back += (modes.offset == offset).all(axis=1).tolist()
    # A tilt and coma move an image nearly alike.
    assert np.mean(back) > 0.6


def test_a_place_that_several_starts_reach_is_returned_once(stars, model, noise):
    z, truth, noisy, offset = stars
    posteriors = StarPosteriors(noisy, Likelihood.from_noise(noise, LEVEL, truth), model)
    number = np.repeat(np.arange(len(z)), 5)
    knowledge = np.full(number.size, Knowledge.FIELD)
    beside = z[number] + np.outer(np.tile(np.linspace(-0.2, 0.2, 5), len(z)), np.ones(5))
    starts = Modes.make_starts(number, 0 * number, offset[number], knowledge, beside)
    places, is_moved = recentre(starts, posteriors)
    assert np.bincount(places.star).tolist() == [1, 1, 1, 1] and not is_moved.any()
    # Starts are added unchanged where their own offset has changed.
    assert propose_starts(starts, posteriors).star.size == 4
    aside = replace(starts, offset=starts.offset + 1)
    moved = int(recentre(aside, posteriors)[1].sum())
    both = propose_starts(aside, posteriors)
    assert moved > 10 and both.star.size == len(recentre(aside, posteriors)[0].star) + moved
    assert (both.z[-moved:, None] == aside.z).all(axis=2).any(axis=1).all()


def test_a_mode_found_without_the_field_explains_the_star_in_its_field(modes, stars, model, noise):
    """Poorer modes that were found with the field known do not make a star unexplained."""
    posteriors = StarPosteriors(stars[2], Likelihood.from_noise(noise, LEVEL, stars[1]), model)
    star_field = np.zeros(4, int)
    blind = modes.select(modes.field == 0)
    poor = replace(blind, offset=blind.offset + 3, evidence=blind.evidence - 40.0)
    poor = replace(poor, knowledge=np.full(poor.star.size, Knowledge.FIELD))
    both = Modes.join([blind, poor])
    assert not find_unexplained(select_best(both, star_field), posteriors, 4.0).star.size
    # Alone, they leave all stars unexplained, each of which is named with its field known.
    alone = find_unexplained(select_best(poor, star_field), posteriors, 4.0)
    assert alone.star.tolist() == [0, 1, 2, 3]
    assert (alone.knowledge == Knowledge.FIELD).all()


def test_coarse_pupil_grids_are_used_only_where_the_noise_hides_their_error(scene1, noise):
    """The stamps' error is the one that `StampModel.coarsen` compares with the noise."""
    rng, mean = np.random.default_rng(3), np.array(scene1.wavefront.coefficients)
    groups = scene1.telescope, scene1.optics, scene1.framing
    fine = StampModel(mean, 0.5 * np.abs(mean), FIELDS, *groups)
    z, field = rng.standard_normal((200, 5)), rng.integers(0, len(FIELDS), 200)
    offset = rng.integers(-1, 2, (200, 2))
    bright, faint = (
        fine.coarsen(Likelihood(noise.flux(level), noise.background, np.zeros(256)))
        for level in (9e-5, 3e-4)
    )
    assert (bright.is_coarse, faint.is_coarse) == (False, True)
    coefficients, directions = fine.coefficients(z, field), fine.directions(field)
    exact, _ = fine.derivatives(coefficients, directions, offset, np.full(200, 318), "complex128")
    errors = [
        ((model.stamps(z, field, offset).reshape(200, -1) - exact) ** 2).mean(axis=1)
        for model in (fine, faint)
    ]
    assert errors[0].mean() < 2e-10
    assert 1e-10 < errors[1].mean() < 6e-10
    assert errors[1].max() < 4e-9


def test_what_is_found_without_the_truth_does_not_depend_on_it(stars, model, noise):
    misplaced, truth, posteriors = aside(stars, model, noise, 1e-3, (0, 1))
    with_truth = Modes.join([misplaced, climb(truth, posteriors)])
    first, second = (
        sample_posterior(modes, posteriors, np.zeros(1, int), 100, [stream(1, "test", 0)])[1]
        for modes in (misplaced, with_truth)
    )
    for part, expected in zip(first.parts, second.parts, strict=True):
        assert part.image_sum.tobytes() == expected.image_sum.tobytes()
    assert second.with_truth.image_sum.tobytes() != first.with_truth.image_sum.tobytes()
