"""The Gaussian mixture: its sums against dense matrices, its limits, and where stars are few."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from psfdae.denoise.bundle import BundleError
from psfdae.methods import mixing
from psfdae.methods.gmm import GaussianMixture, Gmm
from psfdae.methods.interface import Needs, TrainingSet
from psfdae.methods.mixture import fit as mixture_fit
from psfdae.methods.mixture.clusters import remove_slope
from psfdae.stars.noise import NoiseModel
from psfdae.training.packing import pack

NOISE = NoiseModel(kappa=5.0, background=1e4)
D = 6
LEVEL = 2e-3
BASIC = {
    **{"stars": None, "components": [1], "shrinkage": [20.0]},
    **{"principal": 8, "place": 1.0, "threads": 1},
}
CONFIG = {"noise": {"kappa": NOISE.kappa, "background_photons": NOISE.background}}


def stars(count, seed=1):
    """Gaussian stars of three kinds, of sum 1, and wider ones as references."""
    rng = np.random.default_rng(seed)
    axis = np.arange(D) - D / 2
    width = rng.choice([0.8, 1.2, 1.7], count) * rng.normal(1.0, 0.05, count)
    at = rng.normal(0.0, 0.4, (count, 2))

    def images(width):
        r2 = (axis - at[:, :1])[:, None] ** 2 + (axis - at[:, 1:])[:, :, None] ** 2
        light = np.exp(-0.5 * r2 / width[:, None, None] ** 2)
        return (light / light.sum(axis=(1, 2), keepdims=True)).astype(np.float32)

    return images(width), images(1.1 * width)


class PlacedGmm(GaussianMixture):
    needs = Needs(level=True, position=True)


def kind_places(count, seed=1):
    """Positions that have to do with the stars' kinds."""
    return stars(count, seed)[0][:, 3, 3:5] + np.random.default_rng(seed).normal(
        0, 0.01, (count, 2)
    )


def training(count=400, of_images=True, images=None):
    x, y = stars(count) if images is None else (images, images)
    part = np.arange(len(x))
    judge = part[::8] if len(x) > 8 else part[:0]
    return TrainingSet(
        images=x,
        references=x if of_images else y,
        fit=np.setdiff1d(part, judge),
        validation=judge,
        levels=np.array([LEVEL, 4 * LEVEL]),
        noise=NOISE,
        positions=kind_places(len(x)),
    )


@cache
def _fitted(clusters, of_images, kind):
    return kind.fit(training(400, of_images), Gmm(**{**BASIC, "components": [clusters]}))


def fitted(clusters=1, of_images=True, kind=GaussianMixture, **numbers):
    """A fit without what it remembers of other tests."""
    return replace(_fitted(clusters, of_images, kind), **numbers)


def noisy_of(images, level=LEVEL):
    return NOISE.draw(images, level, np.random.default_rng(3))


EXACT = {"noise_step": 1e-3, "flat_variance": 0.0, "least_variance": 0.0}
"""Numbers of a mixture that leaves out nothing because it hardly counts."""


@pytest.fixture
def exact(monkeypatch):
    """Sums over all clusters, however small their weight is."""
    monkeypatch.setattr(mixing, "LEAST_WEIGHT", 0.0)


