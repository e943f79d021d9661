"""The mixture over sub-pixel centres about a model of the field, on stars of a known field."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import photutils
import pytest
from astropy.io import fits
from astropy.nddata import NDData
from astropy.table import Table
from numpy.testing import assert_allclose
from packaging.version import Version
from photutils.psf import GriddedPSFModel, PSFPhotometry

from command_line import printed, psfdae, refused
from image_training import few_draws
from psfdae import load_model
from psfdae.denoise.bundle import read_bundle, write_bundle
from psfdae.denoise.star_model import StarModel
from psfdae.image.selection import Candidates, Verdict
from psfdae.methods.field import FieldMixture, select_fit_stars
from psfdae.methods.field.fit import FieldFitter, FitOptions
from psfdae.methods.field.nodes import node_step
from psfdae.methods.field.pairs import FieldStamps
from psfdae.methods.field.posterior import log_node_prior, match_flux
from psfdae.methods.field.prior import FieldPrior, PosteriorLimits
from psfdae.methods.field.residuals import find_components
from psfdae.methods.field.search import fit_field
from psfdae.methods.interface import TrainingSet
from psfdae.psf.interface import PredictionError
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.moments import measure_shapes
from psfdae.stars.noise import NoiseModel
from psfdae.training.star_residuals import reject_misfits
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.stars.example import add_stamps, write_field

SIDE, FRAME, FIELD = 10, 26, 1000.0
SNR = (5.0, 10.0, 20.0, 50.0)


def truth(position, centre, side, spread=0.0, seed=0):
    """PSFs of a field whose width and ellipticity change with the place, pixels integrated.

    Two Gaussians; `spread` is the RMS of what the width of a star has of its own.
    """
    from scipy.special import erf

    u = 2 * np.asarray(position) / FIELD - 1
    scale = 1 + spread * np.random.default_rng(seed).standard_normal(len(u))
    width = (1.05 + 0.12 * u[:, 0] + 0.08 * u[:, 1] ** 2) * scale
    edges = np.arange(side + 1) - side // 2 - 0.5
    images = 0.0
    for part, size in ((0.8, 1.0), (0.2, 1.9)):
        axes = []
        for axis, stretch in ((0, 1 + 0.1 * u[:, 1]), (1, 1 - 0.1 * u[:, 1])):
            sigma = (width * stretch * size)[:, None]
            axes.append(np.diff(erf((edges - centre[:, axis, None]) / (np.sqrt(2) * sigma))) / 2)
        images = images + part * axes[0][:, :, None] * axes[1][:, None, :]
    return images


def unit(images):
    return images / images.sum(axis=(1, 2), keepdims=True)


def bright(count=150, seed=1, spread=0.02, varied=True):
    """Bright stars with their margin, framed by their brightest pixel."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(0, FIELD, (count, 2))
    centre = rng.uniform(-0.5, 0.5, (count, 2))
    place = position if varied else np.full((count, 2), FIELD / 2)
    images = truth(place, centre, FRAME, spread, seed)
    noise = 10 ** rng.uniform(-3.5, -3, count)
    images = images + noise[:, None, None] * rng.standard_normal(images.shape)
    flux = images[:, 8:18, 8:18].sum(axis=(1, 2))
    images, noise = images / flux[:, None, None], noise / flux
    peak = np.zeros((count, 2), int)
    listed = centre + 0.1 + 0.05 * rng.standard_normal((count, 2))
    measurements = {"peak": peak, "listed": listed, "position": position, "noise": noise}
    columns = {"centre": listed, "snr": 1 / noise, "row": np.arange(count)}
    columns["colour"] = np.full(count, np.nan)
    return BrightStars(stamps=images, flux=np.ones(count), **measurements, **columns)


def gridded(path):
    """Model of photutils from a grid's file, of any release: `GriddedPSFModel.read` takes 3.1."""
    cube, header = fits.getdata(path, header=True)
    yx = [header[f"DET_YX{k}"].strip("()").split(",") for k in range(len(cube))]
    xy = [(float(x), float(y)) for y, x in yx]
    meta = {"grid_xypos": xy, "oversampling": header["OVERSAMP"]}
    return GriddedPSFModel(NDData(cube, meta=meta))


def fitted(stars, orders=(2,), **changed):
    images = stars.stamps[:, 8:18, 8:18].astype(np.float32)
    number = np.arange(len(images))
    noise = NoiseModel(1.0, 1e6)
    star_facts = {"bright": stars, "star": number}
    data = TrainingSet(images, images, number, number[:0], np.array([0.01]), noise, **star_facts)
    config = load_stage(("field",), [])
    settings = config.field.model_copy(update={"orders": list(orders), **changed})
    return FieldMixture.fit(data, field=settings)


@pytest.fixture(scope="module")
def stars():
    return bright()


@pytest.fixture(scope="module")
def field(stars):
    return fitted(stars)


@pytest.fixture(scope="module")
def cv_field(stars):
    """Order and smoothness are those of stars left out, as for a user's image."""
    return fitted(stars, (0, 1, 2))


