"""Test error against fitting time: which training, which PCA+SOM is large enough."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Annotated

import numpy as np
from pydantic import Field

from measure import isolated, pareto, write, yes
from psfdae.base.belonging import STARS, require
from psfdae.base.files import read_product, write_csv
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_table, read_yaml
from psfdae.base.settings import Group, Reference
from psfdae.base.threads import limit_threads
from psfdae.commands.cli import program
from psfdae.methods import fit_files as fits
from psfdae.methods import groups_of, method
from psfdae.model import star_sets
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.compose import config_dir, decisive_settings, load_file, part
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.methods import all_groups
from psfdae_paper.configuration.schema import Config

PATIENCE = 5  # validations without a better one after which a training no longer improves
WORTHWHILE = 0.9  # fraction to which each doubling of the time must bring the error

SIZES = ("components", "rows", "columns", "epochs")
COMPONENTS, MAPS, EPOCHS = (5, 10, 20, 40), (7, 11, 15), (2, 10, 50)
CHEAP_S = 3.0  # within which a fit of PCA+SOM is repeated


SEEDS = 5  # of each method: that of the configuration and the next ones

READS = (*SIMULATION, "noise", "parts", "baseline", "benchmark")
METHODS = (*SIMULATION, "noise", "parts", "methods", "evaluation", *all_groups())


class Knee(Group):
    """Trainings whose test errors are set against their time (`config/knee/points.yaml`)."""

    fresh_stars: Annotated[int, Field(ge=2)]
    points: Annotated[
        dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")], list[str]], Field(min_length=1)
    ]


def load_knee():
    """Read and check the file; raises ConfigError."""
    return load_file(Knee, config_dir() / "knee" / "points.yaml")


@command("knee", reads=("seed", "noise", "parts", "dae", "train", "evaluation"))
def knee_table(
    config: Config,
    stars: Annotated[File, "Product of the stage stars."],
    points: Annotated[tuple[str, ...], {"flag": "--point", "metavar": "NAME=FOLDER"}, "Training."],
    out: Annotated[File, "CSV with time and test error of every training."],
    stopping: Annotated[File, "CSV: what stopping saves."],
) -> None:
    """Compare trainings of one dataset by error and time; validation stars find the knee.

    The time is the CPU time of the training's one thread, which is its wall time on a quiet
    core; start-up and simulation are not in it.
    """
    import pandas as pd

    from psfdae.methods.dae import Dae
    from psfdae.methods.interface import HISTORY
    from psfdae.methods.metrics import mse

    limit_threads(config.evaluation.threads)
    folders = {name: Path(folder) for name, _, folder in (p.partition("=") for p in points)}
    product = star_sets.read_stars(stars)
    for folder in folders.values():
        fits.require(Dae, folder, product, config, "random", "realisation")
    test = star_sets.split_stars(product, "random", config).test
    images, levels = product["realisation"][test], config.noise.levels
    noisy = {level: star_sets.noisy_test_images(config, product, test, level) for level in levels}
    configured = decisive_settings(config.model_dump(include={"dae", "train"}))
    rows, idle = [], []
    for name, folder in folders.items():
        network = Dae.load(folder, evaluation=config.evaluation)
        history = read_table(folder / HISTORY)
        errors = {level: mse(network.predict(x), images).mean() for level, x in noisy.items()}
        row = {"point": name, **settings_of(folder, configured)}
        last = history.iloc[-1]
        row |= {"steps": int(last["step"]), "cpu_s": last["cpu_seconds"], "wall_s": last["seconds"]}
        row |= {f"mse_{level:g}": error for level, error in errors.items()}
        row["validation_mse"] = history["validation_mse"].min()
        rows.append({**row, "mse": np.exp(np.mean(np.log([*errors.values()]))), "n": len(images)})
        if row["schedule"] == "constant":
            idle.append(idle_steps(name, history.dropna(subset=["validation_mse"])))
    table = pd.DataFrame(rows)
    # Other stars cost simulation time that is not in the column: shown, but not a candidate.
    same_stars = np.flatnonzero(table["stars"] == "same")
    time, error = (table[name].to_numpy()[same_stars] for name in ("cpu_s", "validation_mse"))
    for name, front in (("pareto", pareto(time, error)), ("knee", [knee(time, error)])):
        table[name] = np.where(np.isin(table.index, same_stars[front]), "yes", "no")
    write(out, table)
    write(stopping, idle)


def settings_of(folder, configured):
    """Return the settings of a training, and whether the configuration uses them."""
    from psfdae.methods.interface import CONFIG

    tree = decisive_settings(read_yaml(folder / CONFIG))
    has_same_stars = tree["parts"]["test_stars"] > 1
    row = {"width": max(tree["dae"]["widths"])}
    row |= {key: tree["train"][key] for key in ("epochs", "batch", "lr", "schedule", "noise")}
    used = has_same_stars and all(tree[key] == configured[key] for key in configured)
    return row | {"stars": "same" if has_same_stars else "fresh", "used": yes(used)}


def idle_steps(name, validations):
    """Return the saving of an early stop in a training of constant rate, and its cost in error."""
    scores = validations["validation_mse"].to_numpy()
    stop = stopping_point(scores, PATIENCE)
    with_s, without_s = validations["cpu_seconds"].iloc[[-1, stop]]
    change = scores[: stop + 1].min() / scores.min() - 1.0
    row = {"item": f"training that has stopped improving ({name})", "scene": "seidel"}
    row |= {"per": "training", "with_s": with_s, "without_s": without_s}
    row |= {"saving": with_s / without_s, "change": change, "unit": "relative validation MSE"}
    return row | {"skipped": yes(stop < scores.size - 1)}


def knee(time, error, worthwhile=WORTHWHILE):
    """The point of the front beyond which more time is not worth it.

    From the cheapest point on, a later point of the front is taken if it lowers the error to
    `worthwhile` or less per doubling of the time.
    """
    front = pareto(time, error)
    point = front[0]
    for candidate in front[1:]:
        doublings = np.log2(time[candidate] / time[point])
        if error[candidate] / error[point] <= worthwhile**doublings:
            point = candidate
    return int(point)


def stopping_point(scores, patience):
    """Index of the validation after which a training with this patience stops.

    A training is deterministic, so a full history tells what `train.patience` would have done.
    """
    lowest = np.minimum.accumulate(scores)
    since = np.arange(scores.size) - np.searchsorted(-lowest, -lowest, side="left")
    stale = np.flatnonzero(since >= patience)
    return int(stale[0]) if stale.size else scores.size - 1


@command("baseline", reads=READS)
def baseline(
    config: Config,
    stars: Annotated[File, "Product of the stage stars."],
    out: Annotated[File, "CSV with time and error of PCA+SOM over its sizes."],
) -> None:
    """Time PCA+SOM over components, map and epochs, on a quiet machine."""
    require(stars, read_product(stars, "stars", ()).config, STARS, config)
    rows = isolated(config.baseline.threads, time_points, config.model_dump(), stars)
    write(out, [{**row, "threads": config.baseline.threads} for row in rows])


def grid_around(used, most_components):
    """Points (components, rows, columns, epochs): `used`, one size changed, the two extremes."""
    components, rows, columns, epochs = used
    points = [used]
    points += [(k, rows, columns, epochs) for k in COMPONENTS]
    points += [(components, side, side, epochs) for side in MAPS]
    points += [(components, rows, columns, t) for t in EPOCHS]
    points += [(COMPONENTS[i], MAPS[i], MAPS[i], EPOCHS[i]) for i in (0, -1)]
    return [point for point in dict.fromkeys(points) if point[0] <= most_components]


def time_points(tree, stars):
    """Fit and test settings on the training and test stars of the split random."""
    import minisom  # noqa: F401  # before the clock starts

    from psfdae_paper.methods.pca_som import PcaSom

    config = part(READS, tree)
    settings, levels = config.baseline, config.noise.levels
    limit_threads(settings.threads)
    product = star_sets.read_stars(stars, "template")
    parts = star_sets.split_stars(product, "random", config)
    # As the stage `baseline` does it: the point in use is the very model of the tables.
    data = star_sets.training_set(config, PcaSom, product, "random", "realisation")
    truths = {name: product[name][parts.test] for name in ("realisation", "template")}
    clean = truths["realisation"]
    tests = {
        level: star_sets.noisy_test_images(config, product, parts.test, level) for level in levels
    }
    used = tuple(getattr(settings, size) for size in SIZES)
    rows = []
    for point in grid_around(used, min(config.parts.train_stars, config.framing.stamp_px**2)):
        sizes = dict(zip(SIZES, point, strict=True))
        fit = settings.model_copy(update=sizes)
        measured = time_point(data, fit, tests, truths, config.benchmark.repeats)
        rows.append({**sizes, "used": yes(point == used), **measured, "n": len(clean)})
    return rows


def time_point(data, settings, tests, truths, repeats):
    """Fit a training set and restore the test images of each λ: median times and mean errors."""
    from psfdae_paper.methods.pca_som import PcaSom

    model, fit_s, repeats_made = median_time(lambda: PcaSom.fit(data, settings), repeats)
    estimates, predict_s, _ = median_time(
        lambda: [model.predict(images, level) for level, images in tests.items()], repeats
    )
    row = {"fit_s": fit_s, "predict_stars_per_s": sum(map(len, estimates)) / predict_s}
    row["repeats"] = repeats_made
    for name, truth in truths.items():
        row[f"mse_{name}"] = np.mean([((estimate - truth) ** 2).mean() for estimate in estimates])
    return row


def median_time(call, repeats):
    """Result, median seconds and number of repeats; fewer if they take long."""
    times: list[float] = []
    while not times or (len(times) < repeats and sum(times) + times[0] < CHEAP_S):
        start = perf_counter()
        result = call()
        times.append(perf_counter() - start)
    return result, np.median(times), len(times)


@command("methods", reads=METHODS)
def methods(
    config: Config,
    stars: Annotated[File, "Product of the stage stars."],
    out: Annotated[File, "CSV with the times of every method, and its error."],
) -> None:
    """Time fit and inference of all methods on one thread, on a quiet machine."""
    require(stars, read_product(stars, "stars", ()).config, STARS, config)
    write(out, isolated(1, time_methods, config.model_dump(), stars))


def time_methods(tree, stars):
    """CPU time of each method's fit, stars per second and errors, λ by λ."""
    from psfdae.methods.metrics import clustered_mean, mse

    config = part(METHODS, tree)
    limit_threads(1)
    product = star_sets.read_stars(stars, "template")
    test = star_sets.split_stars(product, "random", config).test
    clean, field = product["realisation"][test], product["field_index"][test]
    position = star_sets.field_positions(product)[test]
    rows = []
    for kind in (kind for kind in map(method, config.methods) if kind.look.restores):
        with TemporaryDirectory() as folder:
            source = config, kind, product, "random", "realisation"
            data = star_sets.training_set(*source, checkpoint=Path(folder, "checkpoint"))
            start = process_time()
            fitted = kind.fit(data, **kind.settings(config))
            fit_s = process_time() - start
        for level in config.noise.levels:
            noisy = star_sets.noisy_test_images(config, product, test, level)
            # What is made once for a level, such as factorisations, is not of the stars.
            fitted.estimate(noisy[:1], level, position[:1], False)
            start = process_time()
            estimate = fitted.estimate(noisy, level, position, False).psf
            rate = len(noisy) / (process_time() - start)
            row = {"method": kind.name, "noise_level": level, "fit_cpu_s": fit_s}
            mean, stderr = clustered_mean(mse(estimate, clean), field)
            rows.append(row | {"stars_per_s": rate, "mse": mean, "stderr": stderr})
    return rows


