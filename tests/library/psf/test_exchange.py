"""PSFs of a field in files of other programs: what they read is what the model says, and back."""

from __future__ import annotations

import gzip
import json
import pickle

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from photutils.psf import GriddedPSFModel

from command_line import printed, psfdae, refused
from psfdae import Error, load_model
from psfdae.denoise.bundle import name_foreign_format
from psfdae.denoise.field_models import load_field
from psfdae.psf import exchange
from psfdae.psf.exchange import PsfexField
from psfdae.psf.interface import FieldPsfs, PredictionError

galsim = pytest.importorskip("galsim")
des = pytest.importorskip("galsim.des")

LOW, HIGH = np.array([20.0, 40.0]), np.array([980.0, 640.0])
PLACES = np.random.default_rng(3).uniform(LOW, HIGH, (10, 2))


class Moving(FieldPsfs):
    """Two Gaussians of the sum 1, of 3 and 4 px FWHM and round and not, mixed over the field."""

    name, sha256, stamp_px, order, image_px = "moving", "0" * 64, 24, 2, (1000, 660)

    def field_range(self):
        return LOW, HIGH

    def check_scale(self, pixel_scale_arcsec, subject):
        pass

    def draw_psfs(self, place, oversampling):
        u, v = (2 * (place - LOW) / (HIGH - LOW) - 1).T
        axis = np.arange(oversampling * self.stamp_px + (oversampling > 1)) / oversampling
        axis = axis - self.stamp_px // 2
        phase = place - np.floor(place + 0.5)
        part = 0.4 + 0.3 * u - 0.2 * v + 0.1 * u * v
        x, y = ((axis - p[:, None]) ** 2 / 2 for p in phase.T)
        psf = 0.0
        for weight, first, second in ((part, 1.3, 1.3), (1 - part, 1.8, 1.5)):
            rows, columns = np.exp(-y / second**2), np.exp(-x / first**2)
            unit = weight / (2 * np.pi * first * second)
            psf = psf + unit[:, None, None] * rows[:, :, None] * columns[:, None]
        return psf


@pytest.mark.parametrize(("samples", "limit"), [(8, 1.5e-3), (16, 1e-3)])
def test_galsim_reads_what_is_written_for_psfex(tmp_path, samples, limit):
    """Positions, axes, phases, sampling and flux agree at ten places (Lanczos order 3)."""
    model, path = Moving(), tmp_path / "m.psf"
    assert exchange.write_psfex(path, model, samples) < 1e-6
    read = des.DES_PSFEx(str(path))
    for x, y in PLACES:
        expected = model.psf_at(x, y, 1)
        psf = read.getPSF(galsim.PositionD(x + 1, y + 1))
        # Its middle of an even image is half a pixel before index n//2.
        offset = (x - np.floor(x + 0.5) + 0.5, y - np.floor(y + 0.5) + 0.5)
        values = psf.drawImage(nx=24, ny=24, scale=1.0, method="no_pixel", offset=offset).array
        assert np.abs(values - expected).max() < limit * expected.max()


def test_psfex_comes_back(tmp_path):
    """The PSFs that were written are read again, at any sampling, and described alike."""
    model, path = Moving(), tmp_path / "m.psf"
    exchange.write_psfex(path, model, 8)
    back = load_field(path)
    assert (back.order, back.stamp_px, back.name) == (2, 24, "m")
    assert np.array(back.field_range()) == pytest.approx(np.array([LOW, HIGH]))
    for samples in (1, 3, 4):
        expected, converted = (m.psf_at(*PLACES.T, samples) for m in (model, back))
        assert converted.shape == expected.shape
        assert np.abs(converted - expected).max() < 1e-3 * expected.max()
    edge, outside = back.psf_at([980.0, 1500.0], [300.0, 300.0], 1)
    assert outside == pytest.approx(edge)


