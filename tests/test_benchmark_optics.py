"""The benchmark of the optics: its references, its choices, its peers, and what stages skip."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import figures
import propagation
import propagators
import scenes
from measure import alone, time_in_rounds
from psfdae.files import ProductError
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.stars.framing import normalise_flux
from workflow_runs import ROOT

RECORD = ROOT / "results/reference/tables"
COMATIC, FIELD = np.array([0.3, 0.8, 0.6, 0.4, -0.1]), np.array([0.6, -0.4])
SCENES = {
    # Datasets whose stars must fit the least noise; the stars that `screen` finds to be worst.
    "seidel": ("dataset4", [7144, 642, 6364, 3655, 4373, 4061, 7637, 1962]),
    "turbulence": ("dataset7", [286, 365, 157, 153, 368, 223]),
}


@pytest.fixture(scope="module")
def both():
    """Both scenes with the configuration that the benchmark gets."""
    return {
        name: scenes.Scene.of(load_stage(scenes.READS, [f"dataset={dataset}"]))
        for name, (dataset, _) in SCENES.items()
    }


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


@pytest.mark.parametrize("pixel", [0.88148, 1.58667])
@pytest.mark.parametrize(("subsamples", "multiple"), [(2, 2), (4, 4), (8, 16)])
def test_padded_grid_hits_the_pixels(pixel, subsamples, multiple):
    samples, padded = propagators.commensurate_grid(222, pixel, subsamples, multiple)
    assert 222 <= samples <= 1.3 * 222 + 2
    assert padded % multiple == samples % 2 == 0
    assert samples / padded * subsamples == pytest.approx(pixel, rel=2e-4)


@pytest.mark.parametrize("scene", SCENES)
def test_references_have_converged(both, scene):
    """The two coarser references agree with the finest far below the budget."""
    found, convergence = scenes.build_cases(both[scene])
    assert [c.aberration for c in found] == ["mild", "strong"]
    mild, strong = (np.abs(c.source.slopes()).max() for c in found)
    assert mild < 0.7 * strong
    table = pd.DataFrame(convergence)
    assert len(table) == 4
    assert (table.mse < 0.01 * table.budget).all()
    assert all(c.truth.sum() == pytest.approx(1) for c in found)


@pytest.mark.parametrize("name", SCENES)
def test_configured_settings_stay_within_the_budget(both, name):
    scene, stars = both[name], np.array(SCENES[name][1])
    some = scenes.Selection(scene.stars, stars)
    way = scene.propagation(some, scene.search_px)
    stamps, offset = way.framed(scene.framing.stamp_px)
    exact = scenes.stamps_at(scene, some, offset, *scenes.REFERENCES[-1])
    assert scenes.stamp_mse(normalise_flux(stamps)[0], exact).max() <= scene.budget


def rows_of(values):
    names = "scene aberration method samples points precision backend threads batch time_ms mse"
    table = pd.DataFrame(values, columns=names.split())
    return table.assign(within_budget="yes", processes=1)


KERNEL = ("kernel", 94, 2, "complex64", "numpy")
TABLE = [
    ("seidel", "mild", *KERNEL, 2, 16, 0.1, 1e-8),
    ("seidel", "mild", *KERNEL, 2, 1, 0.3, 1e-10),
    ("seidel", "mild", *KERNEL, 1, 16, 0.05, 1e-10),
    ("seidel", "mild", "kernel", 94, 2, "complex64", "torch", 2, 16, 0.01, 1e-10),
    ("seidel", "strong", *KERNEL, 2, 16, 0.2, 1e-12),
    ("seidel", "mild", "poppy_mft", 94, 4, "complex128", "numpy", 2, 1, 9.0, 1e-9),
    ("seidel", "mild", "hcipy", 94, 4, "complex128", "numpy", 2, 1, 1.0, 1e-11),
]


def test_peers_are_compared_at_equal_error_in_one_process():
    found = propagators.compare(rows_of(TABLE))
    assert found.method.tolist() == ["poppy_mft"]  # nothing of ours is as good as the other
    assert found.kernel_time_ms.tolist() == [0.3]  # same threads and backend, no larger error
    assert found.speedup.tolist() == pytest.approx([30.0])
    assert found.met.tolist() == ["no"]


def test_pareto_front_and_setting_in_use_are_marked():
    setting = propagators.Setting("kernel", 94, 2, "complex64", "numpy", 2, 1)
    used = {"mild": setting, "strong": replace(setting, batch=16)}
    table = propagators.finish(rows_of(TABLE).to_dict("records"), used)
    assert table.index[table.used == "yes"].tolist() == [1, 4]
    assert table.index[table.pareto == "yes"].tolist() == [3, 4, 6]


def test_times_are_those_of_one_stamp_of_all_that_ran(case, monkeypatch):
    """Batches of the kernel beside each other, stamps of a peer; each run takes 80 ms."""
    ran = []

    def rounds(builders, repeats):
        runs = [build() for build in builders]
        ran.clear()
        for run in runs:
            run()
        return np.tile([0.08, 0.04, 0.16, 0.08, 0.08], (len(runs), 1))

    def beside(work, batches, threads):
        ran.append((len(batches), threads))

    monkeypatch.setattr(propagators, "time_in_rounds", rounds)
    monkeypatch.setattr(propagators, "side_by_side", beside)
    rest = ("complex64", "numpy")
    sizes = ((1, 8), (2, 8), (2, 64))
    chosen = [propagators.Setting("kernel", 62, 4, *rest, *size) for size in sizes]
    chosen.append(propagators.Setting("fft", 62, 2, *rest, threads=2))
    # Nobody looks at these images.
    case = replace(case, source=seidel_wavefronts(0.1 * COMATIC[None], FIELD[None]))
    rows = propagators.time_settings([(case, setting) for setting in chosen], 5, 16)
    assert ran == [(8, 1), (8, 2), (2, 2), (1, 1)]
    stamps = [64, 64, 128, 1]
    for end in ("", "_low", "_high"):
        times = [row[f"time_ms{end}"] for row in rows]
        assert times == pytest.approx([80 / n for n in stamps])


def test_stamps_of_processes_side_by_side_count_together(monkeypatch):
    found = [[{"time_ms": t, "time_ms_low": t, "time_ms_high": 2 * t}] for t in (3.0, 5.0)]
    monkeypatch.setattr(propagators, "alone", lambda *a, processes: found[:processes])
    (row,) = propagators.in_processes([], 5, 16, 2)
    assert row == {"time_ms": 2.0, "time_ms_low": 2.0, "time_ms_high": 4.0, "processes": 2}


def test_processes_begin_every_timing_together():
    """Neither is done with a later timing before the other has begun it."""
    found = alone(1, begun_and_ended, 5, processes=2)
    (begun, ended), (other_begun, other_ended) = (np.array(times).T for times in found)
    assert (np.maximum(begun, other_begun)[:-1] < np.minimum(begun, other_begun)[1:] + 1e-3).all()
    assert (np.maximum(begun, other_begun) < np.minimum(ended, other_ended)).all()


def begun_and_ended(count):
    times = []

    def work():
        start = time.monotonic()
        time.sleep(0.05)
        times.append((start, time.monotonic()))

    time_in_rounds([lambda: work] * count, 1)
    return times


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """The whole benchmark on a tiny scene 2, in this process, and its joined tables."""
    folder = tmp_path_factory.mktemp("tiny")
    small = ["preset=smoke", "grid.points=3", "benchmark.threads=1", "optics.threads=1"]
    config = load_stage(scenes.READS, ["dataset=dataset7", *small])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(propagation, "alone", lambda threads, f, *arguments: f(*arguments))
        patch.setattr(scenes, "REFERENCES", ((126, 3), (158, 4), (190, 5)))
        propagation.measure(config, folder / "turbulence")
        propagation.tables(folder / "tables", (folder / "turbulence",))
    return folder / "tables"


def test_every_table_is_that_of_the_record(tiny):
    """Names and columns are those that docs and users know."""
    tables = {path.name: pd.read_csv(path) for path in tiny.glob("*.csv")}
    assert set(tables) == {f"benchmark_{name}.csv" for name in (*propagation.TABLES, "peers")}
    for name, table in tables.items():
        assert list(table.columns) == list(pd.read_csv(RECORD / name).columns), name
    times = tables["benchmark_propagation.csv"]
    assert set(times.backend) == {"numpy", "torch"}
    assert (times.time_ms > 0).all()
    used = times[times.used == "yes"]
    assert used.aberration.tolist() == ["mild", "strong"]
    assert (used.within_budget == "yes").all()


def test_figures_are_drawn(tiny, tmp_path):
    times, out = tiny / "benchmark_propagation.csv", tmp_path / "drawn.png"
    figures.draw("propagation", times, out, "turbulence")
    assert out.stat().st_size > 10_000
    with pytest.raises(ProductError, match="no rows of scene seidel"):
        figures.draw("propagation", times, out, "seidel")
