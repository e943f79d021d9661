"""The DAE trained on many fresh stars of the simulator: tells method and data apart."""

from __future__ import annotations

from typing import Any, ClassVar

from psfdae.method import TrainingSet
from psfdae.methods.dae import Dae
from psfdae.networks.settings import DaeSettings, Train
from psfdae_paper.methods.gmm_simulated import Simulated


class SimulatedDae(Dae):
    """As many steps as on the stars of the dataset, each star seen less often."""

    label, color, marker = "DAE of fresh stars", "#56b4e9", "d"
    paper = None
    drawn = False
    groups: ClassVar = {**Dae.groups, "simulated": Simulated}

    @classmethod
    def fresh(cls, config: Any) -> int:
        """As set."""
        return int(config.simulated.stars)

    @classmethod
    def fit(cls, data: TrainingSet, dae: DaeSettings, train: Train, simulated: Simulated) -> Dae:
        """Train on the fresh stars; raises FitError without any, too."""
        fresh = data.on_fresh_stars()
        epochs = max(1, round(train.epochs * data.fit.size / fresh.fit.size))
        return super().fit(
            fresh, dae, train.model_copy(update={"epochs": epochs, "validate_every": 1})
        )