def dense(mixture, noisy, level, position):
    """Posterior mean, standard deviation and evidence with whole covariance matrices.

    They are those of the joint vector of image, position and reference.
    """
    axes, pixels = mixture.axes.astype(float), D * D
    size = mixture.center.shape[1]
    place = position @ mixture.whitening if size else position[:, :0]
    z = np.hstack([noisy.reshape(len(noisy), -1), place])
    noise = np.zeros(z.shape[1])
    noise[:pixels] = (NOISE.kappa * level) ** 2 + 1.0 / pixels / NOISE.flux(level)
    p = mixture.deviation_center
    x = (mixture.deviation + p @ mixture.slope) @ axes.T
    y = mixture.deviation_reference + p @ mixture.slope_reference if len(mixture.cross) else x
    joint = np.hstack([x, p, y])
    pooled, nu = joint.T @ joint / len(joint), mixture.shrinkage[0]
    log, means, squares = [], [], []
    for k, last in enumerate(mixture.count.cumsum()):
        rows = joint[last - mixture.count[k] : last]
        covariance = (rows.T @ rows + nu * pooled) / (len(rows) + nu)
        image = mixture.mean[k] @ axes.T
        reference = mixture.mean_reference[k] if len(mixture.cross) else image
        star = [image - 1 / pixels, reference if len(mixture.cross) else image - 1 / pixels]
        flux_row = mixture.flux_sigma * np.concatenate([star[0], np.zeros(size), star[1]])
        covariance += np.outer(flux_row, flux_row)
        observables, hidden = slice(z.shape[1]), slice(z.shape[1], None)
        data_cov = covariance[observables, observables] + np.diag(noise)
        mean = np.concatenate([image, mixture.center[k]])
        law = multivariate_normal(mean, data_cov, allow_singular=True)
        log.append(law.logpdf(z) + np.log(mixture.count[k] / len(joint)))
        gain = np.linalg.solve(data_cov, covariance[observables, hidden]).T
        means.append(reference + (z - mean) @ gain.T)
        inside = np.diag(covariance[hidden, hidden] - gain @ covariance[observables, hidden])
        squares.append(means[-1] ** 2 + inside)
    peak = np.max(log, axis=0)
    weight = np.exp(log - peak)
    evidence = peak + np.log(weight.sum(axis=0)) + 0.5 * size * np.log(2 * np.pi)
    mean, square = (
        np.einsum("kn,knp->np", weight / weight.sum(axis=0), a) for a in (means, squares)
    )
    shaped = (a.reshape(noisy.shape) for a in (mean, np.sqrt(square - mean**2)))
    return *shaped, evidence


@pytest.mark.parametrize("of_images", [True, False])
@pytest.mark.parametrize("kind", [GaussianMixture, PlacedGmm])
@pytest.mark.parametrize("level", [1e-4, LEVEL, 0.05])
@pytest.mark.usefixtures("exact")
def test_sums_are_those_of_dense_matrices(of_images, kind, level):
    """Those of images of one noise, and those of images that say theirs one by one."""
    mixture, places = fitted(12, of_images, kind, **EXACT), kind_places(50, seed=2)
    noisy = noisy_of(stars(50, seed=2)[0], level)
    mean, sigma, evidence = dense(mixture, noisy, level, places)
    # σ² is a difference of squares; where each image has its own noise, in single precision.
    rounding = 2 * np.finfo(np.float32).eps * np.square(noisy).max()
    for levels in (level, np.full(len(noisy), level)):
        result = mixture.estimate(noisy, levels, places)
        np.testing.assert_allclose(result.psf, mean, atol=2e-4 * mean.max())
        np.testing.assert_allclose(result.sigma**2, sigma**2, rtol=0.01, atol=1e-7 + rounding)
        np.testing.assert_allclose(result.evidence, evidence, atol=0.05)


@pytest.mark.parametrize("of_images", [True, False])
@pytest.mark.usefixtures("exact")
def test_a_flux_that_is_an_estimate_is_found(of_images):
    mixture, rng, pixels = fitted(12, of_images, **EXACT), np.random.default_rng(3), D * D
    images, wide_psf = stars(300, seed=2)
    flux = rng.normal(1.0, 0.1, (300, 1, 1))
    noisy = NOISE.draw(images, LEVEL / 5, rng) + (flux - 1) * (images - 1 / pixels)
    noisy += ((1 - noisy.sum(axis=(1, 2))) / pixels)[:, None, None]
    loose = mixture.free_flux()
    result, mean = (
        loose.estimate(noisy, LEVEL / 5),
        dense(loose, noisy, LEVEL / 5, kind_places(300))[0],
    )
    sky = ((result.flux - 1) / pixels if of_images else 0 * result.flux)[:, None, None]
    np.testing.assert_allclose(result.psf, mean + sky, atol=2e-4 * mean.max())
    np.testing.assert_allclose(result.psf.sum(axis=(1, 2)), result.flux, atol=2e-3)
    assert np.std(result.flux - flux.ravel()) < 0.5 * np.std(flux)
    truth = images if of_images else wide_psf
    errors = [
        result.psf / result.flux[:, None, None],
        mixture.estimate(noisy, LEVEL / 5).psf,
    ] - truth
    assert np.square(errors[0]).mean() < 0.9 * np.square(errors[1]).mean()
    assert (
        loose.free_flux().flux_sigma == loose.flux_sigma
        and mixture.estimate(noisy, LEVEL / 5).flux is None
    )


