"""Images in Python: the calls give what the commands write, and several work side by side."""

from __future__ import annotations

import copy
import pickle

import joblib
import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData
from astropy.table import QTable

import psfdae as library
import small_field
from command_line import psfdae
from image_training import few_draws


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    """An image of 70 stars."""
    pixels, _ = small_field.field()
    return small_field.write(tmp_path_factory.mktemp("image_calls") / "sky.fits", pixels)


@pytest.fixture(scope="module")
def model(image):
    """The model of its field, as read from the file beside it."""
    sizes = {"train_stars": 120, "test_stars": 40}
    stars = library.Stars.from_image(image, detect=True, **sizes)
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


def test_detected_stars_are_a_star_list(image, model):
    pixels, place = small_field.field()
    detected = library.detect(CCDData(pixels, unit="adu", meta=dict(small_field.header())))
    detected_xy = np.stack([detected["x"].value, detected["y"].value], axis=1)
    assert np.abs(detected_xy[:, None] - place).max(axis=2).min(axis=1).max() < 0.3
    assert len(detected) == small_field.COUNT and detected["flux_iso"].unit == "adu"
    prediction = model.predict_image(image, catalogue=detected)
    assert len(prediction) == len(detected)
    with pytest.raises(library.Error, match="gian: no statement on an image; did you mean gain"):
        library.detect(image, gian=1.5)


def test_models_are_copied_and_pickled_and_work_on_images_side_by_side(image, model):
    copies = [pickle.loads(pickle.dumps(model)), copy.deepcopy(model)]
    predict = joblib.delayed(lambda model: model.predict_image(image, detect=True, threads=1))
    predictions = joblib.Parallel(n_jobs=2)(map(predict, [model, *copies]))
    for prediction in predictions[1:]:
        np.testing.assert_array_equal(prediction.psf, predictions[0].psf)
