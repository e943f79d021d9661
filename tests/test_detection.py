"""Stars found without a list, what cameras say of themselves, maps of noise, bits of masks."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from astropy.io import fits
from astropy.table import Table
from scipy.spatial import cKDTree

from command_line import psfdae, refused
from psfdae.image.detection import Sky
from psfdae.image.fits_file import find_image
from psfdae.image.observation import SEEN, Source
from psfdae.image.selection import collect
from psfdae.model.bundle import read_bundle
from psfdae.model.settings import from_words
from psfdae_paper.stages import simulate

REAL = Path(os.environ.get("PSFDAE_REAL_IMAGE", "hatp32.fits"))
"""A real image that is not ours to distribute; the list of its stars lies beside it."""
TINY = ["preset=smoke", "parts.train_stars=120", "parts.test_stars=30", "train.epochs=1"]
TINY += ["methods=[noisy,lmmse,gmm]"]


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """A simulated image without a card about anything, its list, and the truth."""
    folder = tmp_path_factory.mktemp("detect")
    full, catalogue = folder / "full.fits", folder / "stars.csv"
    made = simulate.write_example(
        full, catalogue, seed=5, side_px=700, bright=60, faint=80, blended=6, saturated=3
    )
    write(folder / "image.fits", fits.getdata(full))
    return folder, made


def write(path, pixels, **cards):
    header = fits.Header()
    header.update({key.replace("_", " "): value for key, value in cards.items()})
    fits.writeto(path, np.asarray(pixels, dtype=np.float32), header, overwrite=True)
    return path


def pixels(field):
    return fits.getdata(field[0] / "image.fits")


def opened(path, **stated):
    return Source(path, **stated).open(16, 8)


# Finding


def test_stars_are_found_where_they_are(field):
    folder, made = field
    found = opened(folder / "image.fits", detect=5.0)
    distance, _ = cKDTree(found.positions).query(made.centroid)
    assert (distance[made.kind != "faint"] < 2).all()
    assert np.median(distance[made.kind == "bright"]) < 0.3
    faint = made.kind == "faint"
    assert (distance[faint] < 2).mean() > 0.6
    # Nothing but stars and their companions: noise alone has none.
    spurious, _ = cKDTree(made.centroid).query(found.positions)
    assert (spurious > 8).sum() <= 1
    level = found.found.numbers("BACKGROUND")
    assert level == pytest.approx(300 / 1.6, rel=0.08)


def test_a_star_without_noise_is_found_exactly_and_nothing_is_named_twice():
    """Smoothing moves no star, and in white noise it leaves `SMOOTHED_NOISE` of it."""
    place = np.array([[40.3, 51.8], [90.0, 30.4], [70.7, 100.1]])
    y, x = np.indices((140, 130))
    light = [np.exp(-0.5 * ((x - a) ** 2 + (y - b) ** 2) / 1.5**2) for a, b in place]
    shape, rng = x.shape, np.random.default_rng(1)
    nothing = np.zeros(shape, bool)
    sky = Sky(1e3 * np.sum(light, axis=0), np.full(shape, 7.0), np.ones(shape), nothing, np.nan)
    found = sky.stars(5.0)
    seen = np.stack([found["X_IMAGE"], found["Y_IMAGE"]], axis=1) - 1
    distance, star = cKDTree(seen).query(place)
    assert len(seen) == 3 and sorted(star) == [0, 1, 2] and (distance < 0.02).all()
    assert sorted(found["id"]) == [1, 2, 3]
    assert (found["BACKGROUND"] == 7.0).all()
    assert found["FLUX_ISO"] == pytest.approx(np.full(3, 1e3 * 2 * np.pi * 1.5**2), rel=0.02)
    smooth, limit = replace(sky, flat=rng.normal(size=shape))._above(2.0)
    assert smooth.std() == pytest.approx(limit[0, 0] / 2.0, rel=0.05)


def test_commands_need_no_list_and_no_card(field, tmp_path):
    image, model = field[0] / "image.fits", tmp_path / "model"
    words = [image, "--detect"]
    first = psfdae("from-stars", *words, "--out", model, *TINY)
    assert first.exit_code == 0, first.output
    said = (
        "pixel scale 1 arcsec (assumed), gain not known, read noise not known, saturation not known"
    )
    assert f"image.fits: {said}\n" in first.output
    bundle = model / "image.psf.safetensors"
    assert read_bundle(bundle).info.scale_assumed
    assert "px of 1 arcsec, assumed" in psfdae("describe", bundle).output
    out = tmp_path / "psf.fits"
    second = psfdae("predict", *words, "--model", bundle, "--out", out)
    assert second.exit_code == 0, second.output
    assert said in second.output
    table, listed = Table.read(out, hdu="STARS"), Table.read(tmp_path / "psf_stars.csv")
    assert (model / "stars.csv").read_bytes() == (tmp_path / "psf_stars.csv").read_bytes()
    assert table["x"] == pytest.approx(listed["X_IMAGE"] - 1)
    assert fits.getheader(out)["PIXSCALE"] == 1.0
    # The list is one as any other, and what is there is not replaced unasked.
    again = ["--model", bundle, "--out", tmp_path / "again.fits"]
    given = psfdae("predict", image, "--catalogue", tmp_path / "psf_stars.csv", *again)
    assert given.exit_code == 0, given.output
    assert (Table.read(tmp_path / "again.fits", hdu="STARS")["flux"] == table["flux"]).all()
    out.unlink()
    said = refused("predict", *words, "--model", bundle, "--out", out)
    assert "psf_stars.csv: exists already" in said
    # Scales that are known differ, or are needed.
    known = [*words, "--out", tmp_path / "none.fits"]
    said = refused("predict", *known, "--model", bundle, "--pixel-scale", 1.2)
    assert "pixels of 1.2 arcsec" in said and "trained on 1 arcsec, assumed" in said
    assert "--pixel-scale" in refused("predict", *known)
    assert not list(tmp_path.glob("none*"))


@pytest.mark.skipif(not REAL.is_file(), reason="the real image is not here")
def test_stars_of_a_real_image():
    found = opened(REAL, detect=5.0)
    listed = Table.read(REAL.with_name("hatp32_stars.csv"))
    place = np.stack([listed["X_IMAGE"], listed["Y_IMAGE"]], axis=1) - 1
    distance, _ = cKDTree(found.positions).query(place)
    assert (distance < 2).mean() > 0.95
    assert found.camera["pixel scale"] == (5.21, "IM_SCALE")


# Cameras


@pytest.mark.parametrize(
    ("cards", "name", "said"),
    [
        ({"EGAIN": 1.5, "GAIN": 139}, "gain", (1.5, "EGAIN")),
        ({"GAIN": "2.1 "}, "gain", (2.1, "GAIN")),
        ({"GAIN": 0}, "gain", (None, "not known")),
        ({"BUNIT": "electron", "GAIN": 2.0}, "gain", (1.0, "BUNIT")),
        ({"HIERARCH_ESO_DET_OUT1_CONAD": 0.6}, "gain", (0.6, "ESO DET OUT1 CONAD")),
        ({"READNOIS": 4.5}, "read noise", (4.5, "READNOIS")),
        ({"SATLEVEL": 5e4}, "saturation", (5e4, "SATLEVEL")),
        ({"SECPIX1": 0.4}, "pixel scale", (0.4, "SECPIX1")),
        ({"XPIXSZ": 9.0, "FOCALLEN": 1000.0}, "pixel scale", (1.856, "XPIXSZ and FOCALLEN")),
    ],
)
def test_what_headers_say_and_who_says_it(field, tmp_path, cards, name, said):
    image = write(tmp_path / "image.fits", pixels(field)[:200, :200], **cards)
    value, origin = opened(image, detect=5.0).camera[name]
    assert origin == said[1]
    assert value == (said[0] and pytest.approx(said[0], rel=1e-3))


def test_what_is_given_goes_before_the_header(field, tmp_path):
    cards = {"GAIN": 2.0, "RDNOISE": 5.0, "SATURATE": 6e4, "PIXSCALE": 1.2}
    image = write(tmp_path / "image.fits", pixels(field)[:200, :200], **cards)
    seen = opened(image, detect=5.0)
    assert seen.said().endswith(
        "pixel scale 1.2 arcsec (PIXSCALE), gain 2 electrons per count (GAIN), "
        "read noise 5 electrons (RDNOISE), saturation 60000 counts (SATURATE)"
    )
    assert seen.least_noise == 2.5
    given = {"gain": 4.0, "read_noise": 2.0, "saturate": 5e4, "pixel_scale_arcsec": 0.7}
    other = opened(image, detect=5.0, **given)
    assert other.said().count("(given)") == 4
    assert (other.gain, other.saturate, other.pixel_scale_arcsec) == (4.0, 5e4, 0.7)
    assert other.least_noise == 0.5


def test_whole_counts_without_scatter_have_the_read_noise(field, tmp_path):
    """Half of the sky's pixels are one number: its median deviation is 0."""
    config = from_words(["dataset=from_stars", *TINY])
    coarse = np.round(pixels(field) / 60.0) * 60.0
    image = write(tmp_path / "image.fits", coarse, GAIN=1.0, RDNOISE=20.0)
    found = collect(opened(image, detect=5.0), config.calibration_stars, config.framing)
    assert (found.noise >= 20.0).all()
    assert len(found.bright) > 20


