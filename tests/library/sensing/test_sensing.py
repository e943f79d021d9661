"""Wavefronts of known telescopes: the climb, the draws, single stars, the state of a telescope."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import psfdae
from command_line import printed
from docs_pages import blocks, read
from known_wavefronts import SKY, example, field_of, imaged, sensed, three_terms
from psfdae.optics.derivatives import ModalStamps
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.seeing import BlurredPropagator, BlurredSampling, Broadening, Profile
from psfdae.optics.wavefronts import zernike_images
from psfdae.sensing import stars as engine
from psfdae.sensing.climbing import Steps, add_normal_prior, climb, poisson_information
from psfdae.sensing.joint import TelescopePosterior, twin_numbers
from psfdae.sensing.modes import compute_squared_distance, merge_modes
from psfdae.sensing.plot import bright_separate_stars
from psfdae.sensing.quadratic import QuadraticPosterior, draw_design, fit_root
from psfdae.sensing.results import build_stamps
from psfdae.sensing.sampling import choose_evenly, sample_around
from psfdae.sensing.stars import Photons, SensingError, StarOptics
from psfdae.telescope.field import build_terms, model_telescope
from psfdae.telescope.settings import Prior, Seeing, read_telescope
from psfdae_paper.configuration.base import config_dir
from psfdae_paper.configuration.compose import load


@pytest.mark.parametrize(
    "kind", ("zernike", "seidel", "newtonian", "raytraced", "ritchey_chretien")
)
def test_library_reads_telescopes_as_hydra_composes_them(kind):
    composed = load(["dataset=_telescope", f"telescope=example_{kind}"]).telescope
    assert example(kind) == composed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("defaults: ['../../secret']\n", "NAME"),
        ("defaults: [telescope]\n", "itself"),
        ("name: a\ndiameter_m: -1\n", "diameter_m"),
    ],
)
def test_telescope_file_that_cannot_be_used_is_named(tmp_path, text, message):
    path = tmp_path / "telescope.yaml"
    path.write_text(text)
    with pytest.raises(psfdae.Error, match=message):
        read_telescope(path)


# --- The climb


def test_score_and_information_of_poisson_counts():
    rng = np.random.default_rng(1)
    slopes, base = rng.normal(size=(1, 3, 40)), rng.uniform(50, 90, (1, 40))
    counts = rng.poisson(base).astype(float)
    counts[0, 3] = np.nan

    def deviance(t):
        return poisson_information(counts, base + t @ slopes[0], slopes)[0][0]

    _, score, information = poisson_information(counts, base, slopes)
    for axis, unit in enumerate(1e-3 * np.eye(3)):
        slope = -(deviance(unit) - deviance(-unit)) / 4e-3
        assert score[0, axis] == pytest.approx(slope, rel=1e-4, abs=1e-4)
    used = np.isfinite(counts[0])
    expected = (slopes[0][:, used] / base[0, used]) @ slopes[0][:, used].T
    assert information[0] == pytest.approx(expected)


def test_deviance_is_the_log_likelihood_that_is_missing():
    counts, mean = np.array([[3.0, 100.0, 7.0]]), np.array([[5.0, 90.0, 7.0]])
    deviance = poisson_information(counts, mean, np.empty((1, 0, 3)))[0]
    expected = 2 * (counts * np.log(counts / mean) - counts + mean).sum()
    assert deviance == pytest.approx(expected)


def test_slope_and_information_of_a_posterior_are_derivatives_of_its_height():
    """The likelihood is exp(−½ Σ aᵢ xᵢ²), the priors normal with σ = 1 and 2, and flat."""
    curvature, precision = np.array([3.0, 0.5, 2.0]), np.array([1.0, 0.25, 0.0])

    def evaluate(x):
        information = np.tile(np.diag(curvature), (len(x), 1, 1))
        likelihood = (curvature * x**2).sum(axis=1), -curvature * x, information
        return add_normal_prior(likelihood, x, precision)

    at = np.array([[0.3, -1.0, 2.0]])
    height, slope, information = evaluate(at)
    assert height == pytest.approx(-0.5 * ((curvature + precision) * at**2).sum())
    for axis, unit in enumerate(1e-4 * np.eye(3)):
        difference = evaluate(at + unit)[0] - evaluate(at - unit)[0]
        assert slope[0, axis] == pytest.approx(difference[0] / 2e-4, rel=1e-6)
        bend = evaluate(at + unit)[1] - evaluate(at - unit)[1]
        assert information[0, axis] == pytest.approx(-bend[0] / 2e-4, abs=1e-6)


def test_modes_a_standard_deviation_apart_are_different_maxima():
    """σ is 2 along the first parameter; the best mode of each maximum stands for the others."""
    position = np.array([[0.0, 0.0], [1.9, 0.0], [2.1, 0.0], [0.1, 0.0], [3.9, 0.0]])
    covariance = np.tile(np.diag([4.0, 1.0]), (5, 1, 1))
    evidence, group = np.array([5.0, 1.0, 4.0, 6.0, 3.0]), np.array([0, 0, 0, 1, 0])
    maximum = merge_modes(position, covariance, evidence, group)
    # The second is near two better modes and goes to the best; the fourth is of another group.
    assert maximum.tolist() == [0, 0, 2, 3, 2]
    gap = position[1:3][None] - position[0]
    assert compute_squared_distance(gap, covariance[:1])[0] == pytest.approx([0.9025, 1.1025])


def quadratic(centre, curvature):
    def evaluate(rows, at):
        gap = centre[rows] - at
        slope = gap @ curvature
        count = (len(rows), 1, 1)
        return -0.5 * (gap * slope).sum(axis=1), slope, np.tile(curvature, count)

    return evaluate


def test_climb_reaches_maxima_and_stays_within_its_limit():
    centre = np.array([[0.3, -2.0], [5.0, 1.0]])
    evaluate = quadratic(centre, np.array([[2.0, 0.3], [0.3, 1.0]]))
    peaks = climb(evaluate, np.zeros((2, 2)), np.inf, Steps())
    assert peaks.parameters == pytest.approx(centre, abs=1e-2)
    assert peaks.height == pytest.approx(0.0, abs=1e-2)
    assert peaks.has_converged.all()
    limited = climb(evaluate, np.zeros((2, 2)), 3.0, Steps(min_gain=1e-9))
    assert limited.parameters[0] == pytest.approx(centre[0], abs=1e-4)
    # At the limit the other parameter is at its own maximum: 1 + 0.3 (5 − 3).
    assert limited.parameters[1] == pytest.approx([3.0, 1.6], abs=1e-4)


def test_a_step_that_fails_is_shortened_at_once():
    """Undamped steps fail where the information is less than half of the curvature, here 2."""

    def evaluate(rows, x):
        return -(x[:, 0] ** 2), -2.0 * x, np.full((len(x), 1, 1), 0.9)

    steps = Steps(initial_damping=1e-6, max_steps=2)
    assert climb(evaluate, np.ones((1, 1)), 10.0, steps).height[0] > -0.6


# --- Draws


def test_chains_draw_from_a_normal_whose_mode_is_known_badly():
    covariance = np.array([[1.0, 0.6], [0.6, 2.0]])
    precision = np.linalg.inv(covariance)

    def height(owner, at):
        return -0.5 * np.einsum("ni,ij,nj->n", at - 3.0, precision, at - 3.0)

    def twin(owner, at):
        return at, np.full(len(at), -np.inf)

    modes = np.array([[2.5, 3.2]] * 20), np.array([0.8 * np.eye(2)] * 20), np.zeros(20)
    rngs = [np.random.default_rng(i) for i in range(20)]
    draws = sample_around(height, twin, np.arange(20), *modes, rngs).reshape(-1, 2)
    assert draws.mean(axis=0) == pytest.approx([3.0, 3.0], abs=0.1)
    assert np.cov(draws.T) == pytest.approx(covariance, abs=0.2)


def test_twins_are_drawn_by_their_probability():
    """A likelihood of |x| and a prior that prefers one sign by e to 1."""

    def height(owner, at):
        return -50.0 * (np.abs(at[:, 0]) - 1.0) ** 2 + 0.5 * at[:, 0]

    def twin(owner, at):
        return -at, -at[:, 0]

    modes = np.ones((8, 1)), np.full((8, 1, 1), 0.1), np.zeros(8)
    rngs = [np.random.default_rng(i) for i in range(8)]
    draws = sample_around(height, twin, np.arange(8), *modes, rngs)
    assert np.mean(draws > 0) == pytest.approx(np.e / (1 + np.e), abs=0.03)


@pytest.mark.parametrize(("offset", "exact_per_star"), [(0.7, 300), (4.0, 10200)])
def test_draws_are_of_the_posterior_whatever_the_approximation(offset, exact_per_star):
    """An approximation off by 0.7 σ is corrected by weights; one off by 4 σ is not followed."""
    evaluated = []

    def height(owner, at):
        evaluated.append(len(at))
        return -0.5 * ((at - 1.0) ** 2).sum(axis=1)

    def approximate(modes, offsets):
        return lambda mode, at: -0.5 * ((at - [offset, 0.0]) ** 2).sum(axis=1) + 7.0

    def twin(owner, at):
        return at, np.full(len(at), -np.inf)

    modes = np.ones((20, 2)), np.array([np.eye(2)] * 20), np.zeros(20)
    rngs = [np.random.default_rng(i) for i in range(20)]
    draws = sample_around(height, twin, np.arange(20), *modes, rngs, approximate).reshape(-1, 2)
    assert draws.mean(axis=0) == pytest.approx([1.0, 1.0], abs=0.07)
    assert np.cov(draws.T) == pytest.approx(np.eye(2), abs=0.12)
    assert sum(evaluated) / 20 == pytest.approx(exact_per_star, rel=0.1)


def test_shares_are_rounded_without_bias():
    weight = np.array([0.31, 0.0, 0.69])
    counts = [
        np.bincount(choose_evenly(weight, np.random.default_rng(i), 10), minlength=3)
        for i in range(400)
    ]
    assert np.mean(counts, axis=0) == pytest.approx([3.1, 0.0, 6.9], abs=0.06)
    assert np.unique([count[0] for count in counts]).tolist() == [3, 4]


def test_quadratic_images_give_the_posterior_of_counts_with_their_variance_at_the_mode():
    """A pixel without counts does not matter."""
    rng, sky, unit = np.random.default_rng(2), 50.0, 1000.0
    linear, square = rng.normal(0.0, 0.01, (2, 3, 20))
    mean = np.array([0.3, -0.2, 0.1, 1.1, 0.4])
    factor = np.tril(rng.uniform(0.2, 0.5, (5, 5)))
    precision = np.array([1.0, 1.0, 1.0, 0.0, 0.0])

    def image(shape):
        return 0.05 + shape @ linear + shape**2 @ square

    counts = rng.poisson(1.1 * unit * np.abs(image(mean[:3])) + sky).astype(float)
    counts[4] = np.nan
    design = draw_design(5, rng)[:, :3]
    images = image(mean[:3] + design @ factor[:3, :3].T)
    root = fit_root(design, images, counts, unit, sky, mean[3])
    posterior = QuadraticPosterior(mean[None], factor[None], precision, {0: root})
    offset = rng.standard_normal((40, 5))
    at = mean + offset @ factor.T
    expected = unit * at[:, 3:4] * image(at[:, :3]) + sky + sky**0.5 * at[:, 4:]
    variance = unit * mean[3] * image(mean[:3]) + sky
    chi2 = np.nansum((counts - expected) ** 2 / variance, axis=1)
    height = posterior(np.zeros(40, int), offset)
    assert height == pytest.approx(-0.5 * (chi2 + at**2 @ precision), rel=1e-4)


def test_climbs_that_meet_are_one():
    """Both sides of a maximum lead there; a second maximum, and another group, are kept."""
    centre = np.array([[0.0], [0.0], [9.0], [0.0]])
    starts, group = np.array([[-3.0], [2.0], [8.0], [1.0]]), np.array([0, 0, 0, 1])
    evaluate = quadratic(centre, np.array([[1.0]]))
    steps = Steps(initial_damping=0.5, min_distance=1.0, min_gain=1e-6)
    peaks = climb(evaluate, starts, np.inf, steps, group)
    assert np.isfinite(peaks.height).tolist() == [False, True, True, True]
    assert peaks.parameters[1:, 0] == pytest.approx([0.0, 9.0, 0.0], abs=0.02)


# --- Optics


def test_blurred_modal_stamps_are_blurred_stamps_and_their_slopes_are_differences():
    pupil, profile = annular_pupil(64, 0.3), Profile(3.0, 3.0)
    modes = partial(zernike_images, (2, 3, 4, 11))
    sampling = BlurredSampling(pupil, 12, 1.5, profile, "complex128")
    operator = ModalStamps(pupil, modes, sampling, 1.5)
    waves = np.array([[0.3, -0.2, 0.4, 0.25]])
    stamp, slopes = operator.derivatives(waves, np.eye(4)[None])
    opd = operator.opd(waves)
    assert stamp == pytest.approx(BlurredPropagator(pupil, 12, 1.5, profile)(opd), abs=1e-12)
    for j, unit in enumerate(1e-5 * np.eye(4)):
        ahead, behind = (operator.stamps(waves + sign * unit) for sign in (1, -1))
        assert slopes[0, j] == pytest.approx((ahead - behind)[0] / 2e-5, abs=1e-8)
    # Many directions are derived from products of polynomials, of which none has x³ here.
    by_product = operator.derivatives(waves, np.tile(np.eye(4), (1, 2, 1)))[1]
    assert by_product[:, :4] == pytest.approx(slopes, abs=1e-10)


@pytest.mark.parametrize("beta", [None, 2.5])
def test_broadened_stamps_are_derivatives_by_the_width(beta):
    pupil = annular_pupil(64, 0.3)
    opd = np.tile(0.2 * pupil.axis, (1, pupil.axis.size, 1))

    def stamp(profile):
        return BlurredPropagator(pupil, 12, 1.5, profile)(opd)[0]

    change = stamp(Profile(3.0 * 1.01, beta)) - stamp(Profile(3.0 / 1.01, beta))
    slope = stamp(Broadening(Profile(3.0, beta)))
    assert slope == pytest.approx(change / (2 * np.log(1.01)), abs=1e-3 * np.abs(slope).max())
    assert slope.min() < -0.1 * stamp(Profile(3.0, beta)).max()


@pytest.mark.parametrize("kind", ["zernike", "seidel", "newtonian"])
def test_even_part_has_no_sign(kind):
    telescope = example(kind)
    telescope = telescope.model_copy(update={"prior": Prior(waves=0.2)})
    rng = np.random.default_rng(3)
    optics = StarOptics(telescope, build_terms(telescope, field_of(telescope, 5, rng)), 16)
    star, z = np.arange(5), rng.standard_normal((5, optics.coefficient_count))
    place = np.zeros((5, 2))
    pair = (optics.coefficients(star, sign) for sign in (z, optics.twins(star, z)))
    images, twins = (
        optics.operator.stamps(optics.mode_coefficients(star, waves, place)) for waves in pair
    )
    assert twins == pytest.approx(images, abs=float(2e-6 * images.max()))
    assert optics.twins(star, optics.twins(star, z)) == pytest.approx(z)
    assert np.abs(optics.twins(star, z) - z).max() > 0.5


@pytest.mark.parametrize("kind", ["zernike", "ritchey_chretien"])
def test_coarse_pupils_err_far_below_the_noise(kind, monkeypatch):
    """A thousandth of the variance of a pixel of a star of S/N 200."""
    telescope, rng = example(kind), np.random.default_rng(12)
    angle = field_of(telescope, 10, rng)
    terms = build_terms(telescope, angle)
    truth = terms.mean + terms.sd * rng.standard_normal(terms.mean.shape)
    waves = np.einsum("mk,mkj->mj", truth, terms.to_modes)
    modes = np.concatenate([waves, rng.uniform(-0.5, 0.5, (10, 2))], axis=1)
    coarse = StarOptics(telescope, terms, 16).operator.stamps(modes)
    monkeypatch.setattr(engine, "PUPIL_SIZES", (318, 318))
    fine = StarOptics(telescope, terms, 16).operator.stamps(modes)
    error = ((coarse - fine) ** 2).mean(axis=(1, 2))
    assert (error > 0).all()
    assert (error < 1e-3 * (fine**2).sum(axis=(1, 2)) / 200.0**2).all()


# --- Single stars


def test_noise_free_stars_come_back():
    telescope, rng = three_terms(), np.random.default_rng(4)
    angle = field_of(telescope, 4, rng)
    terms = build_terms(telescope, angle)
    truth = terms.mean + 0.7 * terms.sd * rng.standard_normal(terms.mean.shape)
    place = rng.uniform(-0.5, 0.5, (4, 2))
    counts, flux = imaged(telescope, angle, truth, place, 2000.0)
    wavefronts = sensed(counts, telescope, angle)
    mean = wavefronts.summary["mean"][wavefronts.summary["probability"] > 0.5]
    error = np.sqrt(np.einsum("mkk->mk", wavefronts.summary["covariance"]))
    assert np.abs(mean - truth).max() < 6 * error.max()
    assert error.max() < 0.2 * terms.sd.min()
    measured = wavefronts.measured()
    assert measured["x"] == pytest.approx(7.5 + place[:, 0], abs=0.02)
    assert measured["y"] == pytest.approx(7.5 + place[:, 1], abs=0.02)
    assert measured["flux"] == pytest.approx(flux, rel=5e-3)
    assert measured["sky"] == pytest.approx(SKY, abs=5 * measured["sky_error"].max())
    assert wavefronts.explained.all()
    # Candidates of a search are draws from the prior, of mean 0 and variance 1.
    starts = wavefronts.search._match_candidates(0, 1, 400, 400)
    candidates = starts[:, : truth.shape[1]]
    assert len(candidates) == 400 and candidates.mean(axis=0) == pytest.approx(0.0, abs=0.2)
    assert candidates.std(axis=0) == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
def test_intervals_hold_as_many_stars_as_they_say(monkeypatch):
    telescope, rng = three_terms(), np.random.default_rng(5)
    angle = field_of(telescope, 20, rng)
    terms = build_terms(telescope, angle)
    truth = terms.mean + terms.sd * rng.standard_normal(terms.mean.shape)
    place = rng.uniform(-0.5, 0.5, (20, 2))
    counts, _ = imaged(telescope, angle, truth, place, 60.0, rng)
    wavefronts = sensed(counts, telescope, angle)
    for probability, lowest, highest in ((0.6827, 0.56, 0.80), (0.9545, 0.87, 0.995)):
        low, high = np.moveaxis(wavefronts.interval(probability), -1, 0)
        assert lowest < np.mean((truth >= low) & (truth <= high)) < highest
    centred, flux = imaged(telescope, angle, truth, np.zeros((20, 2)), 60.0)
    psf, error = wavefronts.psf_and_error()
    off = np.abs(psf - (centred - SKY) / flux[:, None, None])
    assert 0.56 < np.mean(off <= error) < 0.80
    assert np.mean(off <= 3 * error) > 0.95
    monkeypatch.setattr(engine.WavefrontSearch, "stars_at_once", 1)
    repeated = sensed(counts[:2], telescope, angle[:2])
    assert repeated.draws == pytest.approx(wavefronts.draws[:2], abs=1e-3)
    assert wavefronts.chi2.mean() == pytest.approx(0.97, abs=0.05)


def test_bad_stars_stop_nobody_and_are_kept_as_rows():
    telescope, rng = three_terms(), np.random.default_rng(8)
    angle = field_of(telescope, 6, rng)
    mean = build_terms(telescope, angle).mean
    counts, _ = imaged(telescope, angle, mean, np.zeros((6, 2)), 60.0, rng)
    counts[1] = np.nan
    counts[2, :3] = np.nan
    counts[3] = SKY  # no star at all
    counts[4] = rng.poisson(SKY, (16, 16))
    counts[4, :, 15] += 3000.0  # light of a star beside the stamp
    counts[5, 7:9, 7:9] += 50_000.0  # no image of this telescope
    counts[5, 3, 12] += 40_000.0
    wavefronts = sensed(counts, telescope, angle)
    assert wavefronts.star.tolist() == [0, 2, 3, 4, 5]
    assert wavefronts.explained[[0, 2]].all() and not wavefronts.explained[[1, 5]].any()
    assert wavefronts.chi2[-1] > 3.0
    assert np.isnan(wavefronts.psf()[1]).all() and np.isfinite(wavefronts.draws).all()
    # Values of smaller pixels are those of a whole pixel.
    assert wavefronts.psf(2)[0].mean() == pytest.approx(wavefronts.psf()[0].mean(), rel=0.02)
    assert np.isnan(wavefronts.table["z4"][wavefronts.table["id"] == 1]).all()
    with pytest.raises(SensingError, match="no star has enough"):
        sensed(counts[1:2], telescope, angle[1:2])


@pytest.mark.parametrize(
    ("stars", "options", "message"),
    [
        (np.ones((2, 16, 15)), {}, r"\(n, d, d\)"),
        (np.ones((2, 16, 16)), {"field_deg": np.zeros((3, 2))}, "field_deg"),
        (np.ones((2, 16, 16)), {"noise": -1.0}, "noise"),
    ],
)
def test_wrong_input_is_named(stars, options, message):
    with pytest.raises(SensingError, match=message):
        psfdae.wavefront(stars, example("zernike"), **{"field_deg": np.zeros((2, 2)), **options})


# --- The state of a telescope


@pytest.mark.parametrize(
    ("kind", "count"),
    [("zernike", 16), ("seidel", 10), pytest.param("ritchey_chretien", 20, marks=pytest.mark.slow)],
)
def test_state_of_the_telescope_is_found_with_its_errors(kind, count):
    telescope, rng = example(kind), np.random.default_rng(9)
    angle = field_of(telescope, count, rng)
    model = model_telescope(telescope, angle)
    truth = model.mean + model.sd * rng.standard_normal(model.sd.size)
    place = rng.uniform(-0.5, 0.5, (count, 2))
    counts, _ = imaged(telescope, angle, model.coefficients(truth), place, 60.0, rng)
    counts[0] = np.roll(counts[0], 5, axis=1) + counts[1] - SKY  # two stars in one stamp
    wavefronts = sensed(counts, telescope, angle, joint=True)
    state = wavefronts.joint
    pull = (state.value - truth) / state.error
    assert np.sqrt(np.mean(pull**2)) < 2.0
    assert np.abs(pull).max() > 0.05
    assert (state.error < 0.5 * model.sd).all()
    assert 0 not in state.star or state.disagrees[state.star == 0].all()
    assert np.mean(state.disagrees) < 0.1
    assert state.correlation == pytest.approx(state.correlation.T)


def test_the_posterior_of_a_telescope_is_likelihood_times_normal_prior():
    """Height, slope and information of the stars' counts, and of numbers N(0, 1) once for all."""
    telescope, rng = three_terms(), np.random.default_rng(6)
    angle = field_of(telescope, 3, rng)
    model = model_telescope(telescope, angle)
    counts, _ = imaged(
        telescope, angle, model.coefficients(model.mean), np.zeros((3, 2)), 60.0, rng
    )
    search = sensed(counts, telescope, angle).search
    posterior = TelescopePosterior(search, model, np.arange(3), search.optics)
    t = rng.standard_normal(posterior.number_count)
    values = np.append(t, np.tile([0.1, -0.2, 0.9, 0.0], 3))
    deviance, star_score, star_information = posterior.evaluate_stars(values)
    (height,), (score,), (information,) = posterior.evaluate(np.arange(1), values[None])
    assert height == pytest.approx(-0.5 * (deviance.sum() + t @ t), rel=1e-9)
    q = t.size
    assert score[:q] == pytest.approx(star_score[:, :q].sum(axis=0) - t, rel=1e-9)
    expected = star_information[:, :q, :q].sum(axis=0) + np.eye(q)
    assert information[:q, :q] == pytest.approx(expected, rel=1e-9)


