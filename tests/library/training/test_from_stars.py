"""Training on the bright stars of an image: which stars, which images, which model."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from command_line import printed, psfdae, refused
from docs_pages import blocks, commands, read
from fits_inputs import write_cube
from image_training import RECIPE, SIZE_WORDS, WORDS, few_draws
from psfdae.base.files import read_product, write_product
from psfdae.base.rng import stream
from psfdae.commands import train as stage
from psfdae.commands.train import lock_folder
from psfdae.denoise.bundle import read_bundle
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.image.selection import collect
from psfdae.image.stamps import cut
from psfdae.methods import list_groups, method
from psfdae.report.validation import Report
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.moments import shift_stamps
from psfdae.stars.noise import NoiseModel, OwnNoise
from psfdae.stars.splits import held_out_fields
from psfdae.training.settings import from_words
from psfdae.training.star_sets import split_stars
from psfdae.training.training_images import make_images, star_grid, training_columns
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.stages import simulate
from psfdae_paper.stars.example import FieldRecipe, example_field, star_images

TINY = ["preset=smoke", *SIZE_WORDS, "train.epochs=1"]


@pytest.fixture(scope="module")
def config():
    return from_words(WORDS)


@pytest.fixture(scope="module")
def made(training):
    """The truth of the simulated image."""
    return training.truth()


@pytest.fixture(scope="module")
def candidates(training, config):
    observation = open_observation(ImageInput(training.image, catalogue=training.catalogue), 16, 8)
    return collect(observation, config.calibration_stars, config.framing)


@pytest.fixture(scope="module")
def network(training, tmp_path_factory):
    """Folder of a model whose method was named."""
    out = tmp_path_factory.mktemp("network") / "model"
    words = [*training.words, "--out", out, *TINY, "methods=[noisy,dae]", "--method", "dae"]
    with few_draws():
        result = run(*words)
    assert result.exit_code == 0 and "validation stars" not in result.output, result.output
    return out


# Measuring


def test_star_of_a_perfect_telescope_lies_where_it_was_put():
    """Its centre of light, from the middle of the pixel nearest to the position."""
    position = np.array([[300.0, 400.0], [310.3, 399.8], [299.6, 405.45], [301.49, 288.52]])
    images = star_images(FieldRecipe(seidel=(0.0,) * 5), position)
    axis = np.arange(32) - 16  # of stamps of 32 px
    centre = np.stack([images.sum(axis=1) @ axis, images.sum(axis=2) @ axis], axis=1)
    assert centre == pytest.approx(position - np.rint(position), abs=0.02)


def test_example_is_reproducible_and_has_the_noise_that_it_states():
    recipe = FieldRecipe(**{**RECIPE, "bright": 5, "faint": 5, "blended": 0, "saturated": 1})
    example, repeated = example_field(recipe, 3), example_field(recipe, 3)
    assert (example.image == repeated.image).all()
    assert (example.image != example_field(recipe, 4).image).any()
    is_sky = np.ones(example.image.shape, dtype=bool)
    for column, row in np.rint(example.position).astype(int):
        is_sky[max(row - 30, 0) : row + 31, max(column - 30, 0) : column + 31] = False
    middle = is_sky.copy()
    middle[:, :300] = middle[:, 400:] = False
    sky = example.image[middle].astype(float) * recipe.gain
    variance = recipe.sky_e + recipe.read_noise_e**2 + recipe.gain**2 / 12
    assert sky.mean() == pytest.approx(recipe.sky_e, rel=0.01)
    assert sky.var() == pytest.approx(variance, rel=0.03)
    assert example.image.max() == recipe.saturation


def test_selection_keeps_good_stars_only(made, candidates):
    verdict = pd.Series(candidates.verdict)
    good = verdict == "good"
    assert (made.kind[good] == "bright").mean() == 1.0
    assert (verdict[made.kind == "saturated"] == "saturated").all()
    assert good.sum() > 0.6 * (made.kind == "bright").sum()
    assert (candidates.bright.row == np.flatnonzero(good)).all()
    assert candidates.snr[good].min() >= 100.0


def test_what_the_list_says_against_a_star_counts(training, candidates, config, tmp_path):
    """SExtractor's flags, and rows without a position; the other stars stay good."""
    listed = pd.read_csv(training.catalogue).assign(FLAGS=0)
    good = candidates.bright.row[:5]
    listed.loc[good[:4], "FLAGS"] = [1, 2, 7, 8]
    listed.loc[good[4], "X_IMAGE"] = np.nan
    listed.drop(columns=["ra", "dec"]).to_csv(tmp_path / "stars.csv", index=False)
    observation = open_observation(
        ImageInput(training.image, catalogue=tmp_path / "stars.csv"), 16, 8
    )
    verdict = collect(observation, config.calibration_stars, config.framing).verdict
    assert verdict[good].tolist() == [
        *("good", "blended", "saturated", "incomplete", "no position"),
    ]
    refused_rows = np.setdiff1d(candidates.bright.row, good)
    assert (verdict[refused_rows] == "good").mean() > 0.95
    assert f"no position in row {good[4] + 1}: flagged" in observation.summary()


