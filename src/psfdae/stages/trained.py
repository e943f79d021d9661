"""The files of a trained network: how a training leaves them, and the network from them."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.belonging import write_origin
from psfdae.configuration.compose import decisive
from psfdae.files import Product, write_text
from psfdae.reading import from_tree, read_yaml

if TYPE_CHECKING:
    from psfdae.models.training import Row, Training

WEIGHTS, CONFIG, HISTORY = "dae.safetensors", "config.yaml", "history.csv"
"""Files of a trained network."""

ERRORS = {"train_mse": "train MSE", "validation_mse": "validation MSE", "loss": "loss"}
"""Columns of a history that are shown while a training runs."""


def fingerprint(described: dict[str, Any], *arrays: np.ndarray) -> str:
    """Hash of what a training sees, and of what of its configuration counts."""
    digest = hashlib.sha256(json.dumps(decisive(described), sort_keys=True).encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


@contextmanager
def progress(epochs: int) -> Iterator[Callable[[Row], None]]:
    """What a training calls after each epoch: a bar, in a log a line."""
    from tqdm import tqdm

    terminal = sys.stderr.isatty()

    def report(row: Row) -> None:
        errors = [f"{name} {row[key]:.3e}" for key, name in ERRORS.items() if key in row]
        bar.set_postfix_str(errors[0])
        bar.update()
        if not terminal:
            line = (f"epoch {row['epoch']:.0f}/{epochs}", *errors, f"{row['seconds']:.0f} s")
            print("  ".join(line), flush=True)

    with tqdm(total=epochs, unit="epoch", disable=not terminal, desc="train") as bar:
        yield report


def keep(
    training: Training,
    folder: Path,
    weights: str,
    described: dict[str, Any],
    product: Product,
    **noted: Any,
) -> None:
    """Write weights, history, resolved config, and what the training data say of themselves."""
    from psfdae.models.weights import save_weights

    save_weights(folder / weights, training.result, described)
    write_origin(folder, product)
    write_text(folder / HISTORY, as_csv(training.history))
    write_text(folder / CONFIG, as_yaml({**described, **noted}))


def as_csv(rows: list[Row]) -> str:
    """CSV of a training's history."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_yaml(tree: dict[str, Any]) -> str:
    """YAML of a resolved configuration, keys sorted."""
    import yaml

    return yaml.safe_dump(tree, sort_keys=True)


def trained_dae(folder: Path) -> tuple[Any, Any]:
    """Config group `dae` and network of a folder that `train` has written.

    Raises
    ------
    ProductError
        If a file is missing or damaged, or the two are not of the same training.
    """
    from psfdae.models.dae import load_dae

    settings = dae_settings(folder, read_yaml(folder / CONFIG))
    return settings, load_dae(settings, folder / WEIGHTS)


def dae_settings(folder: Path, trained: dict[str, Any]) -> Any:
    """Config group `dae` of a training's configuration; raises ProductError."""
    from psfdae.configuration.compose import validate
    from psfdae.configuration.schema import Dae

    return from_tree(folder / CONFIG, trained, "dae", make=lambda tree: validate(Dae, tree))