def test_total_variance_is_that_of_the_stars_and_with_a_free_flux_of_no_less():
    """The rule leaves out coordinates in which noise hides all differences of the clusters."""
    mixture, (images, _) = fitted(4), stars(400)
    flux = np.random.default_rng(5).normal(1.0, mixing.FLUX_SIGMA, (400, 1))
    flat = images.reshape(400, -1)
    loose = flux * flat + (1 - flux) / flat.shape[1]
    plain, spread = ((a @ mixture.axes).astype(float).var(axis=0) for a in (flat, loose))
    assert mixture.total_variance == pytest.approx(plain, rel=1e-3, abs=1e-3 * plain.max())
    assert (mixture.free_flux().total_variance > 0.9 * spread - 1e-3 * plain.max()).all()
    assert (spread > 1.2 * plain).any()


def test_one_cluster_is_linear_mmse():
    data, mixture = training(of_images=False), fitted(of_images=False)
    x, y = (a.reshape(len(a), -1).astype(float) for a in (data.images, data.references))
    noisy = noisy_of(stars(20, seed=2)[0])
    s = NOISE.variance(np.full(20, 1.0 / D**2), LEVEL)[0]
    dx, dy = x - x.mean(axis=0), y - y.mean(axis=0)
    system = dx.T @ dx / len(x) + s * np.eye(D**2)
    residual = noisy.reshape(20, -1) - x.mean(axis=0)
    expected = y.mean(axis=0) + (dy.T @ dx / len(x) @ np.linalg.solve(system, residual.T)).T
    np.testing.assert_allclose(
        mixture.estimate(noisy, LEVEL).psf.reshape(20, -1), expected, atol=1e-5
    )


def test_levels_of_their_own_are_those_of_all():
    mixture = fitted(12)
    levels = np.repeat(np.geomspace(1e-3, 1e-2, 20), 5)
    noisy = noisy_of(stars(100, seed=2)[0], levels)
    single = np.concatenate(
        [mixture.estimate(z[None], v).psf for z, v in zip(noisy, levels, strict=True)]
    )
    error = np.square(mixture.estimate(noisy, levels).psf - single).mean()
    assert error < 4e-3 * np.square(single - stars(100, seed=2)[0]).mean()


def test_positions_have_unit_variance_within_clusters():
    p = fitted(4, kind=PlacedGmm).deviation_center
    assert p.T @ p / len(p) == pytest.approx(np.eye(2), abs=1e-5)


def test_rows_of_a_cluster_have_the_products_of_their_formulas():
    """Eq. 9: XᵀX − Xᵀp (pᵀp + ν)⁻¹ pᵀX without the slope; eq. 3: XᵀX − N, not negative."""
    rng, nu = np.random.default_rng(7), 3.0
    x, p = rng.normal(size=(9, 5)), rng.normal(size=(9, 2))
    inverse = np.linalg.inv(p.T @ p + nu * np.eye(2))
    rows, slope = remove_slope(x, p, inverse, nu)
    assert rows.T @ rows == pytest.approx(x.T @ x - x.T @ p @ inverse @ p.T @ x, abs=1e-4)
    assert slope == pytest.approx(inverse @ p.T @ x, abs=1e-5)
    small, large = (mixture_fit.rows_without_noise(x, noise * np.eye(5)) for noise in (1e-3, 1e3))
    assert small.T @ small == pytest.approx(x.T @ x - 1e-3 * np.eye(5))
    assert not large.any()
    # A direction in which positions do not vary becomes 0.
    line = np.outer(rng.normal(size=9), [3.0, 4.0])
    whitened = (line - line.mean(axis=0)) @ mixture_fit.whitening_matrix(line - line.mean(axis=0))
    assert np.sort(whitened.var(axis=0)) == pytest.approx([0.0, 1.0], abs=1e-6)


