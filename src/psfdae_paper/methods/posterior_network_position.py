"""Method `posterior_network_position`: the posterior network with the position in the field."""

from __future__ import annotations

from psfdae.methods.interface import Look, Needs
from psfdae_paper.methods.posterior_network import PosteriorNetworkMethod


class PlacedPosteriorNetwork(PosteriorNetworkMethod):
    """Network of images and positions."""

    look = Look("posterior network", "#44aa99", "H", is_drawn=False)
    needs = Needs(level=True, position=True, validation=True, memory_mb=2000, minutes=60)
    packing = None
