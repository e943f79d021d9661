"""Packing networks: that a bundle says what was trained, and that its errors are those made."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from psfdae import StarFlag
from psfdae.belonging import write_origin
from psfdae.cli import main
from psfdae.commands import describe
from psfdae.files import Column, ProductError, read_product, write_product
from psfdae.methods import groups_of
from psfdae.model import packing
from psfdae.model.bundle import (
    SCALES,
    BundleError,
    at_noise,
    brightest,
    estimator,
    mahalanobis,
    read_bundle,
    shipped_path,
    write_bundle,
)
from psfdae.model.photometry import FluxModel, signal_to_noise
from psfdae.model.psf_model import PsfModel
from psfdae.model.star_sets import noise_model, noisy_test_images, read_stars
from psfdae.networks import dae as dae_network
from psfdae.noise import NoiseModel, noise_equivalent_px
from psfdae.rng import stream
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.configuration.consistency import SIMULATION, STATIC
from psfdae_paper.stages import bundle as stage
from psfdae_paper.stages.evaluate import Models
from psfdae_paper.stages.fit import fit, train

TINY = [
    "noise.levels=[1e-3,3e-3,1e-2]",
    "parts.train_stars=1000",
    "parts.test_stars=400",
    "dae.kernels=[5,3,3,5]",
    "dae.widths=[6,6,6]",
    "train.epochs=4",
]
STARS = {
    "telescope": {"pixel_scale_arcsec": 0.1, "diameter_m": 1.0, "wavelength_m": 5.5e-7},
    "framing": {"jitter_px": 1, "subpixel": True},
}


def gaussians(count, seed):
    """Gaussian stars of random width and position, 12 × 12, float32, of sum 1."""
    rng = np.random.default_rng(seed)
    grid = np.arange(12) - 6
    centre = rng.uniform(-1, 1, size=(2, count, 1, 1))
    width = rng.uniform(0.8, 2.5, size=(count, 1, 1))
    r2 = (grid[:, None] - centre[0]) ** 2 + (grid - centre[1]) ** 2
    images = np.exp(-0.5 * r2 / width**2)
    return (images / images.sum(axis=(1, 2), keepdims=True)).astype(np.float32)


def write_stars(path, config):
    images = gaussians(1400, 1)
    grid = np.stack([np.arange(25) % 5, np.arange(25) // 5], axis=1)
    columns = {
        "realisation": Column(images, "1", "noise-free image"),
        "field_index": Column(np.arange(1400) % 25, "1", "field"),
        "grid": Column(grid, "1", "index"),
        "position": Column(100.0 * grid, "pixel", "of stars of an image"),
        "noise": Column(np.full(25, 1e-3), "1", "of stars of an image"),
        "snr": Column(np.full(25, 250.0), "1", "of stars of an image"),
        "flux": Column(np.full(25, 1e4), "count", "of stars of an image"),
        "colour": Column(np.full(25, np.nan), "mag", "of stars of an image"),
        "wide": Column(np.zeros((25, 32, 32)), "1", "of stars of an image"),
    }
    write_product(path, "stars", columns, config)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Stars, a network trained on them, and its bundle."""
    folder = tmp_path_factory.mktemp("bundle")
    stars = write_stars(folder / "stars.h5", STARS)
    config = load_stage(groups_of("dae"), TINY)
    train(config, stars, out=folder / "dae")
    pack(folder, folder / "tiny.psf.safetensors")
    return folder


def pack(folder, out, overrides=(), **options):
    chosen = {"stars": folder / "stars.h5", "split": None, "name": "tiny", "licence": "MIT"}
    chosen["models"] = Models(dae=options.pop("dae", folder / "dae"))
    config = load_stage(stage.bundle.stage.settings.reads, [*TINY, *overrides])
    stage.bundle(config, out=out, **(chosen | options))


@pytest.fixture(scope="module")
def tiny(folder):
    return read_bundle(folder / "tiny.psf.safetensors")


