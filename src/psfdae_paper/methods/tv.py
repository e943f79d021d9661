"""Total variation (Rudin et al. 1992, Physica D 60, 259; Chambolle 2004)."""

from __future__ import annotations

import numpy as np

from psfdae.method import Look
from psfdae_paper.denoising import Denoiser


class TotalVariation(Denoiser):
    """The image with the least variation near the noisy one; the strength weighs the variation."""

    look = Look("total variation", "#44aa99", "3", drawn=False)

    @staticmethod
    def denoise(image: np.ndarray, sigma: float, strength: float) -> np.ndarray:
        """See `Denoiser`."""
        from skimage.restoration import denoise_tv_chambolle

        denoised: np.ndarray = denoise_tv_chambolle(image, strength)  # type: ignore[no-untyped-call]
        return denoised
