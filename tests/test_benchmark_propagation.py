"""The benchmark of the optics: its references, its choices, its peers, and what stages skip."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

from psfdae.benchmark import cases, choice, peers, propagation, skipping, timing, wavefronts
from psfdae.benchmark.cases import Case, Selection, stamps_at
from psfdae.configuration.compose import load_stage
from psfdae.files import ProductError
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.sampling import SamplingError
from psfdae.optics.seidel import monomial_coefficients, monomial_images
from psfdae.optics.turbulence import structure_function
from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae.stages import propagation as stage
from psfdae.stars.framing import normalise_flux

COMATIC = np.array([0.3, 0.8, 0.6, 0.4, -0.1])
SCENES = {
    # Datasets whose stars must fit the least noise; the stars that `screen` finds to be worst.
    "seidel": ("dataset4", [7144, 642, 6364, 3655, 4373, 4061, 7637, 1962]),
    "turbulence": ("dataset7", [286, 365, 157, 153, 368, 223]),
}


@pytest.fixture(scope="module")
def scenes():
    """Both scenes with the configuration that the benchmark gets."""
    return {
        name: stage.scene_of(load_stage("propagation", [f"dataset={dataset}"]))
        for name, (dataset, _) in SCENES.items()
    }


@pytest.fixture(scope="module")
def case():
    """A comatic star well off the chief ray, with its exact stamp."""
    source, fine = (
        seidel_wavefronts(COMATIC[None], np.array([[0.6, -0.4]])),
        annular_pupil(512, 0.3),
    )
    offset = np.array([[3, -5]])
    exact = StampPropagator(fine, 10, 0.88, nodes=6)
    opd = source.opd(np.zeros(1, int), fine, np.dtype(float))
    return Case(
        *("seidel", "mild", source, offset, 160, 10, 0.88, 0.3, 1e-9),
        truth=normalise_flux(exact(opd, offset))[0][0],
    )


def peer_error(case, method, subsamples):
    _, propagate = peers.build(case, peers.Peer(method, case.samples, subsamples), threads=1)
    return cases.errors(normalise_flux(propagate())[0], case.truth)[0]


@pytest.mark.parametrize("method", ["fft", "fft_pruned", "poppy_mft", "poppy_fresnel", "hcipy"])
def test_peers_converge_to_our_stamp_with_their_subsamples(case, method):
    """Same orientation, same place, and an error that falls as 1/subsamples²."""
    coarse, fine = (peer_error(case, method, subsamples) for subsamples in (4, 8))
    assert fine < 2.5e-3
    assert coarse / fine == pytest.approx(4.0, rel=0.2)


def test_fresnel_planes_change_nothing(case):
    peer = peers.Peer("poppy_fresnel", case.samples, 4)
    samples, padded, _ = peers.fresnel_grid(case, peer)
    same = replace(case, pixel=4 * samples / padded)
    planes, direct = (
        peers.build(same, replace(peer, samples=samples, method=method), 1)[1]()
        for method in ("poppy_fresnel", "poppy_mft")
    )
    assert skipping.relative_to_peak(direct, planes) < 1e-7


@pytest.mark.parametrize("pixel", [0.88148, 1.58667])
@pytest.mark.parametrize(("subsamples", "multiple"), [(2, 2), (4, 4), (8, 16)])
def test_padded_grid_hits_the_pixels(pixel, subsamples, multiple):
    samples, padded = peers.commensurate_grid(222, pixel, subsamples, multiple)
    assert 222 <= samples <= 1.3 * 222 + 2
    assert padded % multiple == samples % 2 == 0
    assert samples / padded * subsamples == pytest.approx(pixel, rel=2e-4)


@pytest.mark.parametrize("scene", SCENES)
def test_references_have_converged(scenes, scene):
    """The two coarser references agree with the finest far below the budget."""
    found, convergence = cases.build_cases(scenes[scene])
    assert [c.aberration for c in found] == ["mild", "strong"]
    mild, strong = (np.abs(c.source.slopes()).max() for c in found)
    assert mild < 0.7 * strong
    table = pd.DataFrame(convergence)
    assert len(table) == 4
    assert (table.mse < 0.01 * table.budget).all()
    assert all(c.truth.sum() == pytest.approx(1) for c in found)


def test_budget_is_a_hundredth_of_the_least_noise_variance(scenes):
    assert cases.error_budget(5.0, [1e-3, 2e-3]) == pytest.approx(0.01 * 25e-6)
    assert scenes["seidel"].budget == pytest.approx(0.01 * (4.98 * 3e-5) ** 2)
    assert scenes["turbulence"].budget == pytest.approx(0.01 * (4.98 * 3e-4) ** 2)


def worst_errors(scene, stars, **settings):
    """MSE of real stars of a scene with its settings (or others) against the reference."""
    some = Selection(scene.stars, np.array(stars))
    way = scene.propagation(some, scene.search_px, **settings)
    offset = scene.propagation(some, scene.search_px).brightest()
    stamps = normalise_flux(way.stamps(scene.framing.stamp_px, offset))[0]
    return choice.stamp_mse(stamps, stamps_at(scene, some, offset, *choice.REFERENCE))


@pytest.mark.parametrize("scene", SCENES)
def test_configured_settings_stay_within_the_budget(scenes, scene):
    error = worst_errors(scenes[scene], SCENES[scene][1])
    assert error.max() <= scenes[scene].budget


@pytest.mark.parametrize("scene", SCENES)
def test_two_nodes_fewer_are_refused(scenes, scene):
    with pytest.raises(SamplingError, match=r"needs at least \d nodes"):
        worst_errors(scenes[scene], SCENES[scene][1], nodes=scenes[scene].optics.nodes - 2)


@pytest.mark.parametrize(
    ("time", "error", "chosen"),
    [
        ([3.0, 1.0, 2.0], [0.1, 9.0, 0.5], 2),  # the cheapest is not good enough
        ([3.0, 1.0, 2.0], [0.1, 1.0, 0.5], 1),  # on the budget is within it
        ([np.nan, 3.0], [0.1, 0.1], 1),  # what was not timed cannot be chosen
        ([2.0, 2.0], [0.5, 0.1], 0),
        ([1.0], [2.0], None),
    ],
)
def test_cheapest_within_budget(time, error, chosen):
    assert choice.cheapest_within(np.array(time), np.array(error), 1.0) == chosen


def test_first_lasting_value_ignores_lucky_coarse_grids():
    fine = np.array([[1, 0, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0]], bool)
    found = choice.first_lasting(fine, np.array([94.0, 126.0, 158.0, 222.0]))
    assert found[:2].tolist() == [158.0, 94.0]
    assert np.isnan(found[2])


def test_spread_takes_the_extremes_of_every_rung():
    needed = np.array([100, 90, 210, 130, 120, 190, 110])
    picks = choice.spread(needed, (126, 222), per_rung=2)
    assert sorted(needed[picks]) == [90, 120, 130, 210]


def test_candidate_ladders_end_where_the_configured_one_does(scenes):
    optics = scenes["seidel"].optics
    found = choice.ladders(optics, propagation.candidate_samples(optics, thorough=True))
    assert tuple(optics.pupil_samples) in found
    assert {ladder[-1] for ladder in found} == {optics.pupil_samples[-1]}
    assert all(list(ladder) == sorted(set(ladder)) for ladder in found)


def rows_of(values):
    names = "scene aberration method samples nodes precision backend threads batch time_ms mse"
    table = pd.DataFrame(values, columns=names.split())
    return table.assign(repeats=1, time_ms_low=0.0, time_ms_high=0.0, error_peak=0.0, budget=1e-9)


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
    table = rows_of(TABLE).assign(within_budget="yes")
    found = peers.compare(table)
    assert found.method.tolist() == ["poppy_mft"]  # nothing of ours is as good as the other
    assert found.kernel_time_ms.tolist() == [0.3]  # same threads and backend, no larger error
    assert found.speedup.tolist() == pytest.approx([30.0])
    assert found.met.tolist() == ["no"]


def test_pareto_front_and_setting_in_use_are_marked():
    rows = rows_of(TABLE).assign(within_budget="yes").to_dict("records")
    setting = propagation.Setting(94, 2, "complex64", "numpy", 2, 1)
    used = {"mild": setting, "strong": replace(setting, batch=16)}
    table = propagation.finish(rows, used)
    assert tuple(table.columns) == propagation.COLUMNS
    assert table.index[table.used == "yes"].tolist() == [1, 4]
    assert table.index[table.pareto == "yes"].tolist() == [3, 4, 6]


def test_zernike_fit_is_exact_and_piston_does_not_matter(case):
    monomials = monomial_coefficients(COMATIC, np.array([0.6, -0.4]))
    axis = np.linspace(-0.7, 0.7, 9)
    x, y = np.meshgrid(axis, axis)
    fitted = np.tensordot(wavefronts.zernike_fit(monomials), wavefronts.zernikes(x, y), axes=1)
    assert fitted == pytest.approx(np.tensordot(monomials, monomial_images(x, y), axes=1), abs=1e-9)
    pupil = annular_pupil(96, 0.3)
    kernel = StampPropagator(pupil, 10, 0.88, nodes=3)
    lean = wavefronts.equal_stars(monomial_images, monomials, 2)
    full = wavefronts.equal_stars(wavefronts.with_piston, np.append(monomials, 0.37), 2)
    stamps, others = (kernel(opd_of(pupil, np.dtype(float))) for opd_of in (lean, full))
    assert skipping.relative_to_peak(stamps, others) < 1e-12


def test_drawn_waves_have_the_structure_function_of_theory(scenes):
    config = load_stage("propagation", ["dataset=dataset7"])
    distance_m = np.geomspace(0.05, 0.5, 6)
    footprints = scenes["turbulence"].templates.footprints
    drawn = wavefronts.mean_structure(footprints, distance_m / 0.5)
    theory = structure_function(distance_m, config.wavefront.r0_m, config.wavefront.outer_scale_m)
    assert drawn == pytest.approx(theory, rel=0.1)


def test_time_calls_warms_up_and_counts():
    called = []
    found = timing.time_calls(lambda: called.append(1), repeats=3, calls=4)
    assert len(called) == 1 + 3 * 4
    assert 0 <= found.low_s <= found.median_s <= found.high_s
    with pytest.raises(ValueError, match="repeats = 0"):
        timing.time_calls(lambda: None, repeats=0)


def test_rounds_take_turns_and_set_up_off_the_clock():
    events = []

    def builder(name, seconds):
        def build():
            time.sleep(0.05)
            return lambda: (events.append(name), time.sleep(seconds))

        return build

    slow, fast = timing.time_in_rounds([builder("slow", 0.02), builder("fast", 0.002)], repeats=3)
    assert events == ["slow", "fast"] * 3
    assert slow.repeats == 3
    assert 0.002 <= fast.median_s < 0.02 <= slow.low_s <= slow.median_s < 0.05
    with pytest.raises(ValueError, match="repeats = 0"):
        timing.time_in_rounds([], repeats=0)


def test_times_are_those_of_one_stamp(case):
    """A run of 5 batches of 8 stamps that takes 80 ms: 2 ms per stamp."""
    setting = (126, 4, "complex64", "numpy", 2, 8)
    build = partial(partial, time.sleep, 0.08)
    trial = propagation.Trial(case, "kernel", setting, case.truth, build, batches=5)
    (row,) = propagation.time_trials([trial], repeats=3)
    assert 2.0 <= row["time_ms_low"] <= row["time_ms"] <= row["time_ms_high"] < 2.5
    assert (row["repeats"], row["mse"], row["within_budget"]) == (3, 0.0, "yes")


def test_kernel_runs_as_many_batches_as_its_time_is_divided_by(case, monkeypatch):
    ran = []
    monkeypatch.setattr(
        propagation, "side_by_side", lambda _, batches, threads: ran.append((len(batches), threads))
    )
    settings = [
        propagation.Setting(62, 4, "complex64", "numpy", threads, batch)
        for threads, batch in ((1, 8), (2, 8), (2, 64))
    ]
    trials = propagation.kernel_trials([case], [settings], stamps=64)
    for trial in trials:
        trial.build()()
    assert [trial.batches for trial in trials] == [8, 8, 2]
    timed = ran[1::2]  # after the warm-up of each
    assert timed == [(8, 1), (8, 2), (2, 2)]


def test_peers_run_as_many_stamps_as_their_time_is_divided_by(case, monkeypatch):
    ran = []
    monkeypatch.setattr(peers, "build", lambda *_: (62, lambda: ran.append(1) or case.truth))
    chosen = [peers.Peer("poppy_mft", 62, 2), peers.Peer("poppy_fresnel", 62, 2)]
    for trial, stamps in zip(peers.peer_trials([case], [chosen], 1, 5), (5, 1), strict=True):
        run = trial.build()
        ran.clear()
        run()
        assert len(ran) == trial.batches == stamps


def test_grids_that_a_wavefront_refuses_are_left_out(case):
    class FineGridsOnly:
        def opd(self, index, pupil, dtype):
            if pupil.axis.size < 60:
                raise SamplingError("too coarse")
            return case.source.opd(index, pupil, dtype)

    wary = replace(case, source=FineGridsOnly())
    settings = [
        propagation.Setting(samples, 4, "complex64", "numpy", 2, 8) for samples in (30, 62, 126)
    ]
    rows = peers.time_methods([wary], [settings], [[peers.Peer("fft_pruned", 126, 4)]], 2, 2, 16)
    table = pd.DataFrame(rows)
    assert list(table.samples[table.method == "kernel"]) == [62, 126]
    assert (table.mse < 1e-5).all()


def test_fresh_process_is_another_one_with_its_own_threads(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    jobs = [(os.getpid, ()), (os.getenv, ("OMP_NUM_THREADS",))]
    pid, threads = timing.in_fresh_process(3, timing.call_all, jobs)
    assert pid != os.getpid()
    assert (threads, os.environ["OMP_NUM_THREADS"]) == ("3", "1")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """The whole stage on a tiny scene 2, in this process, and its joined tables."""
    folder = tmp_path_factory.mktemp("tiny")
    small = ["preset=smoke", "grid.points=3", "benchmark.threads=1", "optics.threads=1"]
    config = load_stage("propagation", ["dataset=dataset7", *small])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(timing, "in_fresh_process", lambda threads, f, *arguments: f(*arguments))
        patch.setattr(cases, "REFERENCES", ((126, 3), (158, 4), (190, 5)))
        patch.setattr(choice, "REFERENCE", (190, 5))
        stage.run(config, 2, folder / "turbulence")
    extra = folder / "extra.csv"
    row = skipping.saving("Idle steps", "seidel", "training", 3.0, 1.0, 0.0, "none")
    pd.DataFrame([row]).to_csv(extra, index=False)
    stage.tables([folder / "turbulence"], [extra], folder / "tables")
    return folder


def test_stage_writes_every_table(tiny):
    tables = {p.stem: pd.read_csv(p) for p in (tiny / "tables").glob("*.csv")}
    assert set(tables) == {f"benchmark_{name}" for name in (*stage.TABLES, "peers")}
    times = tables["benchmark_propagation"]
    assert set(times.backend) == {"numpy", "torch"}
    assert (times.time_ms > 0).all()
    used = times[times.used == "yes"]
    assert used.aberration.tolist() == ["mild", "strong"]
    assert (used.within_budget == "yes").all()
    chosen = tables["benchmark_choice"]
    assert (chosen.cheapest == "yes").sum() == (chosen.configured == "yes").sum() == 1
    assert chosen.time_ms.notna().all()


def test_savings_change_nothing_that_matters(tiny):
    table = pd.read_csv(tiny / "tables/benchmark_skipping.csv", keep_default_na=False)
    rows = table.set_index("item")
    assert rows.saving["Stamps anew for each λ"] == pytest.approx(8)  # two datasets, four λ
    assert rows.change["Stamps anew for each λ"] == 0
    for item in ("Pixels outside the stamp", "Templates anew for each star"):
        assert rows.change[item] < 1e-5
    assert rows.change["Tilt of the turbulence"] > 0.01
    assert rows.saving["Idle steps"] == 3
    budget = pd.read_csv(tiny / "tables/benchmark_choice.csv").budget[0]
    assert (rows.change[rows.unit == skipping.AS_MSE] < budget).all()


def test_figures_are_drawn(tiny):
    tables = tiny / "tables"
    stage.figure_propagation(tables / "benchmark_propagation.csv", "turbulence", tiny / "p.png")
    stage.figure_skipping(tables / "benchmark_skipping.csv", tiny / "s.png")
    assert (tiny / "p.png").stat().st_size > 10_000
    assert (tiny / "s.png").stat().st_size > 10_000
    with pytest.raises(ProductError, match="no rows of scene seidel"):
        stage.figure_propagation(tables / "benchmark_propagation.csv", "seidel", tiny / "n.png")


def test_savings_of_another_shape_are_refused(tiny, tmp_path):
    (tmp_path / "wrong.csv").write_text("item,seconds\nx,1\n")
    with pytest.raises(ProductError, match=r"wrong\.csv: columns"):
        stage.tables([tiny / "turbulence"], [tmp_path / "wrong.csv"], tmp_path)


def test_packages_that_are_not_imported_are_timed():
    rows = skipping.imports(1, ("colorsys", "no_such_package"))
    assert [row["item"] for row in rows] == ["Import of colorsys"]
    assert rows[0]["with_s"] > 0.01


RUN_TINY_STAGES = """
import importlib, pkgutil, sys
from pathlib import Path
import psfdae.stages
from psfdae.configuration.compose import load_stage

