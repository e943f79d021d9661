"""How good a model is on stars that no training saw: `validate`, and its `Report`."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.figures import StripRow, as_png, restoration_strip, spread_stars
from psfdae.files import write_text
from psfdae.image.tables import shown_with_digits
from psfdae.method import Method, facts_of
from psfdae.methods import method as method_of
from psfdae.metrics import all_metrics, clustered_mean, mse, quality, summarised
from psfdae.model.field_psfs import PredictionError
from psfdae.model.packing import COVERAGE, checksum
from psfdae.model.photometry import signal_to_noise
from psfdae.model.plot import FieldStars, psf_map
from psfdae.model.psf_model import PsfModel
from psfdae.model.report import (
    MEAN_PSF,
    SHOWN_STARS,
    Check,
    Quality,
    checks_html,
    checks_of_held_out,
    fitted_mean,
    quality_page,
    standing,
)
from psfdae.model.star_sets import (
    field_positions,
    noisy_test_images,
    own_noise,
    split_stars,
    star_area,
    training_set,
)
from psfdae.model.stars import REFERENCE, SPLIT, Stars
from psfdae.progress import steps
from psfdae.splits import Split
from psfdae.threads import fixed_threads

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

BESIDE = ("noisy", "lmmse")
"""Methods that every model is compared with, beside one mean PSF."""

STRIP_SNR = 10.0
"""The figure of restored stars has the S/N nearest to this."""

STRIP_STARS = 6


def validate(model: PsfModel, stars: Stars, others: Mapping[str, Method] | None = None) -> Report:
    """Errors of a model on the stars held out, degraded to the noise levels of their settings.

    Beside it stand the noisy images, one mean PSF whose centre is fitted, and linear MMSE.

    Parameters
    ----------
    model : PsfModel
        It was fitted to these stars, or to another image of the same camera.
    stars : Stars
    others : mapping of str to Method, optional
        Further fits to these stars for the table, by name.

    Raises
    ------
    Error
        If the model may have seen the stars that are held out, or their pixels differ.

    Examples
    --------
    >>> report = psfdae.validate(model, stars)
    >>> mse = {row["method"]: row["mse"] for row in report.table if round(row["snr"]) == 10}
    >>> bool(mse["field"] < mse["mean_psf"] < mse["noisy"])
    True
    """
    _require_unseen(model, stars)
    settings, own = stars.settings, model.info.method
    known = {**(others or {}), own: model.method}
    names = [n for n in settings.methods if n in known or n in BESIDE]
    names += [n for n in (own, *BESIDE) if n not in names]
    with fixed_threads(settings.evaluation.threads):
        methods = {name: known.get(name) or _fitted_here(name, stars) for name in names}
        return _measured(model, stars, methods)


def _require_unseen(model: PsfModel, stars: Stars) -> None:
    """Refuse a model of other stars of the same image, and one of another camera."""
    info, product, said = model.info, stars.product, stars.observation.path
    model.check_scale(stars.observation.pixel_scale_arcsec, str(said))
    if info.stamp_px != stars.settings.framing.stamp_px:
        raise PredictionError(
            f"{said}: stamps of {stars.settings.framing.stamp_px} px, but the model {info.name!r} "
            f"takes {info.stamp_px} px"
        )
    train = split_stars(product, SPLIT, stars.settings).train
    images = product["realisation"][train]
    known = (str(info.config["stars"].get(key)) for key in ("image_sha256", "trained_on"))
    if not {*", ".join(known).split(", ")} & {*product.config["image_sha256"].split(", ")}:
        return
    if info.training_sha256 != checksum(images, product[REFERENCE][train]):
        raise PredictionError(
            f"{said}: the model {info.name!r} was trained on other stars of this image, among "
            "which may be those held out here; fit a model to these stars"
        )


def _fitted_here(name: str, stars: Stars) -> Method:
    kind = method_of(name)
    data = training_set(stars.settings, kind, stars.product, SPLIT, REFERENCE)
    fitted: Method = kind.fit(data, **kind.settings(stars.settings))
    return fitted


def _measured(model: PsfModel, stars: Stars, methods: Mapping[str, Method]) -> Report:
    settings, product = stars.settings, stars.product
    parts = split_stars(product, SPLIT, settings)
    truth, field = product[REFERENCE][parts.test], product["field_index"][parts.test]
    position = field_positions(product)[parts.test]
    data_range = settings.evaluation.data_range
    key = {"dataset": stars.name, "split": SPLIT, "reference": REFERENCE}
    rows, per_star, restored, degraded = [], [], {}, {}
    for level in steps("stars held out", settings.noise.levels):
        noisy = degraded[level] = noisy_test_images(settings, product, parts.test, level)
        mean = fitted_mean(noisy, stars.mean_psf, settings.framing.jitter_px + 1.0)
        row = {**key, "method": MEAN_PSF, "noise_level": level}
        beside = summarised(row, all_metrics(mean, truth, data_range), field)
        for name, method in methods.items():
            own = name == model.info.method
            scale = settings.noise.kappa / model.info.kappa if own else 1.0
            estimate = method.estimate(noisy, scale * level, position)
            metrics = quality(estimate, truth, data_range)
            row = {**key, "method": name, "noise_level": level}
            rows += summarised(row, metrics, field)
            per_star.append({**row, "star": parts.test, "field": field, **metrics})
            if own:
                images = {"noisy": noisy, "truth": truth, "model": estimate.psf, MEAN_PSF: mean}
                restored[level] = images
        rows += beside
    measured = [row for row in rows if row["method"] != MEAN_PSF]
    table = _table(rows, stars, methods)
    found = _found(model, stars, degraded)
    return Report(
        model, stars, methods, table, _stacked(measured), _joined(per_star), found, restored
    )


def _found(model: PsfModel, stars: Stars, degraded: Mapping[float, np.ndarray]) -> Table:
    """Predict held-out stars of flux 1 at each λ from their places alone.

    The bright star that is the truth has noise of its own, which counts in every error.
    """
    settings, product = stars.settings, stars.product
    parts, background = split_stars(product, SPLIT, settings), settings.noise.background_photons
    test, area = parts.test, star_area(product, parts.train)
    star, truth = product["field_index"][test], product[REFERENCE][test]
    own = own_noise(product, product[REFERENCE], background)
    of_flux, of_pixels = (of_all[test] for of_all in own)
    given = {"position": field_positions(product)[test]}
    bright = model.predict(truth, flux=1.0, background=0.0, noise=product["noise"][star], **given)
    rows = []
    for level in sorted(degraded, reverse=True):  # S/N ascending
        noise = settings.noise.kappa * level
        found = model.predict(degraded[level], gain=np.sqrt(background) / noise, **given)
        usable = np.isfinite(found.psf).all(axis=(1, 2)) & (found.flux_error > 0)
        row = {"snr": signal_to_noise(noise, area), "lost": float(1.0 - usable.mean())}
        off = np.stack([getattr(found, c) - getattr(bright, c) for c in ("x_fit", "y_fit")])
        errors = ("x_error", "y_error")
        doubt = np.stack([np.hypot(getattr(found, c), getattr(bright, c)) for c in errors])
        pull = np.abs(found.flux - 1.0) / np.hypot(found.flux_error, of_flux)
        row["flux_bias"], row["flux_bias_stderr"] = _mean(found.flux - 1.0, star, usable)
        row["flux_pull"] = float(np.quantile(pull[usable], COVERAGE)) if usable.any() else np.nan
        row["centre_rms_px"] = _mean(np.square(off).sum(axis=0), star, usable)[0] ** 0.5
        inside = np.abs(found.psf - truth) < np.hypot(found.uncertainty, of_pixels)
        measured = np.isfinite(off).all(axis=0)
        held = {
            "flux": np.where(usable, pull < 1.0, np.nan),
            "centre": np.where(measured, (np.abs(off) < doubt).mean(axis=0), np.nan),
            "psf": inside.mean(axis=(1, 2)),
        }
        for name, part in held.items():
            row[f"{name}_within"], row[f"{name}_within_stderr"] = _mean(part, star, usable)
        rows.append(row)
    return _stacked(rows)


def _mean(values: np.ndarray, star: np.ndarray, usable: np.ndarray) -> tuple[float, float]:
    """Mean of some images (n,) and its standard error, clustered by star; NaN of none."""
    if not usable.any():
        return np.nan, np.nan
    return clustered_mean(values[usable], star[usable])


def _stacked(rows: Sequence[Mapping[str, object]]) -> Table:
    from astropy.table import Table

    return shown_with_digits(Table({name: [row[name] for row in rows] for name in rows[0]}))


def _joined(parts: Sequence[Mapping[str, Any]]) -> Table:
    """Rows of parts, NaN in columns that a part does not have."""
    from astropy.table import Table

    names = dict.fromkeys(name for part in parts for name in part)
    columns = {
        name: [np.broadcast_to(part.get(name, np.nan), part["star"].shape) for part in parts]
        for name in names
    }
    return Table({name: np.concatenate(values) for name, values in columns.items()})


def _table(rows: Sequence[Mapping[str, Any]], stars: Stars, methods: Mapping[str, Method]) -> Table:
    """MSE and SSIM by S/N and method."""
    settings, product = stars.settings, stars.product
    parts = split_stars(product, SPLIT, settings)
    area = star_area(product, parts.train)
    of = {(row["noise_level"], row["method"], row["metric"]): row for row in rows}
    shared = {
        "images": parts.test.size,
        "stars": int(stars.held_out.sum()),
        "truth_mse": _own_mse(stars, parts),
    }
    found = []
    for level in sorted(settings.noise.levels, reverse=True):  # S/N ascending
        noise = settings.noise.kappa * level
        for name in (*methods, MEAN_PSF):
            mse_of, ssim_of = (of[level, name, metric] for metric in ("mse", "ssim_peak"))
            found.append(
                {
                    "snr": signal_to_noise(noise, area),
                    "noise": noise,
                    "method": name,
                    "mse": mse_of["value"],
                    "mse_stderr": mse_of["stderr"],
                    "ssim": ssim_of["value"],
                    **shared,
                }
            )
    return _stacked(found)


def _own_mse(stars: Stars, parts: Split) -> float:
    """Mean variance of the pixels of the stars held out: their own noise, in every MSE."""
    product, sky = stars.product, stars.settings.noise.background_photons
    _, noise = own_noise(product, product[REFERENCE], sky)
    return float(np.square(noise[parts.test]).mean())


@dataclass(frozen=True, eq=False)
class Report:
    """Whether to trust a model: its errors on stars that no training saw.

    Attributes
    ----------
    model : PsfModel
    stars : Stars
    methods : dict of str to Method
        All that were measured, the model's own included.
    table : Table
        MSE with its standard error and SSIM by S/N and method.
    evaluation : Table
        Every metric of every method at every noise level.
    per_star : Table
        The same of every image.
    found : Table
        What `predict` makes of the held-out images where no flux, sky, noise and centre is given,
        by S/N: bias of the flux over the flux, its pull (what 68.27 % of |error| over `flux_error`
        are below: 1 if errors hold), RMS of the centre, and the parts of fluxes, centres and
        pixels that are within their stated errors, with standard errors clustered by star.
    restored : dict
        By noise level λ the held-out images (n, d, d): `noisy`, `truth`, `model`, and `mean_psf`.

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
    found: Table
    restored: dict[float, dict[str, np.ndarray]]

    def __str__(self) -> str:
        kind = type(self.model.method)
        return standing(self.table, kind.name, kind.look.label)

    def __repr__(self) -> str:
        return f"Report({self.model.name!r}, {self})"

    def _repr_html_(self) -> str:
        """A sentence on the model, and its checks on held-out stars, for a notebook."""
        return f"<p>{escape(str(self))}</p>{checks_html(self.checks())}"

    def checks(self) -> list[Check]:
        """Checks of the model on the stars held out: question, answer, and whether it is passed."""
        errors = self.table, self.found, self._coverage, self._faint
        return checks_of_held_out(self.model.info.method, *errors)

    @property
    def _faint(self) -> dict[float, dict[str, np.ndarray]]:
        """The restored images by S/N."""
        info = self.model.info
        return {
            signal_to_noise(info.kappa * level, info.noise_equivalent_px): images
            for level, images in self.restored.items()
        }

    @property
    def _coverage(self) -> dict[float, float]:
        """Part of the errors within ± the stated 68 %, by S/N."""
        rows = self.model.info.metrics
        return {row["snr"]: row["coverage68"] for row in rows if "coverage68" in row}

    def save(self, path: str | Path) -> None:
        """Write the page, one HTML file that needs no other."""
        write_text(path, self.page())

    def strip(self) -> Figure:
        """Held-out stars degraded to S/N 10, and what the methods make of them."""
        settings, product = self.stars.settings, self.stars.product
        parts = split_stars(product, SPLIT, settings)
        area = star_area(product, parts.train)
        levels = np.asarray(settings.noise.levels)
        snr = 1.0 / (settings.noise.kappa * levels * np.sqrt(area))
        level = float(levels[np.abs(np.log(snr / STRIP_SNR)).argmin()])
        star, place = product["field_index"][parts.test], field_positions(product)[parts.test]
        shown = _one_of_each(star, product["position"])
        noisy, truth = (self.restored[level][kind][shown] for kind in ("noisy", "truth"))
        rows = [StripRow("bright\nstar", truth)]
        for method in self.methods.values():
            look = method.look
            if look.drawn:
                stamps = method.restore(noisy, level, place[shown])
                error = mse(stamps, truth)
                rows.append(StripRow(look.label, stamps, error, own_scale=not look.restores))
        columns = [f"S/N {value:.0f}" for value in product["snr"][star[shown]]]
        found = signal_to_noise(settings.noise.kappa * level, area)
        title = f"Bright stars that no training saw, degraded to S/N {found:.3g}"
        return restoration_strip(rows, columns, title)

    @cached_property
    def strip_png(self) -> bytes:
        """The picture of `strip` as a file holds it."""
        return as_png(self.strip())

    def page(self) -> str:
        """The HTML of the page; the PSFs of all stars of the image are predicted for it."""
        model, stars = self.model, self.stars
        info, selection = model.info, stars.candidates.columns(stars.held_out)
        held = np.flatnonzero(selection["part"] == "held out")
        where = stars.candidates.position[held]
        shown = held[spread_stars(where, SHOWN_STARS)] if np.isfinite(where).all() else held
        found, psf, residual = _all_stars(model, stars, shown[:SHOWN_STARS])
        columns = {name: selection[name] for name in ("verdict", "part")}
        shown = shown[:SHOWN_STARS]
        kind = type(model.method)
        product = stars.product
        test = split_stars(product, SPLIT, stars.settings).test
        row = product["row"][product["field_index"][test]]
        return quality_page(
            Quality(
                name=info.name,
                image=stars.observation.path.name,
                method=kind.name,
                label=kind.look.label,
                notes=stars.notes,
                errors=self.table,
                found=self.found,
                coverage=self._coverage,
                faint=self._faint,
                degraded={name: found[name][row] for name in ("x", "y", "flux")},
                stars=found | columns,
                residual=residual / found["noise"][shown, None, None],
                bright=psf[shown] + residual,
                strip=self.strip_png,
                field=None if stars.observation.positions is None else _map(found, psf, stars),
                facts=facts_of(model.method),
            )
        )


