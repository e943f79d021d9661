"""Fit of what the paper leaves open to its original-noise rows.

The rows depend on noise and images only, not on any estimator: their MSE gives
the noise per λ, their SSIM the dynamic range and how much structure a stamp
has, that is the pixel scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from psfdae_paper.evaluation.paper import published

OUTLIER = ("dataset8", 0.002)
"""The one column whose MSE does not follow λ²; it is left out of every fit."""


class OriginalNoise(NamedTuple):
    """An original-noise column of the paper's tables."""

    dataset: str
    noise_level: float
    mse: float
    ssim: float

    @property
    def fitted(self) -> bool:
        """Whether it takes part in fits."""
        return (self.dataset, self.noise_level) != OUTLIER


def original_noise_rows() -> list[OriginalNoise]:
    """The paper's original-noise columns, by dataset and noise level."""
    paper = published("psf")
    rows = paper[paper.method == "original_noise"]
    wide = rows.pivot(index=["dataset", "noise_level"], columns="metric", values="value")
    wide = wide.reset_index()
    columns = (wide[name] for name in OriginalNoise._fields)
    return [OriginalNoise(*row) for row in zip(*columns, strict=True)]


def kappa_of_mse(mse: float, level: float, pixels: int, background: float) -> float:
    """κ of a noise level whose pixel variance is `mse`, the star's photons included.

    Solves (κλ)² + κλ/(P √B) = MSE, where 1/P is the mean of a normalised image
    of P pixels.
    """
    photon = 1.0 / (pixels * np.sqrt(background))
    return float((-photon + np.sqrt(photon**2 + 4.0 * mse)) / 2.0 / level)


@dataclass(frozen=True)
class ScaleFit:
    """Joint fit of dynamic range and pixel scales.

    Attributes
    ----------
    data_range : float
    pixel_scale : dict
        Experiment → pixel scale in arcsec.
    rms : float
        RMS of the SSIM residuals of the fitted columns.
    """

    data_range: float
    pixel_scale: dict[str, float]
    rms: float


def fit_scales(scan: pd.DataFrame) -> ScaleFit:
    """Least squares over one dynamic range and one pixel scale per experiment.

    Parameters
    ----------
    scan : DataFrame
        Columns experiment, pixel_scale_arcsec, data_range, dataset, noise_level,
        ssim; a full grid of scale × range for every fitted column.
    """
    from scipy.optimize import least_squares

    rows = _fitted(scan)
    experiments = sorted(scan.experiment.unique())
    surfaces = [_surface(scan, row) for row in rows]
    belongs = [
        experiments.index(scan.experiment[scan.dataset == row.dataset].iloc[0]) for row in rows
    ]
    target = np.array([row.ssim for row in rows])

    def residuals(parameters: np.ndarray) -> np.ndarray:
        data_range, scales = np.exp(parameters[0]), np.exp(parameters[1:])
        values = [
            surface(scales[index], data_range)
            for surface, index in zip(surfaces, belongs, strict=True)
        ]
        residual: np.ndarray = np.array(values) - target
        return residual

    ranges = scan.data_range.agg(["min", "max"])
    bounds = [(ranges["min"], ranges["max"])]
    for experiment in experiments:
        scales = scan.pixel_scale_arcsec[scan.experiment == experiment]
        bounds.append((scales.min(), scales.max()))
    low, high = np.log(np.array(bounds)).T
    found = least_squares(residuals, 0.5 * (low + high), bounds=(low, high), diff_step=1e-3)
    scale = {name: float(np.exp(x)) for name, x in zip(experiments, found.x[1:], strict=True)}
    rms = float(np.sqrt(np.mean(found.fun**2)))
    return ScaleFit(float(np.exp(found.x[0])), scale, rms)


def residuals_by_scale(scan: pd.DataFrame, data_range: float) -> pd.DataFrame:
    """How well each scanned pixel scale explains the rows at one dynamic range.

    Returns
    -------
    DataFrame
        Columns experiment, r0_m, pixel_scale_arcsec, rms, largest (SSIM).
    """
    table = []
    for (experiment, r0), part in scan.groupby(["experiment", "r0_m"], dropna=False):
        rows = _fitted(part)
        surfaces = [_surface(part, row) for row in rows]
        target = np.array([row.ssim for row in rows])
        for scale in sorted(part.pixel_scale_arcsec.unique()):
            residual = np.array([s(scale, data_range) for s in surfaces]) - target
            table.append(
                (experiment, r0, scale, np.sqrt((residual**2).mean()), np.abs(residual).max())
            )
    return pd.DataFrame(
        table, columns=["experiment", "r0_m", "pixel_scale_arcsec", "rms", "largest"]
    )


def _fitted(scan: pd.DataFrame) -> list[OriginalNoise]:
    """The paper's columns that take part in fits and are in a scan."""
    datasets = set(scan.dataset)
    return [row for row in original_noise_rows() if row.fitted and row.dataset in datasets]


def _surface(scan: pd.DataFrame, row: OriginalNoise) -> Callable[[float, float], float]:
    """SSIM of one column as a smooth function of pixel scale and dynamic range."""
    from scipy.interpolate import RectBivariateSpline

    part = scan[(scan.dataset == row.dataset) & np.isclose(scan.noise_level, row.noise_level)]
    grid = part.pivot(index="pixel_scale_arcsec", columns="data_range", values="ssim")
    order = [min(3, size - 1) for size in grid.shape]
    spline = RectBivariateSpline(
        np.log(grid.index), np.log(grid.columns), grid.to_numpy(), kx=order[0], ky=order[1]
    )
    return lambda scale, data_range: float(spline(np.log(scale), np.log(data_range))[0, 0])
