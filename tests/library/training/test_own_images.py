"""An image that no simulation of ours knows: undersampled stars, their list, and what is said."""

from __future__ import annotations

import re
from dataclasses import replace

import galsim
import numpy as np
import pandas as pd
import pytest
from astropy.io import fits
from astropy.table import Table

from command_line import printed, refused
from command_line import psfdae as run
from image_training import few_draws
from psfdae import StarFlag, load_model
from psfdae.denoise.bundle import read_bundle, write_bundle
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.image.selection import collect
from psfdae.image.selection_advice import saturation_advice
from psfdae.image.stamps import cut
from psfdae.training.settings import from_words

SIDE, SKY, NOISE = 10, 187.0, 10.0
COLUMNS, ROWS = 330, 300
TINY = (f"framing.stamp_px={SIDE}", "parts.train_stars=80", "parts.test_stars=40")


class Image:
    """Stars of one PSF, FWHM 2 px, on a lattice of 20 × 23 px, a third of them bright."""

    def __init__(self, folder):
        rng = np.random.default_rng(5)
        x, y = np.meshgrid(np.arange(20.0, COLUMNS - 10, 20), np.arange(20.0, ROWS - 10, 23))
        self.position = np.stack([x.ravel(), y.ravel()], axis=1)
        self.position += rng.uniform(-0.5, 0.5, self.position.shape)
        count = len(self.position)
        bright = rng.permutation(count) % 3 == 0
        low, high = np.where(bright, [[120.0], [3000.0]], [[4.0], [40.0]])
        self.snr = low * (high / low) ** rng.uniform(size=count)
        psf = galsim.Moffat(beta=3.0, fwhm=2.0)
        image = galsim.ImageF(COLUMNS, ROWS, xmin=0, ymin=0)
        self.area = np.empty(count)
        for star, (at, snr) in enumerate(zip(self.position, self.snr, strict=True)):
            pixel = np.rint(at).astype(int)
            bounds = galsim.BoundsI(pixel[0] - 10, pixel[0] + 9, pixel[1] - 10, pixel[1] + 9)
            stamp = galsim.ImageD(bounds)
            psf.drawImage(stamp, center=galsim.PositionD(*at), scale=1.0)
            inside = cut(stamp.array[None], SIDE)[0]
            self.area[star] = inside.sum() ** 2 / np.square(inside).sum()
            total = snr * NOISE * np.sqrt(self.area[star]) / inside.sum()
            image[bounds] += galsim.ImageF(stamp * total)
        # Electrons and counts are the same.
        light = rng.poisson(np.maximum(image.array, 0))
        self.pixels = (SKY + light + rng.normal(0, NOISE, light.shape)).astype(np.float32)
        self.folder, self.image = folder, folder / "sky.fits"
        fits.PrimaryHDU(self.pixels, fits.Header({"GAIN": 1.0})).writeto(self.image)
        self.list = self.listed("stars", *self.position.T)

    def listed(self, name, x, y, **columns):
        path = self.folder / f"{name}.csv"
        pd.DataFrame({"x_fit": x, "y_fit": y, **columns}).to_csv(path, index=False)
        return path

    def predicted(self, catalogue, *words):
        out = self.folder / f"{catalogue.stem}_psf.fits"
        given = ("--catalogue", catalogue, "--model", self.model, "--out", out, "--overwrite")
        return run("predict", self.image, *given, *words), out


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """The image, a field model of it, and its stars as `predict` measures them."""
    image_case = Image(tmp_path_factory.mktemp("sky"))
    out = image_case.folder / "model"
    words = ("--catalogue", image_case.list, "--method", "field", "--out", out)
    with few_draws():
        printed("train", image_case.image, *words, "methods=[noisy,field]", *TINY)
    image_case.model = out / "sky.psf.safetensors"
    process, table = image_case.predicted(image_case.list)
    assert process.exit_code == 0, process.output
    image_case.stars = Table.read(table, hdu="STARS")
    return image_case


def test_signal_to_noise_is_that_of_each_star(sky):
    """The filter is matched to the star's PSF, not to the mean of moved ones, which is wider."""
    ratio = sky.stars["snr"] / sky.snr
    for low, high in ((10, 40), (120, 3000)):
        between = (sky.snr > low) & (sky.snr < high)
        assert np.median(ratio[between]) == pytest.approx(1.0, abs=0.04), low
    area = read_bundle(sky.model).info.noise_equivalent_px
    assert area == pytest.approx(np.median(sky.area), rel=0.05)
    five = (sky.snr > 4.8) & (sky.snr < 6.0)
    assert five.sum() > 5
    # What is measured scatters by more than 1, and 4 is the limit.
    assert ((sky.stars["flags"][five] & StarFlag.SNR_LOW) > 0).mean() < 0.4


def test_bright_stars_are_good_stars(sky):
    """A field model needs no largest S/N; a noise that holds a star's own light would be larger."""
    bright = sky.snr > 100
    assert not (sky.stars["flags"] & StarFlag.SNR_HIGH).any()
    assert (sky.stars["flags"][bright] == 0).mean() > 0.8
    assert np.median(sky.stars["noise"][sky.snr > 1000]) == pytest.approx(NOISE, rel=0.05)


