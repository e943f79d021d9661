"""Stamps of stars behind known wavefronts of the example telescopes."""

from __future__ import annotations

import numpy as np

import psfdae
from psfdae.sensing.stars import StarOptics
from psfdae.telescope.field import build_terms
from psfdae.telescope.settings import read_telescope
from psfdae_paper.configuration.base import config_dir

SKY = 1000.0


def example(kind):
    return read_telescope(config_dir() / "telescope" / f"example_{kind}.yaml")


def three_terms():
    """The example with focus, astigmatism and coma alone."""
    telescope = example("zernike")
    terms = {name: telescope.aberrations.terms[name] for name in ("z4", "z6", "z8")}
    aberrations = telescope.aberrations.model_copy(update={"terms": terms})
    return telescope.model_copy(update={"aberrations": aberrations})


def field_of(telescope, count, rng):
    return rng.uniform(-1.0, 1.0, (count, 2)) * telescope.field_edge_deg


def sensed(counts, telescope, angle, **options):
    options = {"noise": SKY**0.5, "gain": 1.0, **options}
    return psfdae.wavefront(counts, telescope, field_deg=angle, **options)


def imaged(telescope, angle, coefficients, place, snr, rng=None):
    """Stamps in counts of gain 1, noise-free without a generator, and fluxes."""
    terms = build_terms(telescope, angle)
    waves = np.einsum("mk,mkj->mj", coefficients, terms.to_modes)
    operator = StarOptics(telescope, terms, 16).operator
    images = operator.stamps(np.concatenate([waves, place], axis=1)).astype(float)
    flux = snr * np.sqrt(SKY / (images**2).sum(axis=(1, 2)))
    mean = flux[:, None, None] * images + SKY
    return (mean if rng is None else rng.poisson(mean).astype(float)), flux
