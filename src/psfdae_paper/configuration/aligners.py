"""The methods of scene 3, in the order of its tables.

One entry says what a method estimates states from; products, rules, tables and figures follow it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from psfdae.method import Look


@dataclass(frozen=True)
class Aligner:
    """Method that estimates states of misalignment, or a bound of such estimates.

    To add a network, add one of these with `states`, and its settings `train_<name>` to
    `config/config.yaml`.

    Attributes
    ----------
    name : str
        Name in tables and files.
    look : Look
        Label, colour and marker in figures.
    short : str
        Title of small panels; empty if it has none.
    states : str
        Set of states that the network of this name is trained on; empty if there is no network.
    noisy : bool
        The network is trained on noisy stamps.
    denoised : bool
        The input of the network is the output of the DAE.
    borrowed_network : str
        Method whose network this one uses: to estimate, or to start a fit.
    fitted : bool
        Every state is fitted by maximum likelihood.
    unknown_flux : bool
        Flux and position of the stars in their stamps are not given.
    swept : tuple of str
        Settings that a sweep may change.
    """

    name: str
    look: Look
    short: str = ""
    states: Literal["", "grid", "train"] = ""
    noisy: bool = False
    denoised: bool = False
    borrowed_network: str = ""
    fitted: bool = False
    unknown_flux: bool = False
    swept: tuple[str, ...] = ()

    @property
    def network(self) -> str:
        """Method whose network is used, this or another one; empty if none is."""
        return self.name if self.states else self.borrowed_network


_ALIGNERS = [
    # The aligned telescope, whatever the stamps: the error that a method must beat.
    Aligner("constant", Look("always the middle", "black")),
    # The paper's network: it learns noise-free stamps of the grid, and estimates from noisy ones.
    Aligner(
        "original",
        Look("CNN, noisy stamps", "#4d4d4d", paper=("original", "Original data")),
        "original",
        states="grid",
        swept=("cnn", "train_original"),
    ),
    # The same network behind the DAE, which takes the noise from the stamps.
    Aligner(
        "dae",
        Look("CNN, DAE output", "#0072b2", paper=("dae", "DAE PSF")),
        "dae",
        denoised=True,
        borrowed_network="original",
    ),
    # Not in the paper: a network that has seen noise needs no DAE, and one that is trained on the
    # DAE's output knows its errors.
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
    # Fits of single states, which start at the estimate of a network.
    Aligner(
        "max_likelihood",
        Look("maximum likelihood", "#009e73"),
        "max. likelihood",
        borrowed_network="noise_trained",
        fitted=True,
    ),
    Aligner(
        "max_likelihood_free",
        Look("maximum likelihood, flux and place free", "black"),
        borrowed_network="noise_trained",
        fitted=True,
        unknown_flux=True,
    ),
    # Bounds of unbiased estimates: of each state, of the errors of all states together, and with
    # unknown flux and position.
    Aligner("cramer_rao", Look("Cramér–Rao bound", "black")),
    Aligner("cramer_rao_pooled", Look("Cramér–Rao, all states", "black"), "Fisher"),
    Aligner(
        "cramer_rao_free", Look("Cramér–Rao bound, flux and place free", "black"), unknown_flux=True
    ),
]
ALIGNERS = {aligner.name: aligner for aligner in _ALIGNERS}
"""Methods and bounds by name."""

ESTIMATORS = [aligner for aligner in _ALIGNERS if aligner.network]
"""Methods that estimate states with a network, alone or before a fit."""

LEARNED = [aligner for aligner in ESTIMATORS if not aligner.fitted]
"""Methods of the product "alignment_estimates", in its order."""

FITTED = [aligner for aligner in ESTIMATORS if aligner.fitted]
"""Methods of the product "alignment_fit", in its order."""

BOUNDS = [ALIGNERS["cramer_rao"], ALIGNERS["cramer_rao_free"]]
"""Bounds of the product "alignment_bound", in its order."""

TRAINED = [aligner.name for aligner in _ALIGNERS if aligner.states]
"""Methods that have a network of their own."""

SWEPT = [aligner.name for aligner in _ALIGNERS if aligner.swept]
"""Networks that sweeps may train."""

WEIGHTS = "network.safetensors"
"""Name of a network's file in its folder."""


def methods_of_set(aligners: list[Aligner], test_set: str) -> list[Aligner]:
    """Return the methods that are applied to a test set.

    Those with unknown flux and position are applied to uniform states only.
    """
    return [aligner for aligner in aligners if test_set == "uniform" or not aligner.unknown_flux]
