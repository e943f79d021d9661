"""Spoilt inputs, drawn by a seed: an `Error` or a result, never another exception or half a file.

Each kind of input is one small file that the readers take. A draw spoils it: bytes flipped, cut,
inserted or repeated; cards, cells and values that are NaN, infinite, huge, negative or words;
columns and rows exchanged. The first draws of each kind are fast tests, the others slow ones.
"""

from __future__ import annotations

import io
import re
import zlib
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from command_line import psfdae
from psfdae import Error, Stars, load_model, read_telescope
from psfdae.denoise.bundle import bundle_arrays, bundle_bytes, locate_shipped_model, read_bundle
from psfdae.denoise.field_models import load_field
from psfdae.image.image_input import ImageInput
from psfdae.photometry.image_photometry import measure_all_stars
from psfdae.psf.exchange import write_psfex, write_stdpsf
from psfdae.psf.interface import FieldPsfs
from psfdae.training.settings import from_words
from small_field import moffat, noisy

SIDE_PX, STARS = 64, 9
FAST, ALL = 4, 20
"""Draws of each kind in the fast suite, and in all."""

JUNK = ["nan", "inf", "-inf", "1e400", "-1", "0", "99999999999", "1e-320", "", "x", "'", "1,5"]
JUNK += ["[1]", "{}", "null", "true", "007", "12:34:56", "ä", "%s", "1" * 400]
NUMBERS = [np.nan, np.inf, -np.inf, 1e38, -1e38, 0.0, -1.0, 1e-38]


def as_bytes(hdus):
    content = io.BytesIO()
    fits.HDUList(hdus).writeto(content)
    return content.getvalue()


def good_image():
    """Counts of nine stars on 64 × 64 pixels, and their places, x and y from 0."""
    rng = np.random.default_rng(5)
    place = np.stack(np.meshgrid([12, 32, 52], [12, 32, 52]), axis=-1).reshape(-1, 2)
    place = place + rng.uniform(-0.5, 0.5, place.shape)
    y, x = np.indices((SIDE_PX, SIDE_PX))
    distance = np.hypot(x - place[:, :1, None], y - place[:, 1:, None])
    light = np.tensordot(np.geomspace(3e3, 1e5, STARS), moffat(3.0)(distance), 1)
    return noisy(light, rng).astype(np.float32), place


def write_list(place, form):
    """A star list with identifiers, positions and fluxes, in a format of astropy."""
    table = Table({"id": [f"s{k:02d}" for k in range(STARS)]})
    table["x_fit"], table["y_fit"] = np.round(place, 2).T
    table["mag"] = np.linspace(10.0, 14.0, STARS)
    content = io.BytesIO() if form in ("fits", "votable") else io.StringIO()
    table.write(content, format=form)
    content = content.getvalue()
    return content if isinstance(content, bytes) else content.encode()


LISTS = {
    "list.csv": "ascii.csv",
    "list.txt": "ascii.basic",
    "list.ecsv": "ascii.ecsv",
    "list.tbl": "ascii.ipac",
    "list.fits": "fits",
    "list.vot": "votable",
}
TELESCOPE = """\
name: tiny
diameter_m: 0.2
obscuration: 0.3
wavelength_m: 6.0e-07
pixel_scale_arcsec: 1.2
field_edge_deg: 0.1
aberrations:
  kind: zernike
  terms:
    z4: {constant: 0.03, xx: 0.08}
    z7: {y: 0.07}
seeing: {kind: moffat, fwhm_arcsec: 2.5, beta: 3.0}
prior: {seeing: 0.2, waves: 0.1}
"""
SETTINGS = """\
seed=3
methods=[gmm,field]
framing.stamp_px=16
calibration_stars.snr_min=30
field.orders=[0,2]
gmm.components=[4]
evaluation.threads=1
"""


