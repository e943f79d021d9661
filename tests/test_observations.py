"""Stamps out of FITS cubes and of images with a catalogue: values, positions, flags."""

from __future__ import annotations

import gzip
import tracemalloc

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from fits_inputs import open_observation, write_cube, write_field
from psfdae.own_stars.errors import ObservationError

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
    return {
        name: np.concatenate([getattr(chunk, name) for chunk in chunks])
        for name in ("data", "bad", "saturated", "id", "x", "y", "truncated")
    }


def write_ramp(path, shape=(30, 40), **cards):
    """An image whose pixel values are 1000·row + column, with a WCS."""
    pixels = 1000.0 * np.arange(shape[0])[:, None] + np.arange(shape[1])
    none = np.zeros((0, D, D)), np.zeros(0), np.zeros(0)
    write_field(path, path.with_suffix(".csv"), *none, shape=shape, background=pixels, **cards)
    return path


@pytest.fixture
def ramp(tmp_path):
    return write_ramp(tmp_path / "ramp.fits")


def catalogue(path, x, y, names=("X_IMAGE", "Y_IMAGE")):
    lines = [f"{a},{b}" for a, b in zip(x, y, strict=True)]
    path.write_text("\n".join([",".join(names), *lines]) + "\n")
    return path


# Cubes


@pytest.mark.parametrize("rows", [1, 7, 40, 1000])
def test_chunks_of_any_size_make_up_the_cube(cube, stamps, rows):
    observation = open_observation(cube, stamp_px=D)
    assert (observation.count, observation.shape, observation.positions) == (40, None, None)
    got = read(observation, rows)
    assert got["data"].dtype == np.float32 and got["data"].dtype.isnative
    np.testing.assert_array_equal(got["data"], stamps)
    np.testing.assert_array_equal(got["id"], np.arange(40))
    assert not (got["bad"].any() or got["saturated"].any() or got["truncated"].any())
    assert np.isnan(got["x"]).all() and np.isnan(got["y"]).all()


def integers(stamps, bscale, bzero, blank=None):
    stored = np.round((stamps - bzero) / bscale).astype(np.int16)
    hdu = fits.PrimaryHDU(stored)
    for key, value in (("BSCALE", bscale), ("BZERO", bzero), ("BLANK", blank)):
        if value is not None:
            hdu.header[key] = value
    return hdu, (stored * bscale + bzero).astype(np.float32)


@pytest.mark.parametrize(("bscale", "bzero"), [(1.0, 0.0), (1.0, 32768.0), (0.25, 100.0)])
@pytest.mark.parametrize("kind", ["plain", "fz", "gz"])
def test_integers_are_scaled_in_every_kind_of_file(tmp_path, stamps, bscale, bzero, kind):
    hdu, expected = integers(stamps, bscale, bzero)
    path = tmp_path / "int.fits"
    if kind == "fz":
        tiles = fits.CompImageHDU(hdu.data)
        fits.HDUList([fits.PrimaryHDU(), tiles]).writeto(path)
        # As fpack leaves them: astropy itself drops these cards when it compresses.
        with fits.open(path, mode="update", disable_image_compression=True) as hdus:
            hdus[1].header["BSCALE"], hdus[1].header["BZERO"] = bscale, bzero
    else:
        hdu.writeto(path)
    if kind == "gz":
        packed = tmp_path / "int.fits.gz"
        packed.write_bytes(gzip.compress(path.read_bytes()))
        path = packed
    got = read(open_observation(path, stamp_px=D))
    np.testing.assert_allclose(got["data"], expected, rtol=1e-6)
    assert np.abs(got["data"] - stamps).max() <= 0.5 * bscale + 1e-3


@pytest.mark.parametrize("bzero", [0.0, 32768.0])
def test_blank_nan_and_infinite_pixels_are_bad_and_zero(tmp_path, stamps, bzero):
    hdu, _ = integers(stamps, 1.0, bzero, blank=-32768)
    hdu.data[3, 2, 1] = -32768
    hdu.writeto(tmp_path / "blank.fits")
    broken = stamps.copy()
    broken[3, 2, 1], broken[4, 0, 0], broken[5, 7, 7] = np.nan, np.inf, -np.inf
    write_cube(tmp_path / "nan.fits", broken)
    for name, expected in (("blank", [[3, 2, 1]]), ("nan", [[3, 2, 1], [4, 0, 0], [5, 7, 7]])):
        got = read(open_observation(tmp_path / f"{name}.fits", stamp_px=D))
        np.testing.assert_array_equal(np.argwhere(got["bad"]), expected)
        assert (got["data"][got["bad"]] == 0).all()


