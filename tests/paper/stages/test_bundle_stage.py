"""Packing networks: that a bundle says what was trained, and that its errors are those made."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from command_line import printed, psfdae, refused
from prediction_stars import gaussians
from psfdae import StarFlag
from psfdae.api import PsfModel
from psfdae.base.belonging import write_origin
from psfdae.base.files import Column, ProductError, read_product, write_product
from psfdae.denoise.bundle import (
    BundleError,
    estimator,
    locate_shipped_model,
    read_bundle,
    write_bundle,
)
from psfdae.denoise.error_model import brightest, interpolate_at_noise, mahalanobis
from psfdae.denoise.flux_model import FluxModel
from psfdae.methods import list_groups
from psfdae.stars.noise import NoiseModel
from psfdae.stars.splits import random_split
from psfdae.training.calibration import StarErrors, cross_validate_coverage
from psfdae.training.star_sets import HeldOutStars, noise_model, noisy_test_images, read_stars
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.stages import bundle as stage
from psfdae_paper.stages.evaluate import Models
from psfdae_paper.stages.fit import fit

TINY = [
    *("noise.levels=[1e-3,3e-3,1e-2]", "parts.train_stars=1000", "parts.test_stars=400"),
    *("dae.kernels=[5,3,3,5]", "dae.widths=[6,6,6]", "train.epochs=4"),
]
STARS = {
    "telescope": {"pixel_scale_arcsec": 0.1, "diameter_m": 1.0, "wavelength_m": 5.5e-7},
    "framing": {"jitter_px": 1, "subpixel": True},
}


def write_stars(path, config):
    images = gaussians(1400, 1)
    grid = np.stack([np.arange(25) % 5, np.arange(25) // 5], axis=1)
    arrays = {"realisation": images, "field_index": np.arange(1400) % 25, "grid": grid}
    measured = {"noise": 1e-3, "snr": 250.0, "flux": 1e4, "colour": np.nan}
    arrays |= {"position": 100.0 * grid}
    arrays |= {name: np.full(25, value) for name, value in measured.items()}
    arrays["wide"] = np.zeros((25, 32, 32))
    columns = {name: Column(array, "1", "of stars") for name, array in arrays.items()}
    write_product(path, "stars", columns, config)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Stars, a network trained on them, and its bundle."""
    folder = tmp_path_factory.mktemp("bundle")
    stars = write_stars(folder / "stars.h5", STARS)
    config = load_stage(list_groups("dae"), TINY)
    fit(config, "dae", stars, out=folder / "dae")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "0")
        pack(folder, folder / "tiny.psf.safetensors")
    return folder


def pack(folder, out, overrides=(), **options):
    inputs = {"stars": folder / "stars.h5", "split": None, "name": "tiny", "licence": "MIT"}
    inputs["models"] = Models(dae=options.pop("dae", folder / "dae"))
    config = load_stage(stage.bundle.stage.settings.reads, [*TINY, *overrides])
    stage.bundle(config, out=out, **(inputs | options))


@pytest.fixture(scope="module")
def tiny(folder):
    return read_bundle(folder / "tiny.psf.safetensors")