def test_photutils_reads_stdpsf(tmp_path):
    model, path = Moving(), tmp_path / "m.stdpsf.fits"
    exchange.write_stdpsf(path, model, 7, 5)
    grid = GriddedPSFModel.read(path)
    assert list(grid.oversampling) == [4, 4]
    assert grid.grid_xypos == pytest.approx(np.rint(model.grid(7, 5)))
    for x, y in PLACES:
        columns, rows = np.meshgrid(np.rint(x) + np.arange(-8, 9), np.rint(y) + np.arange(-8, 9))
        expected = model.psf_at(x, y, 1)[4:21, 4:21]
        values = grid.evaluate(columns, rows, 1.0, x, y)
        assert np.abs(values - expected).max() < 1e-3 * expected.max()


def stdpsf(path, columns, rows):
    exchange.write_stdpsf(path, Moving(), columns, rows)


def cube(path, columns, rows, oversampling=4):
    exchange.write_grid(path, Moving(), np.rint(Moving().grid(columns, rows)), oversampling)


def even_cube(path, columns, rows):
    """STPSF writes an even number of values, with the star in the middle of them."""
    positions = np.rint(Moving().grid(columns, rows))
    # Every other of eight values per pixel; the star is midway between two of them.
    psfs = Moving().psf_at(*positions.T, 8)[:, 1::2, 1::2]
    header = fits.Header({"OVERSAMP": 4})
    for number, (x, y) in enumerate(positions.tolist()):
        header[f"DET_YX{number}"] = f"({y}, {x})"
    fits.writeto(path, psfs, header)


@pytest.mark.parametrize("pack", [bytes, gzip.compress], ids=["plain", "gz"])
@pytest.mark.parametrize(
    ("write", "columns", "rows"),
    [(stdpsf, 7, 5), (cube, 7, 5), (cube, 12, 10), (even_cube, 7, 5)],
)
def test_grids_of_other_programs_are_read(tmp_path, write, columns, rows, pack):
    """Positions, axes, phases, sampling and flux; outside of the grid, the PSF of its edge."""
    path = tmp_path / "grid.fits"
    write(path, columns, rows)
    path.write_bytes(pack(path.read_bytes()))
    model, back = Moving(), load_field(path)
    assert np.array(back.field_range()) == pytest.approx(np.array([LOW, HIGH]))
    for samples in (1, 3, 4):
        expected, read = (m.psf_at(*PLACES.T, samples) for m in (model, back))
        assert np.abs(read - expected).max() < 1e-4 * expected.max()
    edge, outside = back.psf_at([980.0, 1500.0], [300.0, 300.0], 1)
    assert outside == pytest.approx(edge)


def test_a_single_psf_is_the_same_everywhere(tmp_path):
    exchange.write_grid(tmp_path / "m.fits", Moving(), np.array([[500.0, 300.0]]), 4)
    back = load_field(tmp_path / "m.fits")
    expected = Moving().psf_at(500.0, 300.0, 1)
    for place in ((500.0, 300.0), (20.0, 640.0)):
        assert np.abs(back.psf_at(*place, 1) - expected).max() < 1e-4 * expected.max()
    assert back.order == 0


