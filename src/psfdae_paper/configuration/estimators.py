"""The methods of scene 3, in the order of its tables.

An entry describes the input of a method; products, rules, tables and figures follow from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from psfdae.methods.interface import Look


@dataclass(frozen=True)
class Estimator:
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
        Title of small panels; empty without one.
    states : str
        Set of states that the network of this name is trained on; empty without a network.
    noisy : bool
        The network is trained on noisy stamps.
    uses_dae : bool
        The input of the network is the output of the DAE.
    borrowed_network : str
        Method whose network this one uses: to estimate, or to start a fit.
    product : str
        Product with the results of the method, without "alignment_": estimates of networks, fits of
        single states by maximum likelihood, or bounds; empty if they are not in a product.
    unknown_flux : bool
        Flux and position of the stars in their stamps are not given.
    swept : tuple of str
        Settings that a sweep may change.
    weights_file : str
        Name of the file with the weights of a network, in its folder.
    """

    weights_file: ClassVar = "network.safetensors"

    name: str
    look: Look
    short: str = ""
    states: Literal["", "grid", "train"] = ""
    noisy: bool = False
    uses_dae: bool = False
    borrowed_network: str = ""
    product: Literal["", "estimates", "fit", "bound"] = ""
    unknown_flux: bool = False
    swept: tuple[str, ...] = ()

    @property
    def network(self) -> str:
        """Method whose network is used, this or another one; empty without a network."""
        return self.name if self.states else self.borrowed_network

    @property
    def is_drawn(self) -> bool:
        """True if figures show estimates and errors: a network is used, and the flux is given."""
        return bool(self.network) and not self.unknown_flux


ESTIMATORS = {
    estimator.name: estimator
    for estimator in (
        # The aligned telescope, for all stamps: the error that a method must beat.
        Estimator("constant", Look("always the middle", "black")),
        # The paper's network: it is trained on noise-free stamps of the grid, and estimates from
        # noisy ones.
        Estimator(
            "original",
            Look("CNN, noisy stamps", "#4d4d4d", paper=("original", "Original data")),
            "original",
            states="grid",
            product="estimates",
            swept=("cnn", "train_original"),
        ),
        # The same network behind the DAE, which removes the noise from the stamps.
        Estimator(
            "dae",
            Look("CNN, DAE output", "#0072b2", paper=("dae", "DAE PSF")),
            "dae",
            uses_dae=True,
            borrowed_network="original",
            product="estimates",
        ),
        # Not in the paper: a network that has seen noise needs no DAE, and one that is trained on
        # the DAE's output knows its errors.
        Estimator(
            "noise_trained",
            Look("network trained on noisy stamps", "#d55e00"),
            "noise-trained",
            states="train",
            noisy=True,
            product="estimates",
            swept=("cnn", "perceptron", "train_noise_trained", "noise.levels"),
        ),
        Estimator(
            "dae_retrained",
            Look("network trained on DAE output", "#cc79a7"),
            "DAE, retrained",
            states="train",
            noisy=True,
            product="estimates",
            uses_dae=True,
        ),
        # Fits of single states, which start at the estimate of a network.
        Estimator(
            "max_likelihood",
            Look("maximum likelihood", "#009e73"),
            "max. likelihood",
            borrowed_network="noise_trained",
            product="fit",
        ),
        Estimator(
            "max_likelihood_free",
            Look("maximum likelihood, flux and place free", "black"),
            borrowed_network="noise_trained",
            product="fit",
            unknown_flux=True,
        ),
        # Bounds of unbiased estimates: of each state, of the errors of all states together, and
        # with unknown flux and position.
        Estimator("cramer_rao", Look("Cramér–Rao bound", "black"), product="bound"),
        Estimator("cramer_rao_pooled", Look("Cramér–Rao, all states", "black"), "Fisher"),
        Estimator(
            "cramer_rao_free",
            Look("Cramér–Rao bound, flux and place free", "black"),
            product="bound",
            unknown_flux=True,
        ),
    )
}
"""Methods and bounds by name."""


def list_estimators(product: str, test_set: str = "uniform") -> list[Estimator]:
    """Return the methods of a product, or the bounds, in the order of its arrays.

    Methods with unknown flux and position are applied to uniform states only.

    Parameters
    ----------
    product : str
        "estimates", "fit" or "bound"; see `Estimator.product`.
    test_set : str
        "uniform" or "grid".
    """
    return [
        estimator
        for estimator in ESTIMATORS.values()
        if estimator.product == product and (test_set == "uniform" or not estimator.unknown_flux)
    ]


def list_trained_networks() -> list[str]:
    """Return the names of the methods that have a network of their own."""
    return [name for name, estimator in ESTIMATORS.items() if estimator.states]


def list_swept_networks() -> list[str]:
    """Return the names of the networks that sweeps may train."""
    return [name for name, estimator in ESTIMATORS.items() if estimator.swept]
