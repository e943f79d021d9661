"""The Gaussian mixture that is given where in the field a star stands, as an observer knows."""

from __future__ import annotations

from dataclasses import dataclass

from psfdae.methods.gmm import GaussianMixture
from psfdae.methods.interface import Look, Needs


@dataclass(frozen=True, eq=False, repr=False)
class PlacedMixture(GaussianMixture):
    """A mixture of images, references and positions."""

    look = Look("GMM", "#882255", "X", drawn=False)
    needs = Needs(level=True, position=True, memory_mb=1200)
    packing = None
