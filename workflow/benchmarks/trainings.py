"""Scatter of the errors of each method over its own random draws, for the same stars."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np

from measure import write
from psfdae.base.files import write_csv
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_table
from psfdae.base.settings import Reference
from psfdae.base.threads import limit_threads
from psfdae.commands.cli import program
from psfdae.methods import fit_files as fits
from psfdae.methods import list_groups, method
from psfdae.training import star_sets
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.schema import Config

SEEDS = 5  # of each method: that of the configuration and the next ones


@command("seeds", reads=lambda name, **options: (*list_groups(name), "evaluation"))
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
    base = load_own_fits(config, kind, dataset, reference, product, results)
    rows = []
    for seed in range(config.seed, config.seed + SEEDS):
        fits = base if seed == config.seed else fit_other_seed(config, kind, base, product, seed)
        for target, fitted in fits.items():
            row = {"dataset": dataset, "reference": target, "method": name, "seed": seed}
            for level, images in noisy.items():
                estimate = fitted.estimate(images, level, position, False).psf
                error = mse(estimate, product[target][test]).mean()
                rows.append({**row, "noise_level": level, "mse": error})
    write(out, rows)


def load_own_fits(config, kind, dataset, references, product, results):
    """The fits of the workflow by reference; where they leave no file, the same again."""
    by_reference = {}
    for reference in references:
        if kind.storage:
            place = results / fits.get_fit_path(kind, dataset, "random", reference)
            fits.require_fit(kind, place, product, config, "random", reference)
            by_reference[reference] = kind.load(place, reference, config.evaluation)
        else:
            data = star_sets.training_set(config, kind, product, "random", reference)
            by_reference[reference] = kind.fit(data, **kind.settings(config))
    return by_reference


def fit_other_seed(config, kind, references, product, seed):
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

    write_csv(out, pool_seeds(pd.concat(map(read_table, errors))), 3)


def pool_seeds(errors):
    """Root mean square over λ of the standard deviation over the seeds divided by their mean."""
    from psfdae_paper.evaluation.comparison import FIT_KEYS

    cells = errors.groupby([*FIT_KEYS, "noise_level"], sort=False)
    relative = (cells.mse.std() / cells.mse.mean()).groupby(FIT_KEYS, sort=False)
    table = cells.seed.nunique().groupby(FIT_KEYS, sort=False).min().rename("seeds").to_frame()
    return table.assign(scatter=relative.agg(lambda s: np.sqrt((s**2).mean()))).reset_index()


if __name__ == "__main__":
    program(seeds, scatter)
