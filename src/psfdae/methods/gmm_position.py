"""Gaussian mixture with the position of a star in the field as an additional input."""

from __future__ import annotations

from dataclasses import dataclass

from psfdae.methods.gmm import GaussianMixture
from psfdae.methods.interface import Look, Needs


@dataclass(frozen=True, eq=False, repr=False)
class PlacedMixture(GaussianMixture):
    """Mixture of images, references and positions."""

    look = Look("GMM", "#882255", "X", is_drawn=False)
    needs = Needs(level=True, position=True, memory_mb=1200)
    packing = None