def test_photometry_by_a_grid_of_another_program(tmp_path):
    """Fluxes of stars whose PSF changes over the image."""
    model, rng = Moving(), np.random.default_rng(5)
    stars = np.stack(np.meshgrid(np.arange(60, 940, 110), np.arange(70, 600, 110)), -1)
    stars = stars.reshape(-1, 2) + rng.uniform(-5, 5, (stars.size // 2, 2))
    flux = 10 ** rng.uniform(4.3, 5.0, len(stars))
    image = np.zeros((660, 1000))
    for (x, y), f, psf in zip(stars, flux, model.draw_on_pixels(stars), strict=True):
        row, column = (int(np.floor(v + 0.5)) - 12 for v in (y, x))
        image[row : row + 24, column : column + 24] += f * psf
    image = rng.poisson(image + 100.0).astype(np.float32)
    fits.writeto(tmp_path / "image.fits", image, fits.Header({"GAIN": 1.0, "SATURATE": 6e4}))
    Table({"x": stars[:, 0], "y": stars[:, 1]}).write(tmp_path / "list.csv")
    stdpsf(tmp_path / "m.stdpsf.fits", 9, 7)
    words = ["--catalogue", tmp_path / "list.csv", "--origin", 0, "--pixel-scale", 1]
    words += ["--model", tmp_path / "m.stdpsf.fits", "--out", tmp_path / "p.ecsv"]
    printed("photometry", tmp_path / "image.fits", *words)
    table = Table.read(tmp_path / "p.ecsv")
    pull = (table["flux"].value - flux) / table["flux_error"].value
    assert abs(np.median(table["flux"].value / flux) - 1) < 0.003
    assert 0.6 < np.sqrt(np.mean(pull**2)) < 1.6


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """Models of other programs."""
    folder = tmp_path_factory.mktemp("foreign")
    exchange.write_psfex(folder / "PSFEx", Moving(), 2)
    stdpsf(folder / "STDPSF", 3, 3)
    cube(folder / "STPSF", 3, 3)
    with fits.open(folder / "PSFEx") as hdus:
        fits.HDUList([hdus[0], hdus[1], hdus[1].copy()]).writeto(folder / "merged PSFEx")
    column = fits.Column("type", "8A", array=["Simple"])
    names = ("psf", "psf_stars", "psf_wcs", "psf_model", "psf_interp")
    tables = [fits.BinTableHDU.from_columns([column], name=name) for name in names]
    fits.HDUList([fits.PrimaryHDU(), *tables]).writeto(folder / "Piff")
    fits.writeto(folder / "FITS", np.zeros((9, 9)))
    (folder / "pickle").write_bytes(pickle.dumps([1]))
    (folder / "JSON").write_text('{"psf": 1}')
    return folder


@pytest.mark.parametrize(
    "name", ["PSFEx", "STDPSF", "STPSF", "merged PSFEx", "Piff", "FITS", "pickle", "JSON"]
)
def test_models_of_other_programs_are_named(foreign, tmp_path, name):
    """The content decides, whatever the name of the file."""
    kind = name.removeprefix("merged ")
    path = foreign / name
    message = f"{path}: of the format {kind}, expected a model of psfdae"
    with pytest.raises(Error) as refusal:
        load_model(path)
    assert str(refusal.value).startswith(message)
    assert ("psf and photometry read it" in str(refusal.value)) == (kind[:2] in ("PS", "ST"))
    assert message in refused("describe", path)
    assert message in refused("predict", path, "--model", path, "--out", tmp_path / "a.fits")
    if kind not in ("PSFEx", "STDPSF", "STPSF"):
        assert message in refused("psf", path, "--grid", "3x3", "--out", tmp_path / "a.fits")
    elif name == kind:
        load_field(path)
    else:
        assert "2 tables PSF_DATA" in refused("psf", path, "--out", tmp_path / "a.psf")


EDGES = [1, 2048, 2049, 4096, 4097, 6144, 6145, 8192]


@pytest.mark.parametrize(
    ("name", "columns", "rows"),
    [
        ("STDPSF_ACSWFC_F814W.fits", [1, 2048, 4096], EDGES[:4]),
        ("STDPSF_WFC3UV_F606W.fits", [1, 2048, 4096], EDGES[:4]),
        ("STDPSF_NRCSW_F150W.fits", EDGES, EDGES[:4]),
    ],
)
def test_a_grid_of_several_detectors_is_refused_under_its_usual_name(tmp_path, name, columns, rows):
    """As STScI lays them out, side by side: no position says which detector is meant."""
    stdpsf(tmp_path / "m.fits", len(columns), len(rows))
    with fits.open(tmp_path / "m.fits", mode="update") as hdus:
        for key, nodes in (("IPSFX", columns), ("JPSFY", rows)):
            hdus[0].header.update({f"{key}{k:02d}": node for k, node in enumerate(nodes, start=1)})
    path = (tmp_path / "m.fits").rename(tmp_path / name)
    with pytest.raises(PredictionError, match=f"{name}: PSFs of several detectors, expected"):
        load_field(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"JPSFY03": 42}, "several detectors"),
        ({"JPSFY03": "x"}, "damaged"),
        ({"NXPSFS": 4}, "damaged"),
        ({"NXPSFS": -1}, "damaged"),
        ({"IPSFX01": None}, "damaged"),
    ],
)
def test_a_grid_that_is_damaged_or_of_several_detectors_is_refused(tmp_path, change, message):
    path = tmp_path / "m.fits"
    stdpsf(path, 3, 3)
    with fits.open(path, mode="update") as hdus:
        for key, value in change.items():
            if value is None:
                del hdus[0].header[key]
            else:
                hdus[0].header[key] = value
        if "JPSFY03" in change:
            hdus[0].header["JPSFY02"] = 41
    with pytest.raises(Error, match=rf"m\.fits: .*{message}"):
        load_field(path)


