"""The Gaussian mixture of many fresh stars of the simulator: more data, the same method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

from pydantic import Field

from psfdae.method import TrainingSet
from psfdae.methods.gmm import GaussianMixture, Gmm
from psfdae.settings import Count


class Simulated(Gmm):
    """Methods that learn from fresh stars, and the mixture's settings there."""

    stars: Count = Field(60000, description="Fresh stars, of random streams of their own")  # type: ignore[assignment]


@dataclass(frozen=True, eq=False)
class SimulatedMixture(GaussianMixture):
    """A mixture of fresh stars; the validation stars are those of the dataset."""

    label, color, marker = "GMM of fresh stars", "#aa4499", "p"
    drawn = False
    groups: ClassVar = {"simulated": Simulated}
    memory_mb = 2000

    @classmethod
    def fresh(cls, config: Any) -> int:
        """As set."""
        return int(config.simulated.stars)

    @classmethod
    def fit(cls, data: TrainingSet, simulated: Simulated) -> Self:
        """As any mixture; raises FitError without fresh stars, too."""
        return super().fit(data.on_fresh_stars(), simulated)

    def again(self, data: TrainingSet, simulated: Simulated) -> Self:
        """As any mixture, of fresh stars."""
        return super().again(data.on_fresh_stars(), simulated)
