"""Points of sweeps, trained and measured; their summary, figures and MLflow runs."""

from __future__ import annotations

import csv
import json
import shlex

import numpy as np
import optuna
import pandas as pd
import pytest
import yaml

from psfdae.base.files import Column, ProductError, write_product
from psfdae.base.reading import read_json
from psfdae.methods import list_groups
from psfdae.stars.splits import random_split
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import load, load_stage
from psfdae_paper.configuration.sweep import Sweep, list_point_groups
from psfdae_paper.stages import sweep as stage
from psfdae_paper.stages import sweep_summary, track
from psfdae_paper.stages.fit import fit
from psfdae_paper.sweeps import points
from psfdae_paper.sweeps.figures import ALL_AXES, TWO_AXES, draw_sweep
from psfdae_paper.sweeps.measurement import Task
from psfdae_paper.sweeps.study import open_journal, read_study
from psfdae_paper.tracking import find_stars

SIZES = ("parts.train_stars=160", "parts.test_stars=60", "noise.levels=[0.001,0.005]")
TINY = ("dataset=dataset3", "preset=smoke", *SIZES, "train.epochs=3")
LEVELS = [0.001, 0.005]
FILES = {"dae": ("dae.safetensors", "config.yaml"), "pca_som": ("pca_som.h5",)}


@pytest.fixture(scope="module")
def stars(tmp_path_factory, gaussian_stars):
    """240 Gaussians at 12 field points."""
    return write_stars(tmp_path_factory.mktemp("stars") / "stars.h5", gaussian_stars[:240])


def write_stars(path, images):
    """Product of 240 images."""
    columns = {
        "realisation": Column(images, "1", "noise-free"),
        "template": Column(images, "1", "noise-free"),
        "field_index": Column(np.arange(240) % 12, "1", "field"),
        "grid": Column(np.array([(i, j) for i in range(4) for j in range(3)]), "1", "field"),
    }
    write_product(path, "stars", columns, {"seed": 1, "scene": {"experiment": "scene1"}})
    return path


class Point:
    """A folder for one point and the stage that fills it."""

    def __init__(self, root, stars, name="0123456789ab"):
        self.folder = root / "sweeps/tried/points" / name
        self.task = Task(
            *("dataset3", "random", "realisation"),
            data={"stars": stars},
            levels=LEVELS,
            folder=self.folder,
            checkpoint=root / f"{name}.pt",
        )

    def run(self, *overrides, model="dae"):
        config = load_stage(list_point_groups(model), (*TINY, *overrides))
        stage.point(config, model, points.Point(self.folder.name, {}, {}, {}), self.task)
        return self.result()

    def result(self):
        return read_json(self.folder / "result.json")


@pytest.fixture
def point(tmp_path, stars):
    return Point(tmp_path, stars)


@pytest.mark.parametrize("model", FILES)
def test_point_is_the_main_workflow_s_fit(point, stars, tmp_path, model):
    assert point.run(model=model)["status"] == "finished"
    main = tmp_path / ("main" if model == "dae" else "main/pca_som.h5")
    fit(load_stage(list_groups(model), TINY), model, stars, out=main)
    for name in FILES[model]:
        assert (tmp_path / "main" / name).read_bytes() == (point.folder / name).read_bytes()


def test_point_is_measured_on_both_parts(point):
    first = point.run()
    metrics = first["metrics"]
    assert (first["epochs"], first["attempt"]) == (3, 0)
    # Metrics are those of the tables, and geometric means over levels.
    for part, name, count in (("test", "evaluation.csv", 60), ("validation", "validation.csv", 16)):
        table = pd.read_csv(point.folder / name)
        assert set(table.n) == {count}
        for row in table[table.metric.isin(["mse", "ssim"])].itertuples():
            value = metrics[f"{part}_{row.metric}_{row.noise_level:g}"]
            assert value == pytest.approx(row.value, rel=1e-7)
        by_level = [metrics[f"{part}_mse_{level:g}"] for level in LEVELS]
        assert metrics[f"{part}_mse"] == pytest.approx(np.sqrt(by_level[0] * by_level[1]))


def test_early_stopping_is_recorded(point):
    late = ("train.epochs=40", "train.lr=0.3", "train.schedule=constant", "train.grad_clip=0.01")
    result = point.run(*late, "train.patience=1", "train.validate_every=1")
    assert result["status"] == "stopped" and result["epochs"] < 40
    assert np.isfinite(result["metrics"]["validation_mse"])


def test_failed_point_is_a_result_with_its_reason(point):
    point.folder.mkdir(parents=True)
    (point.folder / "dae.safetensors").write_bytes(b"of an earlier run")
    fatal = ("train.lr=1", "train.restarts=0", "train.grad_clip=0")
    result = point.run(*fatal, "train.dead_check_steps=1")
    assert (result["status"], result["metrics"]) == ("failed", {})
    assert "lower train.lr = 1" in result["reason"]
    assert not (point.folder / "dae.safetensors").exists()
    assert not point.task.checkpoint.exists()


