"""The real DAG: what it builds, what it leaves alone, how it survives a killed job."""

from __future__ import annotations

import json
import os
import re
import shutil

import h5py
import numpy as np
import pandas as pd
import pytest
from skimage.metrics import mean_squared_error, structural_similarity

from docs_pages import read
from psfdae.files import read_product
from psfdae.methods import method
from psfdae.model.star_sets import noisy_test_images, read_stars, split_stars
from psfdae_paper.configuration.aligners import ESTIMATORS
from psfdae_paper.configuration.compose import load
from psfdae_paper.evaluation.comparison import seed_scatter
from psfdae_paper.stages.bounds import COLUMNS as BOUND_COLUMNS
from workflow_runs import PATH, ROOT, captured, command, planned, snakemake

pytestmark = pytest.mark.workflow

COLUMNS = ["dataset", "split", "reference", "method", "noise_level", "metric"]
COLUMNS += ["value", "stderr", "seed_stderr", "n"]


def test_smoke_builds_everything(smoke):
    metrics = pd.read_csv(smoke / "results/tables/psf_metrics.csv")
    assert list(metrics.columns) == COLUMNS
    assert set(metrics.method) == {"noisy", "pca_som", "lmmse", "dae", "gmm", "gmm_position"}
    sure = metrics.method.str.startswith("gmm")
    found = {"mse", "ssim", "ssim_unit", "ssim_peak"}
    assert set(metrics.metric[~sure]) == found
    assert set(metrics.metric[sure]) == found | {"coverage68", "evidence"}
    assert metrics.drop(columns="seed_stderr").notna().all().all()
    fits = zip(metrics.dataset, metrics.reference, metrics.method, strict=True)
    known = metrics.metric.isin(found) & np.array([fit in seed_scatter() for fit in fits])
    assert (metrics.seed_stderr.notna() == known).all()
    assert (metrics[metrics.split == "random"].n == 50).all()


def test_original_noise_rows_are_the_noise_that_was_added(smoke):
    metrics = pd.read_csv(smoke / "results/tables/psf_metrics.csv")
    rows = metrics[
        (metrics.metric == "mse")
        & (metrics.method == "noisy")
        & (metrics.reference == "realisation")
    ]
    expected = (4.98 * rows.noise_level) ** 2 + 4.98 * rows.noise_level / 100 / 256
    assert (rows.value / expected).to_numpy() == pytest.approx(1, abs=0.05)


def test_errors_of_single_stars_are_scikit_image_s(smoke):
    """Every test star of one column of the tables, its noise drawn again."""
    config = load(["dataset=dataset3", "preset=smoke"])
    stars = read_stars(smoke / "results/data/seidel/seidel_10pct.h5", "realisation")
    test = split_stars(stars, "random", config).test
    truth = stars["realisation"][test].astype(float)
    noisy = noisy_test_images(config, stars, test, 0.003).astype(float)
    table = pd.read_parquet(smoke / "results/evaluation/dataset3/random-realisation.parquet")
    table = table[(table.method == "noisy") & (table.noise_level == 0.003)]
    assert table.star.to_list() == test.tolist()
    for number, row in enumerate(table.itertuples()):
        pair = noisy[number], truth[number]
        assert row.mse == pytest.approx(mean_squared_error(*pair), rel=1e-6)
        peak = np.ptp(pair[1])
        for found, data_range in (
            (row.ssim, config.evaluation.data_range),
            (row.ssim_unit, 1.0),
            (row.ssim_peak, peak),
        ):
            expected = structural_similarity(*pair, data_range=data_range)
            assert found == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("target", "own", "others"),
    [
        ("dataset3", "dataset3", "dataset[1245678]|50pct|turbulence"),
        ("scene2", "dataset8", "dataset[1-7]|seidel"),
        ("scene3", "alignment_network", "dataset[1-8]|seidel|turbulence"),
    ],
)
def test_a_target_lists_no_job_of_another(tmp_path, target, own, others):
    out = snakemake(tmp_path, "--dry-run", target)
    assert re.search(own, out, re.S)
    assert not re.search(others, out)


def test_same_value_in_another_format_reruns_nothing(smoke):
    assert planned(smoke) == {}
    assert planned(smoke, overrides="train.lr=0.0060 noise.kappa=4.980") == {}


