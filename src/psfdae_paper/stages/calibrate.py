"""Stages `scan` and `calibrate`: parameters that the paper does not give, fitted to its tables.

Inputs: settings of the scenes, and simulated stars. Outputs: tables of the fitted noise constant κ,
the dynamic range of the SSIM and the pixel scales, with the configured values. Only rows of the
original noise are used, which do not depend on a method.
"""

from __future__ import annotations

from math import ceil
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd

from psfdae.base.belonging import STATIC, require
from psfdae.base.files import Product, read_product, write_csv
from psfdae.base.options import File, Folder
from psfdae.base.progress import steps
from psfdae.base.rng import stream
from psfdae.base.threads import limit_threads
from psfdae.methods.metrics import mse, ssim
from psfdae.optics.pupil import Pupil
from psfdae.optics.wavefronts import WavefrontSource
from psfdae.stars.noise import NoiseModel
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.schema import Config
from psfdae_paper.configuration.wavefront import VonKarman
from psfdae_paper.evaluation.calibration import (
    OriginalNoise,
    compute_scale_residuals,
    fit_scales,
    read_original_noise,
    solve_kappa,
)
from psfdae_paper.evaluation.measure import read_tables
from psfdae_paper.stars.fields import assign_fields
from psfdae_paper.stars.framing import Propagation, normalise_flux
from psfdae_paper.stars.scenes import star_wavefronts, template_wavefronts


@command("paper scan", reads=(*SIMULATION, "noise", "calibration"))
def scan(config: Config, dataset: str, out: File) -> None:
    """Scan parameters that the paper does not give against its original-noise rows.

    The noise of each column is scaled to the MSE that the paper prints, so that the SSIM depends
    only on image structure and dynamic range.

    A row of the table is a point of the scan: pixel scale in arcsec, r0 in metres (empty in scene
    1), noise level, dynamic range, and the mean SSIM of noisy stars to their noise-free images.

    Parameters
    ----------
    config : Config
        Settings of the simulation, noise and calibration.
    dataset : str
        A dataset that the paper tabulates.
    out : Path
        CSV with the SSIM over scale, r0 and dynamic range.
    """
    config.noise.require_poisson("the paper's rows are")
    limit_threads(1)  # batches run in parallel
    # Columns of the paper's tables with the original noise, before any method.
    rows = [row for row in read_original_noise() if row.dataset == dataset]
    r0_values = [float("nan")]
    if isinstance(config.wavefront, VonKarman):
        # The configured r0 is always scanned: its fit is compared with the configured scale.
        r0_values = sorted({*config.calibration.r0_m, config.wavefront.r0_m})
    table = []
    # Noisy stars of each pixel scale, whose SSIM is computed at all dynamic ranges.
    for r0 in steps("values of r0", r0_values):
        source = _source(config, r0)
        for scale in steps("pixel scales", config.calibration.pixel_scales_arcsec):
            # Noise-free, framed, normalised stars at this pixel scale. The search for the brightest
            # pixel covers the same angle as at the configured scale.
            telescope = config.telescope.model_copy(update={"pixel_scale_arcsec": scale})
            search_px = ceil(config.stars.search_px * config.telescope.pixel_scale_arcsec / scale)
            propagation = Propagation(source, telescope, config.optics, config.framing, search_px)
            images = normalise_flux(propagation.frame(config.framing.stamp_px)[0])[0]
            for row in rows:
                # Noise with the MSE that the paper prints for this column.
                noisy = _add_published_noise(images, row, config)
                ranges = config.calibration.data_ranges
                # SSIM of each star at each dynamic range, shape (range, star).
                similarity = np.atleast_2d(ssim(noisy, images, *ranges))
                key = config.scene.experiment, dataset, scale, r0, row.noise_level
                by_range = zip(ranges, similarity, strict=True)
                table += [(*key, data_range, values.mean()) for data_range, values in by_range]
    columns = ["experiment", "dataset", "pixel_scale_arcsec", "r0_m", "noise_level"]
    write_csv(out, pd.DataFrame(table, columns=[*columns, "data_range", "ssim"]))


