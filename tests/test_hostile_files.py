"""Files of an enemy: one line and exit code 2, in little memory and time."""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import os
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from astropy.io import fits
from astropy.table import Table
from click.testing import CliRunner

import hostile_files
from psfdae import load_model
from psfdae.bundle import BundleError, format, read_bundle, write_bundle
from psfdae.bundle.format import shipped_path
from psfdae.cli import main
from psfdae.observations import ObservationError, catalogue, open_observation, tiles, unpacking
from psfdae.observations.catalogue import read_catalogue
from psfdae.observations.examples import write_cube, write_field
from psfdae.prediction import engine
from psfdae.safe_text import no_formula, one_line

D = 8


def cards(*lines):
    """A FITS header."""
    text = "".join(f"{line:<80}" for line in (*lines, "END"))
    return text.ljust(-(-len(text) // 2880) * 2880).encode()


PRIMARY = ("BITPIX  =                    8", "NAXIS   =                    0")
GOOD, NEVER = (cards(f"SIMPLE  =                    {value}", *PRIMARY) for value in "TF")
EXTENSION = cards("XTENSION= 'IMAGE   '", *PRIMARY, "PCOUNT  = 0", "GCOUNT  = 1")


def zipped(path, data):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("a.fits", data)


PACK = {
    "gz": lambda path, data: path.write_bytes(gzip.compress(data, 1)),
    "bz2": lambda path, data: path.write_bytes(bz2.compress(data)),
    "xz": lambda path, data: path.write_bytes(lzma.compress(data, preset=0)),
    "zip": zipped,
}


def command(*words):
    """What `psfdae` says and its exit code."""
    result = CliRunner().invoke(main, list(map(str, words)))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def refused(*words):
    """The one line of a command that ends with code 2."""
    code, output = command(*words)
    assert code == 2, output
    assert len(output.splitlines()) == 1 and output.startswith("psfdae: "), output
    return output


def hostile(count, seed, folder):
    script = Path(hostile_files.__file__)
    words = [sys.executable, script, str(count), str(seed), folder]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    return json.loads(done.stdout)


def test_some_hostile_inputs(tmp_path):
    found = hostile(40, 1, tmp_path)
    assert found["inputs"] == sum(found["ends"].values()) == 40
    assert {end.split()[1] for end in found["ends"]} == {"0", "2"}


@pytest.mark.slow
def test_hostile_inputs(tmp_path):
    """PSFDAE_HOSTILE_INPUTS=10000 for a night."""
    count = int(os.environ.get("PSFDAE_HOSTILE_INPUTS", "500"))
    assert hostile(count, 2, tmp_path)["inputs"] == count


# FITS files without end.


@pytest.mark.parametrize("pack", PACK)
def test_a_header_without_end_is_refused_before_it_is_read(tmp_path, pack):
    path = tmp_path / f"a.fits.{pack}"
    PACK[pack](path, NEVER + bytes(10**7))
    assert "SIMPLE is not T" in refused("predict", path, "--out", tmp_path / "o.fits")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("pack", PACK)
def test_bombs_are_unpacked_to_a_limit(tmp_path, monkeypatch, pack):
    monkeypatch.setenv("TMPDIR", str(tmp_path / "room"))
    monkeypatch.setattr(unpacking.tempfile, "tempdir", None)
    (tmp_path / "room").mkdir()
    monkeypatch.setattr(unpacking, "WHOLE", unpacking.Limit(3 * 10**6))
    path = tmp_path / f"a.fits.{pack}"
    PACK[pack](path, GOOD + bytes(2 * 10**7))
    message = refused("predict", path, "--out", tmp_path / "o.fits")
    assert "unpacks to more than" in message and "unpack it beforehand" in message
    assert list((tmp_path / "room").iterdir()) == []


def test_unpacking_leaves_half_of_the_free_space(monkeypatch):
    usage = shutil.disk_usage(".")._replace(free=1000)
    monkeypatch.setattr(unpacking.shutil, "disk_usage", lambda folder: usage)
    allowed, words = unpacking.WHOLE.of(10)
    assert allowed == 500 and "TMPDIR" in words


@pytest.mark.parametrize(
    ("place", "card"),
    [("NAXIS1", "NAXIS1  = 'PB(9)'"), ("NAXIS2", "NAXIS2  = 'x'"), ("PIXSCALE", "WCSAXES = 65536")],
)
def test_sizes_that_astropy_or_wcslib_cannot_bear_are_refused(tmp_path, place, card):
    path = tmp_path / "a.fits"
    write_cube(path, np.ones((5, D, D)), PIXSCALE=0.1)
    raw = path.read_bytes()
    where = raw.index(place.encode())
    path.write_bytes(raw[:where] + card.ljust(80).encode() + raw[where + 80 :])
    said = " ".join(refused("predict", path, "--out", tmp_path / "o.fits").split())
    assert f"damaged: {' '.join(card.split())}" in said


@pytest.mark.parametrize("pack", PACK)
def test_packed_files_are_read_like_plain_ones(tmp_path, pack):
    stamps = np.random.default_rng(1).normal(9, 2, (5, D, D))
    write_cube(tmp_path / "a.fits", stamps)
    PACK[pack](tmp_path / "packed", (tmp_path / "a.fits").read_bytes())
    plain, packed = (
        next(open_observation(tmp_path / name, stamp_px=D).chunks(9)).data
        for name in ("a.fits", "packed")
    )
    np.testing.assert_array_equal(plain, packed)


def test_a_zip_file_of_several_files_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as packed:
        packed.writestr("a.fits", GOOD)
        packed.writestr("b.fits", GOOD)
    with pytest.raises(ObservationError, match="2 files in a zip file"):
        open_observation(tmp_path / "a.zip", stamp_px=D)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (GOOD + 101 * EXTENSION, "more than 100 extensions"),
        (
            GOOD.replace(b"NAXIS   =                    0", b"NAXIS   =           9999999999"),
            "damaged: NAXIS = 9999999999",
        ),
        (GOOD + cards("XTENSION= 'BINTABLE'", "TFIELDS = 1000"), "damaged: TFIELDS = 1000"),
        (GOOD + 20 * EXTENSION, "damaged: headers of more than 28800 bytes"),
        (
            cards("SIMPLE  =                    T", "BITPIX  = 8", "NAXIS   = 1", "NAXIS1  = 2881")
            + bytes(5760)
            + cards("XTENSION= 'BINTABLE'", "TFIELDS = 99999999999"),
            "damaged: TFIELDS = 99999999999",
        ),
        (GOOD[:80].ljust(10**6), "damaged: headers of more than 28800 bytes"),
        (GOOD + b"XTENSION= 'IMAGE   '".ljust(10**6), "damaged: headers of more than 28800 bytes"),
    ],
)
def test_too_many_headers_are_refused(tmp_path, monkeypatch, data, message):
    monkeypatch.setattr(unpacking, "MOST_HDUS", 100)
    most = 200 if "extensions" in message else 10
    monkeypatch.setattr(unpacking, "LONGEST_HEADERS", 2880 * most)
    (tmp_path / "a.fits").write_bytes(data)
    with pytest.raises(ObservationError, match=message):
        open_observation(tmp_path / "a.fits", stamp_px=D)