def test_same_inputs_give_the_same_bytes(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    for name in ("one", "two"):
        pack(folder, tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    early = read_bundle(tmp_path / "one")
    assert early.info.created == "1970-01-01"
    assert early.sha256 == read_bundle(folder / "tiny.psf.safetensors").sha256


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
    own = {"telescope": {"pixel_scale_arcsec": 2.0}, "framing": {"jitter_px": 0}, "source": "stars"}
    stars = write_stars(tmp_path / "own.h5", own)
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
    images = gaussians(1400, 1)
    from psfdae.splits import random_split

    test = random_split(1400, 1000, 400, config.parts.validation_fraction, config.seed).test
    stars = read_stars(folder / "stars.h5")
    for row in tiny.info.metrics:
        noisy = noisy_test_images(config, stars, test, row["noise_level"])
        estimate = estimator(tiny).predict(noisy)
        assert row["mse"] == pytest.approx(np.square(estimate - images[test]).mean(), rel=1e-4)
        assert row["mse"] < row["mse_noisy"]


def test_half_width_covers_fresh_stars_and_the_rms_too_many(tiny):
    config = load_stage(stage.bundle.stage.settings.reads, TINY)
    images = gaussians(1500, 99)
    rng = np.random.default_rng(5)
    noise = np.exp(rng.uniform(np.log(4.98e-3), np.log(4.98e-2), size=1500))
    noisy = noise_model(config).draw(images, noise / 4.98, rng)
    error = estimator(tiny).predict(noisy) - images
    covered = packing.coverage(error, noise, tiny.noise_nodes, tiny.error68)
    assert covered == pytest.approx(0.6827, abs=0.05)
    for part in np.array_split(np.argsort(noise), 3):
        within = packing.coverage(error[part], noise[part], tiny.noise_nodes, tiny.error68)
        assert within == pytest.approx(0.6827, abs=0.05)
    assert packing.coverage(error, noise, tiny.noise_nodes, tiny.rms) > covered + 0.05
    for row in tiny.info.metrics:
        assert row["coverage68"] == pytest.approx(0.6827, abs=0.05)


def test_a_method_that_knows_how_sure_it_is_covers_68_and_95_per_cent(folder, tiny, tmp_path):
    """Its σ tells stars apart; the bundle's table corrects it. Threads change nothing."""
    small = ["gmm.components=[24]", "gmm.shrinkage=[10.0]"]
    fit(
        load_stage(groups_of("gmm"), [*TINY, *small]),
        "gmm",
        folder / "stars.h5",
        out=tmp_path / "g",
    )
    pack(folder, tmp_path / "g.psf.safetensors", models=Models(gmm=tmp_path / "g"))
    bundle, images = read_bundle(tmp_path / "g.psf.safetensors"), gaussians(1500, 99)
    rng = np.random.default_rng(5)
    noise = np.exp(rng.uniform(np.log(4.98e-3), np.log(4.98e-2), size=1500))
    noisy = images + rng.normal(size=images.shape) * noise[:, None, None]
    known = {"flux": 1.0, "background": 0.0, "noise": noise}
    found, again = (PsfModel(bundle).predict(noisy, **known, threads=n) for n in (1, 2))
    error, width = np.abs(found.psf - images), found.uncertainty
    for part in np.array_split(np.argsort(noise), 3):
        assert (error[part] <= width[part]).mean() == pytest.approx(0.683, abs=0.05)
        wide = width[part] * found.ratio95[part, None, None]
        assert (error[part] <= wide).mean() == pytest.approx(0.95, abs=0.02)
    assert bundle.info.metrics[0]["coverage95"] == pytest.approx(0.95, abs=0.02)
    wrong, doubt = (np.square(a / noise[:, None, None]).mean(axis=(1, 2)) for a in (error, width))
    surest, least = np.array_split(np.argsort(doubt), 2)
    assert wrong[least].mean() > 1.3 * wrong[surest].mean()
    assert all((getattr(again, name) == getattr(found, name)).all() for name in ("psf", "snr"))
    free, dae = (PsfModel(b).predict(noisy + 3.0, noise=noise) for b in (bundle, tiny))
    bright = noise < 0.01
    kept = np.isfinite(free.psf).all(axis=(1, 2))
    write_bundle(replace(bundle, **dict.fromkeys(SCALES)), tmp_path / "old.psf.safetensors")
    old = PsfModel(read_bundle(tmp_path / "old.psf.safetensors"))
    narrow = old.predict(noisy + 3.0, noise=noise)
    for part in np.array_split(np.argsort(noise), 3):
        some = part[kept[part]]
        error = np.abs(free.psf[some] - images[some])
        (less, few), (inside, most) = (
            [(error <= f.uncertainty[some] * r).mean() for r in (1, f.ratio95[some, None, None])]
            for f in (narrow, free)
        )
        assert less < 0.65 and inside == pytest.approx(0.683, abs=0.03)
        assert few < 0.91 and most == pytest.approx(0.95, abs=0.035)
    errors = [np.sqrt(np.square(found.flux[bright] - 1).mean()) for found in (free, dae)]
    assert errors[0] < 0.9 * errors[1]
    assert free.psf[kept].sum(axis=(1, 2)) == pytest.approx(free.flux[kept], rel=1e-3)
    light = free.flux + 144 * free.background
    assert light == pytest.approx(dae.flux + 144 * dae.background, nan_ok=True)
    assert (free.flags[bright] & StarFlag.UNLIKE_TRAINING > 0).mean() < 0.02
    blends = 0.7 * noisy + 0.3 * np.roll(noisy, 5, axis=2)
    strange, far = (
        PsfModel(b).predict(blends[bright], noise=noise[bright]) for b in (bundle, tiny)
    )
    both = [(found.flags & StarFlag.UNLIKE_TRAINING > 0).mean() for found in (strange, far)]
    assert both[0] > 0.1 > both[1]
    assert np.isfinite(strange.outlier_score).mean() > 0.9 and np.isnan(far.outlier_score).all()
    one = PsfModel(bundle).predict(noisy[7], flux=1.0, background=0.0, noise=noise[7])
    np.testing.assert_allclose(one.psf[0], found.psf[7], atol=1e-6)


@pytest.mark.parametrize("told", [(), ("noise",), ("background", "noise")])
def test_bright_pixels_are_covered_as_the_others_are(tiny, told):
    """Of unseen stars, whatever is known of them beside their flux."""
    images, rng = gaussians(1500, 99), np.random.default_rng(5)
    model = PsfModel(tiny)
    for noise in (6e-3, 1.5e-2):
        noisy = images + noise * rng.normal(size=images.shape) + 3.0
        known = {"background": 3.0, "noise": noise}
        found = model.predict(noisy, **{name: known[name] for name in told})
        kept = np.isfinite(found.psf).all(axis=(1, 2))
        error, width = np.abs(found.psf - images)[kept], found.uncertainty[kept]
        bright = brightest(found.psf[kept])
        assert bright.mean() == pytest.approx(20 / 256, abs=0.01)
        both = (found.ratio95_bright, bright), (found.ratio95, ~bright)
        for ratio, pixels in both:
            wide = width * ratio[kept, None, None]
            assert (error <= width)[pixels].mean() == pytest.approx(0.683, abs=0.03)
            assert (error <= wide)[pixels].mean() == pytest.approx(0.95, abs=0.02)


def test_signal_to_noise_is_that_of_a_matched_filter():
    """The flux of the mean PSF in white noise scatters by 1 / (S/N) of itself."""
    mean = gaussians(1, 3)[0].astype(np.float64)
    noise = 0.01
    images = mean + np.random.default_rng(0).normal(0, noise, size=(20000, 12, 12))
    flux = (images * mean).sum(axis=(1, 2)) / (mean**2).sum()
    area = noise_equivalent_px(mean)
    assert 1 / flux.std() == pytest.approx(signal_to_noise(noise, area), rel=0.03)
    flat = np.full((12, 12), 1 / 144)
    assert noise_equivalent_px(flat) == pytest.approx(144)


def test_errors_of_some_stars_are_those_stars_errors():
    """Images repeat the stars; a mask over stars keeps every image of those, and no other."""
    star = np.array([0, 1, 2, 3, 4, 0, 1, 2, 3, 4])
    error = np.arange(10.0)[None, :, None, None] + np.zeros((2, 10, 4, 4))
    distance = 100.0 + np.arange(20.0).reshape(2, 10)
    some = packing.Errors(np.array([1.0, 2.0]), error, star, distance).of(
        np.array([False, True, False, False, True])
    )
    assert some.star.tolist() == [1, 4, 1, 4]
    assert (some.error[:, :, 0, 0] == [1, 4, 6, 9]).all()
    assert (some.distance == [[101, 104, 106, 109], [111, 114, 116, 119]]).all()


def test_either_half_of_the_stars_is_judged_by_the_errors_of_the_other():
    """Even stars err by σ, odd ones by 3σ: ± σ holds 26 % of these, ± 3σ 99.7 % of those."""
    rng, star = np.random.default_rng(0), np.tile(np.arange(400), 10)
    scale = np.where(star % 2, 3.0, 1.0)[:, None, None]
    error = rng.normal(size=(1, 4000, 8, 8)) * scale
    errors = packing.Errors(np.array([0.01]), error, star, np.zeros((1, 4000)))
    fresh = rng.normal(size=(400, 8, 8)) * scale[:400]
    found = packing.crossed_coverage(errors, fresh, 0.01)
    expected = (0.9973 + 0.2611) / 2
    wanted = {"coverage68": expected, "coverage_rms": expected, "coverage95": (1 + 0.4865) / 2}
    assert found == pytest.approx(wanted, abs=0.01)


def test_errors_between_nodes_are_interpolated_and_held_outside():
    nodes, maps = np.array([1.0, 2.0, 4.0]), np.arange(12.0).reshape(3, 2, 2)
    found = at_noise(np.array([1.0, 1.5, 3.0, 4.0, 9.0, 0.1, np.nan]), nodes, maps)
    expected = [maps[0], (maps[0] + maps[1]) / 2, (maps[1] + maps[2]) / 2, maps[2], maps[2]]
    assert found[:5] == pytest.approx(np.stack(expected))
    assert (found[5] == maps[0]).all()
    assert np.isnan(found[6]).all()
    assert (at_noise(np.array([0.5, 7.0]), np.array([1.0]), maps[:1]) == maps[0]).all()


def test_distance_is_the_number_of_components_whatever_the_noise():
    model = FluxModel.fit(gaussians(4000, 4))
    fresh, rng = gaussians(2000, 5), np.random.default_rng(6)
    for noise in (1e-4, 3e-3, 5e-2):
        noisy = fresh + rng.normal(0, noise, fresh.shape)
        squared = mahalanobis(noisy, np.full(2000, noise), model, 20) ** 2
        assert squared.mean() == pytest.approx(20, rel=0.1)


def test_strange_stars_are_farther_than_any_of_the_training_set(tiny):
    stars = gaussians(200, 7)
    noise = np.full(200, 5e-3)
    rng = np.random.default_rng(8)
    blends = 0.5 * (stars + np.roll(stars, 5, axis=2))
    info, model = tiny.info, tiny.flux_model
    near, far = (
        mahalanobis(images + rng.normal(0, 5e-3, stars.shape), noise, model, info.components)
        for images in (stars, blends)
    )
    assert (near > tiny.distance_limit).mean() < 0.02
    assert (far > tiny.distance_limit).mean() > 0.6


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("noise.kappa=5", r"trained with noise\.kappa=4\.98, .* asked for with noise\.kappa=5\.0"),
        ("seed=3", r"trained with seed=20200611, .* asked for with seed=3"),
        ("parts.test_stars=300", r"parts\.test_stars=400"),
    ],
)
def test_network_of_another_training_is_refused(folder, tmp_path, override, message):
    with pytest.raises(BundleError, match=message):
        pack(folder, tmp_path / "x", [override])
    with pytest.raises(BundleError, match=r"split=random, .* split=held_out"):
        pack(folder, tmp_path / "x", split="held_out")


