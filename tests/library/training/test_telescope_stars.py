"""Training on simulated stars of a telescope that a file describes."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from command_line import printed, psfdae, refused
from image_training import MIXTURE, few_draws
from known_wavefronts import SKY, example, field_of, imaged
from psfdae import StarFlag, load_model
from psfdae.telescope.field import build_terms
from psfdae.training import telescope_stars
from psfdae.training.settings import from_words
from psfdae_paper.configuration.base import config_dir

FOLDER = config_dir() / "telescope"
ZERNIKE = FOLDER / "example_zernike.yaml"
WORDS = ["parts.train_stars=800", "parts.test_stars=80"]
WORDS += [f"gmm.{name}={value}" for name, value in MIXTURE.items()]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    out = tmp_path_factory.mktemp("telescope")
    with pytest.MonkeyPatch.context() as patch, few_draws():
        patch.setattr(telescope_stars, "FIELD_POINTS", 20)
        options = ("--telescope", ZERNIKE, "--method", "gmm", "--out", out)
        output = printed("train", *options, *WORDS)
    assert "400 stars" in output and "psfdae predict IMAGE" in output
    return load_model(out / "example_zernike.psf.safetensors")


def fresh_stars(telescope, count, snr, seed):
    """Counts with the brightest pixel in the middle, noise-free PSFs of sum 1, and fluxes."""
    rng = np.random.default_rng(seed)
    angle = field_of(telescope, count, rng)
    terms = build_terms(telescope, angle)
    waves = terms.mean + terms.sd * rng.standard_normal(terms.mean.shape)
    place = rng.uniform(-0.5, 0.5, (count, 2))
    counts, _ = imaged(telescope, angle, waves, place, snr)
    peak = np.stack(np.divmod(counts.reshape(count, -1).argmax(axis=1), 16), axis=1)
    counts, _ = imaged(telescope, angle, waves, place - (peak - 8)[:, ::-1], snr)
    flux = (counts - SKY).sum(axis=(1, 2))
    return rng.poisson(counts).astype(float), (counts - SKY) / flux[:, None, None], flux


def restored(model, counts):
    return model.predict(counts, background=SKY, noise=SKY**0.5)


@pytest.mark.slow
def test_restored_stars_are_far_nearer_to_the_truth_than_the_noisy_ones(model):
    """By the ratio of pixels to numbers that change a PSF, 256 over some 10."""
    counts, psf, flux = fresh_stars(example("zernike"), 100, 10.0, 3)
    prediction = restored(model, counts)
    error = ((prediction.psf / prediction.flux[:, None, None] - psf) ** 2).mean()
    noisy = (counts - SKY) / flux[:, None, None]
    assert 10.0 < ((noisy - psf) ** 2).mean() / error < 50.0


@pytest.mark.slow
def test_stars_of_another_telescope_are_flagged(model):
    telescope = example("zernike")
    terms = telescope.aberrations.terms
    focus = {**terms, "z4": {**terms["z4"], "constant": -1.5}}
    aberrations = telescope.aberrations.model_copy(update={"terms": focus})
    other_telescope = telescope.model_copy(update={"aberrations": aberrations})
    flagged, chi2 = [], []
    for source in (telescope, other_telescope):
        prediction = restored(model, fresh_stars(source, 100, 50.0, 4)[0])
        flagged.append(np.mean(prediction.flags & StarFlag.UNLIKE_TRAINING > 0))
        chi2.append(np.median(prediction.chi2))
    # Only the worst stars are flagged, but the residuals of nearly all are too large.
    assert flagged[0] <= 0.02 and 0.1 < flagged[1] < 0.9
    assert chi2[0] == pytest.approx(1.0, abs=0.1) and 1.8 < chi2[1] < 3.5


def test_simulated_stars_stand_in_the_middle_of_their_stamps(monkeypatch):
    monkeypatch.setattr(telescope_stars, "FIELD_POINTS", 6)
    telescope = example("zernike")
    source = telescope_stars.simulate_stars(telescope, ZERNIKE, from_words())
    counts = fits.getdata(source.image.path).astype(float)
    assert counts.shape == (36, 32, 32)
    assert (counts.reshape(36, -1).argmax(axis=1) == 16 * 32 + 16).mean() > 0.8
    assert np.median(counts[:, :4]) == pytest.approx(SKY, rel=0.05)
    snr = np.sqrt(((counts - SKY) ** 2).sum(axis=(1, 2)) / SKY)
    assert snr == pytest.approx(telescope_stars.SNR, rel=0.02)
    # A square field of 2° in pixels of 0.8 arcsec, half a cell between neighbours.
    assert source.catalogue.min() > 0 and source.catalogue.max() < 9000
    gap = np.linalg.norm(source.catalogue[:, None] - source.catalogue, axis=2)
    assert gap[gap > 0].min() > 9000 / 6 / 2


def test_a_telescope_without_aberrations_is_named(tmp_path):
    result = psfdae("train", "--telescope", FOLDER / "ideal_1m.yaml", "--out", tmp_path / "model")
    assert result.exit_code == 2 and "ideal_1m.yaml: aberrations: missing" in result.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--telescope", ZERNIKE, "image.fits"], "one of them"),
        ([], "one of them"),
        (["--telescope", ZERNIKE, "--detect"], "no options of an image"),
        (["--telescope", ZERNIKE, "--method", "field"], "--method field"),
    ],
)
def test_what_cannot_be_trained_on_is_named(tmp_path, words, message):
    assert message in refused("train", *words, "--out", tmp_path / "model")
    assert not (tmp_path / "model").exists()
