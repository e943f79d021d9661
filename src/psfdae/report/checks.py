"""Comparison of a model with one mean PSF, and checks that show whether to trust it.

The numbers come from stars that were held out of the training (`psfdae.report.validation`); the
report page shows the answers (`psfdae.report.page`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from psfdae.base.types import Table
from psfdae.image.stamps import cut, find_unlike_stars
from psfdae.methods import method as method_of
from psfdae.stars.moments import measure_shapes, shift_stamps

MEAN_PSF = "mean_psf"
"""Name, in tables, of the comparison with one mean PSF whose centre is fitted to each star."""

Check = tuple[str, str, bool]
"""Question, answer, and True if the check is passed."""


def fit_mean_psf(noisy: np.ndarray, mean: np.ndarray, reach_px: float) -> np.ndarray:
    """Shift one PSF to the centre that fits each star best: the simplest model of the PSF.

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
    count, side = noisy.shape[:2]

    def mean_at(offsets: np.ndarray) -> np.ndarray:
        """Return the mean PSF (k, d, d) of sum 1, shifted by offsets (k, 2) in pixels."""
        psf = cut(shift_stamps(mean[None], offsets, np.zeros(len(offsets), int)), side)
        return np.asarray(psf / psf.sum(axis=(1, 2), keepdims=True))

    # Steps of a quarter of a pixel: between them, the likelihood is close to a parabola.
    step_px = 0.25
    axis = np.arange(-reach_px, reach_px + step_px / 2, step_px)
    templates = mean_at(np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2))
    templates = templates.reshape(axis.size**2, -1)
    # ln likelihood times σ² in white noise, −|x − t|²/2 with the template t, without the term
    # −|x|²/2, which does not depend on t.
    likelihood = noisy.reshape(count, -1) @ templates.T - 0.5 * np.square(templates).sum(axis=1)
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
    """Return the MSE of a method over the MSE of a reference method, by ascending S/N.

    `errors` has the columns snr, method and mse. S/N at which a method was not measured are absent.
    """
    mse = {(row["method"], row["snr"]): row["mse"] for row in errors}
    return {
        float(snr): float(mse[method, snr] / mse[reference, snr])
        for snr in sorted(snr for name, snr in mse if name == method)
        if (reference, snr) in mse
    }


def nearest_snr(values: Iterable[float]) -> float:
    """Return the S/N whose ratio to 10 is nearest to 1; figures show errors at this S/N.

    Stars of S/N 10 are faint enough for models to differ, and bright enough to be seen in a figure.
    """
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
    sentence = f"{label}: at S/N {snr:.3g} the MSE is {mean[snr]:.2f} times the MSE of one mean PSF"
    if linear and method != "lmmse":
        sentence += f", {linear[snr]:.2f} times the MSE of linear MMSE"
    worse_snr = ", ".join(f"{snr:.3g}" for snr, ratio in mean.items() if ratio >= 1)
    verdict = (
        f"no better than the mean PSF at S/N {worse_snr}" if worse_snr else "better at each S/N"
    )
    return f"{sentence}; {verdict} ({errors['stars'][0]} stars held out)"