def test_stars_that_say_too_little_are_refused(folder, tmp_path):
    stars = write_stars(tmp_path / "s.h5", {"telescope": {}, "framing": {"jitter_px": 1}})
    with pytest.raises(ProductError, match=r"s\.h5: its configuration lacks 'pixel_scale_arcsec'"):
        pack(folder, tmp_path / "x", stars=stars)


def test_missing_network_is_one_line_and_exit_code_2(folder, tmp_path):
    arguments = ["bundle", "--stars", str(folder / "stars.h5"), "--dae", str(tmp_path)]
    result = CliRunner().invoke(main, [*arguments, "--out", str(tmp_path / "x")])
    assert result.exit_code == 2
    assert (
        result.output
        == f"psfdae: {tmp_path}/dae.safetensors: no such file; psfdae train writes it\n"
    )


def test_commands_pack_describe_and_export(folder, tmp_path):
    """The same by the command line; the ONNX file computes what torch does."""
    path, onnx = tmp_path / "mine.psf.safetensors", tmp_path / "mine.onnx"
    inputs = ["--stars", str(folder / "stars.h5"), "--dae", str(folder / "dae")]
    runner = CliRunner()
    result = runner.invoke(main, ["bundle", *inputs, "--out", str(path), *TINY])
    assert result.exit_code == 0, result.output
    said = runner.invoke(main, ["describe", str(path)]).output
    for fact in ("mine", "12 × 12 px of 0.1 arcsec (0.881 λ/D)", "not stated", "1000 simulated"):
        assert fact in said
    card = runner.invoke(main, ["describe", str(path), "--card"]).output
    assert "1000 simulated stars" in card and "the maker stated none" in card.lower()
    result = runner.invoke(main, ["export", str(path), "--out", str(onnx)])
    assert result.exit_code == 0, result.output
    images = gaussians(5, 11)
    found = dae_network.session(onnx, threads=1).run(None, {"images": images})[0]
    expected = estimator(read_bundle(path)).predict(images)
    assert np.abs(found - expected).max() <= dae_network.ONNX_TOLERANCE * expected.max()


