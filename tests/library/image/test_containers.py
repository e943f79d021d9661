"""Images of any kind, in any container; layers of files, and headers that contradict pixels."""

from __future__ import annotations

import pickle
import re
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import (
    CCDData,
    InverseVariance,
    NDData,
    StdDevUncertainty,
    VarianceUncertainty,
)
from astropy.table import QTable
from astropy.utils.masked import Masked

import small_field as small
from command_line import psfdae, refused
from docs_pages import read
from image_training import WORDS, few_draws
from psfdae import Error, Stars, fit
from psfdae.commands import train
from psfdae.image.fits_file import science_images
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.training.from_image import collect_stars
from small_field import CAMERA, GAIN, READ, SIZE, SKY, TANGENT, field, header, table, write


@pytest.fixture(scope="module")
def image():
    return field()[0]


@pytest.fixture(scope="module")
def place():
    return field()[1]


@pytest.fixture(scope="module")
def bad():
    mask = np.zeros((SIZE, SIZE), dtype=bool)
    mask[:, :60] = True
    return mask


def verdicts(image, place, **stated):
    return Stars.from_image(image, catalogue=place, **stated).candidates.verdict.tolist()


CONTAINERS = {
    "masked array": np.ma.MaskedArray,
    "CCDData": lambda image, bad: CCDData(image, unit="adu", mask=bad),
    "LSST": lambda image, bad: fits.HDUList(
        [
            fits.PrimaryHDU(),
            fits.ImageHDU(image, name="IMAGE"),
            # Bit 5 marks the pixels of sources, and is no fault.
            fits.ImageHDU(
                2 * bad.astype(np.int32) + 32 * (image > 500),
                fits.Header({"MP_SAT": 1, "MP_DETECTED": 5}.items()),
                name="MASK",
            ),
        ]
    ),
}


@pytest.mark.parametrize("name", CONTAINERS)
def test_the_mask_of_a_container_is_that_of_the_keyword(image, place, bad, name):
    expected = verdicts(image, place, mask=bad, **CAMERA)
    assert 0 < expected.count("incomplete") < len(expected) / 2
    assert verdicts(CONTAINERS[name](image, bad), place, **CAMERA) == expected


@pytest.mark.parametrize(
    ("option", "number"), [("error", 5.0), ("variance", 25.0), ("weight", 0.04), ("mask", 0)]
)
@pytest.mark.parametrize("kind", [np.ma.MaskedArray, Masked])
def test_masked_values_of_a_map_are_bad_pixels(image, place, bad, option, number, kind):
    layer = np.full(image.shape, number)
    masked = kind(layer, mask=bad)
    sky = open_observation(ImageInput(image, catalogue=place, **{option: masked}), 16).sky()
    assert (sky.bad == bad).all()


# The four lines of Python: each container, with each kind of list.


def build_model(image, catalogue):
    """Stars, their model and a prediction."""
    stars = Stars.from_image(image, catalogue=catalogue, train_stars=30, test_stars=10, **CAMERA)
    with few_draws():
        model = fit(stars, "field", orders=[0], modes=4, step_px=1.0, spacing_px=1.0)
    return stars, model, model.predict(np.ones((1, 16, 16)))


@pytest.fixture(scope="module")
def expected(image, place):
    """Results of another process, which pickles what it gives back."""
    with ProcessPoolExecutor(1, get_context("fork")) as pool:
        return pool.submit(build_model, image, place).result()


