"""Wavelet thresholds (BayesShrink; Chang et al. 2000, IEEE Trans. Image Process. 9, 1532)."""

from __future__ import annotations

import numpy as np

from psfdae.method import Look
from psfdae_paper.denoising import Denoiser


class Wavelet(Denoiser):
    """Soft thresholds of Daubechies' second wavelet, for noise of the given strength."""

    look = Look("wavelets", "#999933", "1", drawn=False)

    @staticmethod
    def denoise(image: np.ndarray, sigma: float, strength: float) -> np.ndarray:
        """See `Denoiser`."""
        from skimage.restoration import denoise_wavelet

        denoised: np.ndarray = denoise_wavelet(
            image, strength, "db2", method="BayesShrink", rescale_sigma=False
        )
        return denoised
