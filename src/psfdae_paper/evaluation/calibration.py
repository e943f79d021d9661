"""Fit of parameters that the paper does not give, to its original-noise rows.

The rows depend on noise and images only, not on any estimator. Their MSE gives the noise per λ.
Their SSIM gives the dynamic range, and the structure of a stamp, which is the pixel scale.

Input: the scan of simulated stars (stage `scan`). Output: the fitted parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from psfdae_paper.evaluation.paper import read_published


class OriginalNoise(NamedTuple):
    """An original-noise column of the paper's tables."""

    dataset: str
    noise_level: float
    mse: float
    ssim: float

    @property
    def is_fitted(self) -> bool:
        """True if the column is used in fits: all but the one whose MSE does not follow λ²."""
        return (self.dataset, self.noise_level) != ("dataset8", 0.002)


def read_original_noise() -> list[OriginalNoise]:
    """Return the paper's original-noise columns, by dataset and noise level."""
    paper = read_published("psf")
    rows = paper[paper.method == "original_noise"]
    # One row for each dataset and noise level, with both metrics.
    by_metric = rows.pivot(index=["dataset", "noise_level"], columns="metric", values="value")
    by_metric = by_metric.reset_index()
    # The columns have the names of the fields.
    columns = (by_metric[name] for name in OriginalNoise._fields)
    return [OriginalNoise(*row) for row in zip(*columns, strict=True)]


def solve_kappa(mse: float, level: float, pixels: int, background: float) -> float:
    """Return κ of a noise level whose pixel variance is `mse`, the star's photons included.

    Solves (κλ)² + κλ/(P √B) = MSE for κ, where 1/P is the mean of a normalised image of P pixels
    and B the background in photons.
    """
    photon_term = 1.0 / (pixels * np.sqrt(background))
    # Positive root of x² + x/(P √B) − MSE = 0 with x = κλ.
    return float((-photon_term + np.sqrt(photon_term**2 + 4.0 * mse)) / 2.0 / level)


@dataclass(frozen=True)
class ScaleFit:
    """Joint fit of dynamic range and pixel scales.

    Attributes
    ----------
    data_range : float
        Dynamic range of the SSIM.
    pixel_scale : dict
        Pixel scale in arcsec by experiment.
    rms : float
        RMS of the SSIM residuals of the fitted columns.
    """

    data_range: float
    pixel_scale: dict[str, float]
    rms: float


def fit_scales(scan: pd.DataFrame) -> ScaleFit:
    """Fit one dynamic range and one pixel scale per experiment by least squares.

    Parameters
    ----------
    scan : DataFrame
        Columns experiment, pixel_scale_arcsec, data_range, dataset, noise_level,
        ssim; a full grid of scale × range for every fitted column.
    """
    from scipy.optimize import least_squares

    # Scanned pixel scales by experiment, and the number of the experiment of each dataset.
    scales = scan.groupby("experiment").pixel_scale_arcsec.agg(["min", "max"])
    experiments = scan.groupby("dataset").experiment.first()
    numbers = {name: list(scales.index).index(value) for name, value in experiments.items()}
    residuals = _interpolate_residuals(scan)

    def compute_residuals(logarithms: np.ndarray) -> np.ndarray:
        # SSIM of the interpolated scan minus the paper's, for each of its columns.
        data_range, *scale = np.exp(logarithms)
        return np.array([f(scale[numbers[d]], data_range) for d, f in residuals])

    # Parameters are logarithms within the scanned ranges; the fit begins in their middle.
    low, high = np.log(np.vstack([scan.data_range.agg(["min", "max"]), scales])).T
    middle = 0.5 * (low + high)
    solution = least_squares(compute_residuals, middle, bounds=(low, high), diff_step=1e-3)
    # Back from logarithms: the range, then the scale of each experiment.
    data_range, *pixel_scales = (float(np.exp(logarithm)) for logarithm in solution.x)
    rms = float(np.sqrt(np.mean(solution.fun**2)))
    return ScaleFit(data_range, dict(zip(scales.index, pixel_scales, strict=True)), rms)


def compute_scale_residuals(scan: pd.DataFrame, data_range: float) -> pd.DataFrame:
    """Compare the paper's SSIM with the SSIM at each scanned pixel scale, at one dynamic range.

    Returns
    -------
    DataFrame
        Columns experiment, r0_m, pixel_scale_arcsec, rms, largest (SSIM).
    """
    # RMS and largest difference of the SSIM over the paper's columns, at each scanned scale.
    table = []
    for (experiment, r0), part in scan.groupby(["experiment", "r0_m"], dropna=False):
        residuals = _interpolate_residuals(part)
        for scale in sorted(part.pixel_scale_arcsec.unique()):
            residual = np.array([compute(scale, data_range) for _, compute in residuals])
            statistics = np.sqrt((residual**2).mean()), np.abs(residual).max()
            table.append((experiment, r0, scale, *statistics))
    columns = ["experiment", "r0_m", "pixel_scale_arcsec", "rms", "largest"]
    return pd.DataFrame(table, columns=columns)


def _interpolate_residuals(scan: pd.DataFrame) -> list[tuple[str, Callable[[float, float], float]]]:
    """Return the SSIM of a scan minus the paper's, for each of its columns in the scan.

    Each has its dataset, and a function of pixel scale and dynamic range.
    """
    from scipy.interpolate import RectBivariateSpline

    def interpolate(row: OriginalNoise) -> Callable[[float, float], float]:
        # The SSIM on a grid of scale and dynamic range, as a spline of their logarithms.
        part = scan[(scan.dataset == row.dataset) & np.isclose(scan.noise_level, row.noise_level)]
        grid = part.pivot(index="pixel_scale_arcsec", columns="data_range", values="ssim")
        scale_order, range_order = (min(3, size - 1) for size in grid.shape)
        logarithms = np.log(grid.index), np.log(grid.columns)
        spline = RectBivariateSpline(*logarithms, grid.to_numpy(), kx=scale_order, ky=range_order)
        return lambda scale, data_range: (
            float(spline(np.log(scale), np.log(data_range))[0, 0]) - row.ssim
        )

    # Only fitted columns of the scanned datasets.
    datasets = set(scan.dataset)
    rows = [row for row in read_original_noise() if row.is_fitted and row.dataset in datasets]
    return [(row.dataset, interpolate(row)) for row in rows]