def _one_of_each(star: np.ndarray, position: np.ndarray) -> np.ndarray:
    """An image each of stars that lie evenly over the field."""
    stars, first = np.unique(star, return_index=True)
    if not np.isfinite(position[stars]).all():
        return first[:STRIP_STARS]
    return np.asarray(first[spread_stars(position[stars], STRIP_STARS)])


def _all_stars(
    model: PsfModel, stars: Stars, kept: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Columns and PSFs of all stars of an image, and the residuals of those that are kept."""
    columns: dict[str, list[np.ndarray]] = {}
    psf, residual, done = [], [], 0
    margin = model.margin_px
    of_images = (
        model.stream(part.observation.with_margin(margin), threads=1) for part in stars.each
    )
    for _, found in itertools.chain.from_iterable(of_images):
        for name, values in found.columns().items():
            columns.setdefault(name, []).append(values)
        psf.append(found.psf)
        inside = kept[(kept >= done) & (kept < done + len(found))] - done
        residual.append((inside + done, found.residual[inside]))
        done += len(found)
    order = np.argsort(np.argsort(kept))
    rows = np.concatenate([images for _, images in residual])[order]
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    joined["flags"] = joined["flags"].astype(int)
    return joined, np.concatenate(psf), rows


def _map(found: Mapping[str, np.ndarray], psf: np.ndarray, stars: Stars) -> Figure:
    field = FieldStars(**{name: found[name] for name in FieldStars.__dataclass_fields__})
    drawn, count = len(field.drawable()), len(field.x)
    title = f"{stars.observation.path.name}: {drawn} of {count} stars"
    return psf_map(psf[field.chosen()], field, title)
