"""The real DAG: what it builds, what it leaves alone, how it survives a killed job."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import psutil
import pytest

ROOT = Path(__file__).resolve().parents[1]
PATH = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"

pytestmark = pytest.mark.workflow


def command(folder, *arguments, overrides="", preset="smoke"):
    return [
        "snakemake",
        *("--snakefile", str(ROOT / "Snakefile"), "--directory", str(folder)),
        *("--workflow-profile", str(ROOT / "workflow/profiles/default"), "--cores", "2"),
        *arguments,
        *("--config", f"preset={preset}", "results=results", f"set={overrides}"),
    ]


def snakemake(folder, *arguments, check=True, **options):
    result = subprocess.run(
        command(folder, *arguments, **options),
        env={**os.environ, "PATH": PATH},
        capture_output=True,
        text=True,
        check=False,
    )
    if check:
        assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout + result.stderr


def planned(folder, *targets, **options):
    """Jobs of a dry run: number by rule, without the target itself."""
    out = snakemake(folder, "--dry-run", *targets, **options)
    table = re.search(r"^job +count\n-+ +-+\n(.*?)\n\n", out, re.M | re.S)
    if table is None:
        assert "Nothing to be done" in out, out
        return {}
    jobs = dict(line.split() for line in table[1].splitlines())
    return {rule: int(n) for rule, n in jobs.items() if rule not in ("total", "all", *targets)}


@pytest.fixture(scope="session")
def smoke(tmp_path_factory):
    """The whole DAG on tiny sizes, with its wall time in seconds."""
    folder = tmp_path_factory.mktemp("smoke")
    start = time.monotonic()
    snakemake(folder)
    return folder, time.monotonic() - start


def test_smoke_builds_everything_in_time(smoke):
    folder, seconds = smoke
    assert seconds < 180
    metrics = pd.read_csv(folder / "results/tables/psf_metrics.csv")
    assert list(metrics.columns) == (
        ["dataset", "split", "reference", "method", "noise_level", "metric", "value", "stderr", "n"]
    )
    assert set(metrics.method) == {"noisy", "pca_som", "lmmse", "dae"}
    assert set(metrics.metric) == {"mse", "ssim", "ssim_unit", "ssim_peak"}
    assert metrics.notna().all().all()
    assert (metrics[metrics.split == "random"].n == 50).all()


def test_original_noise_rows_are_the_noise_that_was_added(smoke):
    folder, _ = smoke
    metrics = pd.read_csv(folder / "results/tables/psf_metrics.csv")
    rows = metrics[
        (metrics.metric == "mse")
        & (metrics.method == "noisy")
        & (metrics.reference == "realisation")
    ]
    expected = (4.98 * rows.noise_level) ** 2 + 4.98 * rows.noise_level / 100 / 256
    assert (rows.value / expected).to_numpy() == pytest.approx(1, abs=0.05)


def test_everything_is_up_to_date_afterwards(smoke):
    folder, _ = smoke
    assert planned(folder) == {}


def test_second_run_gives_identical_bytes(smoke, tmp_path):
    folder, _ = smoke
    snakemake(tmp_path, "results/tables/dataset3_mse.csv", "results/tables/dataset8_mse.csv")
    compared = 0
    for suffix in ("h5", "safetensors", "csv", "md", "parquet"):
        for path in (tmp_path / "results").rglob(f"*.{suffix}"):
            if path.name != "history.csv":
                assert path.read_bytes() == (folder / path.relative_to(tmp_path)).read_bytes(), path
                compared += 1
    assert compared > 15


def test_one_dataset_lists_no_job_of_another(tmp_path):
    out = snakemake(tmp_path, "--dry-run", "dataset3")
    assert "dataset3" in out
    assert not re.search(r"dataset[1245678]", out)
    assert "50pct" not in out
    assert "turbulence" not in out


def test_scene_2_touches_nothing_of_scene_1(tmp_path):
    out = snakemake(tmp_path, "--dry-run", "scene2")
    assert "dataset7" in out
    assert "dataset8" in out
    assert not re.search(r"dataset[1-6]", out)
    assert "seidel" not in out


def test_scene_3_touches_nothing_of_the_others(tmp_path):
    jobs = planned(tmp_path, "scene3")
    assert jobs["alignment_cnn"] == 3
    assert all("alignment" in rule for rule in jobs), jobs


def test_changing_one_learning_rate_reruns_its_training_and_tables_only(smoke):
    folder, _ = smoke
    jobs = planned(folder, overrides="train.lr=0.002")
    assert not set(jobs) & {"templates", "stars", "baseline", "scan", "calibrate"}
    assert {"train", "evaluate", "psf_metrics"} <= set(jobs)


def test_same_value_in_another_format_reruns_nothing(smoke):
    folder, _ = smoke
    assert planned(folder, overrides="train.lr=0.0040 noise.kappa=4.980") == {}


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"overrides": "framing.stamp_px=6"}, "framing.stamp_px = 6"),
        ({"overrides": "trian.lr=1"}, "trian.lr"),
        ({"preset": "none"}, "preset/none"),
    ],
)
def test_wrong_config_stops_before_any_job(tmp_path, option, message):
    out = snakemake(tmp_path, check=False, **option)
    assert message in out
    assert not (tmp_path / "results").exists()


def test_unknown_command_line_key_is_refused(tmp_path):
    arguments = [*command(tmp_path), "presett=fast"]
    result = subprocess.run(
        arguments, env={**os.environ, "PATH": PATH}, capture_output=True, text=True, check=False
    )
    assert result.returncode != 0
    assert "presett" in result.stdout + result.stderr


def test_killed_training_resumes_and_repeats_nothing(smoke, tmp_path):
    source, _ = smoke
    shutil.copytree(source, tmp_path, dirs_exist_ok=True)
    slow = "train.epochs=120 train.checkpoint_seconds=0 train.batch=8"
    target = "results/dae/dataset3/random-realisation/dae.safetensors"
    checkpoint = tmp_path / "results/checkpoints/dataset3-random-realisation.pt"
    stars = tmp_path / "results/data/seidel/seidel_10pct.h5"
    written = stars.stat().st_mtime_ns
    run = subprocess.Popen(
        command(tmp_path, target, overrides=slow),
        env={**os.environ, "PATH": PATH},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 60
    while not checkpoint.exists():
        assert time.monotonic() < deadline, "the training left no checkpoint"
        time.sleep(0.05)
    for child in psutil.Process(run.pid).children(recursive=True):
        if "train" in child.cmdline() and "--checkpoint" in child.cmdline():
            child.kill()
    assert run.wait(60) != 0
    assert checkpoint.exists()
    assert not (tmp_path / target).exists()
    snakemake(tmp_path, target, overrides=slow)
    log = (tmp_path / "results/logs/dae/dataset3/random-realisation.log").read_text()
    assert "resuming after epoch" in log
    assert "epoch 120/120" in log
    assert stars.stat().st_mtime_ns == written
    assert not checkpoint.exists()


def test_killed_snakemake_needs_no_manual_step(smoke, tmp_path):
    """After SIGKILL its jobs run on and its lock stays; the wrapper of make deals with both."""
    source, _ = smoke
    shutil.copytree(source / "results/data", tmp_path / "results/data")
    target = "results/dae/dataset3/random-realisation/dae.safetensors"
    options = {"overrides": "train.epochs=80 train.checkpoint_seconds=0 train.batch=8"}
    locked = ["sh", str(ROOT / "workflow/locked.sh"), *command(tmp_path, target, **options)]
    environment = {**os.environ, "PATH": PATH}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    run = subprocess.Popen(locked, cwd=tmp_path, env=environment, **quiet)
    deadline = time.monotonic() + 60
    while not list((tmp_path / "results").glob("checkpoints/*.pt")):
        assert time.monotonic() < deadline, "the training left no checkpoint"
        time.sleep(0.05)
    orphans = psutil.Process(run.pid).children(recursive=True)
    run.kill()
    run.wait()
    assert any(child.is_running() for child in orphans)
    again = subprocess.run(
        locked, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert again.returncode == 0, again.stdout + again.stderr
    assert "waiting for it to end" in again.stderr
    assert (tmp_path / target).exists()


@pytest.mark.slow
def test_two_whole_runs_give_identical_bytes(smoke, tmp_path):
    """As above, for every data product, model and table of the default target."""
    folder, _ = smoke
    snakemake(tmp_path)
    suffixes = {".h5", ".safetensors", ".parquet", ".png", ".md"}
    products = [p for p in (folder / "results").rglob("*") if p.suffix in suffixes]
    products += (folder / "results/tables").glob("*.csv")
    products += (folder / "results/calibration").glob("*.csv")
    timed = ("curves.png", "alignment_time.csv")
    products = [p for p in products if "mlartifacts" not in p.parts and p.name not in timed]
    for path in products:
        assert path.read_bytes() == (tmp_path / path.relative_to(folder)).read_bytes(), path
    assert len(products) > 50


@pytest.mark.slow
def test_targets_on_request(smoke):
    """Benchmark, stress tests and bounds of the tiny run."""
    folder, _ = smoke
    snakemake(folder, "benchmark", "stability", "bounds")
    tables = folder / "results/tables"
    stability = pd.read_csv(tables / "stability.csv")
    assert list(stability.columns) == ["case", "quantity", "expected", "measured", "verdict"]
    assert (stability.verdict == "pass").all()
    bounds = pd.read_csv(tables / "psf_bounds.csv")
    columns = [
        "dataset",
        "split",
        "reference",
        "method",
        "noise_level",
        "metric",
        "value",
        "stderr",
    ]
    assert list(bounds.columns) == [*columns, "n", "ci_low", "ci_high", "tight"]
    assert set(bounds.method) == {"bayes", "floor"}
    choice = pd.read_csv(tables / "benchmark_choice.csv")
    assert (choice.configured == "yes").groupby(choice.scene).any().all()
    assert planned(folder, "benchmark", "stability", "bounds") == {}
