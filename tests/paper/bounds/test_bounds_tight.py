"""When a posterior mean over samples counts as the exact one, and stars that have none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from psfdae_paper.bounds.estimates import BoundedStars, Estimates
from psfdae_paper.bounds.tables import Tables
from psfdae_paper.bounds.tight import Evidence, calibration
from psfdae_paper.stages import bounds

STARS, PIXELS = 400, 16
FIELD = np.arange(STARS) % 40
SURE = Evidence(ess_low=10.0, calibration=-2.0, last_change=0.05, undetected=-0.05)


def gaussian(assumed=1.0):
    """Errors and posterior variances of pixels N(0, 1) under noise N(0, 0.5²).

    The mean is that of a noise variance that is `assumed` times the true one.
    """
    rng = np.random.default_rng(3)
    truth = rng.standard_normal((STARS, PIXELS))
    noisy = truth + 0.5 * rng.standard_normal((STARS, PIXELS))
    noise = 0.25 * assumed
    error = ((noisy / (1.0 + noise) - truth) ** 2).mean(axis=1)
    return error, np.full(STARS, noise / (1.0 + noise))


def test_the_error_of_an_exact_posterior_mean_is_its_variance():
    error, variance = gaussian()
    assert error.mean() == pytest.approx(0.2, rel=0.05)
    assert abs(calibration(error, variance, FIELD)) < 2


@pytest.mark.parametrize(("assumed", "sign"), [(0.5, 1), (2.0, -1)])
def test_too_sure_and_too_unsure_are_both_seen(assumed, sign):
    """The variance is 0.11 with half the noise, and the error larger; 0.33 with twice the noise."""
    score = calibration(*gaussian(assumed), FIELD)
    assert sign * score > 10
    assert SURE.tight
    assert not replace(SURE, calibration=score).tight


def test_variances_that_are_the_errors_need_no_standard_error():
    errors = np.ones(STARS)
    assert calibration(errors, errors, FIELD) == 0.0
    assert calibration(2 * errors, errors, FIELD) == np.inf


@pytest.mark.parametrize(
    "but", [{"ess_low": 9.9}, {"last_change": 0.06}, {"undetected": 0.06}, {"undetected": -0.06}]
)
def test_every_part_of_the_evidence_is_needed(but):
    assert not replace(SURE, **but).tight


@pytest.mark.parametrize(("thin", "missing", "low"), [(4, 0, 300), (5, 0, 3), (2, 3, 3), (0, 5, 0)])
def test_one_in_a_hundred_may_have_few_samples_or_none(thin, missing, low):
    mse, variance = gaussian()
    ess = np.full(STARS, 300.0)
    ess[:thin] = 3.0
    mse[10 : 10 + missing] = np.nan
    evidence = Evidence.from_errors(mse, variance, ess, FIELD, last_change=0.0, undetected=0.0)
    assert evidence.ess_low == low
    assert evidence.tight == (low >= 10)


def measured(mse, ess=300.0):
    """Calibrated rows of `measure_posteriors`: errors, variances, effective sample sizes."""
    return np.stack([mse, mse, mse, mse, np.full(STARS, ess)])


def estimates(mse, helped):
    return Estimates(measured(mse), measured(mse), measured(helped))


def test_a_mode_undetected_with_the_field_given_is_not_tight():
    """One star of 400 whose mode only the truth leads to: a fifth of the error."""
    exact = gaussian()[0]
    without_mode = exact.copy()
    without_mode[7] += 0.25 * exact.sum()
    assert estimates(exact, exact).evidence(0, FIELD).tight
    evidence = estimates(without_mode, exact).evidence(0, FIELD)
    assert evidence.undetected == pytest.approx(0.2)
    assert not evidence.tight


def table_of(estimated):
    truth = {name: np.zeros((STARS, 4, 4)) for name in ("realisation", "template")}
    stars = BoundedStars(np.arange(1000, 1000 + STARS), FIELD, truth, {})
    tables = Tables("dataset1", stars)
    tables.add_mean("bayes", 1e-3, estimated, "samples", draws=400, sampled=STARS)
    return tables


def compared(tables, folder, errors):
    """Table of the efficiency of a made-up method with these errors."""
    pd.DataFrame(tables.summary, columns=Tables.summary_columns).to_csv(folder / "b.csv")
    per_star = pd.concat(tables.per_star, ignore_index=True)
    per_star.to_parquet(folder / "b.parquet")
    per_star.assign(method="dae", mse=np.tile(errors, 2)).to_parquet(folder / "e.parquet")
    out = folder / "efficiency.csv"
    bounds.efficiency([folder / "b.csv"], [folder / "b.parquet"], out, [folder / "e.parquet"])
    return pd.read_csv(out)


def test_a_star_without_possible_samples_is_named_and_the_others_bounded(tmp_path):
    mse = gaussian()[0]
    errors = 2 * mse
    mse[[5, 50]], errors[[5, 50]] = np.nan, 1e6
    tables = table_of(estimates(mse, mse))
    finite = mse[np.isfinite(mse)]
    for row in tables.summary:
        assert (row["n"], row["missing"], row["missing_stars"]) == (STARS - 2, 2, "1005 1050")
        assert row["value"] == row["variance"] == pytest.approx(finite.mean())
        assert row["median"] == pytest.approx(np.median(finite))
        assert row["tight"] == "yes"
    for row in compared(tables, tmp_path, errors).itertuples():
        assert row.n == STARS - 2
        assert row.mse == pytest.approx(2 * finite.mean(), rel=1e-5)
        assert row.efficiency == pytest.approx(0.5, rel=1e-5)


def test_no_efficiency_where_over_one_in_a_hundred_is_missing(tmp_path):
    mse = gaussian()[0]
    mse[:5] = np.nan
    tables = table_of(estimates(mse, mse))
    assert {row["tight"] for row in tables.summary} == {"no"}
    for row in tables.summary:
        row["tight"] = "yes"  # whatever the table says
    table = compared(tables, tmp_path, np.ones(STARS))
    assert table.efficiency.isna().all()
    assert table.verdict.isna().all()
    assert set(table.n) == {STARS - 5}


def test_a_star_comes_from_the_bank_or_from_its_own_samples():
    """Wherever the bank has too few, and never fewer than it has."""
    bank = Estimates(*(measured(np.full(STARS, 1.0), ess=20.0) for _ in range(3)))
    assert bank.replace_sparse(np.zeros(0, int), None) == (bank, 0)
    sparse = np.array([3, 9, 11])
    rows = np.full((5, 3), 2.0)
    rows[-1] = [300.0, 5.0, 60.0]
    bank.full[-1, 11] = 55.0
    improved, replaced = bank.replace_sparse(sparse, Estimates(rows, rows, rows))
    assert replaced == 1
    assert np.flatnonzero(improved.full[0] == 2.0).tolist() == [3]
    assert improved.full[-1, [3, 9, 11]].tolist() == [300.0, 20.0, 55.0]
