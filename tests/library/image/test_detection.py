"""Stars found without a list, what cameras say of themselves, maps of noise, bits of masks."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import sep
from astropy.io import fits
from astropy.table import Table
from photutils.segmentation import SourceCatalog, SourceFinder
from scipy import ndimage
from scipy.spatial import cKDTree

from command_line import printed, psfdae, refused
from image_training import few_draws
from psfdae.denoise.bundle import read_bundle
from psfdae.image.camera import camera_values
from psfdae.image.detection import _smooth, find_sources, is_on_source
from psfdae.image.fits_file import find_image
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.image.selection import collect
from psfdae.image.sky import Sky, sample_sky
from psfdae.training.settings import from_words
from psfdae_paper.stages import simulate

SIDE = 520
TINY = ["preset=smoke", "parts.train_stars=120", "parts.test_stars=30", "train.epochs=1"]
TINY += ["methods=[noisy,gmm]"]


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """A simulated image without a card about anything, its list, and the truth."""
    folder = tmp_path_factory.mktemp("detect")
    full, catalogue = folder / "full.fits", folder / "stars.csv"
    example = simulate.write_example(
        full, catalogue, seed=5, side_px=SIDE, bright=45, faint=45, blended=4, saturated=2
    )
    write(folder / "image.fits", fits.getdata(full))
    return folder, example


def write(path, pixels, **cards):
    header = fits.Header()
    header.update({key.replace("_", " "): value for key, value in cards.items()})
    fits.writeto(path, np.asarray(pixels, dtype=np.float32), header, overwrite=True)
    return path


def pixels(field):
    return fits.getdata(field[0] / "image.fits")


def opened(path, **stated):
    return open_observation(ImageInput(path, **stated), 16, 8)


# Finding


def test_sources_are_those_of_photutils():
    """Groups of one to four stars of many fluxes, some of them too faint to be parted."""
    rng, shape = np.random.default_rng(2), (300, 300)
    light = np.zeros(shape)
    middle = np.repeat(rng.uniform(20, 280, (60, 2)), rng.integers(1, 5, 60), axis=0)
    row, column = np.rint(middle + rng.normal(0, 3, middle.shape)).astype(int).T
    np.add.at(light, (row, column), 10 ** rng.uniform(2.5, 5, len(row)))
    image = ndimage.gaussian_filter(light, 1.3) + rng.normal(0, 1, shape)
    sky = Sky(image, np.zeros(shape), np.ones(shape), np.zeros(shape, bool), np.nan)
    stars = find_sources(sky, 5.0)
    # The same pixels, which photutils parts at the same levels.
    smooth, limit = _smooth(sky, 5.0)
    finder = SourceFinder(5, n_levels=8, contrast=0.005)
    finder.progress_bar = False
    expected = SourceCatalog(image, finder(smooth, limit), convolved_data=smooth)
    assert len(stars["id"]) == pytest.approx(len(expected), rel=0.15)
    position = np.stack([expected.x_centroid, expected.y_centroid], axis=1)
    measured = np.stack([stars["X_IMAGE"], stars["Y_IMAGE"]], axis=1) - 1
    distance, source = cKDTree(position).query(measured)
    is_same = distance < 0.3
    assert is_same.mean() > 0.75 and np.median(distance) < 0.05
    ratio = stars["FLUX_ISO"][is_same] / expected.segment_flux[source[is_same]]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.005)


def test_a_source_may_have_any_number_of_pixels_and_peaks():
    """More than the buffers of SEP hold by default, 300,000 pixels and 1024 peaks."""
    wave = np.cos(np.pi / 6 * np.arange(600))
    light, shape = 128.0 + 60.0 * (wave + wave[:, None]), (600, 600)
    light += np.random.default_rng(1).normal(0, 1, shape)
    sky = Sky(light, np.zeros(shape), np.ones(shape), np.zeros(shape, bool), np.nan)
    stars = find_sources(sky, 5.0)
    assert stars["FLUX_ISO"] == pytest.approx([light.sum()], rel=1e-6)
    assert stars["X_IMAGE"] == pytest.approx([300.5], abs=3.0)


def test_buffers_of_sep_stay_those_of_the_user(monkeypatch):
    """They are global, and a detection may end in an error."""
    rng, shape = np.random.default_rng(1), (64, 64)
    sky = Sky(rng.normal(0, 1, shape), np.zeros(shape), np.ones(shape), np.zeros(shape) > 1, np.nan)
    extract, seen = sep.extract, []

    def look(*arguments, **options):
        seen.append((sep.get_extract_pixstack(), sep.get_sub_object_limit()))
        return extract(*arguments, **options)

    def fail(*arguments, **options):
        look(*arguments, **options)
        raise RuntimeError("internal pixel buffer full")

    before = sep.get_extract_pixstack(), sep.get_sub_object_limit()
    try:
        sep.set_extract_pixstack(1000)
        sep.set_sub_object_limit(7)
        monkeypatch.setattr(sep, "extract", look)
        find_sources(sky, 3.0)
        assert (sep.get_extract_pixstack(), sep.get_sub_object_limit()) == (1000, 7)
        monkeypatch.setattr(sep, "extract", fail)
        with pytest.raises(RuntimeError, match="buffer"):
            find_sources(sky, 3.0)
        assert (sep.get_extract_pixstack(), sep.get_sub_object_limit()) == (1000, 7)
        assert seen == [(300_000, 1024)] * 2
    finally:
        sep.set_extract_pixstack(before[0])
        sep.set_sub_object_limit(before[1])


def test_stars_are_found_where_they_are(field):
    folder, example = field
    stars = opened(folder / "image.fits", detect=5.0)
    distance, _ = cKDTree(stars.positions).query(example.centroid)
    assert (distance[example.kind != "faint"] < 2).all()
    assert np.median(distance[example.kind == "bright"]) < 0.3
    faint = example.kind == "faint"
    assert (distance[faint] < 2).mean() > 0.6
    # Nothing but stars and their companions: noise alone has none.
    spurious, _ = cKDTree(example.centroid).query(stars.positions)
    assert (spurious > 8).sum() <= 1
    assert stars.detections.numbers("BACKGROUND") == pytest.approx(300 / 1.6, rel=0.08)
    # What a list is judged by.
    column, row = np.rint(example.centroid.T).astype(int)
    assert is_on_source(stars.sky(), column, row, 2.0).mean() > 0.9


def test_a_star_without_noise_is_found_exactly_and_nothing_is_named_twice():
    """Smoothing moves no star, and in white noise it leaves 0.53 of it."""
    place = np.array([[40.3, 51.8], [90.0, 30.4], [70.7, 100.1]])
    y, x = np.indices((140, 130))
    light = [np.exp(-0.5 * ((x - a) ** 2 + (y - b) ** 2) / 1.5**2) for a, b in place]
    shape, rng = x.shape, np.random.default_rng(1)
    nothing = np.zeros(shape, bool)
    sky = Sky(1e3 * np.sum(light, axis=0), np.full(shape, 7.0), np.ones(shape), nothing, np.nan)
    stars = find_sources(sky, 5.0)
    measured = np.stack([stars["X_IMAGE"], stars["Y_IMAGE"]], axis=1) - 1
    distance, star = cKDTree(measured).query(place)
    assert len(measured) == 3 and sorted(star) == [0, 1, 2] and (distance < 0.02).all()
    assert sorted(stars["id"]) == [1, 2, 3]
    assert (stars["BACKGROUND"] == 7.0).all()
    assert stars["FLUX_ISO"] == pytest.approx(np.full(3, 1e3 * 2 * np.pi * 1.5**2), rel=0.02)
    smooth, limit = _smooth(replace(sky, signal=rng.normal(size=shape)), 2.0)
    assert smooth.std() == pytest.approx(limit[0, 0] / 2.0, rel=0.05)


def test_pixels_off_an_image_are_on_no_source():
    row, column = np.indices((60, 80))
    star = 500.0 * np.exp(-0.5 * ((column - 78) ** 2 + (row - 58) ** 2) / 1.5**2)
    nothing = np.zeros(star.shape, bool)
    sky = Sky(star, 0.0 * star, np.ones(star.shape), nothing, np.nan)
    column, row = np.array([79, 80, 79, -1, 79, 5]), np.array([59, 59, 60, 59, -1, 5])
    assert is_on_source(sky, column, row, 2.0).tolist() == [True, *[False] * 5]


def test_the_sky_is_sampled_evenly_over_the_rows(tmp_path):
    """The median of a sky that rises by 1 count a row is the middle row's."""
    rise = np.indices((640, 64))[0] + np.random.default_rng(2).normal(0.0, 2.0, (640, 64))
    sample = sample_sky(find_image(write(tmp_path / "rise.fits", rise)))
    assert sample.level == pytest.approx(319.5, abs=5.0)
    assert sample.highest == pytest.approx(rise.max())


