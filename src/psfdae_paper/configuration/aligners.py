"""The methods of scene 3, in the order of its tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from psfdae.method import Look


@dataclass(frozen=True)
class Aligner:
    """How states are estimated, or how well they can be.

    To add a network is to add one of these with `states`, and its settings `train_<name>` to
    `config/config.yaml`.

    Attributes
    ----------
    name : str
    look : Look
    short : str
        Above small panels, if it has some.
    states : str
        Set of states that the network of this name is trained on; empty if there is none.
    noisy, denoised : bool
        The network is trained on noisy stamps; it sees what the DAE makes of stamps.
    other : str
        Network of another method that this one takes: to estimate, or to start a fit.
    fitted : bool
        Every state is fitted.
    free : bool
        Flux and place of the stars in their stamps are not given.
    swept : tuple of str
        Settings that a sweep may change.
    """

    name: str
    look: Look
    short: str = ""
    states: Literal["", "grid", "train"] = ""
    noisy: bool = False
    denoised: bool = False
    other: str = ""
    fitted: bool = False
    free: bool = False
    swept: tuple[str, ...] = ()

    @property
    def network(self) -> str:
        """Name of the network that it takes; empty if none."""
        return self.name if self.states else self.other


_ALIGNERS = [
    Aligner("constant", Look("always the middle", "black")),
    Aligner(
        "original",
        Look("CNN, noisy stamps", "#4d4d4d", paper=("original", "Original data")),
        "original",
        states="grid",
        swept=("cnn", "train_original"),
    ),
    Aligner(
        "dae",
        Look("CNN, DAE output", "#0072b2", paper=("dae", "DAE PSF")),
        "dae",
        denoised=True,
        other="original",
    ),
    Aligner(
        "noise_trained",
        Look("network trained on noisy stamps", "#d55e00"),
        "noise-trained",
        states="train",
        noisy=True,
        swept=("cnn", "perceptron", "train_noise_trained", "noise.levels"),
    ),
    Aligner(
        "dae_retrained",
        Look("network trained on DAE output", "#cc79a7"),
        "DAE, retrained",
        states="train",
        noisy=True,
        denoised=True,
    ),
    Aligner(
        "max_likelihood",
        Look("maximum likelihood", "#009e73"),
        "max. likelihood",
        other="noise_trained",
        fitted=True,
    ),
    Aligner(
        "max_likelihood_free",
        Look("maximum likelihood, flux and place free", "black"),
        other="noise_trained",
        fitted=True,
        free=True,
    ),
    Aligner("cramer_rao", Look("Cramér–Rao bound", "black")),
    Aligner("cramer_rao_pooled", Look("Cramér–Rao, all states", "black"), "Fisher"),
    Aligner("cramer_rao_free", Look("Cramér–Rao bound, flux and place free", "black"), free=True),
]
ALIGNERS = {aligner.name: aligner for aligner in _ALIGNERS}
ESTIMATORS = [aligner for aligner in _ALIGNERS if aligner.network]
LEARNED = [aligner for aligner in ESTIMATORS if not aligner.fitted]
"""Methods of the product "alignment_estimates", in its order."""

FITTED = [aligner for aligner in ESTIMATORS if aligner.fitted]
"""Methods of the product "alignment_fit", in its order."""

BOUNDS = [ALIGNERS["cramer_rao"], ALIGNERS["cramer_rao_free"]]
"""Bounds of the product "alignment_bound", in its order."""

TRAINED = [aligner.name for aligner in _ALIGNERS if aligner.states]
SWEPT = [aligner.name for aligner in _ALIGNERS if aligner.swept]
"""Networks that sweeps may train."""

WEIGHTS = "network.safetensors"
"""File of a network, in its folder."""


def of_set(aligners: list[Aligner], test_set: str) -> list[Aligner]:
    """What a test set is for: flux and place are free for uniform states only, as pages quote."""
    return [aligner for aligner in aligners if test_set == "uniform" or not aligner.free]
