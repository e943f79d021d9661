"""Stage `train`: a denoising autoencoder for one dataset, split and reference."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.belonging import write_origin
from psfdae.configuration.compose import decisive
from psfdae.files import write_text
from psfdae.stages.common import noise_model, read_stars, split_stars
from psfdae.stages.trained import CONFIG, HISTORY, WEIGHTS


def run(config: Any, stars: Path, split: str, reference: str, out: Path, checkpoint: Path) -> None:
    """Train and leave weights, resolved config and history in a folder.

    Parameters
    ----------
    config : stage config (seed, noise, parts, dae, train)
    stars : product "stars"
    split, reference : "random" or "held_out"; "realisation" or "template"
    out : folder that receives `dae.safetensors`, `config.yaml`, `history.csv`, and in
        `trained_on.yaml` what the stars say of themselves
    checkpoint : file that lets an interrupted training resume

    Raises TrainingError as `train_dae` does.
    """
    from tqdm import tqdm

    from psfdae.models.training import TrainingSet, train_dae
    from psfdae.models.weights import save_weights

    product = read_stars(stars, reference)
    parts = split_stars(product, split, config)
    data = TrainingSet(
        images=product["realisation"],
        references=product[reference],
        fit=parts.fit,
        validation=parts.validation,
        levels=np.asarray(config.noise.levels),
        noise=noise_model(config),
    )
    described = {**config.model_dump(), "split": split, "reference": reference}
    epochs = config.train.epochs
    steps = epochs * -(-parts.fit.size // config.train.batch)
    terminal = sys.stderr.isatty()
    with tqdm(total=steps, unit="step", disable=not terminal, desc="train") as bar:

        def report(row: dict[str, float]) -> None:
            line = (
                f"epoch {row['epoch']:.0f}/{epochs}  train MSE {row['train_mse']:.3e}  "
                f"validation MSE {row['validation_mse']:.3e}  {row['seconds']:.0f} s"
            )
            if terminal:
                bar.set_postfix_str(f"MSE {row['train_mse']:.2e}")
            else:
                print(line, flush=True)

        result = train_dae(
            data,
            config.dae,
            config.train,
            config.seed,
            checkpoint,
            _fingerprint(described, data),
            report,
            bar.update,
        )
    save_weights(out / WEIGHTS, result.state, described)
    write_origin(out, product)
    write_text(out / HISTORY, as_csv(result.history))
    write_text(out / CONFIG, as_yaml({**described, "attempt": result.attempt}))
    checkpoint.unlink(missing_ok=True)


def _fingerprint(described: dict[str, Any], data: Any) -> str:
    """Hash of the images that a training sees, and of what of its configuration counts."""
    digest = hashlib.sha256(json.dumps(decisive(described), sort_keys=True).encode())
    for array in (data.images, data.references, data.fit):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def as_csv(rows: list[dict[str, float]]) -> str:
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
