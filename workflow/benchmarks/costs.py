"""Error against CPU time, of the fit and of a star: every method, and other settings of some."""

from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from timeit import Timer
from typing import Annotated

import numpy as np
from pydantic import Field

from measure import isolate, pareto, write
from psfdae.base.belonging import STARS, require
from psfdae.base.files import ProductError, read_product
from psfdae.base.options import File
from psfdae.base.reading import read_table
from psfdae.base.settings import Group
from psfdae.commands.cli import program
from psfdae.methods import list_groups, method
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.compose import load_file, part
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.schema import Config
from psfdae_paper.evaluation.comparison import read_seed_scatter

PointName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")]
Settings = dict[str, dict[PointName, list[str]]]


class Points(Group):
    """Methods that are timed, and settings other than those in use (`points.yaml`).

    Attributes
    ----------
    datasets : list of str
        Datasets on which all methods of the configuration are timed.
    further_methods : list of str
        Methods that are timed beside those.
    on_request : dict of str to list of str
        Methods that only the target `posterior_network` times, by dataset.
    settings : dict
        Overrides of the configuration on `datasets`, by method and by the name of the point.
    trials : dict
        The same, on the first dataset alone.
    """

    datasets: Annotated[list[str], Field(min_length=1)]
    further_methods: list[str]
    on_request: dict[str, list[str]]
    settings: Settings
    trials: Settings

    def overrides(self, dataset, name):
        """Return the overrides of a method by point; "configured" has none."""
        settings = self.settings.get(name, {}) if dataset in self.datasets else {}
        trials = self.trials.get(name, {}) if dataset == self.datasets[0] else {}
        return {"configured": [], **settings, **trials}


def load_points():
    """Read and check the file; raises ConfigError."""
    return load_file(Points, Path(__file__).with_name("points.yaml"))


def method_class(name):
    """Return the class of a method of the package, or of the denoisers."""
    return import_module(name).Denoisers if name == "denoisers" else method(name)


def groups(name, **options):
    """Return the groups of the configuration that decide error and time of a method."""
    of_fit = list_groups(name) if name != "denoisers" else ("noise", "parts")
    return tuple(dict.fromkeys((*SIMULATION, *of_fit, "bounds", "evaluation")))


@command("cost", reads=groups)
def cost(
    config: Config,
    name: Annotated[str, {"argument": True, "metavar": "METHOD"}],
    dataset: Annotated[str, "Name in the table."],
    point: Annotated[str, "Name of the settings in the table."],
    stars: Annotated[File, "Product of the stage stars."],
    bounds: Annotated[File, "CSV of the stage bounds."],
    out: Annotated[File, "CSV with one row."],
) -> None:
    """Time METHOD on one thread: its fit, and the stars whose least possible error is known."""
    require(stars, read_product(stars, "stars", ()).config, STARS, config)
    knows_position = method_class(name).needs.position
    bound, is_tight = least_errors(read_table(bounds), dataset, knows_position)
    row = isolate(1, time_method, name, config.model_dump(), stars, bound)
    # Fits of other seeds scatter, as far as the target `seeds` has measured it.
    scatter = read_seed_scatter().get((dataset, "realisation", name), 0.0) * row["over_least"]
    row["over_least_stderr"] = np.hypot(row["over_least_stderr"], scatter)
    key = {"dataset": dataset, "method": name, "point": point}
    write(out, [{**key, **row, "tight": "yes" if is_tight else "no"}])


def least_errors(bounds, dataset, knows_position):
    """Return the least possible error by noise level λ, and whether it is known at all levels.

    It is the error of the posterior mean against the realisation, with or without the position in
    the field. Levels are those at which the one without is tight for all stars, so that all methods
    have the same levels; all levels if there is none. Levels at which all stars are recognised are
    left out: no error is a multiple of 0. The one with the position may not be tight there, so that
    the minimum error may be lower.

    Raises
    ------
    ProductError
        If the error with the position is 0 at one of these levels.
    """
    rows = bounds.query("dataset == @dataset and reference == 'realisation' and metric == 'mse'")
    columns = ["value", "tight", "missing"]
    table = rows.pivot(index="noise_level", columns="method", values=columns)
    is_tight = table.tight.eq("yes") & table.missing.eq(0)
    values, is_positive = table.value.astype(float), table.value.bayes.astype(float) > 0
    is_usable = is_tight.bayes if is_tight.bayes.any() else is_tight.bayes.notna()
    mean = "bayes_position" if knows_position else "bayes"
    least = values[mean][is_usable & is_positive]
    if not (least > 0).all():
        raise ProductError(f"{dataset}: the least possible error with the position is 0")
    return least.to_dict(), bool(is_tight[mean][least.index].all())


