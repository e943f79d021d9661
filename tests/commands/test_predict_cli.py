"""`psfdae predict`: FITS in, FITS out, and one line with exit code 2 for what cannot be used."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, Table

from command_line import psfdae, refused
from fits_inputs import write_cube, write_field
from prediction_stars import SKY, observe
from psfdae import StarFlag
from psfdae.commands import predict as stage
from psfdae.denoise import prediction as writer
from psfdae.denoise.denoiser import SNR_TOLERANCE
from psfdae.denoise.star_model import SCALE_TOLERANCE
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.image.tables import COLUMNS, SUFFIXES, star_table, write_table
from workflow_runs import ROOT

SIDE = 320


def run(*words):
    return psfdae("predict", *words)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, field_psfs):
    """A cube of 300 stamps, and an image of 60 stars with catalogues."""
    folder = tmp_path_factory.mktemp("predict")
    stars = observe(field_psfs[:300], 1e-3)
    write_cube(folder / "cube.fits", stars.stamps, PIXSCALE=0.1, OBJECT="M 67")
    np.save(folder / "cube.npy", stars.stamps)
    rng = np.random.default_rng(2)
    row, column = np.divmod(np.arange(60), 8)
    x, y = (20 + 38 * a + rng.uniform(-3, 3, 60) for a in (column, row))
    sky = rng.normal(SKY, SKY**0.5, (SIDE, SIDE))
    write_field(
        folder / "image.fits", folder / "stars.csv", 2e4 * field_psfs[:60], x, y,
        shape=(SIDE, SIDE), background=sky, pixel_scale_arcsec=0.1, GAIN=1.0, SATURATE=6e4,
    )  # fmt: skip
    table = Table.read(folder / "stars.csv")
    table["id"] = [f"star-{number}" for number in table["id"]]
    table["flux"] = np.where(np.arange(60) % 2, 2e4, np.nan)
    table.write(folder / "named.fits")
    return folder


def read(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with fits.open(path) as file:
            file.verify("exception")
            cubes = {hdu.name: np.array(hdu.data) for hdu in file[1:4]}
            return cubes, Table.read(path, hdu="STARS"), file[0].header


def test_cube_gives_what_the_model_gives(folder, shipped):
    out = folder / "cube_psf.fits"
    result = run(folder / "cube.fits", "--out", out)
    assert result.exit_code == 0, result.output
    assert "300 stars" in result.output
    cubes, table, header = read(out)
    expected = shipped.predict(np.load(folder / "cube.npy"))
    assert list(cubes) == ["PSF", "RESIDUAL", "UNCERT"]
    assert np.array_equal(cubes["PSF"], expected.psf)
    assert np.array_equal(cubes["RESIDUAL"], expected.residual, equal_nan=True)
    assert np.array_equal(cubes["UNCERT"], expected.uncertainty)
    for name in ("flux", "snr", "fwhm_px", "shift_x", "flags"):
        assert np.array_equal(table[name], getattr(expected, name)), name
    assert np.array_equal(table["id"], np.arange(300))
    assert table["x"].mask.all()
    assert header["PSFMODEL"] == "wfsat"
    assert header["PSFSHA"] == shipped.bundle.sha256
    assert (header["INFILE"], header["OBJECT"]) == ("cube.fits", "M 67")


def test_image_and_catalogue(folder, field_psfs, shipped):
    out, png = folder / "image_psf.fits", folder / "map.png"
    result = run(
        *(folder / "image.fits", "--catalogue", folder / "stars.csv"), "--out", out, "--plot", png
    )
    assert result.exit_code == 0, result.output
    cubes, table, header = read(out)
    truth = Table.read(folder / "stars.csv")
    assert np.allclose(table["x"], truth["X_IMAGE"] - 1)
    source = ImageInput(folder / "image.fits", catalogue=folder / "stars.csv")
    ((_, prediction),) = shipped.stream(
        open_observation(source, shipped.stamp_px, shipped.margin_px)
    )
    rows = prediction.to_table()
    assert rows.colnames == table.colnames and {"ra", "dec"} < {*rows.colnames}
    for name in rows.colnames:
        assert rows[name].unit == table[name].unit
        np.testing.assert_array_equal(np.ma.filled(table[name], np.nan), rows[name].value)
    assert header["GAIN"] == 1.0
    still = (table["shift_x"] == 0) & (table["shift_y"] == 0)
    assert still.sum() > 55
    error = np.abs(cubes["PSF"] - 2e4 * field_psfs[:60])[still]
    assert (error <= cubes["UNCERT"][still]).mean() == pytest.approx(0.68, abs=0.06)
    assert png.read_bytes()[:4] == b"\x89PNG"


def test_tables_have_units_digits_and_the_columns_of_the_list(tmp_path):
    columns = {"id": np.arange(2), "x": np.array([4.999999999883585, np.nan]), "flux": np.ones(2)}
    of_list = Table({"Flux": [1, 2], "flux_list": ["=1+1", "é"], "mag": [3.0, 4.0] * u.mag})
    of_list["name"] = [b"@a", b"b"]
    table = star_table(columns, "electron / s", of_list)
    names = ["id", "x", "flux", "Flux_list", "flux_list_list", "mag", "name"]
    for suffix in SUFFIXES:
        write_table(tmp_path / f"t{suffix}", table)
        read_table = QTable.read(tmp_path / f"t{suffix}")
        assert read_table.colnames == names
        if suffix != ".csv":
            assert read_table["x"][0] == table["x"][0]
            units = [str(read_table[name].unit) for name in ("x", "flux", "mag")]
            assert units == ["pix", "electron / s", "mag"]
    assert (tmp_path / "t.csv").read_text().splitlines()[1:] == [
        "0,5.0000,1,1,'=1+1,3.0,'@a",
        "1,nan,1,2,é,4.0,b",
    ]


def test_names_given_fluxes_and_columns_of_a_table(folder):
    out = folder / "named_psf.fits"
    result = run(
        *(folder / "image.fits", "--catalogue", folder / "named.fits", "--out", out),
        *("--flux-column", "flux", "--quiet"),
    )
    assert result.exit_code == 0, result.output
    assert result.output == ""
    _, table, _ = read(out)
    assert table["id"][59] == "star-59"
    assert (table["flux"][1::2] == 2e4).all()
    assert table["flux_error"].mask[1::2].all()
    assert (table["flux"][::2] != 2e4).all()
    # A column of the list whose name is taken.
    assert (table["flux_list"][1::2] == 2e4).all() and table["flux_list"].mask[::2].all()


def test_chunks_and_threads_do_not_show(folder, monkeypatch):
    files = []
    for rows, threads in ((1024, 1), (256, 3)):
        monkeypatch.setattr(stage.StarModel, "max_stars_read", rows)
        out = folder / f"rows{rows}_{threads}.fits"
        statements = stage.ImageOptions()
        stage.predict_command(folder / "cube.fits", statements, threads=threads, out=out)
        files.append(out.read_bytes())
    assert files[0] == files[1]


@pytest.fixture(scope="module")
def bad(folder):
    """Files that cannot be used."""
    stamps = np.load(folder / "cube.npy")[:4]
    write_cube(folder / "coarse.fits", stamps, PIXSCALE=0.2)
    write_cube(folder / "unknown.fits", stamps)
    (folder / "exists.fits").write_text("precious")
    return folder


@pytest.mark.parametrize(
    ("words", "texts"),
    [
        (["nowhere.fits"], ["nowhere.fits", "no such file"]),
        (["coarse.fits"], ["coarse.fits", "0.2 arcsec", "0.1 arcsec"]),
        (["unknown.fits"], ["unknown.fits", "--pixel-scale"]),
        (["image.fits"], ["image.fits", "catalogue"]),
        (["cube.fits", "--model", "cube.npy"], ["cube.npy"]),
        (["image.fits", "--catalogue", "stars.csv", "--flux-column", "f"], ["stars.csv", "'f'"]),
        (["cube.fits", "--out", "exists.fits"], ["exists.fits", "--overwrite"]),
    ],
)
def test_what_cannot_be_used_ends_in_one_line_and_code_2(bad, monkeypatch, words, texts):
    monkeypatch.chdir(bad)
    out = [] if "--out" in words else ["--out", "out.fits"]
    line = refused("predict", *words, *out)
    assert all(text in line for text in texts), line
    assert not (bad / "out.fits").exists()
    assert (bad / "exists.fits").read_text() == "precious"


def test_page_lists_all_flags_and_columns():
    text = " ".join((ROOT / "docs/photometry.md").read_text(encoding="utf-8").split())
    for flag in StarFlag:
        assert f"| `{flag.name}` | {int(flag)} |" in text
    other_pages = [ROOT / f"docs/{name}.md" for name in ("training", "input", "python")]
    all_text = text + "".join(path.read_text(encoding="utf-8") for path in other_pages)
    for name in COLUMNS:
        assert f"`{name}`" in all_text, name
    for extension, _ in writer.CUBES.values():
        assert f"| `{extension}` |" in text
    assert f"by up to {stage.StarModel.margin_px} px" in text
    assert f"more than {100 * SCALE_TOLERANCE:g} %" in text
    assert f"1/{SNR_TOLERANCE:g} of the minimum" in text
