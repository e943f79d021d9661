"""Stage `fit`: a method for one dataset and split, and for a reference if it has one each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import click
import numpy as np

from psfdae.cli import File, Folder, Reference, Split, command
from psfdae.configuration.schema import Config
from psfdae.estimators import BrightStamps, Method, TrainingSet, groups_of, method
from psfdae.files import Product, read_product
from psfdae.stages.common import (
    field_positions,
    limit_threads,
    noise_model,
    read_stars,
    split_stars,
)

INNER = 10
"""One of so many stars chooses the settings of a fit that has not seen the validation stars."""

Stars = Annotated[File, "Product of the stage stars."]


@command("fit", reads=groups_of)
def fit(
    config: Config,
    name: Annotated[str, {"argument": True, "metavar": "METHOD"}],
    stars: Stars,
    split: Split = "random",
    reference: Reference = "realisation",
    fresh: Annotated[File | None, "Product of the stage stars with other draws."] = None,
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
    product = read_stars(stars, reference if kind.per_reference else "template")
    more = None if fresh is None else read_stars(fresh, "template")
    kept = checkpoint or kind.beside(out, "checkpoint.pt")
    data = training_set(config, kind, product, split, reference, fresh=more, checkpoint=kept)
    if start is not None:
        if reference != "template" or not kind.continues(config):
            raise click.UsageError("--start: nothing that goes on from a fit is fitted")
        kind.require(start, product, config, split, "realisation")
        data = replace(data, start=kind.load(start))
    described = {**config.model_dump(), "split": split}
    described |= {"reference": reference} if kind.per_reference else {}
    kind.fit(data, **kind.settings(config)).store(out, described, product)
    kept.unlink(missing_ok=True)


@command("baseline", reads=groups_of("pca_som"))
def baseline(
    config: Config,
    stars: Stars,
    split: Split = "random",
    *,
    out: Annotated[File, "HDF5 product with the fitted PCA+SOM."],
) -> None:
    """Fit the PCA+SOM baseline."""
    fit(config, "pca_som", stars, split, out=out)


@command("train", reads=groups_of("dae"))
def train(
    config: Config,
    stars: Stars,
    split: Split = "random",
    reference: Reference = "realisation",
    checkpoint: Annotated[
        File | None, "State of an interrupted training.  [default: OUT/checkpoint.pt]"
    ] = None,
    *,
    out: Annotated[Folder, "Folder for weights, resolved config and history."],
) -> None:
    """Train a denoising autoencoder; resumes from its checkpoint."""
    fit(config, "dae", stars, split, reference, checkpoint=checkpoint, out=out)


def training_set(
    config: Config,
    kind: type[Method],
    stars: Product,
    split: str,
    reference: str,
    **more: Any,
) -> TrainingSet:
    """What a method learns from: the training part of a split, with a configuration's noise."""
    parts = split_stars(stars, split, config)
    if stars.config.get("source") == "stars":
        more["own_noise"] = _own_noise(stars, config.noise.background_photons)
        if kind.measures:
            *names, _ = BrightStamps._fields
            kept = read_product(stars.path, "stars", tuple(names))
            more["bright"] = BrightStamps(*map(kept.__getitem__, names), stars["field_index"])
    return TrainingSet(
        images=stars["realisation"],
        references=stars["template" if kind.stored and not kind.per_reference else reference],
        fit=parts.fit,
        validation=parts.validation,
        levels=np.asarray(config.noise.levels),
        noise=noise_model(config),
        seed=config.seed,
        reference=reference,
        positions=field_positions(stars),
        **more,
    )


def fit_apart(kind: type[Method], data: TrainingSet, star: np.ndarray, config: Any) -> Method:
    """A fit that has learnt nothing from the validation stars, for methods that else do.

    Some stars of `fit` choose its settings instead; `star` says which images are of the same.
    """
    inner = np.isin(star[data.fit], np.unique(star[data.fit])[::INNER])
    some = replace(data, fit=data.fit[~inner], validation=data.fit[inner])
    return kind.fit(some, **kind.settings(config))


def _own_noise(stars: Product, background: float) -> Callable[..., np.ndarray]:
    """Noise of the bright stars of an image; read only if a method asks for it."""

    @cache
    def known() -> Callable[..., np.ndarray]:
        from psfdae.own_stars.training_images import OwnNoise

        kept = read_product(stars.path, "stars", ("noise", "phase"))
        star = stars["field_index"]
        return OwnNoise(kept["noise"][star], background, kept["phase"], star)

    def own_noise(images: np.ndarray, mean: np.ndarray) -> np.ndarray:
        return known()(images, mean)

    return own_noise