@command("seeds", reads=lambda name, **options: (*groups_of(name), "evaluation"))
def seeds(
    config: Config,
    name: Annotated[str, {"argument": True, "metavar": "METHOD"}],
    dataset: Annotated[str, "Name that goes into the table."],
    reference: tuple[Reference, ...],
    stars: Annotated[File, "Product of the stage stars."],
    results: Annotated[Folder, "Folder of the run with the method's own fits."],
    out: Annotated[File, "CSV with the mean error of every seed."],
) -> None:
    """Repeat the fits of METHOD with other seeds, and test all of them on the same noisy stars."""
    from psfdae.methods.metrics import mse

    kind, product = method(name), star_sets.read_stars(stars, "template")
    limit_threads(kind.threads(config))
    test = star_sets.split_stars(product, "random", config).test
    position = star_sets.field_positions(product)[test]
    noisy = {x: star_sets.noisy_test_images(config, product, test, x) for x in config.noise.levels}
    base = own_fits(config, kind, dataset, reference, product, results)
    rows = []
    for seed in range(config.seed, config.seed + SEEDS):
        fits = base if seed == config.seed else other_fits(config, kind, base, product, seed)
        for target, fitted in fits.items():
            row = {"dataset": dataset, "reference": target, "method": name, "seed": seed}
            for level, images in noisy.items():
                estimate = fitted.estimate(images, level, position, False).psf
                error = mse(estimate, product[target][test]).mean()
                rows.append({**row, "noise_level": level, "mse": error})
    write(out, rows)