def test_validation_stars_choose_and_the_last_value_that_was_tried_is_named(capsys):
    settings = Gmm(**{**BASIC, "components": [1, 12], "shrinkage": [5.0, 1e6]})
    mixture = GaussianMixture.fit(training(), settings)
    assert len(mixture.count) == 12 and mixture.shrinkage == [5.0]
    assert mixture.count.sum() == 400
    assert "K = 12" in capsys.readouterr().out
    no_judge = GaussianMixture.fit(training().drop_validation(), settings)
    assert len(no_judge.count) == 12 and no_judge.count.sum() == 350


def test_a_search_goes_both_ways_and_more_clusters_must_pay():
    tries = []

    def climbed(errors, start, pays=0.0):
        tries.clear()
        return mixture_fit.climb([*errors], start, lambda k: tries.append(k) or errors[k], pays)

    falling = {1: 9.0, 4: 5.0, 16: 4.0, 64: 3.98, 256: 1.0}
    assert climbed(falling, 4, pays=0.02) == 16 and 256 not in tries and 1 not in tries
    assert climbed(falling, 4) == 256
    assert climbed({1: 3.99, 4: 4.0, 16: 4.1, 64: 1.0}, 4, pays=0.02) == 1 and 64 not in tries
    assert climbed({1: 2.0, 4: 2.0, 16: 2.0}, 4) == 4


@pytest.mark.parametrize("is_free", [False, True])
@pytest.mark.usefixtures("exact")
def test_outlier_score_of_one_cluster_is_the_square_of_mahalanobis_distance(is_free):
    mixture = fitted(of_images=False, outlier_coordinates=10, **EXACT)
    mixture = mixture.free_flux() if is_free else mixture
    noisy = noisy_of(stars(20, seed=2)[0])
    s = NOISE.variance(1.0 / D**2, LEVEL)
    residual = (noisy.reshape(20, -1) @ mixture.axes - mixture.mean[0])[:, :10].astype(float)
    row = mixture.flux_sigma * mixture.contrast[0, :10].astype(float)
    common = np.diag(mixture.total_variance[:10] + s)
    covariance = np.diag(mixture.variance[:10] + s) + np.outer(row, row)
    expected = np.einsum("ni,ij,nj->n", residual, np.linalg.inv(covariance), residual)
    expected += np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(common)[1]
    score = mixture.outlier_score(noisy, np.full(20, LEVEL))
    np.testing.assert_allclose(score, expected, rtol=2e-3, atol=0.05)


def test_noise_of_the_training_stars_is_no_part_of_the_prior():
    rng, images, sky = np.random.default_rng(4), stars(2000)[0], 0.01
    grainy = images + rng.normal(0, sky, images.shape).astype(np.float32)
    denoised = replace(
        training(images=grainy),
        own_noise=lambda star_numbers, mean: (star_numbers.size - 1) * sky**2 * np.eye(D * D),
    )
    settings = Gmm(**{**BASIC, "components": [8]})
    clean, raw, corrected = (
        GaussianMixture.fit(data, settings)
        for data in (training(images=images), training(images=grainy), denoised)
    )
    excess = [m.variance.sum() / clean.variance.sum() - 1 for m in (raw, corrected)]
    assert excess[0] > 0.1 and abs(excess[1]) < 0.2 * excess[0]
    truth = stars(400, seed=2)[0]
    errors = [
        np.square(m.estimate(noisy_of(truth), LEVEL).psf - truth).mean() for m in (raw, corrected)
    ]
    assert errors[1] < errors[0]


