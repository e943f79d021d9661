"""Additions of one's own: how many files a method, a stage or a dataset takes.

A method is a class, its settings, and a name in the list, and it is everywhere. So is the method of
docs/developers.md, which learns.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys

import pandas as pd
import pytest
import yaml
from astropy.io import fits

from workflow_runs import ROOT, copy_of_sources, environment, planned, snakemake

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

CLASS = '''
"""Toy: images drawn towards the mean of the training references."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from psfdae.methods.interface import Look, Method, Storage
from psfdae.base.settings import Group


class Settings(Group):
    """How far."""

    weight: Annotated[float, Field(ge=0, le=1)]
    """Weight of the image; 0 gives the mean."""


@dataclass(frozen=True)
class Shrunk(Method):
    """Toy."""

    look = Look("toy", "#aa3377", "v")
    groups: ClassVar = {"shrunk": Settings}
    storage = Storage({"mean": ("flux", "mean reference"), "weight": ("", "of the image")})

    mean: np.ndarray
    weight: np.ndarray

    @classmethod
    def fit(cls, data, shrunk):
        mean = data.references[data.train].mean(axis=0, dtype=np.float64)
        return cls(mean.astype(np.float32), np.array([shrunk.weight], np.float32))

    def predict(self, noisy):
        return self.mean + self.weight * (noisy - self.mean)
'''
STAGE = '''
"""Stage `count-fields`."""

from typing import Annotated

from psfdae.base.files import write_text
from psfdae.base.options import File
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.schema import Config


@command("count-fields", reads=("grid",))
def count_fields(config: Config, out: Annotated[File, "Text."]) -> None:
    """Count the fields."""
    write_text(out, str(config.grid.points**2))
