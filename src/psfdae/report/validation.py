"""Test of a model on stars that no training saw: `validate`, and its `Report`."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.base.arguments import check_arguments
from psfdae.base.errors import warn
from psfdae.base.figures import StripRow, as_png, restoration_strip, spread_stars
from psfdae.base.files import write_text
from psfdae.base.progress import steps
from psfdae.base.threads import fixed_threads
from psfdae.denoise.flux_model import signal_to_noise
from psfdae.denoise.star_model import PsfModel
from psfdae.image.tables import table_of_rows, with_format
from psfdae.methods import method as method_of
from psfdae.methods.interface import Method
from psfdae.methods.metrics import all_metrics, mse, quality, summarised
from psfdae.psf.interface import PredictionError
from psfdae.report.checks import (
    MEAN_PSF,
    Check,
    check_held_out,
    comparison_sentence,
    fit_mean_psf,
    nearest_snr,
)
from psfdae.report.figures import residual_strip
from psfdae.report.held_out_photometry import measure_photometry
from psfdae.report.page import checks_html, image_tag, quality_page
from psfdae.report.plot import psf_map
from psfdae.training.packing import checksum
from psfdae.training.star_sets import field_positions, noisy_test_images, own_noise, star_area
from psfdae.training.stars import Stars

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure


@check_arguments
def validate(
    model: PsfModel, stars: Stars, further_fits: Mapping[str, Method] | None = None
) -> Report:
    """Measure a model on the stars held out, degraded to the noise levels of their settings.

    It is compared with the noisy images, one mean PSF whose centre is fitted, and the linear
    estimator of minimum mean square error (linear MMSE).

    Parameters
    ----------
    model : PsfModel
        It was fitted to these stars, or to another image of the same camera.
    stars : Stars
    further_fits : mapping of str to Method, optional
        Fits of other methods to these stars, by name, for the table.

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
    # The fits that exist already, that of the model included.
    fits = {**(further_fits or {}), model.info.method: model.method}
    # Every table has the noisy images and linear MMSE; both are quick to fit.
    baselines = ("noisy", "lmmse")
    names = [name for name in settings.methods if name in fits or name in baselines]
    methods: dict[str, Method] = {}
    with fixed_threads(settings.evaluation.threads):
        for name in dict.fromkeys([*names, model.info.method, *baselines]):
            if name not in fits:
                method_class = method_of(name)
                data = stars.training_set(method_class)
                fits[name] = method_class.fit(data, **method_class.settings(settings))
            methods[name] = fits[name]
        return _measure(model, stars, methods)


def _require_unseen(model: PsfModel, stars: Stars) -> None:
    """Refuse a model that may have learnt from the stars held out, and one of another camera.

    Raises
    ------
    PredictionError
        If pixels or stamps differ from those of the model, or if it was trained on other stars of
        the same image.
    """
    info, product, path = model.info, stars.product, stars.observation.path
    # Pixels and stamps must have the size of those of the model.
    model.check_scale(stars.observation.pixel_scale_arcsec, str(path))
    if info.stamp_px != stars.settings.framing.stamp_px:
        raise PredictionError(
            f"{path}: stamps of {stars.settings.framing.stamp_px} px, but the model {info.name!r} "
            f"takes {info.stamp_px} px"
        )
    # A model of another image has learnt from none of these stars. Hashes of several images are
    # one text, joined by commas.
    hashes = (str(info.config["stars"].get(key)) for key in ("image_sha256", "trained_on"))
    if not {*", ".join(hashes).split(", ")} & {*product.config["image_sha256"].split(", ")}:
        return
    # The training images of a model are those of these stars if their checksum is the same.
    train = stars.split.train
    if info.training_sha256 != checksum(
        product["realisation"][train], product[stars.reference][train]
    ):
        raise PredictionError(
            f"{path}: the model {info.name!r} was trained on other stars of this image, among "
            "which may be those held out here; fit a model to these stars"
        )


def _measure(model: PsfModel, stars: Stars, methods: Mapping[str, Method]) -> Report:
    """Measure fitted methods, and photometry of the model, on held-out stars at every λ.

    Parameters
    ----------
    model : PsfModel
    stars : Stars
    methods : mapping of str to Method
        Fits by name, that of the model included.
    """
    settings, product, test = stars.settings, stars.product, stars.split.test
    # Held-out images with their truth, star and place.
    truth, star = product[stars.reference][test], product["field_index"][test]
    position, data_range = field_positions(product)[test], settings.evaluation.data_range
    key = {"dataset": stars.name, "split": stars.split_kind, "reference": stars.reference}
    rows, mean_rows, per_star, restored = [], [], [], {}
    for level in steps("stars held out", settings.noise.levels):
        noisy = noisy_test_images(settings, product, test, level)
        # The centre is fitted up to a pixel beyond the jitter: noise moves the brightest pixel.
        by_mean_psf = fit_mean_psf(noisy, stars.mean_psf, settings.framing.jitter_px + 1.0)
        row = {**key, "method": MEAN_PSF, "noise_level": level}
        mean_rows += summarised(row, all_metrics(by_mean_psf, truth, data_range), star)
        for name, method in methods.items():
            scale = _level_scale(model, stars, name)
            estimate = method.estimate(noisy, scale * level, position)
            # Metrics of every image; their means and standard errors are clustered by star.
            metrics = quality(estimate, truth, data_range)
            row = {**key, "method": name, "noise_level": level}
            rows += summarised(row, metrics, star)
            per_star.append({**row, "star": test, "field": star, **metrics})
            if name == model.info.method:
                images = {"noisy": noisy, "truth": truth, "model": estimate.psf}
                restored[level] = images | {MEAN_PSF: by_mean_psf}
    return Report(
        model,
        stars,
        methods,
        _error_table([*rows, *mean_rows], stars, methods),
        table_of_rows(rows),
        _joined(per_star),
        measure_photometry(model, stars, restored),
        restored,
    )