def test_commands_need_no_list_and_no_card(field, tmp_path):
    image, model, out = field[0] / "image.fits", tmp_path / "model", tmp_path / "psf.fits"
    words = [image, "--detect"]
    with few_draws():
        output = printed("train", *words, "--out", model, *TINY)
    camera = "image.fits: pixel scale 1 arcsec (assumed), gain not known, read noise not known"
    assert camera in output
    bundle = model / "image.psf.safetensors"
    assert read_bundle(bundle).info.scale_assumed
    assert "px of 1 arcsec, assumed" in psfdae("describe", bundle).output
    output = printed("predict", *words, "--model", bundle, "--out", out)
    assert camera in output
    table, listed = Table.read(out, hdu="STARS"), Table.read(tmp_path / "psf_stars.csv")
    assert (model / "stars.csv").read_bytes() == (tmp_path / "psf_stars.csv").read_bytes()
    assert table["x"] == pytest.approx(listed["X_IMAGE"] - 1)
    assert fits.getheader(out)["PIXSCALE"] == 1.0
    # The list is one as any other, and what is there is not replaced unasked.
    positions = opened(image, catalogue=tmp_path / "psf_stars.csv").positions
    assert positions == pytest.approx(np.stack([table["x"], table["y"]], axis=1))
    out.unlink()
    line = refused("predict", *words, "--model", bundle, "--out", out)
    assert "psf_stars.csv: exists already" in line
    # Scales that are known differ, or are needed.
    elsewhere = [*words, "--out", tmp_path / "none.fits"]
    line = refused("predict", *elsewhere, "--model", bundle, "--pixel-scale", 1.2)
    assert "1.2 arcsec" in line and "1 arcsec, assumed" in line
    assert "--pixel-scale" in refused("predict", *elsewhere)
    assert not list(tmp_path.glob("none*"))