class Faint:
    """Stars of flux 1000 on a sky of 3, their frames moved by up to a pixel."""

    def __init__(self, count, snr, seed=7):
        rng = np.random.default_rng((seed, int(snr)))
        self.position = rng.uniform(0, FIELD, (count, 2))
        self.centre = rng.uniform(-0.5, 0.5, (count, 2)) + rng.integers(-1, 2, (count, 2))
        self.psf = unit(truth(self.position, self.centre, SIDE, 0.02, seed + 1))
        area = 1 / np.square(self.psf).sum(axis=(1, 2)).mean()
        self.sigma = np.full(count, 1000 / (snr * np.sqrt(area)))
        self.noise = self.sigma[:, None, None] * rng.standard_normal(self.psf.shape)
        self.stamps = 1000 * self.psf + 3 + self.noise

    def measured(self, field, **stated):
        return field.measure(self.stamps, self.sigma, self.position, **stated)

    def mse(self, estimate):
        return float(np.square(estimate.psf - self.psf).mean())


def size(images):
    """Width of stars by adaptive moments."""
    return measure_shapes(images.astype(np.float32)).fwhm_px


@pytest.mark.parametrize("snr", SNR)
def test_flux_sky_centre_and_size_are_unbiased_and_as_sure_as_said(field, snr):
    faint = Faint(1000, snr)
    result = faint.measured(field)
    measured = result.measurements
    error = np.sqrt(np.einsum("nii->ni", measured.covariance))
    off = np.stack(
        [measured.flux - 1000, measured.background - 3, *(measured.centre.T - faint.centre.T)], 1
    )
    # The centres are those of the list of the training stars, which are 0.1 px off.
    off[:, 2:] -= 0.1
    sure = 3 * off.std(axis=0) / np.sqrt(len(off))
    assert abs(off[:, 0].mean()) < (30 if snr == 5 else 10) + sure[0]
    assert abs(off[:, 1].mean()) < 0.1 + sure[1]
    assert (np.abs(off[:, 2:].mean(axis=0)) < 0.02 + sure[2:]).all()
    # A centre in a wrong node is rare, and not normal.
    pull = np.quantile(np.abs(off / error), 0.68, axis=0)
    assert ((pull > 0.85) & (pull < 1.2)).all(), pull
    if snr > 5:
        ratio = size(result.psf) / size(faint.psf) - 1
        assert abs(np.median(ratio)) < 0.02 + 3 * 1.25 * ratio.std() / np.sqrt(len(ratio))
    star = result.psf * measured.flux[:, None, None] / 1000
    inside = (np.abs(star - faint.psf) <= result.sigma).mean()
    assert 0.62 < inside < 0.87  # of a wing, few large errors make the variance
    assert np.square(star - faint.psf).mean() == pytest.approx(
        np.square(result.sigma, dtype=float).mean(), rel=0.2
    )
    flux_and_sky = measured.covariance[:, 0, 1] / (error[:, 0] * error[:, 1])
    assert np.corrcoef(off[:, 0], off[:, 1])[0, 1] == pytest.approx(flux_and_sky.mean(), abs=0.12)


def test_the_form_of_free_flux_measures_what_the_other_form_knows(field):
    """Flux and sky of images at high S/N; without it, images have flux 1 and no sky."""
    faint, scale = Faint(50, 50.0), np.random.default_rng(2).uniform(0.7, 1.4, 50)
    images = scale[:, None, None] * faint.psf + 0.01
    free = field.free_flux().estimate(images, 1e-4, faint.position).measurements
    assert free.flux == pytest.approx(scale, rel=0.05)
    assert free.background == pytest.approx(0.01, abs=1e-3)
    known = field.estimate(faint.psf, 1e-4, faint.position).measurements
    assert known.flux == pytest.approx(1.0, abs=0.003)
    assert known.background == pytest.approx(0.0, abs=1e-4)


def test_known_place_is_better_than_a_list_and_a_list_better_than_nothing(field):
    faint = Faint(400, 5.0)
    rng = np.random.default_rng(3)
    listed = faint.centre + 0.1 + 0.05 * rng.standard_normal(faint.centre.shape)
    exact = faint.mse(faint.measured(field, centre=faint.centre + 0.1, fixed=True))
    with_list = faint.mse(faint.measured(field, centre=listed))
    assert exact < with_list < 0.7 * faint.mse(faint.measured(field))
    # A list that is wrong by a pixel does not spoil the brighter stars.
    bright_ones = Faint(200, 20.0)
    with_wrong_list = bright_ones.measured(field, centre=bright_ones.centre + 1.0)
    assert bright_ones.mse(with_wrong_list) < 1.2 * bright_ones.mse(bright_ones.measured(field))