class _CachedWavefronts:
    """Turbulent wavefronts whose OPD is computed once per grid, not once per pixel scale.

    A scan computes the same wavefronts at many pixel scales, on the same pupil grids.

    Parameters
    ----------
    source : WavefrontSource
        Wavefronts of the fields.
    """

    def __init__(self, source: WavefrontSource) -> None:
        self.source = source
        self.slopes = source.slopes
        self._opd: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        """Return the number of wavefronts."""
        return len(self.source)

    def opd(self, index: np.ndarray, pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        """Return the OPD of wavefronts as the source does; double precision is not cached.

        Only few stars need double precision.

        Parameters
        ----------
        index : ndarray of int, shape (n,)
            Numbers of the wavefronts.
        pupil : Pupil
            Pupil, on whose grid of N × N samples the OPD is computed.
        dtype : dtype
            float32 or float64.

        Returns
        -------
        ndarray, shape (n, N, N)
            In waves.
        """
        # Exact pixels of a few stars that compete for the maximum.
        if dtype != np.float32:
            return self.source.opd(index, pupil, dtype)
        if pupil.axis.size not in self._opd:
            all_wavefronts = np.arange(len(self))
            self._opd[pupil.axis.size] = self.source.opd(all_wavefronts, pupil, dtype)
        return np.asarray(self._opd[pupil.axis.size][index])


def _source(config: Config, r0: float) -> WavefrontSource:
    """Return wavefronts of the scanned stars, or of all fields behind turbulence of this r0.

    Parameters
    ----------
    config : Config
        Stage configuration of `scan`.
    r0 : float
        Fried parameter in metres; NaN in scene 1.
    """
    if not isinstance(config.wavefront, VonKarman):
        # Scene 1: stars at random fields, with aberrations of their own.
        count, fields = config.calibration.stars, config.grid.points**2
        return star_wavefronts(
            config, assign_fields(count, fields, stream(config.seed, "scan", "field"))
        )
    # Scene 2: one wavefront per field, behind turbulence of this strength.
    wavefront = config.wavefront.model_copy(update={"r0_m": r0})
    return _CachedWavefronts(
        template_wavefronts(config.model_copy(update={"wavefront": wavefront}))
    )


def _add_published_noise(images: np.ndarray, row: OriginalNoise, config: Config) -> np.ndarray:
    """Add noise to images, scaled to the MSE of a column of the paper.

    The noise of λ = `row.noise_level` has the variance (κλ)² plus the photon noise of the star.

    Parameters
    ----------
    images : ndarray, shape (n, d, d)
        Noise-free stars of sum 1.
    row : OriginalNoise
        The column of the paper: noise level λ and the MSE of its noisy stars.
    config : Config
        Its group `noise` has the photons B of the sky in a pixel.

    Returns
    -------
    ndarray, shape (n, d, d)
    """
    level, background = row.noise_level, config.noise.background_photons
    # The constant κ whose noise has the published MSE on these stars.
    kappa = solve_kappa(row.mse, level, images[0].size, background)
    rng = stream(config.seed, "noise", "scan", f"{level:.6g}")
    return NoiseModel(kappa, background).draw(images, level, rng)


@command("paper calibrate", reads=("seed", "noise", "evaluation"))
def calibrate(
    config: Config,
    scans: Annotated[tuple[File, ...], {"flag": "--scan"}],
    stars: tuple[tuple[str, File], ...],
    out: Folder,
) -> None:
    """Fit noise, dynamic range and pixel scales to the scans.

    The noise constant κ follows from the columns' MSE, whose logarithms have equal weights; one
    dynamic range and one pixel scale for each scene follow from the SSIM by least squares.

    There are four tables: fitted and configured values (fit.csv); each of the paper's columns with
    simulated noise (columns.csv); residuals by pixel scale (scales.csv); and fits with other r0
    (degeneracy.csv). The configuration itself is not changed.

    Parameters
    ----------
    config : Config
        Seed, noise and evaluation: the configured values.
    scans : sequence of Path
        CSV of the stage scan; repeat for more datasets.
    stars : sequence of pairs
        Dataset and its product of the stage stars.
    out : Path
        Folder for fit.csv, columns.csv and degeneracy.csv.
    """
    # Each of the paper's columns, and simulated stars with the configured parameters.
    products = dict(stars)
    values = _read_simulated_values(products)
    config.noise.require_poisson("the paper's rows are")
    limit_threads(config.evaluation.threads)
    scan_table = read_tables(scans)
    columns = pd.DataFrame(
        [_column(row, products[row.dataset], config) for row in read_original_noise()]
    )
    # A joint fit of both scenes for each r0 of scene 2; r0 of scene 1 is NaN.
    r0_column = scan_table.r0_m
    fit_by_r0 = {
        r0: fit_scales(scan_table[r0_column.isna() | (r0_column == r0)])
        for r0 in sorted(r0_column.dropna().unique())
    }
    fit = fit_by_r0[min(fit_by_r0, key=lambda r0: abs(r0 - values["r0_m"]))]
    # Least squares of log MSE: all columns have equal weight.
    fitted_columns = columns[columns.fitted]
    kappa = float(np.exp(np.log(fitted_columns.kappa).mean()))
    ssim_residual = fitted_columns.ssim_at_published_mse - fitted_columns.ssim_paper
    rms = float(np.sqrt((ssim_residual**2).mean()))
    # Fitted and configured values.
    table = [
        ("kappa", kappa, config.noise.kappa, "1"),
        ("data_range", fit.data_range, config.evaluation.data_range, "1"),
        ("pixel_scale_scene1", fit.pixel_scale["scene1"], values["scene1"], "arcsec"),
        ("pixel_scale_scene2", fit.pixel_scale["scene2"], values["scene2"], "arcsec"),
        ("r0_scene2", min(fit_by_r0, key=lambda r0: fit_by_r0[r0].rms), values["r0_m"], "m"),
        ("ssim_residual_rms", fit.rms, rms, "1"),
    ]
    # Different r0 with other pixel scales fit the paper's rows nearly as well.
    degeneracy = [
        (r0, r0_fit.pixel_scale["scene2"], r0_fit.data_range, r0_fit.rms)
        for r0, r0_fit in fit_by_r0.items()
    ]
    frames = {
        "fit.csv": pd.DataFrame(table, columns=["quantity", "fitted", "configured", "unit"]),
        "columns.csv": columns,
        "scales.csv": compute_scale_residuals(scan_table, config.evaluation.data_range),
        "degeneracy.csv": pd.DataFrame(
            degeneracy, columns=["r0_m", "pixel_scale_scene2_arcsec", "data_range", "rms"]
        ),
    }
    for name, frame in frames.items():
        write_csv(out / name, frame, 6)


def _read_simulated_values(stars: dict[str, Path]) -> dict[str, float]:
    """Return the pixel scales by scene and the r0 with which the stars were simulated.

    Stars of one scene must have the same static PSFs; raises ProductError.

    Parameters
    ----------
    stars : dict of Path
        Product "stars" of each dataset.

    Returns
    -------
    dict of float
        `scene1` and `scene2` in arcsec, `r0_m` in metres.
    """
    values: dict[str, float] = {}
    scenes: dict[str, Product] = {}
    for path in stars.values():
        product = read_product(path, "stars", ())
        config = product.config
        # Other products of a scene are compared with its first one.
        first = scenes.setdefault(config["scene"]["experiment"], product)
        require(path, config, STATIC, first.config, first.path)
        values[config["scene"]["experiment"]] = config["telescope"]["pixel_scale_arcsec"]
        if "r0_m" in config["wavefront"]:
            values["r0_m"] = config["wavefront"]["r0_m"]
    return values


def _column(row: OriginalNoise, path: Path, config: Config) -> dict[str, object]:
    """Return one original-noise column: published and simulated, at κλ and at its own MSE.

    Parameters
    ----------
    row : OriginalNoise
        Noise level, MSE and SSIM of the column in the paper.
    path : Path
        Product "stars" of its dataset.
    config : Config
        Stage configuration of `calibrate`.
    """
    # The same stars with the configured κ, and with the κ of this column alone.
    images = read_product(path, "stars", ("realisation",))["realisation"]
    background = config.noise.background_photons
    rng = stream(config.seed, "noise", "calibrate", row.dataset, f"{row.noise_level:.6g}")
    noise = NoiseModel(config.noise.kappa, background)
    # With the configured κ, as in the evaluation.
    noisy = noise.draw(images, row.noise_level, rng)
    noisy_at_published_mse = _add_published_noise(images, row, config)
    data_range, error = config.evaluation.data_range, mse(noisy, images).mean()
    return {
        "dataset": row.dataset,
        "noise_level": row.noise_level,
        "fitted": row.is_fitted,
        "kappa": solve_kappa(row.mse, row.noise_level, images[0].size, background),
        "mse_paper": row.mse,
        "mse": error,
        "mse_ratio": error / row.mse,
        "ssim_paper": row.ssim,
        "ssim_at_published_mse": ssim(noisy_at_published_mse, images, data_range).mean(),
        "ssim_at_kappa": ssim(noisy, images, data_range).mean(),
    }