def own_fits(config, kind, dataset, references, product, results):
    """The fits of the workflow by reference; where they leave no file, the same again."""
    by_reference = {}
    for reference in references:
        if kind.storage:
            place = results / fits.place_of(kind, dataset, "random", reference)
            fits.require(kind, place, product, config, "random", reference)
            by_reference[reference] = kind.load(place, reference, config.evaluation)
        else:
            data = star_sets.training_set(config, kind, product, "random", reference)
            by_reference[reference] = kind.fit(data, **kind.settings(config))
    return by_reference


def other_fits(config, kind, references, product, seed):
    """Fits that differ from the given ones by nothing but their seed."""
    by_reference = {}
    goes_on = kind.continues(config)
    for reference in references:
        if by_reference and kind.storage and not kind.storage.per_reference:
            by_reference[reference] = next(iter(by_reference.values()))  # one serves all
            continue
        with TemporaryDirectory() as folder:
            data = star_sets.training_set(
                *(config, kind, product, "random", reference),
                checkpoint=Path(folder, "checkpoint"),
                start=by_reference.get("realisation") if goes_on else None,
            )
            data = replace(data, seed=seed)
            by_reference[reference] = kind.fit(data, **kind.settings(config))
    return by_reference


@command("scatter")
def scatter(
    errors: Annotated[tuple[File, ...], {"argument": True}],
    out: Annotated[File, "CSV: relative scatter of every method, pooled over λ."],
) -> None:
    """Pool ERRORS, tables of the command seeds, over the noise levels."""
    import pandas as pd

    write_csv(out, pooled(pd.concat(map(read_table, errors))), 3)


def pooled(errors):
    """Root mean square over λ of the standard deviation over the seeds divided by their mean."""
    from psfdae_paper.evaluation.comparison import FITTED

    cells = errors.groupby([*FITTED, "noise_level"], sort=False)
    relative = (cells.mse.std() / cells.mse.mean()).groupby(FITTED, sort=False)
    table = cells.seed.nunique().groupby(FITTED, sort=False).min().rename("seeds").to_frame()
    return table.assign(scatter=relative.agg(lambda s: np.sqrt((s**2).mean()))).reset_index()


if __name__ == "__main__":
    program(knee_table, baseline, methods, seeds, scatter)
