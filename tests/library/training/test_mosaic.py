"""All CCDs of a mosaic in one call of `train` and `predict`."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from command_line import printed, psfdae, refused
from psfdae.commands import mosaic
from psfdae.denoise.bundle import read_bundle
from psfdae.image.errors import ObservationError
from psfdae.image.fits_file import science_images
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.image.opening import open_observation
from psfdae_paper.stages import simulate
from psfdae_paper.stars import example

TINY = ["preset=smoke", "parts.train_stars=120", "parts.test_stars=30", "train.epochs=1"]
SIDE = {"side_px": 700, "bright": 60, "faint": 80, "blended": 6, "saturated": 3}
NUMBERS = {"CCD1": 1, "CCD2": 2, "5": 5, "6": 6}


def mosaic_file(path, *images):
    """A FITS file with named images, None for a table, and no primary one."""
    hdus = [
        fits.BinTableHDU(Table({"x": [1.0]}), name=name)
        if pixels is None
        else fits.ImageHDU(np.asarray(pixels, np.float32), header, name=name)
        for name, pixels, header in images
    ]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)
    return path


@pytest.fixture(scope="module")
def ccds(tmp_path_factory):
    """Two CCDs with their stars' sky list in one, a mask, a table, and twice the same name."""
    folder = tmp_path_factory.mktemp("mosaic")
    rng, images, lists = np.random.default_rng(1), [], []
    for k in (1, 2):
        image, catalogue = folder / f"{k}.fits", folder / f"{k}.csv"
        x, y = rng.uniform(20, 180, (2, 5))
        pixels = rng.normal(100, 1, (200, 200))
        example.add_stamps(pixels, np.full((5, 4, 4), 50.0), x, y)
        example.write_field(image, catalogue, pixels, x, y)
        header = fits.getheader(image)
        header["CRVAL2"] += k  # fields of the sky of their own
        table = Table.read(catalogue)
        table["dec"] += k
        table["id"] += 10 * k
        lists.append(table["id", "ra", "dec"])
        images.append((f"CCD{k}", pixels, header))
    rows = Table({name: np.concatenate([t[name] for t in lists]) for name in ("id", "ra", "dec")})
    rows.write(folder / "sky.csv")
    quality = np.ones((9, 9))
    other_extensions = [
        ("DQ", quality, None),
        ("CAT", None, None),
        ("SCI", quality, None),
        ("SCI", quality, None),
    ]
    return mosaic_file(folder / "m.fits", *images, *other_extensions), folder / "sky.csv"


def test_images_are_called_by_their_own_names_where_they_have_one(ccds, tmp_path):
    assert science_images(ccds[0]) == NUMBERS
    path = mosaic_file(tmp_path / "odd.fits", ("a/../b", np.ones((3, 3)), None))
    assert science_images(path) == {"1": 1}
    with pytest.raises(ObservationError, match="no image"):
        science_images(mosaic_file(tmp_path / "none.fits", ("CAT", None, None)))


def test_stars_of_a_sky_list_belong_to_the_image_on_which_they_are(ccds):
    image, catalogue = ccds
    stated = mosaic.options_by_image(image, ImageOptions(catalogue=catalogue, gain=2.0))
    assert {name: of.extension for name, of in stated.items()} == NUMBERS
    for k in (1, 2):
        of = stated[f"CCD{k}"]
        assert of.gain == 2.0
        opened = open_observation(ImageInput(image, **vars(of)), 4)
        assert opened.count == 5
        assert next(opened.chunks(9)).id.tolist() == [10 * k + n for n in range(5)]
    # The list reaches beyond an image, which alone keeps and flags all of them.
    assert open_observation(ImageInput(image, catalogue=catalogue, extension=1), 4).count == 10


def twice(word):
    print("not shown")
    if word == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if word == "nothing":
        raise ObservationError("f", "no star")
    return {"x": "xx"}[word]


def test_images_that_fail_or_are_killed_are_named_at_the_end_and_stop_no_other(capfd):
    words = {"A": "x", "B": "nothing", "C": "killed", "D": "x"}
    jobs = {name: {"word": word} for name, word in words.items()}
    with pytest.raises(mosaic.MosaicError, match=r"m: 2 of 4 images failed: B, C$"):
        mosaic.run_for_images(twice, jobs, "m")
    out, err = capfd.readouterr()
    _, first, second, third, last = out.splitlines()
    assert (first, second, last, err) == ("A: xx", "B: f: no star", "D: xx", "")
    assert third.startswith("C: ") and "killed" in third
    with pytest.raises(KeyError):  # a bug stays one
        mosaic.run_for_images(twice, {"A": {"word": "bug"}}, "m")


@pytest.mark.parametrize(
    ("command", "words", "named"),
    [
        ("predict", ["--detect", "--mask", "DQ"], "m.fits: --all-extensions excludes --mask"),
        ("train", ["--detect", "--extension", 1], "--all-extensions excludes --extension"),
        ("predict", ["--detect", "--model", "."], "CCD1: "),
    ],
)
def test_what_cannot_be_said_of_several_images_is_refused(ccds, monkeypatch, command, words, named):
    monkeypatch.chdir(ccds[0].parent)
    assert named in refused(command, "m.fits", "--all-extensions", *words, "--out", "out")


@pytest.mark.slow
def test_a_mosaic_from_its_stars_to_their_psfs(tmp_path):
    images = []
    for k in (1, 2):
        simulate.write_example(tmp_path / "i.fits", tmp_path / "s.csv", seed=k, **SIDE)
        header = fits.getheader(tmp_path / "i.fits")
        images.append((f"CCD{k}", fits.getdata(tmp_path / "i.fits"), header))
    empty = ("EMPTY", np.random.default_rng(1).normal(100, 3, (300, 300)), images[0][2])
    image = mosaic_file(tmp_path / "m.fits", *images, empty)
    out = tmp_path / "model"
    words = [image, "--all-extensions", "--detect"]
    process = psfdae("train", *words, "--out", out, "--report", tmp_path / "page.html", *TINY)
    assert process.exit_code == 2
    assert process.output.endswith("1 of 3 images failed: EMPTY\n")
    for k in (1, 2):
        assert read_bundle(out / f"CCD{k}/m_CCD{k}.psf.safetensors").info.source == "stars"
        assert (tmp_path / f"page_CCD{k}.html").is_file()
    mosaic = mosaic_file(tmp_path / "two.fits", *images)
    words = [mosaic, "--all-extensions", "--detect", "--model", out]
    printed("predict", *words, "--out", tmp_path / "psf.fits")
    for k in (1, 2):
        stars = Table.read(tmp_path / f"psf_CCD{k}.fits", hdu="STARS")
        assert len(stars) == len(Table.read(tmp_path / f"psf_CCD{k}_stars.csv")) > 100
