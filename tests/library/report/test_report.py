"""Statements on a model of one's own: beside one mean PSF, on its page, and as advice."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table

from psfdae.image import selection_advice as advice
from psfdae.image.stamps import cut
from psfdae.image.star_criteria import misfit
from psfdae.report.checks import (
    MEAN_PSF,
    check_held_out,
    check_stars,
    comparison_sentence,
    fit_mean_psf,
    mse_ratios,
)

SIDE = 16


def gaussians(x, y, sigma=1.6, side=32):
    """Stars of flux 1, centre at index (side//2, side//2) plus (x, y), shape (n, side, side)."""
    axis = np.arange(side) - side // 2
    x, y, sigma = (np.broadcast_to(v, np.shape(x))[:, None, None] for v in (x, y, sigma))
    return np.exp(-0.5 * ((axis - x) ** 2 + (axis[:, None] - y) ** 2) / sigma**2) / (
        2 * np.pi * sigma**2
    )


# One mean PSF


def test_one_psf_is_all_that_is_needed_where_all_are_alike():
    """Its error is that of its centre, which has the Cramér-Rao bound's; bright stars have none."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1.5, 1.5, (2, 200))
    mean, truth = gaussians(np.zeros(1), np.zeros(1))[0], cut(gaussians(x, y), SIDE)
    truth /= truth.sum(axis=(1, 2), keepdims=True)
    assert np.square(fit_mean_psf(truth, mean, 2.0) - truth).mean() < 1e-9
    noise = 2e-3
    error = fit_mean_psf(truth + noise * rng.normal(size=truth.shape), mean, 2.0) - truth
    # Two parameters, σ² of each noise² / Σ(∂p/∂x)²: 2 noise² in all pixels together.
    assert np.square(error).sum() / 200 == pytest.approx(2 * noise**2, rel=0.2)


# The sentence


def errors(model, mean=(4e-6, 4e-6), linear=(5e-6, 2e-6), stars=40):
    """A table as report.csv, at S/N 10 and 50."""
    rows = {"gmm": model, MEAN_PSF: mean, "lmmse": linear}
    table = [
        {"snr": snr, "method": name, "mse": mse, "mse_stderr": 0.1 * mse}
        for name, values in rows.items()
        for snr, mse in zip((10.0, 50.0), values, strict=True)
    ]
    return Table([row | {"images": 300, "stars": stars, "truth_mse": 1e-7} for row in table])


def test_standing_says_where_a_model_is_worse():
    good, poor = errors((2e-6, 1e-6)), errors((2e-6, 4.4e-6))
    assert mse_ratios(good, "gmm", MEAN_PSF) == {10.0: 0.5, 50.0: 0.25}
    sentence = comparison_sentence(good, "gmm", "mixture")
    assert "0.50 times the MSE of one mean PSF" in sentence
    assert "0.40 times the MSE of linear MMSE" in sentence and "40 stars held out" in sentence
    assert "no better than the mean PSF at S/N 50 (" in comparison_sentence(poor, "gmm", "mixture")
    assert "linear" not in comparison_sentence(good[good["method"] != "lmmse"], "gmm", "mixture")


# The page


def photometry(flux=(0.68, 0.68), centre=(0.68, 0.68)):
    """A table as found.csv, at S/N 10 and 50."""
    columns = {"snr": [10.0, 50.0], "lost": [0.0, 0.0], "flux_bias": [0.01, 0.0]}
    columns |= {"flux_bias_stderr": [0.01] * 2, "flux_pull": [1.0] * 2, "centre_rms_px": [0.1] * 2}
    for name, part in (("flux", flux), ("centre", centre), ("psf", (0.68, 0.68))):
        columns |= {f"{name}_within": part, f"{name}_within_stderr": [0.02, 0.02]}
    return Table(columns)


def checks(**changed):
    """Checks of a good model, but for what is changed."""
    truth = cut(gaussians(*np.random.default_rng(2).uniform(-0.5, 0.5, (2, 40))), SIDE)
    images = {"truth": truth, "model": truth, MEAN_PSF: truth[::-1]}
    stars = {"snr": np.geomspace(5, 700, 60), "chi2": np.ones(60), "flags": np.zeros(60, int)}
    stars["part"] = np.where(np.arange(60) % 5 == 4, "held out", "training")
    measured = {"errors": errors((2e-6, 1e-6)), "photometry": photometry()}
    measured |= {"coverage": {10.0: 0.68}, "denoised_images": {10.0: images, 50.0: images}}
    return check_stars(stars) + check_held_out("gmm", **measured | changed)


@pytest.mark.parametrize(
    ("wrong", "check"),
    [
        ({"errors": errors((2e-6, 5e-6), linear=(5e-6, 6e-6))}, "Better than one mean PSF?"),
        ({"errors": errors((2e-6, 3e-6))}, "Better than linear MMSE?"),
        ({"coverage": {10.0: 0.4}}, "Are 68 % of pixel errors within ± UNCERT?"),
        (
            {"photometry": photometry(flux=(0.68, 0.5))},
            "Are 68 % of flux errors within ± σ?",
        ),
        (
            {"photometry": photometry(centre=(0.9, 0.68))},
            "Are 68 % of centre errors within ± σ?",
        ),
        ({"errors": errors((2e-6, 1e-6), stars=5)}, "Stars held out"),
    ],
)
def test_what_is_wrong_is_marked(wrong, check):
    assert all(good for *_, good in checks())
    assert [question for question, _, good in checks(**wrong) if not good] == [check]


# Stars that are not good


@pytest.fixture(scope="module")
def stars():
    """Stars whose width varies over the field, and where they stand."""
    rng = np.random.default_rng(3)
    place = rng.uniform(0, 1000, (120, 2))
    images = gaussians(*rng.normal(0, 0.03, (2, 120)), sigma=1.6 + place[:, 0] / 5000)
    return cut(images + rng.normal(0, 1e-4, images.shape), SIDE), place


def flat(star):
    return np.minimum(star, 0.6 * star.max())


def ring(star):
    return np.where(star > 0.6 * star.max(), 0.3 * star.max(), star)


@pytest.mark.parametrize("spoil", [flat, ring])
def test_cores_that_are_flat_or_hollow_do_not_fit(stars, spoil):
    images, place = stars
    spoilt = images.copy()
    spoilt[::20] = [spoil(star) for star in images[::20]]
    spoilt /= spoilt.sum(axis=(1, 2), keepdims=True)
    score = misfit(spoilt, place, np.full(120, 1e-4))
    assert (score[::20] > 2.5).all()
    assert (misfit(images, place, np.full(120, 1e-4)) > 2.5).mean() < 0.02


# Advice


def test_photons_of_the_sky_give_the_gain():
    stars = SimpleNamespace(sky=np.full(9, 300.0), noise=np.full(9, np.sqrt(300 / 1.6)))
    assert "gain=1.6 is right" in advice.gain_advice(stars)