def test_seeing_is_found_with_the_telescope():
    """Worse by 20 % than the file says; its error goes with that of the aberrations."""
    telescope, rng = three_terms(), np.random.default_rng(4)
    angle = field_of(telescope, 12, rng)

    def example_of(fwhm, prior):
        seeing = Seeing(kind="gaussian", fwhm_arcsec=fwhm)
        return telescope.model_copy(update={"seeing": seeing, "prior": Prior(seeing=prior)})

    stated, true_telescope = example_of(1.5, 0.15), example_of(1.8, 0.0)
    model = model_telescope(true_telescope, angle)
    truth = model.mean + model.sd * rng.standard_normal(model.sd.size)
    place = rng.uniform(-0.5, 0.5, (12, 2))
    counts, _ = imaged(true_telescope, angle, model.coefficients(truth), place, 100.0, rng)
    state = sensed(counts, stated, angle, joint=True).joint
    assert state.model.names[-1] == "seeing"
    assert abs(state.value[-1] - 1.8) < 3 * state.error[-1]
    assert 0.002 < state.error[-1] < 0.1
    pull = (state.value[:-1] - truth) / state.error[:-1]
    assert np.sqrt(np.mean(pull**2)) < 2.0
    assert np.abs(state.correlation[-1, :-1]).max() > 0.2


