"""The Gaussian mixture of many fresh stars that is given where a star stands."""

from __future__ import annotations

from dataclasses import dataclass

from psfdae_paper.methods.gmm_simulated import SimulatedMixture


@dataclass(frozen=True, eq=False)
class PlacedSimulatedMixture(SimulatedMixture):
    """A mixture of fresh images, references and positions."""

    label, color, marker = "GMM of fresh stars", "#661100", "*"
    needs_position = True
    bundled = False