def test_distortion_of_any_order_does_not_keep_us(tmp_path):
    x = np.array([9.0])
    write_field(
        tmp_path / "a.fits", tmp_path / "s.csv", np.ones((1, D, D)), x, x, shape=(30, 40)
    )  # fmt: skip
    with fits.open(tmp_path / "a.fits", mode="update") as hdus:
        header = hdus[0].header
        header.update(CTYPE1="RA---TAN-SIP", CTYPE2="DEC--TAN-SIP", A_ORDER=30_000, B_ORDER=30_000)
    found = open_observation(tmp_path / "a.fits", stamp_px=D, catalogue=tmp_path / "s.csv",
                             columns=("X_IMAGE", "Y_IMAGE"))  # fmt: skip
    assert found.pixel_scale_arcsec is None


# Tiles.


@pytest.mark.parametrize("tile", [(1, 70), (7, 9), (60, 3), (60, 70)])
def test_tiles_are_decompressed_in_blocks(tmp_path, monkeypatch, tile):
    """Rows or columns of tiles at a time, whatever their shape: the same values as at once."""
    image = np.random.default_rng(1).poisson(900, (60, 70)).astype(np.int32)
    packed = fits.CompImageHDU(image, tile_shape=tile)
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "a.fz")
    monkeypatch.setattr(tiles, "BLOCK_PX", 150)
    with fits.open(tmp_path / "a.fz") as hdus, (tmp_path / "copy").open("w+b") as copy:
        found = tiles.decompress(tmp_path / "a.fz", hdus[1], copy)
        np.testing.assert_array_equal(found, image)


