"""Stage `baseline`: PCA and self-organising map of one dataset and split."""

from __future__ import annotations

from math import isqrt
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.belonging import require, require_training, write_origin
from psfdae.files import Column, Product, read_product, write_product
from psfdae.models.pca_som import PcaSom, fit_pca_som
from psfdae.rng import stream
from psfdae.stages.common import limit_threads, noise_model, read_stars, split_stars
from psfdae.stars.noise import mixed_levels


def run(config: Any, stars: Path, split: str, out: Path) -> None:
    """Fit the baseline on the noisy, mixed-λ training stars.

    Parameters
    ----------
    config : stage config (seed, noise, parts, baseline)
    stars : product "stars"
    split : "random" or "held_out"
    out : path of the HDF5 product "pca_som"; beside it, `*.trained_on.yaml` receives what
        the stars say of themselves
    """
    limit_threads(config.baseline.threads)
    product = read_stars(stars)
    train = split_stars(product, split, config).train
    rng = stream(config.seed, "noise", "baseline")
    levels = mixed_levels(np.asarray(config.noise.levels), train.size, rng)
    noisy = noise_model(config).draw(product["realisation"][train], levels, rng)
    settings = config.baseline.model_dump(exclude={"threads"})
    model = fit_pca_som(
        noisy, **settings, seed=int(stream(config.seed, "baseline", "map").integers(2**31))
    )
    columns = {
        "mean": Column(model.mean, "1", "mean training image"),
        "components": Column(model.components, "1", "eigenvectors, rows"),
        "nodes": Column(model.nodes, "1", "map nodes in feature space"),
        "psf": Column(model.psf, "1", "mean star image of each node's cluster"),
    }
    described = {**config.model_dump(), "split": split}
    write_product(out, "pca_som", columns, described)
    write_origin(out, product)


def load(path: Path) -> PcaSom:
    """The fitted baseline of a product "pca_som"."""
    product = read_product(path, "pca_som", ("mean", "components", "nodes", "psf"))
    return PcaSom(**product.arrays)


def require_fitted(path: Path, stars: Product, config: Any, split: str) -> None:
    """Refuse a product "pca_som" that does not belong to test stars.

    Parameters
    ----------
    path : product "pca_som"
    stars : product "stars" with its realisations
    config : stage config (seed, parts)
    split : "random" or "held_out"
    """
    product = read_product(path, "pca_som", ("mean",))
    stamp = {"framing": {"stamp_px": isqrt(product["mean"].size)}}
    side = {"framing": {"stamp_px": stars["realisation"].shape[-1]}}
    require(path, stamp, ("framing.stamp_px",), side, stars.path)
    require_training(path, product.config, stars, config, split=split)