def test_export_of_a_wrong_network_fails_and_leaves_no_file(folder, tmp_path, monkeypatch):
    plain = dae_network._plain

    def wrong(layer):
        changed = plain(layer)
        changed.weight = torch.nn.Parameter(changed.weight * 1.001)
        return changed

    monkeypatch.setattr(dae_network, "_plain", wrong)
    with pytest.raises(dae_network.ExportError, match="differs from torch"):
        describe.export(folder / "tiny.psf.safetensors", out=tmp_path / "x.onnx")
    assert list(tmp_path.iterdir()) == []


def test_shipped_bundle_is_small_and_wide():
    bundle = read_bundle()
    assert bundle.info.name == "wfsat"
    assert shipped_path().stat().st_size <= stage.LARGEST_SHIPPED
    assert bundle.info.subpixel
    assert bundle.info.snr_min < 5
    assert bundle.info.snr_max > 500
    faint = [row for row in bundle.info.metrics if row["snr"] < 50]
    assert len(faint) >= 3
    assert all(row["mse"] < 0.2 * row["mse_noisy"] for row in faint)
    for row in bundle.info.metrics:
        assert row["coverage68"] == pytest.approx(0.6827, abs=0.05)


def test_shipped_bundle_covers_stars_that_nobody_has_seen(tmp_path):
    """New stars of the same telescope, from another seed."""
    from psfdae.files import read_product
    from psfdae_paper.stages import stars

    sizes = ["seed=11", "grid.points=5", "grid.spacing_deg=2.75", "stars.count=500"]
    chosen = ["dataset=field", *sizes, "parts.train_stars=400", "parts.test_stars=100"]
    stars.templates(load_stage(STATIC, chosen), tmp_path / "t.h5")
    stars.stars(load_stage(SIMULATION, chosen), tmp_path / "t.h5", tmp_path / "s.h5")
    images = read_product(tmp_path / "s.h5", "stars", ("realisation",))["realisation"]
    bundle, rng = read_bundle(), stream(11, "coverage")
    band = np.log([bundle.info.noise_min, bundle.info.noise_max])
    noise = np.exp(rng.uniform(*band, size=len(images)))
    config = load_stage(stage.bundle.stage.settings.reads, chosen)
    noisy = noise_model(config).draw(images, noise / config.noise.kappa, rng)
    level = noise / config.noise.kappa
    estimate = estimator(bundle).estimate(noisy, level)
    error = np.abs(estimate.psf - images) / (1.0 if estimate.sigma is None else estimate.sigma)
    covered = packing.coverage(error, noise, bundle.noise_nodes, bundle.error68)
    assert covered == pytest.approx(0.6827, abs=0.05)
    assert packing.coverage(error, noise, bundle.noise_nodes, bundle.rms) > 0.75


