"""Classical denoisers as methods: they reduce the noise, and their strength is found."""

from __future__ import annotations

import numpy as np
import pytest

from psfdae.method import TrainingSet
from psfdae.methods import method
from psfdae.metrics import mse
from psfdae.noise import NoiseModel
from psfdae_paper.denoising import STRENGTHS

NOISE = NoiseModel(4.98, 1e4)
LEVELS = np.array([1e-3, 4e-3])


@pytest.fixture(scope="module")
def data(gaussian_stars):
    stars = np.arange(len(gaussian_stars))
    return TrainingSet(gaussian_stars, gaussian_stars, stars[:30], stars[30:60], LEVELS, NOISE, 3)


@pytest.mark.parametrize(("name", "most"), [("wavelet", 0.7), ("nl_means", 0.4), ("tv", 0.4)])
def test_the_strength_is_that_with_the_least_error(data, name, most):
    kind = method(name)
    fitted = kind.fit(data)
    assert ((fitted.strength > STRENGTHS[0]) & (fitted.strength < STRENGTHS[-1])).all()
    clean = data.images[data.validation]
    for level, strength in zip(LEVELS, fitted.strength, strict=True):
        noisy = NOISE.draw(clean, level, np.random.default_rng(1))
        errors = {
            s: mse(kind.denoised(noisy, NOISE.kappa * level, s), clean).mean() for s in STRENGTHS
        }
        # Another draw of the noise, whose best may be a neighbour.
        assert errors[strength] < 1.05 * min(errors.values())
        assert errors[strength] < 0.8 * max(errors[STRENGTHS[0]], errors[STRENGTHS[-1]])
        restored = fitted.predict(noisy, level)
        assert mse(restored, clean).mean() == pytest.approx(errors[strength], rel=1e-5)
        assert errors[strength] < most * mse(noisy, clean).mean()
    # Images in another unit are the same images.
    twice = NoiseModel(2 * NOISE.kappa, NOISE.background)
    scaled = type(fitted)(fitted.level, fitted.strength, twice).predict(2 * noisy, LEVELS[-1])
    assert scaled == pytest.approx(2 * restored, abs=1e-6)