def test_same_inputs_give_the_same_bytes(folder, tiny, tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    pack(folder, tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (folder / "tiny.psf.safetensors").read_bytes()
    assert tiny.info.created == "1970-01-01"


def test_info_says_what_the_stars_and_the_training_were(tiny):
    info = tiny.info
    assert (info.stamp_px, info.jitter_px, info.subpixel, info.source) == (12, 1, True, "simulated")
    assert info.pixel_lambda_d == pytest.approx(np.deg2rad(0.1 / 3600) / 5.5e-7)
    assert (info.noise_min, info.noise_max) == pytest.approx((4.98e-3, 4.98e-2))
    assert info.snr_max == pytest.approx(1 / (info.noise_min * np.sqrt(info.noise_equivalent_px)))
    assert info.snr_max / info.snr_min == pytest.approx(10)
    assert info.training_stars == 1000
    assert info.image_scale == 144
    assert info.config["train"]["train"]["epochs"] == 4


def test_unknown_optics_have_no_diffraction_limit(folder, tmp_path):
    optics = {
        "telescope": {"pixel_scale_arcsec": 2.0},
        "framing": {"jitter_px": 0},
        "source": "stars",
    }
    stars = write_stars(tmp_path / "own.h5", optics)
    with pytest.raises(ProductError, match=r"pixel_scale_arcsec = 0\.1, but .*own\.h5 has 2\.0"):
        pack(folder, tmp_path / "own", stars=stars)
    shutil.copytree(folder / "dae", tmp_path / "dae")
    write_origin(tmp_path / "dae", read_product(stars, "stars", ()))
    pack(tmp_path, tmp_path / "own", stars=stars)
    info = read_bundle(tmp_path / "own").info
    assert (info.pixel_lambda_d, info.source, info.subpixel) == (None, "stars", False)
    assert info.pixel_scale_arcsec == 2.0
    assert info.noise_equivalent_px == pytest.approx((1e-3 * 250) ** -2)
    assert info.training_stars == 25  # and not the 1000 images of them


def test_metrics_are_those_of_the_stage_evaluate(folder, tiny):
    config = load_stage(stage.bundle.stage.settings.reads, TINY)
    images, stars = gaussians(1400, 1), read_stars(folder / "stars.h5")
    test = random_split(1400, 1000, 400, config.parts.validation_fraction, config.seed).test
    for row in tiny.info.metrics:
        noisy = noisy_test_images(config, stars, test, row["noise_level"])
        estimate = estimator(tiny).predict(noisy)
        assert row["mse"] == pytest.approx(np.square(estimate - images[test]).mean(), rel=1e-4)
        assert row["mse"] < row["mse_noisy"]


def simulate_fresh_stars():
    """Stars that no method has seen, their noise σ, and the random stream that goes on."""
    rng = np.random.default_rng(5)
    return gaussians(1500, 99), np.exp(rng.uniform(np.log(4.98e-3), np.log(4.98e-2), 1500)), rng


def covered(error, noise, nodes, maps):
    """Part of the errors (n, d, d) within the half-widths at the noise of each star."""
    return (np.abs(error) <= interpolate_at_noise(noise, nodes, maps)).mean()


def test_half_width_covers_fresh_stars(tiny):
    config = load_stage(stage.bundle.stage.settings.reads, TINY)
    images, noise, rng = simulate_fresh_stars()
    noisy = noise_model(config).draw(images, noise / 4.98, rng)
    error = estimator(tiny).predict(noisy) - images
    for part in np.array_split(np.argsort(noise), 3):
        coverage = covered(error[part], noise[part], tiny.errors.noise, tiny.errors.half_width68)
        assert coverage == pytest.approx(0.6827, abs=0.05)
    for row in tiny.info.metrics:
        assert row["coverage68"] == pytest.approx(0.6827, abs=0.05)


@pytest.fixture(scope="module")
def mixture(folder):
    """The bundle of a Gaussian mixture, which tells how sure it is of each star."""
    small = [*TINY, "gmm.components=[24]", "gmm.shrinkage=[10.0]"]
    fit(load_stage(list_groups("gmm"), small), "gmm", folder / "stars.h5", out=folder / "g")
    pack(folder, folder / "g.psf.safetensors", models=Models(gmm=folder / "g"))
    return read_bundle(folder / "g.psf.safetensors")


def test_a_method_that_knows_how_sure_it_is_covers_68_and_95_per_cent(mixture):
    """Its σ tells stars apart; the bundle's table corrects it. Threads change nothing."""
    images, noise, rng = simulate_fresh_stars()
    noisy = images + rng.normal(size=images.shape) * noise[:, None, None]
    stated = {"flux": 1.0, "background": 0.0, "noise": noise}
    exact, threaded = (PsfModel(mixture).predict(noisy, **stated, threads=n) for n in (1, 2))
    assert all((getattr(threaded, name) == getattr(exact, name)).all() for name in ("psf", "snr"))
    fitted = PsfModel(mixture).predict(noisy + 3.0, noise=noise)
    valid = np.isfinite(fitted.psf).all(axis=(1, 2))
    for part in np.array_split(np.argsort(noise), 3):
        for prediction, rows, scatter in ((exact, part, 0.02), (fitted, part[valid[part]], 0.035)):
            error, width = np.abs(prediction.psf - images)[rows], prediction.uncertainty[rows]
            width95 = width * prediction.ratio95[rows, None, None]
            assert (error <= width).mean() == pytest.approx(0.683, abs=0.03)
            assert (error <= width95).mean() == pytest.approx(0.95, abs=scatter)
    assert mixture.info.metrics[0]["coverage95"] == pytest.approx(0.95, abs=0.02)
    error, scale = exact.psf - images, noise[:, None, None]
    error2, sigma2 = (np.square(a / scale).mean(axis=(1, 2)) for a in (error, exact.uncertainty))
    surest, unsure = np.array_split(np.argsort(sigma2), 2)
    assert error2[unsure].mean() > 1.3 * error2[surest].mean()
    assert fitted.psf[valid].sum(axis=(1, 2)) == pytest.approx(fitted.flux[valid], rel=1e-3)
    single = PsfModel(mixture).predict(noisy[7], flux=1.0, background=0.0, noise=noise[7])
    np.testing.assert_allclose(single.psf[0], exact.psf[7], atol=1e-6)


def test_a_mixture_measures_flux_better_than_the_photometry_and_flags_blends(mixture, tiny):
    images, noise, rng = simulate_fresh_stars()
    noise = np.minimum(noise, 0.01)
    noisy = images + rng.normal(size=images.shape) * noise[:, None, None]
    models = [PsfModel(bundle) for bundle in (mixture, tiny)]
    gmm, dae = (model.predict(noisy + 3.0, noise=noise) for model in models)
    errors = [np.sqrt(np.square(result.flux - 1).mean()) for result in (gmm, dae)]
    assert errors[0] < 0.9 * errors[1]
    # Whatever the flux, the light of the stamp stays.
    light = gmm.flux + 144 * gmm.background
    assert light == pytest.approx(dae.flux + 144 * dae.background, nan_ok=True)
    blends = 0.7 * noisy + 0.3 * np.roll(noisy, 5, axis=2)
    gmm_blend, dae_blend = (model.predict(blends, noise=noise) for model in models)
    flagged = [(p.flags & StarFlag.UNLIKE_TRAINING > 0).mean() for p in (gmm, gmm_blend, dae_blend)]
    assert flagged[0] < 0.02 and flagged[1] > 0.1 > flagged[2]
    assert (
        np.isfinite(gmm_blend.outlier_score).mean() > 0.9
        and np.isnan(dae_blend.outlier_score).all()
    )


@pytest.mark.parametrize("names", [(), ("background", "noise")])
def test_bright_pixels_are_covered_as_the_others_are(tiny, names):
    """Errors cover unseen stars, whatever is known of them beside their flux."""
    images, rng = gaussians(1500, 99), np.random.default_rng(5)
    model = PsfModel(tiny)
    for noise in (6e-3, 1.5e-2):
        noisy = images + noise * rng.normal(size=images.shape) + 3.0
        stated = {"background": 3.0, "noise": noise}
        result = model.predict(noisy, **{name: stated[name] for name in names})
        valid = np.isfinite(result.psf).all(axis=(1, 2))
        error, width = np.abs(result.psf - images)[valid], result.uncertainty[valid]
        bright = brightest(result.psf[valid])
        assert bright.mean() == pytest.approx(20 / 256, abs=0.01)
        cases = (result.ratio95_bright, bright), (result.ratio95, ~bright)
        for ratio, pixels in cases:
            width95 = width * ratio[valid, None, None]
            assert (error <= width)[pixels].mean() == pytest.approx(0.683, abs=0.03)
            assert (error <= width95)[pixels].mean() == pytest.approx(0.95, abs=0.02)


def test_errors_of_some_stars_are_those_stars_errors():
    """Images repeat the stars; a mask over stars keeps every image of those, and no other."""
    star = np.array([0, 1, 2, 3, 4, 0, 1, 2, 3, 4])
    error = np.arange(10.0)[None, :, None, None] + np.zeros((2, 10, 4, 4))
    distance = 100.0 + np.arange(20.0).reshape(2, 10)
    subset = StarErrors(np.array([1.0, 2.0]), error, star, distance).select(
        np.array([False, True, False, False, True])
    )
    assert subset.star.tolist() == [1, 4, 1, 4]
    assert (subset.error[:, :, 0, 0] == [1, 4, 6, 9]).all()
    assert (subset.distance == [[101, 104, 106, 109], [111, 114, 116, 119]]).all()


def test_either_half_of_the_stars_is_judged_by_the_errors_of_the_other():
    """Even stars err by σ, odd ones by 3σ: ± σ holds 26 % of these, ± 3σ 99.7 % of those."""
    rng, star = np.random.default_rng(0), np.tile(np.arange(400), 10)
    scale = np.where(star % 2, 3.0, 1.0)[:, None, None]
    error = rng.normal(size=(1, 4000, 8, 8)) * scale
    errors = StarErrors(np.array([0.01]), np.abs(error), star, np.zeros((1, 4000)))
    fresh = np.abs(rng.normal(size=(400, 8, 8)) * scale[:400])
    coverage = cross_validate_coverage(errors)(fresh, 0.01)
    expected = {"coverage68": (0.9973 + 0.2611) / 2, "coverage95": (1 + 0.4865) / 2}
    assert coverage == pytest.approx(expected, abs=0.01)


def test_distance_is_the_number_of_components_whatever_the_noise():
    model = FluxModel.fit(gaussians(4000, 4))
    fresh, rng = gaussians(2000, 5), np.random.default_rng(6)
    for noise in (1e-4, 3e-3, 5e-2):
        noisy = fresh + rng.normal(0, noise, fresh.shape)
        squared = mahalanobis(noisy, np.full(2000, noise), model, 20) ** 2
        assert squared.mean() == pytest.approx(20, rel=0.1)


def test_network_of_another_training_and_stars_that_say_too_little_are_refused(folder, tmp_path):
    for override in ("noise.kappa=5", "parts.test_stars=300"):
        with pytest.raises(ProductError, match=override.split("=")[0]):
            pack(folder, tmp_path / "x", [override])
    with pytest.raises(ProductError, match=r"split = random, .* has held_out"):
        pack(folder, tmp_path / "x", split="held_out")
    stars = write_stars(tmp_path / "s.h5", {"telescope": {}, "framing": {"jitter_px": 1}})
    with pytest.raises(ProductError, match=r"s\.h5: .*'pixel_scale_arcsec'"):
        pack(folder, tmp_path / "x", stars=stars)
    line = refused(
        "paper", "bundle", "--stars", folder / "stars.h5", "--dae", tmp_path, "--out", "x"
    )
    assert f"{tmp_path}/dae.safetensors: no such file" in line


def test_commands_pack_and_describe(folder, tmp_path):
    path = tmp_path / "mine.psf.safetensors"
    inputs = ["--stars", folder / "stars.h5", "--dae", folder / "dae"]
    printed("paper", "bundle", *inputs, "--out", path, *TINY)
    text = psfdae("describe", path).output
    for fact in ("mine", "12 × 12 px of 0.1 arcsec (0.881 λ/D)", "not stated", "1000 simulated"):
        assert fact in text


def test_shipped_bundle_is_small_and_wide():
    info = read_bundle().info
    assert info.name == "wfsat" and info.subpixel
    assert locate_shipped_model().stat().st_size <= 5_000_000
    assert info.snr_min < 5 and info.snr_max > 500
    faint = [row["mse"] / row["mse_noisy"] for row in info.metrics if row["snr"] < 50]
    assert len(faint) >= 3 and max(faint) < 0.2
    for row in info.metrics:
        assert row["coverage68"] == pytest.approx(0.6827, abs=0.05)


def test_ship_names_checks_and_writes(folder, tiny, tmp_path, capsys):
    """The bundle that errs least on the validation stars, of a fit that has not seen them."""
    config = load_stage(stage.ship.stage.settings.reads, TINY)
    inputs = {"stars": folder / "stars.h5", "out": tmp_path / "bundles"}
    weights = {name: 0 * array for name, array in tiny.weights.items()}
    untrained, trained = tmp_path / "none.psf.safetensors", folder / "tiny.psf.safetensors"
    write_bundle(replace(tiny, weights=weights), untrained)
    stage.ship(config, (untrained, trained), **inputs)
    lines = capsys.readouterr().out.splitlines()[:2]
    errors = [float(line.split("MSE ")[1].split()[0]) for line in lines]
    assert errors[0] > 2 * errors[1]
    (out,) = (tmp_path / "bundles").iterdir()
    assert out.name == "wfsat.psf.safetensors"
    assert read_bundle(out).info.licence == "MIT"
    rows = [row | {"coverage68": 0.5} for row in tiny.info.metrics]
    poor = replace(tiny, info=tiny.info.model_copy(update={"metrics": rows}))
    write_bundle(poor, tmp_path / "poor.psf.safetensors")
    with pytest.raises(BundleError, match=r"half-widths contain 50\.0%"):
        stage.ship(config, (tmp_path / "poor.psf.safetensors",), **inputs)


def test_half_widths_beside_the_stars_own_noise_are_above_0_and_hold_two_thirds_or_more():
    """Own noise three times the method's errors: most of these are hidden in it, star by star."""
    rng = np.random.default_rng(6)
    own_sigma, error = 3e-3, 1e-3
    zero = np.zeros((2000, 8, 8), np.float32)
    own_noise = np.full(zero.shape, own_sigma)
    of = NoiseModel(1.0, 1e4), np.zeros((2000, 4)), np.zeros(2000), own_noise
    stars = HeldOutStars(zero, rng.normal(0, own_sigma, zero.shape), *of)
    psf = rng.normal(0, error, zero.shape)
    first_stars = np.arange(40)
    errors, distance = (
        stars.errors(psf[first_stars], first_stars)[None],
        np.ones((1, first_stars.size)),
    )
    width = StarErrors(np.ones(1), errors, first_stars, distance).half_width68
    assert width.min() > 0 and 0.1 * own_sigma < width.mean() < 0.7 * own_sigma
    coverage = covered(stars.errors(psf), np.ones(2000), np.ones(1), width)
    assert coverage == pytest.approx(0.72, abs=0.05)