def test_product_stars_is_what_the_stages_read(candidates, config, tmp_path):
    bright = candidates.bright
    grid = star_grid(bright.position)
    held_out = held_out_fields(grid)
    out = tmp_path / "stars.h5"
    columns = []
    for _ in range(2):
        rng = stream(config.seed, "own stars")
        shape = (config.framing, config.parts)
        write_product(out, "stars", training_columns(bright, grid, held_out, 2, *shape, rng), {})
        columns.append(out.read_bytes())
    assert columns[0] == columns[1]
    product = read_product(out, "stars")
    parts = split_stars(product, "held_out", config)
    assert parts.train.size == 120
    assert set(product["field_index"][parts.test]) == set(np.flatnonzero(held_out))
    assert not {*product["field_index"][parts.fit]} & {*product["field_index"][parts.validation]}


def test_held_out_stars_are_the_truth_but_for_their_noise(made, candidates):
    bright = candidates.bright
    framing = SimpleNamespace(stamp_px=16, jitter_px=0)
    still = np.zeros(len(bright), dtype=bool)
    images, *_ = make_images(
        bright, bright.stamps, np.arange(len(bright)), framing, still, stream(1, "t")
    )
    for image, row, noise in zip(images, bright.row, bright.noise / bright.flux, strict=True):
        error = best_match(made.psf[row], image)
        photons = 1 / (made.flux[row] * 256)
        assert error < 3 * (noise**2 + photons)


def best_match(psf, image):
    """Least MSE of an image against all pieces of the noise-free star near its middle."""
    offsets = np.array([(i, j) for i in range(-3, 4) for j in range(-3, 4)])
    pieces = cut(np.broadcast_to(psf, (len(offsets), *psf.shape)), image.shape[-1], offsets)
    pieces = pieces / pieces.sum(axis=(1, 2), keepdims=True)
    return np.square(pieces - image).mean(axis=(1, 2)).min()


# The command


def run(*words):
    return psfdae("train", *words)


def test_command_leaves_a_model_and_a_report(training):
    out = training.out
    report = pd.read_csv(out / "report.csv")
    assert list(report.columns) == (
        ["snr", "noise", "method", "mse", "mse_stderr", "ssim", "images", "stars", "truth_mse"]
    )
    assert report.snr.unique() == pytest.approx([5, 10, 20, 50])
    selection = pd.read_csv(out / "selection.csv")
    assert (report.stars == (selection.part == "held out").sum()).all()
    noisy = report[report.method == "noisy"]
    # Sky σ² and the star's own photons, 1/F of the flux over all pixels.
    assert (noisy.mse / noisy.noise**2).between(0.95, 1.25).all()
    info = read_bundle(training.bundle).info
    assert info.source == "stars" and info.pixel_lambda_d is None
    assert info.pixel_scale_arcsec == pytest.approx(1.2)
    assert info.snr_min == pytest.approx(5, rel=1e-3)
    errors = dict(re.findall(r"(.+): MSE (\S+) on validation stars", training.output))
    title = method(info.method).look.title
    assert len(errors) == 2 and float(errors[title]) == min(map(float, errors.values()))


def test_the_method_may_be_named_and_settings_used_by_hand(network, tmp_path):
    (path,) = network.glob("*.psf.safetensors")
    assert read_bundle(path).info.method == "dae"
    overrides = (network / "overrides.txt").read_text().split()
    noise = load_stage(list_groups("dae"), overrides).noise
    assert noise.kappa == 1.0 and len(noise.levels) == 4
    by_hand = ["fit", "dae", "--stars", network / "stars.h5", "--split", "held_out"]
    words = [*by_hand, "--out", tmp_path / "dae", *overrides]
    assert psfdae(*words).exit_code == 0
    weights = "dae/dae.safetensors"
    assert (tmp_path / weights).read_bytes() == (network / weights).read_bytes()


