"""A results folder of finished runs, and its database of MLflow."""

from __future__ import annotations

import csv
import shutil
import sqlite3

import numpy as np
import yaml

from psfdae.base.files import Column, write_product, write_text
from psfdae_paper.stages import track

TABLES = ("runs", "metrics", "params", "tags", "inputs", "logged_models", "model_versions")
PNG = b"\x89PNG\r\n\x1a\n"
ALL = ("noisy", "pca_som", "dae")
"""The methods of the table of errors, each of which is a run."""
HISTORY = ((1, 3e-5, "nan", 1.5), (2, 2e-5, 1e-5, 3.0), (3, 1e-5, 2e-5, 4.5))


def write_history(path, rows=HISTORY):
    lines = [f"{epoch},{10 * epoch},0.001,{t},{v},{s}" for epoch, t, v, s in rows]
    path.write_text("\n".join(["epoch,step,lr,train_mse,validation_mse,seconds", *lines, ""]))


def write_config(path, **train):
    noise = {"name": "noise3", "levels": [0.003], "kappa": 4.98, "background_photons": 1e4}
    parts = {"train_stars": 30, "test_stars": 10, "validation_fraction": 0.1}
    tree = {"seed": 7, "noise": noise, "parts": parts, "split": "random", "reference": "template"}
    tree |= {"dae": {"widths": [4, 4]}, "train": {"lr": 0.001, **train}, "attempt": 1}
    path.write_text(yaml.safe_dump(tree))


def write_stars(path, **scene):
    """40 equal stars of 8 × 8 pixels, each in a field of its own."""
    images = np.full((40, 8, 8), 1 / 64, np.float32)
    columns = {
        "realisation": Column(images, "1", "stars"),
        "template": Column(images, "1", "templates"),
        "field_index": Column(np.arange(40), "1", "fields"),
        "grid": Column(np.stack([np.arange(40)] * 2, axis=1), "1", "places"),
    }
    telescope = {"diameter_m": 1.0, "wavelength_m": 5.5e-7, "pixel_scale_arcsec": 0.1}
    tree = {"seed": 7, "scene": {"experiment": "scene1"}, "stars": {"name": "seidel_10pct"}}
    tree |= {"telescope": telescope, "framing": {"jitter_px": 1}}
    write_product(path, "stars", columns, tree | scene)


def write_tree(results):
    """A results folder as the workflow leaves it, without any training."""
    dataset, reference = "dataset3", "template"
    values = {"a": Column(np.arange(3.0), "1", "values")}
    stars = results / "data/seidel/stars.h5"
    write_stars(stars)
    baseline = {"seed": 7, "baseline": {"components": 2}}
    write_product(results / f"pca_som/{dataset}/random.h5", "pca_som", values, baseline)
    dae = results / f"dae/{dataset}/random-{reference}"
    dae.mkdir(parents=True)
    (dae / "dae.safetensors").write_bytes(b"weights")
    write_history(dae / "history.csv")
    write_config(dae / "config.yaml")
    evaluation = results / f"evaluation/{dataset}/random-{reference}.csv"
    evaluation.parent.mkdir(parents=True)
    rows = ["dataset,split,reference,method,noise_level,metric,value,stderr,n"]
    for i, method in enumerate(("noisy", "pca_som", "dae"), start=1):
        for metric, value in (("mse", i * 1e-5), ("ssim", i / 10)):
            rows.append(f"{dataset},random,{reference},{method},0.003,{metric},{value:g},1e-7,50")
    evaluation.write_text("\n".join([*rows, ""]))
    key = {"dataset": dataset, "split": "random", "reference": reference}
    tree = yaml.safe_load((dae / "config.yaml").read_text())
    settings = {group: tree[group] for group in ("seed", "noise", "parts")}
    write_product(evaluation.with_suffix(".h5"), "restored", values, {**settings, **key})
    # What Snakemake says of the job.
    write_text(results / "benchmarks/baseline/dataset3/random.tsv", "s\tmax_rss\n12.5\t90\n")
    figures = results / f"figures/{dataset}"
    figures.mkdir(parents=True)
    for name in ("curves", f"random-{reference}_strip", "held_out-template_strip"):
        (figures / f"{name}.png").write_bytes(PNG)
    return {dataset: stars}


class Site:
    """A results folder with its own copy of the database."""

    def __init__(self, root, empty_database):
        self.results = root / "results"
        self.stars = write_tree(self.results)
        self.database = self.results / "mlflow.db"
        self.dae = self.results / "dae/dataset3/random-template"
        shutil.copy(empty_database, self.database)

    def track(self):
        """Import everything; actions by kind of run, as the receipt tells."""
        receipt = self.results / "runs.csv"
        stars = tuple(self.stars.items())
        track.track(self.results, "smoke", self.database, receipt, stars)
        with receipt.open(newline="") as file:
            return {row["kind"]: row["action"] for row in csv.DictReader(file)}

    @property
    def client(self):
        from mlflow import MlflowClient

        return MlflowClient(f"sqlite:///{self.database}")

    def runs(self, kind="dae", experiment="scene1"):
        number = self.client.get_experiment_by_name(experiment).experiment_id
        query = f"tags.kind = '{kind}'" if experiment == "scene1" else ""
        return self.client.search_runs([number], query)

    def history(self, run, metric):
        return self.client.get_metric_history(run.info.run_id, metric)

    def rows(self):
        """The number of rows of all runs, metrics and models, which an import must not double."""
        with sqlite3.connect(self.database) as connection:
            counts = [connection.execute(f"select count(*) from {table}") for table in TABLES]
            return [count.fetchone()[0] for count in counts]
