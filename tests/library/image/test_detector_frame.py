"""A model on an image of another part of the detector, of another binning, or turned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

import psfdae
import small_field
from image_training import few_draws
from psfdae.commands.wavefront import note_axis
from psfdae.image.detector_frame import detector_frames, find_offset
from psfdae.image.fits_file import array_image
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation

SIZE, FIRST = 380, (150, 170)  # px of the training image; first column and row of the subframe
STATISTICS = {"gain": 1.0, "read_noise": 3.0, "pixel_scale_arcsec": 0.6, "saturate": 6e4}
CARDS = {"GAIN": 1.0, "RDNOISE": 3.0, "PIXSCALE": 0.6, "SATURATE": 6e4}


def frames(columns, rows, **cards):
    """Frames of an image of this size by these cards."""
    header = fits.Header(cards.items())
    return detector_frames(replace(array_image(np.zeros((rows, columns))), headers=(header,)))


@pytest.mark.parametrize(
    ("trained", "cards", "offset"),
    [
        ({}, {"LTV1": -330, "LTV2": -340}, (330, 340)),
        ({"LTV1": 0.0, "LTV2": 0.0}, {"LTV1": "-330.0", "LTV2": "-340.0"}, (330, 340)),
        ({"XORGSUBF": 10, "YORGSUBF": 0}, {"XORGSUBF": 340, "YORGSUBF": 340}, (330, 340)),
        ({"SUBSTRT1": 1, "SUBSTRT2": 1}, {"SUBSTRT1": 331, "SUBSTRT2": 341}, (330, 340)),
        ({"DETSEC": "[1:640,1:640]"}, {"DETSEC": "[331:640,341:640]"}, (330, 340)),
        ({}, {"CCDSEC": "[331:630,341:640]", "DATASEC": "[11:310,1:300]"}, (320, 340)),
        ({}, {"CCDSEC": "[331:630,341:640]", "TRIMSEC": "[ 11:310 , 1:300 ]"}, (320, 340)),
        # Binned alike: the first pixel of 2 × 2 pixels, in such pixels.
        (
            {"CCDSUM": "2 2", "DETSEC": "[1:1280,1:1280]"},
            {"CCDSUM": "2 2", "DETSEC": "[661:1280,681:1280]"},
            (330, 340),
        ),
        (
            {"LTM1_1": 0.5, "LTM2_2": 0.5, "LTV1": 0.25, "LTV2": 0.25},
            {"LTM1_1": 0.5, "LTM2_2": 0.5, "LTV1": -329.75, "LTV2": -339.75},
            (330, 340),
        ),
        # No header, different systems, a section of another size, or an image that is not inside.
        ({}, {}, None),
        ({"LTV1": 0, "LTV2": 0}, {"XORGSUBF": 3, "YORGSUBF": 4}, None),
        ({}, {"DETSEC": "[331:700,341:640]"}, None),
        ({}, {"LTV1": -400, "LTV2": -340}, None),
    ],
)
def test_headers_show_where_a_subframe_is(trained, cards, offset):
    sizes = np.array([640, 640]), np.array([310, 300])
    found = find_offset(
        frames(*sizes[0], **trained), sizes[0], frames(*sizes[1], **cards), sizes[1]
    )
    assert found is None if offset is None else tuple(found) == pytest.approx(offset, abs=1e-9)


@pytest.mark.parametrize(
    ("trained", "cards"),
    [
        ({"XBINNING": 1, "YBINNING": 1}, {"XBINNING": 2, "YBINNING": 2}),
        ({"CCDSUM": "1 1"}, {"CCDSUM": "1 2"}),
        ({"BINNING": "1x1"}, {"BINNING": "2x2"}),
        ({"LTM1_1": 1.0, "LTM2_2": 1.0}, {"LTM1_1": 0.5, "LTM2_2": 0.5}),
        ({"DETSEC": "[1:640,1:640]"}, {"DETSEC": "[640:1,1:640]"}),
        ({"DETSEC": "[1:640,1:640]"}, {"DETSEC": "[1:1280,1:1280]"}),
    ],
)
def test_another_binning_and_a_mirrored_image_are_refused(trained, cards):
    size = np.array([640, 640])
    with pytest.raises(ValueError, match=r" is .*, not 1×1"):
        find_offset(frames(*size, **trained), size, frames(*size, **cards), size)


@pytest.fixture(scope="module")
def image():
    """Image of Gaussians whose width changes over the field, positions and fluxes."""
    rng = np.random.default_rng(5)
    axis = np.arange(20.0, SIZE - 12, 34)
    place = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    place += rng.uniform(-0.5, 0.5, place.shape)
    flux = 10 ** rng.uniform(4, 5, len(place))
    pixels = np.full((SIZE, SIZE), 300.0)
    offset = np.arange(-16, 17)
    for (x, y), total in zip(place, flux, strict=True):
        sigma = 1.1 + 0.8 * x / SIZE, 1.3 + 0.3 * y / SIZE
        column, row = round(x), round(y)
        wide, high = (
            np.exp(-((offset + middle - at) ** 2) / 2 / s**2) / np.sqrt(2 * np.pi) / s
            for middle, at, s in ((column, x, sigma[0]), (row, y, sigma[1]))
        )
        box = np.s_[max(row - 16, 0) : row + 17, max(column - 16, 0) : column + 17]
        pixels[box] += total * np.outer(
            high[-pixels[box].shape[0] :], wide[-pixels[box].shape[1] :]
        )
    return (rng.poisson(pixels) + rng.normal(0, 3, pixels.shape)).astype(np.float32), place, flux


@pytest.fixture(scope="module")
def model(image, tmp_path_factory):
    """Model of the image, from its file."""
    pixels, place, _ = image
    stars = psfdae.Stars.from_image(
        pixels, catalogue=place, **STATISTICS, train_stars=120, test_stars=40
    )
    with few_draws():
        model = psfdae.fit(stars, method="field", orders=[2], modes=4, step_px=0.5)
    path = tmp_path_factory.mktemp("frame") / "model.psf.safetensors"
    model.save(path)
    return psfdae.load_model(path)


def subframe(folder, image, **cards):
    """A part of the image as a file, with positions and fluxes of its stars."""
    pixels, place, flux = image
    inside = (place > np.add(FIRST, 8)).all(axis=1)
    path = folder / "subframe.fits"
    header = fits.Header({**CARDS, **cards}.items())
    fits.writeto(path, pixels[FIRST[1] :, FIRST[0] :], header, overwrite=True)
    return path, place[inside] - FIRST, flux[inside]


@pytest.mark.parametrize(
    "cards",
    [
        {"LTV1": -FIRST[0], "LTV2": -FIRST[1]},
        {"XORGSUBF": FIRST[0], "YORGSUBF": FIRST[1], "XBINNING": 1, "YBINNING": 1},
        {"DETSEC": f"[{FIRST[0] + 1}:{SIZE},{FIRST[1] + 1}:{SIZE}]"},
    ],
)
def test_fluxes_in_a_subframe_are_those_of_the_whole_image(tmp_path, image, model, cards):
    """The PSF of each star is that of its place on the detector."""
    path, place, flux = subframe(tmp_path, image, **cards)
    words = "230×210 pixels, 380×380 in the training; by the headers, .* x 150, y 170 there"
    with pytest.warns(UserWarning, match=words):
        table = model.photometry(path, catalogue=place)
    prediction = model.predict_image(path, catalogue=place)
    assert any("x 150, y 170 there" in note for note in prediction.notes)
    for values in (table["flux"].value, prediction.flux_total):
        assert abs(np.median(values / flux - 1)) < 0.01
    assert (np.asarray(table["flags"]) == 0).mean() > 0.9
    assert table.meta["PSFSHA"] == model.sha256
    # A model that is adapted to the subframe is one of its pixels.
    with pytest.warns(UserWarning, match="there"):
        adapted = model.adapt(path, catalogue=place)
    assert adapted.image_px == (230, 210)
    x, y = place[0]
    psf, whole = adapted.psf_at(x, y, 1), model.psf_at(x + FIRST[0], y + FIRST[1], 1)
    assert np.abs(psf - whole).max() < 0.02 * whole.max()


def test_a_part_without_a_place_in_the_header_is_named_and_flagged(tmp_path, image, model):
    path, place, _ = subframe(tmp_path, image)
    with pytest.warns(UserWarning) as warnings:
        table = model.photometry(path, catalogue=place)
    assert "headers do not show which part it is" in str(warnings[0].message)
    assert "all are flagged UNLIKE_TRAINING" in str(warnings[1].message)
    assert (np.asarray(table["flags"]) & psfdae.StarFlag.UNLIKE_TRAINING > 0).all()
    notes = model.predict_image(path, catalogue=place).notes
    assert any("do not show which part" in note for note in notes)
    assert any("are unlike the training stars" in note for note in notes)
    # Another binning is refused where both headers have one.
    info = model.info.model_copy(deep=True)
    info.config["stars"]["detector"] = {"XBINNING": [1.0, 1.0]}
    binned = psfdae.PsfModel(replace(model.bundle, info=info))
    path, *_ = subframe(tmp_path, image, XBINNING=2, YBINNING=2)
    for call in (binned.photometry, binned.predict_image, binned.adapt, binned.residual):
        with pytest.raises(psfdae.PredictionError, match="XBINNING is 2×2, not 1×1"):
            call(path, catalogue=place)


@pytest.mark.parametrize(
    ("turn", "turned"),
    [
        (lambda pixels: pixels[::-1, ::-1], lambda x, y: (SIZE - 1 - x, SIZE - 1 - y)),
        (lambda pixels: pixels[:, ::-1], lambda x, y: (SIZE - 1 - x, y)),
        (np.rot90, lambda x, y: (y, SIZE - 1 - x)),
        (lambda pixels: pixels.T, lambda x, y: (y, x)),
    ],
    ids=["180°", "mirrored", "90°", "transposed"],
)
def test_stars_of_a_turned_image_are_flagged_by_their_chi2(image, model, turn, turned):
    pixels, place, _ = image
    catalogue = np.transpose(turned(*place.T))
    with pytest.warns(UserWarning, match="an image that is turned"):
        table = model.photometry(turn(pixels), catalogue=catalogue, **STATISTICS)
    assert (np.asarray(table["flags"]) & psfdae.StarFlag.UNLIKE_TRAINING > 0).all()
    notes = model.predict_image(turn(pixels), catalogue=catalogue, **STATISTICS).notes
    assert any("an image that is turned" in note for note in notes)


@pytest.mark.filterwarnings("error:.*(turned|training)")
def test_the_training_image_itself_has_no_such_warning(image, model):
    pixels, place, flux = image
    table = model.photometry(pixels, catalogue=place, **STATISTICS)
    assert abs(np.median(table["flux"].value / flux - 1)) < 0.003
    assert (np.asarray(table["flags"]) == 0).mean() > 0.95
    notes = model.predict_image(pixels, catalogue=place, **STATISTICS).notes
    assert not any("UNLIKE" in note or "training" in note for note in notes)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("upper", [False, True])
def test_adaptation_names_the_part_of_the_field_without_stars(image, model, axis, upper):
    pixels, place, _ = image
    # One star beyond the middle does not make the half a measured one.
    middle = 0.5 * (place[:, axis].min() + place[:, axis].max())
    filled = place[(place[:, axis] > middle + 2) != upper]
    half = "(18|19)[0-9]"
    first, last = (half, "[0-9]+") if upper else ("[0-9]+", half)
    empty = f"{'xy'[axis]} {first} … {last}"
    match = rf"or fewer in 2 of the 4 quarters \(.*{empty}.*{empty}"
    with pytest.warns(UserWarning, match=match):
        model.adapt(pixels, catalogue=filled, **STATISTICS)


def test_field_angles_of_a_subframe_do_not_count_from_its_middle_without_a_word(tmp_path, image):
    for cards, count in (({"LTV1": -FIRST[0], "LTV2": -FIRST[1]}, 1), ({}, 0)):
        path, place, _ = subframe(tmp_path, image, **cards)
        notes = note_axis(open_observation(ImageInput.build(path, {"catalogue": place}), 16))
        assert len(notes) == count and all("x 150, y 170 of the detector" in n for n in notes)


def test_images_of_different_parts_of_the_detector_are_not_one_training(tmp_path, image):
    paths = []
    for name, first in (("a", 0), ("b", 5)):
        paths.append(tmp_path / f"{name}.fits")
        header = fits.Header({**CARDS, "LTV1": -first, "LTV2": 0}.items())
        header += small_field.TANGENT.to_header()
        fits.writeto(paths[-1], image[0], header)
    with pytest.raises(psfdae.Error, match=r"b.fits: the part of the detector is .*LTV1"):
        psfdae.Stars.from_image(paths, detect=True)
