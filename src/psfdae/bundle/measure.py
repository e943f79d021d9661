"""What a bundle has to know of its network: the errors that it makes on test stars.

Errors are per pixel and per noise level. They are not normally distributed: the core
of a PSF, its wings and the rare star that is unlike all others share a pixel, and the
root mean square is then wider than the interval that holds 68 % of the errors. A
bundle carries both.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from psfdae.bundle.statistics import at_noise, mahalanobis
from psfdae.stars.flux import FluxModel
from psfdae.stars.noise import NoiseModel

NODES = 8
"""Noise levels at which errors are measured, equidistant in the logarithm."""

COMPONENTS = 48
"""Leading eigenvectors that a bundle stores."""

COVERAGE = 0.6827
"""Part of the errors within ± `error68`; that of a normal variable within ± 1 σ."""

LIMIT = 0.999
"""Part of the test stars within the limit of the Mahalanobis distance."""

LEAST_STARS = 2000
"""Noisy images per node; few test stars are seen several times with new noise."""

Predict = Callable[[np.ndarray], np.ndarray]
"""The network: normalised noisy images to PSFs, both (n, d, d)."""


@dataclass(frozen=True)
class HeldOutStars:
    """Noise-free stars that no training has seen.

    Attributes
    ----------
    images, references : ndarray, shape (n, d, d)
        Of flux 1.
    noise : NoiseModel
    """

    images: np.ndarray
    references: np.ndarray
    noise: NoiseModel

    def draws(self) -> np.ndarray:
        """Star of every noisy image at a node."""
        return np.tile(np.arange(len(self.images)), -(-LEAST_STARS // len(self.images)))


@dataclass(frozen=True)
class Errors:
    """Errors of the PSFs of test stars at the nodes.

    Attributes
    ----------
    nodes : ndarray, shape (S,)
        Noise: pixel RMS over the flux.
    error : ndarray, shape (S, N, d, d), float32
        PSF minus reference.
    star : ndarray of int, shape (N,)
        Star of every error.
    distance : ndarray, shape (S, N)
        Mahalanobis distance of the noisy images.
    """

    nodes: np.ndarray
    error: np.ndarray
    star: np.ndarray
    distance: np.ndarray

    def of(self, chosen: np.ndarray) -> Errors:
        """Those of some stars, from a mask over stars."""
        kept = chosen[self.star]
        return replace(
            self,
            error=self.error[:, kept],
            star=self.star[kept],
            distance=self.distance[:, kept],
        )

    def half_width(self) -> np.ndarray:
        """Half-width of the interval around 0 that holds 68.27 %, shape (S, d, d)."""
        return np.stack([np.quantile(np.abs(node), COVERAGE, axis=0) for node in self.error])

    def rms(self) -> np.ndarray:
        """Root mean square per pixel, shape (S, d, d)."""
        return np.sqrt(np.stack([np.square(node).mean(axis=0) for node in self.error]))

    def distance_limit(self) -> float:
        """Distance that 0.1 % of the stars of all nodes exceed."""
        return float(np.quantile(self.distance, LIMIT))


def noise_nodes(lowest: float, highest: float, nodes: int = NODES) -> np.ndarray:
    """Noise at which errors are measured, ascending; a single one if there is no range."""
    return np.geomspace(lowest, highest, nodes) if highest > lowest else np.array([lowest])


def leading(model: FluxModel, components: int) -> FluxModel:
    """The model with the variance beyond its leading eigenvectors spread evenly."""
    variance = model.variance.copy()
    rest = variance[: variance.size - components]
    if rest.size:
        rest[:] = rest.sum() / rest.size
    return replace(model, variance=variance)


def noise_equivalent_px(mean: np.ndarray) -> float:
    """Noise-equivalent area A = 1/Σm² of a PSF m of sum 1 (King 1983, PASP 95, 163)."""
    return 1.0 / float(np.square(mean).sum())


def signal_to_noise(noise: float, area: float) -> float:
    """S/N of a star from the pixel RMS over its flux and the noise-equivalent area in pixels."""
    return float(1.0 / (noise * np.sqrt(area)))


def measure_errors(
    stars: HeldOutStars,
    predict: Predict,
    model: FluxModel,
    nodes: np.ndarray,
    rng: np.random.Generator,
) -> Errors:
    """Errors and distances of noisy test stars at every node.

    Parameters
    ----------
    stars : HeldOutStars
    predict : the network
    model : FluxModel
        Of the training stars.
    nodes : ndarray, shape (S,)
        Noise: pixel RMS over the flux.
    rng : Generator
    """
    star = stars.draws()
    error = np.empty((len(nodes), star.size, *stars.images.shape[1:]), np.float32)
    distance = np.empty((len(nodes), star.size))
    for place, level in enumerate(nodes):
        noisy = stars.noise.draw(stars.images[star], level / stars.noise.kappa, rng)
        error[place] = predict(noisy) - stars.references[star]
        distance[place] = mahalanobis(noisy, np.full(star.size, level), model, COMPONENTS)
    return Errors(nodes, error, star, distance)


def coverage(error: np.ndarray, noise: np.ndarray, nodes: np.ndarray, maps: np.ndarray) -> float:
    """Part of the errors (n, d, d) within ± the map at the noise of each star (n,)."""
    return float((np.abs(error) <= at_noise(noise, nodes, maps)).mean())


def crossed_coverage(errors: Errors, error: np.ndarray, noise: float) -> dict[str, float]:
    """Coverage at another noise, of either half of the stars by the errors of the other.

    Parameters
    ----------
    errors : Errors
        At the nodes.
    error : ndarray, shape (n, d, d)
        Of every star once, at `noise`.
    noise : float

    Returns
    -------
    dict
        `coverage68` of the half-width and `coverage_rms` of the root mean square.
    """
    even = np.arange(len(error)) % 2 == 0
    found: dict[str, list[float]] = {"coverage68": [], "coverage_rms": []}
    for half in (even, ~even):
        if not half.any() or half.all():
            continue
        other = errors.of(~half)
        level = np.full(int(half.sum()), noise)
        for name, maps in (("coverage68", other.half_width()), ("coverage_rms", other.rms())):
            found[name].append(coverage(error[half], level, errors.nodes, maps))
    return {name: float(np.mean(values)) for name, values in found.items() if values}


def checksum(images: np.ndarray, references: np.ndarray) -> str:
    """SHA-256 of training stars and of what was to be learnt from them."""
    digest = hashlib.sha256()
    for array in (images, references):
        digest.update(f"{array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
