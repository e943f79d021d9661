"""Benchmarks: optics beside other programs, error budgets in use, and the tables on request."""

from __future__ import annotations

import sys

import click
import numpy as np
import pytest

import costs
import image_costs
import propagators
import scenes
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
        return scenes.relative_to_peak(propagate(), case.truth)

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
    exact = scenes.stamps_at(scene, selection, offset, *scenes.REFERENCES[-1])
    assert scenes.stamp_mse(normalise_flux(stamps)[0], exact).max() <= scene.budget


def test_knee_is_the_last_training_whose_time_is_worth_its_error():
    """Twice the time must lower the error by a tenth, or four times by a fifth."""
    # From 2 s to 4 s it falls by 6 % only.
    assert costs.knee(np.array([1.0, 2.0, 4.0, 8.0]), np.array([1.0, 0.8, 0.75, 0.7])) == 1


# Images


def test_the_cost_of_a_command_is_its_own(tmp_path):
    """Memory and CPU time of a process that takes 200 MB; a failure ends with what it printed."""
    program = "import time; block = bytearray(200_000_000); time.sleep(0.3)"
    cost = image_costs.measure_process([sys.executable, "-c", program], tmp_path, {})
    assert 190 < cost["peak_mb"] < 260 and 0.0 < cost["cpu_s"] < 5.0
    with pytest.raises(click.ClickException, match="no such tool"):
        failure = "raise SystemExit('no such tool')"
        image_costs.measure_process([sys.executable, "-c", failure], tmp_path, {})


def test_an_earlier_commit_has_the_name_that_its_command_had(tmp_path):
    (tmp_path / "new/src/psfdae/commands").mkdir(parents=True)
    (tmp_path / "new/src/psfdae/commands/train.py").touch()
    trees = {"now": tmp_path / "new", "earlier": tmp_path / "old"}
    runs = [*image_costs.list_runs(tmp_path / "i.fits", trees, tmp_path)]
    names = {tool: words[3] for tool, step, words, _ in runs if step == "train" and tool in trees}
    assert names == {"now": "train", "earlier": "from-stars"}
