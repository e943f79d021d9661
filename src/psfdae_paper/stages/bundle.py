"""Stages `bundle` and `ship`: a fitted method in one file, for use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from psfdae import fits
from psfdae.belonging import SAME_IMAGE, SAME_STARS, STARS, require_origin
from psfdae.files import Product
from psfdae.method import CONFIG, Method
from psfdae.methods import method
from psfdae.model import packing
from psfdae.model.bundle import SHIPPED, SUFFIX, Bundle, BundleError, read_bundle, write_bundle
from psfdae.model.psf_model import PsfModel
from psfdae.model.star_sets import fit_apart, noise_model, read_stars, training_set
from psfdae.options import AboveZero, File, Folder
from psfdae.rng import stream
from psfdae.settings import Reference, SplitKind, as_overrides
from psfdae.threads import limit_threads
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.methods import all_groups
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stages.evaluate import Models

SEEN_BY_TRAINING = ("seed", "noise", "parts")
"""Groups in which the configuration must be that of the training."""

LARGEST_SHIPPED = 5_000_000
"""Bytes of the bundle that comes with the package, at most."""

LICENCE = "MIT"
"""Of the shipped bundle, as of the package: its stars are simulated."""

WELL_COVERED = (0.63, 0.73)
"""Coverage of `error68` that a shipped bundle must have at every noise level."""


@command("bundle", reads=(*SEEN_BY_TRAINING, "evaluation"))
def bundle(
    config: Config,
    stars: Annotated[File, "Product of the stage stars that the network was trained on."],
    models: Models,
    split: Annotated[
        SplitKind | None, "Refuse a network of another split.  [default: that of the training]"
    ] = None,
    reference: Annotated[
        Reference | None, "Of a method that serves both.  [default: realisation]"
    ] = None,
    name: Annotated[str | None, "Name of the model.  [default: the file's]"] = None,
    licence: Annotated[str, "Of the model."] = "not stated",
    largest_mb: Annotated[
        float | None, AboveZero, "Size of the model, for which a mixture leaves out fine axes."
    ] = None,
    *,
    out: Annotated[File, "Bundle, a file NAME.psf.safetensors."],
) -> None:
    """Pack a trained network with its errors and all that it takes to apply it."""
    # The configuration inside the product "stars" says what kind of stamps they are.
    limit_threads(config.evaluation.threads)
    given = {key: place for key, place in vars(models).items() if place is not None}
    if len(given) != 1:
        options = " or ".join(f"--{key.replace('_', '-')}" for key in vars(models))
        raise BundleError(f"one model makes a bundle: {options}")
    ((key, place),) = given.items()
    kind = method(key)
    trained = _trained(kind, place, config, split)
    restored = trained.get("reference") or reference or "realisation"
    product = read_stars(stars, restored)
    require_origin(place, (*STARS, *SAME_STARS, *SAME_IMAGE), product)
    fitted = kind.load(place, restored, config.evaluation)
    said = name or out.name.removesuffix(SUFFIX), licence
    model = packing.model_of(fitted, product, restored, config, trained, *said, largest_mb)
    model.save(out)


def _trained(kind: type[Method], place: Path, config: Config, split: str | None) -> dict[str, Any]:
    """Configuration of a fit, if it is that of the stage."""
    for path in fits.own_files(kind, place):
        if not path.is_file():
            raise BundleError(f"{path}: no such file; psfdae fit {kind.name} writes it")
    path, trained = place / CONFIG if place.is_dir() else place, kind.described(place)
    lacking = {*SEEN_BY_TRAINING, *kind.groups, "split"} - set(trained)
    lacking |= {"reference"} - set(trained) if fits.storage_of(kind).per_reference else set()
    if lacking:
        raise BundleError(f"{path}: key {min(lacking)!r} is missing")
    asked = config.model_dump(include={*SEEN_BY_TRAINING}) | {"split": split or trained["split"]}
    _refuse_mismatch({key: trained[key] for key in asked}, asked, path)
    return trained


def _refuse_mismatch(trained: dict[str, Any], asked: dict[str, Any], path: Path) -> None:
    found, wanted = ([word.strip("+") for word in as_overrides(t)] for t in (trained, asked))
    differing = sorted({*found} - {*wanted}) or sorted({*wanted} - {*found})
    if differing:
        key = differing[0].split("=")[0]
        other = next((word for word in wanted if word.startswith(f"{key}=")), f"no {key}")
        raise BundleError(
            f"{path}: the network was trained with {differing[0]}, "
            f"but the bundle is asked for with {other}"
        )


@command("ship", reads=(*SEEN_BY_TRAINING, *all_groups()))
def ship(
    config: Config,
    bundle: Annotated[tuple[File, ...], "Model bundle to choose from; several times."],
    stars: Annotated[File, "Product of the stage stars that they were trained on."],
    out: Annotated[Folder, "Folder of the package's bundles."],
) -> None:
    """Make that bundle which errs least on validation stars the package's own.

    Flux and sky of these stars are estimated, and every noise level counts alike.
    """
    product, errors = read_stars(stars), {}
    for path in bundle:
        errors[path] = _validation_error(read_bundle(path), product, config)
        print(f"{path.name}: MSE {errors[path]:.3g} on validation stars")
    best = min(errors, key=errors.__getitem__)
    packed = read_bundle(best)
    low, high = WELL_COVERED
    for row in packed.info.metrics:
        if not low <= row.get("coverage68", 0.0) <= high:
            raise BundleError(
                f"{best}: at noise level {row.get('noise_level', 0.0):g} error68 holds "
                f"{row.get('coverage68', 0.0):.1%} of the errors ({low:.0%} to {high:.0%} allowed)"
            )
    info = packed.info.model_copy(update={"name": SHIPPED, "licence": LICENCE})
    if best.stat().st_size > LARGEST_SHIPPED:
        raise BundleError(f"{best}: {best.stat().st_size} bytes, at most {LARGEST_SHIPPED}")
    shipped = out / f"{SHIPPED}{SUFFIX}"
    write_bundle(replace(packed, info=info), shipped)
    print(shipped)


def _validation_error(bundle: Bundle, stars: Product, config: Config) -> float:
    """Geometric mean over the noise levels of the MSE of PSFs of flux 1."""
    kind = method(bundle.info.method)
    data = training_set(config, kind, stars, "random", "realisation")
    if not kind.needs.validation:
        apart = fit_apart(kind, data, np.arange(len(data.images)), config)
        size = sum(array.nbytes for array in bundle.weights.values())
        weights, _ = packing.packed(apart, bundle.info.stamp_px, bundle.info.noise_min, size)
        bundle = replace(bundle, weights=weights)
    model, truth, noise = PsfModel(bundle), data.images[data.validation], noise_model(config)
    logs = []
    for level in data.levels:
        rng, flux = stream(config.seed, "noise", "ship", f"{level:.6g}"), noise.flux(level)
        stamps = rng.poisson(flux * truth + noise.background).astype(np.float32)
        found = model.predict(stamps, gain=1.0)
        logs.append(np.log(np.nanmean(np.square(found.psf / found.flux[:, None, None] - truth))))
    return float(np.exp(np.mean(logs)))
