"""Stages `bundle` and `ship`: a fitted method as one file, which astronomers apply to images.

Inputs: a fit and the stars that it was trained on. Output: a bundle with the weights, the errors of
the method on held-out stars, and telescope, camera and noise.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from psfdae.base.belonging import SAME_IMAGE, SAME_STARS, STARS, require, require_origin
from psfdae.base.files import Product
from psfdae.base.options import AboveZero, File, Folder
from psfdae.base.rng import stream
from psfdae.base.settings import Reference, SplitKind
from psfdae.base.threads import limit_threads
from psfdae.denoise.bundle import (
    SUFFIX,
    Bundle,
    BundleError,
    locate_shipped_model,
    read_bundle,
    write_bundle,
)
from psfdae.denoise.star_model import StarModel
from psfdae.methods import fit_files as fits
from psfdae.methods import method
from psfdae.methods.interface import CONFIG, Method
from psfdae.training import packing
from psfdae.training.star_sets import fit_apart, noise_model, read_stars, training_set
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.methods import list_method_groups
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stages.evaluate import Models

SEEN_BY_TRAINING = ("seed", "noise", "parts")
"""Groups in which the configuration must agree with the training."""


@command("paper bundle", reads=(*SEEN_BY_TRAINING, "evaluation"))
def bundle(
    config: Config,
    stars: File,
    models: Models,  # type: ignore[valid-type]  # made at run time
    split: SplitKind | None = None,
    reference: Reference | None = None,
    name: str | None = None,
    licence: str = "not stated",
    largest_mb: Annotated[float | None, AboveZero] = None,
    *,
    out: File,
) -> None:
    """Pack a trained network with its errors and everything that is needed to apply it.

    Errors are measured on test stars, at the noise levels of the configuration; `psfdae describe`
    prints them. Seed, noise and parts must agree with the training. A fit to other stars, or to
    stars of another telescope, is rejected.

    Parameters
    ----------
    config : Config
        Seed, noise and parts, as in the training; evaluation.
    stars : Path
        Product of the stage stars that the network was trained on.
    models : Models
        Folder or file of one fitted method, an option of its name.
    split : SplitKind, optional
        Split that the network must have. [default: any]
    reference : Reference, optional
        Truth that is estimated, by a method that is fitted to both. [default: realisation]
    name : str, optional
        Name of the model. [default: name of the file]
    licence : str
        Licence of the model.
    largest_mb : float, optional
        Size limit, for which a mixture leaves out fine axes.
    out : Path
        Bundle, a file NAME.psf.safetensors.
    """
    # A model applied to an image assumes photon noise for its errors.
    config.noise.require_poisson("model files have errors")
    # Exactly one option names a fit; the option is the name of the method.
    limit_threads(config.evaluation.threads)
    fits_by_name = {key: fit_path for key, fit_path in vars(models).items() if fit_path is not None}
    if len(fits_by_name) != 1:
        options = " or ".join(f"--{key.replace('_', '-')}" for key in vars(models))
        raise BundleError(f"one model makes a bundle: {options}")
    ((method_name, fit_path),) = fits_by_name.items()
    method_class = method(method_name)
    fit_config = _fit_config(method_class, fit_path, config, split)
    # The product "stars" has the telescope, camera and framing of the stamps in its configuration.
    target = fit_config.get("reference") or reference or "realisation"
    product = read_stars(stars, target)
    require_origin(fit_path, (*STARS, *SAME_STARS, *SAME_IMAGE), product)
    # The errors are measured now, which takes most of the time.
    estimator = method_class.load(fit_path, target, config.evaluation)
    labels = name or out.name.removesuffix(SUFFIX), licence
    model = packing.build_model(estimator, product, target, config, fit_config, *labels, largest_mb)
    model.save(out)


def _fit_config(
    method_class: type[Method], fit_path: Path, config: Config, split: str | None
) -> dict[str, Any]:
    """Return the configuration of a fit, which must agree with the stage.

    Parameters
    ----------
    method_class : type of Method
        Class of the fitted method.
    fit_path : Path
        Folder or file of the fit.
    config : Config
        Stage configuration.
    split : str, optional
        Split that the fit must have.

    Raises
    ------
    BundleError
        If a file of the fit, or a key of its configuration, is missing.
    ProductError
        For the first setting that differs.
    """
    # Files that the fit consists of.
    for file in fits.own_files(method_class, fit_path):
        if not file.is_file():
            raise BundleError(
                f"{file}: no such file; psfdae paper fit {method_class.name} writes it"
            )
    # A fit is a folder or one file.
    file = fit_path / CONFIG if fit_path.is_dir() else fit_path
    fit_config = method_class.read_config(fit_path)
    # Its configuration says how it was trained: the groups of the method, and the split of the
    # stars; also the reference, if there is a fit for each.
    required_keys = {*SEEN_BY_TRAINING, *method_class.groups, "split"}
    required_keys |= {"reference"} if fits.get_storage(method_class).per_reference else set()
    if missing := required_keys - set(fit_config):
        raise BundleError(f"{file}: key {min(missing)!r} is missing")
    # Errors are measured with the noise and on the parts of the training, hence they must agree.
    stage_config = config.model_dump(include={*SEEN_BY_TRAINING})
    stage_config |= {"split": split or fit_config["split"]}
    keys = (*SEEN_BY_TRAINING, "split")
    require(file, fit_config, keys, stage_config, "the configuration of the bundle")
    return fit_config


@command("paper ship", reads=(*SEEN_BY_TRAINING, *list_method_groups()))
def ship(config: Config, bundle: tuple[File, ...], stars: File, out: Folder) -> None:
    """Make the bundle with the smallest error on validation stars the package's bundle.

    Flux and sky of these stars are estimated, and all noise levels have equal weight.

    It is rejected if its half-widths do not contain 63 to 73 % of the errors of its test stars at a
    noise level, or if it is larger than 5 MB.

    Parameters
    ----------
    config : Config
        Seed, noise, parts, and settings of all methods.
    bundle : sequence of Path
        Model bundle to choose from; several times.
    stars : Path
        Product of the stage stars that they were trained on.
    out : Path
        Folder of the package's bundles.
    """
    # The candidate with the smallest error.
    product, errors = read_stars(stars), {}
    for path in bundle:
        # Each candidate denoises the same noisy stars.
        errors[path] = _validation_error(read_bundle(path), product, config)
        print(f"{path.name}: MSE {errors[path]:.3g} on validation stars")
    # The smallest error wins; the others are not shipped.
    source = min(errors, key=errors.__getitem__)
    best_bundle = read_bundle(source)
    # The half-widths of 68 % intervals must contain 68 ± 5 % of the errors at every noise level.
    low, high = 0.63, 0.73
    for row in best_bundle.info.metrics:
        if not low <= row.get("coverage68", 0.0) <= high:
            raise BundleError(
                f"{source}: at noise level {row.get('noise_level', 0.0):g} half-widths contain "
                f"{row.get('coverage68', 0.0):.1%} of the errors ({low:.0%} to {high:.0%} allowed)"
            )
    # Its stars are simulated: the licence of the package applies.
    name = locate_shipped_model().name
    fields = {"name": name.removesuffix(SUFFIX), "licence": "MIT"}
    info = best_bundle.info.model_copy(update=fields)
    # The package must stay small: the bundle is in every installation.
    size, largest_size = source.stat().st_size, 5_000_000
    if size > largest_size:
        raise BundleError(f"{source}: {size} bytes, at most {largest_size}")
    target = out / name
    write_bundle(replace(best_bundle, info=info), target)
    print(target)


def _validation_error(bundle: Bundle, stars: Product, config: Config) -> float:
    """Return the MSE of PSFs of flux 1, as a geometric mean over the noise levels.

    Parameters
    ----------
    bundle : Bundle
        Candidate, whose method was trained on these stars.
    stars : Product
        Product "stars" of its training.
    config : Config
        Stage configuration of `ship`.
    """
    method_class = method(bundle.info.method)
    # Split and reference of the model that is shipped.
    data = training_set(config, method_class, stars, "random", "realisation")
    # A method that needs no validation stars was fitted to them, too: fit it without them.
    if not method_class.needs.validation:
        independent_fit = fit_apart(method_class, data, np.arange(len(data.images)), config)
        # With the size of the bundle it has as many fine axes.
        size = sum(array.nbytes for array in bundle.weights.values())
        info = bundle.info
        weights, _ = packing.pack(independent_fit, info.stamp_px, info.noise_min, size)
        bundle = replace(bundle, weights=weights)
    model, truth, noise = StarModel(bundle), data.images[data.validation], noise_model(config)
    # Flux and sky of the noisy stars are unknown to the model; the PSF of flux 1 is compared with
    # the noise-free star.
    log_errors = []
    for level in data.levels:
        rng, flux = stream(config.seed, "noise", "ship", f"{level:.6g}"), noise.flux(level)
        # Photon noise of star and sky.
        stamps = rng.poisson(flux * truth + noise.background).astype(np.float32)
        prediction = model.predict(stamps, gain=1.0)
        # The prediction has the flux of the star.
        normalised_psf = prediction.psf / prediction.flux[:, None, None]
        log_errors.append(np.log(np.nanmean(np.square(normalised_psf - truth))))
    return float(np.exp(np.mean(log_errors)))