def test_baseline_is_validated_on_stars_that_it_has_not_seen(tmp_path, gaussian_stars):
    """Validation stars of a shape of their own cannot be known; a fit to them would know it."""
    images = gaussian_stars[:240].copy()
    validation = random_split(240, 160, 60, 0.1, load(TINY).seed).validation
    images[validation] = 0.0
    images[validation, 2, 2] = 1.0
    point = Point(tmp_path, write_stars(tmp_path / "stars.h5", images))
    point.run(model="pca_som")
    table = pd.read_csv(point.folder / "validation.csv")
    # The spike alone, missed, is 1/256 per pixel.
    assert (table[table.metric == "mse"].value > 0.9 / 256).all()


def write_states(path, rng, count):
    """Product of states with stamps that tell them: Gaussians shifted by the state."""
    states = rng.uniform(-1, 1, (count, 4))
    shift = np.stack([states[:, :2], states[:, 2:], -states[:, :2]], axis=1)[..., None, None]
    y, x = np.mgrid[-8:8, -8:8]
    stamps = np.exp(-0.1 * ((x - 3 * shift[:, :, 0]) ** 2 + (y - 3 * shift[:, :, 1]) ** 2))
    stamps /= stamps.sum(axis=(2, 3), keepdims=True)
    columns = {
        "states": Column(states, "range", "true states"),
        "stamps": Column(stamps.astype(np.float32), "1", "noise-free"),
        "unit": Column(np.array([1e-3, 1e-3, 2e-3, 2e-3]), "m, m, rad, rad", "range"),
    }
    write_product(path, "alignment_states", columns, {"seed": 1})
    return path


def test_network_of_scene_3_is_measured_on_other_states(tmp_path):
    rng = np.random.default_rng(1)
    counts = {"states": 200, "validation": 60, "test": 50}
    data = {role: write_states(tmp_path / f"{role}.h5", rng, n) for role, n in counts.items()}
    folder = tmp_path / "points/0123456789ab"
    overrides = ("preset=smoke", "train_noise_trained.mirrors=false", "perceptron.widths=[8,8]")
    task = Task(
        *("noise_trained", "random", "realisation"),
        data=data,
        levels=[0.002],
        folder=folder,
        checkpoint=tmp_path / "sweep.pt",
    )
    settings = load_stage(list_point_groups("noise_trained"), (*Alignment.choice, *overrides))
    stage.point(settings, "noise_trained", points.Point(folder.name, {}, {}, {}), task)
    metrics = read_json(folder / "result.json")["metrics"]
    for role, name in (("validation", "validation.csv"), ("test", "evaluation.csv")):
        table = pd.read_csv(folder / name)
        assert set(table.n) == {counts[role]}
        mean = table[table.unit == "range"].mean_abs_error.mean()
        assert metrics[f"{role}_mae"] == pytest.approx(mean, rel=1e-7)


def test_trial_trains_the_number_that_it_asked_for(tmp_path, stars, config_folder):
    tree = {**DEFINITION, "kind": "adaptive", "trials": 3, "parallel": 1}
    tree["space"] = {"train.lr": {"low": 1e-3, "high": 1e-2, "log": True}}
    (config_folder / "sweep/tried.yaml").write_text(yaml.safe_dump({"tried": tree}))
    # An earlier result is read, and its values are others.
    values = []
    for name in list(points.plan_sweep("tried", TINY[1:]).points)[:2]:
        folder = tmp_path / name
        stage.sweep_point("tried", (("stars", stars),), tmp_path / "a.pt", folder, TINY[1:])
        result = read_json(folder / "result.json")
        lr = result["values"]["train.lr"]
        assert 1e-3 <= lr <= 1e-2 and result["keys"] == {"train.lr": lr}
        assert yaml.safe_load((folder / "config.yaml").read_text())["train"]["lr"] == lr
        values.append(lr)
    assert len(set(values)) == 2


