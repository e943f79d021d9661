"""Stage `figure headline`: the figure of the README."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from psfdae.files import ProductError
from psfdae.reading import read_table
from psfdae.stages.common import limit_threads, read_stars, split_stars
from psfdae.stages.evaluate import require_models
from psfdae.stages.figures import field_of, strip_rows, write_png

REFERENCE = "realisation"
STARS = 5
LABELS = {"noisy": "noisy star", "PCA+SOM": "PCA+SOM", "DAE": "DAE"}


def run(
    config: Any,
    dataset: str,
    stars_h5: Path,
    pca_som_h5: Path,
    dae_dir: Path,
    level: float,
    bounds_csv: Path,
    efficiency_csv: Path,
    out: Path,
) -> None:
    """Draw restored test stars beside the errors of all noise levels and their bounds.

    Parameters
    ----------
    config : stage config of `evaluate`
    dataset : rows of the tables
    stars_h5, pca_som_h5, dae_dir : as in `figures.strip`, reference realisation
    level : noise level λ of the stars
    bounds_csv, efficiency_csv : tables of the target bounds
    out : path of the PNG

    Raises
    ------
    ProductError
        If the tables have no such rows, or models and stars do not belong together.
    """
    from dataclasses import replace

    from psfdae.evaluation.figures import spread_stars
    from psfdae.evaluation.headline_figure import headline

    limit_threads(config.evaluation.threads)
    product = read_stars(stars_h5, REFERENCE)
    require_models(product, config, pca_som_h5, dae_dir, "random", REFERENCE)
    test = split_stars(product, "random", config).test
    picks = spread_stars(field_of(product)[product["field_index"][test]], STARS)
    args = (config, product, test, picks, REFERENCE, pca_som_h5, dae_dir, [level])
    truth, *restored = strip_rows(*args)
    rows = [replace(row, label=LABELS[row.label.split("\n")[0]]) for row in restored]
    rows.append(replace(truth, label="truth"))
    tables = [_rows_of(path, dataset) for path in (efficiency_csv, bounds_csv)]
    titles = (f"Test stars of {dataset}, λ = {level:g}", "Error against noise")
    write_png(headline(rows, tables[0], tables[1], titles), out)


def _rows_of(path: Path, dataset: str) -> pd.DataFrame:
    table = read_table(path)
    rows = table[(table.dataset == dataset) & (table.reference == REFERENCE)]
    if "metric" in rows:
        rows = rows[rows.metric == "mse"]
    if rows.empty:
        raise ProductError(f"{path}: no rows of {dataset}, {REFERENCE}")
    return rows
