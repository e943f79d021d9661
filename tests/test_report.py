"""What is said of a model of one's own: beside one mean PSF, on its page, and as advice."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table

from psfdae.commands.predict import Stated
from psfdae.image import selection as advice
from psfdae.image.selection import Verdict, misfit, piled_up
from psfdae.image.stamps import StarFlag, cut
from psfdae.model.report import (
    MEAN_PSF,
    Quality,
    checks,
    errors_figure,
    fitted_mean,
    quality_page,
    ratios,
    standing,
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
    assert np.square(fitted_mean(truth, mean, 2.0) - truth).mean() < 1e-9
    noise = 2e-3
    error = fitted_mean(truth + noise * rng.normal(size=truth.shape), mean, 2.0) - truth
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
    assert ratios(good, "gmm", MEAN_PSF) == {10.0: 0.5, 50.0: 0.25}
    sentence = standing(good, "gmm", "mixture")
    assert "0.50 times that of one mean PSF" in sentence
    assert "0.40 times that of linear MMSE" in sentence and "40 stars held out" in sentence
    assert "no better than the mean PSF at S/N 50 (" in standing(poor, "gmm", "mixture")
    assert "linear" not in standing(good[good["method"] != "lmmse"], "gmm", "mixture")


# The page


def found(flux=(0.68, 0.68), centre=(0.68, 0.68)):
    """A table as found.csv, at S/N 10 and 50."""
    columns = {"snr": [10.0, 50.0], "lost": [0.0, 0.0], "flux_bias": [0.01, 0.0]}
    columns |= {"flux_bias_stderr": [0.01] * 2, "flux_pull": [1.0] * 2, "centre_rms_px": [0.1] * 2}
    for name, part in (("flux", flux), ("centre", centre), ("psf", (0.68, 0.68))):
        columns |= {f"{name}_within": part, f"{name}_within_stderr": [0.02, 0.02]}
    return Table(columns)


def quality(count=60, name="a <b> & c", field=None, **more):
    rng = np.random.default_rng(2)
    truth = cut(gaussians(*rng.uniform(-0.5, 0.5, (2, 40))), SIDE)
    faint = {
        snr: {
            "truth": truth,
            "model": truth + 1e-4 / snr * rng.normal(size=truth.shape),
            MEAN_PSF: truth[::-1],
        }
        for snr in (10.0, 50.0)
    }
    stars = {key: rng.uniform(1, 700, count) for key in ("x", "y", "snr", "flux")}
    stars |= {"fwhm_px": rng.normal(3.7, 0.1, count), "ellipticity": rng.uniform(0, 0.2, count)}
    stars |= {"chi2": rng.chisquare(256, count) / 256, "flags": np.zeros(count, int)}
    stars["flags"][:3] = StarFlag.BLENDED
    stars["verdict"] = np.where(np.arange(count) < 3, Verdict.BLENDED, Verdict.GOOD)
    stars["part"] = np.where(np.arange(count) % 5 == 4, "held out", "training")
    given = {
        "name": name, "image": "image.fits", "method": "gmm", "label": "mixture",
        "notes": ["image.fits: gain 2\nstars.csv: no position in row 7"],
        "errors": errors((2e-6, 1e-6)), "found": found(),
        "degraded": {key: rng.uniform(1, 700, 40) for key in ("x", "y", "flux")},
        "coverage": {10.0: 0.68}, "faint": faint, "stars": stars,
        "residual": rng.normal(size=(4, SIDE, SIDE)), "bright": truth[:4], "strip": b"png",
    }  # fmt: skip
    return Quality(**{**given, "field": field, **more})


def test_page_is_one_file_in_the_order_in_which_it_is_read():
    page = quality_page(quality(field=errors_figure(quality())))
    tags = re.findall(r"<(/?)(\w+)", page)
    for name in {name for _, name in tags} - {"img", "meta"}:
        assert tags.count(("", name)) == tags.count(("/", name)), name
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(links) == 7
    assert all(link.startswith("data:image/png;base64,") for link in links)
    words = re.sub("<style.*?</style>|<.*?>", " ", page, flags=re.S)
    order = [
        *("a &lt;b&gt; &amp; c", "0.50 times", "Better than one mean PSF?", "Errors on stars"),
        *("over the field", "Residuals", "magnitude and place", "χ²", "Stars left out"),
        *("blended", "BLENDED", "no position in row 7"),
    ]
    places = [words.index(text) for text in order]
    assert places[:4] == sorted(places[:4]) and places[4:7] == sorted(places[4:7])
    assert "no positions" in quality_page(quality())


@pytest.mark.parametrize(
    ("wrong", "check"),
    [
        ({"errors": errors((2e-6, 5e-6), linear=(5e-6, 6e-6))}, "Better than one mean PSF?"),
        ({"errors": errors((2e-6, 3e-6))}, "Better than linear MMSE?"),
        ({"coverage": {10.0: 0.4}}, "Does ± UNCERT hold 68 % of the errors?"),
        ({"found": found(flux=(0.68, 0.5))}, "Do errors of the flux hold 68 %?"),
        ({"found": found(centre=(0.9, 0.68))}, "Do errors of the centre hold 68 %?"),
        ({"errors": errors((2e-6, 1e-6), stars=5)}, "Stars held out"),
    ],
)
def test_what_is_wrong_is_marked(wrong, check):
    assert all(good for *_, good in checks(quality()))
    assert [question for question, _, good in checks(quality(**wrong)) if not good] == [check]


def test_centres_that_a_method_does_not_measure_are_no_check():
    questions = [question for question, *_ in checks(quality(found=found(centre=(np.nan,) * 2)))]
    assert len(questions) == len(checks(quality())) - 1
    assert not any("centre" in question for question in questions)


def test_faint_stars_that_come_out_too_wide_are_marked():
    q = quality()
    q.faint[10.0]["model"] = cut(gaussians(*np.zeros((2, 40)), sigma=1.7), SIDE)
    assert [question[:4] for question, _, good in checks(q) if not good] == ["Size"]


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


def double(star):
    return star + 0.2 * np.roll(star, (1, 2), axis=(0, 1))


@pytest.mark.parametrize("spoil", [flat, ring, double])
def test_cores_that_are_flat_or_hollow_and_blends_do_not_fit(stars, spoil):
    images, place = stars
    spoilt = images.copy()
    spoilt[::20] = [spoil(star) for star in images[::20]]
    spoilt /= spoilt.sum(axis=(1, 2), keepdims=True)
    score = misfit(spoilt, place, np.full(120, 1e-4))
    assert (score[::20] > 2.5).all()
    assert (misfit(images, place, np.full(120, 1e-4)) > 2.5).mean() < 0.02


# Advice


def exposed(flux, full=np.inf, sky=200.0, noise=10.0):
    """Columns of `Candidates` of stars of so much flux, cut off at `full` counts."""
    peak = flux / (2 * np.pi * 1.6**2)
    lost = np.maximum(peak + sky - full, 0.0)
    count = np.full(len(flux), 1.0)
    return SimpleNamespace(
        brightest=np.minimum(peak + sky, full),
        highest=np.minimum(peak + sky, full),
        sky=sky * count,
        noise=noise * count,
        snr=(flux - 3 * lost) / (3.54 * 1.6) / noise,
    )


def test_stars_that_are_cut_off_at_one_level_give_it_away():
    flux = 1e5 / np.random.default_rng(4).uniform(0.005, 1, 300)
    clipped, whole = exposed(flux, 30_000.0), exposed(flux)
    assert piled_up(clipped.brightest, clipped.sky, clipped.snr * clipped.noise) == 30_000
    assert "--saturate 30000" in advice.saturation_advice(clipped)
    # Stars of one brightness have one brightest pixel, and no pedestal makes it agree.
    for stars in (whole, exposed(np.full(300, 1e6)), exposed(flux, sky=1e6)):
        assert "none is seen" in advice.saturation_advice(stars)


def test_photons_of_the_sky_give_the_gain():
    found = exposed(np.full(9, 1e4), sky=300.0, noise=np.sqrt(300 / 1.6))
    assert "--gain 1.6 is right" in advice.gain_advice(found)
    assert "probably subtracted" in advice.gain_advice(exposed(np.full(9, 1e4), sky=1.0))


@pytest.mark.parametrize(("sigma", "needed"), [(0.8, 8), (2.4, None), (4.0, 22)])
def test_stamps_are_to_hold_a_star_and_no_other(sigma, needed):
    wide = gaussians(np.zeros(30), np.zeros(30), sigma=sigma)
    place = np.stack([30.0 * np.arange(30), np.zeros(30)], axis=1)
    place[1::2, 0] -= 23.0
    found = SimpleNamespace(bright=SimpleNamespace(aligned=lambda: wide), position=place)
    said = advice.stamp_advice(found, SIDE)
    if needed is None:
        assert said is None
    else:
        assert f"framing.stamp_px={needed} is worth a trial" in said
        assert f"100 % of 16 px, {0 if needed < 14 else 100} % of {needed} px" in said
    assert advice.overlapping(np.array([[1.0, 1.0], [np.nan, 1.0]]), 8) == 0


# What to do next


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"detect": True, "threshold": 20.0}, "--detect --threshold 20.0"),
        ({"pixel_scale": 1.2, "extension": 2}, "--pixel-scale 1.2 --extension 2"),
        ({"catalogue": "stars.csv"}, "--catalogue stars.csv"),
        ({}, ""),
    ],
)
def test_options_come_back_as_they_were_typed(options, words):
    assert " ".join(Stated(**options).words()) == words