def write_points(root, outcomes):
    """Results of a grid without any training; a metric of None is a failed point."""
    files = []
    for i, (width, lr, score) in enumerate(outcomes):
        name = f"{i:012x}"
        folder = root / "sweeps/tried/points" / name
        folder.mkdir(parents=True, exist_ok=True)
        metrics = {} if score is None else {"validation_mse": score, "test_mse": 1.1 * score}
        result = {
            **{"point": name, "slot": None, "model": "dae", "dataset": "dataset3"},
            **{"split": "random", "reference": "realisation"},
            "values": {"width": width, "train.lr": lr},
            "keys": {"dae.widths": [width] * 9, "train.lr": lr},
            "status": "failed" if score is None else "finished",
            "reason": "the network died" if score is None else "",
            **{"epochs": 3, "attempt": 0, "metrics": metrics, "config": {"train": {"lr": lr}}},
        }
        (folder / "result.json").write_text(json.dumps(result))
        (folder / "cost.json").write_text('{"seconds": 2.0, "cpu_seconds": 1.5}')
        if score is not None:
            (folder / "dae.safetensors").write_bytes(name.encode())
            (folder / "config.yaml").write_text("seed: 1\n")
            header = "epoch,step,lr,train_mse,validation_mse,seconds,cpu_seconds"
            (folder / "history.csv").write_text(f"{header}\n1,5,0.1,2e-5,1e-5,2.0,1.5\n")
        files.append(folder / "result.json")
    return files


DEFINITION = {
    **{"kind": "grid", "model": "dae", "dataset": "dataset3"},
    **{"metric": "validation_mse", "direction": "minimize"},
    "space": {
        "width": {"keys": ["dae.widths"], "values": [4, 8], "repeat": 9},
        "train.lr": [0.001, 0.004],
    },
}
OUTCOMES = [(4, 0.001, 3e-5), (4, 0.004, 2e-5), (8, 0.001, None), (8, 0.004, 1e-5)]
OVERRIDES = ("preset=smoke", "train.epochs=3")


def summarise(root, outcomes=OUTCOMES, **changes):
    out = root / "sweeps/tried"
    files = write_points(root, outcomes)
    sweep = Sweep.model_validate({**DEFINITION, **changes})
    sweep_summary.tabulate_points("tried", sweep, OVERRIDES, files, out)
    return out


def test_summary_has_every_point_and_the_best_by_validation(tmp_path):
    out = summarise(tmp_path)
    table = pd.read_csv(out / "summary.csv").set_index("point")
    assert table.status.tolist() == ["finished", "finished", "failed", "finished"]
    assert table.reason.tolist()[2] == "the network died"
    assert table.best.tolist() == ["no", "no", "no", "yes"]
    overrides = " ".join(sweep_summary.best_overrides(tmp_path, "tried"))
    assert overrides == "train.epochs=3 dae.widths=[8,8,8,8,8,8,8,8,8] train.lr=0.004"
    load_stage(list_groups("dae"), ("preset=smoke", *shlex.split(overrides)))
    # The test errors of this file would choose another point.
    files = write_points(tmp_path, OUTCOMES)
    for number, path in enumerate(files):
        result = read_json(path)
        result["metrics"]["test_mse"] = number
        path.write_text(json.dumps(result))
    for direction, number in (("minimize", 3), ("maximize", 0)):
        sweep = Sweep.model_validate({**DEFINITION, "direction": direction})
        sweep_summary.tabulate_points("tried", sweep, OVERRIDES, files, out)
        assert yaml.safe_load((out / "best.yaml").read_text())["point"] == f"{number:012x}"


def test_study_of_a_sweep_is_readable_by_optuna(tmp_path):
    out = summarise(tmp_path)
    # Written again, it has no trial twice, and the same bytes.
    first = (out / "study.journal").read_bytes()
    summarise(tmp_path)
    assert (out / "study.journal").read_bytes() == first
    storage = open_journal(out / "study.journal")
    study = optuna.load_study(study_name="tried", storage=storage)
    table = pd.read_csv(out / "summary.csv", dtype={"point": str})
    assert [trial.user_attrs["point"] for trial in study.trials] == table.point.tolist()
    assert study.best_params == {"width": 8, "train.lr": 0.004}
    failed = study.get_trials(states=[optuna.trial.TrialState.FAIL])
    assert [trial.number for trial in failed] == [2]
    # Distances of numbers are kept in figures, widths on a linear scale.
    assert not study.trials[0].distributions["width"].log


def test_points_without_any_metric_end_in_one_line(tmp_path):
    failed = [(*values, None) for *values, _ in OUTCOMES]
    with pytest.raises(points.SweepError, match=f"all 4 .* {0:012x}: the network died"):
        summarise(tmp_path, failed)


def test_a_metric_that_is_not_finite_is_never_the_best(tmp_path):
    scores = (np.nan, np.inf, -np.inf, 1.0)
    outcomes = [(*values, new) for (*values, _), new in zip(OUTCOMES, scores, strict=True)]
    out = summarise(tmp_path, outcomes)
    assert yaml.safe_load((out / "best.yaml").read_text())["point"] == f"{3:012x}"
    study = read_study(out / "study.journal")
    assert [trial.state.name for trial in study.trials] == ["FAIL"] * 3 + ["COMPLETE"]


# All but one point failed: Optuna has nothing to compare.
LONE = [(width, lr, score and None) for width, lr, score in OUTCOMES[:3]] + OUTCOMES[3:]


