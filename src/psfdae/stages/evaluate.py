"""Stage `evaluate`: every method on every test star at each noise level."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.belonging import require_training
from psfdae.evaluation.metrics import all_metrics, clustered_mean
from psfdae.files import Product, atomic_path, write_text
from psfdae.models.lmmse import LinearMmse
from psfdae.reading import read_yaml
from psfdae.stages import baseline
from psfdae.stages.common import (
    limit_threads,
    noise_model,
    noisy_test_images,
    read_stars,
    split_stars,
)
from psfdae.stages.trained import CONFIG, trained_dae

Predictor = Callable[[np.ndarray, float], np.ndarray]


def run(
    config: Any,
    dataset: str,
    stars: Path,
    pca_som: Path,
    dae: Path,
    split: str,
    reference: str,
    out: Path,
    per_star: Path,
) -> None:
    """Measure noisy images, PCA+SOM, linear MMSE and DAE against the reference.

    The test noise of a star depends on seed and λ only, so all methods and both
    references see the same noisy images and their differences are paired.

    Parameters
    ----------
    config : stage config (seed, noise, parts, evaluation)
    dataset : name that goes into the table
    stars, pca_som : products
    dae : folder of a trained network
    split, reference : as in `train`
    out : CSV, columns dataset, split, reference, method, noise_level, metric,
        value, stderr (clustered by field), n
    per_star : Parquet with one row per method, λ and star

    Raises
    ------
    ProductError
        If a product is damaged, or models and stars do not belong together.
    """
    import pandas as pd

    limit_threads(config.evaluation.threads)
    product = read_stars(stars, reference)
    require_models(product, config, pca_som, dae, split, reference)
    parts = split_stars(product, split, config)
    truth = product[reference][parts.test]
    linear = LinearMmse.fit(
        product["realisation"][parts.train], product[reference][parts.train], noise_model(config)
    )
    methods: dict[str, Predictor] = {
        "noisy": lambda noisy, level: noisy,
        "pca_som": _ignoring_level(baseline.load(pca_som).predict),
        "lmmse": linear.predict,
        "dae": dae_predictor(dae, config),
    }
    field = product["field_index"][parts.test]
    key = {"dataset": dataset, "split": split, "reference": reference}
    summary, stars_table = [], []
    for level in config.noise.levels:
        noisy = noisy_test_images(config, product["realisation"][parts.test], level)
        for method, predict in methods.items():
            metrics = all_metrics(predict(noisy, level), truth, config.evaluation.data_range)
            row = {**key, "method": method, "noise_level": level}
            summary += _summarise(row, metrics, field)
            stars_table.append(pd.DataFrame({**row, "star": parts.test, "field": field, **metrics}))
    write_text(out, pd.DataFrame(summary).to_csv(index=False, float_format="%.8g"))
    with atomic_path(per_star) as temporary:
        pd.concat(stars_table, ignore_index=True).to_parquet(
            temporary, index=False, write_page_checksum=True
        )


def _summarise(
    row: dict[str, Any], metrics: dict[str, np.ndarray], field: np.ndarray
) -> list[dict[str, Any]]:
    rows = []
    for metric, values in metrics.items():
        mean, stderr = clustered_mean(values, field)
        rows.append({**row, "metric": metric, "value": mean, "stderr": stderr, "n": values.size})
    return rows


def _ignoring_level(predict: Callable[[np.ndarray], np.ndarray]) -> Predictor:
    return lambda noisy, level: predict(noisy)


def require_models(
    stars: Product, config: Any, pca_som: Path, dae: Path, split: str, reference: str
) -> None:
    """Refuse a baseline or a network that does not belong to test stars."""
    baseline.require_fitted(pca_som, stars, config, split)
    require_network(stars, config, dae, split, reference)


def require_network(stars: Product, config: Any, dae: Path, split: str, reference: str) -> None:
    """Refuse a network that does not belong to test stars.

    Parameters
    ----------
    stars : product "stars"
    config : stage config (seed, parts)
    dae : folder of a trained network
    split, reference : as in `train`
    """
    trained = read_yaml(dae / CONFIG)
    require_training(dae, trained, stars, config, split=split, reference=reference)


def dae_predictor(folder: Path, config: Any) -> Predictor:
    """The trained network of a folder as a function of noisy images and λ, which it ignores."""
    import torch

    from psfdae.models.dae import image_scale, predict

    torch.set_num_threads(config.evaluation.threads)
    settings, model = trained_dae(folder)
    batch = config.evaluation.batch

    def apply(noisy: np.ndarray, level: float) -> np.ndarray:
        return predict(model, noisy, image_scale(settings.scale, noisy.shape[-1]), batch)

    return apply
