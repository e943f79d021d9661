"""Stress tests of single precision, from the kernel to the metrics."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np
import torch

from psfdae.evaluation.metrics import mse, ssim
from psfdae.models.dae import image_scale
from psfdae.optics.wavefronts import WavefrontSource, seidel_wavefronts
from psfdae.rng import stream
from psfdae.stability.bench import Bench, Scene, stamp_mse
from psfdae.stability.networks import rounding_of, trained_network
from psfdae.stability.rows import Entry, at_most
from psfdae.stages.common import template_wavefronts
from psfdae.stars.fields import relative_field
from psfdae.stars.framing import normalise_flux
from psfdae.stars.scene import Propagation

EPS = float(np.finfo(np.float32).eps)
"""Relative spacing of single precision."""


def kernel(bench: Bench) -> Iterator[Entry]:
    """complex64 against complex128 on the same grid, both scenes."""
    for name, scene in (("scene 1", bench.seidel), ("scene 2", bench.turbulence)):
        source = _some_wavefronts(scene)
        reach = scene.config.framing.search_px
        both = {}
        for precision in ("complex64", "complex128"):
            optics = scene.config.optics.model_copy(update={"precision": precision})
            propagation = Propagation(
                source, scene.config.telescope, optics, scene.config.framing, reach
            )
            if not both:
                offset = propagation.brightest()
            both[precision] = propagation.stamps(scene.config.framing.stamp_px, offset)
        single, double = both["complex64"], both["complex128"]
        yield at_most(
            f"kernel in single precision, {name}",
            "MSE of normalised stamps",
            stamp_mse(single, double),
            bench.budget(scene),
        )
        # A phase of W waves is rounded by 2πW·ε; the sum over the pupil can only average it.
        waves = max(float(np.abs(source.slopes()).max()), 1.0)
        peak = double.max(axis=(1, 2), keepdims=True)
        yield at_most(
            f"kernel in single precision, {name}",
            "largest pixel difference over peak",
            float((np.abs(single - double) / peak).max()),
            2 * np.pi * waves * EPS,
        )
        rounded, _ = normalise_flux(double.astype(np.float32))
        exact, _ = normalise_flux(double)
        # Pairwise summation of P positive terms rounds log2 P times, the quotient once.
        depth = 2 + np.log2(double[0].size)
        yield at_most(
            f"flux normalisation in single precision, {name}",
            "largest relative difference",
            float(np.abs(rounded / exact - 1).max()),
            depth * EPS,
        )


def principal_components(bench: Bench) -> Iterator[Entry]:
    """The subspace of the components in single and in double precision."""
    from sklearn.decomposition import PCA

    count = bench.config.baseline.components
    images = _noisy(bench).reshape(len(bench.seidel.images), -1)
    single, double = (
        PCA(count, svd_solver="full").fit(images.astype(t)) for t in (np.float32, np.float64)
    )
    spectrum = np.linalg.svd(images - images.mean(axis=0), compute_uv=False)
    # Davis & Kahan 1970: the angle is at most the perturbation over the gap; the singular
    # values of rounded data move by their norm times ε times the root of the size.
    gap = (spectrum[count - 1] - spectrum[count]) / spectrum[0]
    yield at_most(
        "PCA in single precision",
        "sine of the largest angle between the subspaces",
        subspace_angle(single.components_, double.components_),
        np.sqrt(images.shape[0]) * EPS / gap,
    )


def network(bench: Bench) -> Iterator[Entry]:
    """The same weights in single and in double precision."""
    single = trained_network(bench)
    double = copy.deepcopy(single).double()
    factor = image_scale(bench.config.dae.scale, bench.seidel.images.shape[-1])
    images = torch.from_numpy(_noisy(bench)[:64].astype(np.float32))[:, None] * factor
    with torch.inference_mode():
        exact = double(images.double())
        difference = (single(images).double() - exact).abs().max() / exact.abs().max()
    yield at_most(
        "DAE in single precision",
        "largest difference over largest output",
        float(difference),
        rounding_of(bench.config.dae),
    )


def metrics(bench: Bench) -> Iterator[Entry]:
    """MSE and SSIM of images rounded to single precision."""
    truth = bench.seidel.images.astype(np.float64)
    noisy = _noisy(bench)
    rounded = noisy.astype(np.float32)
    exact = mse(noisy, truth)
    # ε/2 per pixel, relative to the pixel, enters the squared difference twice.
    relative = EPS * np.abs(noisy).max() / np.sqrt(exact.min())
    yield at_most(
        "MSE in single precision",
        "largest relative difference",
        float(np.abs(mse(rounded, truth) / exact - 1).max()),
        float(relative),
    )
    data_range = bench.config.evaluation.data_range
    change = np.abs(ssim(rounded, truth, data_range) - ssim(noisy, truth, data_range))
    # SSIM changes by at most the relative change of its windows' second moments.
    yield at_most("SSIM in single precision", "largest difference", float(change.max()), 10 * EPS)


def subspace_angle(first: np.ndarray, second: np.ndarray) -> float:
    """Sine of the largest principal angle between the row spaces of (K, P) arrays."""
    a, b = (np.linalg.qr(rows.T.astype(np.float64))[0] for rows in (first, second))
    # From the part of one that lies outside the other: cosines near 1 would lose all digits.
    return float(np.linalg.norm(b - a @ (a.T @ b), 2))


def _some_wavefronts(scene: Scene) -> WavefrontSource:
    config = scene.config
    if config.scene.name == "turbulence":
        grid = config.grid.model_copy(update={"points": 3})
        return template_wavefronts(config.model_copy(update={"grid": grid}))
    field = relative_field(config.grid)
    corner = field[:: max(1, len(field) // 12)]
    return seidel_wavefronts(np.tile(config.wavefront.coefficients, (len(corner), 1)), corner)


def _noisy(bench: Bench) -> np.ndarray:
    """Noisy stars at the band's smallest level in double precision."""
    images = bench.seidel.images
    level = min(bench.config.noise.levels)
    rng = stream(bench.seed, "stability", "precision")
    sigma = np.sqrt(bench.noise.variance(images.astype(np.float64), level))
    return images + sigma * rng.standard_normal(images.shape)


CASES = (kernel, principal_components, network, metrics)
"""All cases of this module."""