def test_a_star_without_a_position_is_that_of_the_mean_field(field):
    """Noise hides it: what is left is the mean over the field, not the PSF of some corner."""
    faint, all_over = Faint(10, 5.0), np.random.default_rng(4).uniform(0, FIELD, (500, 2))
    position = faint.position.copy()
    position[::2] = np.nan
    stated = {"centre": faint.centre + 0.1, "fixed": True, "flux": np.full(10, 1e3)}
    result = field.measure(faint.stamps, np.full(10, 1e5), position, **stated)
    for star, centre in enumerate(faint.centre):
        positions = all_over if star % 2 == 0 else faint.position[star : star + 1]
        terms = field.model.terms(positions)
        mean = unit(field.model.images(terms, np.tile(centre, (len(positions), 1)), SIDE)).mean(
            axis=0
        )
        assert result.psf[star] == pytest.approx(mean, abs=0.02 * mean.max())
    no_place = field.measure(faint.stamps, np.full(10, 1e5), None, **stated)
    assert no_place.psf[::2] == pytest.approx(result.psf[::2], abs=1e-7)
    assert (no_place.sigma[1::2] > result.sigma[1::2]).mean() > 0.8


def test_without_noise_the_data_come_back_and_without_data_the_field(field):
    faint = Faint(20, 1e5)
    result = faint.measured(field, flux=np.full(20, 1e3), sky=np.full(20, 3.0))
    assert result.psf == pytest.approx(faint.psf, abs=2e-4 * faint.psf.max())
    hopeless = field.measure(
        faint.stamps,
        1e5 * np.ones(20),
        faint.position,
        faint.centre + 0.1,
        True,
        flux=np.full(20, 1e3),
    )
    expected = field.model.images(field.model.terms(faint.position), faint.centre, SIDE)
    assert hopeless.psf == pytest.approx(unit(expected), abs=0.01 * faint.psf.max())
    assert (hopeless.sigma > result.sigma).all()


@pytest.mark.parametrize("snr", [5.0, 50.0])
def test_outlier_score_has_the_law_of_chi2_and_tells_blends(cv_field, snr):
    field = cv_field
    faint = Faint(400, snr)
    with_place, no_place = faint.measured(field), field.measure(faint.stamps, faint.sigma)
    axes = PosteriorLimits.outlier_axes
    for result in (with_place, no_place):
        assert np.median(result.outlier_score) == pytest.approx(axes, rel=0.25)
        assert (result.outlier_score < axes + 8 * np.sqrt(2 * axes)).mean() > 0.98
    blend = 0.8 * faint.psf + 0.2 * np.roll(faint.psf, 3, axis=2)
    blended = field.measure(1000 * (blend + faint.noise / 1000), faint.sigma, faint.position)
    if snr == 50:
        assert np.median(blended.outlier_score) > np.quantile(with_place.outlier_score, 0.99)


def test_flux_and_sky_that_are_known_are_taken(field):
    faint = Faint(300, 20.0)
    result = faint.measured(field, flux=np.full(300, 1000.0), sky=np.full(300, 3.0))
    assert faint.mse(result) < faint.mse(faint.measured(field))
    assert result.measurements.flux == pytest.approx(1000, rel=0.02)
    assert result.measurements.background == pytest.approx(3.0)
    assert (result.measurements.covariance[:, 1, 1] == 0).all()
    # A method of flux 1 is that, and the same as other methods see it.
    restored = field.estimate((faint.stamps - 3) / 1000, faint.sigma / 1000, faint.position).psf
    assert restored == pytest.approx(result.psf, abs=2e-3)


def test_stars_are_restored_in_groups_that_do_not_matter(field):
    groups = [Faint(40, snr) for snr in (5.0, 50.0, 500.0, 5000.0)]
    inputs = [np.concatenate([getattr(stars, n) for stars in groups]) for n in ("stamps", "sigma")]
    joint = field.measure(*inputs)
    batched = replace(field, limits=PosteriorLimits(stars_at_once=13)).measure(*inputs)
    assert batched.psf == pytest.approx(joint.psf, abs=1e-7)
    assert batched.measurements.flux == pytest.approx(joint.measurements.flux, rel=1e-9)


@pytest.mark.parametrize("snr", [5.0, 100.0])
def test_nodes_that_the_matched_filter_leaves_out_do_not_matter(field, snr):
    faint = Faint(40, snr)
    result = faint.measured(field)
    limits = PosteriorLimits(min_nodes=round(PosteriorLimits.max_node_area_px2 * 16))
    every = faint.measured(replace(field, limits=limits))
    assert np.abs(result.psf - every.psf).max() < 0.01 * every.sigma.max()
    assert result.measurements.flux == pytest.approx(every.measurements.flux, rel=1e-3)
    assert result.evidence == pytest.approx(every.evidence, abs=2e-3)


