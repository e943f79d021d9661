"""Denoisers that know no star, as a method: wavelets, non-local means, total variation.

They learn one number from other stars: their strength, in units of the noise of a sky pixel, with
which the error of noisy validation stars is least at a noise level.
"""

from dataclasses import dataclass

import numpy as np
from skimage.restoration import denoise_nl_means, denoise_tv_chambolle, denoise_wavelet

from psfdae.base.rng import stream
from psfdae.methods.interface import Look, Method, Needs
from psfdae.methods.metrics import mse


def wavelet(image, sigma, strength):
    """Soft thresholds of Daubechies' second wavelet (Chang et al. 2000, IEEE TIP 9, 1532)."""
    return denoise_wavelet(image, strength, "db2", method="BayesShrink", rescale_sigma=False)


def nl_means(image, sigma, strength):
    """Means over pixels with similar surroundings (Buades et al. 2005, IEEE CVPR 2, 60)."""
    # Patches of 3 px, at most 5 px away: a star is hardly larger.
    return denoise_nl_means(image, 3, 5, strength, sigma=sigma)


def tv(image, sigma, strength):
    """Return the image of the least variation near the noisy one (Rudin et al. 1992)."""
    return denoise_tv_chambolle(image, strength)


def denoise_images(denoise, noisy, sigma, strength):
    """Images (n, d, d) denoised at a strength; `sigma` is the noise of a sky pixel."""
    # The functions have absolute tolerances, made for images between 0 and 1.
    peak = float(np.abs(noisy).max()) or 1.0
    scaled = noisy.astype(np.float64) / peak
    images = [denoise(image, sigma / peak, strength * sigma / peak) for image in scaled]
    return (peak * np.array(images)).astype(np.float32)


@dataclass(frozen=True)
class Denoisers(Method):
    """The denoiser and the strength with the least error of validation stars, at each noise level.

    Attributes
    ----------
    noise : NoiseModel
    choices : dict
        Denoising function and strength by noise level λ.
    """

    look = Look("denoisers", "#8c510a", "P", is_drawn=False)
    needs = Needs(level=True, validation=True)
    storage = packing = None

    noise: object
    choices: dict

    @classmethod
    def fit(cls, data, functions=(wavelet, nl_means, tv)):
        """Try strengths from 1/4 to 4 in steps of √2 on at most 200 stars."""
        stars = (data.validation if data.validation.size else data.fit)[:200]
        images, references = data.images[stars], data.references[stars]
        choices = {}
        for level in data.levels:
            # All denoisers get the same noise.
            noisy = data.noise.draw(images, level, stream(data.seed, "denoisers", f"{level:.6g}"))
            errors = {
                (denoise, strength): mse(
                    denoise_images(denoise, noisy, data.noise.kappa * level, strength), references
                ).mean()
                for denoise in functions
                for strength in 2.0 ** np.arange(-2.0, 2.25, 0.5)
            }
            choices[level] = min(errors, key=errors.get)
        return cls(data.noise, choices)

    def predict(self, noisy, level):
        """Denoise images (n, d, d) of one noise level λ of the training."""
        denoise, strength = self.choices[level]
        return denoise_images(denoise, noisy, self.noise.kappa * level, strength)