# Cameras


@pytest.mark.parametrize(
    ("cards", "name", "expected"),
    [
        ({"EGAIN": 1.5, "GAIN": 139}, "gain", (1.5, "EGAIN")),
        ({"GAIN": 0}, "gain", (None, "not known")),
        ({"GAIN": 3.0, "BUNIT": "adu/s"}, "gain", (None, "not known, the image is a rate")),
        ({"BUNIT": "electron", "GAIN": 2.0}, "gain", (1.0, "BUNIT")),
        ({"READNOIS": 4.5}, "read noise", (4.5, "READNOIS")),
        ({"SATLEVEL": 5e4}, "saturation", (5e4, "SATLEVEL")),
        ({"SECPIX1": 0.4}, "pixel scale", (0.4, "SECPIX1")),
        ({"XPIXSZ": 9.0, "FOCALLEN": 1000.0}, "pixel scale", (1.856, "XPIXSZ and FOCALLEN")),
    ],
)
def test_what_headers_say_and_who_says_it(tmp_path, cards, name, expected):
    image = find_image(write(tmp_path / "image.fits", np.ones((20, 20)), **cards))
    value, origin = camera_values(image, {})[name]
    assert origin == expected[1]
    assert value == (expected[0] and pytest.approx(expected[0], rel=1e-3))


def test_whole_counts_without_scatter_have_the_read_noise(field, tmp_path):
    """Half of the sky's pixels are one number: its median deviation is 0."""
    config = from_words(["dataset=from_stars", *TINY])
    coarse = np.round(pixels(field) / 60.0) * 60.0
    image = write(tmp_path / "image.fits", coarse, GAIN=1.0, RDNOISE=20.0)
    candidates = collect(opened(image, detect=5.0), config.calibration_stars, config.framing)
    assert (candidates.noise >= 20.0).all()
    assert len(candidates.bright) > 20


# Maps beside the image


@pytest.mark.parametrize("kind", ["weight", "variance"])
def test_a_map_says_the_noise_but_for_a_factor(field, tmp_path, kind):
    """One half of the image is noisier, which only the map knows."""
    image, half = pixels(field).copy(), SIDE // 2
    rng, sigma = np.random.default_rng(2), np.full(image.shape, 12.0)
    sigma[:, half:] = 36.0
    image[:, half:] += rng.normal(0, np.sqrt(36.0**2 - 12.0**2), (SIDE, half))
    values = 5.0 * sigma**2
    values[100:110, 100:110] = np.nan
    path = write(tmp_path / "image.fits", image)
    map_file = write(tmp_path / "map.fits", 1 / values if kind == "weight" else values)
    observation = opened(path, detect=5.0, **{kind: str(map_file)})
    stamps = next(observation.chunks(observation.count))
    assert np.isfinite(stamps.noise).all()
    assert stamps.noise[stamps.x < half - 20] == pytest.approx(12.0, rel=0.1)
    assert stamps.noise[stamps.x > half + 20] == pytest.approx(36.0, rel=0.1)
    assert not (np.abs(observation.positions - 104.5) < 4).all(axis=1).any()
    # The half that is noisier does not fill up with noise.
    spurious, _ = cKDTree(field[1].centroid).query(observation.positions)
    assert (spurious > 8).sum() <= 2


