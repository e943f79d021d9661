"""The methods of scene 3, in the order of its tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Method:
    """How states are estimated, or how well they can be.

    To add a network is to add one of these with `states`, and its settings `train_<name>` to the
    configuration.

    Attributes
    ----------
    label, short, color : str
        In tables and figures; above small panels, if it has some; of its curves.
    paper : str
        What the paper calls it, if it is one of the paper's.
    states : str
        Set of states that the network of this name is trained on; empty if there is none.
    noisy, denoised : bool
        The network is trained on noisy stamps; it sees what the DAE makes of stamps.
    other : str
        Network of another method that this one takes: to estimate, or to start a fit.
    fitted : bool
        Every state is fitted.
    free : bool
        Nobody tells it the flux and the place of the stars in their stamps.
    """

    name: str
    label: str
    short: str = ""
    color: str = "black"
    paper: str = ""
    states: Literal["", "grid", "train"] = ""
    noisy: bool = False
    denoised: bool = False
    other: str = ""
    fitted: bool = False
    free: bool = False

    @property
    def network(self) -> str:
        """Name of the network that it takes; empty if none."""
        return self.name if self.states else self.other


_METHODS = [
    Method("constant", "always the middle"),
    Method(
        "original",
        "CNN, noisy stamps",
        "original",
        "#4d4d4d",
        paper="Original data",
        states="grid",
    ),
    Method(
        "dae",
        "CNN, DAE output",
        "dae",
        "#0072b2",
        paper="DAE PSF",
        denoised=True,
        other="original",
    ),
    Method(
        "noise_trained",
        "network trained on noisy stamps",
        "noise-trained",
        "#d55e00",
        states="train",
        noisy=True,
    ),
    Method(
        "dae_retrained",
        "network trained on DAE output",
        "DAE, retrained",
        "#cc79a7",
        states="train",
        noisy=True,
        denoised=True,
    ),
    Method(
        "max_likelihood",
        "maximum likelihood",
        "max. likelihood",
        "#009e73",
        other="noise_trained",
        fitted=True,
    ),
    Method(
        "max_likelihood_free",
        "maximum likelihood, flux and place free",
        other="noise_trained",
        fitted=True,
        free=True,
    ),
    Method("cramer_rao", "Cramér–Rao bound"),
    Method("cramer_rao_pooled", "Cramér–Rao, all states", "Fisher"),
    Method("cramer_rao_free", "Cramér–Rao bound, flux and place free", free=True),
]
METHODS = {method.name: method for method in _METHODS}
ESTIMATORS = [method for method in METHODS.values() if method.network]
LEARNED = [method for method in ESTIMATORS if not method.fitted]
"""Methods of the product "alignment_estimates", in its order."""

FITTED = [method for method in ESTIMATORS if method.fitted]
"""Methods of the product "alignment_fit", in its order."""

BOUNDS = [METHODS["cramer_rao"], METHODS["cramer_rao_free"]]
"""Bounds of the product "alignment_bound", in its order."""


def of_set(methods: list[Method], test_set: str) -> list[Method]:
    """What a test set is for: flux and place are free for uniform states only, as pages quote."""
    return [method for method in methods if test_set == "uniform" or not method.free]


TRAINED = [method.name for method in METHODS.values() if method.states]
