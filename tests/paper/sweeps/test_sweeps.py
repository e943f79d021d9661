"""Points of sweeps: their names, their values, what a trial learns, what is checked."""

from __future__ import annotations

from itertools import product

import numpy as np
import pandas as pd
import pytest
import yaml

from psfdae.base.files import ProductError
from psfdae.base.settings import ConfigError
from psfdae_paper.configuration.compose import load
from psfdae_paper.configuration.sweep import Sweep, find_sweeps, load_sweep
from psfdae_paper.sweeps.points import SweepError, plan_sweep
from psfdae_paper.sweeps.study import ask, create_study, list_values

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
    # Optuna's own order of axes is alphabetic, and its grid is shuffled.
    space = {
        "train.lr": [0.002, 0.001],
        "a": {"choices": {3: {"dae.residual": True}, 4: {"dae.residual": False}}},
        "dae.widths": [[4] * 9, [8] * 9],
    }
    values = [tuple(v.values()) for v in list_values(make_sweep(space=space))]
    assert values == list(product(space["train.lr"], ("3", "4"), space["dae.widths"]))


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


def make_sweep(**changes):
    """A checked sweep, without a file."""
    return Sweep.model_validate({**GRID, **changes})


def draw_values(trials, seed, space):
    """Random draws of a sweep."""
    return list_values(make_sweep(kind="random", trials=trials, seed=seed, space=space))


DRAWS = {
    "whole": {"keys": ["train.batch"], "low": 1, "high": 4, "integer": True},
    "even": {"keys": ["train.grad_clip"], "low": 2, "high": 4},
    "train.lr": {"low": 1e-4, "high": 1, "log": True},
    "train.optimiser": ["adam", "muon"],
}


def test_more_draws_extend_the_list_and_another_seed_has_others():
    first = draw_values(4, 5, DRAWS)
    assert draw_values(9, 5, DRAWS)[:4] == first
    assert draw_values(4, 6, DRAWS) != first
    # Seeds may be larger than numpy's older generators allow.
    assert len(draw_values(4, 2**62, DRAWS)) == 4


def test_draws_fill_their_range_evenly():
    points = pd.DataFrame(draw_values(500, 1, DRAWS))
    # Five standard deviations of a binomial with 500 trials of probability 1/4 and 1/2.
    assert np.abs(np.bincount(points.whole)[1:] - 125).max() < 5 * np.sqrt(500 * 0.25 * 0.75)
    assert abs((points["train.optimiser"] == "adam").sum() - 250) < 5 * np.sqrt(500 * 0.25)
    for unit in ((points.even - 2) / 2, np.log10(points["train.lr"]) / 4 + 1):
        # Mean 1/2 and variance 1/12, whose own variances are 1/12n and 1/180n.
        assert abs(unit.mean() - 0.5) < 5 / np.sqrt(12 * 500)
        assert abs(unit.var() - 1 / 12) < 5 / np.sqrt(180 * 500)


SPACE = {
    "x": {"keys": ["train.grad_clip"], "low": 0.0, "high": 8.0},
    "kind": {"choices": {"good": {"train.lr": 0.1}, "bad": {"train.lr": 0.2}}},
    "list": {"keys": ["dae.widths"], "values": [[1, 2], [3, 4]]},
}
SEARCH = make_sweep(kind="adaptive", trials=9, space=SPACE, seed=3)


def outcome(slot, values, is_finished=True):
    """Result of a trial on a parabola."""
    loss = (values["x"] - 5.5) ** 2 + (values["kind"] == "bad")
    metrics = {"validation_mse": loss} if is_finished else {}
    return {"slot": slot, "point": f"{slot:012x}", "values": values, "metrics": metrics}


def run_trials(count, sweep=SEARCH):
    results = []
    for slot in range(count):
        values = ask(create_study(sweep, results, slot), sweep)
        results.append(outcome(slot, values, is_finished=slot != 2))
    return results


def test_asking_is_a_function_of_what_is_known():
    results = run_trials(8)
    assert run_trials(8) == results
    assert all(result["values"]["list"] in ([1, 2], [3, 4]) for result in results)
    assert run_trials(8, make_sweep(**{**SEARCH.model_dump(exclude_none=True), "seed": 4})) != (
        results
    )


def test_later_trials_are_near_the_best_of_earlier_ones():
    """Values of a uniform draw would be 2.8 from the minimum in the mean."""
    distances = [abs(result["values"]["x"] - 5.5) for result in run_trials(40)[20:]]
    assert np.mean(distances) < 1.4


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
