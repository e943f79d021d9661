"""The files of a trained network, and the network from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from psfdae.reading import from_tree, read_yaml

WEIGHTS, CONFIG, HISTORY = "dae.safetensors", "config.yaml", "history.csv"
"""Files of a trained network."""


def trained_dae(folder: Path) -> tuple[Any, Any]:
    """Config group `dae` and network of a folder that `train` has written.

    Raises
    ------
    ProductError
        If a file is missing or damaged, or the two are not of the same training.
    """
    from psfdae.models.training import load_dae

    settings = dae_settings(folder, read_yaml(folder / CONFIG))
    return settings, load_dae(settings, folder / WEIGHTS)


def dae_settings(folder: Path, trained: dict[str, Any]) -> Any:
    """Config group `dae` of a training's configuration; raises ProductError."""
    from psfdae.configuration.compose import validate
    from psfdae.configuration.schema import Dae

    return from_tree(folder / CONFIG, trained, "dae", make=lambda tree: validate(Dae, tree))