def test_own_noise_is_what_moving_and_dividing_leave_of_it():
    """The covariance is that of many noisy images of one star, and of few stars in many."""
    rng, grid, count = np.random.default_rng(3), np.arange(24) - 12, 6000
    profile = np.exp(-(grid[:, None] ** 2 + grid**2) / 8)
    profile /= cut(profile[None], 8).sum()
    sky, background = 0.004, 1.0
    rms = np.sqrt(sky**2 + sky / background**0.5 * profile)
    phase = rng.uniform(-0.5, 0.5, (count, 2))
    noise = shift_stamps(rms * rng.normal(size=(count, 24, 24)), phase)
    clean, noisy = (
        cut(shift_stamps(profile[None].repeat(count, 0), phase) + n, 8) for n in (0.0, noise)
    )
    error = noisy / noisy.sum((1, 2), keepdims=True) - clean / clean.sum((1, 2), keepdims=True)
    covariance = error.reshape(count, -1).T @ error.reshape(count, -1)
    everyone, star_sky = np.arange(count), np.full(count, sky)
    mean = clean.mean(axis=0).ravel()
    model = OwnNoise(star_sky, background, phase, everyone)(everyone, mean / mean.sum())
    assert np.trace(model) == pytest.approx(np.trace(covariance), rel=0.05)
    assert np.abs(model - covariance).max() < 0.1 * covariance.max()
    four_stars = OwnNoise(star_sky, background, phase, everyone % 4)(everyone, mean / mean.sum())
    assert four_stars == pytest.approx(0.75 * model, rel=0.1, abs=0.01 * model.max())


def test_a_model_is_replaced_on_request_only(training, tmp_path):
    out = tmp_path / "model"
    shutil.copytree(training.out, out)
    bundle_file = out / training.bundle.name
    words = [*training.words, "--out", out, *WORDS, "--method", "gmm"]
    bytes_before = {path: path.read_bytes() for path in out.rglob("*")}
    message = refused("train", *words, "--name", "other")
    assert str(bundle_file) in message and "--overwrite" in message
    assert {path: path.read_bytes() for path in out.rglob("*")} == bytes_before
    with few_draws():
        result = run(*words, "--overwrite")
    assert result.exit_code == 0, result.output
    assert read_bundle(bundle_file).info.method == "gmm"
    # The picture of the earlier model would be wrong, and without --report there is no other one.
    assert set(out.rglob("*")) == bytes_before.keys() - {out / "report.png"}


def test_a_killed_command_leaves_no_output_and_is_repeated(training, tmp_path, monkeypatch):
    """All outputs get their names at the end, the bundle last."""
    out, page = tmp_path / "model", tmp_path / "page.html"
    shutil.copytree(training.out, out)
    bundle_file = out / training.bundle.name
    bundle_file.unlink()
    monkeypatch.setattr(stage, "fit_method", lambda stars, kind, _: kind.load(out / "field.h5"))
    monkeypatch.setattr(stage, "pack_model", lambda *args: training.model)
    monkeypatch.setattr(Report, "page", lambda self: "page")
    words = [*training.words, "--out", out, "--report", page, *WORDS]
    words += ["methods=[noisy,field]", "--method", "field"]
    save = Report.save

    def killed(*args):
        save(*args)
        os.kill(os.getpid(), signal.SIGKILL)

    if (child := os.fork()) == 0:
        monkeypatch.setattr(Report, "save", killed)
        run(*words)
        os._exit(1)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    assert not bundle_file.exists() and not page.exists()
    process = run(*words)
    assert process.exit_code == 0, process.output
    assert bundle_file.read_bytes() == training.bundle.read_bytes()


@pytest.mark.parametrize("gain", [1e-9, 1e300])
def test_the_sky_of_any_gain_can_be_drawn(gain):
    """A header may say GAIN = 1e12: nothing draws 1e26 photons."""
    stars = BrightStars(*[np.ones(30)] * 10)
    noise = NoiseModel(1.0, stars.sky_photons(gain, 1e4))
    psf = np.full((20, 16, 16), 1 / 256)
    residual = noise.draw(psf, 0.05, stream(1, "gain")) - psf
    assert residual.std() == pytest.approx(np.sqrt(noise.variance(psf, 0.05).mean()), rel=0.05)


