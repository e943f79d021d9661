"""Predictions of large runs: lines, limits, and the measurements behind them."""

from __future__ import annotations

import os

import numpy as np
import pandas as pd
import pytest

from psfdae.benchmark import cost, dag
from psfdae.benchmark.scaling import PowerLaw
from psfdae.configuration.compose import config_dir, load_stage
from psfdae.files import ProductError
from psfdae.stages import scaling
from workflow_runs import ROOT, planned, snakemake

SITE = cost.Site(walltime_h=10.0, memory_gb=4.0, storage_tb=1.0, files=1000)


def stage(seconds, memory=1e3, storage=2e3):
    """Costs per star, with a second and 100 MB that are always there."""
    return cost.Stage(cost.Line(1.0, seconds), cost.Line(1e8, memory), cost.Line(0.0, storage))


PLANNING = cost.Planning(
    seconds=PowerLaw(0.01, 1.5, 0.0),
    start_s=cost.Line(2.0, 0.05),
    memory_bytes=cost.Line(2e8, 4e5),
    jobs={"stars": cost.Line(0, 1), "train": cost.Line(0, 2), "templates": cost.Line(1, 0)},
)


def test_a_line_is_found_through_sizes_of_several_decades():
    x = np.array([1e2, 1e3, 1e4, 1e5])
    line = cost.fit_line(x, 3.0 + 2e-3 * x)
    assert line.fixed == pytest.approx(3.0)
    assert line.slope == pytest.approx(2e-3)
    assert line(1e9) == pytest.approx(3.0 + 2e6)


def test_neither_part_of_a_line_is_negative():
    x = np.array([1.0, 2.0, 4.0])
    assert cost.fit_line(x, x**2).fixed == 0.0
    flat = cost.fit_line(x, np.array([3.0, 2.0, 2.0]))
    assert flat.slope == 0.0
    assert 2.0 < flat.fixed < 3.0
    assert flat.reaches(10.0) == np.inf


@pytest.mark.parametrize(("x", "y"), [([1, 1], [2, 3]), ([1, 2], [0, 1]), ([0, 2], [1, 1])])
def test_no_line_through_one_size_or_nothing(x, y):
    with pytest.raises(cost.CostError, match="no line"):
        cost.fit_line(x, y)


def test_a_limit_is_reached_where_the_cost_is_the_limit():
    line = cost.Line(2.0, 0.5)
    assert line(line.reaches(12.0)) == pytest.approx(12.0)
    assert line.reaches(1.0) == 0.0


@pytest.mark.parametrize("exponent", [-0.01, 0.0, 1e-4])
def test_a_law_that_hardly_grows_is_never_reached(exponent):
    """Two noisy times of small workflows can give any exponent."""
    assert PowerLaw(1.0, exponent, np.nan).reaches(600.0) == np.inf
    assert PowerLaw(2.0, 0.5, np.nan).reaches(6.0) == pytest.approx(9.0)


def test_a_job_takes_at_most_half_of_walltime_and_memory():
    fast, slow = stage(1e-3), stage(0.1)
    share = cost.stars_per_job([fast, slow], SITE)
    assert slow.seconds(share) <= 5 * 3600 < slow.seconds(10 * share)
    hungry = stage(1e-3, memory=1e6)
    share = cost.stars_per_job([fast, hungry], SITE)
    assert hungry.memory_bytes(share) <= 2e9 < hungry.memory_bytes(10 * share)
    with pytest.raises(cost.CostError, match="hold no star"):
        cost.stars_per_job([stage(1e6)], SITE)


def test_core_hours_of_many_stars_are_those_of_each():
    stages = {"simulate": stage(0.01), "predict": stage(0.001)}
    rows = cost.stars_case(1e9, stages, SITE, stage(1.0), 5000)
    by_rule = {row["rule"]: row for row in rows}
    assert by_rule["stars"]["core_h"] == pytest.approx(1e7 / 3600, rel=1e-3)
    assert by_rule["stars"]["storage_gb"] == pytest.approx(2000)
    assert by_rule["stars"]["jobs"] == 1000
    assert by_rule["train"]["jobs"] == 1
    assert by_rule["train"]["longest_h"] == pytest.approx(5001 / 3600)


