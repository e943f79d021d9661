"""Stamps out of FITS cubes and of images with a catalogue: values, positions, flags."""

from __future__ import annotations

import gzip

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from fits_inputs import open_observation, write_cube
from psfdae.image.errors import ObservationError
from psfdae.image.stamps import StarFlag
from psfdae_paper.stars import example

D = 8


@pytest.fixture(scope="module")
def stamps():
    """40 stamps of counts, 8 × 8."""
    return np.random.default_rng(5).normal(200, 30, (40, D, D)).astype(np.float32)


@pytest.fixture
def cube(tmp_path, stamps):
    path = tmp_path / "cube.fits"
    write_cube(path, stamps, PIXSCALE=1.1, GAIN=2.0, SATURATE=5000.0, OBJECT="M 31")
    return path


def read(observation, rows=7):
    """All chunks, each column joined."""
    chunks = list(observation.chunks(rows))
    columns = {
        name: np.concatenate([getattr(chunk, name) for chunk in chunks])
        for name in ("data", "bad", "saturated", "id", "x", "y", "flags")
    }
    return columns | {"truncated": (columns["flags"] & StarFlag.TRUNCATED) > 0}


def write_ramp(path, **cards):
    """An image whose pixel values are 1000·row + column, with a WCS."""
    pixels = 1000.0 * np.arange(30)[:, None] + np.arange(40)
    example.write_field(path, path.with_suffix(".csv"), pixels, *np.zeros((2, 0)), **cards)
    return path


@pytest.fixture
def ramp(tmp_path):
    return write_ramp(tmp_path / "ramp.fits")


def catalogue(path, x, y, names=("X_IMAGE", "Y_IMAGE")):
    Table([x, y], names=names).write(path, format="ascii.csv", overwrite=True)
    return path


# Cubes


@pytest.mark.parametrize("rows", [1, 7, 1000])
def test_chunks_of_any_size_make_up_the_cube(cube, stamps, rows):
    observation = open_observation(cube, D)
    assert (observation.count, observation.positions) == (40, None)
    columns = read(observation, rows)
    assert columns["data"].dtype == np.float32 and columns["data"].dtype.isnative
    np.testing.assert_array_equal(columns["data"], stamps)
    np.testing.assert_array_equal(columns["id"], np.arange(40))
    assert not (columns["bad"].any() or columns["saturated"].any() or columns["truncated"].any())
    assert np.isnan(columns["x"]).all() and np.isnan(columns["y"]).all()
    with pytest.raises(ValueError, match="rows is 0"):
        next(observation.chunks(0))


@pytest.mark.parametrize(("bscale", "bzero"), [(1.0, 32768.0), (0.25, 100.0)])
@pytest.mark.parametrize("kind", ["plain", "fz", "gz"])
def test_integers_are_scaled_in_every_kind_of_file_and_blank_pixels_bad(
    tmp_path, stamps, bscale, bzero, kind
):
    stored, path = np.round((stamps - bzero) / bscale).astype(np.int16), tmp_path / "int.fits"
    expected = (stored * bscale + bzero).astype(np.float32)
    stored[3, 2, 1] = -32768
    image = fits.CompImageHDU if kind == "fz" else fits.ImageHDU
    fits.HDUList([fits.PrimaryHDU(), image(stored)]).writeto(path)
    # As fpack leaves them: astropy itself drops these cards when it compresses.
    raw = {"disable_image_compression": True, "do_not_scale_image_data": True}
    with fits.open(path, mode="update", **raw) as hdus:
        hdus[1].header.update(BSCALE=bscale, BZERO=bzero, BLANK=-32768)
    if kind == "gz":
        path.write_bytes(gzip.compress(path.read_bytes()))
    columns = read(open_observation(path, D))
    np.testing.assert_array_equal(np.argwhere(columns["bad"]), [[3, 2, 1]])
    assert columns["data"][3, 2, 1] == 0
    good = ~columns["bad"]
    np.testing.assert_allclose(columns["data"][good], expected[good], rtol=1e-6)


