"""Exact posterior where a star can only be one of a few known images (scene 2)."""

from __future__ import annotations

import numpy as np

from psfdae.bounds.likelihood import Likelihood


def exact_posterior(
    noisy: np.ndarray, templates: np.ndarray, likelihood: Likelihood
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior mean and probability of every template, its centring error summed out.

    All templates and all centring errors are equally likely beforehand.

    Parameters
    ----------
    noisy : ndarray, shape (n, d, d)
    templates : ndarray, shape (F, J, d, d)
        Every template at every centring error.
    likelihood : Likelihood
        Of the images' noise level.

    Returns
    -------
    mean : ndarray, shape (n, d, d)
    probability : ndarray, shape (n, F)
    """
    fields, shifts = templates.shape[:2]
    images = templates.reshape(fields * shifts, -1).astype(np.float64)
    ratio, offset = likelihood.factors(images)
    scores = likelihood.residuals(noisy) @ ratio.T + offset
    weight = np.exp(scores - scores.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = (weight @ images).reshape(noisy.shape)
    return mean, weight.reshape(-1, fields, shifts).sum(axis=2)