@pytest.mark.slow
def test_interval_of_checkpoints_reruns_nothing(smoke):
    groups = ("train", "dae_train", "train_original", "train_dae_retrained")
    given = [f"{group}.checkpoint_seconds=1.5" for group in groups]
    assert planned(smoke, overrides=" ".join(given)) == {}


@pytest.mark.slow
def test_command_of_the_readme_with_another_telescope(tmp_path):
    """Templates and stars are made; all that follows is planned."""
    (given,) = re.findall(r'SET="(.*wfsat_literal)"', (ROOT / "README.md").read_text())
    # A field in the centre and those on the edge, where peaks lie farthest out.
    few = (
        "grid.points=3 grid.spacing_deg=5.5 stars.count=27 parts.train_stars=18 parts.test_stars=9"
    )
    stars = "results/data/seidel/seidel_10pct.h5"
    snakemake(tmp_path, stars, overrides=f"{given} {few} baseline.components=8", preset="fast")
    config = read_product(tmp_path / stars, "stars", ()).config
    assert config["telescope"]["name"] == "wfsat_literal"
    assert config["framing"]["search_px"] == config["stars"]["search_px"] == 239
    jobs = planned(tmp_path / "whole", "dataset3", overrides=given, preset="fast")
    assert {"templates", "stars", "train", "evaluate", "paper_tables", "track"} <= set(jobs)


def test_keys_of_one_scene_leave_the_others_alone(smoke):
    """The README's SET with a key of scene 1 alone, and one that is too small for scene 2."""
    jobs = planned(smoke, "scene1", "dataset5", "scene2", overrides="wavefront.coma=3.5")
    assert jobs["templates"] == jobs["stars"] - 1 == 1
    for scene, r0 in (("scene1", {}), ("scene2", {"templates": 1, "stars": 1})):
        found = planned(smoke, scene, overrides="wavefront.r0_m=0.15")
        assert {rule: n for rule, n in found.items() if rule in ("templates", "stars")} == r0


@pytest.mark.slow
def test_sizes_have_to_fit_together_where_a_dataset_is_built(tmp_path):
    options = {"overrides": "stars.count=9000", "preset": "fast"}
    assert planned(tmp_path, "dataset3", **options)["stars"] == 1
    out = snakemake(tmp_path, "--dry-run", "dataset7", check=False, **options)
    refusal = (
        "psfdae: dataset=dataset7: parts.train_stars + parts.test_stars = 10000: "
        "must be at most stars.count = 9000"
    )
    assert refusal in out.splitlines()
    assert "Traceback" not in out


def test_damaged_yaml_is_one_line(tmp_path, monkeypatch):
    shutil.copytree(ROOT / "config", tmp_path / "config")
    path = tmp_path / "config/train/onecycle.yaml"
    path.write_text("epochs: 12\n\tbatch: 32\n")
    monkeypatch.setenv("PSFDAE_CONFIG", str(tmp_path / "config"))
    out = snakemake(tmp_path, check=False)
    said = [line for line in out.splitlines() if "workflow specific profile" not in line]
    assert len(said) == 1
    assert said[0].startswith(f"psfdae: {path}: line 2, column 1: ")


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"overrides": "framing.stamp_px=6"}, "framing.stamp_px = 6"),
        ({"overrides": "trian.lr=1"}, "trian.lr"),
        pytest.param(
            {"overrides": "stars.count=0"},
            "stars.count = 0: input should be greater",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"overrides": "train.lr='2e-3"}, "No closing quotation", marks=pytest.mark.slow
        ),
        pytest.param({"preset": "none"}, "preset/none", marks=pytest.mark.slow),
    ],
)
def test_wrong_config_stops_before_any_job(tmp_path, option, message):
    out = snakemake(tmp_path, check=False, **option)
    (line,) = [line for line in out.splitlines() if message in line]
    assert line.startswith("psfdae: ")
    assert "Traceback" not in out
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    "word",
    ["presett=fast", "results=my results", "results=$(touch pwned)", "results=a;b", "preset=a/b"],
)
def test_what_is_no_plain_word_or_unknown_is_refused(tmp_path, word):
    result = captured([*command(tmp_path), word], env={**os.environ, "PATH": PATH})
    assert result.returncode != 0
    assert word.partition("=")[0] in result.stdout + result.stderr
    assert {path.name for path in tmp_path.iterdir()} <= {".snakemake"}