def test_one_stamp_and_degenerate_axes_count_as_cubes(tmp_path, stamps):
    for pixels in (stamps[0], stamps[:1], stamps[None]):
        fits.PrimaryHDU(pixels).writeto(tmp_path / "a.fits", overwrite=True)
        columns = read(open_observation(tmp_path / "a.fits", D))
        np.testing.assert_array_equal(columns["data"], stamps[: len(columns["data"])])
    assert len(columns["data"]) == 40


def test_a_catalogue_gives_a_cube_positions_and_identifiers(tmp_path, cube):
    rows = "\n".join(f"s{k},{k + 0.5},{2 * k}" for k in range(40))
    (tmp_path / "c.csv").write_text(f"id,X_IMAGE,Y_IMAGE\n{rows}\n")
    columns = read(open_observation(cube, D, catalogue=tmp_path / "c.csv"))
    np.testing.assert_allclose(columns["x"], np.arange(40) - 0.5)
    assert columns["id"][-1] == "s39"
    catalogue(tmp_path / "c.csv", [1], [1])
    with pytest.raises(ObservationError, match="1 stars for the 40 stamps"):
        open_observation(cube, D, catalogue=tmp_path / "c.csv")


@pytest.mark.parametrize(
    ("stored", "margin", "start", "side"),
    [(8, 0, 1, 6), (8, 2, 0, 8), (9, 0, 1, 6), (9, 5, 0, 8), (11, 1, 1, 8), (40, 2, 15, 10)],
)
def test_larger_stamps_of_a_cube_are_cut_about_their_middle(tmp_path, stored, margin, start, side):
    """The star stands at index s//2, also of stamps of an odd side."""
    pixels = np.random.default_rng(1).normal(size=(3, stored, stored)).astype(np.float32)
    mask = np.zeros((stored, stored))
    mask[stored // 2, stored // 2] = 1
    write_cube(tmp_path / "odd.fits", pixels)
    write_cube(tmp_path / "mask.fits", mask)
    observation = open_observation(tmp_path / "odd.fits", 6, margin, mask=tmp_path / "mask.fits")
    columns, part = read(observation), slice(start, start + side)
    np.testing.assert_array_equal(columns["data"], pixels[:, part, part])
    assert (np.argwhere(columns["bad"][0]) == side // 2).all() and columns["bad"].sum() == 3


# What headers say


def test_header_values_and_those_that_are_given_before_them(cube):
    camera = open_observation(cube, D)
    assert (camera.pixel_scale_arcsec, camera.gain, camera.saturate) == (1.1, 2.0, 5000.0)
    assert camera.header_cards == [("OBJECT", "M 31", "")]
    stated = open_observation(cube, D, pixel_scale_arcsec=3.0, gain=4.0, saturate=210.0)
    assert (stated.pixel_scale_arcsec, stated.gain, stated.saturate) == (3.0, 4.0, 210.0)
    columns = read(stated)
    np.testing.assert_array_equal(columns["saturated"], columns["data"] >= 210.0)
    assert columns["saturated"].any() and not columns["bad"].any()


def test_the_scale_of_the_wcs_goes_before_a_nominal_one(tmp_path):
    path = write_ramp(tmp_path / "w.fits", pixel_scale_arcsec=0.7, PIXSCALE=1.0)
    stars = catalogue(tmp_path / "c.csv", [20], [15])
    observation = open_observation(path, D, catalogue=stars)
    assert observation.pixel_scale_arcsec == pytest.approx(0.7, rel=1e-9)
    # A scale beyond any number is none.
    with fits.open(path, mode="update") as (hdu, *_):
        hdu.header.update({key: 1e200 for key in ("CDELT1", "CDELT2")})
    assert open_observation(path, D, catalogue=stars).pixel_scale_arcsec == 1.0
    fits.setval(path, "CTYPE1", value="RA---TNX")
    damaged = open_observation(path, D, catalogue=stars)
    assert damaged.pixel_scale_arcsec == 1.0
    assert "its WCS (CTYPE1 = RA---TNX) is damaged and not used" in damaged.summary()


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((3, 300, 400), r"3 planes of 300×400 pixels, as of a colour image.*getdata\(…\)\[0\],"),
        ((300, 400, 4), r"4 planes of 300×400 pixels.*getdata\(…\)\[\.\.\., 0\],"),
    ],
    ids=["first axis", "last axis"],
)
def test_planes_of_colours_are_refused_with_their_number_and_size(tmp_path, shape, words):
    fits.writeto(tmp_path / "c.fits", np.zeros(shape, np.float32))
    with pytest.raises(ObservationError, match=words):
        open_observation(tmp_path / "c.fits", D)


