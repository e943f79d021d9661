"""The Gaussian mixture: its sums against dense matrices, its limits, and where stars are few."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from psfdae.estimators import FitError, TrainingSet
from psfdae.estimators import gmm as module
from psfdae.estimators.gmm import GaussianMixture, Gmm
from psfdae.stars.noise import NoiseModel

NOISE = NoiseModel(kappa=5.0, background=1e4)
D = 6
LEVEL = 2e-3
ONE = {"components": [1], "shrinkage": [20.0], "principal": 8, "place": 1.0, "threads": 1}


def stars(count, seed=1):
    """Gaussian stars of three kinds, of sum 1, and wider ones as references."""
    rng = np.random.default_rng(seed)
    axis = np.arange(D) - D / 2
    width = rng.choice([0.8, 1.2, 1.7], count) * rng.normal(1.0, 0.05, count)
    at = rng.normal(0.0, 0.4, (count, 2))

    def images(width):
        r2 = (axis - at[:, :1])[:, None] ** 2 + (axis - at[:, 1:])[:, :, None] ** 2
        made = np.exp(-0.5 * r2 / width[:, None, None] ** 2)
        return (made / made.sum(axis=(1, 2), keepdims=True)).astype(np.float32)

    return images(width), images(1.1 * width)


def training(count=400, same=True, images=None):
    x, y = stars(count) if images is None else (images, images)
    part = np.arange(len(x))
    judge = part[::8] if len(x) > 8 else part[:0]
    return TrainingSet(
        images=x,
        references=x if same else y,
        fit=np.setdiff1d(part, judge),
        validation=judge,
        levels=np.array([LEVEL, 4 * LEVEL]),
        noise=NOISE,
    )


def fitted(count=400, same=True, **changed):
    return GaussianMixture.fit(training(count, same), Gmm(**{**ONE, **changed}))


def dense(mixture, noisy, level):
    """Posterior mean and evidence with whole covariance matrices."""
    z = noisy.reshape(len(noisy), -1).astype(float)
    s = (NOISE.kappa * level) ** 2 + 1.0 / z.shape[1] / NOISE.flux(level)
    axes, log, estimates = mixture.axes.astype(float), [], []
    for k, count in enumerate(mixture.count):
        cluster = mixture._clusters[k]
        common, own = cluster.common, cluster.scale
        x, y = cluster.own @ axes.T, cluster.own_reference.astype(float)
        pooled = (axes * mixture.variance) @ axes.T
        y, cross = (y, mixture.cross @ axes.T) if len(mixture.cross) else (x, pooled)
        covariance = common * pooled + own * x.T @ x + s * np.eye(z.shape[1])
        mean = mixture.mean[k] @ axes.T
        log.append(
            multivariate_normal(mean, covariance).logpdf(z) + np.log(count / mixture.count.sum())
        )
        gain = np.linalg.solve(covariance, (z - mean).T)
        estimates.append(mixture.mean_reference[k] + ((common * cross + own * y.T @ x) @ gain).T)
    peak = np.max(log, axis=0)
    weight = np.exp(log - peak)
    mean = np.einsum("kn,knp->np", weight / weight.sum(axis=0), estimates)
    return mean.reshape(noisy.shape), peak + np.log(weight.sum(axis=0))


@pytest.mark.parametrize("same", [True, False])
@pytest.mark.parametrize("level", [1e-4, LEVEL, 0.05])
def test_sums_are_those_of_dense_matrices(same, level, monkeypatch):
    monkeypatch.setattr(module, "FLAT", 0.0)
    monkeypatch.setattr(module, "LEAST", 0.0)
    mixture = fitted(same=same, components=[12])
    noisy = NOISE.draw(stars(50, seed=2)[0], level, np.random.default_rng(3))
    mean, evidence = dense(mixture, noisy, level)
    found = mixture.estimate(noisy, level)
    np.testing.assert_allclose(found.psf, mean, atol=2e-4 * mean.max())
    np.testing.assert_allclose(found.evidence, evidence, atol=0.05)


@pytest.mark.parametrize("same", [True, False])
def test_a_flux_that_is_an_estimate_is_found(same, monkeypatch):
    monkeypatch.setattr(module, "FLAT", 0.0)
    monkeypatch.setattr(module, "LEAST", 0.0)
    mixture, rng, pixels = fitted(same=same, components=[12]), np.random.default_rng(3), D * D
    images, wider = stars(300, seed=2)
    flux = rng.normal(1.0, 0.1, (300, 1, 1))
    noisy = NOISE.draw(images, LEVEL / 5, rng) + (flux - 1) * (images - 1 / pixels)
    noisy += ((1 - noisy.sum(axis=(1, 2))) / pixels)[:, None, None]
    free = mixture.free_flux()
    found, mean = free.estimate(noisy, LEVEL / 5), dense(free, noisy, LEVEL / 5)[0]
    sky = ((found.flux - 1) / pixels if same else 0 * found.flux)[:, None, None]
    np.testing.assert_allclose(found.psf, mean + sky, atol=2e-4 * mean.max())
    np.testing.assert_allclose(found.psf.sum(axis=(1, 2)), found.flux, atol=2e-3)
    assert np.std(found.flux - flux.ravel()) < 0.5 * np.std(flux)
    truth = images if same else wider
    errors = [found.psf / found.flux[:, None, None], mixture.predict(noisy, LEVEL / 5)] - truth
    assert np.square(errors[0]).mean() < 0.9 * np.square(errors[1]).mean()
    assert free.free_flux().loose == free.loose and mixture.estimate(noisy, LEVEL / 5).flux is None


def test_one_cluster_is_linear_mmse():
    data = training(same=False)
    mixture = GaussianMixture.fit(data, Gmm(**ONE))
    x, y = (a.reshape(len(a), -1).astype(float) for a in (data.images, data.references))
    noisy = NOISE.draw(stars(20, seed=2)[0], LEVEL, np.random.default_rng(3))
    s = NOISE.variance(np.full(20, 1.0 / D**2), LEVEL)[0]
    dx, dy = x - x.mean(axis=0), y - y.mean(axis=0)
    system = dx.T @ dx / len(x) + s * np.eye(D**2)
    residual = noisy.reshape(20, -1) - x.mean(axis=0)
    wanted = y.mean(axis=0) + (dy.T @ dx / len(x) @ np.linalg.solve(system, residual.T)).T
    np.testing.assert_allclose(mixture.predict(noisy, LEVEL).reshape(20, -1), wanted, atol=1e-5)


def test_without_noise_it_gives_the_image_and_in_noise_the_mean():
    mixture, images = fitted(components=[12]), stars(20, seed=2)[0]
    np.testing.assert_allclose(mixture.predict(images, 1e-9), images, atol=3e-6)
    weight = mixture.count / mixture.count.sum()
    mean = np.einsum("k,kp->p", weight, mixture.mean_reference)
    lost = mixture.predict(images, 1e4).reshape(20, -1)
    np.testing.assert_allclose(lost, np.broadcast_to(mean, lost.shape), atol=1e-6)


def test_levels_of_their_own_are_those_of_all():
    mixture = fitted(components=[12])
    levels = np.repeat(np.geomspace(1e-3, 1e-2, 20), 5)
    noisy = NOISE.draw(stars(100, seed=2)[0], levels, np.random.default_rng(3))
    each = np.concatenate([mixture.predict(z[None], v) for z, v in zip(noisy, levels, strict=True)])
    error = np.square(mixture.predict(noisy, levels) - each).mean()
    assert error < 1e-3 * np.square(each - stars(100, seed=2)[0]).mean()


def test_the_nearest_clusters_are_enough(monkeypatch):
    mixture = fitted(components=[40])
    truth = stars(200, seed=2)[0]
    noisy = NOISE.draw(truth, LEVEL, np.random.default_rng(3))
    every = np.square(mixture.predict(noisy, LEVEL) - truth).mean()
    monkeypatch.setattr(module, "NEAREST", 10)
    assert np.square(mixture.predict(noisy, LEVEL) - truth).mean() < 1.02 * every


def test_it_beats_one_cluster_and_its_input_on_stars_of_several_kinds():
    truth = stars(400, seed=2)[0]
    noisy = NOISE.draw(truth, LEVEL, np.random.default_rng(3))
    errors = [
        np.square(fitted(components=[k], shrinkage=[5.0]).predict(noisy, LEVEL) - truth).mean()
        for k in (1, 12)
    ]
    assert errors[1] < 0.9 * errors[0] < 0.9 * np.square(noisy - truth).mean()


def test_validation_stars_choose():
    wanted = fitted(components=[1, 12], shrinkage=[5.0, 1e6])
    assert len(wanted.count) == 12 and wanted.shrinkage == [5.0]
    assert wanted.count.sum() == 400
    other = GaussianMixture.fit(
        training().without_validation(), Gmm(**{**ONE, "components": [1, 12]})
    )
    assert len(other.count) == 12 and other.count.sum() == 350


def test_few_and_equal_stars():
    noisy = NOISE.draw(stars(5, seed=2)[0], LEVEL, np.random.default_rng(3))
    one = GaussianMixture.fit(training(images=stars(1)[0]), Gmm(**ONE))
    np.testing.assert_allclose(
        one.predict(noisy, LEVEL), np.repeat(stars(1)[0], 5, axis=0), atol=1e-6
    )
    equal = training(images=np.repeat(stars(1)[0], 30, axis=0))
    found = GaussianMixture.fit(equal, Gmm(**{**ONE, "components": [1, 4]}))
    np.testing.assert_allclose(
        found.predict(noisy, LEVEL), np.repeat(stars(1)[0], 5, axis=0), atol=1e-6
    )
    lonely = np.concatenate([stars(30)[0], np.eye(D * D, dtype=np.float32)[:1].reshape(1, D, D)])
    apart = GaussianMixture.fit(training(images=lonely), Gmm(**{**ONE, "components": [2]}))
    assert 1 in apart.count and np.isfinite(apart.predict(noisy, LEVEL)).all()
    with pytest.raises(FitError, match=r"gmm\.components = \[500\]: must be at most 30"):
        GaussianMixture.fit(training(30), Gmm(**{**ONE, "components": [500]}))


@pytest.mark.parametrize("free", [False, True])
def test_strangeness_of_one_cluster_is_the_square_of_mahalanobis_distance(free, monkeypatch):
    monkeypatch.setattr(module, "FLAT", 0.0)
    monkeypatch.setattr(module, "TELLING", 10)
    mixture = fitted(same=False)
    mixture = mixture.free_flux() if free else mixture
    noisy = NOISE.draw(stars(20, seed=2)[0], LEVEL, np.random.default_rng(3))
    s = np.exp(np.rint(np.log(NOISE.variance(1.0 / D**2, LEVEL)) / module.STEP) * module.STEP)
    residual = (noisy.reshape(20, -1) @ mixture.axes - mixture.mean[0])[:, :10].astype(float)
    row = mixture.loose * mixture._contrast[0, :10].astype(float)
    usual = np.diag(mixture._total[:10] + s)
    covariance = np.diag(mixture.variance[:10] + s) + np.outer(row, row)
    wanted = np.einsum("ni,ij,nj->n", residual, np.linalg.inv(covariance), residual)
    wanted += np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(usual)[1]
    found = mixture.strangeness(noisy, np.full(20, LEVEL))
    np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=0.05)


@pytest.mark.parametrize("clusters", [1, 8])
def test_noise_of_the_training_stars_is_no_part_of_the_prior(clusters):
    rng, images = np.random.default_rng(4), stars(3000)[0]
    sky = 0.01
    own = images + rng.normal(0, sky, images.shape).astype(np.float32)
    chosen = Gmm(**{**ONE, "components": [clusters]})
    clean, raw = (GaussianMixture.fit(training(images=x), chosen) for x in (images, own))

    def covariance(which, mean):
        return (which.size - 1) * sky**2 * np.eye(mean.size)

    data = replace(training(images=own), own_noise=covariance)
    less = GaussianMixture.fit(data, chosen)
    excess = [m.variance.sum() / clean.variance.sum() - 1 for m in (raw, less)]
    assert excess[0] > 0.1 and abs(excess[1]) < 0.2 * excess[0]
    truth = stars(400, seed=2)[0]
    noisy = NOISE.draw(truth, LEVEL, np.random.default_rng(3))
    errors = [np.square(m.predict(noisy, LEVEL) - truth).mean() for m in (raw, less)]
    assert errors[1] < errors[0]


def test_an_image_that_is_not_finite_is_refused():
    noisy = stars(3)[0]
    noisy[1, 2, 3] = np.nan
    with pytest.raises(ValueError, match="must be finite"):
        fitted().predict(noisy, LEVEL)


def test_it_is_stored_and_the_same_again(tmp_path):
    mixture, noisy = fitted(same=False, components=[12]), stars(5, seed=2)[0]
    mixture.save(tmp_path / "a.h5", {"noise": {"kappa": 5.0, "background_photons": 1e4}})
    again = GaussianMixture.load(tmp_path / "a.h5")
    np.testing.assert_array_equal(again.predict(noisy, LEVEL), mixture.predict(noisy, LEVEL))
    twice = fitted(same=False, components=[12])
    assert all(
        np.array_equal(getattr(twice, n), getattr(mixture, n)) for n in GaussianMixture.arrays
    )
    assert replace(mixture, shrinkage=np.array([1.0])).shrinkage == [1.0]
