"""Benchmarks: optics beside other programs, error budgets in use, and the tables on request."""

from __future__ import annotations

import sys

import click
import numpy as np
import pandas as pd
import pytest
from astropy.io import fits
from click.testing import CliRunner

import costs
import figures
import image_costs
import propagators
import scenes
from psfdae.base.files import ProductError
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.stars.framing import normalise_flux

COMATIC, FIELD = np.array([0.3, 0.8, 0.6, 0.4, -0.1]), np.array([0.6, -0.4])


# Optics


@pytest.fixture(scope="module")
def case():
    """A comatic star well off the chief ray, with its exact stamp."""
    source, fine = seidel_wavefronts(COMATIC[None], FIELD[None]), annular_pupil(512, 0.3)
    offset = np.array([[3, -5]])
    exact = StampPropagator(fine, 10, 0.88, extra=16)
    opd = source.opd(np.zeros(1, int), fine, np.dtype(float))
    truth = normalise_flux(exact(opd, offset))[0][0]
    return scenes.Case("seidel", "mild", source, offset, 160, 10, 0.88, 0.3, 1e-9, truth)


@pytest.mark.parametrize("method", ["fft", "fft_pruned", "poppy_mft", "poppy_fresnel", "hcipy"])
def test_peers_converge_to_our_stamp_with_their_subsamples(case, method):
    """Same orientation, same place, and an error that falls as 1/subsamples²."""

    def error(subsamples):
        setting = propagators.Setting(method, case.samples, subsamples)
        _, propagate = propagators.build(case, setting)
        return scenes.compare_to_peak(propagate(), case.truth)

    coarse, fine = error(4), error(8)
    assert fine < 2.5e-3
    assert coarse / fine == pytest.approx(4.0, rel=0.2)


@pytest.mark.parametrize(
    ("dataset", "worst_stars"),
    [("dataset4", [7144, 642, 6364, 3655]), ("dataset7", [286, 365, 157])],
)
def test_configured_optics_stay_within_the_error_budget(dataset, worst_stars):
    """Datasets whose stars must fit the least noise; `screen` finds their worst stars."""
    scene = scenes.Scene.of(load_stage(scenes.READS, [f"dataset={dataset}"]))
    selection = scenes.Selection(scene.stars, np.array(worst_stars))
    stamps, offset = scene.propagation(selection, scene.search_px).frame(scene.framing.stamp_px)
    exact = scenes.simulate_stamps(scene, selection, offset, *scenes.REFERENCES[-1])
    assert scenes.stamp_mse(normalise_flux(stamps)[0], exact).max() <= scene.budget


def test_knee_is_the_last_training_whose_time_is_worth_its_error():
    """Twice the time must lower the error by a tenth, or four times by a fifth."""
    # From 2 s to 4 s it falls by 6 % only.
    assert costs.knee(np.array([1.0, 2.0, 4.0, 8.0]), np.array([1.0, 0.8, 0.75, 0.7])) == 1


# Images


@pytest.mark.parametrize("depth", [0, 2])
def test_the_cost_of_a_command_is_its_own_with_the_processes_that_it_starts(tmp_path, depth):
    """Memory of 200 MB and 0.3 s of CPU time; a failure ends with what it printed."""
    program = "import time; block = bytearray(200_000_000)\nwhile time.process_time() < 0.3: pass"
    words = [sys.executable, "-I", "-S", "-c", program]
    for _ in range(depth):
        text = f"import subprocess; subprocess.run({words}, check=True)"
        words = [sys.executable, "-I", "-S", "-c", text]
    # The memory of this process, which starts it, does not count.
    block = np.ones(40_000_000)
    cost = image_costs.measure_process(words, tmp_path, {})
    assert 200 < cost["peak_mb"] < 260 < block.nbytes / 1e6
    assert 0.3 <= cost["cpu_s"] < 3.0
    with pytest.raises(click.ClickException, match="no such tool"):
        failure = "raise SystemExit('no such tool')"
        image_costs.measure_process([sys.executable, "-c", failure], tmp_path, {})


def test_an_earlier_commit_has_the_name_that_its_command_had(tmp_path):
    (tmp_path / "new/src/psfdae/commands").mkdir(parents=True)
    (tmp_path / "new/src/psfdae/commands/train.py").touch()
    trees = {"now": tmp_path / "new", "earlier": tmp_path / "old"}
    runs = [*image_costs.list_own_runs(tmp_path / "i.fits", trees, tmp_path)]
    names = {tool: words[3] for tool, step, words, _ in runs if step == "train"}
    assert names == {"now": "train", "earlier": "from-stars"}


def test_every_tool_gets_the_same_pixels_of_a_compressed_image(tmp_path):
    """SExtractor reads no compressed file; names of images may have dots."""
    image, folder = np.arange(6.0).reshape(2, 3), tmp_path / "copies"
    folder.mkdir()
    for name in ("m67.r.fits", "m67.r.fits.gz", "m67.r.fit"):
        fits.writeto(tmp_path / name, image, overwrite=True)
        copy = image_costs.write_image(tmp_path / name, folder)
        assert copy == folder / "m67.r.fits"
        assert copy.read_bytes()[:6] == b"SIMPLE"
        np.testing.assert_array_equal(fits.getdata(copy), image)