@pytest.mark.parametrize(
    ("kind", "names", "units"),
    [
        ("newtonian", ["defocus", "axis_x", "axis_y"], ["m", "deg", "deg"]),
        ("zernike", ["z4.constant", "z6.xx"], ["wave", "wave"]),
    ],
)
def test_numbers_of_a_telescope_have_names_and_units(kind, names, units):
    """Of its aberrations, and of the seeing where the prior leaves it free."""
    seeing = {"seeing": Seeing(kind="gaussian", fwhm_arcsec=1.5)}
    telescope = example(kind)
    prior = telescope.prior.model_copy(update={"seeing": 0.1})
    telescope = telescope.model_copy(update={**seeing, "prior": prior})
    model = model_telescope(telescope, np.zeros((2, 2)))
    unit_of = dict(zip(model.names, model.units, strict=True))
    assert [unit_of[name] for name in names] == units
    assert (model.names[-1], model.units[-1]) == ("seeing", "arcsec")
    assert (model.mean[-1], model.sd[-1]) == pytest.approx((1.5, 0.15))


def test_slopes_of_the_field_s_numbers_are_differences():
    telescope, angle = example("ritchey_chretien"), np.array([[0.1, -0.2], [0.0, 0.15]])
    model = model_telescope(telescope, angle)
    slopes = model.jacobian(model.mean)
    step = np.where(np.array(model.names) == "decentre_x", 1e-4, 0.0)
    change = model.coefficients(model.mean + step) - model.coefficients(model.mean)
    row = model.names.index("decentre_x")
    assert change == pytest.approx(1e-4 * slopes[row], abs=1e-2 * np.abs(change).max())