def test_the_same_everywhere_is_a_polynomial_of_order_0(tmp_path, monkeypatch):
    monkeypatch.setattr(Moving, "order", 0)
    monkeypatch.setattr(Moving, "field_range", lambda self: (LOW, LOW))
    exchange.write_psfex(tmp_path / "m.psf", Moving(), 2)
    back = load_field(tmp_path / "m.psf")
    assert back.order == 0
    assert back.psf_at(500.0, 500.0, 2) == pytest.approx(Moving().psf_at(*LOW, 2), abs=1e-5)
    with pytest.raises(PredictionError, match="knows no positions"):
        back.field_range()


@pytest.mark.parametrize(
    "arguments",
    [
        {"x": [1.0, 2.0, 3.0], "y": [1.0, 2.0]},
        {"x": [1.0, 2.0], "y": 1.0, "mag": [-9.0, -9.0, -9.0]},
        {"x": [[1.0]], "y": [[2.0]]},
        {"x": np.nan, "y": 1.0},
        {"x": 1.0, "y": 1.0, "colour": np.inf},
    ],
)
def test_positions_of_different_lengths_or_not_finite_raise_one_line(arguments):
    """The message names the arguments; numpy's error on shapes that do not fit names none."""
    with pytest.raises(PredictionError, match=r"x, y, mag and colour must be finite.*same length"):
        Moving().psf_at(**arguments)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("EXTNAME", "OTHER", "PSF_DATA"),
        ("POLNAME1", "MAG_AUTO", "MAG_AUTO"),
        ("POLDEG1", 10**6, "range"),
        ("PSF_SAMP", "half", "no model of PSFEx"),
    ],
)
def test_other_tables_are_refused(tmp_path, key, value, message):
    path = tmp_path / "m.psf"
    exchange.write_psfex(path, Moving(), 2)
    fits.setval(path, key, value=value, ext=1)
    with pytest.raises(PredictionError, match=rf"m\.psf.*{message}"):
        PsfexField(path)


@pytest.fixture
def psfex(tmp_path):
    exchange.write_psfex(tmp_path / "m.psf", Moving(), 8)
    return tmp_path / "m.psf"


def test_psf_converts_a_model_of_psfex(psfex, tmp_path):
    printed("psf", psfex, "--grid", "3x3", "--out", tmp_path / "g.fits")
    expected = Moving().psf_at(*np.rint(Moving().grid(3, 3)).T)
    assert np.abs(fits.getdata(tmp_path / "g.fits") - expected).max() < 1e-3 * expected.max()
    for name, words in (("a.psf", ()), ("a.stdpsf.fits", ("--grid", "3x3"))):
        result = psfdae("psf", psfex, *words, "--out", tmp_path / name)
        assert result.exit_code == 0 and (tmp_path / name).is_file(), result.output


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("a.psf", ["--grid", "3x3"], "whole field"),
        ("a.stdpsf.fits", ["--at", "5,5"], "--grid"),
        ("a.stdpsf.fits", ["--grid", "3x3", "--oversampling", 2], "4 values"),
        ("x_y_z.stdpsf.fits", ["--grid", "3x3"], "underscores"),
    ],
)
def test_files_that_others_cannot_read_are_refused(psfex, tmp_path, name, words, message):
    assert message in refused("psf", psfex, *words, "--out", tmp_path / name)
    assert list(tmp_path.iterdir()) == [psfex]


@pytest.mark.parametrize("length", range(8, 1024, 8))
def test_no_model_of_psfdae_is_taken_for_another_format(tmp_path, length):
    """A safetensors file begins with the length of its header, a multiple of 8."""
    header = json.dumps({"__metadata__": {}}).encode()[:length].ljust(length)
    path = tmp_path / "model.psf.safetensors"
    path.write_bytes(length.to_bytes(8, "little") + header)
    assert name_foreign_format(path) == ""