def test_only_some_tiles_of_an_image_are_in_memory(tmp_path):
    """4096² pixels, 64 MB, from a child whose data may grow by far less."""
    image = np.zeros((4096, 4096), np.int32)
    image[::64] = np.arange(4096) % 97
    packed = fits.CompImageHDU(image, tile_shape=(16, 4096))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "a.fz")
    (tmp_path / "s.csv").write_text("X_IMAGE,Y_IMAGE\n2000,65\n100,4001\n")
    script = (
        "import resource, sys, hostile_files\n"
        "from psfdae.observations import open_observation\n"
        "a, s = sys.argv[1:]\n"
        "found = open_observation(a, stamp_px=8, catalogue=s)\n"
        "limit = hostile_files.data_bytes() + 40 * 2**20\n"
        "resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))\n"
        "chunk, = found.chunks(9)\n"
        "print(chunk.data[0, 4].astype(int).tolist())\n"
    )
    words = [sys.executable, "-c", script, tmp_path / "a.fz", tmp_path / "s.csv"]
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == image[64, 1995:2003].tolist()


def test_tiles_and_images_that_are_too_large_are_refused(tmp_path, monkeypatch):
    packed = fits.CompImageHDU(np.ones((64, 64), np.int32), tile_shape=(64, 64))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "a.fz")
    (tmp_path / "s.csv").write_text("X_IMAGE,Y_IMAGE\n20,20\n")
    options = {"stamp_px": D, "catalogue": tmp_path / "s.csv"}
    monkeypatch.setattr(tiles, "DECOMPRESSED", unpacking.Limit(10_000, 0))
    with pytest.raises(ObservationError, match="decompresses to 16384 bytes, more than 10000"):
        list(open_observation(tmp_path / "a.fz", **options).chunks(9))
    monkeypatch.setattr(tiles, "LARGEST_TILE", 4095)
    with pytest.raises(ObservationError, match="tiles of 64×64 pixels"):
        open_observation(tmp_path / "a.fz", **options)


def test_a_text_as_the_size_of_an_image_is_no_size(tmp_path):
    packed = fits.CompImageHDU(np.ones((16, 16), np.int32))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "a.fz")
    with fits.open(tmp_path / "a.fz", mode="update", disable_image_compression=True) as hdus:
        hdus[1].header.update(ZNAXIS1="text", ZNAXIS2=2**31)
    with pytest.raises(ObservationError, match=r"ZNAXIS1 = 'text.*expected a number"):
        open_observation(tmp_path / "a.fz", stamp_px=16)


# Catalogues.


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y," + ",".join(map(str, range(10**5))) + "\n1,1\n", "100002 columns in a catalogue"),
        ("id,x,y\n" + 40_000 * "a" + ",1,1\n" + 50_000 * "a,1,1\n", "column 1 is 40000 char"),
        ("id x y\n" + 40_000 * "a" + " 1 1\n" + 50_000 * "a 1 1\n", "column 1 is 40000 char"),
        ('id,x\n"' + 20_000 * ", " + '",1\n' + 50_000 * "a,1\n", "column 1 is 40000 characters"),
        ("id,x\n" + 300_000 * '"' + ",1\n" + 50_000 * "a,1\n", "not a text table|300002 char"),
        ('# 3 "\n' + 20_000 * "1 2\n", "a quote without an end in its header"),
        ("# 1 X_IMAGE\n# 2000000000 Y_IMAGE\n1 1\n", "columns in a catalogue, at most 2000"),
        ("# %ECSV 1.0\n# ---\n# " + 300_000 * "[" + "\nx y\n1 1\n", "an ECSV header of more than"),
    ],
)
def test_catalogues_that_would_fill_the_memory_are_refused(tmp_path, text, message):
    path = tmp_path / "s.csv"
    path.write_text(text)
    with pytest.raises(ObservationError, match=rf"s\.csv: .*({message})"):
        read_catalogue(path)


@pytest.mark.parametrize("suffix", ["csv", "fits"])
def test_catalogues_of_too_many_stars_are_refused(tmp_path, monkeypatch, suffix):
    Table({"x": np.ones(1001), "y": np.ones(1001)}).write(tmp_path / f"s.{suffix}")
    monkeypatch.setattr(catalogue, "MOST_STARS", 1000)
    with pytest.raises(ObservationError, match=r"100[12] stars in a catalogue, at most 1000"):
        read_catalogue(tmp_path / f"s.{suffix}")


