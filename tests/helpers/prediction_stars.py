"""Stars of the shipped model's scene that nothing was trained on, with noise, sky and truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from psfdae.base.files import read_product
from psfdae.denoise.error_model import ErrorModel
from psfdae.methods.bundle_info import Architecture, BundleInfo
from psfdae.methods.networks.dae import build_dae
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.configuration.consistency import SIMULATION, STATIC
from psfdae_paper.stages import stars

KAPPA, SKY = 4.98, 1e4


@dataclass(frozen=True)
class Observed:
    """Stamps in photons with what made them."""

    stamps: np.ndarray
    flux: float
    truth: np.ndarray

    @property
    def noise(self):
        return SKY**0.5 / self.flux


def fresh_psfs(folder, count):
    """Noise-free stars of flux 1 with aberrations that no training has seen, float64."""
    overrides = ["dataset=field", "seed=7", f"stars.count={count}"]
    overrides += ["parts.train_stars=1", "parts.test_stars=1"]
    stars.templates(load_stage(STATIC, overrides), folder / "templates.h5")
    stars.stars(load_stage(SIMULATION, overrides), folder / "templates.h5", folder / "stars.h5")
    product = read_product(folder / "stars.h5", "stars", ("realisation",))
    return product["realisation"].astype(np.float64)


def observe(psf, level, seed=0):
    """Photon counts of stars of noise level λ on a sky of 10⁴ photons."""
    flux = SKY**0.5 / (KAPPA * level)
    stamps = np.random.default_rng(seed).poisson(flux * psf + SKY).astype(np.float32)
    return Observed(stamps, flux, psf)


def with_network(bundle):
    """The bundle with a network of random weights in place of its method."""
    shape = Architecture(kernels=(5, 3, 5), widths=(4, 4))
    network = build_dae(shape.kernels, shape.widths, "he", torch.Generator().manual_seed(1))
    description = bundle.info.model_dump()
    description |= {"method": "dae", "dae": shape, "image_scale": 256.0}
    errors = bundle.errors
    unscaled = ErrorModel.build_uncalibrated(errors.noise, errors.half_width68)
    limit = errors.distance_limit
    return replace(
        bundle,
        info=BundleInfo(**description),
        weights={name: value.contiguous().numpy() for name, value in network.state_dict().items()},
        errors=replace(unscaled, ratio95=errors.ratio95, distance_limit=limit),
    )


def gaussians(count, seed, side=12, narrowest=0.8):
    """Gaussian stars of random width and position, (count, side, side), float32, of sum 1."""
    rng = np.random.default_rng(seed)
    grid = np.arange(side) - side // 2
    centre = rng.uniform(-1, 1, size=(2, count, 1, 1))
    width = rng.uniform(narrowest, 2.5, size=(count, 1, 1))
    r2 = (grid[:, None] - centre[0]) ** 2 + (grid - centre[1]) ** 2
    images = np.exp(-0.5 * r2 / width**2)
    return (images / images.sum(axis=(1, 2), keepdims=True)).astype(np.float32)
