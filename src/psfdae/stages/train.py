"""Stage `train`: a denoising autoencoder for one dataset, split and reference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from psfdae.stages.common import noise_model, read_stars, split_stars
from psfdae.stages.trained import WEIGHTS, fingerprint, keep, progress


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
    from psfdae.models.dae import TrainingSet, train_dae

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
    seen = fingerprint(described, data.images, data.references, data.fit)
    with progress(config.train.epochs) as report:
        done = train_dae(data, config.dae, config.train, config.seed, checkpoint, seen, report)
    keep(done, out, WEIGHTS, described, product, attempt=done.attempt)
    checkpoint.unlink(missing_ok=True)
