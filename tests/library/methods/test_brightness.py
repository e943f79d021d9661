"""Fields whose PSF changes with brightness or colour of a star, as on plates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from scipy.ndimage import gaussian_filter

import psfdae
from image_training import SIZES
from psfdae import PsfModel, StarFlag
from psfdae.denoise.image_prediction import other_instrument
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.methods.field import FieldMixture
from psfdae.methods.field.prior import FieldSettings
from psfdae.methods.field.spline import FieldModel
from psfdae.methods.interface import TrainingSet
from psfdae.stars.bright_stars import BrightStars, magnitude
from psfdae.stars.noise import NoiseModel

SIDE, SPACING = 12, 0.5
RANGES = {"magnitude": (-13.0, -8.0), "colour": (-0.2, 1.6)}
COORDINATES = {"magnitude": 2, "colour": 3}
KEYWORDS = {"magnitude": "mag", "colour": "colour"}

# --- The law, f(r) + m g(r) with splines that are known


def gaussian_splines(sigma, knots):
    axis = (np.arange(knots) - (knots - 1) / 2) * SPACING
    light = np.exp(-(axis**2) / (2 * sigma**2))
    return np.outer(light, light) * SPACING**2 / (2 * np.pi * sigma**2)


def known_field(coordinate, change):
    """f is a Gaussian of σ = 1.3 px, g what a σ of 1.6 px adds to it, times `change`."""
    narrow, wide = (gaussian_splines(sigma, 33) for sigma in (1.3, 1.6))
    coefficients = np.stack([narrow, change * (wide - narrow), 0 * narrow])
    low, high = np.zeros((2, coordinate + 1))
    low[coordinate], high[coordinate] = RANGES[{2: "magnitude", 3: "colour"}[coordinate]]
    return FieldModel(coefficients, low, high, SPACING)


def bright_stars(coordinate, change, count=40):
    """Bright stars of that field, with noise of 1e-4 of their flux."""
    rng, field = np.random.default_rng(3), known_field(coordinate, change)
    position, centre = rng.uniform(0, 500, (count, 2)), rng.uniform(-0.5, 0.5, (count, 2))
    flux = 10 ** (-0.4 * rng.permutation(np.linspace(*RANGES["magnitude"], count)))
    colour = rng.permutation(np.linspace(*RANGES["colour"], count))
    colour[7::20] = np.nan if coordinate == 2 else colour[7::20]
    place = np.column_stack([position, magnitude(flux), colour])
    images = field.images(field.terms(place), centre, 28)
    images = images / images[:, 8:20, 8:20].sum(axis=(1, 2), keepdims=True)
    images = images + 1e-4 * rng.standard_normal(images.shape)
    return BrightStars(
        stamps=flux[:, None, None] * images,
        peak=np.zeros((count, 2), int),
        centre=centre,
        position=position,
        flux=flux,
        noise=1e-4 * flux,
        snr=np.full(count, 1e3),
        row=np.arange(count),
        listed=centre,
        colour=colour,
    )


def fitted(stars, orders):
    images = (stars.stamps / stars.flux[:, None, None])[:, 8:20, 8:20].astype(np.float32)
    number = np.arange(len(stars))
    of_image = {"bright": stars, "star": number}
    noise = NoiseModel(1.0, 1e9)
    data = TrainingSet(images, images, number, number[:0], np.array([0.01]), noise, **of_image)
    return FieldMixture.fit(data, field=FieldSettings(orders=orders, modes=4))


@pytest.mark.parametrize("name", RANGES)
def test_the_psf_follows_magnitude_or_colour_and_is_that_of_the_end_beyond(name):
    coordinate, ends = COORDINATES[name], RANGES[name]
    fit, truth = fitted(bright_stars(coordinate, 1.0), [0, 1]), known_field(coordinate, 1.0)
    changing = np.flatnonzero(fit.high[2:] > fit.low[2:]) + 2
    assert changing.tolist() == [coordinate]
    for value in (*ends, np.mean(ends), ends[0] - 9, ends[1] + 9):
        place = np.full((1, 4), np.nan)
        place[0, :2], place[0, coordinate] = 250.0, value
        true_psf = truth.images(truth.terms(place), np.zeros((1, 2)), SIDE)
        # Splines are smoothed: by 1 % of the narrowest star.
        assert fit.psf_at(place) == pytest.approx(true_psf / true_psf.sum(), abs=1.5e-3)
    (fact,) = (fit.facts()[word] for word in ("Brightness", "Colour") if word in fit.facts())
    assert name in fact


@pytest.mark.parametrize(("change", "orders"), [(0.0, [0, 1]), (1.0, [0])])
def test_stars_that_are_alike_or_one_order_alone_need_no_magnitude(change, orders):
    """No term of a star is tried beside a single order."""
    assert len(fitted(bright_stars(2, change), orders).low) == 2


# --- A model with such a field


def changing_model(training, name):
    """The trained model, whose PSF is wider at the high end of a range, and g itself."""
    bundle, coordinate = training.model.bundle, COORDINATES[name]
    arrays = dict(bundle.weights)
    splines = arrays["coefficients"].astype(float)
    # A filter of σ = 1 px; knots may be any distance apart.
    sigma = 1.0 / training.model.method.model.spacing
    slope = 0.8 * (gaussian_filter(splines[0], sigma) - splines[0])
    low, high = np.zeros((2, coordinate + 1))
    low[:2], high[:2] = arrays["low"][:2], arrays["high"][:2]
    low[coordinate], high[coordinate] = RANGES[name]
    # The mean and the covariance of m and m² of stars that are spread evenly over the range.
    typical_terms = np.append(arrays["usual"], [0.0, 1 / 3])
    spread = np.diag([*np.zeros(len(typical_terms) - 2), 1 / 3, 4 / 45])
    spread[:-2, :-2] = arrays["spread"]
    field = np.concatenate([splines, [slope, 0 * slope]]).astype(np.float32)
    changed = {
        "coefficients": field,
        "low": low,
        "high": high,
        "usual": typical_terms,
        "spread": spread,
    }
    info = bundle.info
    if name == "colour":
        stars = info.config["stars"] | {"colour_column": "g_r"}
        info = info.model_copy(update={"config": info.config | {"stars": stars}})
    return PsfModel(replace(bundle, info=info, weights=arrays | changed))


@pytest.fixture(scope="module")
def plate(training):
    return changing_model(training, "magnitude")


@pytest.fixture(scope="module")
def colourful(training):
    return changing_model(training, "colour")


@pytest.mark.parametrize("name", RANGES)
def test_a_model_has_the_psf_of_a_magnitude_or_colour(training, plate, colourful, name):
    model = {"magnitude": plate, "colour": colourful}[name]
    low, high = RANGES[name]
    ends = [model.psf_at(300.0, 400.0, **{KEYWORDS[name]: value}) for value in (low, high)]
    middle = model.psf_at(300.0, 400.0, **{KEYWORDS[name]: (low + high) / 2})
    # g has next to no flux, so that the normalised PSF is f + m g, too, but for the part of noise
    # that changes the light with the phase; f is the trained one.
    assert middle == pytest.approx((ends[0] + ends[1]) / 2, abs=3e-3 * middle.max())
    assert middle == pytest.approx(training.model.psf_at(300.0, 400.0), abs=1e-6)
    assert model.psf_at(300.0, 400.0) == pytest.approx(middle, abs=1e-9)
    assert ends[0].max() > 1.2 * ends[1].max()
    several = model.psf_at(300.0, 400.0, **{KEYWORDS[name]: [low - 5, high + 5]})
    assert several == pytest.approx(np.stack(ends))


PLACE = np.array([300.0, 400.0])


def squared_error(prediction, truth):
    return float(np.square(prediction.psf / prediction.flux[:, None, None] - truth).mean())


def test_a_star_has_the_psf_of_its_own_flux_or_of_the_magnitude_that_is_stated(plate):
    """Noise hides the star itself; a stated magnitude counts whatever the flux."""
    rng, mag, count = np.random.default_rng(5), -12.5, 200
    truth = plate.psf_at(*PLACE, 1, mag=mag)
    noisy = truth + 0.01 * rng.standard_normal((count, *truth.shape))
    place, flux = np.tile(PLACE, (count, 1)), 10 ** (-0.4 * mag)
    in_counts = plate.predict(flux * noisy, position=place)
    stated = plate.predict(noisy, position=np.column_stack([place, np.full(count, mag)]))
    as_faintest = plate.predict(noisy, position=place)  # as the faintest
    assert in_counts.flux / flux == pytest.approx(stated.flux, rel=0.05)
    is_beyond = [(p.flags & StarFlag.BEYOND) > 0 for p in (in_counts, stated, as_faintest)]
    assert [flagged.mean() for flagged in is_beyond] == [0.0, 0.0, 1.0]
    assert squared_error(in_counts, truth) == pytest.approx(squared_error(stated, truth), rel=0.1)
    assert squared_error(stated, truth) < 0.5 * squared_error(as_faintest, truth)


def test_a_star_has_the_psf_of_its_colour(colourful):
    """Noise hides the star itself."""
    rng, count = np.random.default_rng(5), 200
    low, high = RANGES["colour"]
    colour = np.resize([low, high], count)
    truth = np.stack([colourful.psf_at(*PLACE, 1, colour=value) for value in colour[:2]])
    truth = np.resize(truth, (count, *truth.shape[1:]))
    noisy = 1e4 * (truth + 0.02 * rng.standard_normal(truth.shape))
    unknown = np.full(count, np.nan)

    def predicted(stated_colour):
        place = np.column_stack([np.tile(PLACE, (count, 1)), unknown, stated_colour])
        return colourful.predict(noisy, position=place)

    several = predicted(np.array([low, high, np.nan, 3.0] + [0.5] * (count - 4)))
    assert np.flatnonzero(several.flags & StarFlag.BEYOND).tolist() == [3]
    true_colour, none, reversed_colour, middle = (
        squared_error(predicted(stated_colour), truth)
        for stated_colour in (colour, unknown, colour[::-1], np.full(count, (low + high) / 2))
    )
    assert true_colour < 0.8 * none < reversed_colour
    # That the field may change with the colour is known, if the colour is not.
    assert 0.75 * middle < none < 0.95 * middle


@pytest.mark.parametrize(("column", "mismatch"), [("g_r", False), ("r_i", True)])
def test_colours_are_those_of_the_list_and_of_another_column_are_named(
    training, colourful, column, mismatch
):
    listed = Table.read(training.catalogue)
    listed[column] = np.linspace(0.1, 0.9, len(listed))
    words = {"colour_column": column}
    stars = psfdae.Stars.from_image(training.image, listed, **words, **SIZES)
    bright = stars.candidates.bright
    assert bright.colour == pytest.approx(np.asarray(listed[column])[bright.row])
    observation = open_observation(ImageInput(training.image, catalogue=listed, **words), 16)
    instrument_note = other_instrument(colourful, observation)
    assert (column in instrument_note) == mismatch == bool(instrument_note)