class RoundField(FieldPsfs):
    """The same round PSF everywhere."""

    name, sha256, stamp_px, order, image_px = "round", "0" * 64, 12, 0, (SIDE_PX, SIDE_PX)

    def field_range(self):
        return np.zeros(2), np.full(2, SIDE_PX - 1.0)

    def check_scale(self, pixel_scale_arcsec, subject):
        pass

    def draw_psfs(self, position, oversampling):
        axis = np.arange(oversampling * self.stamp_px + (oversampling > 1)) / oversampling
        phase = position - np.floor(position + 0.5)
        x, y = (axis - self.stamp_px // 2 - offset[:, None] for offset in phase.T)
        return moffat(3.0)(np.hypot(x[:, None, :], y[:, :, None]))


@cache
def good_files():
    """Contents of all inputs by their names; two more that nobody spoils."""
    counts, place = good_image()
    scale = load_model().info.pixel_scale_arcsec
    camera = {"GAIN": 1.5, "RDNOISE": 5.0, "SATURATE": 6e4, "PIXSCALE": scale}
    files = {name: write_list(place, form) for name, form in LISTS.items()}
    lines = [f"circle({x + 1:.2f},{y + 1:.2f},3) # text={{s{x:.0f}}}" for x, y in place]
    files["list.reg"] = "\n".join(["# Region file format: DS9", "image", *lines, ""]).encode()
    files["image.fits"] = as_bytes([fits.PrimaryHDU(counts, fits.Header(camera.items()))])
    files["mask.fits"] = as_bytes([fits.PrimaryHDU((counts > 5e3).astype(np.uint8))])
    files["error.fits"] = as_bytes([fits.PrimaryHDU(np.sqrt(np.maximum(counts, 1.0)))])
    files["model.psf.safetensors"] = locate_shipped_model().read_bytes()
    with TemporaryDirectory() as folder:
        path = Path(folder, "out")
        write_psfex(path, RoundField(), 2)
        files["field.psf"] = path.read_bytes()
        write_stdpsf(path, RoundField(), 2, 2)
        files["stdpsf.fits"] = path.read_bytes()
    files["telescope.yaml"] = TELESCOPE.encode()
    files["settings.txt"] = SETTINGS.encode()
    return files


# Spoiling.


def spoil_bytes(content, rng):
    """Bytes flipped, cut, inserted, repeated or none left."""
    raw = bytearray(content)
    first, second = sorted(rng.integers(0, len(raw) + 1, 2).tolist())
    match rng.integers(6):
        case 0:
            for place in rng.integers(0, len(raw), rng.integers(1, 20)):
                raw[place] ^= int(rng.integers(1, 256))
        case 1:
            raw = raw[:first]
        case 2:
            raw[first:first] = rng.bytes(int(rng.integers(1, 100)))
        case 3:
            raw[second:second] = raw[first:second]
        case 4:
            del raw[first:second]
        case 5:
            raw = raw[:0]
    return bytes(raw)


def spoil_text(content, rng):
    """Words of a text replaced by junk, exchanged or left out, or rows exchanged."""
    parts = re.split(r"([\s,;:=|<>{}()]+)", content.decode())
    words = [k for k, part in enumerate(parts) if k % 2 == 0 and part]
    for _ in range(rng.integers(1, 4)):
        first, second = rng.choice(words, 2)
        match rng.integers(3):
            case 0:
                parts[first] = str(rng.choice(JUNK))
            case 1:
                parts[first], parts[second] = parts[second], parts[first]
            case 2:
                parts[first] = ""
    lines = "".join(parts).split("\n")
    if rng.integers(3) == 0:
        first, second = rng.integers(0, len(lines), 2)
        lines[first], lines[second] = lines[second], lines[first]
    return "\n".join(lines).encode()


def spoil_header(content, rng):
    """A card of a header that has another value."""
    cards = [k for k in range(0, len(content), 80) if content[k + 8 : k + 10] == b"= "]
    raw = bytearray(content)
    for place in rng.choice(cards, rng.integers(1, 3)):
        text = str(rng.choice([*JUNK, "T", "'F8.3'", "-32", "64", "1000000"]))
        raw[place + 10 : place + 80] = text.encode("ascii", "replace")[:70].rjust(20).ljust(70)
    return bytes(raw)


def spoil_values(content, rng):
    """Pixels or cells of a FITS file that are no usual numbers, or columns that are exchanged."""
    with fits.open(io.BytesIO(content), memmap=False) as hdus:
        for hdu in hdus:
            if hdu.data is None:
                continue
            if isinstance(hdu, fits.BinTableHDU):
                # The number of a column is in the names of its cards.
                first, second = rng.integers(1, len(hdu.columns) + 1, 2)
                header = hdu.header
                header[f"TTYPE{first}"], header[f"TTYPE{second}"] = (
                    header[f"TTYPE{number}"] for number in (second, first)
                )
            is_spoilt = rng.random(hdu.data.shape) < rng.choice([0.01, 0.5, 1.0])
            number = rng.choice(NUMBERS)
            if hdu.data.dtype.kind == "f":
                hdu.data[is_spoilt] = number
            for name in hdu.data.dtype.names or ():
                if hdu.data[name].dtype.kind == "f":
                    hdu.data[name][is_spoilt] = number
        return as_bytes([hdu.copy() for hdu in hdus])


def spoil_model(content, rng):
    """A sound file of a model, one array of which has other values or another shape."""
    bundle = read_bundle()
    arrays = bundle_arrays(bundle)
    name = str(rng.choice(sorted(name for name in arrays if np.size(arrays[name]))))
    array = np.array(arrays[name])
    match rng.integers(3):
        case 0:
            array.flat[rng.integers(0, array.size, 3)] = rng.choice(NUMBERS)
        case 1:
            array = array[1:] if array.ndim else array
        case 2:
            array = array * np.float32(rng.choice([-1.0, 0.0, 1e30, 1e-30]))
    arrays[name] = np.ascontiguousarray(array)
    return bundle_bytes(bundle.info, arrays)


def spoil(name, rng):
    """The content of an input, spoilt in one of the ways of its format."""
    if name == "model.psf.safetensors":
        ways = (spoil_bytes, spoil_model)
    elif name.endswith((".fits", ".psf")):
        ways = (spoil_bytes, spoil_header, spoil_values)
    else:
        ways = (spoil_bytes, spoil_text, spoil_text)
    return ways[rng.integers(len(ways))](good_files()[name], rng)


# Calls.


def measure(folder, **statements):
    """PSFs and fluxes of the stars of the image, by any of the models, in a few pixels."""
    words = {"catalogue": folder / "list.csv", **statements}
    load_model().predict_image(folder / "image.fits", **words)


def call_python(folder, name):
    """Read an input by the public call that takes it, and use it."""
    path = folder / name
    if name.startswith("list"):
        measure(folder, catalogue=path)
    elif name == "image.fits":
        measure(folder)
        Stars.from_image(path, catalogue=folder / "list.csv", stamp_px=8)
    elif name in ("mask.fits", "error.fits"):
        measure(folder, **{name.partition(".")[0]: path})
    elif name == "model.psf.safetensors":
        load_model(path).predict(np.random.default_rng(1).normal(100, 9, (3, 16, 16)))
    elif name in ("field.psf", "stdpsf.fits"):
        source = ImageInput.build(folder / "image.fits", {"catalogue": folder / "list.csv"})
        measure_all_stars(load_field(path), source)
    elif name == "telescope.yaml":
        read_telescope(path)
    else:
        words = path.read_bytes().decode("utf-8", "surrogateescape")  # as of a command line
        from_words(words.strip("\n").split("\n"))


def command(folder, name):
    """Words of a command that reads an input and writes a file."""
    image, path = folder / "image.fits", folder / name
    words = ["predict", image, "--catalogue", path if name.startswith("list") else "list.csv"]
    if name in ("mask.fits", "error.fits"):
        words += [f"--{name.partition('.')[0]}", path]
    elif name == "model.psf.safetensors":
        words += ["--model", path]
    elif name in ("field.psf", "stdpsf.fits"):
        words = ["psf", path, "--grid", "2x2"]
    elif name == "telescope.yaml":
        words = ["wavefront", image, "--catalogue", "list.csv", "--telescope", path]
    return [*words, "--out", "out.csv" if words[0] == "wavefront" else "out.fits", "--quiet"]


@pytest.mark.parametrize(
    "draws", [range(FAST), pytest.param(range(FAST, ALL), marks=pytest.mark.slow)], ids=str
)
@pytest.mark.parametrize("name", sorted(good_files()))
def test_a_spoilt_input_is_an_error_or_gives_a_result(tmp_path, monkeypatch, name, draws):
    monkeypatch.chdir(tmp_path)
    for other, content in good_files().items():
        (tmp_path / other).write_bytes(content)
    files = {*tmp_path.iterdir()}
    if draws.start:
        call_python(tmp_path, name)  # the sound file gives a result
    for draw in draws:
        rng = np.random.default_rng([draw, zlib.crc32(name.encode())])
        (tmp_path / name).write_bytes(spoil(name, rng))
        try:
            call_python(tmp_path, name)
        except Error:
            pass
        except Exception as error:
            error.add_note(f"{name}, draw {draw}")
            raise
        # The command line: a whole file and code 0, or none and code 2.
        if draw % 4 == 0 and name != "settings.txt":
            result = psfdae(*command(tmp_path, name))
            out = {*tmp_path.iterdir()} - files
            assert (result.exit_code, len(out)) in ((0, 1), (2, 0)), (draw, result.output, out)
            for path in out:
                if path.suffix == ".fits":
                    with fits.open(path, checksum=True) as hdus:
                        hdus.verify("exception")
                path.unlink()
