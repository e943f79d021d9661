"""Stars per second of the network, and how the costs of the stages grow."""

import os
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from timeit import Timer
from typing import Annotated

import numpy as np

from measure import isolate, measure_command, write
from prediction import make_cube
from psfdae.base.options import File
from psfdae.base.rng import stream
from psfdae.commands.cli import program
from psfdae.methods import method
from psfdae.methods.fit_files import get_rule_name
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.methods import list_method_groups
from psfdae_paper.configuration.schema import Config

BATCHES = (1, 16, 64, 256, 1024)
LARGEST_BATCH_PER_STAMP = 16  # larger ones than this times `benchmark.stamps` are left out
LEAST_S = 0.03  # a timing calls as often as it takes to last this long
PREDICTED_STARS = 1_000_000  # for which time, memory and disk are extrapolated
FIRST_RUN_STARS = 16  # stars of a first run, whose imports cost time and memory
COSTS = ("time_s", "peak_mb", "disk_mb")
PLANNED_STARS = 1_000_000_000
TRAINED_EPOCHS = 1  # the cost of more is that of their stars times epochs
SIMULATED = 2  # of the numbers of stars, the smallest, simulation and prediction are measured


@command("inference", reads=("dae", "benchmark"))
def inference(config: Config, out: Annotated[File, "CSV with stars per second."]) -> None:
    """Time the network in torch, on a quiet machine.

    Speed does not depend on the values of the weights, so random networks do. Widths are
    half, once and twice the configured one; stamps are the two smallest of the config.
    """
    settings, width = config.benchmark, max(config.dae.widths)
    sizes = list(product((width // 2, width, 2 * width), settings.stamp_sizes[:2]))
    largest_batch = LARGEST_BATCH_PER_STAMP * settings.stamps
    batches = [batch for batch in BATCHES if batch <= largest_batch]
    dae, rows = config.dae.model_dump(), []
    for threads in sorted({1, settings.threads}):
        rows += isolate(threads, time_networks, dae, sizes, batches, threads, settings.repeats)
    write(out, rows)


def make_network(dae, width, side):
    """A network of one width with random weights, and the factor of its images."""
    import torch

    from psfdae.methods.networks.dae import build_dae
    from psfdae.methods.networks.settings import image_scale

    widths, seed = [width] * len(dae["widths"]), torch.Generator().manual_seed(width)
    return build_dae(dae["kernels"], widths, "he", seed), image_scale(dae["scale"], side)


def network(dae, size, threads):
    """`predict` with a random network, as every stage calls it."""
    import torch

    from psfdae.methods.networks.dae import run_network

    torch.set_num_threads(threads)
    model, factor = make_network(dae, *size)
    return lambda images: run_network(model, images, factor, len(images))


def time_networks(dae, sizes, batches, threads, repeats):
    """Stars per second in this process, with median and extremes of the repeats."""
    rows = []
    for (width, side), batch in product(sizes, batches):
        apply = network(dae, (width, side), threads)
        noise = stream(0, "throughput").normal(0.0, 0.005, (batch, side, side))
        timer = Timer(partial(apply, (noise + side**-2.0).astype(np.float32)))
        timer.timeit(1)
        calls = max(1, round(LEAST_S / timer.timeit(1)))
        rates = calls * batch / np.array(timer.repeat(repeats, calls))
        row = {"width": width, "stamp_px": side, "threads": threads}
        row |= {"batch": batch, "repeats": repeats, "stars_per_s": np.median(rates)}
        rows.append(row | {"stars_per_s_low": rates.min(), "stars_per_s_high": rates.max()})
    return rows


@command("growth", reads=(*SIMULATION, "noise", "dae", "benchmark"))
def growth(
    config: Config, out: Annotated[File, "CSV with time, memory and disk over stars and side."]
) -> None:
    """Measure how simulation and prediction grow, on a quiet machine."""
    import pandas as pd

    counts, sides = config.benchmark.star_counts, config.benchmark.stamp_sizes
    frames = []
    with TemporaryDirectory() as folder:
        for against, sizes in (
            ("stars", [(count, config.framing.stamp_px) for count in counts]),
            ("stamp_px", [(counts[0], side) for side in sides]),
        ):
            rows = [row for size in sizes for row in chain(config, *size, Path(folder))]
            for _, part in pd.DataFrame(rows).groupby("what", sort=False):
                frames.append(add_exponents(part, against))
    write(out, pd.concat(frames).assign(threads=config.benchmark.threads))


def chain(config, count, side, folder):
    """Simulate stars, then predict their PSFs, one row each; memory and disk are in MiB."""
    threads, tree = config.benchmark.threads, config.model_dump()
    tree["framing"]["stamp_px"], tree["optics"]["threads"] = side, threads
    trees = [{**tree, "stars": {**tree["stars"], "count": n}} for n in (FIRST_RUN_STARS, count)]
    names = ("templates.h5", "stars.h5", "model.psf.safetensors", "stars.fits", "psf.fits")
    templates, stars, bundle, cube, psf = (folder / name for name in names)
    isolate(threads, measure_command, ["templates"], templates, tree)
    simulate = ["stars", "--templates", templates]
    costs = {"simulation": isolate(threads, measure_last, [(simulate, stars, t) for t in trees])}
    isolate(1, write_untrained_bundle, tree, stars, bundle)
    first_cube = cube.with_name("few.fits")
    for number, path in ((FIRST_RUN_STARS, first_cube), (count, cube)):
        isolate(1, make_cube, tree, stars, number, path)
    options = ["--model", bundle, "--threads", threads, "--overwrite", "--quiet"]
    predict = [(["predict", path, *options], psf) for path in (first_cube, cube)]
    costs["inference"] = isolate(threads, measure_last, predict)
    rows = []
    for stage, cost in costs.items():
        # Where the peak cannot be started anew, that of the imports may be the larger one.
        peak_mb = max((cost["peak_b"] - cost["resting_b"]) / 2**20, 0.1)
        row = {"what": stage, "stars": count, "stamp_px": side, "time_s": cost["time_s"]}
        rows.append(row | {"peak_mb": peak_mb, "disk_mb": cost["disk_b"] / 2**20})
    return rows


def measure_last(runs):
    """Cost of the last of some commands; imports of the first ones count no longer."""
    return [measure_command(*run) for run in runs][-1]


def write_untrained_bundle(tree, stars, out):
    """The shipped model with a random network and these stars' size of stamps."""
    from psfdae.base.files import read_product
    from psfdae.denoise.bundle import read_bundle, write_bundle
    from psfdae.denoise.error_model import ErrorModel
    from psfdae.denoise.flux_model import FluxModel
    from psfdae.methods.bundle_info import Architecture, BundleInfo
    from psfdae.stars.noise import noise_equivalent_px
    from psfdae.training.packing import leading

    images, dae, shipped = read_product(stars, "stars")["realisation"], tree["dae"], read_bundle()
    side, model = images.shape[-1], FluxModel.fit(images[:1000])
    network, factor = make_network(dae, max(dae["widths"]), side)
    nodes = shipped.errors.noise
    about = {
        **shipped.info.model_dump(exclude={"misfit"}),
        "stamp_px": side,
        "pixel_scale_arcsec": tree["telescope"]["pixel_scale_arcsec"],
        "image_scale": factor,
        "noise_equivalent_px": noise_equivalent_px(model.mean),
        "method": "dae",
        "dae": Architecture(kernels=dae["kernels"], widths=dae["widths"]),
    }
    bundle = replace(
        shipped,
        info=BundleInfo(**about),
        weights={k: v.contiguous().numpy() for k, v in network.state_dict().items()},
        flux_model=leading(model, shipped.info.components),
        errors=ErrorModel.build_uncalibrated(nodes, np.ones((len(nodes), side, side), np.float32)),
    )
    write_bundle(bundle, out)


def add_exponents(part, against):
    """Measured rows with the exponents of their costs and, over stars, a predicted row."""
    import pandas as pd
    from scipy.stats import linregress

    x = part[against].to_numpy(float)
    laws = {name: linregress(np.log(x), np.log(part[name])) for name in COSTS}
    table = part.assign(measured="yes")
    if against == "stars":
        row = part.iloc[-1].to_dict() | {"stars": PREDICTED_STARS, "measured": "extrapolated"}
        # Not the memory: both stages work on a piece of the stars at a time.
        names = [name for name in COSTS if name != "peak_mb"]
        row |= {"peak_mb": np.nan} | extrapolate(part.to_dict("records"), names, PREDICTED_STARS)
        table = pd.concat([table, pd.DataFrame([row])])
    table.insert(1, "against", against)
    # Two points leave the error of the exponent open.
    stderr = laws["time_s"].stderr if len(x) > 2 else np.nan
    table = table.assign(exponent=laws["time_s"].slope, exponent_stderr=stderr)
    exponents = {f"{name}_exponent": laws[f"{name}_mb"].slope for name in ("peak", "disk")}
    return table.assign(**exponents)


def extrapolate(rows, names, stars):
    """Costs of more stars than measured: a fixed part and a part per star, neither negative.

    Least squares of relative deviations, so that small and large sizes count alike.
    """
    from scipy.optimize import nnls

    costs = {}
    for name in names:
        relative = [(1.0 / row[name], row["stars"] / row[name]) for row in rows]
        fixed, per_star = nnls(np.array(relative), np.ones(len(rows)))[0]
        costs[name] = fixed + per_star * stars
    return costs


READS = ("parts", *list_method_groups(), "evaluation", "methods", "benchmark")


@command("stages", reads=(*SIMULATION, "noise", *READS))
def stages(config: Config, out: Annotated[File, "CSV with measured and planned costs."]) -> None:
    """Measure the stages that grow with the number of stars, on one CPU."""
    with TemporaryDirectory() as folder, stay_on_one_cpu():
        rows = measure_stages(config, Path(folder))
    write(out, rows + predict_plans(rows))


def measure_stages(config, folder):
    """Costs of every stage at the numbers benchmark.star_counts, four fifths for training."""
    threads, tree, rows = config.optics.threads, config.model_dump(), []
    # Whole stamps: epochs that see their middle cost less.
    tree["train"] |= {"epochs": TRAINED_EPOCHS, "crop_epochs": 0.0}
    names = ("templates.h5", "simulated.h5", "stars.h5", "stars.fits")
    templates, simulated, stars, cube = (folder / name for name in names)
    places = {kind: folder / kind.name for kind in map(method, config.methods) if kind.storage}
    bundle = folder / "model.psf.safetensors"
    isolate(threads, measure_command, ["templates"], templates, tree)

    def cost(stage, words, out, reads=tree):
        costs = isolate(threads if stage == "simulate" else 1, measure_command, words, out, reads)
        row = {"stage": stage, "stars": count, "epochs": TRAINED_EPOCHS * (stage == "train")}
        row |= {name: costs[name] for name in ("time_s", "cpu_s")}
        row |= {f"{name}_mb": costs[f"{name}_b"] / 1e6 for name in ("peak", "disk")}
        rows.append(row | {"measured": "yes"})

    for count in config.benchmark.star_counts[:SIMULATED]:
        tree["stars"]["count"] = count
        cost("simulate", ["stars", "--templates", templates], simulated)
    stars_option = ["--stars", stars]
    for i, count in enumerate(config.benchmark.star_counts):
        tree["parts"] |= {"train_stars": 4 * count // 5, "test_stars": count - 4 * count // 5}
        isolate(1, repeat_stars, simulated, count, stars)
        models = ["--dataset", "measured"]
        for kind, place in places.items():
            checkpoint_option = ["--checkpoint", folder / "fit.pt"]
            cost(get_rule_name(kind), ["fit", kind.name, *stars_option, *checkpoint_option], place)
            models += [f"--{kind.name.replace('_', '-')}", place]
        models += ["--per-star", folder / "per_star.parquet", "--restored", folder / "shown.h5"]
        cost("evaluate", ["evaluate", *stars_option, *models], folder / "summary.csv")
        if i < SIMULATED:
            isolate(1, write_untrained_bundle, tree, stars, bundle)
            isolate(1, make_cube, tree, stars, count, cube)
            options = ["--model", bundle, "--threads", 1, "--overwrite", "--quiet"]
            cost("predict", ["predict", cube, *options], folder / "psf.fits", None)
    return rows


def repeat_stars(stars, count, out):
    """Write as many stars as asked for by repeating those of a product.

    What the stages cost does not depend on what the stars look like.
    """
    from psfdae.base.files import Column, read_product, write_product

    per_star = ("realisation", "template", "field_index")
    product = read_product(stars, "stars", (*per_star, "grid"))
    rows = np.arange(count) % len(product["field_index"])
    columns = {name: Column(product[name][rows], "1", "repeated") for name in per_star}
    columns["grid"] = Column(product["grid"], "1", "as of the product that is repeated")
    write_product(out, "stars", columns, product.config)


@contextmanager
def stay_on_one_cpu():
    """Keep this process and those it starts on one CPU, as a job of the SLURM profile is."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cpus = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cpus)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cpus)


def predict_plans(rows):
    """A row of `PLANNED_STARS` per stage."""
    stages = {}
    for row in rows:
        stages.setdefault(row["stage"], []).append(row)
    return [
        {**part[0], "stars": PLANNED_STARS, "measured": "extrapolated"}
        | extrapolate(part, ("cpu_s", *COSTS), PLANNED_STARS)
        for part in stages.values()
    ]


if __name__ == "__main__":
    program(inference, growth, stages)