def test_a_text_table_is_read_up_to_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(catalogue, "LARGEST_TEXT", 100)
    (tmp_path / "s.csv").write_text("x,y\n" + 30 * "1,1\n")
    with pytest.raises(ObservationError, match="more than 100 bytes; a FITS table may be larger"):
        read_catalogue(tmp_path / "s.csv")
    with pytest.raises(ObservationError, match="more than 100 bytes"):
        read_catalogue("/dev/zero")


@pytest.mark.parametrize("suffix", ["csv", "fits"])
def test_long_identifiers_are_refused(tmp_path, suffix):
    path = tmp_path / f"s.{suffix}"
    Table({"id": ["a", "b" * 201], "x": [1.0, 2.0], "y": [1.0, 2.0]}).write(path)
    with pytest.raises(ObservationError, match="'id' has 201 characters in row 2"):
        read_catalogue(path).identifiers()


def test_columns_of_variable_length_are_left_alone(tmp_path):
    """Their rows may all be the same bytes: a small file unfolds to any size."""
    lists = fits.Column("many", "PB()", array=np.array([np.zeros(9, np.uint8)] * 3, dtype=object))
    x = fits.Column("x", "D", array=np.arange(3.0))
    fits.BinTableHDU.from_columns([x, lists]).writeto(tmp_path / "s.fits")
    found = read_catalogue(tmp_path / "s.fits")
    np.testing.assert_array_equal(found.numbers("x"), [0.0, 1.0, 2.0])
    with pytest.raises(ObservationError, match="column 'many' holds arrays"):
        found.numbers("many")


def test_columns_of_fits_tables_are_what_astropy_reads(tmp_path):
    table = Table(
        {
            "scaled": np.arange(4, dtype=np.uint16),
            "large": np.arange(4, dtype=np.uint64) + 2**63,
            "gap": np.ma.array([1, 2, 3, 4], mask=[0, 1, 0, 0]),
            "text": ["a", "bc", "", "d"],
            "unit": np.arange(4.0),
        }
    )
    table["unit"].unit = "deg"
    table.write(tmp_path / "s.fits")
    found = read_catalogue(tmp_path / "s.fits").table
    with fits.open(tmp_path / "s.fits") as hdus:
        whole = Table.read(hdus[1], format="fits", mask_invalid=False)
    assert found.colnames == whole.colnames
    for name in whole.colnames:
        assert found[name].tolist() == whole[name].tolist()
        assert whole[name].dtype == found[name].dtype and whole[name].unit == found[name].unit


# Bundles.


def with_arrays(bundle, path, **changes):
    """Write a bundle without our own check, as an enemy would."""
    tensors = {**format._tensors(bundle), **changes}
    described = bundle.info.model_dump(mode="json")
    text = {"kind": format.KIND, "format_version": 1, "info": described}
    text["sha256"] = format._digest(described, tensors)
    from safetensors.numpy import save

    path.write_bytes(save(tensors, {"bundle": json.dumps(text)}))
    return path


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("flux/mean", lambda a: 0 * a, "must have a sum of 1"),
        ("flux/basis", lambda a: 0 * a, "must have orthonormal columns"),
        ("flux/variance", lambda a: -a, "must have numbers from 0 to 1e+06"),
        ("flux/variance", lambda a: a + 1e300, "must have numbers from 0 to 1e+06"),
        ("flux/rest", lambda a: a - 1, "must have numbers from 0 to 1e+06"),
        ("flux/high", lambda a: a - 9, "must have at least flux/low"),
        ("rms", lambda a: a.astype(np.float64), "of float64, not float32"),
    ],
)
def test_numbers_that_no_training_leaves_are_refused(tmp_path, name, change, message):
    bundle = read_bundle()
    array = np.asarray(change(format._tensors(bundle)[name]))
    path = with_arrays(bundle, tmp_path / "x.psf.safetensors", **{name: array})
    line = refused("describe", path)
    assert name in line and message in line
    write_cube(tmp_path / "c.fits", np.ones((2, 16, 16)), PIXSCALE=0.1)
    refused("predict", tmp_path / "c.fits", "--model", path, "--out", tmp_path / "o.fits")


