"""Report page of a model: errors on held-out stars, comparison with one mean PSF, and checks.

`quality_page` makes one HTML file that needs no other. It begins with a summary and a table of
checks; then follow errors, photometry, the field, residuals, sizes and shapes, χ², and the stars
that were not used.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.figures import SERIES_COLORS, as_png, new_figure, styled
from psfdae.image.selection import Verdict
from psfdae.image.stamps import StarFlag, cut
from psfdae.image.tables import html_table
from psfdae.methods import method as method_of
from psfdae.model.plot import UNUSABLE_FLAGS
from psfdae.moments import measure_shapes, shift_stamps

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

    from psfdae.model.validation import Report

MEAN_PSF = "mean_psf"
"""Name, in tables, of the comparison with one mean PSF whose centre is fitted to each star."""

MEAN_LABEL = "one mean PSF, its centre fitted"
"""Words for `MEAN_PSF` in sentences and legends."""

COVERAGE_RANGE = (0.60, 0.76)
"""Fractions of errors within their stated 68 % half-width that pass a check."""


# Comparison with one mean PSF.


def fit_mean_psf(noisy: np.ndarray, mean: np.ndarray, reach_px: float) -> np.ndarray:
    """Shift one PSF to the centre that fits each star best, the least that a model has to beat.

    Parameters
    ----------
    noisy : ndarray, shape (n, d, d)
        Stars of flux 1 without sky, brightest pixel near (d/2, d/2).
    mean : ndarray, shape (s, s)
        Mean PSF, centre at index (s//2, s//2), s ≥ d.
    reach_px : float
        Largest offset of the centre from the middle along each axis, in pixels.

    Returns
    -------
    ndarray, shape (n, d, d)
        The shifted PSF of each star, sum 1.
    """

    def mean_at(offsets: np.ndarray) -> np.ndarray:
        """Return the mean PSF (k, d, d) of sum 1, shifted by offsets (k, 2) in pixels."""
        psf = cut(shift_stamps(mean[None], offsets, np.zeros(len(offsets), int)), side)
        return np.asarray(psf / psf.sum(axis=(1, 2), keepdims=True))

    count, side = noisy.shape[:2]
    # Steps of a quarter of a pixel: between them, the likelihood is close to a parabola.
    step_px = 0.25
    axis = np.arange(-reach_px, reach_px + step_px / 2, step_px)
    lattice = mean_at(np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2))
    lattice = lattice.reshape(axis.size**2, -1)
    # Log likelihood in white noise, −|x − t|² / 2, without the term that does not depend on t.
    likelihood = noisy.reshape(count, -1) @ lattice.T - 0.5 * np.square(lattice).sum(axis=1)
    likelihood = likelihood.reshape(count, axis.size, axis.size)
    maximum = np.stack(np.divmod(likelihood.reshape(count, -1).argmax(axis=1), axis.size), axis=1)
    # The parabola needs a point on either side of the maximum.
    middle = np.clip(maximum, 1, axis.size - 2)
    star, (row, column) = np.arange(count), middle.T
    offsets = axis[middle]
    # Vertex of the parabola through three points along each axis, at most one step away.
    for k, (row_step, column_step) in enumerate(((1, 0), (0, 1))):
        lower, centre, upper = (
            likelihood[star, row + s * row_step, column + s * column_step] for s in (-1, 0, 1)
        )
        curvature = np.minimum(lower - 2 * centre + upper, -1e-30)
        offsets[:, k] += step_px * np.clip(0.5 * (lower - upper) / curvature, -1, 1)
    return mean_at(offsets)


def mse_ratios(errors: Table, method: str, reference: str) -> dict[float, float]:
    """Return the MSE of a method over that of a reference method by S/N, ascending.

    `errors` has the columns snr, method and mse. S/N at which a method was not measured are absent.
    """
    mse = {(row["method"], row["snr"]): row["mse"] for row in errors}
    return {
        float(snr): float(mse[method, snr] / mse[reference, snr])
        for snr in sorted(snr for name, snr in mse if name == method)
        if (reference, snr) in mse
    }


def nearest_snr(values: Iterable[float]) -> float:
    """Return the S/N that is nearest to 10 by its ratio, at which figures show errors."""
    return min(values, key=lambda value: abs(np.log(value / 10.0)))


def comparison_sentence(errors: Table, method: str, label: str) -> str:
    """Return a sentence that compares a method with one mean PSF and with linear MMSE.

    Parameters
    ----------
    errors : Table
        Columns of `report.csv`.
    method, label : str
        Name of the method in the table, and in the sentence.
    """
    # The S/N nearest to 10 stands for faint stars, for which models differ most.
    mean, linear = (mse_ratios(errors, method, name) for name in (MEAN_PSF, "lmmse"))
    snr = nearest_snr(mean)
    sentence = f"{label}: at S/N {snr:.3g} the MSE is {mean[snr]:.2f} times that of {MEAN_LABEL}"
    if linear and method != "lmmse":
        sentence += f", {linear[snr]:.2f} times that of linear MMSE"
    levels = ", ".join(f"{level:.3g}" for level, ratio in mean.items() if ratio >= 1)
    verdict = f"no better than the mean PSF at S/N {levels}" if levels else "better at each"
    return f"{sentence}; {verdict} ({errors['stars'][0]} stars held out)"


def size_errors(images: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Compare sizes and shapes of restored stars with those of their bright images.

    Parameters
    ----------
    images : mapping of str to ndarray, shape (n, d, d)
        Held-out stars: restored from degraded images (`model`), and bright (`truth`).

    Returns
    -------
    size_error : ndarray, shape (n,)
        FWHM over that of the bright image, minus 1.
    ellipticity_error : ndarray, shape (n,)
        Ellipticity minus that of the bright image.
    """
    restored, truth = (measure_shapes(images[name]) for name in ("model", "truth"))
    return restored.fwhm_px / truth.fwhm_px - 1.0, restored.ellipticity - truth.ellipticity


# Checks.


Check = tuple[str, str, bool]
"""Question, answer, and True if the check is passed."""


def check_held_out(
    method: str,
    errors: Table,
    photometry: Table,
    coverage: Mapping[float, float],
    degraded: Mapping[float, Mapping[str, np.ndarray]],
) -> list[Check]:
    """Check a model on held-out stars alone.

    Parameters
    ----------
    method : str
        Name of the model's method.
    errors, photometry : Table
        Columns of `report.csv`, and of `found.csv`.
    coverage : mapping of float to float
        Fraction of the errors of pixels within their stated 68 % half-width, by S/N.
    degraded : mapping of float to mapping of str to ndarray, shape (n, d, d)
        Held-out stars by S/N: bright (`truth`), and restored from degraded images by the model
        (`model`) and by one mean PSF (`MEAN_PSF`).
    """
    # Each row: question, answer at each S/N, and the verdict. What was not measured has no row.
    rows: list[Check] = []
    # MSE beside the two simplest models of the PSF.
    for label, reference in (("one mean PSF", MEAN_PSF), ("linear MMSE", "lmmse")):
        ratios = mse_ratios(errors, method, reference)
        by_snr = ", ".join(f"{ratio:.2f} at S/N {snr:.3g}" for snr, ratio in ratios.items())
        if ratios:
            rows.append((f"Better than {label}?", f"MSE × {by_snr}", max(ratios.values()) < 1))
    # Bias of the size: at most 2 % of the FWHM beyond two standard errors. The standard error of a
    # median is 1.25 σ/√n, of as many images as there are different stars.
    snr, held_out = nearest_snr(degraded), int(errors["stars"][0])
    size_error = size_errors(degraded[snr])[0]
    bias = float(np.median(size_error))
    stderr = 1.25 * float(size_error.std()) / np.sqrt(min(held_out, errors["images"][0]))
    answer = f"median {100 * bias:+.1f} ± {100 * stderr:.1f} %"
    rows.append((f"Size of stars of S/N {snr:.3g}", answer, abs(bias) < 0.02 + 2 * stderr))
    # Coverage of the stated errors, of pixels and then of flux and centre.
    low, high = COVERAGE_RANGE
    if coverage:
        by_snr = ", ".join(f"{100 * v:.0f} % at S/N {s:.3g}" for s, v in sorted(coverage.items()))
        is_covered = all(low < fraction < high for fraction in coverage.values())
        rows.append(("Are 68 % of pixel errors within ± UNCERT?", by_snr, is_covered))
    for name in ("flux", "centre"):
        cells = [(r["snr"], r[f"{name}_within"], r[f"{name}_within_stderr"]) for r in photometry]
        cells = [cell for cell in cells if np.isfinite(cell[1])]
        by_snr = ", ".join(f"{100 * v:.0f} ± {100 * e:.0f} % at S/N {s:.3g}" for s, v, e in cells)
        is_covered = all(low < v + 2 * e and v - 2 * e < high for _, v, e in cells)
        if cells:
            rows.append(
                (
                    f"Are 68 % of {name} errors within ± σ?",
                    by_snr,
                    is_covered,
                )
            )
    # With fewer than 20 stars, all of the above is rough.
    return [*rows, ("Stars held out", f"{held_out}", held_out >= 20)]


def check_stars(stars: Mapping[str, np.ndarray]) -> list[Check]:
    """Check a model on all stars of its image.

    `stars` has columns of the prediction and `part` of `selection.csv`, shape (n,) each.
    """
    checks: list[Check] = []
    # χ² of stars that the model has not learnt from, by classes of S/N with at least five stars.
    is_usable = (stars["flags"] == 0) & (stars["part"] != "training") & np.isfinite(stars["chi2"])
    snr_class = np.searchsorted((10.0, 100.0, 1000.0), stars["snr"])
    medians, answers = [], []
    for index, label in enumerate(("below 10", "from 10", "from 100", "from 1000")):
        chi2 = stars["chi2"][is_usable & (snr_class == index)]
        if chi2.size >= 5:
            medians.append(float(np.median(chi2)))
            answers.append(f"median {medians[-1]:.2f} at S/N {label} ({chi2.size} stars)")
    if medians:
        question = "χ² of unflagged stars outside the training"
        is_passed = all(0.8 < median < 1.3 for median in medians)
        checks.append((question, ", ".join(answers), is_passed))
    # Outliers: the model is not meant for an image where more than a tenth of the stars are.
    outliers = float(((stars["flags"] & int(StarFlag.UNLIKE_TRAINING)) > 0).mean())
    answer = f"{100 * outliers:.0f} % of the list"
    return [*checks, ("Stars unlike the training", answer, outliers < 0.1)]


def checks_html(rows: Sequence[Check]) -> str:
    """Return an HTML table of checks, each passed or to be inspected."""
    words = {True: "<b class=pass>pass</b>", False: "<b class=inspect>inspect</b>"}
    cells = [(escape(a), escape(b), words[bool(is_passed)]) for a, b, is_passed in rows]
    return html_table(("check", "result", ""), cells)


# The page.


def quality_page(
    report: Report,
    stars: dict[str, np.ndarray],
    degraded_rows: np.ndarray,
    field_map: Figure | None,
    residuals: Figure | None,
) -> str:
    """Return the report page as HTML.

    Parameters
    ----------
    report : Report
    stars : dict of str to ndarray, shape (n,)
        Columns of the prediction of all stars, and `verdict` and `part` of `selection.csv`.
    degraded_rows : ndarray of int
        Star of each held-out image in `report.restored`.
    field_map : Figure, optional
        Map of the PSF, if the stars have positions.
    residuals : Figure, optional
        Residuals of bright held-out stars (`residual_strip`), if there are any.
    """
    method, images = type(report.model.method), report.restored_by_snr
    name, image = report.model.info.name, report.stars.observation.path.name
    # Checks of all stars come before the number of stars held out.
    *checks, held_out_check = report.checks()
    summary_checks = [*checks, *check_stars(stars), held_out_check]
    notes = (line for note in report.stars.notes for line in note.splitlines())
    parts = [
        f"<h1>{escape(name)}</h1><p class=lead>{escape(str(report))}.</p>",
        checks_html(summary_checks),
        "<h2>Errors on held-out stars, degraded to low S/N</h2>",
        _errors_table(report.table, method.name),
        _image_tag(errors_figure(report.table, method.name)),
        _image_tag(report.strip_png),
        "<h2>Flux, centre and their errors</h2>",
        _photometry_table(report.found),
        "<h2>The PSF over the field</h2>",
        *(f"<p>{escape(fact)}.</p>" for fact in report.model.method.facts().values()),
        _image_tag(field_map) if field_map else "<p>The stars have no positions.</p>",
        "<h2>Residuals of held-out stars</h2>",
        "<p>Above: mean and RMS of restored minus bright image, over all held-out stars. Below: "
        "bright held-out stars, and their residuals after the PSF is subtracted, in σ of the "
        "sky.</p>",
        _image_tag(error_maps(images)),
        _image_tag(residuals) if residuals else "",
        "<h2>Size and shape against magnitude and place</h2>",
        _image_tag(shapes_figure(stars, degraded_rows, images)),
        "<h2>χ²</h2>",
        _image_tag(chi2_figure(stars)),
        "<h2>Stars left out</h2>",
        _verdict_tables(stars),
        "<h2>Camera, star list and advice</h2><ul>",
        *(f"<li>{escape(line)}</li>" for line in notes),
        "</ul>",
    ]
    return PAGE.format(title=escape(name), image=escape(image), body="\n".join(parts))


PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 15px/1.45 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em }}
table {{ border-collapse: collapse; margin: 1em 0 }}
td, th {{ padding: .25em .8em; border-bottom: 1px solid #ddd; text-align: left }}
.lead {{ font-size: 1.15em }} .pass {{ color: #007a5a }} .inspect {{ color: #b04000 }}
img {{ max-width: 100%; display: block; margin: 1em 0 }}
</style></head><body>
<p>PSF model of {image}</p>
{body}
</body></html>
"""
"""Frame of the page; its fields are title, image and body."""


def _image_tag(picture: Figure | bytes) -> str:
    """Return an HTML image with a figure, or the bytes of a PNG file, inside."""
    content = picture if isinstance(picture, bytes) else as_png(picture, dpi=110)
    return f'<img src="data:image/png;base64,{base64.b64encode(content).decode()}">'


def _errors_table(errors: Table, model_method: str) -> str:
    """Return the HTML table of MSE with standard errors: rows are methods, columns S/N.

    Parameters
    ----------
    errors : Table
        Columns of `report.csv`.
    model_method : str
        Name of the method that is marked as the model.
    """
    levels = np.unique(errors["snr"])
    # A method that was not measured at a S/N has an empty cell.
    cells = {(r["method"], r["snr"]): f"{r['mse']:.2e} ± {r['mse_stderr']:.0e}" for r in errors}
    rows = [
        [escape(f"{label} (the model)" if name == model_method else label)]
        + [cells.get((name, snr), "") for snr in levels]
        for name, label in _method_labels(errors).items()
    ]
    return html_table(["MSE", *(f"S/N {snr:.3g}" for snr in levels)], rows) + (
        "<p>Stars have flux 1. "
        f"Noise of the bright images is {errors['truth_mse'][0]:.1e} of every MSE.</p>"
    )


def _photometry_table(photometry: Table) -> str:
    """Return the HTML table of photometry of held-out stars, given nothing but their stamps.

    `photometry` has the columns of `found.csv`.
    """
    rows = [
        [
            f"{row['snr']:.3g}",
            f"{100 * row['flux_bias']:+.1f} ± {100 * row['flux_bias_stderr']:.1f} %",
            f"{row['flux_pull']:.2f}",
            f"{row['centre_rms_px']:.3f}" if np.isfinite(row["centre_rms_px"]) else "",
        ]
        for row in photometry
    ]
    head = ("S/N", "flux, mean error", "pull of the flux", "centre, RMS error (px)")
    return (
        "<p>Held-out stars degraded to low S/N; the model is given neither flux, sky, noise nor "
        "centre. The pull is the 68 % quantile of the absolute error, over the stated error; it is "
        "1 if stated errors are right.</p>" + html_table(head, rows)
    )


def _verdict_tables(stars: Mapping[str, np.ndarray]) -> str:
    """Return HTML tables: counts of stars by verdict of their selection, and by flag of the model.

    `stars` has the columns `verdict` and `flags`; a star may have several flags.
    """
    verdicts, flags = stars["verdict"], stars["flags"]
    rows = [(escape(v), str(n)) for v in Verdict if (n := int((verdicts == v).sum()))]
    counts = [(f.name or "", str(n)) for f in StarFlag if (n := int(((flags & int(f)) > 0).sum()))]
    return (
        html_table(("selection for the training", "stars"), rows)
        + "<p>Flags of the model on all stars of the list:</p>"
        + html_table(("flag", "stars"), [*counts, ("none", str(int((flags == 0).sum())))])
    )


def _method_labels(errors: Table) -> dict[str, str]:
    """Return the label of each method of a table, in the order of the table."""
    names = dict.fromkeys(errors["method"])
    return {n: MEAN_LABEL if n == MEAN_PSF else method_of(n).look.label for n in names}


# Figures of the page.


@styled
def errors_figure(errors: Table, model_method: str) -> Figure:
    """Draw MSE against S/N for each method, with the noise of the bright images as a floor.

    Parameters
    ----------
    errors : Table
        Columns of `report.csv`.
    model_method : str
        Name of the method with the thick line.
    """
    figure = new_figure(3.4, layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="S/N", ylabel="MSE")
    for index, (name, label) in enumerate(_method_labels(errors).items()):
        rows = errors[errors["method"] == name]
        rows.sort("snr")
        color, width = SERIES_COLORS[index % len(SERIES_COLORS)], 2.2 if name == model_method else 1
        axes.errorbar(
            rows["snr"], rows["mse"], rows["mse_stderr"], label=label, marker="o", ms=3,
            color=color, lw=width,
        )  # fmt: skip
    axes.axhline(errors["truth_mse"][0], color="grey", ls=":", label="noise of the truth")
    axes.grid(True, which="both")
    figure.legend(loc="outside right upper")
    return figure


@styled
def error_maps(degraded: Mapping[float, Mapping[str, np.ndarray]]) -> Figure:
    """Draw mean and RMS, over held-out stars, of restored minus bright image.

    `degraded` has images by S/N, as of `check_held_out`; those of the S/N nearest to 10 are shown.
    """
    snr = nearest_snr(degraded)
    images = degraded[snr]
    # In per cent of the mean peak; both means share one scale of colours, symmetric about 0.
    peak = images["truth"].max(axis=(1, 2)).mean()
    figure = new_figure(2.4, layout="constrained")
    grid: Any = figure.subplots(1, 4, subplot_kw={"xticks": [], "yticks": []})
    for columns, name, label in ((grid[:2], "model", "model"), (grid[2:], MEAN_PSF, "mean PSF")):
        error = 100 * (images[name] - images["truth"]) / peak
        mean, rms = error.mean(axis=0), np.sqrt(np.square(error).mean(axis=0))
        limit = max(np.abs(mean).max(), 1e-9)
        for axes, image, statistic, look in (
            (columns[0], mean, "mean", {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}),
            (columns[1], rms, "RMS", {"cmap": "magma", "vmin": 0}),
        ):
            artist = axes.imshow(image, origin="lower", interpolation="nearest", **look)
            axes.set_title(f"{label}, {statistic}", fontsize=8)
            figure.colorbar(artist, ax=axes, location="bottom", shrink=0.9)
    figure.suptitle(f"error at S/N {snr:.3g}, % of the mean peak")
    return figure


@styled
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
        # A square root shows core and wings in one picture.
        above.imshow(np.sqrt(np.clip(stamp / np.nanmax(stamp), 0, 1)), origin="lower", cmap="magma")
        artist = below.imshow(residual, origin="lower", cmap="RdBu_r", vmin=-5, vmax=5)
    for axes in grid.ravel():
        axes.set(xticks=[], yticks=[])
    figure.colorbar(artist, ax=grid, label="residual (σ)", shrink=0.8)
    return figure


@styled
def shapes_figure(
    stars: Mapping[str, np.ndarray],
    degraded_rows: np.ndarray,
    degraded: Mapping[float, Mapping[str, np.ndarray]],
) -> Figure:
    """Draw FWHM and ellipticity against magnitude, x and y.

    Upper panels: all usable stars, with held-out stars in colour. Lower panels: errors of the
    held-out stars after they were degraded to the S/N nearest to 10. Parameters are those of
    `quality_page`, with the images by S/N.
    """
    snr = nearest_snr(degraded)
    # Shapes of flagged stars mean nothing.
    usable = ((stars["flags"] & int(UNUSABLE_FLAGS)) == 0) & np.isfinite(stars["fwhm_px"])
    held_out = usable & (stars["part"] == "held out")
    size_error, ellipticity_error = size_errors(degraded[snr])
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
            above, below = grid[2 * row : 2 * row + 2, column]
            above.plot(place[usable], stars[name][usable], ".", ms=2, color="#888888", label="all")
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


@styled
def chi2_figure(stars: Mapping[str, np.ndarray]) -> Figure:
    """Draw χ² per pixel of all stars against S/N: flagged, used for training, and neither.

    `stars` has the columns flags, part, chi2 and snr, shape (n,) each. χ² is 1 where the model and
    the noise are right.
    """
    flagged, learnt = stars["flags"] != 0, stars["part"] == "training"
    # Both axes are logarithmic.
    positive = (stars["chi2"] > 0) & (stars["snr"] > 0)
    figure = new_figure(2.8, layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="S/N", ylabel="χ² per pixel")
    for selected, color, label in (
        (positive & flagged, "#aaaaaa", "flagged"),
        (positive & ~flagged & learnt, SERIES_COLORS[5], "no flag, learnt from"),
        (positive & ~flagged & ~learnt, SERIES_COLORS[0], "no flag"),
    ):
        axes.plot(
            stars["snr"][selected], stars["chi2"][selected], ".", ms=3, color=color, label=label
        )
    axes.axhline(1.0, color="black", lw=0.8)
    axes.grid(True)
    axes.legend()
    return figure