def test_bright_stars_are_fitted_in_the_nodes_about_their_centre(field):
    """However bright a star of unknown flux is: in few nodes, all of them near its centre."""
    faint = Faint(20, 5000.0)
    images = faint.stamps.reshape(20, -1) - 3.0
    unknown = np.full(20, np.nan)
    columns = {
        "noise": faint.sigma,
        "flux": unknown,
        "unit": np.ones(20),
        "terms": np.ones((20, 1)),
    }
    stars = FieldStamps(
        images=images,
        log_prior=log_node_prior(field, np.full((20, 2), np.nan)),
        sky_known=np.zeros(20, bool),
        unit_per_electron=np.zeros(20),
        cell_sigma_px=np.full(20, field.cell_sigma_px),
        **columns,
    )
    is_nearby = match_flux(field, stars)[1]
    assert (is_nearby.sum(axis=1) <= 12).all()
    offset_px = np.abs(field.places - faint.centre[:, None] - 0.1).max(axis=2)
    assert offset_px[is_nearby].max() < 3 * field.step_px


@pytest.mark.parametrize("snr", [5.0, 100.0])
def test_a_star_of_known_centre_is_the_posterior_mean_of_its_normal_law(field, snr):
    """x − s (C + s)⁻¹ (x − m), with C as a whole, for flux, sky and centre that are known."""
    field, faint = replace(field, limits=PosteriorLimits(min_axes=SIDE**2)), Faint(30, snr)
    flux, sky = np.full(30, 1000.0), np.full(30, 3.0)
    result = faint.measured(field, centre=faint.centre, fixed=True, flux=flux, sky=sky)
    at = faint.centre + field.list_error[0]
    nearest = np.square(field.places - at[:, None]).sum(axis=-1).argmin(axis=1)
    means = field.model.images(field.model.terms(faint.position), at, SIDE).reshape(30, -1)
    s = (faint.sigma[0] / 1000) ** 2
    for k, mean, stamp, psf, sigma in zip(
        nearest, means, faint.stamps, result.psf, result.sigma, strict=True
    ):
        node, star = field.nodes[k], (stamp.ravel() - 3) / 1000
        inverse = np.linalg.inv(
            node.residual_modes.T @ node.residual_modes + np.diag(node.diagonal + s)
        )
        restored = star - s * inverse @ (star - mean / mean.sum() - node.images[-1])
        assert psf.ravel() == pytest.approx(restored / restored.sum(), abs=1e-6)
        variance = s - s**2 * inverse.diagonal()
        assert np.square(sigma).sum() == pytest.approx(
            variance.sum() / restored.sum() ** 2, rel=0.05
        )


def test_centres_are_as_likely_as_nodes_have_room_in_the_box(field):
    """Every node stands for the places that are nearest to it; beyond 1.5 px there are none."""
    rng = np.random.default_rng(2)
    places = rng.uniform(-1.5, 1.5, (200_000, 2))
    nearest = np.rint(places / 0.25).astype(int)
    edges = np.arange(-7.5, 8)
    counted = np.histogram2d(*nearest.T, bins=(edges, edges))[0]
    prior = np.exp(log_node_prior(field, np.full((1, 2), np.nan)))[0].reshape(15, 15)
    assert field.settings.centring_px == 1.5 and field.settings.step_px == 0.25
    for part in (slice(1, 2), slice(2, -2)):
        share = counted[part, 2:-2].sum() / len(places)
        assert prior[part, 2:-2].sum() == pytest.approx(share, rel=0.02)
    assert (prior[counted == 0] == 0).all()


def test_the_unit_of_a_star_does_not_matter_to_the_field():
    """Stars of any flux, in units of which their noise is, too, have the same PSF."""
    twins, rng = bright(60, spread=0.0), np.random.default_rng(3)
    noise = np.where(np.arange(60) < 30, 1e-2, 1e-3)

    def fit(unit):
        stamps = unit[:, None, None] * twins.stamps
        stars = replace(twins, stamps=stamps, flux=unit, noise=unit * noise)
        return fit_field(stars, 1e6, 14, SIDE, [1], 0.5, 100.0)

    unit_fit, scaled_fit = fit(np.ones(60)), fit(unit := 10 ** rng.uniform(-5.0, 5.0, 60))
    assert scaled_fit.model.coefficients == pytest.approx(unit_fit.model.coefficients, abs=1e-4)
    assert scaled_fit.flux / unit == pytest.approx(unit_fit.flux, rel=1e-3)
    assert scaled_fit.centre == pytest.approx(unit_fit.centre, abs=1e-3)


def test_order_is_what_the_field_has(cv_field):
    assert fitted(bright(60, varied=False), (0, 1)).model.order == 0
    assert cv_field.model.order >= 1
    few_stars = bright(60)
    no_place = fitted(replace(few_stars, position=np.full((60, 2), np.nan)), (0, 1, 2))
    assert no_place.model.order == 0
    assert np.isfinite(Faint(50, 20.0).measured(no_place).psf).all()