def test_ship_names_checks_and_writes(folder, tiny, tmp_path, capsys):
    """The bundle that errs least on the validation stars, of a fit that has not seen them."""
    config = load_stage(stage.ship.stage.settings.reads, TINY)
    given = {"stars": folder / "stars.h5", "out": tmp_path / "bundles"}
    weights = {name: 0 * array for name, array in tiny.weights.items()}
    write_bundle(replace(tiny, weights=weights), tmp_path / "none.psf.safetensors")
    worse, better = tmp_path / "none.psf.safetensors", folder / "tiny.psf.safetensors"
    stage.ship(config, (worse, better), **given)
    said = [
        float(line.split("MSE ")[1].split()[0]) for line in capsys.readouterr().out.splitlines()[:2]
    ]
    assert said[0] > 2 * said[1]
    assert read_bundle(tmp_path / "bundles/wfsat.psf.safetensors").weights.keys() == weights.keys()
    (out,) = (tmp_path / "bundles").iterdir()
    assert out.name == "wfsat.psf.safetensors"
    assert read_bundle(out).info.licence == "MIT"
    rows = [row | {"coverage68": 0.5} for row in tiny.info.metrics]
    poor = replace(tiny, info=tiny.info.model_copy(update={"metrics": rows}))
    write_bundle(poor, tmp_path / "poor.psf.safetensors")
    with pytest.raises(BundleError, match=r"error68 holds 50\.0% of the errors"):
        stage.ship(config, (tmp_path / "poor.psf.safetensors",), **given)


def test_half_widths_beside_the_stars_own_noise_are_above_0_and_hold_two_thirds_or_more():
    """Own noise three times the method's errors: most of these are hidden in it, star by star."""
    rng = np.random.default_rng(6)
    own, error = 3e-3, 1e-3
    zero = np.zeros((2000, 8, 8), np.float32)
    own_noise = np.full(zero.shape, own)
    of = NoiseModel(1.0, 1e4), np.zeros((2000, 4)), np.zeros(2000), own_noise
    stars = packing.HeldOutStars(zero, rng.normal(0, own, zero.shape), *of)
    psf = rng.normal(0, error, zero.shape)
    few = np.arange(40)
    measured = packing.Errors(
        np.ones(1), stars.errors(psf[few], few)[None], few, np.ones((1, few.size))
    )
    width = measured.half_width()
    assert width.min() > 0 and 0.1 * own < width.mean() < 0.7 * own
    assert packing.coverage(stars.errors(psf), np.ones(2000), np.ones(1), width) == pytest.approx(
        0.72, abs=0.05
    )