# Extensions and masks


@pytest.fixture
def exposure(tmp_path, stamps):
    """SCI, ERR and DQ of two chips."""
    hdus = [fits.PrimaryHDU()]
    for chip in (1, 2):
        flags = np.zeros(stamps.shape, dtype=np.int16)
        flags[chip, 0, 0] = 4
        named = {"SCI": stamps * chip, "ERR": 0 * stamps, "DQ": flags}
        hdus += [fits.ImageHDU(pixels, name=name, ver=chip) for name, pixels in named.items()]
    fits.HDUList(hdus).writeto(tmp_path / "two.fits")
    fits.HDUList(hdus[:4]).writeto(tmp_path / "one.fits")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "extension", "chip"),
    [("two", "sci", 1), ("two", "SCI,2", 2), ("two", 4, 2), ("two", "4", 2), ("one", None, 1)],
)
def test_extensions_by_name_version_number_or_as_the_only_one(
    exposure, stamps, name, extension, chip
):
    columns = read(open_observation(exposure / f"{name}.fits", D, extension=extension))
    np.testing.assert_array_equal(columns["data"], stamps * chip)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"extension": None}, r"several images.*1 SCI .*4 SCI"),
        ({"extension": "CHIP9"}, "no extension"),
        ({"extension": 0}, "no image"),
        ({"margin": -1}, "margin -1"),
    ],
)
def test_extensions_are_not_guessed_and_options_have_ranges(exposure, option, words):
    with pytest.raises(ObservationError, match=words):
        open_observation(exposure / "two.fits", **({"stamp_px": D} | option))


def test_masks_from_an_extension_a_file_and_for_all_stamps(exposure, tmp_path):
    def bad(mask):
        return np.argwhere(read(open_observation(exposure / "one.fits", D, mask=mask))["bad"])

    np.testing.assert_array_equal(bad("DQ"), [[1, 0, 0]])
    common = np.zeros((D, D), dtype=np.uint8)
    common[2, 3] = 1
    fits.PrimaryHDU(common).writeto(tmp_path / "m.fits")
    for path in (tmp_path / "m.fits", str(tmp_path / "m.fits")):
        np.testing.assert_array_equal(bad(path), [[k, 2, 3] for k in range(40)])
    fits.PrimaryHDU(common[1:]).writeto(tmp_path / "small.fits")
    with pytest.raises(ObservationError, match="7×8 pixels, expected 40×8×8"):
        bad(tmp_path / "small.fits")
    with pytest.raises(ObservationError, match=r"no extension 'nowhere\.fits'"):
        bad("nowhere.fits")


# Images


@pytest.mark.parametrize(("side", "margin"), [(D, 0), (D, 2), (7, 0)])
def test_the_pixel_of_a_star_is_in_the_middle_of_its_stamp(ramp, tmp_path, side, margin):
    """Pixel k covers k − ½ ≤ x < k + ½; the middle of side d is d // 2."""
    stars = catalogue(tmp_path / "c.csv", [12.6, 20.5], [10.5, 15.5], ("xcentroid", "ycentroid"))
    columns = read(open_observation(ramp, side, margin, catalogue=stars))
    middle = side // 2 + margin
    np.testing.assert_array_equal(columns["data"][:, middle, middle], [11_013, 16_021])
    np.testing.assert_array_equal(columns["data"][0, :, middle] % 1000, 13)
    assert not columns["bad"].any()