@pytest.mark.parametrize(
    ("container", "listed"),
    [
        (lambda image: image, lambda place: [tuple(xy) for xy in place]),
        (lambda image: np.ma.MaskedArray(image, np.zeros(image.shape, bool)), table),
        (
            lambda image: CCDData(image, unit="adu", wcs=TANGENT),
            lambda place: SkyCoord(*TANGENT.all_pix2world(*place.T, 0), unit="deg"),
        ),
        (NDData, lambda place: QTable(place * u.pix, names=("x_fit", "y_fit"))),
        (lambda image: fits.PrimaryHDU(image, header()), lambda place: place),
        (lambda image: fits.HDUList([fits.PrimaryHDU(image, header())]), lambda _: "stars.csv"),
        (lambda _: "image.fits", lambda place: place),
    ],
)
def test_any_container_and_any_list_give_the_same_model(
    tmp_path, monkeypatch, image, place, expected, container, listed
):
    monkeypatch.chdir(tmp_path)
    write("image.fits", image)
    table(place).write("stars.csv")
    stars, model, _ = build_model(container(image), listed(place))
    weights = (m.bundle.weights["coefficients"] for m in (model, expected[1]))
    np.testing.assert_allclose(*weights, rtol=1e-4, atol=1e-8)
    assert len(stars) == len(expected[0]) and "\n" not in repr(stars)


def test_what_a_process_gives_back_is_as_good_as_its_own(expected):
    stars, model, prediction = pickle.loads(pickle.dumps(expected))
    assert stars.settings == expected[0].settings
    np.testing.assert_array_equal(model.predict(np.ones((1, 16, 16))).flux, prediction.flux)
    for result in (stars, prediction):
        assert f"{len(result)} stars" in repr(result) and "<table>" in result._repr_html_()


# The table of the page on input: images of these kinds, by a word of their row.

KINDS = {
    "cosmic": lambda image: image + 3e3 * (np.random.default_rng(1).random(image.shape) < 1e-3),
    "faint": lambda _: small.image_of(small.moffat(2.8), np.geomspace(8e2, 6e3, 70), 300, 16)[0],
    "NaN": lambda image: np.where(np.arange(SIZE)[:, None] // 10 == 10, np.nan, image),
    "zeros": lambda image: np.pad(image, 20),
    "few": lambda _: small.image_of(small.moffat(2.6), np.geomspace(3e4, 2e5, 8), 160, 25)[0],
    "ring": lambda _: small.image_of(small.ring, np.geomspace(5e4, 1e6, 40), 300, 28)[0],
    "crowded": lambda _: small.image_of(small.moffat(2.6), np.geomspace(1e4, 1e5, 80), 220, 6)[0],
    "colour": lambda image: np.stack(3 * [image]),
    **dict.fromkeys(("MJy/sr", "SCI", "header", "list"), lambda image: image),
}
ROWS = re.findall(r"^\| ((?:is|has|comes) .*) \| (.*) \| (.*)\|$", read("docs/input.md"), re.M)
LONG = pytest.param(True, marks=[pytest.mark.slow, pytest.mark.written])


@pytest.mark.parametrize("is_trained", [False, LONG])
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0][:30])
def test_an_image_of_the_pages_table_gives_what_it_says(
    tmp_path, monkeypatch, image, place, row, is_trained
):
    monkeypatch.chdir(tmp_path)
    (kind,) = [kind for kind in KINDS if kind in row[0]]
    pixels = KINDS[kind](image).astype(np.float32)
    cards = {"MJy/sr": header(BUNIT=kind), "header": None}.get(kind, header())
    fits.writeto("image.fits", pixels, cards)
    fits.writeto("mask.fits", np.zeros(pixels.shape, np.uint8))
    if kind == "SCI":
        pipeline_file("image.fits", image, image > 5e4)
    small.stetson([(k, x + 1, y + 1) for k, (x, y) in enumerate(place)], tmp_path / "list.als")
    if not is_trained:
        monkeypatch.setattr(
            train, "write_model", lambda a, b, *_: "\n".join(collect_stars(b, a).notes)
        )
    output = ""
    for option in ["", *re.findall("`(--[a-z]+[- ][^`]*)`", row[2])]:
        words = [*option.split(), *([] if "--catalogue" in option else ["--detect"])]
        words += [*WORDS, "--method", "field", "--out", "m", "--overwrite"]
        with few_draws():
            process = psfdae("train", "image.fits", *words)
        assert process.exit_code == (2 if "rejected" in row[1] else 0), process.output
        output += process.output
    assert all(words_of_page in output for words_of_page in re.findall("`([^`]+)`[.,]", row[1])), (
        output
    )


