"""`Report`: errors of a model on held-out stars, and the page that shows them."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from string import Template

import numpy as np

from psfdae.base.arguments import check_arguments
from psfdae.base.figures import StripRow, as_png, restoration_strip, spread_stars
from psfdae.base.files import write_text
from psfdae.base.types import Figure, Table
from psfdae.denoise.flux_model import signal_to_noise
from psfdae.denoise.star_model import StarModel
from psfdae.image.selection import Verdict
from psfdae.image.stamps import StarFlag
from psfdae.image.tables import html_table
from psfdae.methods.interface import Method
from psfdae.methods.metrics import mse
from psfdae.report.checks import (
    Check,
    check_held_out,
    check_stars,
    comparison_sentence,
    nearest_snr,
)
from psfdae.report.figures import (
    chi2_figure,
    error_maps,
    errors_figure,
    residual_strip,
    shapes_figure,
)
from psfdae.report.page import checks_html, errors_table, image_tag, photometry_table
from psfdae.report.plot import psf_map
from psfdae.training.star_sets import field_positions, star_area
from psfdae.training.stars import ImageStars


@dataclass(frozen=True, eq=False)
class Report:
    """Errors of a model on stars that no training saw, which show whether to trust it.

    Attributes
    ----------
    model : StarModel
    stars : ImageStars
    methods : dict of str to Method
        All that were measured, the model's own included.
    table : Table
        MSE with its standard error and SSIM by S/N and method, for stars of flux 1; `truth_mse` is
        the noise of the bright images in the MSE.
    evaluation : Table
        Every metric of every method at every noise level: `metric`, its mean `value`, `stderr` and
        number of images `n`.
    per_star : Table
        Every metric of every image; `star` numbers the images, `field` their stars.
    photometry : Table
        Photometry of the held-out images by S/N, as by `predict` without given flux, sky, noise and
        centre. Fraction of the stars without a usable flux (`lost`), relative bias of the flux, its
        pull (68.27 % percentile of |error| over the standard error: 1 if errors hold), RMS error of
        the centre in px, and coverage of fluxes, centres and pixels: the fractions that are within
        their predicted errors, with standard errors clustered by star.
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

    model: StarModel
    stars: ImageStars
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
            They compare errors with the simplest models, and check sizes of stars and predicted
            errors.
        """
        # Coverage was measured when the model was made; another image has other S/N.
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
        tested_stars, first = np.unique(star, return_index=True)
        shown = first[_evenly_spread(product["position"][tested_stars], 6)]
        images = self.restored[levels[snr]]
        noisy, truth = images["noisy"][shown], images["truth"][shown]
        # A row of the bright stars, then one for each method that figures show.
        rows = [StripRow("bright\nstar", truth)]
        for name, method in self.methods.items():
            look = method.look
            if look.is_drawn:
                scale = level_scale(self.model, self.stars, name)
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
        Maximum number of stars, at least 1.
    """
    if not np.isfinite(position).all():
        return np.arange(min(count, len(position)))
    return spread_stars(position, count)