def test_one_process_at_a_time_works_in_a_folder(training, tmp_path):
    """Whoever holds the folder is alone, until its process ends in whatever way."""
    holder = (
        "import sys, time; from pathlib import Path\n"
        "from psfdae.commands.train import lock_folder\n"
        "with lock_folder(Path(sys.argv[1])): print('mine', flush=True); time.sleep(600)"
    )
    out = tmp_path / "model"
    words = [sys.executable, "-c", holder, str(out)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "mine\n"
        message = refused("train", *training.words, "--out", out, *WORDS)
        process.kill()
    assert str(out) in message
    with lock_folder(out):
        assert list(out.iterdir()) == []
    assert not out.exists()


def test_a_cube_of_stamps_will_do(candidates, tmp_path):
    sky = np.random.default_rng(1).normal(100, 1, (len(candidates.bright), 32, 32))
    stamps = (candidates.bright.stamps + sky).astype(np.float32)
    write_cube(tmp_path / "cube.fits", stamps[:, 3:29, 3:29], PIXSCALE=1.2)
    with few_draws():
        result = run(tmp_path / "cube.fits", "--out", tmp_path / "m", *WORDS, "--method", "gmm")
    assert result.exit_code == 0, result.output
    assert read_bundle(tmp_path / "m/cube.psf.safetensors").info.stamp_px == 16


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{image}"], "needs --catalogue, a list of its stars"),
        (
            ["{image}", "--catalogue", "{stars}", "calibration_stars.stars_min=1000"],
            "--stars-min takes fewer",
        ),
        (["{image}", "--catalogue", "{stars}", "--method", "pca_som"], "--method"),
        (["{image}", "calibration_stars.snr_levels=[10,5]"], "snr_levels"),
        (["none.fits", "--catalogue", "{stars}"], "none.fits"),
        (["cube.fits"], "4 faint"),
    ],
)
def test_what_cannot_be_used_ends_in_one_line(training, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    write_cube("cube.fits", np.ones((4, 16, 16), np.float32))
    words = [word.format(image=training.image, stars=training.catalogue) for word in words]
    assert message in refused("train", *words, "--out", "model")
    assert [path.name for path in tmp_path.iterdir()] == ["cube.fits"]


@pytest.mark.slow
@pytest.mark.workflow
@pytest.mark.parametrize("page", ["docs/training", "docs/photometry"])
def test_commands_of_pages_run(page, tmp_path, monkeypatch):
    """The commands run from first to last, on a small image and a tiny network."""
    text = read(f"{page}.md")
    steps = [line.words for line in commands(text) if line.words[0] == "psfdae"]
    assert {"example", "train", "predict"} <= {step[1] for step in steps}
    small = {
        "example": ["--side=700", "--bright=60", "--faint=80"],
        "train": [*TINY, "methods=[noisy,gmm,field]"],
        "predict": ["--quiet"],
    }
    monkeypatch.chdir(tmp_path)
    for _, name, *rest in steps:
        if "sparse.fits" in rest:
            shutil.copy("image.fits", "sparse.fits")
        words = [name, *rest, *small.get(name, [])]
        printed(*words)
    names: dict[str, Any] = {}
    for body in blocks(text, "python"):
        exec(compile(body, page, "exec"), names)
    if "fluxes" in names:
        assert np.median(names["fluxes"]["flux_fit"] / names["stars"]["flux"]) == pytest.approx(
            1.0, abs=0.05
        )


@pytest.mark.slow
def test_one_command_beats_the_noisy_star_and_the_baseline(tmp_path):
    """Show 4: 300 bright stars, 16 × 16 px, held-out stars at S/N 10, minutes of one core."""
    image, catalogue, out = (tmp_path / name for name in ("i.fits", "s.csv", "model"))
    simulate.write_example(image, catalogue, seed=1)
    words = [image, "--catalogue", catalogue, "--out", out]
    words += ["methods=[noisy,pca_som,dae]", "train.epochs=12", "parts.train_stars=2000"]
    assert run(*words).exit_code == 0
    report = pd.read_csv(out / "report.csv").set_index(["method", "snr"])
    dae, baseline, noisy = (report.loc[m] for m in ("dae", "pca_som", "noisy"))
    assert (dae.mse + 3 * dae.mse_stderr < baseline.mse - 3 * baseline.mse_stderr).all()
    ten = dae.index[np.abs(dae.index - 10).argmin()]
    assert dae.mse[ten] < 0.5 * baseline.mse[ten]
    assert dae.mse[ten] < 0.03 * noisy.mse[ten]