def test_an_hdu_is_read_with_its_header(image, place):
    stars = Stars.from_image(fits.CompImageHDU(image, header()), catalogue=place)
    assert stars.observation.gain == GAIN
    assert verdicts(image, place, **CAMERA) == stars.candidates.verdict.tolist()


def test_an_hdulist_of_a_file_has_its_name_and_the_same_stars(tmp_path, image, place):
    path = write(tmp_path / "night.fits", image)
    from_file = Stars.from_image(path, catalogue=place)
    with fits.open(path) as hdus:
        from_list = Stars.from_image(hdus, catalogue=place)
    assert from_list.name == "night" and from_list.described() == from_file.described()
    unpickled = pickle.loads(pickle.dumps(from_list.source))
    assert open_observation(unpickled, 16).sha256() == from_file.observation.sha256()


@pytest.mark.parametrize("kind", [StdDevUncertainty, VarianceUncertainty, InverseVariance])
def test_uncertainty_unit_meta_and_wcs_of_nddata_are_used(image, place, kind):
    sigma = np.full(image.shape, np.sqrt(SKY / GAIN + (READ / GAIN) ** 2))
    data = NDData(
        image,
        uncertainty=StdDevUncertainty(sigma).represent_as(kind),
        unit=u.adu,
        wcs=TANGENT,
        meta={"EGAIN": GAIN, "history": ["of", "no", "use"], "TELESCOP": "T1"},
    )
    ra, dec = TANGENT.all_pix2world(*place.T, 0)
    observation = Stars.from_image(data, catalogue={"ra": ra, "dec": dec}).observation
    assert observation.gain == GAIN and observation.instrument == {"TELESCOP": "T1"}
    assert observation.pixel_scale_arcsec == pytest.approx(0.6)
    np.testing.assert_allclose(observation.positions, place, atol=1e-6)
    (chunk,) = observation.chunks(100)
    # One σ for all, as the map has it, not those of stamps, which differ.
    assert np.ptp(chunk.noise) < 1e-6 * chunk.noise[0]
    assert chunk.noise[0] == pytest.approx(sigma[0, 0], rel=0.02)
    assert "uses ERR as σ" in observation.summary()


def test_what_is_no_image_is_refused(place):
    for image in (3.0, {"data": 1}, fits.BinTableHDU(), np.ma.MaskedArray(["a"], [True])):
        with pytest.raises(Error):
            Stars.from_image(image, catalogue=place)


def test_quantities_are_converted_and_other_units_refused(tmp_path, image, place):
    path = write(tmp_path / "a.fits", image)
    stated = {
        "gain": 1.6 * u.electron / u.ct,
        "read_noise": 4 * u.electron,
        "saturate": 5e4 * u.adu,
        "pixel_scale_arcsec": 0.01 * u.arcmin / u.pix,
    }
    camera = Stars.from_image(path, catalogue=place, **stated).observation.camera
    values = [camera[name][0] for name in ("gain", "read noise", "saturation", "pixel scale")]
    np.testing.assert_allclose(values, [1.6, 4.0, 5e4, 0.6])
    for name, unit in (("gain", u.m), ("read_noise", u.adu), ("saturate", u.s)):
        with pytest.raises(Error, match=f"{name}=2.0 {unit}: expected a number of"):
            Stars.from_image(path, catalogue=place, **{name: 2.0 * unit})


