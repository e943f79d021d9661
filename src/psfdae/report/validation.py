"""Test of a model on stars that no training saw: `validate`, and its `Report`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from psfdae.base.arguments import check_arguments
from psfdae.base.errors import warn
from psfdae.base.progress import steps
from psfdae.base.threads import fix_threads
from psfdae.base.types import Table
from psfdae.denoise.flux_model import signal_to_noise
from psfdae.denoise.star_model import StarModel
from psfdae.image.tables import rows_to_table, set_format
from psfdae.methods import method as method_of
from psfdae.methods.interface import Method
from psfdae.methods.metrics import all_metrics, quality, summarise_metrics
from psfdae.psf.interface import PredictionError
from psfdae.report.checks import (
    MEAN_PSF,
    fit_mean_psf,
)
from psfdae.report.held_out_photometry import measure_photometry
from psfdae.report.report import Report, level_scale
from psfdae.training.packing import checksum
from psfdae.training.star_sets import field_positions, noisy_test_images, own_noise, star_area
from psfdae.training.stars import ImageStars


@check_arguments
def validate(
    model: StarModel, stars: ImageStars, further_fits: Mapping[str, Method] | None = None
) -> Report:
    """Measure a model on the stars held out, degraded to the noise levels of their settings.

    It is compared with the noisy images, one mean PSF whose centre is fitted, and the linear
    estimator of minimum mean square error (linear MMSE).

    Parameters
    ----------
    model : StarModel
        It was fitted to these stars, or to another image of the same camera.
    stars : ImageStars
        Bright stars of an image, some of them held out.
    further_fits : mapping of str to Method, optional
        Fits of other methods to these stars, by name, for the table.

    Returns
    -------
    Report
        Errors by method and S/N, photometry, checks and figures.

    Raises
    ------
    Error
        If the model may have seen the held-out stars, or their pixels or stamps differ from its
        own.

    Examples
    --------
    >>> report = psfdae.validate(model, stars)
    >>> mse = {row["method"]: row["mse"] for row in report.table if round(row["snr"]) == 10}
    >>> bool(mse["field"] < mse["mean_psf"] < mse["noisy"])
    True
    """
    _require_unseen(model, stars)
    model, notes = model.to_image_frame(stars.observation)
    warn(notes)
    settings = stars.settings
    # The fits that exist already, with the model's own.
    fits = {**(further_fits or {}), model.info.method: model.method}
    # Every table has the noisy images and linear MMSE; both are quick to fit.
    baselines = ("noisy", "lmmse")
    names = [name for name in settings.methods if name in fits or name in baselines]
    methods: dict[str, Method] = {}
    with fix_threads(settings.evaluation.threads):
        for name in dict.fromkeys([*names, model.info.method, *baselines]):
            if name not in fits:
                method_class = method_of(name)
                data = stars.training_set(method_class)
                fits[name] = method_class.fit(data, **method_class.settings(settings))
            methods[name] = fits[name]
        return _measure(model, stars, methods)


def _require_unseen(model: StarModel, stars: ImageStars) -> None:
    """Refuse a model that may have been trained on the stars held out, and one of another camera.

    Raises
    ------
    PredictionError
        If pixels or stamps differ from the model's, or if it was trained on other stars of
        the same image.
    """
    info, product, path = model.info, stars.product, stars.observation.path
    # Pixels and stamps must have the size of the model's.
    model.check_scale(stars.observation.pixel_scale_arcsec, stars.observation.name_with_scale)
    if info.stamp_px != stars.settings.framing.stamp_px:
        raise PredictionError(
            f"{path}: stamps of {stars.settings.framing.stamp_px} px, but the model {info.name!r} "
            f"takes {info.stamp_px} px"
        )
    # A model of another image was trained on none of these stars. Hashes of several images are
    # one text, joined by commas.
    hashes = (str(info.config["stars"].get(key)) for key in ("image_sha256", "trained_on"))
    if not {*", ".join(hashes).split(", ")} & {*product.config["image_sha256"].split(", ")}:
        return
    # A model was trained on these stars if the checksum of the training images is the same.
    train = stars.split.train
    if info.training_sha256 != checksum(
        product["realisation"][train], product[stars.reference][train]
    ):
        raise PredictionError(
            f"{path}: the model {info.name!r} was trained on other stars of this image, among "
            "which may be those held out here; fit a model to these stars"
        )


def _measure(model: StarModel, stars: ImageStars, methods: Mapping[str, Method]) -> Report:
    """Measure fitted methods, and photometry of the model, on held-out stars at every λ.

    Parameters
    ----------
    model : StarModel
        Model to be tested.
    stars : ImageStars
        Bright stars of an image, some of them held out.
    methods : mapping of str to Method
        Fits by name, with the model's own.
    """
    settings, product, test = stars.settings, stars.product, stars.split.test
    # Held-out images with their truth, star and place.
    truth, star = product[stars.reference][test], product["field_index"][test]
    position, data_range = field_positions(product)[test], settings.evaluation.data_range
    key = {"dataset": stars.name, "split": stars.split_kind, "reference": stars.reference}
    rows, mean_rows, per_star, denoised_images = [], [], [], {}
    for level in steps("stars held out", settings.noise.levels):
        # The images of the packing, if a model was packed from these stars, and its estimate.
        packed_method, noisy, packed_estimate = stars.estimates.get(level, (None, None, None))
        if noisy is None:
            noisy = noisy_test_images(settings, product, test, level)
        # The centre is fitted up to a pixel beyond the jitter: noise moves the brightest pixel.
        by_mean_psf = fit_mean_psf(noisy, stars.mean_psf, settings.framing.jitter_px + 1.0)
        row = {**key, "method": MEAN_PSF, "noise_level": level}
        mean_rows += summarise_metrics(row, all_metrics(by_mean_psf, truth, data_range), star)
        for name, method in methods.items():
            if packed_estimate is not None and method is packed_method:
                estimate = packed_estimate
            else:
                scale = level_scale(model, stars, name)
                estimate = method.estimate(noisy, scale * level, position)
            # Metrics of every image; their means and standard errors are clustered by star.
            metrics = quality(estimate, truth, data_range)
            row = {**key, "method": name, "noise_level": level}
            rows += summarise_metrics(row, metrics, star)
            per_star.append({**row, "star": test, "field": star, **metrics})
            if name == model.info.method:
                images = {"noisy": noisy, "truth": truth, "model": estimate.psf}
                denoised_images[level] = images | {MEAN_PSF: by_mean_psf}
    return Report(
        model,
        stars,
        methods,
        _error_table([*rows, *mean_rows], stars, methods),
        rows_to_table(rows),
        join_tables(per_star),
        measure_photometry(model, stars, denoised_images),
        denoised_images,
    )


def join_tables(blocks: Sequence[Mapping[str, Any]]) -> Table:
    """Return one table of blocks of columns, NaN in the columns that a block does not have.

    A block has the array `star` (n,); its other values are arrays as long, or constants.

    Returns
    -------
    Table
        Columns stand in the order in which they first appear.
    """
    from astropy.table import Table

    # Methods differ in their metrics.
    names = dict.fromkeys(name for block in blocks for name in block)
    columns = {
        name: [np.broadcast_to(block.get(name, np.nan), block["star"].shape) for block in blocks]
        for name in names
    }
    return set_format(Table({name: np.concatenate(values) for name, values in columns.items()}))


def _error_table(
    statistics: Sequence[Mapping[str, Any]], stars: ImageStars, methods: Mapping[str, Method]
) -> Table:
    """Return MSE and SSIM by S/N and method, the table `Report.table`.

    Parameters
    ----------
    statistics : sequence of mappings
        Mean and standard error of each metric, by noise level and method.
    stars : ImageStars
        Stars that were measured, with their noise levels.
    methods : mapping of str to Method
        Methods in the order of the rows; one mean PSF comes last.
    """
    settings, product, split = stars.settings, stars.product, stars.split
    # S/N = 1 / (κ λ √A) with the noise-equivalent area A of a typical star.
    area = star_area(product, split.train)
    # Mean and standard error of each metric, by noise level and method.
    cells = {(row["noise_level"], row["method"], row["metric"]): row for row in statistics}
    # Noise of the bright images: the variance of their pixels is a part of every MSE.
    sky_photons = settings.noise.background_photons
    _, truth_sigma = own_noise(product, product[stars.reference], sky_photons)
    rows = []
    for level in sorted(settings.noise.levels, reverse=True):  # S/N ascending
        noise = settings.noise.kappa * level
        for name in (*methods, MEAN_PSF):
            # SSIM with the range of each bright image.
            mse_cell = cells[level, name, "mse"]
            rows.append(
                {
                    "snr": signal_to_noise(noise, area),
                    "noise": noise,
                    "method": name,
                    "mse": mse_cell["value"],
                    "mse_stderr": mse_cell["stderr"],
                    "ssim": cells[level, name, "ssim_peak"]["value"],
                    "images": split.test.size,
                    "stars": int(stars.held_out.sum()),
                    "truth_mse": float(np.square(truth_sigma[split.test]).mean()),
                }
            )
    return rows_to_table(rows)
