"""Arguments of public calls that have a wrong type end in one line of `psfdae.Error`."""

from __future__ import annotations

import datetime
import inspect
import pickle
from copy import deepcopy
from dataclasses import fields

import numpy as np
import pytest

import psfdae
import small_field
from image_training import few_draws
from psfdae.api import StarKeywords
from psfdae.base.settings import CalibrationStars, Parts, Stamp
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.image.opening import open_observation
from psfdae.report.validation import Report
from psfdae_paper.configuration.base import config_dir

OTHERS = [1j, b"1", object(), [], datetime.date(2024, 1, 1), {}, (1, 2, 3)]
WRONG = {
    "number": [*OTHERS, "60000", True, float("nan"), 10**400, float("inf")],
    "integer": [*OTHERS, "60000", True, float("nan"), 1.5],
    "count": [*OTHERS, "60000", True, float("nan"), 1.5, -1],
    "bool": [*OTHERS, "60000", float("nan")],
    "text": [*OTHERS, True, float("nan"), -1],
    "layer": [*OTHERS, True, float("nan")],
    "numbers": [*OTHERS[:3], OTHERS[4], "60000", {}, [[1.0], [1.0, 2.0]]],
    "object": [*OTHERS, "60000", True, float("nan"), -1, None],
}
STATEMENTS = {
    "catalogue": "object",
    "detect": "bool",
    "on_image": "bool",
    "threshold": "number",
    "pixel_scale_arcsec": "number",
    "origin": "integer",
    "extension": "layer",
    "mask": "layer",
    "bad_bits": "integer",
    "weight": "layer",
    "variance": "layer",
    "error": "layer",
    "gain": "number",
    "read_noise": "number",
    "saturate": "number",
    "colour_column": "text",
    "accept_offset": "bool",
}
KINDS = STATEMENTS | {"flux_column": "text", "background_column": "text", "fixed": "bool"}
KINDS |= {"threads": "count", "zero_point": "number", "magnitude_column": "text", "name": "text"}


def wrong_values(arguments):
    """Pairs of an argument and a value that it cannot have."""
    pairs = [(name, value) for name, kind in arguments.items() for value in WRONG[kind]]
    # True is 1 for a choice of numbers, and lists of stars may be left out.
    fine = [("origin", True), ("catalogue", None), ("reference", None)]
    return [pair for pair in pairs if not any(pair[0] == n and pair[1] is v for n, v in fine)]


def refuses(call, name, value, **arguments):
    """The call raises `psfdae.Error`; the line names the argument, or the kind of the image."""
    with pytest.raises(psfdae.Error) as error:
        call(**{**arguments, name: value})
    # The line on an image or a list begins with its own name.
    line = str(error.value)
    assert "\n" not in line and (name in line or name in ("image", "catalogue", "reference")), line


@pytest.fixture(scope="module")
def image():
    """Image and positions of its stars."""
    return small_field.field()


def test_all_statements_are_tested():
    assert {field.name for field in fields(ImageOptions)} == {*STATEMENTS}
    assert {field.name for field in fields(ImageInput)} - {"image"} <= {*KINDS}


def test_calls_on_images_show_every_option():
    """help(), an editor and a type checker know the options and settings, none by a second name."""
    options = {field.name for field in fields(ImageOptions)} - {"catalogue"}
    groups = (CalibrationStars, Stamp, Parts)
    settings = {name for group in groups for name in group.model_fields} | {"seed"}
    model = psfdae.PsfModel
    shown = {
        call: inspect.signature(call).parameters
        for call in (model.predict_image, model.photometry, model.residual, model.adapt)
    }
    assert all(options < {*parameters} for parameters in shown.values())
    assert options - {"detect"} < {*inspect.signature(psfdae.detect).parameters}
    of_stars = {*inspect.signature(psfdae.Stars.from_image).parameters}
    assert of_stars == options | settings | {"image", "catalogue"}
    assert shown[model.residual]["gain"].annotation == "Number | None"
    assert StarKeywords.__annotations__.keys() == options | settings


@pytest.mark.parametrize("name", STATEMENTS)
def test_an_option_of_an_image_of_a_wrong_type(image, name):
    """All calls that take these options check them before the image is read."""
    pixels, place = image
    model = psfdae.load_model()
    calls = (model.predict_image, model.photometry, model.residual, model.adapt)
    for _, value in wrong_values({name: STATEMENTS[name]}):
        refuses(psfdae.Stars.from_image, name, value, image=pixels, catalogue=place, origin=0)
        for call in calls:
            refuses(call, name, value, image=pixels, catalogue=place)
        if name not in ("catalogue", "detect"):
            refuses(psfdae.detect, name, value, image=pixels)


