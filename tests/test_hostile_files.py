"""Unusable and hostile files: exit code 2, one line that names the file, nothing executed."""

from __future__ import annotations

import gc
import pickle
import shutil
import struct
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from command_line import refused
from fits_inputs import PACK, open_observation, write_cube, write_field
from prediction_stars import with_network
from psfdae import load_model
from psfdae.image import fits_file as images
from psfdae.image.catalogue import read_catalogue
from psfdae.image.errors import ObservationError
from psfdae.model import bundle as bundles
from psfdae.model.bundle import read_bundle, shipped_path

SIDE = 16
CUBE, TILES, LIST, TABLE, MODEL = (
    *("cube.fits", "image.fz", "stars.csv", "stars.fits"),
    "model.psf.safetensors",
)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A cube of stamps, an image in tiles, two star lists and a model."""
    folder = tmp_path_factory.mktemp("good")
    grid = np.arange(SIDE) - SIDE // 2
    star = np.exp(-(grid[:, None] ** 2 + grid**2) / 8.0)
    stamps = np.random.default_rng(1).poisson(100 + 400 * star, (12, SIDE, SIDE)).astype(float)
    write_cube(folder / CUBE, stamps, PIXSCALE=0.1)
    x, y = np.random.default_rng(2).uniform(0, [[60], [40]], (2, 12))
    options = {"shape": (40, 60), "pixel_scale_arcsec": 0.1, "compress": True}
    write_field(folder / TILES, folder / LIST, stamps, x, y, **options)
    Table.read(folder / LIST).write(folder / TABLE)
    shutil.copy(shipped_path(), folder / MODEL)
    return folder


def command(good, path):
    """The command that reads a file of this name in the place of the good one."""
    out = path.with_name("out.fits")
    words = {
        CUBE: [path],
        TILES: [path, "--catalogue", good / LIST],
        MODEL: [good / CUBE, "--model", path],
    }.get(path.name, [good / TILES, "--catalogue", path])
    return ["predict", *words, "--pixel-scale", 0.1, "--out", out, "--quiet", "--overwrite"]


class Touch:
    """A pickle of it makes a file where it is read."""

    def __reduce__(self):
        return Path.touch, (Path("executed"),)


def cut(share):
    return lambda raw: raw[: int(share * len(raw))]


def with_card(card):
    """The file with a card of its header replaced by one of the same key."""

    def change(raw):
        place = raw.index(card.split("=")[0].ljust(8).encode() + b"=")
        return raw[:place] + card.ljust(80).encode() + raw[place + 80 :]

    return change


def pixels(*shape):
    def change(_):
        hdu = fits.PrimaryHDU(np.zeros(shape, np.float32))
        return b"".join((hdu.header.tostring().encode(), bytes(-(-hdu.size // 2880) * 2880)))

    return change


def model_with(name, change):
    """The shipped model, or a network, with an array changed and signed anew."""

    def changed(_):
        bundle = read_bundle()
        bundle = with_network(bundle) if name.startswith(("dae/", "flux/")) else bundle
        arrays = bundles.bundle_arrays(bundle)
        arrays[name] = np.asarray(change(arrays[name]))
        return bundles.bundle_bytes(bundle.info, arrays)

    return changed


CASES = [
    *((name, lambda _: pickle.dumps(Touch()), name) for name in (CUBE, TILES, LIST, MODEL)),
    (CUBE, lambda _: b"", "not a FITS file"),
    *((name, cut(0.6), name) for name in (CUBE, TILES, TABLE, MODEL)),
    (CUBE, with_card("NAXIS3  = 99999999"), "truncated"),
    (TILES, with_card("ZNAXIS2 = 9999"), "damaged"),
    (TABLE, with_card("NAXIS2  = 99999999"), "larger than the file"),
    (MODEL, lambda raw: struct.pack("<Q", 2**60) + raw[8:], MODEL),
    (CUBE, pixels(4, 7, 7), "7×7"),
    (CUBE, pixels(30, 40), "needs --catalogue"),
    (MODEL, model_with("flux/mean", lambda a: a[1:]), "'flux/mean' has shape"),
    (MODEL, model_with("flux/mean", lambda a: 0 * a), "'flux/mean' must have a sum of 1"),
    (MODEL, model_with("gmm/axes", lambda a: 2 * a), "'axes' must have orthonormal"),
]


@pytest.mark.parametrize(("name", "change", "words"), CASES)
def test_a_bad_file_is_one_line_and_no_code(good, tmp_path, monkeypatch, name, change, words):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / name
    path.write_bytes(change((good / name).read_bytes()))
    line = refused(*command(good, path))
    assert words in " ".join(line.split()) and line.rstrip("\n").isprintable()
    assert list(tmp_path.iterdir()) == [path]


# What is read of files that are packed or change.


@pytest.mark.parametrize("pack", PACK)
def test_packed_files_are_read_like_plain_ones_and_their_copies_deleted(
    tmp_path, monkeypatch, pack
):
    room, path = tmp_path / "room", tmp_path / "packed"
    room.mkdir()
    monkeypatch.setattr(images.tempfile, "tempdir", str(room))
    stamps = np.random.default_rng(1).normal(9, 2, (5, 8, 8)).astype(np.float32)
    write_cube(tmp_path / "a.fits", stamps)
    path.write_bytes(PACK[pack]((tmp_path / "a.fits").read_bytes()))
    np.testing.assert_array_equal(next(open_observation(path, 8).chunks(9)).data, stamps)
    gc.collect()  # a copy lives as long as what was read from it
    assert list(room.iterdir()) == []


def test_a_file_that_changes_after_opening_is_noticed(good, tmp_path):
    path = tmp_path / CUBE
    shutil.copy(good / CUBE, path)
    observation = open_observation(path, SIDE)
    write_cube(path, np.zeros((3, SIDE, SIDE)))
    with pytest.raises(ObservationError, match="has changed"):
        list(observation.chunks(10))


def test_columns_of_fits_tables_that_hold_arrays_are_no_numbers(tmp_path):
    lists = fits.Column("many", "PB()", array=np.array([np.zeros(9, np.uint8)] * 4, dtype=object))
    gap = Table({"x": np.ma.array([1, 2, 3, 4], mask=[0, 1, 0, 0]), "y": np.zeros(4)})
    columns = fits.table_to_hdu(gap).columns + lists
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "s.fits")
    catalogue = read_catalogue(tmp_path / "s.fits")
    np.testing.assert_array_equal(catalogue.numbers("x"), [1, np.nan, 3, 4])
    assert catalogue.columns(np.arange(4)).colnames == []
    with pytest.raises(ObservationError, match="'many' holds"):
        catalogue.numbers("many")


def test_predictions_do_not_depend_on_who_completes_the_basis(monkeypatch, shipped):
    """Large stamps' way, on small ones: the same predictions but for rounding."""
    lean_basis = partial(bundles.flux_model_of, full_basis_max_px=0)
    monkeypatch.setattr(bundles, "flux_model_of", lean_basis)
    lean = load_model()
    flux_model, rng = lean.bundle.flux_model, np.random.default_rng(3)
    assert flux_model.basis.shape[1] == lean.info.components < 256
    scores = rng.normal(0, np.sqrt(flux_model.variance), (20, lean.info.components))
    psf = (flux_model.mean + scores @ flux_model.basis.T).reshape(20, SIDE, SIDE)
    stamps = rng.poisson(np.maximum(2e4 * psf + 100, 0)).astype(np.float32)
    stamps[::3, 4, 5] = np.nan
    stamps[::5, 9, 9] = 1e7
    for given_values in ({}, {"background": 100.0}):
        full_basis, lean_prediction = (
            model.predict(stamps, **given_values) for model in (shipped, lean)
        )
        assert (full_basis.flags == lean_prediction.flags).all()
        for name in ("psf", "flux", "flux_error", "background", "noise", "chi2", "distance"):
            a, b = getattr(full_basis, name), getattr(lean_prediction, name)
            np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6 * np.nanmax(np.abs(a)))


# Results.


def test_results_never_take_the_place_of_what_they_are_made_of(good, tmp_path):
    for name in (CUBE, LIST, MODEL):
        shutil.copy(good / name, tmp_path / name)
    cube, field, model = (tmp_path / name for name in (CUBE, LIST, MODEL))
    bytes_before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for words in (
        ["predict", cube, "--model", model, "--out", model, "--overwrite"],
        ["predict", cube, "--mask", cube, "--out", cube, "--overwrite"],
        ["from-stars", cube, "--catalogue", field, "--pixel-scale", 1, "--report", field],
    ):
        out = [] if "--out" in words else ["--out", tmp_path / "model"]
        assert "is an input, too" in refused(*words, *out)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == bytes_before