def test_predict_uses_mask_sigma_and_unit_of_its_stamps(expected, image):
    small_model = expected[1]
    stamps = image[None, 60:76, 60:76].repeat(3, axis=0)
    bad = np.zeros(stamps.shape, bool)
    bad[1, 4, 4] = True
    of_arrays = small_model.predict(stamps, bad=bad, noise=15.0, gain=GAIN)
    masked = small_model.predict(np.ma.MaskedArray(stamps, bad), noise=15.0, gain=GAIN)
    sigma = StdDevUncertainty(np.full(stamps.shape, 15.0))
    data = NDData(stamps, mask=bad, uncertainty=sigma, unit=u.adu)
    of_data = small_model.predict(data, gain=GAIN * u.electron / u.adu)
    for prediction in (masked, of_data):
        np.testing.assert_array_equal(prediction.flags, of_arrays.flags)
        np.testing.assert_array_equal(prediction.flux, of_arrays.flux)
    quantity = small_model.predict(stamps * u.ct)
    np.testing.assert_array_equal(quantity.flux, small_model.predict(stamps).flux)


# Layers of pipelines' files.


def pipeline_file(path, image, quality, **cards):
    """SCI in MJy/sr without its sky, ERR with the stars' photons, DQ, and other layers."""
    scale = 1e-3
    error = np.sqrt(np.clip(image, 1, None) / GAIN + (READ / GAIN) ** 2) * scale
    science = ((image - SKY) * scale).astype(np.float32)
    layers = {
        "SCI": science,
        "ERR": error.astype(np.float32),
        "DQ": quality.astype(np.uint32),
        "AREA": np.ones_like(science),
        "VAR_POISSON": science**2,
        "WHT": np.ones_like(science),
        **cards,
    }
    hdus = [fits.ImageHDU(values, name=name) for name, values in layers.items()]
    hdus[0].header["BUNIT"] = "MJy/sr"
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path, overwrite=True)
    return path


def test_err_and_dq_of_the_file_are_used_and_said(tmp_path, image, place, bad):
    path = pipeline_file(tmp_path / "cal.fits", image, bad)
    stars = Stars.from_image(path, catalogue=place)
    assert verdicts(image, place, mask=bad, **CAMERA) == stars.candidates.verdict.tolist()
    notes = "\n".join(stars.notes)
    assert "uses ERR as σ and DQ as mask" in notes and "--bad-bits" not in notes.split("gain")[0]
    # Electrons per MJy/sr from the growth of ERR with the light of the stars.
    assert stars.observation.gain == pytest.approx(GAIN / 1e-3, rel=0.1)
    sigma = 1e-3 * np.sqrt(SKY / GAIN + (READ / GAIN) ** 2)
    good = stars.candidates.verdict == "good"
    np.testing.assert_allclose(stars.candidates.noise[good], sigma, rtol=0.05)
    assert ("BUNIT", "MJy/sr") in [card[:2] for card in stars.observation.header_cards]
    plain = Stars.from_image(path, catalogue=place, mask="none", error="none")
    assert plain.candidates.verdict.tolist() == verdicts(image, place, **CAMERA)


def test_many_masked_pixels_are_said_with_the_option_that_helps(tmp_path, image, place, bad):
    harmless = 4 * (np.arange(bad.size).reshape(bad.shape) % 3 == 0)
    path = pipeline_file(tmp_path / "cal.fits", image, bad + harmless)
    with pytest.raises(Error, match=r"47 % of the pixels have a bit of DQ: set bad_bits="):
        Stars.from_image(path, catalogue=place)
    counts = verdicts(path, place, bad_bits=1)
    assert counts == verdicts(image, place, mask=bad, **CAMERA)
    jwst = fits.open(path)
    jwst[0].header["TELESCOP"] = "JWST"  # whose bit 1 is DO_NOT_USE
    assert verdicts(jwst, place) == counts