def test_pixels_without_weight_are_bad_and_counted_in_silence(field, tmp_path, capfd):
    """SWarp and SExtractor write 0 where there are no data; photutils 3.0 shows its progress."""
    weight = np.ones((SIDE, SIDE))
    weight[100:110, 100:110] = 0
    path = write(tmp_path / "image.fits", pixels(field))
    map_file = write(tmp_path / "map.fits", weight)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        observation = opened(path, detect=5.0, weight=str(map_file))
    assert f"{map_file}: weight 0, bad pixels: 100" in observation.summary()
    assert observation.sky().bad.sum() == 100
    assert capfd.readouterr() == ("", "")


def test_bits_of_a_mask(field, tmp_path):
    flags = np.zeros((SIDE, SIDE), np.int32)
    flags[10, 10], flags[20, 20], flags[30, 30] = 1, 4, 2**30 + 2
    path, listed = tmp_path / "image.fits", field[0] / "stars.csv"
    fits.HDUList([fits.PrimaryHDU(pixels(field)), fits.ImageHDU(flags, name="DQ")]).writeto(path)
    for bits, expected in (
        (None, [True, True, True]),
        (1, [True, False, False]),
        (6, [False, True, True]),
        (2**63 - 1, [True, True, True]),
    ):
        observation = opened(path, catalogue=listed, mask="DQ", bad_bits=bits)
        assert observation.sky().bad[[10, 20, 30], [10, 20, 30]].tolist() == expected
    words = ["predict", path, "--detect", "--mask", "DQ", "--out", tmp_path / "x.fits"]
    process = psfdae(*words, "--bad-bits", 2**63)
    message = "--bad-bits 9223372036854775808: expected"
    assert process.exit_code == 2 and message in process.output


# What cannot be used: one line and code 2


@pytest.fixture(scope="module")
def bad(field):
    """A folder of files of which each has one thing wrong."""
    folder, example = field
    image = pixels(field)
    rng = np.random.default_rng(1)
    write(folder / "empty.fits", rng.normal(100, 3, (300, 300)))
    write(folder / "nan.fits", np.full((SIDE, SIDE), np.nan))
    write(folder / "small.fits", np.ones((10, 10)))
    weight = np.ones(image.shape)
    weight[3, 4] = -1
    write(folder / "below.fits", weight)
    write(folder / "colour.fits", np.stack([image] * 3))
    listed = Table.read(folder / "stars.csv")
    listed[example.kind == "bright"][:5].write(folder / "five.csv")
    listed[[*range(len(listed)), 7]].write(folder / "twice.csv")
    Table({"ra": [150.0], "dec": [2.0]}).write(folder / "sky.csv")
    Table(rng.uniform(1, SIDE, (150, 2)), names=("X_IMAGE", "Y_IMAGE")).write(folder / "other.csv")
    return folder


LIST = ["--catalogue", "stars.csv"]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["empty.fits", "--detect"], "empty.fits: no star 5 σ"),
        (["image.fits", "--catalogue", "five.csv", "--stars-min", "6"], "of 5: "),
        (["nan.fits", "--detect"], "nan.fits: too few pixels"),
        (["image.fits", *LIST, "--weight", "small.fits"], "small.fits: a weight map of 10×10"),
        (["image.fits", *LIST, "--weight", "below.fits"], "below.fits: a weight map of which 1 "),
        (["image.fits", *LIST, "--name", "../../x"], "--name ../../x"),
        (["image.fits", *LIST, "--method", "psfex"], "no method 'psfex'; there are "),
        (["image.fits", "--catalogue", "other.csv"], "of 150 positions"),
        (["image.fits", "--catalogue", "sky.csv"], "no usable celestial WCS"),
        (["image.fits", *LIST, "--detect"], "--detect takes an image"),
        (["colour.fits", "--detect"], "3 planes of 520×520"),
        (["image.fits", *LIST, "--report", "five.csv"], "five.csv: exists already; --overwrite"),
    ],
)
def test_from_stars_refuses_in_one_line(bad, monkeypatch, words, named):
    monkeypatch.chdir(bad)
    assert named in refused("train", *words, "--out", "model", *TINY)
    assert not (bad / "model").exists()


def test_predict_flags_stars_and_drops_none(bad, monkeypatch):
    """An image of NaN, another list and stars that are there twice keep their rows."""
    monkeypatch.chdir(bad)
    for image, catalogue in (("nan.fits", "twice.csv"), ("image.fits", "other.csv")):
        words = [image, "--catalogue", catalogue, "--pixel-scale", 0.1, "--overwrite"]
        printed("predict", *words, "--out", "all.fits")
        assert len(Table.read("all.fits", hdu="STARS")) == len(Table.read(catalogue))