def test_levels_of_noise_follow_the_least_signal_to_noise():
    words = ("dataset=from_stars", "calibration_stars.snr_min=60")
    config = from_words(words)
    assert config.calibration_stars.list_degraded_snr() == [5, 10, 20, 30]
    lower = config.calibration_stars.model_copy(update={"snr_min": 8.0})
    assert lower.list_degraded_snr() == [4]


def test_lists_that_are_off_are_refused(sky):
    x, y = sky.position.T
    for catalogue in (sky.listed("off", x + 5, y), sky.listed("exchanged", y, x)):
        process, out = sky.predicted(catalogue)
        assert process.exit_code == 2 and not out.exists()
        place = rf"{catalogue.name}: stars are off its positions by x .*--accept-offset"
        assert re.search(place, process.output)
    process, out = sky.predicted(catalogue, "--accept-offset")
    assert process.exit_code == 0 and out.exists()


def test_list_of_another_crowded_image_teaches_nothing(sky, tmp_path):
    """The stars' centres tell an offset where every position has a source by chance."""
    x, y = sky.position.T
    catalogue = sky.listed("two_off", x + 2, y)
    words = ("--catalogue", catalogue, "--out", tmp_path / "model", "methods=[noisy,field]", *TINY)
    assert "by x -2.0" in refused("train", sky.image, *words)


@pytest.mark.parametrize(("level", "is_flagged"), [(SKY, False), (0.0, True)])
def test_a_sky_of_another_image_is_flagged(sky, level, is_flagged):
    catalogue = sky.listed(f"sky{level:.0f}", *sky.position.T, sky=np.full(len(sky.snr), level))
    process, out = sky.predicted(catalogue, "--background-column", "sky")
    assert process.exit_code == 0 and (f"SKY_OFF: {len(sky.snr)}" in process.output) == is_flagged
    assert ((Table.read(out, hdu="STARS")["flags"] & StarFlag.SKY_OFF > 0) == is_flagged).all()


def test_models_of_other_releases_are_read(sky, tmp_path):
    """Fit that lacks a new setting, and has one that no longer exists."""
    bundle = read_bundle(sky.model)
    config = {**bundle.info.config, "train": {**bundle.info.config["train"]}}
    config["train"]["field"] = {k: v for k, v in config["train"]["field"].items() if k != "modes"}
    config["train"]["field"]["of_another_release"] = 1
    info = bundle.info.model_copy(update={"config": config})
    path = tmp_path / "other.psf.safetensors"
    write_bundle(replace(bundle, info=info), path)
    assert (load_model(path).psf_at(200, 150) == load_model(sky.model).psf_at(200, 150)).all()


def collected(pixels, sky, folder):
    """Another image of the same list, and its candidates of training stars."""
    path = folder / "other.fits"
    fits.PrimaryHDU(pixels.astype(np.float32)).writeto(path)
    config = from_words(["dataset=from_stars", "framing.stamp_px=22"])
    stars = config.calibration_stars.model_copy(update={"stars_min": 10})
    return path, collect(
        open_observation(ImageInput(path, catalogue=sky.list), 22, 8), stars, config.framing
    )


def test_the_advised_saturation_flags_as_many_stars_as_it_says(sky, tmp_path):
    """Stamps with a saturated neighbour, too; a cut that is not sharp, as of a plate."""
    level = np.quantile(sky.pixels, 0.9990)
    over = np.maximum(sky.pixels - level, 0.0)
    plate = np.minimum(sky.pixels, level) + 0.01 * level * (1 - np.exp(-over / level))
    x, y = np.rint(sky.position[sky.snr < 10][:3]).astype(int).T
    # A neighbour that is saturated; one pixel alone would be a hot one.
    for row, column in np.ndindex(3, 3):
        plate[y + row - 1, x + column + 6] = plate.max()
    path, candidates = collected(plate, sky, tmp_path)
    advice = re.search(r"(\d+) stamps have .*saturate=(\S+) ", saturation_advice(candidates))
    count, saturation = int(advice[1]), float(advice[2])
    assert (candidates.verdict == "saturated").sum() <= count
    observation = open_observation(ImageInput(path, catalogue=sky.list, saturate=saturation), 22, 0)
    flagged = np.concatenate([s.saturated.any(axis=(1, 2)) for s in observation.chunks(64)])
    assert flagged.sum() == count > (candidates.brightest >= saturation).sum()


def test_a_hole_in_the_image_makes_no_faint_star_bright(sky, tmp_path):
    """Residuals where too much of a neighbour's light was subtracted are no light of a star."""
    faint = int(np.flatnonzero(sky.snr < 10)[0])
    x, y = np.rint(sky.position[faint]).astype(int)
    pixels, noise = sky.pixels.copy(), np.std(sky.pixels[:5, :5])
    pixels[y + 4 : y + 7, x + 4 : x + 7] -= 100.0 * noise
    _, candidates = collected(pixels, sky, tmp_path)
    assert candidates.snr[faint] < 100
    assert candidates.verdict[faint] == "faint"
