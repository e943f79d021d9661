"""Stage `prediction`: how fast `psfdae predict` is, and how good on stars of another package."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.belonging import STARS, require
from psfdae.files import ProductError, read_product, write_text
from psfdae.reading import read_table

if TYPE_CHECKING:
    import pandas as pd

    from psfdae.own_stars.prediction import Prediction

REQUIRED_SHARE = 0.6
"""Part of the bare network's throughput that a prediction must reach."""

ALLOWED_MB = 1000.0
"""Memory that it may take."""

ALLOWED_RATIO = 0.1
"""Relative difference of the MSE from that of the workflow's own stars that is allowed."""

REPEATS = 3
"""Timings at most; each takes as long as three predictions."""


def throughput(config: Any, stars: Path, bundle: Path, out: Path) -> None:
    """Time a prediction of `benchmark.star_counts[-1]` stamps, FITS to FITS.

    Nothing else should run on the machine meanwhile.

    Parameters
    ----------
    config : stage config `prediction`
    stars : product "stars" of the scene of the bundle
    bundle : model
    out : CSV, one row: stamps, stamp_px, threads, repeats, bare_shared_per_s,
        bare_parallel_per_s, bare_per_s (the faster one), predict_per_s, share,
        required_share, peak_mb, allowed_mb, met

    Raises
    ------
    ProductError
        If stars or bundle are not of the scene of the configuration.
    """
    import pandas as pd

    from psfdae.benchmark import prediction as benchmark
    from psfdae.benchmark.isolated import run_isolated

    require(stars, read_product(stars, "stars", ()).config, STARS, config)
    _require_bundle(bundle, config)
    settings, noise = config.benchmark, config.noise
    repeats = min(settings.repeats, REPEATS)
    with TemporaryDirectory() as folder:
        cube = str(Path(folder) / "stars.fits")
        run_isolated(
            benchmark.make_cube,
            1,
            stars=str(stars.resolve()),
            kappa=noise.kappa,
            background=noise.background_photons,
            levels=noise.levels,
            count=settings.star_counts[-1],
            seed=config.seed,
            out=cube,
        )
        measured = run_isolated(
            benchmark.time_prediction,
            settings.threads,
            cube=cube,
            bundle=str(bundle.resolve()),
            out=str(Path(folder) / "psf.fits"),
            repeats=repeats,
        )
    bare = max(measured["bare_shared_per_s"], measured["bare_parallel_per_s"])
    share, peak = measured["predict_per_s"] / bare, measured.pop("peak_mb")
    met = share >= REQUIRED_SHARE and peak < ALLOWED_MB
    row = {
        "stamps": int(measured.pop("stamps")),
        "stamp_px": config.framing.stamp_px,
        "threads": settings.threads,
        "repeats": repeats,
        **measured,
        "bare_per_s": bare,
        "share": share,
        "required_share": REQUIRED_SHARE,
        "peak_mb": peak,
        "allowed_mb": ALLOWED_MB,
        "met": "yes" if met else "no",
    }
    _write(out, pd.DataFrame([row]))


def poppy(config: Any, bundle: Path, evaluation: Path, count: int, out: Path) -> None:
    """Predict stars that POPPY has simulated, at the noise levels of the training.

    Once with flux and sky level given, as in the workflow's tables, and once with
    both estimated.

    Parameters
    ----------
    config : stage config `prediction`
    bundle : model of the dataset's network, split random, reference realisation
    evaluation : CSV of the stage `evaluate` for the same network
    count : number of stars
    out : CSV, a row per noise level: noise_level, snr, stars, mse_table, mse_given,
        stderr_given, ratio_given, mse_estimated, stderr_estimated, ratio_estimated
        (MSE of PSFs of flux 1), coverage_given, coverage_estimated (part of the
        pixels within the uncertainty), lost (stars without a usable flux, left out
        of the estimated columns), allowed_ratio, met

    Raises
    ------
    ProductError
        If the evaluation has no row of a noise level, or the bundle is of another scene.
    PoppyError
        As `psfdae.benchmark.poppy_stars.poppy_stars`.
    """
    import pandas as pd

    from psfdae.benchmark.poppy_stars import poppy_stars
    from psfdae.own_stars.model import load_model
    from psfdae.rng import stream
    from psfdae.stages.common import noise_model

    _require_bundle(bundle, config)
    table = read_table(evaluation)
    expected = {level: _table_mse(table, level, evaluation) for level in config.noise.levels}
    model, noise = load_model(bundle), noise_model(config)
    truth = poppy_stars(config, count)
    rows = []
    for level, mse in expected.items():
        rng = stream(config.seed, "poppy", "noise", f"{level:.6g}")
        flux = float(noise.flux(level))
        stamps = rng.poisson(flux * truth + noise.background).astype(np.float32)
        given = model.predict(stamps, flux=flux, background=noise.background, gain=1.0)
        estimated = model.predict(stamps, gain=1.0)
        snr = 1.0 / (noise.kappa * level * model.info.noise_equivalent_px**0.5)
        row: dict[str, Any] = {"noise_level": level, "snr": snr, "stars": count, "mse_table": mse}
        row |= _quality(given, truth, flux, mse, "given")
        row |= _quality(estimated, truth, flux, mse, "estimated")
        row["lost"] = int(np.isnan(estimated.psf).any(axis=(1, 2)).sum())
        row["allowed_ratio"] = ALLOWED_RATIO
        row["met"] = "yes" if abs(row["ratio_given"] - 1.0) <= ALLOWED_RATIO else "no"
        rows.append(row)
    _write(out, pd.DataFrame(rows))


def _require_bundle(bundle: Path, config: Any) -> None:
    """Refuse a bundle whose training stars are not of the configured scene."""
    from psfdae.own_stars.bundle import read_bundle

    trained_on = read_bundle(bundle).info.config.get("stars")
    if isinstance(trained_on, dict):
        require(bundle, trained_on, STARS, config)


def _quality(
    found: Prediction, truth: np.ndarray, flux: float, expected: float, which: str
) -> dict[str, float]:
    """Mean errors of PSFs of flux 1, and how many pixels are within the uncertainty."""
    kept = np.isfinite(found.psf).all(axis=(1, 2))
    psf, error = found.psf[kept], found.uncertainty[kept]
    squares = np.square(psf / found.flux[kept, None, None] - truth[kept]).mean(axis=(1, 2))
    inside = np.abs(psf - flux * truth[kept]) <= error
    mse = float(squares.mean())
    return {
        f"mse_{which}": mse,
        f"stderr_{which}": float(squares.std(ddof=1) / squares.size**0.5),
        f"ratio_{which}": mse / expected,
        f"coverage_{which}": float(inside.mean()),
    }


def _table_mse(table: pd.DataFrame, level: float, path: Path) -> float:
    """MSE of the DAE in a table of the stage `evaluate`."""
    wanted = (table["method"] == "dae") & (table["metric"] == "mse")
    values = table.loc[wanted & np.isclose(table["noise_level"], level), "value"]
    if len(values) != 1:
        raise ProductError(f"{path}: {len(values)} rows with the DAE's MSE at λ = {level:g}")
    return float(values.iloc[0])


def _write(out: Path, table: pd.DataFrame) -> None:
    write_text(out, table.to_csv(index=False, float_format="%.6g"))