def described(path, change):
    """The shipped bundle with another description, signed anew."""
    from safetensors.numpy import load, save

    tensors, info = load(shipped_path().read_bytes()), read_bundle().info.model_dump(mode="json")
    info = change(info) or info
    text = {"kind": format.KIND, "format_version": 1, "info": info}
    text["sha256"] = format._digest(info, tensors)
    path.write_bytes(save(tensors, {"bundle": json.dumps(text)}))
    return path


def test_even_kernels_are_refused(tmp_path):
    path = described(
        tmp_path / "x.psf.safetensors", lambda info: info["dae"]["kernels"].__setitem__(0, 8)
    )
    assert "must be odd" in refused("describe", path)


def test_a_description_deeper_than_pydantic_writes_is_refused(tmp_path):
    def deepen(info):
        info["config"]["a"] = hostile_files.deep(300)

    path = described(tmp_path / "x.psf.safetensors", deepen)
    assert "nested too deeply" in refused("describe", path)


def test_a_deep_description_is_refused(tmp_path):
    from safetensors.numpy import save

    deep = '{"kind": "psfdae bundle", "format_version": 1, "info": {"config": ' + "[" * 100_000
    (tmp_path / "x.psf.safetensors").write_bytes(save({"a": np.zeros(1)}, {"bundle": deep}))
    assert "nested too deeply" in refused("describe", tmp_path / "x.psf.safetensors")


def test_descriptions_are_printed_without_escape_sequences(tmp_path):
    path = described(
        tmp_path / "x.psf.safetensors",
        lambda info: info.update(name="a\x1b[31mb", licence="c\nLicence  MIT\x07"),
    )
    code, output = command("describe", path)
    assert code == 0 and "\x1b" not in output and "\x07" not in output
    assert "a?[31mb" in output and "c Licence MIT?" in output
    path = described(path, lambda info: {**info, "\x1b]0;title\x07": 1})
    assert "\x1b" not in refused("describe", path)


def large(side, path):
    """A bundle of large stamps with four eigenvectors."""
    bundle, kept = read_bundle(), 4
    grid = np.arange(side) - side // 2
    mean = np.exp(-(grid[:, None] ** 2 + grid**2) / 50.0).ravel()
    mean /= mean.sum()
    maps = np.ones((len(bundle.noise_nodes), side, side), np.float32)
    basis = np.linalg.qr(np.random.default_rng(1).normal(size=(side**2, kept)))[0]
    flux = replace(
        bundle.flux_model, mean=mean, low=0 * mean, high=2 * mean, rest=1e-15,
        basis=basis, variance=np.full(kept, 1e-12),
    )  # fmt: skip
    info = bundle.info.model_copy(update={"stamp_px": side, "components": kept})
    made = replace(bundle, info=info, flux_model=flux, error68=maps, rms=maps)
    write_bundle(made, path)
    return made


def test_large_stamps_take_the_memory_of_their_eigenvectors(tmp_path):
    """A whole basis of 256 × 256 pixels would take 32 GiB."""
    made = large(256, tmp_path / "x.psf.safetensors")
    found = read_bundle(tmp_path / "x.psf.safetensors")
    assert found.flux_model.basis.shape == (256**2, 4)
    assert found.sha256 == made.sha256


def test_large_stamps_are_predicted_in_small_blocks(tmp_path):
    made = large(64, tmp_path / "x.psf.safetensors")
    model = load_model(tmp_path / "x.psf.safetensors")
    assert model.engine.size == engine.BLOCK // 4
    noise = np.random.default_rng(2).normal(0, 1, (70, 64, 64))
    found = model.predict(noise + 1e6 * made.flux_model.mean.reshape(64, 64))
    assert found.flux == pytest.approx(1e6, rel=0.01)


def test_predictions_do_not_depend_on_who_completes_the_basis(monkeypatch, field_psfs, shipped):
    """Large stamps' way, on small ones: the same predictions but for rounding."""
    monkeypatch.setattr(format, "COMPLETED_PX", 0)
    lean = load_model()
    assert lean.bundle.flux_model.basis.shape[1] == lean.info.components < 256
    rng = np.random.default_rng(3)
    stamps = rng.poisson(2e4 * field_psfs[:60] + 100).astype(np.float32)
    stamps[::3, 4, 5] = np.nan
    stamps[::5, 9, 9] = 1e7
    for known in ({}, {"background": 100.0}):
        one, other = (model.predict(stamps, **known) for model in (shipped, lean))
        assert (one.flags == other.flags).all()
        for name in ("psf", "flux", "flux_error", "background", "noise", "chi2", "distance"):
            a, b = getattr(one, name), getattr(other, name)
            np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6 * np.nanmax(np.abs(a)))