def test_jobs_of_a_dag_grow_with_its_models_but_for_those_that_are_there_once():
    costs = {"stars": (7.0, 2e7, 2e8), "train": (30.0, 1e6, 4e8), "templates": (9.0, 1e6, 1e8)}
    rows = {row["rule"]: row for row in cost.dag_case("models", 1e4, PLANNING, costs)}
    assert {rule: row["jobs"] for rule, row in rows.items()} == {
        "stars": 10000,
        "train": 20000,
        "templates": 1,
    }
    assert rows["train"]["core_h"] == pytest.approx(20000 * 30 / 3600)


def test_short_jobs_go_in_groups_and_tables_stay_at_home():
    home = frozenset({"track"})

    def row(rule, jobs, seconds):
        return cost.step("models", rule, jobs, seconds, 0.0, 0.0)

    assert cost.submission(row("track", 100, 500.0), home, 3.0) == "home"
    assert cost.submission(row("train", 100, 500.0), home, 3.0) == "array"
    assert cost.submission(row("train", 1, 500.0), home, 3.0) == "single"
    assert cost.submission(row("figure", 100, 2.0), home, 3.0) == "group"


def test_every_limit_is_reached_where_it_says():
    each = cost.Footprint(files=50, storage_bytes=1e7)
    found = cost.dag_limits("models", 1e4, PLANNING, each, 20.0, SITE)
    at = {row["limit"]: row["reached_at"] for row in found}
    assert PLANNING.seconds(at["dry run"]) == pytest.approx(SITE.patience_s)
    assert PLANNING.start_s(at["start of a job"]) == pytest.approx(20.0)
    assert PLANNING.memory_bytes(at["memory"]) == pytest.approx(4e9)
    assert at["files"] == 20
    assert at["storage"] == pytest.approx(1e5)
    assert {row["limit"] for row in found if row["breaks"] == "no"} == {"storage"}
    stages = {"simulate": stage(0.01), "predict": stage(0.001), "train": stage(1.0, memory=1e4)}
    first = min(cost.stars_limits(1e9, stages, SITE), key=lambda row: row["reached_at"])
    assert (first["where"], first["limit"]) == ("train", "walltime")
    assert stages["train"].seconds(first["reached_at"]) == pytest.approx(36000)


def made_up_tables(folder):
    """Tables as the stages would write them: costs that grow as they should."""
    counts = np.array([1000, 10000, 100000])
    per_star = {
        "simulate": 1e-3,
        "predict": 1e-4,
        "baseline": 4e-4,
        "train": 5e-4,
        "evaluate": 1e-3,
    }
    stages = [
        {
            "stage": name,
            "stars": n,
            "cpu_s": 1 + slope * n,
            "peak_mb": 200 + 0.01 * n,
            "disk_mb": 1 + 0.001 * n,
        }
        for name, slope in per_star.items()
        for n in counts
    ]
    plans = []
    for kind, rule in (("models", "train"), ("points", "sweep_point")):
        for n in (10, 100, 1000):
            total = {
                "plan_cpu_s": 2 + 0.1 * n,
                "peak_mb": 200 + 0.1 * n,
                "start_cpu_s": 2 + 0.01 * n,
            }
            plans.append({"kind": kind, "count": n, "rule": "total", "jobs": n + 1, **total})
            plans.append({"kind": kind, "count": n, "rule": rule, "jobs": n})
            plans.append(
                {"kind": kind, "count": n, "rule": "stars", "jobs": n if rule == "train" else 1}
            )
    runtime = [{"rule": "train", "wildcards": "a", "wall_s": 99.0, "peak_mb": 400.0}]
    for name, rows in (("stages", stages), ("dag", plans), ("runtime", runtime)):
        pd.DataFrame(rows).to_csv(folder / f"{name}.csv", index=False)
    network = folder / "results/dae/dataset3/random-realisation/dae.safetensors"
    network.parent.mkdir(parents=True)
    network.write_bytes(bytes(5000))
    return {name: folder / f"{name}.csv" for name in ("stages", "dag", "runtime")}