@pytest.mark.parametrize("outcomes", [OUTCOMES, LONE, [(4, 0.001, 1e-5), (8, 0.001, 1e-5)]])
def test_figures_show_every_point_or_say_why_not(tmp_path, outcomes):
    out = summarise(tmp_path, outcomes)
    for kind in ALL_AXES + TWO_AXES:
        path = out / f"{kind}.png"
        sweep_summary.sweep_figure(kind, out / "study.journal", path)
        assert path.read_bytes().startswith(b"\x89PNG")
    study = optuna.load_study(study_name="tried", storage=open_journal(out / "study.journal"))
    figure = draw_sweep(study, "response")
    count = sum(score is not None for *_, score in outcomes)
    for panel in figure.axes[:2]:
        drawn = panel.collections[0].get_offsets()
        assert len(drawn) == count and drawn[:, 1].min() == pytest.approx(10)
    has_failed = count < len(outcomes)
    assert figure.get_suptitle().endswith("failed" if has_failed else "points")


@pytest.mark.parametrize("content", [None, "", "no journal\n", '{"op_code": 0}\n'])
def test_a_missing_or_damaged_study_is_named(tmp_path, content):
    """No new file is made in its place."""
    path = tmp_path / "study.journal"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ProductError, match=r"study\.journal: (missing|damaged)"):
        read_study(path)
    assert path.is_file() == (content is not None)


def test_importance_of_negative_similarities_is_drawn(tmp_path):
    """SSIM may be below 0, where it has no logarithm."""
    files = write_points(tmp_path, OUTCOMES)
    for path, value in zip(files, (-0.1, 0.0, None, 0.9), strict=True):
        result = read_json(path)
        result["metrics"] = {} if value is None else {"validation_ssim": value}
        path.write_text(json.dumps(result))
    sweep = Sweep.model_validate(
        {**DEFINITION, "metric": "validation_ssim", "direction": "maximize"}
    )
    sweep_summary.tabulate_points("tried", sweep, OVERRIDES, files, tmp_path)
    (panel,) = draw_sweep(read_study(tmp_path / "study.journal"), "importance").axes
    assert "ln(1 − SSIM)" in panel.get_xlabel()
    assert sum(bar.get_width() for bar in panel.patches) == pytest.approx(1.0)


def test_stars_of_a_point_have_its_settings(tmp_path):
    """Stars of another telescope have the same name, and a hash after it."""
    trees, columns = {}, {"field_index": Column(np.arange(3), "1", "fields")}
    for ending, obscuration in (("", 0.0), ("_0123abcd", 0.2)):
        tree = {"scene": {"name": "seidel"}, "stars": {"name": "seidel_10pct"}}
        tree |= {"telescope": {"obscuration": obscuration}}
        path = tmp_path / f"data/seidel{ending}/seidel_10pct{ending}.h5"
        path.parent.mkdir(parents=True)
        write_product(path, "stars", columns, tree)
        trees[path] = {**tree, "train": {"lr": 0.1}}
    for path, tree in trees.items():
        assert find_stars(tmp_path, tree) == path
    assert find_stars(tmp_path, {**tree, "telescope": {"obscuration": 0.3}}) is None
    assert find_stars(tmp_path, {"train": {"lr": 0.1}}) is None


def test_sweep_is_a_parent_run_with_a_child_per_point(site):
    def actions():
        receipt = site.results / "receipt.csv"
        track.track(site.results, "smoke", site.database, receipt, sweeps=("tried",))
        with receipt.open(newline="") as file:
            return [row["action"] for row in csv.DictReader(file)]

    def runs():
        experiment = site.client.get_experiment_by_name("sweep_tried").experiment_id
        return {run.info.run_name: run for run in site.client.search_runs([experiment])}

    summarise(site.results)
    assert actions() == ["created"] * 5
    assert actions() == ["unchanged"] * 5
    children = runs()
    parent = children.pop("sweep tried")
    assert parent.data.metrics["best_validation_mse_1e-6"] == pytest.approx(10)
    assert parent.data.tags["best_point"] == f"{3:012x}"
    assert children["width=8, train.lr=0.001"].info.status == "FAILED"
    best_run = children["width=8, train.lr=0.004"].data
    assert best_run.metrics["test_mse_1e-6"] == pytest.approx(11)
    # A grid that has grown is another parent: old points move to it and are not doubled.
    width = {**DEFINITION["space"]["width"], "values": [4, 8, 16]}
    space = {**DEFINITION["space"], "width": width}
    summarise(site.results, [*OUTCOMES, (16, 0.004, 2e-5)], space=space)
    assert actions() == ["created", *["unchanged"] * 4, "created"]
    parents = {run.data.tags.get("mlflow.parentRunId") for run in runs().values()}
    assert len(parents - {None}) == 1
    assert parent.info.run_id not in parents
