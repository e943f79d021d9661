"""Figures of the report page of a model: errors, residuals, sizes and shapes, χ²."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from psfdae.base.figures import SERIES_COLORS, apply_style, new_figure
from psfdae.base.types import Figure, Table
from psfdae.report.checks import MEAN_PSF, method_labels, nearest_snr, size_errors
from psfdae.report.plot import has_shape


@apply_style
def errors_figure(errors: Table, model_method: str) -> Figure:
    """Draw MSE against S/N for each method, with the noise of the bright images as a floor.

    Parameters
    ----------
    errors : Table
        `Report.table`, with the columns snr, method, mse, mse_stderr and truth_mse.
    model_method : str
        Name of the method with the thick line.
    """
    figure = new_figure(3.4, layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="S/N", ylabel="MSE")
    for index, (name, label) in enumerate(method_labels(errors).items()):
        # A line for each method; the thick one is the model.
        rows = errors[errors["method"] == name]
        rows.sort("snr")
        color, width = SERIES_COLORS[index % len(SERIES_COLORS)], 2.2 if name == model_method else 1
        axes.errorbar(
            rows["snr"], rows["mse"], rows["mse_stderr"], label=label, marker="o", ms=3,
            color=color, lw=width,
        )  # fmt: skip
    # No method can be seen to be better than the noise of the bright images allows.
    axes.axhline(errors["truth_mse"][0], color="grey", ls=":", label="noise of bright images")
    axes.grid(True, which="both")
    figure.legend(loc="outside right upper")
    return figure


@apply_style
def error_maps(denoised_images: Mapping[float, Mapping[str, np.ndarray]]) -> Figure:
    """Draw mean and RMS, over held-out stars, of restored minus bright image.

    Stars of the S/N nearest to 10 are shown.

    Parameters
    ----------
    denoised_images : mapping of float to mapping of str to ndarray, shape (n, d, d)
        Held-out stars by S/N: bright (`truth`), and as the model (`model`) and one mean PSF
        (`MEAN_PSF`) restore them from degraded images.
    """
    # S/N nearest to 10: models differ most for faint stars.
    snr = nearest_snr(denoised_images)
    images = denoised_images[snr]
    # In per cent of the mean peak; each mean has its own colours, symmetric about 0.
    peak = images["truth"].max(axis=(1, 2)).mean()
    figure = new_figure(2.4, layout="constrained")
    grid: Any = figure.subplots(1, 4, subplot_kw={"xticks": [], "yticks": []})
    for panels, name, label in ((grid[:2], "model", "model"), (grid[2:], MEAN_PSF, "mean PSF")):
        error = 100 * (images[name] - images["truth"]) / peak
        # Mean error of each pixel over the stars, and its RMS.
        mean, rms = error.mean(axis=0), np.sqrt(np.square(error).mean(axis=0))
        limit = max(np.abs(mean).max(), 1e-9)
        for axes, image, statistic, look in (
            (panels[0], mean, "mean", {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}),
            (panels[1], rms, "RMS", {"cmap": "magma", "vmin": 0}),
        ):
            artist = axes.imshow(image, origin="lower", interpolation="nearest", **look)
            axes.set_title(f"{label}, {statistic}", fontsize=8)
            figure.colorbar(artist, ax=axes, location="bottom", shrink=0.9)
    figure.suptitle(f"error at S/N {snr:.3g}, % of the mean peak")
    return figure


@apply_style
def residual_strip(stamps: np.ndarray, residuals: np.ndarray) -> Figure:
    """Draw bright held-out stars, and below them their residuals within ± 5 σ of the sky.

    Parameters
    ----------
    stamps : ndarray, shape (k, d, d)
        Stamps of the stars over their flux, without sky.
    residuals : ndarray, shape (k, d, d)
        Stamp minus PSF, in σ of the sky.
    """
    figure = new_figure(2.6, layout="constrained")
    grid: Any = figure.subplots(2, len(residuals), squeeze=False)
    for (above, below), stamp, residual in zip(grid.T, stamps, residuals, strict=True):
        # A square root shows core and outskirts in one picture.
        above.imshow(np.sqrt(np.clip(stamp / np.nanmax(stamp), 0, 1)), origin="lower", cmap="magma")
        artist = below.imshow(residual, origin="lower", cmap="RdBu_r", vmin=-5, vmax=5)
    # Pixels of stamps need no ticks.
    for axes in grid.ravel():
        axes.set(xticks=[], yticks=[])
    figure.colorbar(artist, ax=grid, label="residual (σ)", shrink=0.8)
    return figure


@apply_style
def shapes_figure(
    stars: Mapping[str, np.ndarray],
    degraded_rows: np.ndarray,
    denoised_images: Mapping[float, Mapping[str, np.ndarray]],
) -> Figure:
    """Draw FWHM and ellipticity against magnitude, x and y.

    Upper panels: all usable stars, with held-out stars in colour. Lower panels: errors of the
    held-out stars after they were degraded to the S/N nearest to 10.

    Parameters
    ----------
    stars : mapping of str to ndarray, shape (N,)
        Columns flux, x, y, fwhm_px, ellipticity, flags and part of all stars.
    degraded_rows : ndarray of int, shape (n,)
        Row in `stars` of each held-out image.
    denoised_images : mapping of float to mapping of str to ndarray, shape (n, d, d)
        Held-out images by S/N, as of `error_maps`.
    """
    snr = nearest_snr(denoised_images)
    # Shapes of flagged stars mean nothing.
    usable = has_shape(stars["flags"]) & np.isfinite(stars["fwhm_px"])
    held_out = usable & (stars["part"] == "held out")
    # Errors of degraded stars: restored against bright image.
    size_error, ellipticity_error = size_errors(denoised_images[snr])
    figure = new_figure(7.6, layout="constrained")
    grid: Any = figure.subplots(4, 3, sharey="row", sharex="col")
    rows = (
        ("FWHM (px)", "fwhm_px", 100 * size_error, f"FWHM at S/N {snr:.3g} (%)"),
        ("ellipticity", "ellipticity", ellipticity_error, f"ellipticity at S/N {snr:.3g}"),
    )
    # Columns of panels: instrumental magnitude, then position.
    magnitude = -2.5 * np.log10(np.where(stars["flux"] > 0, stars["flux"], np.nan))
    coordinates = {"−2.5 log₁₀ flux": magnitude, "x (px)": stars["x"], "y (px)": stars["y"]}
    for column, (axis_label, place) in enumerate(coordinates.items()):
        for row, (label, name, error, error_label) in enumerate(rows):
            # All usable stars above, errors of the held-out ones below.
            above, below = grid[2 * row : 2 * row + 2, column]
            above.plot(place[usable], stars[name][usable], ".", ms=2, color="#888888",
                       label="usable")  # fmt: skip
            above.plot(place[held_out], stars[name][held_out], ".", color=SERIES_COLORS[5],
                       label="held out")  # fmt: skip
            below.axhline(0.0, color="black", lw=0.8)
            below.plot(place[degraded_rows], error, ".", ms=2, color=SERIES_COLORS[5])
            if column == 0:
                above.set_ylabel(label)
                below.set_ylabel(f"error of\n{error_label}")
        grid[-1, column].set_xlabel(axis_label)
    grid[0, 0].legend()
    return figure


@apply_style
def chi2_figure(stars: Mapping[str, np.ndarray]) -> Figure:
    """Draw χ² per pixel of all stars against S/N: flagged, used for training, and neither.

    `stars` has the columns flags, part, chi2 and snr, shape (n,) each. χ² is 1 where the model and
    the noise are right.

    Parameters
    ----------
    stars : mapping of str to ndarray, shape (n,)
        Columns of the stars, by name.
    """
    is_flagged, is_trained_on = stars["flags"] != 0, stars["part"] == "training"
    # Both axes are logarithmic.
    positive = (stars["chi2"] > 0) & (stars["snr"] > 0)
    figure = new_figure(2.8, layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="S/N", ylabel="χ² per pixel")
    for is_shown, color, label in (
        (positive & is_flagged, "#aaaaaa", "flagged"),
        (positive & ~is_flagged & is_trained_on, SERIES_COLORS[5], "no flag, training"),
        (positive & ~is_flagged & ~is_trained_on, SERIES_COLORS[0], "no flag, other"),
    ):
        axes.plot(
            stars["snr"][is_shown], stars["chi2"][is_shown], ".", ms=3, color=color, label=label
        )
    axes.axhline(1.0, color="black", lw=0.8)
    axes.grid(True)
    axes.legend()
    return figure