def test_plan_adds_up(tmp_path):
    tables = made_up_tables(tmp_path)
    out, limits = tmp_path / "plan.csv", tmp_path / "limits.csv"
    config = load_stage("scaling", ["dataset=dataset3", "train.epochs=10"])
    scaling.plan(config, tables, tmp_path / "results", ["track"], SITE, out, limits)
    rows = pd.read_csv(out).set_index(["case", "rule"])
    stars, epochs = config.stars.count, 10
    # Half of 4 GB hold 1e5 stars of 10 kB, which take 101 s.
    assert rows.loc[("stars", "stars"), "jobs"] == 1e4
    assert rows.loc[("stars", "stars"), "core_h"] == pytest.approx(1e4 * 101 / 3600, rel=1e-4)
    training = 1 + 5e-4 * epochs * stars
    assert rows.loc[("models", "train"), "core_h"] == pytest.approx(1e4 * training / 3600, rel=1e-4)
    point = training + 1 + 1e-3 * stars
    assert rows.loc[("points", "sweep_point"), "core_h"] == pytest.approx(
        1e5 * point / 3600, rel=1e-4
    )
    assert rows.loc[("points", "stars"), "jobs"] == 1
    # Ten seconds allow 800 models in a DAG: parts of 100, whose jobs start in 3 s.
    assert rows.loc[("models", "snakemake"), "per_dag"] == 100
    assert rows.loc[("models", "snakemake"), "core_h"] == pytest.approx(2e4 * 3 / 3600, rel=1e-4)
    found = pd.read_csv(limits)
    assert list(found.columns) == (
        ["case", "where", "limit", "allowed", "reached_at", "asked", "breaks"]
    )
    for _, part in found.groupby("case"):
        assert part.reached_at.is_monotonic_increasing
    assert ((found.reached_at < found.asked) == (found.breaks == "yes")).all()


def test_files_of_a_point_are_counted_where_there_is_a_sweep(tmp_path):
    network = cost.Footprint(40, 3e6)
    assert scaling.point_footprint(tmp_path, network) == network
    for point in ("a", "b"):
        folder = tmp_path / "sweeps/dae_width/points" / point
        folder.mkdir(parents=True)
        (folder / "result.json").write_bytes(bytes(10))
        (folder / "dae.safetensors").write_bytes(bytes(90))
    assert scaling.point_footprint(tmp_path, network) == cost.Footprint(4, 100)


@pytest.mark.parametrize("lost", ["stages", "dag", "runtime", "results"])
def test_plan_names_what_is_missing(tmp_path, lost):
    tables = made_up_tables(tmp_path)
    results = tmp_path / "results"
    if lost == "results":
        results = tmp_path / "other"
    else:
        tables[lost].unlink()
    config = load_stage("scaling", ["dataset=dataset3"])
    with pytest.raises(ProductError, match=r"other|\.csv"):
        scaling.plan(config, tables, results, [], SITE, tmp_path / "plan.csv", tmp_path / "l.csv")


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="CPUs cannot be chosen here")
def test_measurements_run_on_one_cpu():
    before = os.sched_getaffinity(0)
    with scaling.one_cpu():
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


@pytest.mark.slow
@pytest.mark.workflow
@pytest.mark.parametrize(("kind", "count"), [("models", 3), ("points", 5)])
def test_made_up_dags_have_the_jobs_that_are_asked_for(kind, count):
    with dag.made_up_config(config_dir(), kind, count) as config:
        whole = dag.plan(ROOT / "Snakefile", config, kind)
        single = dag.plan(ROOT / "Snakefile", config, kind, dag.one_job(kind, whole))
    rule = {"models": "train", "points": "sweep_point"}[kind]
    assert whole.jobs[rule] == count
    assert whole.total > count
    assert single.total < whole.total
    assert single.cpu_s > 0
    assert whole.peak_mb > 50


@pytest.mark.workflow
def test_a_dry_run_that_fails_says_why(tmp_path):
    with dag.made_up_config(config_dir(), "models", 1) as config:
        (config / "preset/made_up.yaml").write_text("# @package _global_\nnonsense: 1\n")
        with pytest.raises(dag.PlanError, match="nonsense"):
            dag.plan(ROOT / "Snakefile", config, "models")


@pytest.mark.slow
@pytest.mark.workflow
def test_target_scaling(smoke):
    folder = smoke
    snakemake(folder, "scaling")
    tables = folder / "results/tables"
    stages = pd.read_csv(tables / "scaling_stages.csv")
    assert set(stages.stage) == {"simulate", "predict", "baseline", "train", "evaluate"}
    assert (stages[["time_s", "cpu_s", "peak_mb", "disk_mb"]] > 0).all().all()
    plan = pd.read_csv(tables / "scaling_plan.csv")
    assert set(plan.case) == {"stars", "models", "points"}
    assert (plan[plan.rule != "snakemake"].core_h >= 0).all()
    assert {"home", "group"} <= set(plan.submit)
    assert planned(folder, "scaling") == {}
