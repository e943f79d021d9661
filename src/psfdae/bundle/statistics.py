"""What a bundle says of a star: how wrong its PSF may be, how unlike the training set it is."""

from __future__ import annotations

import numpy as np

from psfdae.stars.flux import FluxModel


def at_noise(noise: np.ndarray, nodes: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Maps of errors at the noise of each star, interpolated linearly in the noise.

    Linear in the noise and not in its logarithm: an error is a floor plus something
    that grows about as fast as the noise. Outside the nodes the nearest one counts.

    Parameters
    ----------
    noise : ndarray, shape (n,)
        RMS of the sky noise in a pixel over the flux, such as `BundleInfo.noise_min`.
    nodes : ndarray, shape (S,)
        Noise at which the maps were measured, ascending.
    maps : ndarray, shape (S, d, d)
        `Bundle.error68` or `Bundle.rms`.

    Returns
    -------
    ndarray, shape (n, d, d)
        In the unit of the maps; NaN where the noise is NaN.
    """
    noise = np.asarray(noise, dtype=np.float64)
    place = np.interp(noise, nodes, np.arange(len(nodes), dtype=np.float64))
    lower = np.where(np.isfinite(place), np.minimum(place, len(nodes) - 1), 0).astype(np.intp)
    upper = np.minimum(lower + 1, len(nodes) - 1)
    share = (place - lower).astype(maps.dtype)[:, None, None]
    return maps[lower] * (1 - share) + maps[upper] * share


def mahalanobis(
    stamps: np.ndarray, noise: np.ndarray, model: FluxModel, components: int
) -> np.ndarray:
    """Distance of stars from the training set, in the space of its leading eigenvectors.

    D² = Σ_k (e_kᵀ(x − m))² / (Λ_k + noise²) over the eigenvectors e_k with the largest
    eigenvalues Λ_k: the distance of Mahalanobis (1936) with the noise of the star as
    part of the covariance. Faint stars are unlike the mean by their noise, which says
    nothing; D² of either kind of star is about `components`.

    Parameters
    ----------
    stamps : ndarray, shape (n, d, d)
        Sky-subtracted, repaired, of flux 1, framed as the training stars.
    noise : ndarray, shape (n,)
        RMS of the sky noise in a pixel over the flux.
    model : FluxModel
        Eigenvalues ascending.
    components : int
        Eigenvectors that count, `BundleInfo.components`.

    Returns
    -------
    ndarray, shape (n,), float64
    """
    centred = stamps.reshape(len(stamps), -1) - model.mean
    scores = centred @ model.basis[:, -components:]
    variance = model.variance[-components:] + np.asarray(noise, dtype=np.float64)[:, None] ** 2
    return np.sqrt((scores**2 / variance).sum(axis=1))
