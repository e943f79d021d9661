"""Stages `figure ...`: from data products and tables to one PNG each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.files import Product, ProductError, atomic_path, read_product
from psfdae.reading import read_table
from psfdae.stages import baseline
from psfdae.stages.common import limit_threads, noisy_test_images, read_stars, split_stars
from psfdae.stages.evaluate import dae_predictor, require_models
from psfdae.stages.tables import read_evaluations

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from psfdae.evaluation.figures import StripRow

DPI = 150
STRIP_STARS = 8
"""Columns of a restoration strip."""


def templates(templates_h5: Path, out: Path) -> None:
    """Draw the templates of a scene at their field positions.

    Parameters
    ----------
    templates_h5 : product "templates"
    out : path of the PNG
    """
    from psfdae.evaluation.figures import template_map

    product = read_product(templates_h5, "templates", ("psf", "grid", "field"))
    margin = product.config["framing"]["jitter_px"]
    side = product["psf"].shape[-1] - margin
    psf = product["psf"][:, margin:side, margin:side]
    title = (
        f"Static PSFs of scene {product.config['scene']['name']}: {len(psf)} field points, "
        f"stamps of {psf.shape[-1]} × {psf.shape[-1]} px"
    )
    write_png(template_map(psf, product["grid"], product["field"], title), out)


def energy(templates_h5: Path, out: Path) -> None:
    """Draw how much light the stamps of a scene hold.

    Parameters
    ----------
    templates_h5 : product "templates"
    out : path of the PNG
    """
    from psfdae.evaluation.figures import stamp_energy_map

    product = read_product(templates_h5, "templates", ("energy", "grid", "field"))
    stamp_px = product.config["framing"]["stamp_px"]
    write_png(stamp_energy_map(product["energy"], product["grid"], product["field"], stamp_px), out)


def strip(
    config: Any,
    dataset: str,
    stars_h5: Path,
    pca_som_h5: Path,
    dae_dir: Path,
    reference: str,
    levels: Sequence[float],
    out: Path,
) -> None:
    """Draw test stars of the split `random` before and after restoration.

    The stars carry the very noise that the stage `evaluate` measures.

    Parameters
    ----------
    config : stage config (seed, noise, parts, evaluation) of `evaluate`
    dataset : name for the title
    stars_h5, pca_som_h5 : products, the latter of the split `random`
    dae_dir : folder of the network trained on that split and `reference`
    reference : "realisation" or "template"
    levels : noise levels λ, one group of rows each
    out : path of the PNG

    Raises
    ------
    ProductError
        If models and stars do not belong together.
    """
    from psfdae.evaluation.figure_style import REFERENCES, in_field_unit
    from psfdae.evaluation.figures import restoration_strip, spread_stars

    limit_threads(config.evaluation.threads)
    product = read_stars(stars_h5, reference)
    require_models(product, config, pca_som_h5, dae_dir, "random", reference)
    test = split_stars(product, "random", config).test
    field = field_of(product)[product["field_index"][test]]
    picks = spread_stars(field, STRIP_STARS)
    rows = strip_rows(config, product, test, picks, reference, pca_som_h5, dae_dir, levels)
    angle, unit = in_field_unit(field)
    columns = [f"({x:+.1f}, {y:+.1f})".replace("-", "−") for x, y in angle[picks]]
    title = (
        f"{dataset}: test stars at field angle (x, y) in {unit},\n"
        f"restored and measured {REFERENCES[reference]}"
    )
    write_png(restoration_strip(rows, columns, title), out)


def curves(history_csvs: Sequence[Path], labels: Sequence[str], out: Path) -> None:
    """Draw the training histories of the networks of a dataset.

    Parameters
    ----------
    history_csvs : `history.csv` of each network
    labels : name of each network
    out : path of the PNG

    Raises
    ------
    ProductError
        If the numbers of files and labels differ, or a file lacks a column.
    """

    from psfdae.evaluation.curves import training_curves

    if len(history_csvs) != len(labels):
        raise ProductError(f"{len(history_csvs)} histories, but {len(labels)} labels")
    histories = {}
    for path, label in zip(history_csvs, labels, strict=True):
        histories[label] = read_table(path)
        missing = {"step", "train_mse", "validation_mse"} - set(histories[label].columns)
        if missing:
            raise ProductError(f"{path}: no column {min(missing)!r}")
    write_png(training_curves(histories, "Training of the denoising autoencoders"), out)


def errors(metrics_csvs: Sequence[Path], dataset: str, metric: str, out: Path) -> None:
    """Draw a metric of all methods against the noise level, with the paper's points.

    Parameters
    ----------
    metrics_csvs : CSV files of the stages `evaluate` or `collect`
    dataset, metric : what to draw
    out : path of the PNG

    Raises
    ------
    ProductError
        If the files have no such rows.
    """
    from psfdae.evaluation.curves import error_against_noise
    from psfdae.evaluation.paper import published

    metrics = read_evaluations(metrics_csvs)
    if not ((metrics.dataset == dataset) & (metrics.metric == metric)).any():
        names = ", ".join(str(path) for path in metrics_csvs)
        raise ProductError(f"{names}: no rows of {dataset}, {metric}")
    write_png(error_against_noise(metrics, published("psf"), dataset, metric), out)


def write_png(figure: Figure, out: Path) -> None:
    """Write a figure atomically; the same figure gives the same bytes."""
    with atomic_path(out) as temporary:
        # The temporary name ends in .tmp; the default metadata names matplotlib's version.
        figure.savefig(temporary, format="png", dpi=DPI, metadata={"Software": None})


def field_of(stars: Product) -> np.ndarray:
    """Field angle (x, y) of every field point in radians, shape (F, 2)."""
    from psfdae.stars.fields import square_grid

    grid = stars.config["grid"]
    return np.deg2rad(square_grid(grid["points"], grid["spacing_deg"])[1])


def strip_rows(
    config: Any,
    product: Product,
    test: np.ndarray,
    picks: np.ndarray,
    reference: str,
    pca_som: Path,
    dae: Path,
    levels: Sequence[float],
) -> list[StripRow]:
    """Rows of a restoration strip: the reference, then groups by noise level.

    Parameters
    ----------
    config : stage config of `evaluate`
    product : product "stars"
    test, picks : test stars, and those of them that are shown
    reference, pca_som, dae, levels : as in `strip`
    """
    from psfdae.evaluation.figures import StripRow
    from psfdae.evaluation.metrics import mse

    truth = product[reference][test][picks]
    rows = [StripRow("reference", truth)]
    if reference == "template":
        noise_free = product["realisation"][test][picks]
        rows.append(StripRow("star without\nnoise", noise_free, mse(noise_free, truth)))
    restore_pca, restore_dae = baseline.load(pca_som).predict, dae_predictor(dae, config)
    for level in levels:
        # All test stars, as the stage `evaluate` draws them, then the picked ones.
        noisy = noisy_test_images(config, product["realisation"][test], level)[picks]
        for label, images, own in (
            (f"noisy\nλ = {level:g}", noisy, True),
            (f"PCA+SOM\nλ = {level:g}", restore_pca(noisy), False),
            (f"DAE\nλ = {level:g}", restore_dae(noisy, level), False),
        ):
            rows.append(StripRow(label, images, mse(images, truth), own))
    return rows
