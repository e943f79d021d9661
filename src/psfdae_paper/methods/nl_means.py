"""Non-local means (Buades et al. 2005, Proc. IEEE CVPR 2, 60), with the noise's variance."""

from __future__ import annotations

import numpy as np

from psfdae.method import Look
from psfdae_paper.denoising import Denoiser

PATCH_PX, REACH_PX = 3, 5
"""Side of a patch, and farthest patch; a star is hardly larger."""


class NonLocalMeans(Denoiser):
    """Means over pixels with similar surroundings; the strength is the width of their weight."""

    look = Look("non-local means", "#882255", "2", drawn=False)

    @staticmethod
    def denoise(image: np.ndarray, sigma: float, strength: float) -> np.ndarray:
        """See `Denoiser`."""
        from skimage.restoration import denoise_nl_means

        denoised: np.ndarray = denoise_nl_means(image, PATCH_PX, REACH_PX, strength, sigma=sigma)
        return denoised