def test_photon_noise_takes_no_light_from_the_wings():
    """Weights by a star's own pixels would take half a photon from each, here 3 % of its light."""
    stars, rng, photons, noise = bright(80, varied=False), np.random.default_rng(5), 1e3, 4e-3
    sigma = np.sqrt(noise**2 + np.maximum(stars.stamps, 0.0) / photons)
    stamps = stars.stamps + sigma * rng.standard_normal(sigma.shape)
    stars = replace(stars, stamps=stamps, noise=np.full(80, noise))
    model = fit_field(stars, (photons * noise) ** 2, SIDE + 4, SIDE, [0], 0.5, 1e4).model
    middle, place = np.zeros((1, 2)), np.full((1, 2), FIELD / 2)
    core = [
        image[0, 2:-2, 2:-2].sum() / image[0].sum()
        for image in (model.images(model.terms(place), middle, SIDE), truth(place, middle, SIDE))
    ]
    assert core[0] == pytest.approx(core[1], abs=0.01)


def test_light_is_the_same_at_all_phases_of_the_pixel_grid():
    """Neighbours at the edges of the frames spoil fluxes, which phases must not make up for."""
    stars, rng = bright(60), np.random.default_rng(3)
    angle, flux = rng.uniform(0, 2 * np.pi, 60), rng.uniform(0, 0.3, 60)
    halo = truth(stars.position, 6.5 * np.stack([np.sin(angle), np.cos(angle)], axis=1), FRAME)
    stars = replace(stars, stamps=stars.stamps + flux[:, None, None] * halo)
    model = fit_field(stars, 1e6, SIDE + 4, SIDE, [2], 0.5, 100.0).model
    steps = np.arange(-0.5, 0.5, 0.125)
    phase = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    for place in ([200.0, 300.0], [700.0, 800.0]):
        positions = np.repeat([place], len(phase), axis=0)
        true_light = unit(truth(positions, phase, FRAME))[:, 8:18, 8:18].sum(axis=(1, 2))
        light = model.images(model.terms(positions), phase, SIDE).sum(axis=(1, 2)) / true_light
        assert np.std(light / light.mean()) < 0.006


def test_same_stars_give_the_same_fit(stars, field):
    refitted = fitted(stars)
    arrays = field.to_arrays()
    for name, array in refitted.to_arrays().items():
        assert array.tobytes() == arrays[name].tobytes(), name


def test_large_frames_are_fitted_to_fewer_stars_the_brighter_the_likelier():
    """All stars of usual stamps count; of 52² px, the 739 that 2e6 pixels have room for."""
    snr = np.random.default_rng(3).permutation(np.geomspace(100.0, 1000.0, 1500))
    assert (select_fit_stars(snr, 20**2, 1) == np.arange(1500)).all()
    rows = select_fit_stars(snr, 52**2, 1)
    assert (rows == select_fit_stars(snr, 52**2, 1)).all()
    assert len(np.unique(rows)) == int(2e6 / 52**2)
    # Faint ones are there, too, so that a PSF that changes with the magnitude is seen.
    is_bright = snr > np.median(snr)
    assert is_bright[rows].mean() > 0.55
    assert (~is_bright)[rows].mean() > 0.2


def test_list_of_the_training_is_known(field):
    assert field.list_error[0] == pytest.approx([-0.1, -0.1], abs=0.03)
    assert field.list_error[1] == pytest.approx([0.05, 0.05], rel=0.5)


def test_nodes_are_nearer_to_each_other_where_stars_are_undersampled(field, stars, monkeypatch):
    assert [node_step(fwhm, 0.25) for fwhm in (1.1, 1.7, 2.5)] == [1 / 8, 1 / 5, 0.25]
    assert field.step_px == 0.25
    finer_step = partial(node_step, max_step_fwhm=0.2 / size(stars.stamps).mean())
    monkeypatch.setattr("psfdae.methods.field.node_step", finer_step)
    finer = fitted(stars)
    assert finer.step_px == pytest.approx(0.18, abs=0.021)
    assert np.diff(np.unique(finer.places)) == pytest.approx(finer.step_px)


def test_packed_is_the_same_to_half_precision(field):
    arrays, _ = field.export(SIDE, 1e-3)
    config = {
        "noise": {"kappa": 1.0, "background_photons": 1e6},
        "field": field.settings.model_dump(),
    }
    faint = Faint(50, 10.0)
    result = faint.measured(FieldMixture.from_arrays(arrays, config, "realisation"))
    assert result.psf == pytest.approx(faint.measured(field).psf, abs=1e-4)