unwanted = ("poppy", "batoid", "aotools", "mlflow", "hydra", "snakemake")
modules = [m.name for m in pkgutil.iter_modules(psfdae.stages.__path__)]
for name in modules:
    importlib.import_module(f"psfdae.stages.{name}")
imported = [name for name in unwanted if name in sys.modules]

stages = ("templates", "stars", "baseline", "train", "evaluate")
tiny = ["preset=smoke", "grid.points=3", "stars.count=60", "parts.train_stars=40",
        "parts.test_stars=12", "train.epochs=1", "dataset=dataset3", "baseline.epochs=1"]
config = {stage: load_stage(stage, tiny) for stage in stages}
# Composing a configuration is what the command line does; the stages themselves must not.
for name in list(sys.modules):
    if name.partition(".")[0] in unwanted:
        del sys.modules[name]

from psfdae.stages import stars, tables, templates
from psfdae.stages.evaluate import Models, evaluate
from psfdae.stages.fit import baseline, train
out = Path(sys.argv[1])
made = {name: out / name for name in ("templates", "stars", "pca_som", "dae", "csv", "per_star")}
templates.templates(config["templates"], made["templates"])
stars.stars(config["stars"], made["templates"], made["stars"])
baseline(config["baseline"], made["stars"], out=made["pca_som"])
train(config["train"], made["stars"], out=made["dae"])
evaluate(config["evaluate"], "dataset3", made["stars"],
         Models(pca_som=made["pca_som"], dae=made["dae"]),
         per_star=made["per_star"], out=made["csv"])
tables.collect([made["csv"]], out / "all.csv")
print(imported, [name for name in unwanted if name in sys.modules])
"""


def test_stages_never_load_heavy_packages(tmp_path):
    """Neither importing nor running the stages of scenes 1 and 2 loads what they do without."""
    command = [sys.executable, "-c", RUN_TINY_STAGES, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[] []"