# --- The command


def test_command_finds_the_changed_coma(tmp_path):
    """The coma of an image is not that of the telescope's file."""
    words = ["telescope=example_zernike", "++telescope.aberrations.terms.z8.constant=0.1"]
    printed("simulate", *words, "--image-snr", 80, "--out", tmp_path, "grid.points=3")
    telescope = config_dir() / "telescope" / "example_zernike.yaml"
    words = ["--catalogue", tmp_path / "stars.csv", "--telescope", telescope, "--joint"]
    out = tmp_path / "wavefront.fits"
    output = printed("wavefront", tmp_path / "image.fits", *words, "--out", out)
    with fits.open(out) as file:
        state = file["JOINT"].data
        coma = state[state["name"] == "z8.constant"]
        assert coma["value"][0] == pytest.approx(0.1, abs=5 * coma["error"][0])
        # 0.005 waves of 16 stars; the error falls as the root of their number, here 9.
        assert coma["error"][0] < 0.005 * (16 / 9) ** 0.5
        rows = file["WAVEFRONT"].data
        assert len(file["COVAR"].data) == len(rows)
        listed = Table.read(tmp_path / "stars.csv")[rows["id"]]
        off = np.hypot(rows["x"] + 1 - listed["X_IMAGE"], rows["y"] + 1 - listed["Y_IMAGE"])
        # Near the axis the brightest pixel touches the chief ray with a corner; coma moves it off.
        assert off.min() == pytest.approx(0.5**0.5, abs=0.1)
        assert file["PSF"].data.shape == (9, 16, 16)
    assert "9 stars, 0 not explained" in output