MODEL_CALLS = {
    "predict": {
        **dict.fromkeys(("stamps", "flux", "background", "noise", "gain", "position"), "numbers"),
        **{"centre": "numbers", "fixed": "bool", "margin": "count", "threads": "count"},
    },
    "predict_image": {name: KINDS[name] for name in ("fixed", "threads", "flux_column")},
    "photometry": {"zero_point": "number", "magnitude_column": "text", "reference": "object"},
    "adapt": {"name": "text"},
    "psf_at": {"x": "numbers", "y": "numbers", "mag": "numbers", "oversampling": "count"},
    "grid": {"columns": "count", "rows": "count"},
    "to_photutils": {"nodes": "count", "oversampling": "count"},
    "aperture_correction": {"x": "number", "y": "number", "radius_px": "number"},
    "save": {"path": "text"},
}
GOOD = {"stamps": np.ones((1, 16, 16)), "image": np.ones((40, 40)), "x": 9.0, "y": 9.0}
GOOD |= {"radius_px": 2.0, "columns": 2, "rows": 2}


@pytest.mark.parametrize("call", MODEL_CALLS)
def test_an_argument_of_a_model_of_a_wrong_type(call):
    model = psfdae.load_model()
    needed = {"predict": ["stamps"], "psf_at": ["x", "y"], "grid": ["columns", "rows"]}
    needed |= {"aperture_correction": ["x", "y", "radius_px"]}
    needed |= {name: ["image"] for name in ("predict_image", "photometry", "adapt")}
    good = {name: GOOD[name] for name in needed.get(call, [])}
    for name, value in wrong_values(MODEL_CALLS[call]):
        refuses(getattr(model, call), name, value, **good)


def test_an_argument_of_a_function_of_a_wrong_type():
    model, stars = psfdae.load_model(), object.__new__(psfdae.Stars)
    report = object.__new__(Report)
    telescope = config_dir() / "telescope" / "example_zernike.yaml"
    calls = [
        (psfdae.fit, {"stars": "object"}, {}),
        (psfdae.fit, {"method": "text", "name": "text", "licence": "text"}, {"stars": stars}),
        (psfdae.validate, {"model": "object"}, {"stars": stars}),
        (psfdae.validate, {"stars": "object"}, {"model": model}),
        (psfdae.load_model, {"path": "text"}, {}),
        (psfdae.read_telescope, {"path": "text"}, {}),
        (psfdae.detect, {"image": "object"}, {}),
        (psfdae.Stars.from_image, {"image": "object"}, {}),
        (report.save, {"path": "text"}, {}),
        (
            psfdae.wavefront,
            {
                **dict.fromkeys(("stars", "field_deg", "noise", "gain"), "numbers"),
                **{"joint": "bool", "seed": "count", "telescope": "text"},
            },
            {"stars": np.ones((2, 16, 16)), "field_deg": np.zeros((2, 2)), "telescope": telescope},
        ),
    ]
    for call, arguments, good in calls:
        for name, value in wrong_values(arguments):
            refuses(call, name, value, **good)


def test_the_line_names_the_argument_and_what_is_expected(image):
    for call, line in (
        (lambda: psfdae.fit("image.fits"), "stars='image.fits': expected an instance of Stars"),
        (
            lambda: psfdae.detect(image[0], gain=1j),
            "gain=1j: expected a valid number or an instance of Quantity",
        ),
        (
            lambda: psfdae.load_model().predict(image[0][:16, :16], threads=0),
            "threads=0: expected greater than 0",
        ),
    ):
        with pytest.raises(psfdae.Error) as error:
            call()
        assert str(error.value) == line


def test_numbers_of_numpy_are_numbers(image):
    pixels, place = image
    numbers = {"gain": np.float32(1.5), "saturate": np.int64(60000), "accept_offset": np.True_}
    observation = open_observation(ImageInput.build(pixels, {"catalogue": place, **numbers}), 16)
    assert (observation.gain, observation.saturate) == (1.5, 60000)


def test_a_pickled_model_is_as_small_as_its_file(image, tmp_path):
    """Its bytes are those of the file, whatever was computed with it before."""
    pixels, place = image
    stars = psfdae.Stars.from_image(
        pixels, catalogue=place, **small_field.CAMERA, train_stars=120, test_stars=40
    )
    with few_draws():
        model = psfdae.fit(stars, method="field", orders=[0], modes=4, step_px=0.5)
    predict = {"image": pixels, "catalogue": place, **small_field.CAMERA}
    psf = model.predict_image(**predict).psf
    model.photometry(**predict)
    path, other = tmp_path / "model.psf.safetensors", tmp_path / "copy.psf.safetensors"
    model.save(path)
    pickled = pickle.dumps(model)
    assert len(pickled) <= 1.5 * path.stat().st_size
    for unpickled in (pickle.loads(pickled), deepcopy(model)):
        unpickled.save(other)
        assert other.read_bytes() == path.read_bytes()
        # The file has single precision.
        np.testing.assert_allclose(
            unpickled.predict_image(**predict).psf, psf, rtol=1e-3, atol=1e-2
        )