@pytest.mark.slow
def test_two_whole_runs_give_identical_bytes(smoke, tmp_path):
    """Every data product, model and table of the default target."""
    snakemake(tmp_path)
    suffixes = {".h5", ".safetensors", ".parquet", ".png", ".md"}
    products = [p for p in (tmp_path / "results").rglob("*") if p.suffix in suffixes]
    for name in ("tables", "calibration", "evaluation"):
        products += (tmp_path / "results" / name).rglob("*.csv")
    timed = ("curves.png", "alignment_time.csv")
    products = [p for p in products if "mlartifacts" not in p.parts and p.name not in timed]
    for path in products:
        assert path.read_bytes() == (smoke / path.relative_to(tmp_path)).read_bytes(), path
    assert len(products) > 50


@pytest.mark.slow
def test_targets_on_request(smoke, tmp_path):
    """Benchmark, stress tests and bounds of the tiny run."""
    # Other tests want the folder as the default target leaves it.
    folder = shutil.copytree(smoke, tmp_path / "run", symlinks=True)
    # It knows where the results lay; the next import makes another.
    (folder / "results/mlflow.db").unlink()
    snakemake(folder, "benchmark", "stability", "bounds")
    tables = folder / "results/tables"
    stability = pd.read_csv(tables / "stability.csv")
    assert list(stability.columns) == ["case", "quantity", "expected", "measured", "verdict"]
    assert (stability.verdict == "pass").all()
    bounds = pd.read_csv(tables / "psf_bounds.csv")
    assert bounds.columns.tolist() == BOUND_COLUMNS
    assert set(bounds.method) == {"bayes", "bayes_position", "floor"}
    assert set(pd.read_csv(tables / "benchmark_peers.csv").columns) >= {"scene", "method"}
    assert planned(folder, "benchmark", "stability", "bounds") == {}


def test_the_data_card_describes_the_files(smoke):
    """Arrays, their types, units and meanings; what is in brackets the card adds."""
    tables = re.split(r"^`(\w+)` \(", read("docs/data_card.md"), flags=re.M)[1:]
    rows = {
        kind: {
            name: (dtype, unit, about.partition(" (in scene")[0])
            for name, _, dtype, unit, about in re.findall(
                r"^\| `(\w+)` \| (.+?) \| (\w+) \| (.+?) \| (.+) \|$", text, re.M
            )
        }
        for kind, text in zip(tables[::2], tables[1::2], strict=True)
    }
    seen = {kind: set() for kind in rows}
    for path in sorted((smoke / "results/data").rglob("*.h5")):
        with h5py.File(path) as file:
            kind = file.attrs["kind"]
            assert f"{path.parent.name}/{path.name}" in read("docs/data_card.md")
            for name, array in file.items() if kind in rows else ():
                dtype, unit, about = rows[kind][name]
                assert (str(array.dtype), array.attrs["unit"]) == (dtype, unit), (path, name)
                alike = {about} | ({"static PSF, sum 1"} if name == "realisation" else set())
                assert array.attrs["about"] in alike, (path, name)
                seen[kind].add(name)
    assert seen == {kind: set(names) for kind, names in rows.items()}


@pytest.mark.parametrize(("target", "pictures"), [("all", 3), ("dataset8", 2)])
def test_the_report_opens_with_its_main_pictures_and_all_methods(smoke, tmp_path, target, pictures):
    report = tmp_path / "report.html"
    snakemake(smoke, "--report", str(report), target)
    first = json.loads(re.search(r"var workflow_desc = (\".*\");\n", report.read_text())[1])
    assert len(re.findall(r'<img [^>]*src="data:image/png', first)) == pictures
    words = " ".join(re.sub("<[^>]+>", "", first).split())
    assert ("the target scene3" in words) == (target == "dataset8")
    assert ("Scene 3 (not built in this run)" in words) == (target == "dataset8")
    config = load(["dataset=dataset8", "preset=smoke"])
    for label in (*(method(name).look.label for name in config.methods), ESTIMATORS[0].look.label):
        assert label in words
