"""Files of an enemy: one line and exit code 2, in little memory and time."""

from __future__ import annotations

import gc
import json
import os
import shutil
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from command_line import psfdae, refused
from fits_inputs import PACK, open_observation, write_cube, write_field, write_good
from prediction_stars import with_network
from psfdae import load_model
from psfdae.image import catalogue
from psfdae.image import fits_file as images
from psfdae.image.catalogue import read_catalogue
from psfdae.image.errors import ObservationError, no_formula, one_line
from psfdae.image.selection import Candidates
from psfdae.model import bundle as module
from psfdae.model.bundle import BundleError, read_bundle, shipped_path, write_bundle
from psfdae.model.psf_model import BLOCK
from workflow_runs import captured

D = 8


def cards(*lines):
    """A FITS header."""
    text = "".join(f"{line:<80}" for line in (*lines, "END"))
    return text.ljust(-(-len(text) // 2880) * 2880).encode()


PRIMARY = ("BITPIX  =                    8", "NAXIS   =                    0")
GOOD, NEVER = (cards(f"SIMPLE  =                    {value}", *PRIMARY) for value in "TF")
EXTENSION = cards("XTENSION= 'IMAGE   '", *PRIMARY, "PCOUNT  = 0", "GCOUNT  = 1")


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Files of every kind, and a model."""
    folder = tmp_path_factory.mktemp("good")
    write_good(folder)
    shutil.copy(shipped_path(), folder / "model.psf.safetensors")
    return folder


EDITS = st.lists(st.tuples(st.floats(0, 1), st.binary(max_size=90), st.integers(0, 90)), max_size=5)


@pytest.mark.parametrize(
    "name",
    [
        *("cube.fits", "cube.gz", "image.fits", "image.fz", "s.csv", "s.ecsv"),
        "model.psf.safetensors",
    ],
)
@settings(
    max_examples=15,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(edits=EDITS, kept=st.floats(0.01, 1))
def test_any_damage_ends_with_a_product_or_one_line(good, tmp_path, name, edits, kept):
    raw = bytearray((good / name).read_bytes())
    for place, new, removed in edits:
        start = int(place * min(len(raw), 9000))  # headers, mostly
        raw[start : start + removed] = new
    path, out = tmp_path / name, tmp_path / "out.fits"
    path.write_bytes(raw if kept > 0.3 else raw[: int(kept * len(raw))])
    words = ["predict", path, "--out", out, "--pixel-scale", "0.1", "--quiet", "--overwrite"]
    if name.startswith("image"):
        words += ["--catalogue", good / "s.csv"]
    if name.startswith("s."):
        words[1:2] = [good / "image.fits", "--catalogue", path]
    if name.startswith("model"):
        words[1:2] = [good / "cube.fits", "--model", path]
    done = psfdae(*words)
    assert done.exit_code in (0, 2), done.output
    if done.exit_code == 2:
        assert len([line for line in done.stderr.splitlines() if line]) == 1, done.stderr
        assert all(c.isprintable() or c == "\n" for c in done.stderr)
    assert (done.exit_code == 0) == out.exists()
    out.unlink(missing_ok=True)


def deep(depth):
    """A list in a list in a list …"""
    found = 1
    for _ in range(depth):
        found = [found]
    return found


# FITS files without end.


@pytest.mark.parametrize("pack", PACK)
def test_packed_files_are_unpacked_to_a_limit_and_read_like_plain_ones(tmp_path, monkeypatch, pack):
    room, path = tmp_path / "room", tmp_path / "packed"
    room.mkdir()
    monkeypatch.setenv("TMPDIR", str(room))
    monkeypatch.setattr(images.tempfile, "tempdir", None)
    monkeypatch.setattr(images, "WHOLE", images.Limit(3 * 10**6))
    stamps = np.random.default_rng(1).normal(9, 2, (5, D, D)).astype(np.float32)
    write_cube(tmp_path / "a.fits", stamps)
    path.write_bytes(PACK[pack]((tmp_path / "a.fits").read_bytes()))
    np.testing.assert_array_equal(next(open_observation(path, D).chunks(9)).data, stamps)
    for data, message in (
        (NEVER + bytes(10**7), "SIMPLE is not T"),
        (GOOD + bytes(2 * 10**7), "unpacks to more than"),
    ):
        path.write_bytes(PACK[pack](data))
        assert message in refused("predict", path, "--out", tmp_path / "o.fits")
    gc.collect()  # a copy lives as long as what was read from it
    assert list(room.iterdir()) == [] and not (tmp_path / "o.fits").exists()


def test_unpacking_leaves_half_of_the_free_space(monkeypatch):
    usage = shutil.disk_usage(".")._replace(free=1000)
    monkeypatch.setattr(images.shutil, "disk_usage", lambda folder: usage)
    allowed, words = images.WHOLE.of(10)
    assert allowed == 500 and "TMPDIR" in words


def test_a_zip_file_of_several_files_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as packed:
        packed.writestr("a.fits", GOOD)
        packed.writestr("b.fits", GOOD)
    with pytest.raises(ObservationError, match="2 files in a zip file"):
        open_observation(tmp_path / "a.zip", D)


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
    monkeypatch.setattr(images, "MOST_HDUS", 100)
    most = 200 if "extensions" in message else 10
    monkeypatch.setattr(images, "LONGEST_HEADERS", 2880 * most)
    (tmp_path / "a.fits").write_bytes(data)
    with pytest.raises(ObservationError, match=message):
        open_observation(tmp_path / "a.fits", D)


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


def test_distortion_of_any_order_does_not_keep_us(tmp_path):
    x = np.array([9.0])
    path, stars = tmp_path / "a.fits", tmp_path / "s.csv"
    write_field(path, stars, np.ones((1, D, D)), x, x, (30, 40))
    order = {"A_ORDER": 30_000, "B_ORDER": 30_000}
    with fits.open(path, mode="update") as hdus:
        hdus[0].header.update(CTYPE1="RA---TAN-SIP", CTYPE2="DEC--TAN-SIP", **order)
    assert open_observation(path, D, catalogue=stars).pixel_scale_arcsec is None


# Tiles.


def write_tiles(path, image, **options):
    """A compressed image and a catalogue of a star on it."""
    packed = fits.CompImageHDU(image, **options)
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(path)
    path.with_suffix(".csv").write_text("X_IMAGE,Y_IMAGE\n20,20\n")
    return path


@pytest.mark.parametrize("tile", [(1, 70), (7, 9), (60, 3), (60, 70)])
def test_tiles_are_decompressed_in_blocks(tmp_path, monkeypatch, tile):
    """Rows or columns of tiles at a time, whatever their shape: the same values as at once."""
    image = np.random.default_rng(1).poisson(900, (60, 70)).astype(np.int32)
    path = write_tiles(tmp_path / "a.fz", image, tile_shape=tile)
    monkeypatch.setattr(images, "BLOCK_PX", 150)
    with fits.open(path) as hdus, (tmp_path / "copy").open("w+b") as copy:
        np.testing.assert_array_equal(images.decompress(path, hdus[1], copy), image)


def test_an_image_of_tiles_takes_little_more_memory_than_its_pixels(tmp_path):
    """4096² pixels, 64 MB as float32, from a child whose data may grow by ten times that.

    Bad pixels are searched for in the image as a whole, with several arrays of its size.
    """
    image = np.zeros((4096, 4096), np.int32)
    image[::64] = np.arange(4096) % 97
    path = write_tiles(tmp_path / "a.fz", image, tile_shape=(16, 4096))
    path.with_suffix(".csv").write_text("X_IMAGE,Y_IMAGE\n2000,65\n100,4001\n")
    script = (
        "import pathlib, re, resource, sys\n"
        "from fits_inputs import open_observation\n"
        "a = pathlib.Path(sys.argv[1])\n"
        "found = open_observation(a, 8, catalogue=a.with_suffix('.csv'))\n"
        "status = pathlib.Path('/proc/self/status').read_text()\n"
        "limit = 1024 * int(re.search(r'VmData:\\s+(\\d+)', status)[1]) + 640 * 2**20\n"
        "resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))\n"
        "chunk, = found.chunks(9)\n"
        "print(chunk.data[0, 4].astype(int).tolist())\n"
    )
    where = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": where, "OMP_NUM_THREADS": "1"}
    words = [sys.executable, "-c", script, path]
    done = captured(words, env=env)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == image[64, 1995:2003].tolist()


def test_tiles_and_images_that_are_too_large_are_refused(tmp_path, monkeypatch):
    path = write_tiles(tmp_path / "a.fz", np.ones((64, 64), np.int32), tile_shape=(64, 64))
    found = open_observation(path, D, catalogue=path.with_suffix(".csv"))
    monkeypatch.setattr(images, "DECOMPRESSED", images.Limit(10_000, 0))
    with pytest.raises(ObservationError, match="decompresses to 16384 bytes, more than 10000"):
        list(found.chunks(9))
    monkeypatch.setattr(images, "LARGEST_TILE", 4095)
    with pytest.raises(ObservationError, match="tiles of 64×64 pixels"):
        open_observation(path, D, catalogue=path.with_suffix(".csv"))


@pytest.mark.parametrize(
    ("cards", "message"),
    [
        ({"ZVAL1": 0}, "damaged: "),
        ({"ZVAL2": 8}, "damaged: "),
        ({"ZNAXIS2": 9999}, "damaged: "),
        ({"ZNAXIS1": "text", "ZNAXIS2": 2**31}, "damaged: ZNAXIS1"),
        ({"ZCMPTYPE": "HCOMPRESS_1"}, "compressed with HCOMPRESS_1, accepted are RICE_1"),
        ({"ZCMPTYPE": "PLIO_1"}, "compressed with PLIO_1, accepted are RICE_1"),
    ],
)
def test_tiles_that_are_damaged_or_whose_decoder_is_not_safe_are_refused(tmp_path, cards, message):
    path = write_tiles(tmp_path / "a.fz", np.ones((16, 16), np.int32))
    with fits.open(path, mode="update", disable_image_compression=True) as hdus:
        hdus[1].header.update(cards)
    with pytest.raises(ObservationError, match=message):
        open_observation(path, 16)


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
def test_too_many_stars_and_long_identifiers_are_refused(tmp_path, monkeypatch, suffix):
    path = tmp_path / f"s.{suffix}"
    Table({"id": ["a", "b" * 201], "x": [1.0, 2.0], "y": [1.0, 2.0]}).write(path)
    with pytest.raises(ObservationError, match="'id' has 201 characters in row 2"):
        read_catalogue(path).identifiers()
    monkeypatch.setattr(catalogue, "MOST_STARS", 1)
    with pytest.raises(ObservationError, match=r"[23] stars in a catalogue, at most 1"):
        read_catalogue(path)


def test_a_text_table_is_read_up_to_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(catalogue, "LARGEST_TEXT", 100)
    (tmp_path / "s.csv").write_text("x,y\n" + 30 * "1,1\n")
    for path in (tmp_path / "s.csv", Path("/dev/zero")):
        with pytest.raises(ObservationError, match="more than 100 bytes; a FITS table may be"):
            read_catalogue(path)


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


# Bundles, written without our own check, as an enemy would.


def signed(path, change=lambda info: None, **arrays):
    """A bundle of a network with another description and other arrays."""
    bundle = with_network(read_bundle())
    tensors, info = module._tensors(bundle), bundle.info.described()
    for name, make in arrays.items():
        tensors[name] = np.asarray(make(tensors[name]))
    path.write_bytes(module.packed(change(info) or info, tensors))
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
        ("error68", lambda a: -a, "must have numbers of at least 0"),
    ],
)
def test_numbers_that_no_training_leaves_are_refused(tmp_path, name, change, message):
    path = signed(tmp_path / "x.psf.safetensors", **{name: change})
    line = refused("describe", path)
    assert name in line and message in line
    write_cube(tmp_path / "c.fits", np.ones((2, 16, 16)), PIXSCALE=0.1)
    refused("predict", tmp_path / "c.fits", "--model", path, "--out", tmp_path / "o.fits")


@pytest.mark.parametrize("name", ["scale68", "scale95", "flux_error_scale"])
def test_factors_of_errors_below_0_are_refused(tmp_path, name):
    """With them, `predict` wrote negative standard errors."""
    bundle, path = read_bundle(), tmp_path / "x.psf.safetensors"
    tensors = module._tensors(bundle)
    path.write_bytes(module.packed(bundle.info.described(), tensors | {name: -tensors[name]}))
    message = f"array '{name}' must have numbers of at least 0"
    assert message in refused("describe", path)
    write_cube(tmp_path / "c.fits", np.ones((2, 16, 16)), PIXSCALE=0.1)
    words = ["predict", tmp_path / "c.fits", "--model", path, "--out", tmp_path / "o.fits"]
    assert message in refused(*words)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("axes", lambda a: 1.1 * a, "orthonormal columns"),
        ("variance", lambda a: -a, "numbers from 0 to 1"),
        ("count", lambda a: 0 * a, "a star or more in each cluster"),
    ],
)
def test_arrays_of_a_mixture_that_no_training_leaves_are_refused(tmp_path, name, change, message):
    bundle, path = read_bundle(), tmp_path / "x.psf.safetensors"
    array = bundle.weights[name]
    weights = bundle.weights | {name: np.asarray(change(array), array.dtype)}
    write_bundle(replace(bundle, weights=weights), path)
    write_cube(tmp_path / "c.fits", np.ones((2, 16, 16)), PIXSCALE=0.1)
    words = ["predict", tmp_path / "c.fits", "--model", path, "--out", tmp_path / "o.fits"]
    assert f"damaged (gmm: array '{name}' must have {message})" in refused(*words)


def told(info, noise):
    """The description of a method that is told λ, of format 2."""
    kept = {key: value for key, value in info.items() if key not in ("dae", "image_scale")}
    own = {"format_version": 2, "method": "lmmse", "reference": "realisation"}
    return {**kept, **own, "config": {"train": {"noise": noise}}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda info: info["dae"]["kernels"].__setitem__(0, 8), "must be odd"),
        (lambda info: info.update(image_scale=None), "has dae and image_scale"),
        (lambda info: told(info, {"kappa": 0.0}), "kappa: must be above 0"),
        (lambda info: told(info, {"kappa": 1e999}), "kappa: must be above 0"),
        (lambda info: told(info, {}), "kappa: must be above 0"),
        (lambda info: info["config"].update(a=deep(300)), "nested too deeply"),
        (lambda info: {**info, "\x1b]0;title\x07": 1}, "]0;title?"),
    ],
)
def test_descriptions_of_an_enemy_are_refused(tmp_path, change, message):
    line = refused("describe", signed(tmp_path / "x.psf.safetensors", change))
    assert message in line and "\x1b" not in line


def test_a_description_that_json_cannot_read_is_refused(tmp_path):
    from safetensors.numpy import save

    deep = '{"kind": "psfdae bundle", "format_version": 3, "info": {"config": ' + "[" * 100_000
    (tmp_path / "x.psf.safetensors").write_bytes(save({"a": np.zeros(1)}, {"bundle": deep}))
    assert "nested too deeply" in refused("describe", tmp_path / "x.psf.safetensors")


def test_descriptions_are_printed_without_escape_sequences(tmp_path):
    path = signed(
        tmp_path / "x.psf.safetensors",
        lambda info: info.update(name="a\x1b[31mb", licence="c\nLicence  MIT\x07"),
    )
    said = psfdae("describe", path)
    assert said.exit_code == 0 and "\x1b" not in said.output and "\x07" not in said.output
    assert "a?[31mb" in said.output and "c Licence MIT?" in said.output


def test_a_bundle_of_any_size_is_not_read(monkeypatch):
    monkeypatch.setattr(module, "LARGEST", 1000)
    with pytest.raises(BundleError, match="bytes, at most 1000"):
        read_bundle()


def large(side, path):
    """A network's bundle of large stamps with four eigenvectors."""
    bundle, kept = with_network(read_bundle()), 4
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
    assert model.engine.size == BLOCK // 4
    noise = np.random.default_rng(2).normal(0, 1, (70, 64, 64))
    found = model.predict(noise + 1e6 * made.flux_model.mean.reshape(64, 64))
    assert found.flux == pytest.approx(1e6, rel=0.01)


def test_predictions_do_not_depend_on_who_completes_the_basis(monkeypatch, field_psfs, shipped):
    """Large stamps' way, on small ones: the same predictions but for rounding."""
    monkeypatch.setattr(module, "COMPLETED_PX", 0)
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
    monkeypatch.setattr("psfdae.model.psf_model.Engine.block", lambda *_: np.empty(2**50))
    write_cube(tmp_path / "c.fits", np.ones((2, 16, 16)), PIXSCALE=0.1)
    words = ["predict", tmp_path / "c.fits", "--out", tmp_path / "o.fits", "--quiet"]
    assert "not enough memory" in refused(*words)
    assert not (tmp_path / "o.fits").exists()


def test_results_never_take_the_place_of_what_they_are_made_of(tmp_path):
    model, stars = tmp_path / "m.psf.safetensors", tmp_path / "c.fits"
    shutil.copy(shipped_path(), model)
    field, table = tmp_path / "selection.csv", tmp_path / "t.csv"
    write_field(stars, field, np.ones((1, D, D)), *np.full((2, 1), 9.0), (30, 40))
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


def test_formulas_are_text_in_tables_for_spreadsheets():
    names = np.array(["=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(A1)", "-5", "+1e3", "star"])
    bright = type("Bright", (), {"row": np.array([0])})()
    numbers, good = np.zeros(7), np.full(7, "good")
    found = Candidates(names, np.zeros((7, 2)), *[numbers] * 5, good, bright)
    written = found.table(np.array([False]))["id"].tolist()
    assert written == ["'=cmd|' /C calc'!A0", "'+1+1", "'-2+3", "'@SUM(A1)", "-5", "+1e3", "star"]
    assert no_formula("\t=1") == "'\t=1"


def test_one_line_of_anything():
    assert one_line("a\n b\x1b[0m\u202ec") == "a b?[0m?c"


def test_names_of_files_are_no_formulas_of_the_map(tmp_path):
    star = np.exp(-((np.arange(16) - 8)[:, None] ** 2 + (np.arange(16) - 8) ** 2) / 8.0)
    path, stars = tmp_path / "a$\\frac$.fits", tmp_path / "s.csv"
    place = np.full((2, 1), 20.0)
    write_field(path, stars, 1e4 * star[None], *place, (40, 40), pixel_scale_arcsec=0.1)
    words = ["predict", path, "--catalogue", stars, "--plot", tmp_path / "a.png"]
    said = psfdae(*words, "--out", tmp_path / "o.fits", "--quiet")
    assert said.exit_code == 0, said.output
