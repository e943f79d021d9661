"""Images in Python: the calls give what the commands write, and several work side by side."""

from __future__ import annotations

import copy
import pickle
import re

import joblib
import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData
from astropy.table import QTable

import psfdae as library
import small_field
from command_line import printed, psfdae, refused
from image_training import few_draws


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    """An image of 70 stars with a WCS."""
    pixels, _ = small_field.field()
    path = tmp_path_factory.mktemp("image_calls") / "sky.fits"
    return small_field.write(path, pixels, **small_field.TANGENT.to_header())


@pytest.fixture(scope="module")
def stars(image):
    """The bright ones of its stars."""
    return library.Stars.from_image(image, detect=True, train_stars=120, test_stars=40)


@pytest.fixture(scope="module")
def model(image, stars):
    """The model of its field, as read from the file beside it."""
    with few_draws():
        model = library.fit(stars, method="field", orders=[1], modes=4)
    bundle = image.with_name("sky.psf.safetensors")
    model.save(bundle)
    return library.load_model(bundle)


def test_predictions_and_fluxes_are_those_of_the_commands(image, model):
    bundle, psfs = image.with_name("sky.psf.safetensors"), image.with_name("psfs.fits")
    assert psfdae("predict", image, "--detect", "--model", bundle, "--out", psfs).exit_code == 0
    prediction = model.predict_image(image, detect=True)
    np.testing.assert_array_equal(prediction.psf, fits.getdata(psfs, "PSF"))
    assert prediction.notes[0].startswith(f"{image}: pixel scale 0.6 arcsec")
    # Fluxes, magnitudes and the image without stars.
    table, without_stars = image.with_name("stars.ecsv"), image.with_name("residual.fits")
    words = ["--detect", "--zero-point", 25, "--model", bundle, "--out", table]
    assert psfdae("photometry", image, *words, "--residual", without_stars).exit_code == 0
    fluxes, command_table = (
        model.photometry(image, detect=True, zero_point=25.0),
        QTable.read(table),
    )
    assert fluxes.colnames == command_table.colnames and fluxes["flux"].unit == "adu"
    np.testing.assert_array_equal(fluxes["mag"], command_table["mag"])
    residual = model.residual(image, detect=True)
    assert isinstance(residual, CCDData)
    np.testing.assert_array_equal(residual.data, fits.getdata(without_stars))
    # A place of the sky is at the same pixel as in the image.
    sky = small_field.TANGENT.pixel_to_world(10.0, 20.0)
    for wcs in (residual.wcs, CCDData.read(without_stars).wcs):
        np.testing.assert_allclose(wcs.world_to_pixel(sky), (10.0, 20.0), atol=1e-6)


def test_commands_of_detected_stars_residual_and_report_are_the_calls(image, stars, model):
    """The image of the training: validation takes the stars that the training held out."""
    bundle, table = image.with_name("sky.psf.safetensors"), image.with_name("detected.ecsv")
    printed("detect", image, "--threshold", 8, "--out", table)
    detected = library.detect(image, threshold=8.0)
    np.testing.assert_array_equal(QTable.read(table)["x"], detected["x"])
    without_stars = image.with_name("without_stars.fits")
    printed("residual", image, "--detect", "--model", bundle, "--out", without_stars)
    residual = model.residual(image, detect=True)
    np.testing.assert_array_equal(fits.getdata(without_stars), residual.data)
    page = image.with_name("report.html")
    lines = printed("validate", image, "--detect", "--model", bundle, "--out", page).splitlines()
    report = library.validate(model, stars)
    # A page of a command has the names of options, one of Python those of keywords.
    assert page.read_text("utf-8").replace("--stamp-px 8", "stamp_px=8") == report.page()
    assert lines[-1] == str(report)
    words = ("--model", bundle, "--out", page, "--overwrite")
    assert "stars.csv: no such file" in refused(
        "validate", image, "--catalogue", "stars.csv", *words
    )


def test_detected_stars_are_a_star_list(image, model):
    pixels, place = small_field.field()
    detected = library.detect(CCDData(pixels, unit="adu", meta=dict(small_field.header())))
    detected_xy = np.stack([detected["x"].value, detected["y"].value], axis=1)
    assert np.abs(detected_xy[:, None] - place).max(axis=2).min(axis=1).max() < 0.3
    assert len(detected) == small_field.COUNT and detected["flux_iso"].unit == "adu"
    prediction = model.predict_image(image, catalogue=detected)
    assert len(prediction) == len(detected)
    with pytest.raises(library.Error, match="gian: not an option of an image; did you mean gain"):
        library.detect(image, gian=1.5)