@pytest.mark.parametrize("names", [("X_IMAGE", "Y_IMAGE"), ("xcentroid", "ycentroid"), ("x", "Y")])
@pytest.mark.parametrize("origin", [None, 0, 1])
def test_origins(ramp, tmp_path, names, origin):
    """SExtractor counts from 1, photutils from 0, of x, y nobody knows; a stated one wins."""
    stars = catalogue(tmp_path / "c.csv", [12], [9], names)
    assumed = {"X_IMAGE": 1, "xcentroid": 0, "x": None}[names[0]] if origin is None else origin
    if assumed is None:
        with pytest.raises(ObservationError, match="origin of columns x,Y must be given"):
            open_observation(ramp, D, catalogue=stars, origin=origin)
        return
    observation = open_observation(ramp, D, catalogue=stars, origin=origin)
    np.testing.assert_array_equal(observation.positions, [[12 - assumed, 9 - assumed]])


def test_stars_at_the_edge_and_off_the_image_are_flagged_and_kept(ramp, tmp_path):
    x, y = [20, 1, 39, 20, -50, 1e300], [15, 15, 28, -3, 15, 1]
    stars = catalogue(tmp_path / "c.csv", x, y, ("xcenter", "ycenter"))
    observation = open_observation(ramp, D, 1, catalogue=stars)
    # A distance to what is beyond any image would not even be a number.
    assert np.argwhere(np.isnan(observation.positions)).tolist() == [[5, 0]]
    columns = read(observation, rows=4)
    np.testing.assert_array_equal(columns["truncated"], [0, 1, 1, 1, 1, 1])
    assert columns["bad"][4:].all() and not columns["bad"][0].any()
    assert (columns["data"][columns["bad"]] == 0).all()
    np.testing.assert_array_equal(columns["bad"][1].sum(axis=0), [10] * 4 + [0] * 6)
    np.testing.assert_array_equal(columns["data"][1, 5, 5], 15_001)
    # Only the margin is off the image: not truncated.
    near_edge = catalogue(tmp_path / "near.csv", [4], [15], ("xcenter", "ycenter"))
    columns = read(open_observation(ramp, D, 1, catalogue=near_edge))
    assert not columns["truncated"].any() and columns["bad"].sum() == 10


def test_masked_and_missing_pixels_of_an_image(tmp_path):
    path = write_ramp(tmp_path / "i.fits", SATURATE=15_000.0)
    fits.append(path, np.eye(30, 40).astype(np.uint8), fits.Header({"EXTNAME": "DQ"}))
    with fits.open(path, mode="update") as hdus:
        hdus[0].data[14, 20] = np.nan
    stars = catalogue(tmp_path / "c.csv", [21], [16])  # 0-based 20, 15
    columns = read(open_observation(path, D, catalogue=stars, mask="dq"))
    expected = np.eye(30, 40)[11:19, 16:24] > 0
    expected[3, 4] = True
    np.testing.assert_array_equal(columns["bad"][0], expected)
    np.testing.assert_array_equal(columns["saturated"][0].sum(axis=1), [0] * 4 + [D] * 4)


# Sky coordinates


def test_distortion_is_inverted_and_far_stars_do_not_fold_into_the_image(ramp, tmp_path):
    with fits.open(ramp, mode="update") as hdus:
        header = hdus[0].header
        header.update(CTYPE1="RA---TAN-SIP", CTYPE2="DEC--TAN-SIP", A_ORDER=2, B_ORDER=2)
        header.update(A_2_0=2e-3, B_0_2=-1e-3)
    wcs = WCS(fits.getheader(ramp))
    ra, dec = wcs.all_pix2world([5.0, 30.0], [7.0, 20.0], 0)
    antipode, far_star = (ra[0] + 180, -dec[0]), (ra[0] + 0.5, dec[0])
    ra, dec = [*ra, antipode[0], far_star[0]], [*dec, antipode[1], far_star[1]]
    stars = catalogue(tmp_path / "c.csv", ra, dec, ("ALPHA_J2000", "DELTA_J2000"))
    observation = open_observation(ramp, D, catalogue=stars)
    np.testing.assert_allclose(observation.positions[:2], [[5, 7], [30, 20]], atol=1e-4)
    columns = read(observation)
    np.testing.assert_array_equal(columns["truncated"], [0, 0, 1, 1])
    assert columns["bad"][2:].all() and "-SIP" not in observation.summary()
    fits.setval(ramp, "CTYPE1", value="RA---TAN")
    assert "RA---TAN has no -SIP" in open_observation(ramp, D, catalogue=stars).summary()
