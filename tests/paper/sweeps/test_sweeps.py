"""Points of sweeps: their names, their values, what a trial learns, what is checked."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import yaml

from psfdae.base.files import ProductError
from psfdae.base.settings import ConfigError
from psfdae_paper.configuration.compose import load
from psfdae_paper.configuration.sweep import Axis, find_sweeps, load_sweep
from psfdae_paper.sweeps import adaptive
from psfdae_paper.sweeps.points import SweepError, draws, grid, plan_sweep

GRID = {
    "kind": "grid",
    "model": "dae",
    "dataset": "dataset3",
    "metric": "validation_mse",
    "direction": "minimize",
    "space": {
        "width": {"keys": ["dae.widths"], "values": [4, 8], "repeat": 9},
        "train.lr": [0.001, 0.004],
    },
}
SEARCH = {"seed": 3, "startup": 4, "metric": "validation_mse", "direction": "minimize"}


@pytest.fixture
def sweep(config_folder):
    """Writes a sweep into a copy of the configuration and plans it."""

    def plan(tree, *overrides, name="tried"):
        text = tree if isinstance(tree, str) else yaml.safe_dump({name: tree}, sort_keys=False)
        (config_folder / f"sweep/{name}.yaml").write_text(text)
        return plan_sweep(name, ("preset=smoke", *overrides))

    return plan


@pytest.mark.parametrize("name", sorted(find_sweeps()))
def test_every_shipped_sweep_can_be_planned(name):
    plans = [plan_sweep(name, (f"preset={preset}",)) for preset in ("fast", "paper")]
    assert all(5 <= len(plan.points) <= 24 for plan in plans)


def test_grid_has_every_combination_once(sweep):
    points = list(sweep(GRID).points.values())
    assert [tuple(p.values.values()) for p in points] == (
        [(4, 0.001), (4, 0.004), (8, 0.001), (8, 0.004)]
    )
    assert points[2].config["dae"]["widths"] == [8] * 9
    assert points[3].config["train"]["lr"] == 0.004
    choices = axes(a=[1, 2], b={"choices": {3: {"x": 1}, 4: {"x": 2}}})
    assert grid(choices) == [{"a": i, "b": j} for i in (1, 2) for j in ("3", "4")]


def test_names_depend_on_content_not_on_order_or_format(sweep):
    names = set(sweep(GRID).points)
    space = dict(reversed(GRID["space"].items())) | {"train.lr": [0.004, 0.001]}
    reordered = dict(reversed(GRID.items())) | {"space": space}
    assert set(sweep(reordered).points) == names
    text = yaml.safe_dump({"tried": GRID}).replace("0.001", "1e-3").replace("0.004", "4.0E-3")
    assert "1e-3" in text
    assert set(sweep(text).points) == names
    grown = {**GRID["space"], "train.lr": [0.0005, 0.001, 0.004]}
    larger = set(sweep({**GRID, "space": grown}).points)
    assert names < larger and len(larger) == 6


def test_names_follow_what_decides_the_result_and_nothing_else(sweep):
    names = set(sweep(GRID).points)
    assert set(sweep(GRID, "calibration.stars=30", "bounds.test_stars=5").points) == names
    for change in ("train.batch=16", "telescope.obscuration=0.2", "noise.kappa=5", "seed=3"):
        assert not set(sweep(GRID, change).points) & names, change
    assert not set(sweep({**GRID, "reference": "template"}).points) & names
    # The metric chooses among the points, it does not change them.
    assert set(sweep({**GRID, "metric": "validation_ssim"}).points) == names


def test_points_are_measured_at_the_dataset_s_levels_whatever_they_train_on():
    plan = plan_sweep("noise_mix", ("preset=smoke",))
    levels = load(["dataset=dataset3"]).noise.levels
    assert plan.levels == levels
    assert any(point.config["noise"]["levels"] != levels for point in plan.points.values())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"trials": 5}, "trials: "),
        ({"model": "original"}, "dataset: "),
        ({"space": {"train.lr": {"low": 1e-3, "high": 1e-2}}}, r"space\.train\.lr: "),
        ({"space": {"seed": [1, 2]}}, "seed: "),
        ({"overrides": {"train.lr": 0.1}}, r"train\.lr: "),
        ({"space": {"train.lr": [0.1, 7]}}, r"train\.lr = 7: .* \(point train\.lr=7\)"),
        (
            {"kind": "adaptive", "trials": 3, "space": {"train.lr": {"low": 0.1, "high": 2}}},
            r"tried\.yaml: tried: train\.lr = 2\.0: ",
        ),
    ],
)
def test_every_mistake_is_named_before_any_work(sweep, change, message):
    with pytest.raises((ConfigError, SweepError), match=message):
        assert sweep({**GRID, **change}).points


def test_damaged_file_and_unknown_name_are_named(sweep, config_folder):
    with pytest.raises(ProductError, match=r"tried\.yaml: .*line"):
        sweep("kind: [grid\n")
    with pytest.raises(ConfigError, match=r"tried\.yaml: kind: expected sweeps by name"):
        sweep("kind: grid\nmodel: dae\n")
    with pytest.raises(ConfigError, match=r"tried\.yaml: gmm: is also in baselines\.yaml"):
        sweep("gmm: {kind: grid}\n")
    (config_folder / "sweep/tried.yaml").unlink()
    with pytest.raises(ConfigError, match=r"sweep = 'nothing': .*dae_width"):
        load_sweep("nothing")


def axes(**space):
    return {name: Axis.model_validate(axis) for name, axis in space.items()}


def test_draws_extend_and_each_axis_is_on_its_own():
    space = axes(a={"low": 1, "high": 9, "integer": True}, b={"low": 1e-4, "high": 1, "log": True})
    assert draws(space, 9, seed=5)[:4] == draws(space, 4, seed=5)
    single_axis = [point["b"] for point in draws({"b": space["b"]}, 4, seed=5)]
    assert single_axis == [point["b"] for point in draws(space, 4, seed=5)]
    assert draws(space, 4, seed=6) != draws(space, 4, seed=5)


def test_draws_fill_their_range_evenly():
    space = axes(
        whole={"low": 1, "high": 4, "integer": True},
        even={"low": 2, "high": 4},
        log={"low": 1e-4, "high": 1, "log": True},
        listed=["x", "y"],
    )
    points = pd.DataFrame(draws(space, 500, seed=1))
    # Five standard deviations of a binomial with 500 trials of probability 1/4 and 1/2.
    assert np.abs(np.bincount(points.whole)[1:] - 125).max() < 5 * np.sqrt(500 * 0.25 * 0.75)
    assert abs((points.listed == "x").sum() - 250) < 5 * np.sqrt(500 * 0.25)
    for unit in ((points.even - 2) / 2, np.log10(points.log) / 4 + 1):
        # Mean 1/2 and variance 1/12, whose own variances are 1/12n and 1/180n.
        assert abs(unit.mean() - 0.5) < 5 / np.sqrt(12 * 500)
        assert abs(unit.var() - 1 / 12) < 5 / np.sqrt(180 * 500)


SPACE = axes(
    x={"low": -4.0, "high": 4.0},
    kind={"choices": {"good": {"k": 0}, "bad": {"k": 1}}},
    list=[[1, 2], [3, 4]],
)


def outcome(slot, values, status="finished"):
    """Result of a trial on a parabola."""
    loss = (values["x"] - 1.5) ** 2 + (values["kind"] == "bad")
    metrics = {"validation_mse": loss} if status == "finished" else {}
    name = f"{slot:012x}"
    return {"slot": slot, "point": name, "values": values, "status": status, "metrics": metrics}


def run_trials(count):
    results = []
    for slot in range(count):
        values = adaptive.ask(SPACE, SEARCH, slot, results)
        results.append(outcome(slot, values, "failed" if slot == 2 else "finished"))
    return results


def test_asking_is_a_function_of_what_is_known():
    results = run_trials(8)
    assert run_trials(8) == results
    repeated = adaptive.ask(SPACE, SEARCH, 8, results)
    assert adaptive.ask(SPACE, SEARCH, 8, results[::-1]) == repeated
    assert repeated["list"] in ([1, 2], [3, 4])
    assert adaptive.ask(SPACE, {**SEARCH, "seed": 4}, 8, results) != repeated


def test_trial_waits_for_all_but_those_beside_it(sweep):
    tree = {**GRID, "kind": "adaptive", "trials": 5, "parallel": 2}
    plan = sweep(tree)
    slots = [[trial.slot for trial in plan.earlier_trials(p)] for p in plan.points.values()]
    assert slots == [[], [], [0], [0, 1], [0, 1, 2]]


def test_more_trials_keep_the_old_ones_and_another_search_has_others(sweep):
    tree = {**GRID, "kind": "adaptive", "trials": 3}
    old = list(sweep(tree).points)
    assert list(sweep({**tree, "trials": 5}).points)[:3] == old
    narrower = {"space": {**GRID["space"], "train.lr": [0.001]}}
    for change in ({"seed": 1}, {"direction": "maximize"}, {"startup": 2}, narrower):
        assert not set(sweep({**tree, **change}).points) & set(old)