def _predict_all(
    model: StarModel, stars: ImageStars, shown: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Predict all N stars of the images batch by batch, and keep the residuals of few.

    Parameters
    ----------
    model : StarModel
        Model that predicts the stars.
    stars : ImageStars
        Bright stars of one or several images.
    shown : ndarray of int, shape (k,)
        Numbers of the stars whose residuals are kept, ascending.

    Returns
    -------
    columns : dict of str to ndarray, shape (N,)
        Columns of the predictions, by name.
    psf : ndarray, shape (N, d, d)
        Denoised stars, in the unit of the image.
    residuals : ndarray, shape (k, d, d)
        Residuals of the shown stars, in their order.
    """
    # Lists of the batches: columns, PSFs, and residuals of the stars shown.
    columns: dict[str, list[np.ndarray]] = {}
    psfs, residuals, count = [], [], 0
    streams = (
        model.stream(image.observation.replace_margin(model.margin_px), threads=1)
        for image in stars.images
    )
    for _, prediction in itertools.chain.from_iterable(streams):
        for name, values in prediction.columns.items():
            columns.setdefault(name, []).append(values)
        psfs.append(prediction.psf)
        in_batch = (shown >= count) & (shown < count + len(prediction))
        residuals.append(prediction.residual[shown[in_batch] - count])
        count += len(prediction)
    table = {name: np.concatenate(values) for name, values in columns.items()}
    table["flags"] = table["flags"].astype(int)
    return table, np.concatenate(psfs), np.concatenate(residuals)


def level_scale(model: StarModel, stars: ImageStars, method_name: str) -> float:
    """Return the factor from noise levels λ of stars to noise levels of a method.

    It is 1 for all methods but the model's: the model may be of another image, whose noise level λ
    has another κ.
    """
    is_model = method_name == model.info.method
    return stars.settings.noise.kappa / model.info.kappa if is_model else 1.0


def quality_page(
    report: Report,
    stars: Mapping[str, np.ndarray],
    degraded_rows: np.ndarray,
    field_map: Figure | None,
    residuals: Figure | None,
) -> str:
    """Return the report page as HTML.

    Parameters
    ----------
    report : Report
        Errors of the model on held-out stars.
    stars : mapping of str to ndarray, shape (n,)
        Columns of the prediction of all stars, and `verdict` and `part` of `selection.csv`.
    degraded_rows : ndarray of int
        Star of each held-out image in `report.restored`.
    field_map : Figure, optional
        Map of the PSF, if the stars have positions.
    residuals : Figure, optional
        Residuals of bright held-out stars (`residual_strip`), if there are any.
    """
    # The method of the model, and held-out stars as it restores them.
    name, images = type(report.model.method).name, report.restored_by_snr
    # Checks of all stars come before the number of stars held out.
    *checks, held_out_check = report.checks()
    # Sentences on the fit, and on the image and its list.
    facts = report.model.method.facts().values()
    notes = [line for note in report.stars.notes for line in note.splitlines()]
    # A star has one verdict, and may have several flags.
    verdicts, flags = stars["verdict"], stars["flags"]
    verdict_counts = [(v, int((verdicts == v).sum())) for v in Verdict]
    flag_counts = [(f.name or "", int(((flags & int(f)) > 0).sum())) for f in StarFlag]
    unflagged_row = ("none", str(int((flags == 0).sum())))
    template = Path(__file__).with_name("report.html").read_text(encoding="utf-8")
    return Template(template).substitute(
        title=escape(report.model.info.name),
        image=escape(report.stars.observation.path.name),
        summary=escape(str(report)),
        checks=checks_html([*checks, *check_stars(stars), held_out_check]),
        errors=errors_table(report.table, name),
        truth_mse=f"{report.table['truth_mse'][0]:.1e}",
        errors_figure=image_tag(errors_figure(report.table, name)),
        strip=image_tag(report.strip_png),
        photometry=photometry_table(report.photometry),
        facts="".join(f"<p>{escape(fact)}.</p>\n" for fact in facts),
        field_map=image_tag(field_map) if field_map else "<p>The stars have no positions.</p>",
        error_maps=image_tag(error_maps(images)),
        residuals=image_tag(residuals) if residuals else "",
        shapes=image_tag(shapes_figure(stars, degraded_rows, images)),
        chi2=image_tag(chi2_figure(stars)),
        verdicts=html_table(
            ("selection for the training", "stars"),
            [(escape(verdict), str(count)) for verdict, count in verdict_counts if count],
        ),
        flags=html_table(
            ("flag", "stars"),
            [*((f, str(count)) for f, count in flag_counts if count), unflagged_row],
        ),
        notes="".join(f"<li>{escape(line)}</li>\n" for line in notes),
    )