# The command line.


@pytest.mark.parametrize("option", ["--extension", "--mask"])
@pytest.mark.parametrize("value", ["²", "٣", "9" * 5000, "1e3"])
def test_digits_that_are_no_number_name_an_extension(tmp_path, option, value):
    write_cube(tmp_path / "c.fits", np.ones((2, 16, 16)), PIXSCALE=0.1)
    line = refused("predict", tmp_path / "c.fits", option, value, "--out", tmp_path / "o.fits")
    assert "no extension" in line or "File name too long" in line


def test_lack_of_memory_is_one_line(tmp_path, monkeypatch):
    def fail(self, stars):
        return np.empty(2**50)

    monkeypatch.setattr("psfdae.prediction.engine.Engine.block", fail)
    write_cube(tmp_path / "c.fits", np.ones((2, 16, 16)), PIXSCALE=0.1)
    words = ["predict", tmp_path / "c.fits", "--out", tmp_path / "o.fits", "--quiet"]
    assert "not enough memory" in refused(*words)
    assert not (tmp_path / "o.fits").exists()


def test_results_never_take_the_place_of_what_they_are_made_of(tmp_path):
    model, stars = tmp_path / "m.psf.safetensors", tmp_path / "c.fits"
    shutil.copy(shipped_path(), model)
    write_cube(stars, np.ones((2, 16, 16)), PIXSCALE=0.1)
    field, table = tmp_path / "selection.csv", tmp_path / "t.csv"
    write_field(stars, field, np.ones((1, D, D)), *np.full((2, 1), 9.0), shape=(30, 40))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for words in (
        ["predict", stars, "--model", model, "--out", model, "--overwrite"],
        ["predict", stars, "--model", model, "--plot", model, "--out", table, "--overwrite"],
        ["predict", stars, "--mask", stars, "--out", stars, "--overwrite"],
        ["export", model, "--out", tmp_path / "x" / ".." / model.name],
        ["from-stars", stars, "--catalogue", field, "--pixel-scale", 1, "--out", tmp_path],
        ["example-field", "--catalogue", table, "--out", table],
    ):
        assert "is an input, too" in refused(*words)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_formulas_are_text_in_tables_for_spreadsheets(tmp_path):
    from psfdae.stages.calibration_stars import Candidates, write_selection

    names = np.array(["=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(A1)", "-5", "+1e3", "star"])
    bright = type("Bright", (), {"row": np.array([0])})()
    numbers = np.zeros(len(names))
    found = Candidates(names, np.zeros((len(names), 2)), numbers, numbers,
                       np.full(len(names), "good"), bright)  # fmt: skip
    write_selection(found, np.array([False]), tmp_path / "selection.csv")
    written = pd.read_csv(tmp_path / "selection.csv", dtype=str)["id"].tolist()
    assert written == ["'=cmd|' /C calc'!A0", "'+1+1", "'-2+3", "'@SUM(A1)", "-5", "+1e3", "star"]
    assert no_formula("\t=1") == "'\t=1"


def test_one_line_of_anything():
    assert one_line("a\n b\x1b[0m\u202ec") == "a b?[0m?c"


def test_names_of_files_are_no_formulas_of_the_map(tmp_path):
    star = np.exp(-((np.arange(16) - 8)[:, None] ** 2 + (np.arange(16) - 8) ** 2) / 8.0)
    path = tmp_path / "a$\\frac$.fits"
    write_field(path, tmp_path / "s.csv", 1e4 * star[None], *np.full((2, 1), 20.0), shape=(40, 40),
                pixel_scale_arcsec=0.1)  # fmt: skip
    words = ["predict", path, "--catalogue", tmp_path / "s.csv", "--plot", tmp_path / "a.png"]
    code, output = command(*words, "--out", tmp_path / "o.fits", "--quiet")
    assert code == 0, output


def test_a_bundle_of_any_size_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(format, "LARGEST", 1000)
    with pytest.raises(BundleError, match="bytes, at most 1000"):
        read_bundle()
