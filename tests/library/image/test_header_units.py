"""Units and numbers of headers in other spellings: gain, read noise, saturation, pixel scale."""

from pathlib import Path

import pytest
from astropy.io.fits import Header

from psfdae.image.camera import camera_values, find_gain, unread_card_remarks
from psfdae.image.fits_file import ImageFile, PlainFile


def image_with(**cards):
    path = Path("image.fits")
    return ImageFile(PlainFile(path, path), 0, (300, 300), headers=(Header(cards),))


@pytest.mark.parametrize(
    ("unit", "gain"),
    [
        *((unit, 1.0) for unit in ("electron", "electron/pixel", "e-/pix", "e-", "E-", "el", "e")),
        *((unit, 1.0) for unit in ("photons", "PHOTON", "photon / pix2", "electrons per pixel")),
        *((unit, 4.0) for unit in ("", "adu", "ADU", "counts", "ct", "DN", "DN/pixel", "Counts")),
        *((unit, None) for unit in ("e-/s", "ELECTRONS/S", "electron s-1", "DN/sec", "cps")),
        *((unit, None) for unit in ("count s**-1", "e-/pix/s", "counts per second", "adu/min")),
        *((unit, None) for unit in ("MJy/sr", "nJy", "10**-20 erg/s/cm2/A", "nmgy", "K", "mag")),
    ],
)
def test_the_gain_belongs_to_the_unit_of_the_pixels(unit, gain):
    """Pixels in electrons have gain 1, rates and calibrated pixels none, counts the header's."""
    value, origin = find_gain(image_with(BUNIT=unit, GAIN=4.0))
    assert value == gain
    assert origin == {1.0: "BUNIT", 4.0: "GAIN"}.get(gain, origin)
    assert gain is not None or "not known" in origin


@pytest.mark.parametrize(
    ("name", "key", "text", "expected"),
    [
        *(
            ("gain", "GAIN", text, 1.5)
            for text in ("1.5", "1.5 e-/ADU", "1.5e-/DN", "1,5", "15D-1")
        ),
        ("gain", "EGAIN", "0.5 ADU/e-", 2.0),
        ("gain", "GAIN", "1.5 electrons per ADU", 1.5),
        *(("pixel scale", "PIXSCALE", text, 0.6) for text in ("0.6 arcsec", "0.6''", "600 mas")),
        *(("pixel scale", "SECPIX", text, 0.6) for text in ("0.6 arcsec/pixel", "0.01 arcmin")),
        *(("read noise", "RDNOISE", text, 5.0) for text in ("5 e-", "5.0 electrons", "5 el/pix")),
        *(("saturation", "SATURATE", text, 6e4) for text in ("60000 ADU", "60000 counts", "6e4")),
    ],
)
def test_numbers_of_headers_may_have_units(name, key, text, expected):
    image = image_with(**{key: text})
    value, origin = camera_values(image, {})[name]
    assert value == pytest.approx(expected, rel=1e-12) and origin == key
    assert unread_card_remarks(image) == []


@pytest.mark.parametrize(
    ("key", "text"),
    [("GAIN", "high"), ("GAIN", "1.5 m"), ("RDNOISE", "5 ADU"), ("SATURATE", "60,000")],
)
def test_a_card_that_is_not_a_number_is_named(key, text):
    """A comma before three digits may be a decimal one or not."""
    image = image_with(**{key: text})
    assert all(value is None for value, _ in camera_values(image, {}).values())
    (line,) = unread_card_remarks(image)
    assert line.startswith(f"image.fits: {key} = '{text}' is not used: expected a number of ")