# Maps beside the image


@pytest.mark.parametrize("kind", ["weight", "variance"])
def test_a_map_says_the_noise_but_for_a_factor(field, tmp_path, kind):
    """One half of the image is noisier, which only the map knows."""
    image = pixels(field).copy()
    rng, sigma = np.random.default_rng(2), np.full(image.shape, 12.0)
    sigma[:, 350:] = 36.0
    image[:, 350:] += rng.normal(0, np.sqrt(36.0**2 - 12.0**2), (700, 350))
    values = 5.0 * sigma**2
    values[100:110, 100:110] = np.nan
    path = write(tmp_path / "image.fits", image)
    beside = write(tmp_path / "map.fits", 1 / values if kind == "weight" else values)
    found = opened(path, detect=5.0, **{kind: str(beside)})
    stamps = next(found.chunks(found.count))
    assert np.isfinite(stamps.noise).all()
    near = stamps.x < 330
    assert stamps.noise[near] == pytest.approx(12.0, rel=0.1)
    assert stamps.noise[stamps.x > 370] == pytest.approx(36.0, rel=0.1)
    inside = (np.abs(found.positions - 104.5) < 4).all(axis=1)
    assert not inside.any()
    # The half that is noisier does not fill up with noise.
    spurious, _ = cKDTree(field[1].centroid).query(found.positions)
    assert (spurious > 8).sum() <= 2


