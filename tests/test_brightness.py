"""Fields whose PSF changes with brightness or colour of a star, as on plates, simulated."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

import psfdae
from psfdae.image.observation import Source
from psfdae.model.fitting import fit
from psfdae.model.stars import Stars
from psfdae_paper.stars.example import add_stamps

SIZE, STAMP, WIDE = 800, 16, 32
BRIGHTEST, FAINTEST = -13.0, -8.0  # magnitudes of stars that are learnt from
PLACES = np.array([[200.0, 200.0], [400.0, 600.0]])


def sigma_of(mag):
    """Width of stars in pixels: bright ones are larger."""
    return 1.3 + 0.7 * ((FAINTEST - np.asarray(mag)) / (FAINTEST - BRIGHTEST)) ** 1.5


def stars_of(centre, sigma, side):
    """Gaussian stars (n, side, side) of flux 1, pixels integrated."""
    from scipy.special import erf

    edges = np.arange(side + 1) - side // 2 - 0.5
    rows, columns = (
        np.diff(erf((edges - centre[:, axis, None]) / (np.sqrt(2) * sigma[:, None]))) / 2
        for axis in (0, 1)
    )
    return rows[:, :, None] * columns[:, None, :]


def image_of(width, seed=3):
    """Pixels with stars whose σ is `width` of their magnitudes, with places and magnitudes."""
    rng = np.random.default_rng(seed)
    axis = np.arange(32.0, SIZE - 32, 40)
    position = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    position = position + rng.uniform(-0.5, 0.5, position.shape)
    mag = rng.uniform(BRIGHTEST, FAINTEST, len(position))
    centre = (position - np.floor(position + 0.5))[:, ::-1]
    pixels = 100.0 + rng.standard_normal((SIZE, SIZE))
    add_stamps(pixels, 10 ** (-0.4 * mag)[:, None, None] * stars_of(centre, width(mag), WIDE),
               *position.T)  # fmt: skip
    return pixels, position, mag


def model_of(pixels, position, orders=(0, 1)):
    small = {"train_stars": 300, "test_stars": 60, "stamp_px": STAMP, "seed": 1}
    stars = Stars.from_image(pixels, position, pixel_scale_arcsec=1.0, gain=1e9, **small)
    return fit(stars, "field", name="plate", orders=list(orders))


@pytest.fixture(scope="module")
def sky():
    return image_of(sigma_of)


@pytest.fixture(scope="module")
def model(sky):
    return model_of(*sky[:2])


def test_the_psf_follows_the_magnitude_and_is_that_of_the_end_beyond(model):
    for mag in (-12.5, -10.5, -8.5):
        found = model.psf_at(*PLACES.T, 1, mag=mag)
        wanted = stars_of(np.zeros((2, 2)), np.full(2, sigma_of(mag)), STAMP)
        assert found == pytest.approx(wanted / wanted.sum(axis=(1, 2), keepdims=True), abs=2e-3)
    for end, beyond in ((BRIGHTEST, -16.0), (FAINTEST, -2.0)):
        far = model.psf_at(200.0, 200.0, mag=beyond)
        assert far == pytest.approx(model.psf_at(200.0, 200.0, mag=end), abs=1e-3)
    usual = model.psf_at(200.0, 200.0).max()
    assert usual == pytest.approx(model.psf_at(200.0, 200.0, mag=-10.5).max(), rel=0.2)
    several = model.psf_at(200.0, 200.0, mag=[-12.5, -8.5])
    assert several[0].max() < several[1].max()
    assert "changes with the magnitude" in model.engine.estimator.facts()["Brightness"]
    low, high = model.field_range()
    assert low.shape == high.shape == (2,) and model.grid(2, 2).shape == (4, 2)


def test_a_star_has_the_psf_of_its_own_flux_or_of_the_magnitude_that_is_stated(model, sky):
    """Where noise hides the star itself; a stated magnitude counts whatever the flux."""
    rng, mag = np.random.default_rng(5), -12.0
    truth = stars_of(np.zeros((200, 2)), np.full(200, sigma_of(mag)), STAMP)
    noise = 0.01 * rng.standard_normal(truth.shape)
    place = np.tile(PLACES[0], (200, 1))
    flux = 10 ** (-0.4 * mag)
    in_counts = model.predict(flux * (truth + noise), position=place)
    stated = model.predict(truth + noise, position=np.column_stack([place, np.full(200, mag)]))
    unlike = model.predict(truth + noise, position=place)  # as the faintest
    assert in_counts.flux / flux == pytest.approx(stated.flux, rel=0.05)
    beyond = [(found.flags & psfdae.StarFlag.BEYOND) > 0 for found in (in_counts, stated, unlike)]
    assert [some.mean() for some in beyond] == [0.0, 0.0, 1.0]

    def error(found):
        return float(np.square(found.psf / found.flux[:, None, None] - truth).mean())

    assert error(in_counts) == pytest.approx(error(stated), rel=0.1)
    assert error(stated) < 0.5 * error(unlike)


def test_stars_that_are_alike_need_no_magnitude(sky):
    pixels, position, _ = image_of(lambda mag: np.full(len(mag), 1.5))
    model = model_of(pixels, position)
    assert len(model.bundle.weights["low"]) == 2
    known = model.psf_at(200.0, 200.0)
    assert (model.psf_at(200.0, 200.0, mag=-9.0) == known).all()
    # Of one order nothing is tried.
    assert len(model_of(*sky[:2], orders=[0]).bundle.weights["low"]) == 2


def test_a_model_of_brightness_is_kept_and_written_for_other_programs(model, tmp_path):
    model.save(tmp_path / "plate.psf.safetensors")
    again = psfdae.load_model(tmp_path / "plate.psf.safetensors")
    for mag in (None, -9.0):
        assert (again.psf_at(1.0, 2.0, mag=mag) == model.psf_at(1.0, 2.0, mag=mag)).all()
    nodes = again.to_photutils(3, 2)
    assert nodes.data[4] == pytest.approx(again.psf_at(*np.rint(again.grid(3, 3)[4]), 2), abs=1e-9)


COLOURS = np.array([-0.2, 1.6])


def sigma_of_colour(colour):
    """Width of stars in pixels: red ones are larger."""
    return 1.3 + 0.3 * (np.asarray(colour) - COLOURS[0]) / np.ptp(COLOURS)


@pytest.fixture(scope="module")
def colourful():
    """A model whose stars say their colours, but for some."""
    drawn = []

    def width(mag):
        drawn.append(np.random.default_rng(9).uniform(*COLOURS, len(mag)))
        return sigma_of_colour(drawn[0])

    pixels, position, _ = image_of(width)
    colour = np.where(np.arange(len(position)) % 20 == 7, np.nan, drawn[0])
    listed = Table({"x": position[:, 0], "y": position[:, 1], "g_r": colour})
    given = {"origin": 0, "colour_column": "g_r", "pixel_scale_arcsec": 1.0, "gain": 1e9}
    small = {"train_stars": 300, "test_stars": 60, "stamp_px": STAMP, "seed": 1}
    stars = Stars.from_image(pixels, listed, **given, **small)
    return fit(stars, "field", name="colourful", orders=[0, 1])


def test_the_psf_follows_the_colour_and_is_that_of_the_end_beyond(colourful):
    place = PLACES[0]
    for colour in (0.1, 0.7, 1.3):
        found = colourful.psf_at(*place, 1, colour=colour)
        wanted = stars_of(np.zeros((1, 2)), sigma_of_colour([colour]), STAMP)[0]
        assert found == pytest.approx(wanted / wanted.sum(), abs=2e-3)
    for end, beyond in zip(COLOURS, (-5.0, 5.0), strict=True):
        far = colourful.psf_at(*place, colour=beyond)
        assert far == pytest.approx(colourful.psf_at(*place, colour=end), abs=1e-3)
    usual = colourful.psf_at(*place).max()
    assert usual == pytest.approx(colourful.psf_at(*place, colour=0.7).max(), rel=0.05)
    assert "changes with the colour" in colourful.engine.estimator.facts()["Colour"]


@pytest.mark.parametrize(("column", "said"), [("g_r", ""), ("r_i", "is 'r_i', the model")])
def test_colours_of_another_column_are_named(colourful, column, said):
    image = np.random.default_rng(5).normal(size=(99, 99))
    listed = Table({"x": [50.0], "y": [50.0], column: [0.4]})
    observation = Source(image, listed, origin=0, colour_column=column).open(STAMP)
    other = colourful.other_instrument(observation.instrument, observation.colour_column)
    assert said in other and bool(said) == bool(other)


def test_a_star_has_the_psf_of_its_colour(colourful):
    """Where noise hides the star itself."""
    rng, count = np.random.default_rng(5), 300
    colour = np.resize(COLOURS, count)
    truth = stars_of(np.zeros((count, 2)), sigma_of_colour(colour), STAMP)
    noisy = 1e4 * (truth + 0.02 * rng.standard_normal(truth.shape))
    place, mag = np.tile(PLACES[0], (count, 1)), np.full(count, np.nan)

    known = np.column_stack([place, mag, [*COLOURS, np.nan, 3.0] + [0.5] * (count - 4)])
    flagged = (colourful.predict(noisy, position=known).flags & psfdae.StarFlag.BEYOND) > 0
    assert flagged.tolist() == [False, False, False, True] + [False] * (count - 4)

    def error(known):
        found = colourful.predict(noisy, position=np.column_stack([place, mag, known]))
        return float(np.square(found.psf / found.flux[:, None, None] - truth).mean())

    unknown, middle = np.full(count, np.nan), np.full(count, COLOURS.mean())
    assert error(colour) < 0.8 * error(unknown) < error(colour[::-1])
    # That the field may change with the colour is known, if the colour is not.
    assert 0.75 * error(middle) < error(unknown) < 0.95 * error(middle)