def time_method(name, tree, stars, bound):
    """Return CPU seconds of the fit, stars per second at the slowest level, and mean errors."""
    from psfdae.base.threads import limit_threads
    from psfdae.methods.metrics import cluster_mean, mse
    from psfdae.training import star_sets
    from psfdae_paper.bounds.estimates import SPLIT, read_test_stars

    # Imports are no part of the fit.
    for module in ("torch", "minisom", "sklearn.cluster", "skimage.restoration"):
        import_module(module)
    limit_threads(1)
    config, kind = part(groups(name), tree), method_class(name)
    product = star_sets.read_stars(stars, "template")
    tested = read_test_stars(config, product)
    position = star_sets.field_positions(product)[tested.star]
    # The fit to the training stars of the random split, its choices by validation stars included.
    with TemporaryDirectory() as folder:
        source = config, kind, product, SPLIT, "realisation"
        data = star_sets.training_set(*source, checkpoint=Path(folder, "checkpoint"))
        start = process_time()
        fitted = kind.fit(data, **kind.settings(config))
        fit_s = process_time() - start
    # Stars per second of CPU time, and the mean squared error, at each noise level.
    rates, errors, deviations, restored = [], [], [], {}
    for level in bound:
        noisy = tested.noisy[level]

        def restore(noisy=noisy, level=level):
            place = position[: len(noisy)]
            restored["psf"] = fitted.estimate(noisy, level, place, with_sigma=False).psf

        # What is made once for a level, such as factorisations, is not of the stars.
        restore(noisy[:1])
        # As many calls as last 0.2 s.
        calls, seconds = Timer(restore, timer=process_time).autorange()
        rates.append(calls * len(noisy) / seconds)
        # Stars of a field are alike: the standard error is clustered by field.
        squares = mse(restored["psf"], tested.truth["realisation"])
        for values, value in zip(
            (errors, deviations), cluster_mean(squares, tested.field), strict=True
        ):
            values.append(value)
    row = {"fit_cpu_s": fit_s, "stars_per_s": min(rates), "mse": np.exp(np.log(errors).mean())}
    # Geometric mean over the noise levels of the error over the least possible one.
    ratios = np.array(errors) / [*bound.values()]
    over_least = np.exp(np.log(ratios).mean())
    # All levels have the same stars: their relative errors are averaged as if they were one error.
    # The scatter of the least possible error is common to all methods, and not in it.
    stderr = over_least * np.mean(np.divide(deviations, errors))
    row |= {"over_least": over_least, "over_least_stderr": stderr, "stars": len(tested.star)}
    return row | {"noise_levels": " ".join(f"{level:g}" for level in bound)}


@command("costs")
def costs(
    rows: Annotated[tuple[File, ...], {"argument": True}],
    out: Annotated[File, "CSV with time and error of every method and setting."],
) -> None:
    """Join ROWS, tables of the command cost, and mark the knee of the trainings of each dataset."""
    import pandas as pd

    # Rows may come from a joined table, which has the columns that are added here.
    table, points = pd.concat(map(read_table, rows), ignore_index=True), load_points()
    table = table.drop(columns=["settings", "knee"], errors="ignore")
    overrides = [points.overrides(row.dataset, row.method)[row.point] for row in table.itertuples()]
    table.insert(3, "settings", [" ".join(words) for words in overrides])
    # Trainings of the configured network that differ in nothing but their length.
    lengths = table[(table.method == "dae") & table.settings.str.fullmatch(r"(train\.epochs=\d+)?")]
    table["knee"] = "no"
    for _, trainings in lengths.groupby("dataset"):
        if len(trainings) > 1:
            index = knee(trainings.fit_cpu_s.to_numpy(), trainings.over_least.to_numpy())
            table.loc[trainings.index[index], "knee"] = "yes"
    write(out, table)


def knee(time, error, worthwhile=0.9):
    """The point of the Pareto front beyond which more time is not worth it.

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


if __name__ == "__main__":
    program(cost, costs)
