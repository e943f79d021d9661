"""The telescope's optics as an estimator that is given the field position of each star."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from psfdae.methods.gmm_position import PlacedMixture
from psfdae.methods.interface import Look, Needs
from psfdae_paper.methods.wavefront import Wavefront


@dataclass(frozen=True, eq=False)
class PlacedWavefront(Wavefront):
    """Estimator `Wavefront` for stars whose field is given."""

    look = Look("optics of the telescope", "#b8860b", "p", is_drawn=False)
    needs = Needs(level=True, position=True)
    fallback: ClassVar = PlacedMixture