def _level_scale(model: PsfModel, stars: Stars, method_name: str) -> float:
    """Return the factor from noise levels λ of stars to those of a method.

    It is 1 for all methods but the model's: the model may be of another image, whose noise level λ
    has another κ.
    """
    is_model = method_name == model.info.method
    return stars.settings.noise.kappa / model.info.kappa if is_model else 1.0


def _joined(blocks: Sequence[Mapping[str, Any]]) -> Table:
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
    return with_format(Table({name: np.concatenate(values) for name, values in columns.items()}))


def _error_table(
    statistics: Sequence[Mapping[str, Any]], stars: Stars, methods: Mapping[str, Method]
) -> Table:
    """Return MSE and SSIM by S/N and method, the table `Report.table`.

    Parameters
    ----------
    statistics : sequence of mappings
        Mean and standard error of each metric, by noise level and method.
    stars : Stars
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
    return table_of_rows(rows)


@dataclass(frozen=True, eq=False)
class Report:
    """Errors of a model on stars that no training saw, which tell whether to trust it.

    Attributes
    ----------
    model : PsfModel
    stars : Stars
    methods : dict of str to Method
        All that were measured, the model's own included.
    table : Table
        MSE with its standard error and SSIM by S/N and method, for stars of flux 1; `truth_mse` is
        the noise of the bright images in the MSE.
    evaluation : Table
        Every metric of every method at every noise level: `metric`, its mean `value`, `stderr` and
        number of images `n`.
    per_star : Table
        Every metric of every image; `star` is the number of the image, `field` that of its star.
    photometry : Table
        Photometry by S/N: what `predict` makes of the held-out images where no flux, sky, noise
        and centre is given. Part of the stars without a usable flux (`lost`), relative bias of the
        flux, its pull (what 68.27 % of |error| over the standard error are below: 1 if errors
        hold), RMS error of the centre in px, and coverage of fluxes, centres and pixels: the parts
        that are within their stated errors, with standard errors clustered by star.
    restored : dict
        By noise level λ the held-out images (n, d, d): degraded (`noisy`), bright (`truth`), and
        restored by the model (`model`) and by one mean PSF (`mean_psf`).

    Examples
    --------
    >>> report = psfdae.validate(model, stars)
    >>> report.table.colnames
    ['snr', 'noise', 'method', 'mse', 'mse_stderr', 'ssim', 'images', 'stars', 'truth_mse']
    >>> report.strip().savefig("stars.png")
    """

    model: PsfModel
    stars: Stars
    methods: Mapping[str, Method]
    table: Table
    evaluation: Table
    per_star: Table
    photometry: Table
    restored: dict[float, dict[str, np.ndarray]]

    def __str__(self) -> str:
        method_class = type(self.model.method)
        return comparison_sentence(self.table, method_class.name, method_class.look.title)

    def __repr__(self) -> str:
        return f"Report({self.model.name!r}, {self})"

    def _repr_html_(self) -> str:
        """Return summary, checks on held-out stars, and the picture of some, for a notebook."""
        summary, checks = f"<p>{escape(str(self))}</p>", checks_html(self.checks())
        return summary + checks + image_tag(as_png(self.strip(), dpi=80))

    def checks(self) -> list[Check]:
        """Check the model on the stars held out: question, answer, and True if it is passed.

        Returns
        -------
        list of Check
            They are of errors against the simplest models, of sizes of stars, and of stated
            errors.
        """
        # Coverage was measured when the model was made: that of another image has other S/N.
        rows = self.model.info.metrics
        coverage = {row["snr"]: row["coverage68"] for row in rows if "coverage68" in row}
        method = self.model.info.method
        return check_held_out(method, self.table, self.photometry, coverage, self.restored_by_snr)

    @property
    def found(self) -> Table:
        """Former name of `photometry`, for one version more."""
        warnings.warn("Report.found is now Report.photometry", DeprecationWarning, stacklevel=2)
        return self.photometry

    @property
    def restored_by_snr(self) -> dict[float, dict[str, np.ndarray]]:
        """Restored images by S/N, as in `table`."""
        return {snr: self.restored[level] for snr, level in self._levels().items()}

    def _levels(self) -> dict[float, float]:
        """Return the noise levels λ by their S/N, for stars of the typical size."""
        kappa = self.stars.settings.noise.kappa
        area = star_area(self.stars.product, self.stars.split.train)
        return {signal_to_noise(kappa * level, area): level for level in self.restored}

    @check_arguments
    def save(self, path: str | Path) -> None:
        """Write the page, one HTML file that needs no other.

        Parameters
        ----------
        path : path-like
            File that is written, or replaced.
        """
        write_text(path, self.page())

    def strip(self) -> Figure:
        """Draw held-out stars degraded to the S/N nearest to 10, as each method restores them.

        Returns
        -------
        Figure
            Six stars, evenly over the field: the bright star, then a row for each method that
            figures show.
        """
        product, test = self.stars.product, self.stars.split.test
        # The noise level whose S/N is the nearest to 10.
        levels = self._levels()
        snr = nearest_snr(levels)
        # Six stars that lie evenly over the field, one image of each.
        star, place = product["field_index"][test], field_positions(product)[test]
        tested, first = np.unique(star, return_index=True)
        shown = first[_evenly_spread(product["position"][tested], 6)]
        images = self.restored[levels[snr]]
        noisy, truth = images["noisy"][shown], images["truth"][shown]
        # A row of the bright stars, then one for each method that figures show.
        rows = [StripRow("bright\nstar", truth)]
        for name, method in self.methods.items():
            look = method.look
            if look.drawn:
                scale = _level_scale(self.model, self.stars, name)
                stamps = method.estimate(noisy, scale * levels[snr], place[shown], False).psf
                error = mse(stamps, truth)
                rows.append(StripRow(look.title, stamps, error, own_scale=not look.restores))
        columns = [f"S/N {value:.0f}" for value in product["snr"][star[shown]]]
        title = f"Bright stars that no training saw, degraded to S/N {snr:.3g}"
        return restoration_strip(rows, columns, title)

    @cached_property
    def strip_png(self) -> bytes:
        """Figure of `strip` as the bytes of a PNG file."""
        return as_png(self.strip())

    def page(self) -> str:
        """Return the HTML of the page; the PSFs of all stars of the image are predicted for it."""
        model, stars, product = self.model, self.stars, self.stars.product
        selection = stars.candidates.columns(stars.held_out)
        # Eight held-out stars, evenly over the field, show their residuals.
        held_out = np.flatnonzero(selection["part"] == "held out")
        shown = np.sort(held_out[_evenly_spread(stars.candidates.position[held_out], 8)])
        columns, psf, residuals = _predict_all(model, stars, shown)
        # Stamps without sky are the PSF plus its residual; σ is the noise of the sky.
        residual_figure = None
        if len(shown):
            sigma = columns["noise"][shown, None, None]
            residual_figure = residual_strip(psf[shown] + residuals, residuals / sigma)
        # The map has the PSFs of bright stars whose stamps do not overlap.
        field_map = None
        if stars.observation.positions is not None:
            field_map = psf_map(columns, psf.__getitem__, stars.observation.path.name)
        columns |= {name: selection[name] for name in ("verdict", "part")}
        # Row of the prediction for each held-out image; a star has several images.
        degraded_rows = product["row"][product["field_index"][stars.split.test]]
        return quality_page(self, columns, degraded_rows, field_map, residual_figure)


def _evenly_spread(position: np.ndarray, count: int) -> np.ndarray:
    """Return indices of at most `count` stars, evenly over the field if positions (n, 2) are known.

    Where one is NaN, they are the first stars.

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        (x, y) of the stars.
    count : int
    """
    if not np.isfinite(position).all():
        return np.arange(min(count, len(position)))
    return spread_stars(position, count)


def _predict_all(
    model: PsfModel, stars: Stars, shown: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Predict all N stars of the images batch by batch, and keep the residuals of few.

    Parameters
    ----------
    model : PsfModel
    stars : Stars
    shown : ndarray of int, shape (k,)
        Numbers of the stars whose residuals are kept.

    Returns
    -------
    columns : dict of str to ndarray, shape (N,)
    psf : ndarray, shape (N, d, d)
    residuals : ndarray, shape (k, d, d)
    """
    # Lists of the batches: columns, PSFs, and residuals of the stars shown.
    columns: dict[str, list[np.ndarray]] = {}
    psfs, residuals, count = [], [], 0
    streams = (
        model.stream(image.observation.with_margin(model.margin_px), threads=1)
        for image in stars.images
    )
    for _, prediction in itertools.chain.from_iterable(streams):
        for name, values in prediction.columns.items():
            columns.setdefault(name, []).append(values)
        psfs.append(prediction.psf)
        in_batch = (shown >= count) & (shown < count + len(prediction))
        residuals.append(prediction.residual[shown[in_batch] - count])
        count += len(prediction)
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    joined["flags"] = joined["flags"].astype(int)
    # Residuals came in the order of the stars: back to that of `shown`.
    return joined, np.concatenate(psfs), np.concatenate(residuals)[np.argsort(np.argsort(shown))]