def size_errors(images: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Compare sizes and shapes of denoised stars with their bright images.

    Parameters
    ----------
    images : mapping of str to ndarray, shape (n, d, d)
        Held-out stars: denoised from degraded images (`model`), and the bright images (`truth`).

    Returns
    -------
    size_error : ndarray, shape (n,)
        FWHM over the FWHM of the bright image, minus 1.
    ellipticity_error : ndarray, shape (n,)
        Ellipticity minus the ellipticity of the bright image.
    """
    model, truth = (measure_shapes(images[name]) for name in ("model", "truth"))
    return model.fwhm_px / truth.fwhm_px - 1.0, model.ellipticity - truth.ellipticity


def method_labels(errors: Table) -> dict[str, str]:
    """Return the label of each method of a table, in the order of the table.

    Returns
    -------
    dict of str to str
        Label for legends by name of the method; one mean PSF has the name `MEAN_PSF`.
    """
    names = dict.fromkeys(errors["method"])
    return {n: "one mean PSF" if n == MEAN_PSF else method_of(n).look.title for n in names}


def check_held_out(
    method: str,
    errors: Table,
    photometry: Table,
    coverage: Mapping[float, float],
    denoised_images: Mapping[float, Mapping[str, np.ndarray]],
) -> list[Check]:
    """Check a model on held-out stars alone.

    Parameters
    ----------
    method : str
        Name of the model's method.
    errors, photometry : Table
        Columns of `report.csv`, and of `found.csv`.
    coverage : mapping of float to float
        Fraction of the errors of pixels within their predicted 68 % half-width, by S/N.
    denoised_images : mapping of float to mapping of str to ndarray, shape (n, d, d)
        Held-out stars by S/N: bright images (`truth`), and denoised from degraded images by the
        model (`model`) and by one mean PSF (`MEAN_PSF`).
    """
    # Each row: question, answer at each S/N, and the verdict. Unmeasured quantities have no row.
    rows: list[Check] = []
    # MSE over the MSE of the two simplest models of the PSF.
    for label, reference in (("one mean PSF", MEAN_PSF), ("linear MMSE", "lmmse")):
        ratios = mse_ratios(errors, method, reference)
        by_snr = ", ".join(f"{ratio:.2f} at S/N {snr:.3g}" for snr, ratio in ratios.items())
        if ratios:
            rows.append((f"Better than {label}?", f"MSE × {by_snr}", max(ratios.values()) < 1))
    # Bias of the size: at most 2 % of the FWHM plus two standard errors. The standard error of a
    # median of n values is 1.25 σ/√n; n is at most the number of stars, because images of the same
    # star are not independent.
    snr, held_out = nearest_snr(denoised_images), int(errors["stars"][0])
    size_error = size_errors(denoised_images[snr])[0]
    bias = float(np.median(size_error))
    stderr = 1.25 * float(size_error.std()) / np.sqrt(min(held_out, errors["images"][0]))
    answer = f"median {100 * bias:+.1f} ± {100 * stderr:.1f} %"
    rows.append((f"Size of stars of S/N {snr:.3g}", answer, abs(bias) < 0.02 + 2 * stderr))
    # Coverage of the predicted errors, of pixels and then of flux and centre: 68 ± 8 %, for flux
    # and centre within two standard errors of the coverage.
    low, high = 0.60, 0.76
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
            rows.append((f"Are 68 % of {name} errors within ± σ?", by_snr, is_covered))
    # With fewer than 20 stars, all other checks are rough estimates.
    return [*rows, ("Stars held out", f"{held_out}", held_out >= 20)]


def check_stars(stars: Mapping[str, np.ndarray]) -> list[Check]:
    """Check a model on all stars of its image.

    `stars` has columns of the prediction and `part` of `selection.csv`, shape (n,) each.
    """
    checks: list[Check] = []
    # χ² of stars that the model was not trained on, in classes of S/N with at least five stars.
    is_usable = (stars["flags"] == 0) & (stars["part"] != "training") & np.isfinite(stars["chi2"])
    snr_class = np.searchsorted((10.0, 100.0, 1000.0), stars["snr"])
    medians, answers = [], []
    for index, label in enumerate(("below 10", "10 to 100", "100 to 1000", "above 1000")):
        chi2 = stars["chi2"][is_usable & (snr_class == index)]
        if chi2.size >= 5:
            medians.append(float(np.median(chi2)))
            answers.append(f"median {medians[-1]:.2f} at S/N {label} ({chi2.size} stars)")
    if medians:
        question = "χ² of unflagged stars outside the training"
        is_passed = all(0.8 < median < 1.3 for median in medians)
        checks.append((question, ", ".join(answers), is_passed))
    # The model does not suit an image where a tenth of the stars or more are outliers.
    outlier_fraction = float(find_unlike_stars(stars["flags"]).mean())
    answer = f"{100 * outlier_fraction:.0f} % of the list"
    return [*checks, ("Stars unlike the training", answer, outlier_fraction < 0.1)]
