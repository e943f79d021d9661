"""Whether to trust a model of one's own stars: beside one mean PSF, and on a page to read.

`quality_page` makes one HTML file that needs no other: first what it comes down to, then
errors, the field, residuals, sizes and shapes, χ², and which stars were left out.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.figures import SERIES_COLORS, as_png, new_figure, styled
from psfdae.image.selection import Verdict
from psfdae.image.stamps import StarFlag, cut
from psfdae.image.tables import html_table
from psfdae.model.plot import SPOILT
from psfdae.moments import measure_shapes, shift_stamps

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

MEAN_PSF, MEAN_LABEL = "mean_psf", "one mean PSF, its centre fitted"
LINEAR = "lmmse"
STEP_PX = 0.25  # between the places at which the mean PSF is tried
SHOWN_SNR = 10.0
SHOWN_STARS = 8

# What a check calls all right.
SIZE_BIAS = 0.02  # of the FWHM, beyond two standard errors
COVERED = (0.60, 0.76)  # of the errors, where 68 % are stated
USUAL_CHI2 = (0.8, 1.3)
CHI2_SNR = (10.0, 100.0, 1000.0)  # between them, below and above, if there are some stars
SOME_STARS = 5
FEW_STARS = 20  # held out


def fitted_mean(noisy: np.ndarray, mean: np.ndarray, reach_px: float) -> np.ndarray:
    """One PSF for all stars, moved to where it fits each star best: what a model has to beat.

    Parameters
    ----------
    noisy : ndarray, shape (n, d, d)
        Stars of flux 1 without sky, brightest pixel near (d/2, d/2).
    mean : ndarray, shape (s, s)
        Centre at index (s//2, s//2), s ≥ d.
    reach_px : float
        The centre is searched within ± this of the middle.

    Returns
    -------
    ndarray, shape (n, d, d)
        Of sum 1.
    """

    def at(places: np.ndarray) -> np.ndarray:
        psf = cut(shift_stamps(mean[None], places, np.zeros(len(places), int)), side)
        return np.asarray(psf / psf.sum(axis=(1, 2), keepdims=True))

    count, side = noisy.shape[:2]
    axis = np.arange(-reach_px, reach_px + STEP_PX / 2, STEP_PX)
    tried = at(np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2))
    tried = tried.reshape(axis.size**2, -1)
    # Least squares of white noise: |x − t|² without what does not depend on t.
    fit = noisy.reshape(count, -1) @ tried.T - 0.5 * np.square(tried).sum(axis=1)
    fit = fit.reshape(count, axis.size, axis.size)
    best = np.stack(np.divmod(fit.reshape(count, -1).argmax(axis=1), axis.size), axis=1)
    inner = np.clip(best, 1, axis.size - 2)
    star, (row, column) = np.arange(count), inner.T
    places = axis[inner]
    for k, step in enumerate(((1, 0), (0, 1))):  # the top of a parabola through three of them
        lower, middle, upper = (
            fit[star, row + s * step[0], column + s * step[1]] for s in (-1, 0, 1)
        )
        curvature = np.minimum(lower - 2 * middle + upper, -1e-30)
        places[:, k] += STEP_PX * np.clip(0.5 * (lower - upper) / curvature, -1, 1)
    return at(places)


def ratios(errors: Table, method: str, other: str) -> dict[float, float]:
    """MSE of a method over that of another one by S/N, ascending; empty if one is missing.

    `errors` has the columns snr, method and mse.
    """
    mse = {(row["method"], row["snr"]): row["mse"] for row in errors}
    levels = sorted({snr for name, snr in mse if name == method})
    pairs = {snr: (mse[method, snr], mse.get((other, snr))) for snr in levels}
    return {float(snr): float(own / its) for snr, (own, its) in pairs.items() if its is not None}


def nearest(values: Iterable[float], wanted: float = SHOWN_SNR) -> float:
    """The value whose ratio to the wanted one is nearest to 1."""
    return min(values, key=lambda value: abs(np.log(value / wanted)))


def standing(errors: Table, method: str, label: str) -> str:
    """How good a method is beside one mean PSF and linear MMSE, in a sentence."""
    mean, linear = (ratios(errors, method, other) for other in (MEAN_PSF, LINEAR))
    snr = nearest(mean)
    said = f"{label}: at S/N {snr:.3g} the MSE is {mean[snr]:.2f} times that of {MEAN_LABEL}"
    if linear and method != LINEAR:
        said += f", {linear[snr]:.2f} times that of linear MMSE"
    worse = [f"{level:.3g}" for level, ratio in mean.items() if ratio >= 1]
    where = f"no better than the mean PSF at S/N {', '.join(worse)}" if worse else "better at each"
    return f"{said}; {where} ({errors['stars'][0]} stars held out)"


# The page.


@dataclass(frozen=True)
class Quality:
    """Contents of the report page of a model.

    Attributes
    ----------
    name, image : str
        Of the model, and of the file that it was made of.
    method, label : str
        That of the model.
    notes : sequence of str
        What is known of the camera, and advice.
    errors : Table
        Columns of `report.csv`.
    found : Table
        Columns of `found.csv`.
    coverage : dict
        Part of the errors within ± the stated 68 % by S/N.
    faint : dict
        By S/N the held-out stars degraded, (n, d, d) each: `truth`, `model` and `MEAN_PSF`.
    degraded : dict
        Columns of `stars` of these held-out stars, (n,).
    stars : dict
        Columns of the prediction of all N stars, (N,) each, and `verdict` and `part` of
        `selection.csv`.
    residual : ndarray, shape (k, d, d)
        Star minus PSF of some bright stars held out, in σ of the sky.
    bright : ndarray, shape (k, d, d)
        These stars.
    strip : bytes
        PNG of faint held-out stars and what the methods make of them.
    field : Figure, optional
        Map of the PSF, if the stars have positions.
    facts : sequence of str
        What the model says of itself (`Method.facts`).
    """

    name: str
    image: str
    method: str
    label: str
    notes: Sequence[str]
    errors: Table
    found: Table
    coverage: dict[float, float]
    faint: dict[float, dict[str, np.ndarray]]
    degraded: dict[str, np.ndarray]
    stars: dict[str, np.ndarray]
    residual: np.ndarray
    bright: np.ndarray
    strip: bytes
    field: Figure | None
    facts: Sequence[str] = ()

    def has(self, flag: StarFlag) -> np.ndarray:
        """Return True for stars that carry one of these flags."""
        return (self.stars["flags"] & int(flag)) > 0

    def usable(self) -> np.ndarray:
        """Stars whose shape means something."""
        return np.asarray(~self.has(SPOILT) & np.isfinite(self.stars["fwhm_px"]))

    def chi2(self) -> dict[str, np.ndarray]:
        """χ² of stars without a flag that were not learnt from, by words for their S/N."""
        stars = self.stars
        fair = (stars["flags"] == 0) & (stars["part"] != "training") & np.isfinite(stars["chi2"])
        place, found = np.searchsorted(CHI2_SNR, stars["snr"]), {}
        words = [f"below {CHI2_SNR[0]:g}", *(f"from {edge:g}" for edge in CHI2_SNR)]
        for index, name in enumerate(words):
            some = stars["chi2"][fair & (place == index)]
            if some.size >= SOME_STARS:
                found[name] = some
        return found

    def sizes(self, snr: float) -> tuple[np.ndarray, np.ndarray]:
        """Errors of sizes and shapes at a S/N (`size_errors`), (n,) each."""
        return size_errors(self.faint[snr])


def size_errors(faint: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """FWHM of faint held-out stars over that of their bright images, minus 1, shape (n,).

    The second one is by how much their ellipticity is larger. `faint` has the images (n, d, d) of
    `model` and `truth`.
    """
    found, truth = (measure_shapes(faint[kind]) for kind in ("model", "truth"))
    return found.fwhm_px / truth.fwhm_px - 1.0, found.ellipticity - truth.ellipticity


def quality_page(q: Quality) -> str:
    """The page as HTML."""
    lead = standing(q.errors, q.method, q.label)
    parts = [
        f"<h1>{escape(q.name)}</h1><p class=lead>{escape(lead)}.</p>",
        checks_html(checks(q)),
        "<h2>Errors on stars that no training saw, degraded to low S/N</h2>",
        _errors_table(q),
        _picture(errors_figure(q)),
        _png(q.strip),
        "<h2>Flux, centre and their errors</h2>",
        _found_table(q),
        "<h2>The PSF over the field</h2>",
        *(f"<p>{escape(fact)}.</p>" for fact in q.facts),
        _picture(q.field) if q.field else "<p>The stars have no positions.</p>",
        "<h2>Residuals of held-out stars</h2>",
        "<p>Above: restored minus bright image at the S/N given, over all held-out stars. "
        "Below: bright held-out stars as they are in the image, and what their PSF leaves, in σ "
        "of the sky.</p>",
        _picture(error_maps(q)),
        _picture(residual_strip(q)) if len(q.residual) else "",
        "<h2>Size and shape against magnitude and place</h2>",
        _picture(shapes_figure(q)),
        "<h2>χ²</h2>",
        _picture(chi2_figure(q)),
        "<h2>Stars left out</h2>",
        _left_out(q),
        "<h2>What is known of the image</h2><ul>",
        *(f"<li>{escape(line)}</li>" for note in q.notes for line in note.splitlines()),
        "</ul>",
    ]
    return PAGE.format(title=escape(q.name), image=escape(q.image), body="\n".join(parts))


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


def _picture(figure: Figure) -> str:
    return _png(as_png(figure, dpi=110))


def _png(content: bytes) -> str:
    return f'<img src="data:image/png;base64,{base64.b64encode(content).decode()}">'


Check = tuple[str, str, bool]
"""Question, answer, and whether the check is passed."""


def checks_of_held_out(
    method: str,
    errors: Table,
    found: Table,
    coverage: Mapping[float, float],
    faint: Mapping[float, Mapping[str, np.ndarray]],
) -> list[Check]:
    """Checks that rest on the stars held out alone; parameters are attributes of `Quality`."""
    mean, linear = (ratios(errors, method, other) for other in (MEAN_PSF, LINEAR))
    snr = nearest(faint)
    size = size_errors(faint[snr])[0]
    held = int(errors["stars"][0])
    # Standard error of a median, 1.25 σ/√n, of as many images as there are different stars.
    bias = float(np.median(size))
    error = 1.25 * float(size.std()) / np.sqrt(min(held, errors["images"][0]))
    rows = [
        ("Better than one mean PSF?", _by_snr(mean), max(mean.values()) < 1),
        ("Better than linear MMSE?", _by_snr(linear), max(linear.values(), default=0.0) < 1),
        (
            f"Size of stars of S/N {snr:.3g}",
            f"median {100 * bias:+.1f} ± {100 * error:.1f} %",
            abs(bias) < SIZE_BIAS + 2 * error,
        ),
        (
            "Does ± UNCERT hold 68 % of the errors?",
            ", ".join(f"{100 * v:.0f} % at S/N {s:.3g}" for s, v in sorted(coverage.items())),
            all(COVERED[0] < v < COVERED[1] for v in coverage.values()),
        ),
        ("Do errors of the flux hold 68 %?", *_held(found, "flux")),
        ("Do errors of the centre hold 68 %?", *_held(found, "centre")),
        ("Stars held out", f"{held}", held >= FEW_STARS),
    ]
    return [row for row in rows if row[1]]


def checks(q: Quality) -> list[Check]:
    """Checks before the model is trusted, also those of all stars of the image."""
    chi2 = {name: (float(np.median(some)), some.size) for name, some in q.chi2().items()}
    unlike = float(q.has(StarFlag.UNLIKE_TRAINING).mean())
    rows = [
        (
            "χ² of stars without a flag that were not learnt from",
            ", ".join(f"median {v:.2f} at S/N {s} ({n} stars)" for s, (v, n) in chi2.items()),
            all(USUAL_CHI2[0] < v < USUAL_CHI2[1] for v, _ in chi2.values()),
        ),
        ("Stars unlike the training", f"{100 * unlike:.0f} % of the list", unlike < 0.1),
    ]
    *first, held = checks_of_held_out(q.method, q.errors, q.found, q.coverage, q.faint)
    return [*first, *(row for row in rows if row[1]), held]


def _held(found: Table, name: str) -> tuple[str, bool]:
    """Parts of the errors within the stated ones by S/N, and whether 68 % may be true of each."""
    rows = [(r["snr"], r[f"{name}_within"], r[f"{name}_within_stderr"]) for r in found]
    rows = [row for row in rows if np.isfinite(row[1])]
    said = ", ".join(f"{100 * v:.0f} ± {100 * e:.0f} % at S/N {snr:.3g}" for snr, v, e in rows)
    return said, all(COVERED[0] < v + 2 * e and v - 2 * e < COVERED[1] for _, v, e in rows)


def _by_snr(values: dict[float, float]) -> str:
    said = ", ".join(f"{value:.2f} at S/N {snr:.3g}" for snr, value in values.items())
    return f"MSE × {said}" if said else ""


def checks_html(rows: Sequence[Check]) -> str:
    """Return a table of checks, each passed or to be inspected."""
    words = {True: "<b class=pass>pass</b>", False: "<b class=inspect>inspect</b>"}
    cells = [(escape(a), escape(b), words[bool(passed)]) for a, b, passed in rows]
    return html_table(("check", "found", ""), cells)


def _errors_table(q: Quality) -> str:
    labels = _labels(q)
    levels = np.unique(q.errors["snr"])
    cell = {(r["method"], r["snr"]): f"{r['mse']:.2e} ± {r['mse_stderr']:.0e}" for r in q.errors}
    rows = [
        [escape(f"{label} (the model)" if name == q.method else label)]
        + [cell.get((name, snr), "") for snr in levels]
        for name, label in labels.items()
    ]
    truth = q.errors["truth_mse"][0]
    return html_table(["MSE", *(f"S/N {snr:.3g}" for snr in levels)], rows) + (
        f"<p>Stars have flux 1. Noise of the bright images is {truth:.1e} of every MSE.</p>"
    )


def _found_table(q: Quality) -> str:
    """Return the table of `predict` on held-out stars of which nothing is given."""
    rows = [
        [
            f"{row['snr']:.3g}",
            f"{100 * row['flux_bias']:+.1f} ± {100 * row['flux_bias_stderr']:.1f} %",
            f"{row['flux_pull']:.2f}",
            f"{row['centre_rms_px']:.3f}" if np.isfinite(row["centre_rms_px"]) else "",
        ]
        for row in q.found
    ]
    head = ("S/N", "flux, mean error", "pull of the flux", "centre, RMS error (px)")
    return (
        "<p>Held-out stars degraded to low S/N, of which neither flux, sky, noise nor centre is "
        "given. The pull is what 68 % of the errors are below, over the stated error; it is 1 "
        "where errors hold.</p>" + html_table(head, rows)
    )


def _labels(q: Quality) -> dict[str, str]:
    from psfdae.methods import method

    names = dict.fromkeys(q.errors["method"])
    return {n: MEAN_LABEL if n == MEAN_PSF else method(n).look.label for n in names}


@styled
def errors_figure(q: Quality) -> Figure:
    """MSE against S/N by method, and the noise of the truth."""
    figure = new_figure(3.4, layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="S/N", ylabel="MSE")
    for place, (name, label) in enumerate(_labels(q).items()):
        rows = q.errors[q.errors["method"] == name]
        rows.sort("snr")
        axes.errorbar(
            rows["snr"], rows["mse"], rows["mse_stderr"], label=label, marker="o", ms=3,
            color=SERIES_COLORS[place % len(SERIES_COLORS)], lw=2.2 if name == q.method else 1,
        )  # fmt: skip
    axes.axhline(q.errors["truth_mse"][0], color="grey", ls=":", label="noise of the truth")
    axes.grid(True, which="both")
    figure.legend(loc="outside right upper")
    return figure


@styled
def error_maps(q: Quality) -> Figure:
    """Mean and RMS over held-out stars of what is restored minus the bright image."""
    snr = nearest(q.faint)
    faint = q.faint[snr]
    peak = faint["truth"].max(axis=(1, 2)).mean()
    figure = new_figure(2.4, layout="constrained")
    for place, (kind, who) in enumerate((("model", "model"), (MEAN_PSF, "mean PSF"))):
        error = 100 * (faint[kind] - faint["truth"]) / peak
        top = max(np.abs(error.mean(axis=0)).max(), 1e-9)
        for column, (image, what, look) in enumerate(
            (
                (error.mean(axis=0), "mean", {"cmap": "RdBu_r", "vmin": -top, "vmax": top}),
                (np.sqrt(np.square(error).mean(axis=0)), "RMS", {"cmap": "magma", "vmin": 0}),
            )
        ):
            axes = figure.add_subplot(1, 4, 2 * place + column + 1, xticks=[], yticks=[])
            shown = axes.imshow(image, origin="lower", interpolation="nearest", **look)
            axes.set_title(f"{who}, {what}", fontsize=8)
            figure.colorbar(shown, ax=axes, location="bottom", shrink=0.9)
    figure.suptitle(f"error at S/N {snr:.3g}, % of the mean peak")
    return figure


@styled
def residual_strip(q: Quality) -> Figure:
    """Bright held-out stars, and their residuals within ± 5 σ of the sky."""
    figure = new_figure(2.6, layout="constrained")
    grid: Any = figure.subplots(2, len(q.residual), squeeze=False)
    for star, (above, below) in enumerate(grid.T):
        image = q.bright[star]
        above.imshow(np.sqrt(np.clip(image / np.nanmax(image), 0, 1)), origin="lower", cmap="magma")
        shown = below.imshow(q.residual[star], origin="lower", cmap="RdBu_r", vmin=-5, vmax=5)
    for axes in grid.ravel():
        axes.set(xticks=[], yticks=[])
    figure.colorbar(shown, ax=grid, label="residual (σ)", shrink=0.8)
    return figure


@styled
def shapes_figure(q: Quality) -> Figure:
    """FWHM and ellipticity against magnitude, x and y, and how far faint stars come out off them.

    Above are all stars, and those held out stand out; below the latter, degraded.
    """
    stars, usable, snr = q.stars, q.usable(), nearest(q.faint)
    held = usable & (stars["part"] == "held out")
    size, shape = q.sizes(snr)
    figure = new_figure(7.6, layout="constrained")
    grid: Any = figure.subplots(4, 3, sharey="row", sharex="col")
    rows = (
        ("FWHM (px)", "fwhm_px", 100 * size, f"FWHM at S/N {snr:.3g} (%)"),
        ("ellipticity", "ellipticity", shape, f"ellipticity at S/N {snr:.3g}"),
    )
    for column, (name, across) in enumerate(ACROSS.items()):
        everywhere, where = across(stars), across(q.degraded)
        for row, (what, of, residual, off) in enumerate(rows):
            axes, below = grid[2 * row : 2 * row + 2, column]
            axes.plot(everywhere[usable], stars[of][usable], ".", ms=2, color="#888888",
                      label="all")  # fmt: skip
            axes.plot(everywhere[held], stars[of][held], ".", color=SERIES_COLORS[5],
                      label="held out")  # fmt: skip
            below.axhline(0.0, color="black", lw=0.8)
            below.plot(where, residual, ".", ms=2, color=SERIES_COLORS[5])
            if column == 0:
                axes.set_ylabel(what)
                below.set_ylabel(f"error of\n{off}")
        grid[-1, column].set_xlabel(name)
    grid[0, 0].legend()
    return figure


def _magnitude(stars: dict[str, np.ndarray]) -> np.ndarray:
    return np.asarray(-2.5 * np.log10(np.where(stars["flux"] > 0, stars["flux"], np.nan)))


ACROSS: dict[str, Callable[[dict[str, np.ndarray]], np.ndarray]] = {
    "−2.5 log₁₀ flux": _magnitude,
    "x (px)": lambda stars: stars["x"],
    "y (px)": lambda stars: stars["y"],
}
"""Axes against which sizes and shapes are drawn."""


@styled
def chi2_figure(q: Quality) -> Figure:
    """χ² of all stars against S/N; those with a flag in grey, and those that were learnt from."""
    stars, flagged = q.stars, q.stars["flags"] != 0
    learnt = stars["part"] == "training"
    shown = (stars["chi2"] > 0) & (stars["snr"] > 0)
    figure = new_figure(2.8, layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="S/N", ylabel="χ² per pixel")
    for which, color, label in (
        (flagged, "#aaaaaa", "flagged"),
        (~flagged & learnt, SERIES_COLORS[5], "no flag, learnt from"),
        (~flagged & ~learnt, SERIES_COLORS[0], "no flag"),
    ):
        axes.plot(stars["snr"][shown & which], stars["chi2"][shown & which], ".", ms=3, color=color,
                  label=label)  # fmt: skip
    axes.axhline(1.0, color="black", lw=0.8)
    axes.grid(True)
    axes.legend()
    return figure


def _left_out(q: Quality) -> str:
    verdicts, flags = q.stars["verdict"], q.stars["flags"]
    rows = [(escape(v), str(n)) for v in Verdict if (n := int((verdicts == v).sum()))]
    marked = [(f.name or "", str(n)) for f in StarFlag if (n := int(((flags & int(f)) > 0).sum()))]
    return (
        html_table(("used for training, or why not", "stars"), rows)
        + "<p>Flags of the model on all stars of the list:</p>"
        + html_table(("flag", "stars"), [*marked, ("none", str(int((flags == 0).sum())))])
    )