def test_growth_shows_the_slope_of_the_largest_images():
    """Twice the stars take twice the time, and more pixels as much as before."""
    sizes = [(10, 1e6), (100, 1e6), (200, 1e6), (100, 4e6)]
    rows = [
        {"tool": "psfdae", "step": step, "stars": stars, "pixels": pixels}
        | {"cpu_s": max(stars, 100.0), "peak_mb": 300.0}
        for stars, pixels in sizes
        for step in ("train", "photometry")
    ]
    rows_of_psfex = [{**row, "tool": "psfex", "cpu_s": 1.0} for row in rows]
    figure = figures.image_growth(pd.DataFrame([*rows, *rows_of_psfex, {**rows[0], "cpu_s": None}]))
    labels = [[line.get_label() for line in axes.lines] for axes in figure.axes]
    assert labels[0] == ["train, slope 1.00", "photometry, slope 1.00"]
    assert labels[1] == ["train, slope 0.00", "photometry, slope 0.00"]


def test_a_tool_that_fails_has_rows_without_costs(tmp_path, monkeypatch):
    """The message says how many failed, even if nothing is left for the figure."""

    def fail(*arguments):
        raise click.ClickException("no such tool")

    monkeypatch.setattr(image_costs, "measure_process", fail)
    monkeypatch.setattr(image_costs, "extract_commit", lambda *arguments: image_costs.ROOT)
    monkeypatch.setattr(image_costs, "list_peer_runs", lambda *arguments: [])
    options = ["--fields", "128:20", "--growth", "", "--results", str(tmp_path)]
    run = CliRunner().invoke(image_costs.compare_tools, options)
    assert run.exit_code == 1
    assert "4 of 4 commands failed" in run.output
    table = pd.read_csv(tmp_path / "tables/benchmark_images.csv")
    assert table["cpu_s"].isna().all() and (table["stars"] == 20).all() and len(table) == 4


def test_each_image_has_its_own_rows_whatever_its_folder(tmp_path, monkeypatch):
    """Two images of one name shared a row of the ratios; the same image again is one."""
    paths = [tmp_path / name for name in ("a/field.fits", "b/field.fits", "b/s64_9.fits", "c.fits")]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        fits.writeto(path, np.zeros((4, 5)))
    names = image_costs.name_images([(64, 9), *paths])
    assert names == ["s64_9", "a/field.fits", "b/field.fits", "b/s64_9.fits", "c"]
    cost = iter([1.0, 2.0, 4.0, 4.0, 8.0, 1.0, 3.0, 6.0])
    monkeypatch.setattr(image_costs, "extract_commit", lambda *arguments: image_costs.ROOT)
    monkeypatch.setattr(image_costs, "list_peer_runs", lambda *arguments: [])
    monkeypatch.setattr(
        image_costs, "measure_process", lambda *_: {"cpu_s": next(cost), "peak_mb": 1.0}
    )
    words = [*map(str, (*paths[:2], paths[0])), "--fields", "", "--growth", ""]
    run = CliRunner().invoke(image_costs.compare_tools, [*words, "--results", str(tmp_path / "r")])
    # train and photometry of psfdae, then of the earlier commit.
    text = " ".join(run.output.split("CPU time over the earlier commit's:")[1].split())
    assert text.startswith("image step a/field.fits train 0.25 photometry 0.50")
    assert text.endswith("b/field.fits train 2.67 photometry 0.17")


def test_no_image_at_all_ends_in_one_line(tmp_path):
    options = ["--fields", "", "--growth", "", "--results", str(tmp_path)]
    run = CliRunner().invoke(image_costs.compare_tools, options)
    assert run.exit_code == 2 and "no image: name one" in run.output


@pytest.mark.parametrize("text", ["512", "512:x", "512:0", "8:10"])
def test_sizes_that_are_none_are_refused(text):
    options = ["--fields", text, "--results", "r"]
    run = CliRunner().invoke(image_costs.compare_tools, options)
    assert run.exit_code == 2
    assert "expected words SIDE:STARS" in run.output


def test_levels_of_the_costs_are_those_with_a_tight_mean_without_the_position():
    keys = {"dataset": "d", "reference": "realisation", "metric": "mse", "missing": 0}
    rows = [
        {**keys, "method": method, "noise_level": level, "value": value, "tight": tight}
        for method, level, value, tight in [
            ("bayes", 0.1, 1.0, "yes"),
            ("bayes", 0.2, 2.0, "no"),
            ("bayes_position", 0.1, 0.5, "no"),
            ("bayes_position", 0.2, 0.7, "yes"),
        ]
    ]
    assert costs.least_errors(pd.DataFrame(rows), "d", False) == ({0.1: 1.0}, True)
    assert costs.least_errors(pd.DataFrame(rows), "d", True) == ({0.1: 0.5}, False)
    # Without a tight mean all levels are taken.
    none = pd.DataFrame(rows).assign(tight="no")
    assert costs.least_errors(none, "d", False) == ({0.1: 1.0, 0.2: 2.0}, False)
    # Errors over a least possible one of 0 are not defined.
    exact = pd.DataFrame(rows).assign(tight="yes", value=[0.0, 2.0, 0.0, 0.0])
    assert costs.least_errors(exact, "d", False) == ({0.2: 2.0}, True)
    with pytest.raises(ProductError, match="d: the least possible error with the position is 0"):
        costs.least_errors(exact, "d", True)