def test_compressed_floats_stay_within_their_noise(tmp_path, stamps):
    write_cube(tmp_path / "c.fits.fz", stamps, compress=True)
    got = read(open_observation(tmp_path / "c.fits.fz", stamp_px=D))
    assert np.std(got["data"] - stamps) < 0.1 * 30


def test_only_the_rows_of_a_chunk_are_read(tmp_path):
    stamps = np.ones((40_000, D, D), dtype=np.float32)  # 10 MB
    write_cube(tmp_path / "long.fits", stamps)
    observation = open_observation(tmp_path / "long.fits", stamp_px=D)
    tracemalloc.start()
    count = sum(len(chunk) for chunk in observation.chunks(500))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 40_000
    assert peak < 0.15 * stamps.nbytes


def test_one_stamp_and_degenerate_axes_count_as_cubes(tmp_path, stamps):
    for pixels in (stamps[0], stamps[:1], stamps[None]):
        fits.PrimaryHDU(pixels).writeto(tmp_path / "a.fits", overwrite=True)
        got = read(open_observation(tmp_path / "a.fits", stamp_px=D))
        np.testing.assert_array_equal(got["data"], stamps[: len(got["data"])])
    assert len(got["data"]) == 40


def test_a_catalogue_gives_a_cube_positions_and_identifiers(tmp_path, cube):
    rows = "\n".join(f"s{k},{k + 0.5},{2 * k}" for k in range(40))
    (tmp_path / "c.csv").write_text(f"id,X_IMAGE,Y_IMAGE\n{rows}\n")
    got = read(open_observation(cube, stamp_px=D, catalogue=tmp_path / "c.csv"))
    np.testing.assert_allclose(got["x"], np.arange(40) - 0.5)
    assert got["id"][-1] == "s39"
    catalogue(tmp_path / "c.csv", [1], [1])
    with pytest.raises(ObservationError, match="1 stars for the 40 stamps"):
        open_observation(cube, stamp_px=D, catalogue=tmp_path / "c.csv")


# What headers say


def test_header_values_and_those_that_are_given_before_them(cube):
    found = open_observation(cube, stamp_px=D)
    assert (found.pixel_scale_arcsec, found.gain, found.saturate) == (1.1, 2.0, 5000.0)
    assert found.header_cards == [("OBJECT", "M 31", "")]
    given = open_observation(cube, stamp_px=D, pixel_scale_arcsec=3.0, gain=4.0, saturate=210.0)
    assert (given.pixel_scale_arcsec, given.gain, given.saturate) == (3.0, 4.0, 210.0)
    got = read(given)
    np.testing.assert_array_equal(got["saturated"], got["data"] >= 210.0)
    assert got["saturated"].any() and not got["bad"].any()


@pytest.mark.parametrize(
    ("cards", "gain"),
    [
        ({"GAIN": 120, "EGAIN": 0.8}, 0.8),  # cameras whose GAIN is a setting
        ({"GAIN": "high"}, None),
        ({"GAIN": -1.0}, None),
        ({"GAIN": 3.0, "BUNIT": "electron"}, 1.0),
        ({"GAIN": 3.0, "BUNIT": "adu/s"}, None),
        ({}, None),
    ],
)
def test_gain(tmp_path, stamps, cards, gain):
    write_cube(tmp_path / "g.fits", stamps, **cards)
    assert open_observation(tmp_path / "g.fits", stamp_px=D).gain == gain


def test_the_primary_header_serves_its_extensions(tmp_path, stamps):
    primary = fits.PrimaryHDU()
    primary.header["GAIN"], primary.header["SATURATE"] = 2.0, 1000.0
    image = fits.ImageHDU(stamps)
    image.header["GAIN"] = 3.0
    fits.HDUList([primary, image]).writeto(tmp_path / "e.fits")
    found = open_observation(tmp_path / "e.fits", stamp_px=D)
    assert (found.gain, found.saturate, found.pixel_scale_arcsec) == (3.0, 1000.0, None)


def test_the_scale_of_the_wcs_goes_before_a_nominal_one(tmp_path):
    path = write_ramp(tmp_path / "w.fits", pixel_scale_arcsec=0.7, PIXSCALE=1.0)
    stars = catalogue(tmp_path / "c.csv", [20], [15])
    found = open_observation(path, stamp_px=D, catalogue=stars)
    assert found.pixel_scale_arcsec == pytest.approx(0.7, rel=1e-9)
    fits.setval(path, "CTYPE1", value="LINEAR")
    assert open_observation(path, stamp_px=D, catalogue=stars).pixel_scale_arcsec == 1.0


# Extensions and masks