def test_it_is_stored_and_the_same_again(tmp_path):
    mixture, noisy = fitted(12, of_images=False), stars(5, seed=2)[0]
    mixture.save(tmp_path / "a.h5", CONFIG)
    stored = GaussianMixture.load(tmp_path / "a.h5")
    np.testing.assert_array_equal(
        stored.estimate(noisy, LEVEL).psf, mixture.estimate(noisy, LEVEL).psf
    )
    twice = _fitted.__wrapped__(12, False, GaussianMixture)
    for name in GaussianMixture.list_arrays():
        np.testing.assert_array_equal(getattr(twice, name), getattr(mixture, name))


def test_a_bundle_has_the_main_axes_of_each_cluster():
    mixture, (truth, _) = fitted(4), stars(200, seed=2)
    noisy = noisy_of(truth)

    def restored(arrays):
        return GaussianMixture.from_arrays(arrays, CONFIG, "realisation").estimate(noisy, LEVEL)

    arrays, _ = mixture.export(D, NOISE.kappa * LEVEL)
    assert arrays["rows"].sum() == len(arrays["deviation"]) < 400
    full, main = mixture.estimate(noisy, LEVEL), restored(arrays)
    assert np.square(main.psf - full.psf).mean() < 1e-4 * np.square(full.psf - truth).mean()
    np.testing.assert_allclose(main.sigma, full.sigma, rtol=0.01)
    np.testing.assert_allclose(main.evidence, full.evidence, atol=0.5)
    assert len(mixture.export(D, 0.1)[0]["deviation"]) < 0.6 * len(arrays["deviation"])
    size = sum(array.nbytes for array in arrays.values())
    unlimited = pack(mixture, D, NOISE.kappa * LEVEL, np.inf)[0]
    assert unlimited["rows"].tolist() == arrays["rows"].tolist()
    smaller = pack(mixture, D, NOISE.kappa * LEVEL, 0.8 * size)[0]
    assert 0.6 * size < sum(array.nbytes for array in smaller.values()) <= 0.8 * size
    errors = [np.square(e.psf - truth).mean() for e in (restored(smaller), full)]
    assert errors[0] < 1.1 * errors[1]
    with pytest.raises(BundleError, match=r"takes more than 0.001 MB"):
        pack(mixture, D, NOISE.kappa * LEVEL, 1e3)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("axes", lambda a: 1.1 * a),
        ("count", lambda a: a * (np.arange(a.size) > 0)),
        ("mean", lambda a: 2 * a),
    ],
)
def test_arrays_that_no_fit_leaves_are_named(name, change):
    arrays = fitted(4).export(D, NOISE.kappa * LEVEL)[0]

    def violated(arrays):
        laws = GaussianMixture.from_arrays(arrays, CONFIG, "realisation").conditions()
        return [law for law, _, is_fulfilled in laws if not np.all(is_fulfilled)]

    assert violated(arrays) == []
    assert violated(arrays | {name: change(arrays[name])})[0] == name


def test_the_position_is_used_where_it_tells_something():
    """Positions decide the kind of the star; or they are those of other stars."""
    data, settings = training(), Gmm(**{**BASIC, "components": [4, 12]})
    truth, place = stars(400, seed=2)[0], kind_places(400, seed=2)
    noisy = noisy_of(truth, 4 * LEVEL)
    with_place, unplaced = (kind.fit(data, settings) for kind in (PlacedGmm, GaussianMixture))
    errors = [
        np.square(m.estimate(noisy, 4 * LEVEL, place).psf - truth).mean()
        for m in (with_place, unplaced)
    ]
    assert errors[0] < 0.9 * errors[1]
    # Trained on one half of the field, it is wrong on the other.
    misled = data.positions.copy()
    misled[data.validation] = misled[data.validation[::-1]] * [-1.0, 3.0]
    misfit = PlacedGmm.fit(replace(data, positions=misled), settings)
    np.testing.assert_allclose(
        misfit.estimate(noisy, LEVEL, place).psf,
        misfit.estimate(noisy, LEVEL, -place).psf,
        atol=1e-7,
    )