def test_python_lines_of_the_page_run(monkeypatch, capsys):
    telescope, rng = example("zernike"), np.random.default_rng(10)
    angle = field_of(telescope, 7, rng)
    mean = build_terms(telescope, angle).mean
    counts, _ = imaged(telescope, angle, mean, np.zeros((7, 2)), 80.0, rng)
    (lines,) = blocks(read("docs/own_telescope.md"), "python")
    monkeypatch.chdir(config_dir().parent)
    exec(compile(lines, "page", "exec"), {"stamps": counts, "field_deg": angle})
    assert "z8.constant" in capsys.readouterr().out


def test_the_twin_of_a_telescope_has_its_even_coefficients_negated():
    """Each number is a coefficient, twice as large in the second star."""
    slopes = np.eye(3) * np.array([1.0, 2.0])[:, None, None]
    posterior = SimpleNamespace(
        search=SimpleNamespace(
            optics=SimpleNamespace(terms=SimpleNamespace(is_even=np.array([True, False, True])))
        ),
        coefficients=lambda t: np.einsum("nqk,q->nk", slopes, t),
        slopes=lambda t: slopes,
    )
    twin = twin_numbers(posterior, np.array([0.5, -1.0, 0.2]))
    assert twin == pytest.approx([-0.5, -1.0, -0.2])