@pytest.fixture
def exposure(tmp_path, stamps):
    """SCI, ERR and DQ of two chips."""
    hdus = [fits.PrimaryHDU()]
    for chip in (1, 2):
        flags = np.zeros(stamps.shape, dtype=np.int16)
        flags[chip, 0, 0] = 4
        hdus += [
            fits.ImageHDU(stamps * chip, name="SCI", ver=chip),
            fits.ImageHDU(0 * stamps, name="ERR", ver=chip),
            fits.ImageHDU(flags, name="DQ", ver=chip),
        ]
    fits.HDUList(hdus).writeto(tmp_path / "two.fits")
    fits.HDUList(hdus[:4]).writeto(tmp_path / "one.fits")
    return tmp_path


@pytest.mark.parametrize(("extension", "chip"), [("sci", 1), ("SCI,2", 2), (4, 2), ("4", 2)])
def test_extensions_by_name_version_and_number(exposure, stamps, extension, chip):
    got = read(open_observation(exposure / "two.fits", stamp_px=D, extension=extension))
    np.testing.assert_array_equal(got["data"], stamps * chip)


def test_the_only_science_image_is_found_and_several_are_not_guessed_between(exposure, stamps):
    got = read(open_observation(exposure / "one.fits", stamp_px=D))
    np.testing.assert_array_equal(got["data"], stamps)
    with pytest.raises(ObservationError, match=r"several images.*1 SCI .*4 SCI"):
        open_observation(exposure / "two.fits", stamp_px=D)
    for extension, message in (("CHIP9", "no extension"), (99, "no extension"), (0, "no image")):
        with pytest.raises(ObservationError, match=message):
            open_observation(exposure / "two.fits", stamp_px=D, extension=extension)


def test_masks_from_an_extension_a_file_and_for_all_stamps(exposure, tmp_path):
    def bad(mask):
        return np.argwhere(
            read(open_observation(exposure / "one.fits", stamp_px=D, mask=mask))["bad"]
        )

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


def test_the_stars_pixel_is_at_half_the_stamp_whatever_the_margin(ramp, tmp_path):
    stars = catalogue(tmp_path / "c.csv", [12.4, 20.5], [9.6, 15.0], ("xcentroid", "ycentroid"))
    for margin in (0, 3):
        got = read(open_observation(ramp, stamp_px=D, catalogue=stars, margin=margin))
        assert got["data"].shape == (2, D + 2 * margin, D + 2 * margin)
        middle = D // 2 + margin
        np.testing.assert_array_equal(got["data"][:, middle, middle], [10_012, 15_021])
        np.testing.assert_array_equal(got["data"][0, :, middle] % 1000, 12)
        assert not got["bad"].any()
    odd = read(open_observation(ramp, stamp_px=7, catalogue=stars))
    np.testing.assert_array_equal(odd["data"][:, 3, 3], [10_012, 15_021])


@pytest.mark.parametrize("names", [("X_IMAGE", "Y_IMAGE"), ("xcentroid", "ycentroid"), ("x", "Y")])
@pytest.mark.parametrize("origin", [None, 0, 1])
def test_origins(ramp, tmp_path, names, origin):
    """SExtractor counts from 1, photutils from 0, of x, y nobody knows; a stated one wins."""
    stars = catalogue(tmp_path / "c.csv", [12], [9], names)
    assumed = {"X_IMAGE": 1, "xcentroid": 0, "x": None}[names[0]] if origin is None else origin
    if assumed is None:
        with pytest.raises(ObservationError, match="origin of columns x,Y must be stated"):
            open_observation(ramp, stamp_px=D, catalogue=stars, origin=origin)
        return
    found = open_observation(ramp, stamp_px=D, catalogue=stars, origin=origin)
    np.testing.assert_array_equal(found.positions, [[12 - assumed, 9 - assumed]])


def test_stars_at_the_edge_and_off_the_image_are_flagged_and_kept(ramp, tmp_path):
    x, y = [20, 1, 39, 20, -50, 1e300], [15, 15, 28, -3, 15, 1]
    stars = catalogue(tmp_path / "c.csv", x, y, ("xcenter", "ycenter"))
    got = read(open_observation(ramp, stamp_px=D, catalogue=stars, margin=1), rows=4)
    np.testing.assert_array_equal(got["truncated"], [0, 1, 1, 1, 1, 1])
    assert got["bad"][4:].all() and not got["bad"][0].any()
    assert (got["data"][got["bad"]] == 0).all()
    np.testing.assert_array_equal(got["bad"][1].sum(axis=0), [10] * 4 + [0] * 6)
    np.testing.assert_array_equal(got["data"][1, 5, 5], 15_001)
    # Only the margin is off the image: not truncated.
    near = catalogue(tmp_path / "near.csv", [4], [15], ("xcenter", "ycenter"))
    got = read(open_observation(ramp, stamp_px=D, catalogue=near, margin=1))
    assert not got["truncated"].any() and got["bad"].sum() == 10


