"""What the stages cost over the number of stars on one CPU, and what 10⁹ stars would."""

import os
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np

from measure import alone, cost_of_command, write
from prediction import make_cube
from psfdae.cli import File, command, program
from psfdae.configuration.schema import Config
from psfdae.configuration.stages import SIMULATION
from speed import untrained_bundle

PLANNED_STARS = 1_000_000_000
TRAINED_EPOCHS = 1  # the cost of more is that of their stars times epochs
SIMULATED = 2  # of the numbers of stars, the smallest, simulation and prediction are measured
COSTS = ("time_s", "cpu_s", "peak_mb", "disk_mb")
READS = (*SIMULATION, "noise", "parts", "dae", "train", "baseline", "evaluation", "methods")


@command("stages", reads=(*READS, "benchmark"))
def stages(config: Config, out: Annotated[File, "CSV with measured and planned costs."]) -> None:
    """Measure the stages that grow with the number of stars, on one CPU."""
    with TemporaryDirectory() as folder, one_cpu():
        rows = measured(config, Path(folder))
    write(out, rows + planned(rows))


def measured(config, folder):
    """Costs of every stage at the numbers benchmark.star_counts, four fifths for training."""
    threads, tree, rows = config.optics.threads, config.model_dump(), []
    tree["train"]["epochs"] = TRAINED_EPOCHS
    names = ("templates.h5", "simulated.h5", "stars.h5", "pca_som.h5", "dae", "stars.fits")
    templates, simulated, stars, pca_som, dae, cube = (folder / name for name in names)
    bundle = folder / "model.psf.safetensors"
    alone(threads, cost_of_command, ["templates"], templates, tree)

    def cost(stage, words, out, reads=tree):
        found = alone(threads if stage == "simulate" else 1, cost_of_command, words, out, reads)
        row = {"stage": stage, "stars": count, "epochs": TRAINED_EPOCHS * (stage == "train")}
        row |= {name: found[name] for name in ("time_s", "cpu_s")}
        row |= {f"{name}_mb": found[f"{name}_b"] / 1e6 for name in ("peak", "disk")}
        rows.append(row | {"measured": "yes"})

    for count in config.benchmark.star_counts[:SIMULATED]:
        tree["stars"]["count"] = count
        cost("simulate", ["stars", "--templates", templates], simulated)
    given = ["--stars", stars]
    for i, count in enumerate(config.benchmark.star_counts):
        tree["parts"] |= {"train_stars": 4 * count // 5, "test_stars": count - 4 * count // 5}
        alone(1, repeat_stars, simulated, count, stars)
        cost("baseline", ["baseline", *given], pca_som)
        cost("train", ["train", *given, "--checkpoint", folder / "train.pt"], dae)
        models = ["--dataset", "measured", "--pca-som", pca_som, "--dae", dae]
        per_star = ["--per-star", folder / "per_star.parquet"]
        cost("evaluate", ["evaluate", *given, *models, *per_star], folder / "summary.csv")
        if i < SIMULATED:
            alone(1, untrained_bundle, tree, stars, bundle)
            alone(1, make_cube, tree, stars, count, cube)
            options = ["--model", bundle, "--threads", 1, "--overwrite", "--quiet"]
            cost("predict", ["predict", cube, *options], folder / "psf.fits", None)
    return rows


def repeat_stars(stars, count, out):
    """Write as many stars as asked for by repeating those of a product.

    What the stages cost does not depend on what the stars look like.
    """
    from psfdae.files import Column, read_product, write_product

    per_star = ("realisation", "template", "field_index")
    product = read_product(stars, "stars", (*per_star, "grid"))
    rows = np.arange(count) % len(product["field_index"])
    columns = {name: Column(product[name][rows], "1", "repeated") for name in per_star}
    columns["grid"] = Column(product["grid"], "1", "as of the product that is repeated")
    write_product(out, "stars", columns, product.config)


@contextmanager
def one_cpu():
    """Keep this process and those it starts on one CPU, as a job of the SLURM profile is."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def planned(rows):
    """A row of `PLANNED_STARS` per stage: a fixed part and a part per star, neither negative.

    Least squares of relative deviations, so that small and large sizes count alike.
    """
    from scipy.optimize import nnls

    found = []
    for stage in dict.fromkeys(row["stage"] for row in rows):
        part = [row for row in rows if row["stage"] == stage]
        row = {**part[0], "stars": PLANNED_STARS, "measured": "extrapolated"}
        for name in COSTS:
            relative = [(1.0 / r[name], r["stars"] / r[name]) for r in part]
            fixed, each = nnls(np.array(relative), np.ones(len(part)))[0]
            row[name] = fixed + each * PLANNED_STARS
        found.append(row)
    return found


if __name__ == "__main__":
    program(stages)