'''
RULE = """
rule count_fields:
    output:
        f"{RESULTS}/fields.txt",
    params:
        config=lambda w: settings(RUN, "count-fields", "dataset=dataset3"),
        source=hash_code("count-fields"),
    shell:
        "psfdae count-fields --config {params.config} --out {output}"
"""
DATASET = """# @package _global_
defaults:
  - dataset3
  - _self_

dataset:
  name: mine
"""
REFERENCES = ("realisation", "template")
SWEEP = {
    **{"kind": "grid", "model": "shrunk", "dataset": "dataset3"},
    **{"metric": "validation_mse", "direction": "minimize"},
    "space": {"shrunk.weight": [0.0, 0.25, 1.0]},
}


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """The sources with the toy and the page's method in them."""
    root = copy_of_sources(tmp_path_factory.mktemp("tree"))
    methods = root / "src/psfdae_paper/methods"
    (methods / "shrunk.py").write_text(CLASS)
    shutil.copy(ROOT / "docs/trained_kernel.py", methods / "kernel.py")
    (root / "config/shrunk").mkdir()
    (root / "config/shrunk/default.yaml").write_text("weight: 0.5\n")
    path = root / "config/config.yaml"
    text = path.read_text()
    assert text.count("gmm_position]") == 1
    path.write_text(text.replace("gmm_position]", "gmm_position, shrunk, kernel]"))
    (root / "config/sweep/tried.yaml").write_text(yaml.safe_dump({"tried": SWEEP}))
    return root


@pytest.fixture(scope="module")
def run(tree, tmp_path_factory):
    """Folder of a tiny run of dataset 3 and of the sweep."""
    folder = tmp_path_factory.mktemp("run")
    wanted = ("mlflow/dataset3.csv", "tables/psf_metrics.csv", "mlflow/sweep_tried.csv")
    wanted += ("figures/dataset3/curves.png",)
    bundles = [f"bundles/dataset3-random-{ref}-shrunk.psf.safetensors" for ref in REFERENCES]
    targets = [f"results/{name}" for name in (*wanted, *bundles, "tables/from_stars.csv")]
    snakemake(folder, *targets, root=tree, overrides="workflow.datasets=[dataset3]")
    return folder


def psfdae(tree, folder, *words):
    process = subprocess.run(
        [sys.executable, "-m", "psfdae", *map(str, words)],
        cwd=folder,
        env=environment(PYTHONPATH=str(tree / "src")),
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout


def test_toy_is_in_the_tables_of_metrics(run):
    table = pd.read_csv(run / "results/tables/psf_metrics.csv")
    toy_rows = table[table["method"] == "shrunk"]
    assert set(toy_rows["reference"]) == set(REFERENCES)
    assert set(toy_rows["split"]) == {"random", "held_out"}
    assert len(toy_rows) == len(table[table["method"] == "dae"])
    assert (table["method"] == "kernel").sum() == len(toy_rows)
    table = pd.read_csv(run / "results/tables/from_stars.csv")
    assert {"noisy", "pca_som", "dae", "shrunk"} <= set(table["method"])


def test_toy_is_swept_and_its_runs_are_in_mlflow(run):
    names = ("dataset3", "sweep_tried")
    runs = pd.concat(pd.read_csv(run / f"results/mlflow/{name}.csv") for name in names)
    assert runs["source"].str.startswith(("shrunk/", "sweeps/tried")).sum() >= 4 + 3
    assert runs["source"].str.startswith("kernel/").sum() == 4
    summary = pd.read_csv(run / "results/sweeps/tried/summary.csv")
    assert summary["shrunk.weight"].tolist() == [0.0, 0.25, 1.0]
    assert (summary["status"] == "finished").all() and summary["validation_mse"].nunique() == 3


def test_predict_takes_the_toy(run, tree):
    bundle = run / "results/bundles/dataset3-random-realisation-shrunk.psf.safetensors"
    assert "toy" in psfdae(tree, run, "describe", bundle)
    example, out = run / "results/own_stars/example", run / f"{bundle.name}.fits"
    psfdae(
        *(tree, run, "predict", example / "image.fits", "--catalogue", example / "stars.csv"),
        *("--model", bundle, "--pixel-scale", 0.1, "--out", out, "--quiet"),
    )
    assert fits.getdata(out).shape[1:] == (16, 16)


def added(root, name, text):
    """Append to a file."""
    with (root / name).open("a") as file:
        file.write(text)


def test_a_stage_is_three(tree, tmp_path):
    added(tree, "src/psfdae_paper/stages/count_fields.py", STAGE)
    added(tree, "workflow/rules/count.smk", RULE)
    added(tree, "workflow/Snakefile", '\n\ninclude: "rules/count.smk"\n')
    snakemake(tmp_path, "results/fields.txt", root=tree, overrides="grid.points=3")
    assert (tmp_path / "results/fields.txt").read_text() == "9"


def test_a_dataset_is_one(tree, tmp_path):
    added(tree, "config/dataset/mine.yaml", DATASET)
    jobs = planned(tmp_path, "mine", root=tree)
    assert {"templates", "stars", "train", "evaluate", "track"} <= set(jobs)


@pytest.mark.parametrize(
    ("stars", "file"),
    [
        ("aberration_fraction: 0.25", r"seidel_10pct_[0-9a-f]{8}"),
        ("name: own, aberration_fraction: 0.25", "own"),
    ],
)
def test_stars_of_its_own_have_a_name_of_their_own(tree, tmp_path, stars, file):
    """Datasets share the stars of a name only while all settings of the simulation agree."""
    path, text = tree / "config/dataset/other.yaml", DATASET.replace("mine", "other")
    path.write_text(f"{text}stars: {{{stars}}}\n")
    plan = snakemake(tmp_path, "--dry-run", "other", root=tree)
    assert re.search(rf"/data/seidel/{file}\.h5", plan)
    assert not re.search(r"/data/seidel/seidel_10pct\.h5", plan)
    assert planned(tmp_path, "other", root=tree)["stars"] == 1