def test_sigma_is_no_variance_and_other_layers_are_no_science(tmp_path, image, place, bad):
    path = pipeline_file(tmp_path / "cal.fits", image, bad)
    assert science_images(path) == {"SCI": 1}
    with pytest.raises(Error, match="error='ERR'"):
        Stars.from_image(path, catalogue=place, variance="ERR")
    stated = Stars.from_image(path, catalogue=place, mask="none", error="ERR")
    squared = Stars.from_image(
        path, catalogue=place, mask="none", variance=fits.getdata(path, "ERR").astype("f8") ** 2
    )
    np.testing.assert_allclose(stated.candidates.noise, squared.candidates.noise, rtol=1e-5)


def test_versions_of_several_science_images_belong_together(tmp_path, image, bad):
    hdus = [fits.PrimaryHDU()]
    for version, mask in ((1, bad), (2, ~bad)):
        hdus.append(fits.ImageHDU(image, name="SCI", ver=version))
        hdus.append(fits.ImageHDU(mask.astype(np.uint8), name="DQ", ver=version))
    fits.HDUList(hdus).writeto(tmp_path / "two.fits")
    for version, mask in ((1, bad), (2, ~bad)):
        source = ImageInput(tmp_path / "two.fits", detect=5.0, extension=f"SCI,{version}")
        assert (open_observation(source, 16).sky().bad == mask).all()


# Headers against pixels.


@pytest.mark.parametrize(
    ("factor", "offset", "cards", "key"),
    [
        (1 / 65535, 0.0, {"EGAIN": GAIN}, "EGAIN"),
        (1 / 65535, -SKY / 65535, {"EGAIN": GAIN, "RDNOISE": 0}, "EGAIN"),
        (1.0, 0.0, {"EGAIN": 0.0, "GAIN": 139}, "GAIN = 139 is a setting"),
    ],
)
def test_a_gain_that_the_pixels_contradict_is_left_out(
    tmp_path, image, place, factor, offset, cards, key
):
    path = write(tmp_path / "a.fits", (image * factor + offset).astype(np.float32), **cards)
    stars = Stars.from_image(path, catalogue=place)
    assert stars.observation.gain is None and stars.observation.least_noise == 0.0
    assert key in stars.observation.summary()
    no_gain = Stars.from_image((image * factor + offset).astype(np.float32), catalogue=place)
    np.testing.assert_allclose(stars.candidates.snr, no_gain.candidates.snr, rtol=1e-6)
    stated = Stars.from_image(path, catalogue=place, gain=GAIN / factor)
    assert stated.observation.gain == GAIN / factor


def test_a_gain_that_fits_stays_and_a_given_one_is_used_with_a_word(tmp_path, image, place):
    path = write(tmp_path / "a.fits", image)
    observation = Stars.from_image(path, catalogue=place).observation
    assert observation.gain == GAIN and observation.remarks == ()
    stated = Stars.from_image(path, catalogue=place, gain=0.1).observation
    assert stated.gain == 0.1 and "given = 0.1" in stated.summary() and "used" in stated.summary()


def test_a_saturation_below_the_sky_is_said_or_refused(tmp_path, image, place):
    path = write(tmp_path / "a.fits", image, SATURATE=10.0)
    stars = Stars.from_image(path, catalogue=place)
    assert stars.observation.saturate is None
    assert "10 counts (SATURATE) is below the sky of 300" in stars.observation.summary()
    with pytest.raises(Error, match="saturate="):
        Stars.from_image(path, catalogue=place, saturate=10.0)


def test_one_plane_is_an_image(tmp_path, image, place):
    expected = verdicts(image, place, **CAMERA)
    path = write(tmp_path / "plane.fits", image[None])
    assert verdicts(path, place) == expected
    assert verdicts(image[None], place, **CAMERA) == expected


def test_an_undebayered_frame_is_refused_in_one_line(tmp_path, image):
    path = write(tmp_path / "osc.fits", image, BAYERPAT="RGGB")
    line = refused("train", path, "--detect", "--out", tmp_path / "m")
    assert line.startswith(f"psfdae: {path}: ") and "debayer" in line
    assert not (tmp_path / "m").exists()