def test_psf_between_the_stars_is_the_fields(field):
    rng = np.random.default_rng(5)
    position = np.rint(rng.uniform(50, FIELD - 50, (30, 2))) + rng.uniform(-0.4, 0.4, (30, 2))
    phase = (position - np.floor(position + 0.5))[:, ::-1]
    expected = unit(truth(position, phase, SIDE))
    position += 0.1  # as the list of the training is
    psf = field.psf_at(position)
    assert np.square(unit(psf) - expected).mean() < 1e-6
    # Stars in the middle of their pixel have the sum 1, others what is left of it in the stamp.
    assert field.psf_at(np.rint(position)).sum(axis=(1, 2)) == pytest.approx(1.0)
    assert psf.sum(axis=(1, 2)) == pytest.approx(1.0, abs=0.01)
    fine = field.psf_at(position, 4)
    assert fine.shape == (30, 41, 41)
    assert fine[:, 0:40:4, 0:40:4] == pytest.approx(psf, abs=1e-9)
    # Beyond the stars it stays that of the edge.
    assert field.psf_at(np.array([[-500.0, 300.0]])) == pytest.approx(
        field.psf_at(np.array([[field.low[0] // 1 - 1, 300.0]])), abs=1e-3
    )


# The commands, on an image of which every star is known.


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    """Bright and faint stars on a lattice, a list of each, and a model of the bright ones."""
    folder, rng = tmp_path_factory.mktemp("field"), np.random.default_rng(11)
    axis = np.arange(30.0, 675, 30)
    lattice = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    position = lattice + rng.uniform(-0.5, 0.5, lattice.shape)
    is_bright = rng.permutation(len(position)) % 6 == 0
    area = 1 / np.square(truth(position, np.zeros_like(position), SIDE)).sum(axis=(1, 2)).mean()
    flux = np.where(is_bright, 2000, 50) * np.sqrt(area)  # σ of the sky is 1
    centre = (position - np.floor(position + 0.5))[:, ::-1]
    stamps = flux[:, None, None] * truth(position, centre, 20)
    pixels = np.full((700, 700), 100.0) + rng.standard_normal((700, 700))
    add_stamps(pixels, stamps, *position.T)
    for name, rows in (("bright", is_bright), ("faint", ~is_bright)):
        write_field(folder / "i.fits", folder / f"{name}.csv", pixels, *position[rows].T)
    words = ["methods=[noisy,field]", "framing.stamp_px=10", "parts.train_stars=100"]
    words += ["parts.test_stars=30", "field.orders=[2]", "field.modes=16", "--method", "field"]
    words += ["--catalogue", folder / "bright.csv", "--out", folder / "model"]
    with few_draws():
        printed("train", folder / "i.fits", *words)
    inside = flux * truth(position, centre, SIDE).sum(axis=(1, 2))
    true = {"position": position, "flux": flux, "inside": inside}
    true = {name: values[~is_bright] for name, values in true.items()}
    return folder, folder / "model/i.psf.safetensors", true


def predicted(image, *options):
    folder, model, _ = image
    out = folder / f"out{len(options)}.fits"
    words = ("--catalogue", folder / "faint.csv", "--model", model, "--out", out, "--overwrite")
    printed("predict", folder / "i.fits", *words, "--quiet", *options)
    return Table.read(out, hdu="STARS"), fits.getdata(out, "UNCERT")


def test_predict_measures_flux_and_centre_with_their_errors(image):
    """The bundle is small, and the list of the training says how good this one is."""
    stars, uncertainty = predicted(image)
    truths = image[2]
    assert np.isfinite(stars["outlier_score"]).all()
    assert image[1].stat().st_size < 5e6
    assert (stars["flags"] == 0).mean() > 0.95
    assert abs(np.mean(stars["flux"] / truths["inside"]) - 1) < 0.005
    for column, true in (
        ("flux", truths["inside"]),
        ("x_fit", truths["position"][:, 0]),
        ("y_fit", truths["position"][:, 1]),
    ):
        error = stars[f"{column.removesuffix('_fit')}_error"]
        pull = np.quantile(np.abs(stars[column] - true) / error, 0.68)
        assert 0.6 < pull < 1.3, (column, pull)
    assert (np.abs(stars["corr_flux_background"]) <= 1).all()
    assert np.median(stars["corr_flux_background"]) < -0.1
    assert np.isfinite(uncertainty).all()


def test_fixed_positions_are_kept(image):
    stars, _ = predicted(image, "--fixed-positions")
    position = image[2]["position"]
    assert stars["x_fit"].data == pytest.approx(position[:, 0], abs=1e-3)
    assert (stars["x_error"] == 0).all() and (stars["corr_flux_x"] == 0).all()
    measured, _ = predicted(image)
    inside = image[2]["inside"]
    assert np.std(stars["flux"] / inside) < 1.02 * np.std(measured["flux"] / inside)


def test_python_takes_positions_and_centres(image):
    model, faint = load_model(image[1]), Faint(200, 5.0)
    at_position, exact = (
        model.predict(faint.stamps, position=faint.position, **centres)
        for centres in ({}, {"centre": faint.centre[:, ::-1], "fixed": True})
    )
    errors = [p.psf / p.flux[:, None, None] - faint.psf for p in (at_position, exact)]
    assert np.square(errors[1]).mean() < 0.5 * np.square(errors[0]).mean()
    with pytest.raises(PredictionError, match="position of shape"):
        model.predict(faint.stamps, position=faint.position[:3])
    blind = model.predict(np.full((1, SIDE, SIDE), 7.0))
    assert blind.flags[0] & 8 and np.isnan(blind.psf).all() and np.isnan(blind.x_fit).all()


def test_fluxes_and_their_errors_have_the_unit_of_the_stamps(image):
    model, faint = load_model(image[1]), Faint(50, 20.0)
    one, other = (model.predict(unit * faint.stamps, position=faint.position) for unit in (1, 50))
    for name in ("flux", "flux_error", "background", "noise"):
        assert getattr(other, name) == pytest.approx(50 * getattr(one, name), rel=1e-3), name
    assert other.x_error == pytest.approx(one.x_error, rel=1e-3)


def test_bad_pixels_are_left_out(image):
    model, faint = load_model(image[1]), Faint(100, 50.0)
    spoilt = faint.stamps.copy()
    spoilt[:, 5, 6] = np.nan
    clean, repaired = (model.predict(s, position=faint.position) for s in (faint.stamps, spoilt))
    assert np.median(np.abs(repaired.flux / clean.flux - 1)) < 0.03
    assert (repaired.flags & 1).all()


def test_the_variance_of_residuals_is_a_mean_over_the_middle_of_the_stamp():
    """Squares of modes and the rest of the variance: 2² + 1 in the middle 4 × 4 px of 8 × 8."""
    middle = np.pad(np.ones((4, 4)), 2).ravel()

    class FixedResiduals(FieldPrior):
        def residuals_at(self, centre):
            return 0.0 * middle, np.stack([2.0 * middle, 0.0 * middle]), middle

    model = SimpleNamespace(method=object.__new__(FixedResiduals), stamp_px=8)
    for side_px, expected in ((4, 5.0), (8, 5.0 / 4.0), (12, 5.0 / 4.0), (2, 5.0)):
        assert StarModel.residual_variance(model, side_px) == pytest.approx(expected)


@pytest.fixture(scope="module")
def oblong(image):
    """The model of a field that is wider than it is high."""
    path = image[0] / "oblong.psf.safetensors"
    bundle = read_bundle(image[1])
    ends = {"low": np.array([50.0, 300.0]), "high": np.array([650.0, 600.0])}
    write_bundle(replace(bundle, weights=bundle.weights | ends), path)
    return path


def test_psf_writes_what_photutils_reads(oblong, tmp_path):
    """Files of STScI say y before x; releases before 3.1 stop at them instead of mixing them up."""
    model, out = load_model(oblong), tmp_path / "grid.fits"
    assert psfdae("psf", oblong, "--grid", "4x3", "--out", out).exit_code == 0
    grid = gridded(out)
    if Version(photutils.__version__) >= Version("3.1"):
        assert (GriddedPSFModel.read(out).grid_xypos == grid.grid_xypos).all()
    else:
        with pytest.raises(ValueError, match=r"needs photutils 3\.1"):
            GriddedPSFModel.read(out)
    assert grid.data.shape == (12, 41, 41) and list(grid.oversampling) == [4, 4]
    x, y = np.linspace(50, 650, 4), np.linspace(300, 600, 3)
    assert grid.grid_xypos.tolist() == [[a, b] for b in y for a in x]
    assert grid.data[5] == pytest.approx(model.psf_at(*np.rint(grid.grid_xypos[5])), abs=1e-6)
    words = ("--at", "310.4,422", "--oversampling", 1, "--out", tmp_path / "one.fits")
    assert psfdae("psf", oblong, *words).exit_code == 0
    single = fits.getdata(tmp_path / "one.fits")
    assert single.shape == (1, SIDE, SIDE) and single.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--grid", "1x5"], "COLUMNSxROWS"),
        (["--at", "1,2", "--grid", "3x3"], "says where"),
    ],
)
def test_wrong_places_are_one_line(image, tmp_path, words, message):
    assert message in refused("psf", image[1], *words, "--out", tmp_path / "x.fits")


def test_models_without_a_field_say_so(image):
    with pytest.raises(PredictionError, match=r"psfdae\.fit with method='field'"):
        load_model().psf_at(1.0, 2.0)
    with pytest.raises(PredictionError, match="finite"):
        load_model(image[1]).psf_at(np.nan, 2.0)


@pytest.mark.slow
def test_photometry_of_photutils_with_the_grid_is_unbiased(image):
    """Isolated stars of S/N 50, mean bias below 0.5 %.

    A PSF of a place holds the flux that a star in the middle of its pixel has in its stamp.
    """
    folder, path, true = image
    out = folder / "photometry.fits"
    assert psfdae("psf", path, "--grid", "7x7", "--out", out).exit_code == 0
    start = Table(true["position"], names=("x", "y"))
    photometry = PSFPhotometry(gridded(out), (9, 9), aperture_radius=4)
    fluxes = photometry(fits.getdata(folder / "i.fits").astype(float) - 100.0, init_params=start)
    middle = truth(true["position"], np.zeros_like(true["position"]), SIDE)
    ratio = fluxes["flux_fit"] / (true["flux"] * middle.sum(axis=(1, 2)))
    assert len(ratio) >= 400
    assert abs(np.mean(ratio) - 1) < 0.005
    assert np.std(ratio) < 0.03


@pytest.mark.parametrize("snr", [5.0, 20.0])
def test_sigma_knows_the_doubt_about_the_flux(field, snr):
    """Flux and sky found: the nine brightest pixels are within σ as often as of a normal law."""
    faint = Faint(500, snr)
    result = faint.measured(field)
    error = np.abs(result.measurements.flux[:, None, None] * result.psf - 1000 * faint.psf)
    sigma = result.measurements.flux[:, None, None] * result.sigma
    bright = result.psf >= np.sort(result.psf.reshape(500, -1))[:, -9, None, None]
    for width, part in ((1.0, 0.683), (1.96, 0.95)):
        assert (error <= width * sigma)[bright].mean() == pytest.approx(part, abs=0.04)


# Numbers of the fit


def test_a_change_between_exposures_is_a_fraction_of_the_coefficient(stars, field, monkeypatch):
    """The ridge ρ = 1/(change |c| + min)²: a change by that fraction is one standard deviation."""
    ridges = []

    def solve(terms, data, weight, splines, penalty, ridge, start, tolerance, preconditioners):
        ridges.append(ridge)
        return np.zeros(ridge.shape)

    monkeypatch.setattr("psfdae.methods.field.fit.solve_splines", solve)
    prior = field.model
    fitter = replace(FieldFitter.build(stars, 1e6, FRAME, SIDE), prior=prior)
    terms, settings = prior.terms(stars.coordinates), fitter.settings
    options = FitOptions(knots=prior.coefficients.shape[1], smoothness=0.0, order=2, change=0.1)
    weight = np.full(fitter.images.shape, 1e6)
    coefficients = fitter.fit_splines(
        options, terms, fitter.images, weight, stars.centre, prior.coefficients
    )
    sigma = 0.1 * np.abs(coefficients[0]) + settings.min_coefficient
    assert np.ptp(np.log10(sigma)) > 2
    assert_allclose(ridges[0][0] * sigma**2, 1.0, rtol=1e-9)
    assert_allclose(ridges[0][1:] * sigma**2, settings.varying_change**-2, rtol=1e-9)


def test_a_blend_changes_nothing_in_the_field(field):
    stars = bright(60)
    stamps = stars.stamps.copy()
    stamps[3] += 0.5 * np.roll(stamps[3], 3, axis=1)
    others = stars.select(np.delete(np.arange(60), 3))
    options = FitOptions(knots=field.model.coefficients.shape[1], smoothness=100.0, order=1)
    with_blend, without = (
        FieldFitter.build(part, 1e6, FRAME, SIDE).fit(options)
        for part in (replace(stars, stamps=stamps), others)
    )
    assert not with_blend.good[3] and with_blend.good.sum() > 50
    coefficients = without.model.coefficients
    limit = 0.01 * np.abs(coefficients).max()
    assert_allclose(with_blend.model.coefficients, coefficients, rtol=0.0, atol=limit)


@pytest.mark.parametrize(("depth", "is_misfit"), [(0.015, False), (0.03, True)])
def test_a_star_is_a_misfit_if_its_pixels_are_2_per_cent_off(depth, is_misfit):
    """Pixels wrong by ±ε of their light have d² = Σ p (ε p)² / Σ p³ = ε²."""
    stars = bright(40, varied=False, spread=0.0)
    noise = np.full(40, 1e-6)
    clean = truth(np.full((40, 2), FIELD / 2), stars.listed, FRAME)
    pattern = 1 + depth * (-1.0) ** np.indices((FRAME, FRAME)).sum(axis=0)
    clean[7] *= pattern
    stars = replace(stars, stamps=clean, noise=noise, snr=1 / noise, centre=stars.listed)
    zeros, verdict = np.zeros(40), np.full(40, Verdict.GOOD, object)
    candidates = Candidates(
        np.arange(40), stars.position, stars.snr, noise, zeros, zeros, zeros, verdict, stars
    )
    settings = SimpleNamespace(
        seed=0,
        framing=SimpleNamespace(stamp_px=SIDE),
        noise=SimpleNamespace(background_photons=1e6),
    )
    checked = reject_misfits(candidates, settings, None)
    assert np.flatnonzero(checked.verdict == Verdict.MISFIT).tolist() == [7] * is_misfit


@pytest.mark.parametrize("shape", [(30, 12), (12, 30), (1, 9)])
def test_components_of_residuals_are_their_singular_vectors(shape):
    rows = np.random.default_rng(1).normal(size=shape)
    rows[:, 0] = 0.0
    square, axes = find_components(rows)
    _, size, singular_vectors = np.linalg.svd(rows, full_matrices=False)
    assert_allclose(square, size**2, atol=1e-10)
    assert_allclose((axes.T * square) @ axes, rows.T @ rows, atol=1e-10)
    cosine = np.abs((axes * singular_vectors).sum(axis=1))
    assert_allclose(cosine[size > 1e-9], 1.0, atol=1e-10)
