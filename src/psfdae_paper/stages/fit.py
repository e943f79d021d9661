"""Stage `fit`: a method for one dataset and split, and for a reference if it has one each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import click

from psfdae import fits
from psfdae.method import GoesOn
from psfdae.methods import groups_of, method
from psfdae.model.star_sets import read_stars, training_set
from psfdae.options import File, Folder
from psfdae.settings import Reference, SplitKind
from psfdae.threads import limit_threads
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.methods import all_groups
from psfdae_paper.configuration.schema import Config

Stars = Annotated[File, "Product of the stage stars."]


def groups_read(name: str = "", **options: object) -> tuple[str, ...]:
    """Return the groups of settings that decide a fit of a method, or of any method."""
    return groups_of(name) if name else ("seed", "noise", "parts", *all_groups())


@command("fit", reads=groups_read)
def fit(
    config: Config,
    name: Annotated[str, {"argument": True, "metavar": "METHOD"}],
    stars: Stars,
    split: SplitKind = "random",
    reference: Reference = "realisation",
    start: Annotated[
        Folder | None, "Fit to the realisations, from which one to templates goes on."
    ] = None,
    checkpoint: Annotated[File | None, "State of an interrupted fit, if it keeps one."] = None,
    *,
    out: Annotated[Path, click.Path(path_type=Path), "Folder or HDF5 product."],
) -> None:
    """Fit METHOD, a name of the list `methods` in config.yaml."""
    kind = method(name)
    limit_threads(kind.threads(config))
    product = read_stars(stars, fits.learnt(kind, reference))
    kept = checkpoint or fits.beside(kind, out, "checkpoint.pt")
    data = training_set(config, kind, product, split, reference, checkpoint=kept)
    if start is not None:
        if reference != "template" or not (issubclass(kind, GoesOn) and kind.continues(config)):
            raise click.UsageError("--start: nothing that goes on from a fit is fitted")
        fits.require(kind, start, product, config, split, "realisation")
        data = replace(data, start=kind.load(start))
    described = fits.described_by(kind, config.model_dump(), split, reference)
    fits.store(kind.fit(data, **kind.settings(config)), out, described, product)
    kept.unlink(missing_ok=True)