def test_bad_pixels_are_not_in_the_noise_of_the_sky():
    counts = np.random.default_rng(1).normal(SKY, 5.0, (3, 16, 16))
    counts[0, :, 9:] = np.nan
    photons = Photons.from_stamps(build_stamps(counts, None, None))
    assert photons.sky_noise == pytest.approx(np.full(3, 5.0), rel=0.4)
    assert photons.sky_level == pytest.approx(np.full(3, SKY), abs=5.0)
    assert photons.pixels.tolist() == [16 * 9, 256, 256]


def test_the_map_shows_the_brightest_star_of_each_cell():
    """Stars without wavefront, or whose wavefront does not explain them, are left out."""
    wavefronts = SimpleNamespace(
        star=np.array([0, 1, 2, 4]),
        explained=np.array([True, True, True, True, False]),
        snr=np.array([10.0, 30.0, 5.0, 90.0, 80.0]),
        field_deg=np.array([[0.0, 0.0], [0.05, 0.0], [0.15, 0.0], [0.4, 0.0], [0.6, 0.0]]),
    )
    assert bright_separate_stars(wavefronts, 0.1).tolist() == [1, 2]
    assert bright_separate_stars(wavefronts, 0.04).tolist() == [1, 0, 2]
    assert bright_separate_stars(wavefronts, 0.0).tolist() == [1]
