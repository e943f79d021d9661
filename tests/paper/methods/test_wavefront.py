"""The telescope's optics as an estimator: it reaches the local floor of a star's error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from psfdae.methods import method
from psfdae.methods.interface import TrainingSet
from psfdae.methods.metrics import mse
from psfdae.optics.wavefronts import monomial_coefficients
from psfdae.training.star_sets import noise_model
from psfdae_paper.bounds.estimates import build_stamp_model, simulate_fresh_stars
from psfdae_paper.bounds.floor import compute_local_error
from psfdae_paper.bounds.modes import select_largest
from psfdae_paper.configuration.compose import load
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.methods.wavefront import Wavefront
from psfdae_paper.stars.framing import crop_jittered, normalise_flux

LEVEL = 1e-3
NAMES = ("wavefront", "wavefront_position")
TEST = 24


@pytest.fixture(scope="module")
def stars():
    """Simulated stars, the last ones for tests: configuration, columns, images."""
    config = load(["dataset=dataset3", "preset=smoke"])
    columns = {
        name: c.values for name, c in simulate_fresh_stars(config, "trial", 120 + TEST).items()
    }
    margin = (columns["framed"].shape[-1] - config.framing.stamp_px) // 2
    cuts = crop_jittered(columns["framed"].astype(float), np.array([0, 0]), margin)
    return config, columns, normalise_flux(cuts)[0].astype(np.float32)


@pytest.fixture(scope="module")
def data(stars):
    config, columns, images = stars
    iy, ix = np.divmod(columns["field_index"], config.grid.points)
    number = np.arange(120)
    return TrainingSet(
        *(images, images, number[:100], number[100:], np.array([LEVEL]), noise_model(config)),
        positions=np.stack([ix, iy], axis=1),
        simulation={name: config.model_dump()[name] for name in SIMULATION},
    )


@pytest.fixture(scope="module")
def fitted(data):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Wavefront, "bank_stars", 1500)
        yield {name: method(name).fit(data) for name in NAMES}


@pytest.fixture(scope="module")
def noisy(stars):
    config, _, images = stars
    return noise_model(config).draw(images[-TEST:], LEVEL, np.random.default_rng(5))


@pytest.mark.parametrize("name", NAMES)
def test_errors_are_at_the_local_floor(stars, data, fitted, noisy, name):
    config, columns, images = stars
    model, field = build_stamp_model(config), columns["field_index"][-TEST:]
    _, slopes = model.derivatives(
        model.coefficients(model.standardise(columns["seidel"][-TEST:]), field),
        monomial_coefficients(np.eye(5), model.field[field][:, None]),
        columns["peak"][-TEST:],
    )
    variance = noise_model(config).variance(images[-TEST:].reshape(TEST, -1), LEVEL)
    floor = compute_local_error(slopes, model.sd, variance)
    psf = fitted[name].estimate(noisy, LEVEL, data.positions[-TEST:]).psf
    error = mse(psf, images[-TEST:])
    assert 0.4 < error.mean() / floor.mean() < 1.4
    mixture = fitted[name].mixture.estimate(noisy, LEVEL, data.positions[-TEST:]).psf
    assert np.median(error) < 0.3 * np.median(mse(mixture, images[-TEST:]))


def test_a_star_that_no_wavefront_explains_has_the_mixture_s_psf(data, fitted, noisy):
    images = noisy[:3].copy()
    images[1] = np.roll(images[1], 5, axis=0)
    for kind in fitted.values():
        position = data.positions[-TEST:][:3]
        psf = kind.estimate(images, LEVEL, position)
        # One image alone: others beside it would round it otherwise.
        mixture = kind.mixture.estimate(images[1:2], LEVEL, position[1:2]).psf[0]
        assert (psf.psf[1] == mixture).all()
        psfs = kind.mixture.estimate(images, LEVEL, position).psf
        assert np.abs(psf.psf[0] - psfs[0]).max() > 1e-5
        assert psf.is_explained.tolist() == [True, False, True]


def test_sigma_covers_the_errors(stars, data, fitted, noisy):
    """Two thirds of the pixels; those of a star err together, and there are few stars."""
    for kind in fitted.values():
        estimate = kind.estimate(noisy, LEVEL, data.positions[-TEST:])
        inside = np.abs(estimate.psf - stars[2][-TEST:]) <= estimate.sigma
        assert 0.5 < inside.mean() < 0.85


def test_one_posterior_serves_both_references(data, fitted, noisy):
    """The estimate of the template is the mean of static PSFs, each of which is possible."""
    kind = fitted["wavefront_position"]
    for_templates = replace(kind, data=replace(data, reference="template"))
    position = data.positions[-TEST:][:4]
    posterior = kind.posterior(noisy[:4], LEVEL, position)
    estimate = for_templates.estimate_from_posterior(*posterior, noisy[:4], LEVEL, position)
    field = (position @ [1, kind.bank.points]).astype(int)
    static = kind.static[field].astype(float)
    distance = np.abs(estimate.psf[:, None] - static).max(axis=(2, 3)).min(axis=1)
    assert (distance < 0.05 * static.max(axis=(1, 2, 3))).all()
    assert estimate.psf.sum(axis=(1, 2)) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_coefficients_come_with_their_covariance(stars, data, fitted, noisy, name):
    _, columns, _ = stars
    modes, missed = fitted[name].modes(noisy, LEVEL, data.positions[-TEST:])
    assert missed.size == 0
    truth = fitted[name].model.standardise(columns["seidel"][-TEST:])
    modes_of_field = modes.select(modes.field == columns["field_index"][-TEST:][modes.star])
    first = modes_of_field.select(select_largest(modes_of_field.star, modes_of_field.evidence, 1))
    assert len(first.star) > 0.8 * TEST
    pull = np.linalg.solve(first.factor, (first.z - truth[first.star])[:, :, None])
    assert 0.5 < np.median((pull**2).mean(axis=1)) < 2.0
