"""Sky coordinates of an image whatever the order, frame, distortion and number of its WCS axes."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import FK5, BarycentricMeanEcliptic, Galactic, SkyCoord, Supergalactic
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

import psfdae
import small_field
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation

SCALE_DEG = 0.6 / 3600
FRAMES = {
    "RA": FK5(equinox="J2000"),
    "GLON": Galactic(),
    "SLON": Supergalactic(),
    "ELON": BarycentricMeanEcliptic(equinox="J2000"),
}
LATITUDES = {"RA": "DEC", "GLON": "GLAT", "SLON": "SLAT", "ELON": "ELAT"}
SIP = {"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 3e-5, "A_1_1": 1e-5, "B_0_2": -2e-5, "B_2_0": 4e-5}
TPV = {"PV1_0": 1e-5, "PV1_1": 1.0, "PV1_4": 0.2, "PV2_0": -2e-5, "PV2_1": 1.0, "PV2_6": -0.3}
DISTORTIONS = {"TAN": {}, "TAN-SIP": SIP, "TPV": TPV}


def sky_header(longitude="RA", projection="TAN", latitude_first=False, axes=(1, 2)):
    """Cards of a WCS whose sky is on two axes of the header; a third one is a frequency."""
    # Pixels are turned, and not quite square on the sky.
    matrix = np.array([[0.98, 0.05], [0.03, -1.01]]) * SCALE_DEG
    centres = {longitude: 150.0, LATITUDES[longitude]: 31.0}
    names = [*centres][:: -1 if latitude_first else 1]
    cards = {"WCSAXES": max(axes), "RADESYS": "FK5", "EQUINOX": 2000.0}
    for row, (axis, name) in enumerate(zip(axes, names, strict=True)):
        # Eight characters: the name, hyphens, the projection.
        kind = f"{name:-<{7 - len(projection.partition('-')[0]) + 1}}{projection}"
        cards |= {f"CTYPE{axis}": kind, f"CRVAL{axis}": centres[name], f"CUNIT{axis}": "deg"}
        cards |= {f"CRPIX{axis}": 140.0 + 15 * row}
        cards |= {f"CD{axis}_{other}": matrix[row, k] for k, other in enumerate(axes)}
    for axis in {1, 2, 3} - {*axes} if max(axes) == 3 else ():
        cards |= {f"CTYPE{axis}": "FREQ", f"CUNIT{axis}": "Hz", f"CRVAL{axis}": 1.4e9}
        cards |= {f"CRPIX{axis}": 1.0, f"CD{axis}_{axis}": 1e6}
    return fits.Header((cards | DISTORTIONS[projection]).items())


@pytest.mark.parametrize("latitude_first", [False, True])
@pytest.mark.parametrize(
    ("longitude", "projection"),
    [*((name, "TAN") for name in FRAMES), ("RA", "TAN-SIP"), ("RA", "TPV"), ("GLON", "TAN-SIP")],
)
def test_stars_are_where_the_header_says_whatever_the_order_of_the_axes(
    tmp_path, longitude, projection, latitude_first
):
    """A list on the sky falls on the stars; ra, dec of detected stars are those of the header."""
    pixels, place = small_field.field()
    header = sky_header(longitude, projection, latitude_first)
    path = tmp_path / "sky.fits"
    fits.writeto(path, pixels, header + small_field.header())
    # The sky by astropy alone, axis by axis.
    if projection == "TPV" and latitude_first:
        # wcslib 8 mirrors this one: it is not used, and the image says so.
        observation = open_observation(ImageInput.build(path, {"catalogue": place}), 16)
        assert observation.wcs is None and "damaged and not used" in observation.summary()
        return
    world = WCS(header).all_pix2world(place, 0).T[:: -1 if latitude_first else 1]
    sky = SkyCoord(*world, unit="deg", frame=FRAMES[longitude]).icrs
    catalogue = Table({"ra": sky.ra.deg, "dec": sky.dec.deg})
    observation = open_observation(ImageInput.build(path, {"catalogue": catalogue}), 16)
    np.testing.assert_allclose(observation.positions, place, atol=1e-3)
    assert observation.pixel_scale_arcsec == pytest.approx(0.6, rel=0.01)
    # Stars of S/N 50 have centroids within some tenths of a pixel.
    detected = psfdae.detect(path)
    distance = sky.match_to_catalog_sky(SkyCoord(detected["ra"], detected["dec"]))[1]
    assert distance.max() < 0.2 * u.arcsec
    # The WCS of results has the columns and rows of the image as its axes.
    np.testing.assert_allclose(
        observation.wcs.all_pix2world(place, 0), WCS(header).all_pix2world(place, 0)
    )


@pytest.mark.parametrize("planes", [None, 1])
@pytest.mark.parametrize("axes", [(1, 2), (1, 3), (2, 3)])
def test_a_third_axis_does_not_move_the_sky(tmp_path, axes, planes):
    """A sky that is not on columns and rows is not used; the image says so."""
    pixels, place = small_field.field()
    path = tmp_path / "cube.fits"
    header = sky_header(axes=axes, latitude_first=True) + small_field.header()
    header["WCSAXES"] = 3
    fits.writeto(path, pixels if planes is None else pixels[None], header)
    observation = open_observation(ImageInput.build(path, {"catalogue": place}), 16)
    if axes == (1, 2):
        dec, ra = WCS(sky_header(latitude_first=True)).all_pix2world(place, 0).T
        sky = SkyCoord(ra, dec, unit="deg", frame=FRAMES["RA"]).icrs
        columns = observation.sky_columns(*place.T)
        np.testing.assert_allclose([*columns.values()], (sky.ra.deg, sky.dec.deg))
    else:
        assert observation.wcs is None and "not the axes of the pixels" in observation.summary()