def test_pixels_without_weight_are_bad_and_counted(field, tmp_path):
    """SWarp and SExtractor write 0 where there are no data."""
    weight = np.ones((700, 700))
    weight[100:110, 100:110] = 0
    path = write(tmp_path / "image.fits", pixels(field))
    beside = write(tmp_path / "map.fits", weight)
    found = opened(path, detect=5.0, weight=str(beside))
    assert found.said().splitlines()[1] == f"{beside}: weight 0, bad pixels: 100"
    assert found._layers.sky().bad.sum() == 100
    assert not (np.abs(found.positions - 104.5) < 4).all(axis=1).any()


def test_a_star_is_found_in_silence(field, tmp_path, capfd):
    """photutils 3.0 shows how far it is, unless it is told not to; 4.0 will not be told."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(write(tmp_path / "image.fits", pixels(field)), detect=5.0)
    assert capfd.readouterr() == ("", "")


def test_bits_of_a_mask(field, tmp_path):
    flags = np.zeros((700, 700), np.int32)
    flags[10, 10], flags[20, 20], flags[30, 30] = 1, 4, 2**30 + 2
    path = tmp_path / "image.fits"
    fits.HDUList([fits.PrimaryHDU(pixels(field)), fits.ImageHDU(flags, name="DQ")]).writeto(path)

    def bad(**stated):
        found = opened(path, detect=5.0, mask="DQ", **stated)
        return found._layers.sky().bad[[10, 20, 30], [10, 20, 30]].tolist()

    assert bad() == [True, True, True]
    assert bad(bad_bits=1) == [True, False, False]
    assert bad(bad_bits=6) == [False, True, True]
    assert bad(bad_bits=2**63 - 1) == [True, True, True]
    words = ["predict", path, "--detect", "--mask", "DQ", "--out", tmp_path / "x.fits"]
    said = psfdae(*words, "--bad-bits", 2**63)
    assert said.exit_code == 2 and "is not in the range" in said.output


# What cannot be used: one line and code 2


@pytest.fixture(scope="module")
def bad(field):
    """Files of which each has one thing wrong."""
    folder, made = field
    image = pixels(field)
    rng = np.random.default_rng(1)
    write(folder / "empty.fits", rng.normal(100, 3, (300, 300)))
    write(folder / "constant.fits", np.full((300, 300), 7.0))
    write(folder / "nan.fits", np.full((700, 700), np.nan))
    write(folder / "small.fits", np.ones((10, 10)))
    some = np.ones(image.shape)
    some[3, 4] = 0
    write(folder / "zero.fits", some)
    some[3, 4] = -1
    write(folder / "below.fits", some)
    write(folder / "negative.fits", -np.ones(image.shape))
    write(folder / "cube.fits", np.ones((4, 16, 16)), PIXSCALE=1.0)
    listed = Table.read(folder / "stars.csv")
    listed[made.kind == "bright"][:5].write(folder / "five.csv")
    twice = listed[[*range(len(listed)), 7]]
    twice.write(folder / "twice.csv")
    other = pd.DataFrame({"X_IMAGE": rng.uniform(1, 700, 150), "Y_IMAGE": rng.uniform(1, 700, 150)})
    other.to_csv(folder / "other.csv", index=False)
    (folder / "none.csv").write_text("X_IMAGE,Y_IMAGE\n")
    table = fits.BinTableHDU(Table({"x": [1.0]}), name="CAT")
    fits.HDUList([fits.PrimaryHDU(image), table]).writeto(folder / "table.fits")
    return folder


LIST = ["--catalogue", "stars.csv"]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["empty.fits", "--detect"], "empty.fits: no star 5 σ above the sky"),
        (["constant.fits", "--detect"], "constant.fits: no star"),
        (["image.fits", "--catalogue", "none.csv"], "none.csv: the catalogue has no stars"),
        (["image.fits", "--catalogue", "five.csv"], "of 5: "),
        (["image.fits", "--detect", "--saturate", 190], "0 stars are good enough"),
        (["nan.fits", "--detect"], "nan.fits: too few pixels of the image have a value"),
        (["nan.fits", *LIST], "nan.fits: too few pixels of the image have a value"),
        (["image.fits", *LIST, "--weight", "small.fits"], "small.fits: a weight map of 10×10"),
        (["image.fits", *LIST, "--weight", "below.fits"], "below.fits: a weight map of which 1 of"),
        (
            ["image.fits", *LIST, "--variance", "zero.fits"],
            "of which 1 of 490000 pixels are not ab",
        ),
        (["image.fits", *LIST, "--variance", "negative.fits"], "a variance map of which 490000"),
        (["image.fits", *LIST, "--weight", "nan.fits"], "too few pixels of the image have a value"),
        (["image.fits", *LIST, "--weight", "1.fits"], "no extension '1.fits'"),
        (["image.fits", *LIST, "--name", "../../x"], "--name ../../x: expected the start of a"),
        (["image.fits", *LIST, "--name", 300 * "x"], "at most 239 bytes, and no folder"),
        (["image.fits", *LIST, "--gain", 0], "image.fits: gain 0.0, expected a number above 0"),
        (["image.fits", *LIST, "--gain", -1], "image.fits: gain -1.0, expected"),
        (["image.fits", *LIST, "--read-noise", 0], "read noise 0.0, expected"),
        (["image.fits", "--detect", "--threshold", -2], "threshold -2.0, expected"),
        (["image.fits", "--catalogue", "other.csv"], "of 150 positions are on a source"),
        (["image.fits", "--catalogue", "twice.csv"], "rows 8 and 150"),
        (["table.fits", *LIST, "--extension", "CAT"], "extension 'CAT' holds no image"),
        (["image.fits", *LIST, "--mask", "small.fits"], "small.fits: a mask of 10×10"),
        (["image.fits", *LIST, "--bad-bits", 4], "but no mask"),
        (["image.fits", *LIST, "--detect"], "--detect takes an image"),
        (["cube.fits", "--detect"], "--detect takes an image"),
        (["cube.fits", "--weight", "zero.fits"], "a cube of stamps none"),
        (["image.fits"], "needs a star catalogue, or --detect"),
        (["image.fits", *LIST, "--report", "stars.csv"], "stars.csv: is an input, too"),
        (["image.fits", *LIST, "--report", "five.csv"], "five.csv: exists already; --overwrite"),
    ],
)
def test_from_stars_refuses_in_one_line(bad, monkeypatch, words, named):
    monkeypatch.chdir(bad)
    assert named in refused("from-stars", *words, "--out", "model", *TINY)
    assert not (bad / "model").exists()


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--weight", "small.fits"], "a weight map of 10×10"),
        (["--weight", "below.fits"], "1 of 490000 pixels are not at least 0"),
        (["--mask", "small.fits"], "a mask of 10×10"),
        (["--gain", 0], "gain 0.0"),
    ],
)
def test_predict_refuses_the_same(bad, monkeypatch, words, named):
    monkeypatch.chdir(bad)
    shipped = ["--pixel-scale", 0.1, "--out", "psf.fits"]
    assert named in refused("predict", "image.fits", *LIST, *words, *shipped)
    assert not (bad / "psf.fits").exists()


def test_predict_flags_stars_and_drops_none(bad, monkeypatch):
    """Also those of an image of NaN, of another list, and those that are there twice."""
    monkeypatch.chdir(bad)
    for image, catalogue, count in (
        *(("nan.fits", "stars.csv", 149), ("image.fits", "other.csv", 150)),
        ("image.fits", "twice.csv", 150),
    ):
        words = [image, "--catalogue", catalogue, "--pixel-scale", 0.1, "--overwrite"]
        result = psfdae("predict", *words, "--out", "all.fits")
        assert result.exit_code == 0, result.output
        assert len(Table.read("all.fits", hdu="STARS")) == count


def test_what_a_list_is_judged_by(field):
    folder, made = field
    seen = opened(folder / "image.fits", catalogue=folder / "stars.csv")
    column, row = np.rint(made.centroid.T).astype(int)
    assert seen._layers.sky().covered(column, row, SEEN).mean() > 0.9
    assert find_image(folder / "image.fits").scale() == (None, "not known")