def test_masked_and_missing_pixels_of_an_image(tmp_path):
    path = write_ramp(tmp_path / "i.fits", SATURATE=15_000.0)
    fits.append(path, np.eye(30, 40).astype(np.uint8), fits.Header({"EXTNAME": "DQ"}))
    with fits.open(path, mode="update") as hdus:
        hdus[0].data[14, 20] = np.nan
    stars = catalogue(tmp_path / "c.csv", [21], [16])  # 0-based 20, 15
    found = open_observation(path, stamp_px=D, catalogue=stars, mask="dq")
    got = read(found)
    expected = np.eye(30, 40)[11:19, 16:24] > 0
    expected[3, 4] = True
    np.testing.assert_array_equal(got["bad"][0], expected)
    np.testing.assert_array_equal(got["saturated"][0].sum(axis=1), [0] * 4 + [D] * 4)


def test_compressed_and_plain_images_give_the_same_stamps(tmp_path, stamps):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 90, 40), rng.uniform(0, 60, 40)
    sky = rng.poisson(100, (60, 90))
    got = []
    for name, compress in (("a.fits", False), ("b.fits.fz", True)):
        where = (tmp_path / name, tmp_path / "c.csv", np.round(stamps), x, y)
        write_field(*where, shape=(60, 90), background=sky, compress=compress)
        if compress:  # integers, so that nothing is lost
            image = fits.getdata(tmp_path / "a.fits").astype(np.int32)
            fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(image)]).writeto(
                tmp_path / name, overwrite=True
            )
        got.append(read(open_observation(where[0], stamp_px=D, catalogue=where[1])))
    np.testing.assert_array_equal(got[0]["data"], got[1]["data"])
    assert got[0]["data"].max() > 200


# Sky coordinates


def test_sky_and_pixel_columns_of_a_catalogue_agree(tmp_path, stamps):
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 90, 40), rng.uniform(0, 60, 40)
    write_field(tmp_path / "f.fits", tmp_path / "c.csv", stamps, x, y, shape=(60, 90))
    Table.read(tmp_path / "c.csv")["ra", "dec"].write(tmp_path / "sky.csv")
    for name in ("c.csv", "sky.csv"):
        found = open_observation(tmp_path / "f.fits", stamp_px=D, catalogue=tmp_path / name)
        np.testing.assert_allclose(found.positions, np.stack([x, y], axis=1), atol=2e-4)


def test_distortion_is_inverted_and_far_stars_do_not_fold_into_the_image(ramp, tmp_path):
    with fits.open(ramp, mode="update") as hdus:
        header = hdus[0].header
        header["CTYPE1"], header["CTYPE2"] = "RA---TAN-SIP", "DEC--TAN-SIP"
        for key, value in (("A_ORDER", 2), ("B_ORDER", 2), ("A_2_0", 2e-3), ("B_0_2", -1e-3)):
            header[key] = value
    wcs = WCS(fits.getheader(ramp))
    ra, dec = wcs.all_pix2world([5.0, 30.0], [7.0, 20.0], 0)
    antipode, far = (ra[0] + 180, -dec[0]), (ra[0] + 0.5, dec[0])
    ra, dec = [*ra, antipode[0], far[0]], [*dec, antipode[1], far[1]]
    stars = catalogue(tmp_path / "c.csv", ra, dec, ("ALPHA_J2000", "DELTA_J2000"))
    found = open_observation(ramp, stamp_px=D, catalogue=stars)
    np.testing.assert_allclose(found.positions[:2], [[5, 7], [30, 20]], atol=1e-4)
    got = read(found)
    np.testing.assert_array_equal(got["truncated"], [0, 0, 1, 1])
    assert got["bad"][2:].all()


def test_a_missing_wcs_matters_for_sky_coordinates_only(tmp_path):
    path = tmp_path / "plain.fits"
    fits.PrimaryHDU(np.zeros((30, 40))).writeto(path)
    pixels = catalogue(tmp_path / "p.csv", [12], [9])
    found = open_observation(path, stamp_px=D, catalogue=pixels)
    assert found.pixel_scale_arcsec is None
    sky = catalogue(tmp_path / "s.csv", [150], [2], ("ra", "dec"))
    with pytest.raises(ObservationError, match=r"plain\.fits: no usable celestial WCS.*ra,dec"):
        open_observation(path, stamp_px=D, catalogue=sky)
