"""The fit of what the paper leaves open."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from psfdae_paper.evaluation import calibration
from psfdae_paper.evaluation.calibration import (
    compute_scale_residuals,
    fit_scales,
    read_original_noise,
    solve_kappa,
)


def model(level, scale, data_range):
    """A smooth stand-in for the SSIM of noisy stamps."""
    return 1.0 / (1.0 + 30.0 * level / data_range * (0.5 + scale))


@pytest.fixture
def scan(monkeypatch):
    """A scan of what SSIM values that range 0.7 and scales 0.11 and 0.16 explain."""
    columns = [
        row._replace(ssim=model(row.noise_level, 0.16 if row.dataset == "dataset8" else 0.11, 0.7))
        for row in read_original_noise()
    ]
    monkeypatch.setattr(calibration, "read_original_noise", lambda: columns)
    grid = [
        {
            "experiment": "scene2" if row.dataset == "dataset8" else "scene1",
            "dataset": row.dataset,
            "pixel_scale_arcsec": scale,
            "r0_m": 0.2 if row.dataset == "dataset8" else np.nan,
            "noise_level": row.noise_level,
            "data_range": data_range,
            "ssim": model(row.noise_level, scale, data_range),
        }
        for row in columns
        for scale in (0.06, 0.08, 0.1, 0.12, 0.15, 0.2)
        for data_range in (0.5, 0.6, 0.7, 0.85, 1.0)
    ]
    return pd.DataFrame(grid)


def test_kappa_of_the_noise_model_s_own_error(noise, gaussian_stars):
    level = 3e-5
    expected = noise.variance(gaussian_stars, level).mean()
    assert solve_kappa(expected, level, 256, noise.background) == pytest.approx(4.98, rel=1e-6)


def test_fit_recovers_range_and_scales(scan):
    fit = fit_scales(scan)
    assert fit.rms < 1e-3
    # Range and scale act alike on these rows; their combined effect is what is fixed.
    for experiment, scale in (("scene1", 0.11), ("scene2", 0.16)):
        effect = (0.5 + fit.pixel_scale[experiment]) / fit.data_range
        assert effect == pytest.approx((0.5 + scale) / 0.7, rel=5e-3)


def test_best_scanned_scale_has_the_smallest_residual(scan):
    table = compute_scale_residuals(scan, 0.7)
    least_rms = table.loc[table.groupby("experiment").rms.idxmin()].set_index("experiment")
    assert least_rms.pixel_scale_arcsec["scene1"] in (0.1, 0.12)
    assert least_rms.pixel_scale_arcsec["scene2"] == 0.15
