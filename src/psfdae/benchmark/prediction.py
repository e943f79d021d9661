"""Stamps per second of `psfdae predict`, FITS to FITS, beside the bare network.

The functions run in processes of their own (`psfdae.benchmark.isolated`); arguments
and results are what JSON carries.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

WARM_UP = 4
"""Blocks of stars that are computed before the clock starts."""

BARE_STAMPS = 8192
"""Images that the bare network sees over and over: it must not fill the memory."""


def make_cube(
    stars: str,
    kappa: float,
    background: float,
    levels: list[float],
    count: int,
    seed: int,
    out: str,
) -> None:
    """Write a FITS cube of noisy stars, sky included, of random noise levels.

    Parameters
    ----------
    stars : path of a product "stars", whose noise-free images are taken in turn
    kappa, background, levels : the noise
    count : number of stamps
    seed : of the noise
    out : path of the cube
    """
    from psfdae.files import read_product
    from psfdae.own_stars.example import write_cube
    from psfdae.rng import stream
    from psfdae.stars.noise import NoiseModel, mixed_levels

    product = read_product(Path(stars), "stars", ("realisation",))
    images, rng = product["realisation"], stream(seed, "prediction", "cube")
    noise = NoiseModel(kappa, background)
    cube = np.empty((count, *images.shape[1:]), np.float32)
    for start in range(0, count, BARE_STAMPS):
        rows = np.arange(start, min(start + BARE_STAMPS, count))
        level = mixed_levels(np.asarray(levels), rows.size, rng)
        flux = noise.flux(level)[:, None, None]
        cube[rows] = rng.poisson(flux * images[rows % len(images)] + background)
    scale = product.config["telescope"]["pixel_scale_arcsec"]
    write_cube(Path(out), cube, PIXSCALE=scale, GAIN=1.0)


def time_prediction(
    cube: str, bundle: str, out: str, threads: int, repeats: int
) -> dict[str, float]:
    """Time the stage `predict` and the bare network in turn.

    The bare network runs in two ways, one forward pass on all threads, and as many
    passes as threads beside each other; the faster one counts.

    Parameters
    ----------
    cube : path of the FITS cube
    bundle : path of the model
    out : path of the prediction
    threads, repeats : int

    Returns
    -------
    dict
        stamps, bare_shared_per_s, bare_parallel_per_s, predict_per_s (medians), and
        peak_mb of the prediction, interpreter and libraries included.
    """
    from psfdae.benchmark.isolated import forget_peak, peak_mb
    from psfdae.own_stars.model import BLOCK, load_model
    from psfdae.stages import predict as stage

    model = load_model(bundle)
    side = model.info.stamp_px
    model.predict(np.zeros((WARM_UP * BLOCK, side, side), np.float32), threads=threads)
    rates: dict[str, list[float]] = {"shared": [], "parallel": [], "predict": []}
    peak = stamps = 0.0
    for _ in range(repeats):
        forget_peak()
        start = perf_counter()
        summary = stage.run(
            stage.Source(Path(cube)), Path(out), model=Path(bundle), overwrite=True, threads=threads
        )
        rates["predict"].append(summary.stars / (perf_counter() - start))
        peak, stamps = max(peak, peak_mb()), summary.stars
        rates["shared"].append(_bare_rate(model, int(stamps), threads, shared=True))
        rates["parallel"].append(_bare_rate(model, int(stamps), threads, shared=False))
    median = {name: float(np.median(values)) for name, values in rates.items()}
    return {
        "stamps": stamps,
        "bare_shared_per_s": median["shared"],
        "bare_parallel_per_s": median["parallel"],
        "predict_per_s": median["predict"],
        "peak_mb": peak,
    }


def _bare_rate(model: Any, stamps: int, threads: int, shared: bool) -> float:
    """Stamps per second of the network alone, on images that are in memory."""
    import torch

    from psfdae.models.dae import predict
    from psfdae.own_stars.model import BLOCK, one_thread_each
    from psfdae.threads import side_by_side

    side, factor, network = (
        model.info.stamp_px,
        model.info.image_scale,
        model.engine.estimator.network,
    )
    mean = model.bundle.flux_model.mean.reshape(1, side, side).astype(np.float32)
    images = np.repeat(mean, min(BARE_STAMPS, stamps), axis=0)
    blocks = [images[start : start + BLOCK] for start in range(0, len(images), BLOCK)]
    rounds = -(-stamps // len(images))
    start = perf_counter()
    if shared:
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        for _ in range(rounds):
            predict(network, images, factor, BLOCK)
        torch.set_num_threads(before)
    else:
        with one_thread_each():
            side_by_side(
                lambda block: predict(network, block, factor, BLOCK), rounds * blocks, threads
            )
    return rounds * len(images) / (perf_counter() - start)