def test_models_are_copied_and_pickled_and_work_on_images_side_by_side(image, model):
    copies = [pickle.loads(pickle.dumps(model)), copy.deepcopy(model)]
    predict = joblib.delayed(lambda model: model.predict_image(image, detect=True, threads=1))
    predictions = joblib.Parallel(n_jobs=2)(map(predict, [model, *copies]))
    for prediction in predictions[1:]:
        np.testing.assert_array_equal(prediction.psf, predictions[0].psf)
    # A bound method as the page on Python has it.
    (fluxes,) = joblib.Parallel(n_jobs=2)([joblib.delayed(model.photometry)(image, detect=True)])
    # Noise has some peaks above 4 σ, which are flagged.
    is_faint = (fluxes["flags"] & library.StarFlag.FAINT) > 0
    assert np.count_nonzero(~is_faint) == small_field.COUNT
    # The model of photutils, with the values of its parameters.
    grid = model.to_photutils(nodes=3)
    grid.x_0 = 40.0
    for unpickled in (pickle.loads(pickle.dumps(grid)), copy.deepcopy(grid)):
        assert type(unpickled) is type(grid) and unpickled.x_0 == 40.0
        assert unpickled(41, 40) == grid(41, 40)


@pytest.mark.parametrize(
    ("name", "value", "python", "command"),
    [
        ("", None, "or detect=True", "or --detect"),
        ("gain", -1, "gain=-1:", "--gain -1:"),
        ("pixel_scale_arcsec", 0, "pixel_scale_arcsec=0:", "--pixel-scale 0:"),
        ("saturate", 10.0, "saturate= takes the", "--saturate takes the"),
        ("bad_bits", 4, "bad_bits= needs a mask", "--bad-bits needs a mask"),
        ("threshold", 1e7, "threshold= sets", "--threshold sets"),
        ("origin", 1, "detect=True takes an image", "--detect takes an image"),
        ("snr_min", -3, "snr_min =", "--snr-min ="),
        ("stamp_px", 15, "stamp_px", "--stamp-px"),
        ("stars_min", 5000, "stars_min= takes fewer, snr_min=", "--stars-min takes fewer, --snr"),
    ],
)
def test_a_refusal_names_keywords_in_python_and_options_in_a_command(
    image, tmp_path, name, value, python, command
):
    # Without a value neither a list nor detection is stated.
    statements = {} if value is None else {"detect": True, name: value}
    option = f"--{name.removesuffix('_arcsec').replace('_', '-')}"
    words = () if value is None else ("--detect", option, value)
    with pytest.raises(library.Error) as refusal:
        library.Stars.from_image(image, **statements)
    assert python in str(refusal.value) and "--" not in str(refusal.value)
    assert command in refused("train", image, *words, "--out", tmp_path / "model")


def test_what_a_user_holds_is_shown_in_a_line_and_in_short_numbers(image, stars, model):
    report = library.validate(model, stars)
    prediction = model.predict_image(image, detect=True)
    parts = stars.observation, stars.candidates, model.info, model.method, model.wings
    for thing in (stars, model, report, prediction, *parts):
        assert "\n" not in repr(thing) and len(repr(thing)) < 200, repr(thing)
    assert f"{len(stars)} stars" in repr(stars) and f"{len(prediction)} stars" in repr(prediction)
    # In a notebook, each is a table; a report has its picture, too.
    for thing in (stars, model, report, prediction):
        assert thing._repr_html_().count("<table>") == thing._repr_html_().count("</table>") > 0
    assert '<img src="data:image/png;base64,' in report._repr_html_()
    # No cell has a number of more than nine digits, such as 4.999999999883585; one of degrees has.
    tables = [report.table, report.evaluation, report.per_star, report.photometry, stars.table]
    tables += [prediction.to_table(), model.photometry(image, detect=True, zero_point=25.0)]
    for table in tables:
        columns = [name for name in table.colnames if name not in ("ra", "dec")]
        lines = table[columns].pformat(max_lines=-1, max_width=-1)
        assert not re.findall(r"\d[\d.]{10,}", "\n".join(lines))
    numbers = [f"{number:.15g}" for number in (model.info.snr_min, model.info.pixel_scale_arcsec)]
    assert max(map(len, numbers)) <= 10, numbers
