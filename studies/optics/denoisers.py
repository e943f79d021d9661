"""Errors and times of denoisers that know no star, per dataset.

    python studies/optics/denoisers.py RESULTS DATASET OUT.csv

RESULTS is the folder of a run (`make reproduce`), of which the noise-free stars are read. The test
stars are those of the error bounds, with the same noise. One thread.

A denoiser learns one number from other stars: its strength, in units of the noise of a sky pixel,
with which the error of noisy validation stars is least at each noise level.
"""

from __future__ import annotations

import subprocess
import sys
import time
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd
from skimage.restoration import denoise_nl_means, denoise_tv_chambolle, denoise_wavelet

from psfdae.base.rng import stream
from psfdae.base.threads import limit_threads
from psfdae.methods.interface import TrainingSet
from psfdae.methods.lmmse import LinearMmse
from psfdae.methods.metrics import clustered_mean, mse
from psfdae.model.star_sets import read_stars, training_set
from psfdae_paper.bounds.estimates import bounded_stars
from psfdae_paper.configuration.compose import load

STRENGTHS = tuple(2.0 ** np.arange(-2.0, 2.25, 0.5))
"""Strengths that are tried, in units of the noise's standard deviation."""


def wavelet(image: np.ndarray, sigma: float, strength: float) -> np.ndarray:
    """Soft thresholds of Daubechies' second wavelet (Chang et al. 2000, IEEE TIP 9, 1532)."""
    return denoise_wavelet(image, strength, "db2", method="BayesShrink", rescale_sigma=False)


def nl_means(image: np.ndarray, sigma: float, strength: float) -> np.ndarray:
    """Means over pixels with similar surroundings (Buades et al. 2005, IEEE CVPR 2, 60)."""
    # Patches of 3 px, at most 5 px away: a star is hardly larger.
    return denoise_nl_means(image, 3, 5, strength, sigma=sigma)


def tv(image: np.ndarray, sigma: float, strength: float) -> np.ndarray:
    """Return the image of the least variation near the noisy one (Rudin et al. 1992)."""
    return denoise_tv_chambolle(image, strength)


DENOISERS = {"wavelet": wavelet, "nl_means": nl_means, "tv": tv}


def denoised(name: str, noisy: np.ndarray, sigma: float, strength: float) -> np.ndarray:
    """Images (n, d, d) denoised at a strength; `sigma` is the noise of a sky pixel."""
    # The functions have absolute tolerances, made for images between 0 and 1.
    peak = float(np.abs(noisy).max()) or 1.0
    scaled = noisy.astype(np.float64) / peak
    images = [DENOISERS[name](image, sigma / peak, strength * sigma / peak) for image in scaled]
    return (peak * np.array(images)).astype(np.float32)


def best_strengths(name: str, data: TrainingSet) -> dict[float, float]:
    """Strength with the least error on noisy validation stars, by noise level."""
    stars = (data.validation if data.validation.size else data.fit)[:200]
    images, references = data.images[stars], data.references[stars]
    rng, strengths = stream(data.seed, name, "noise"), {}
    for level in data.levels:
        noisy, sigma = data.noise.draw(images, level, rng), data.noise.kappa * level
        errors = [mse(denoised(name, noisy, sigma, s), references).mean() for s in STRENGTHS]
        strengths[level] = STRENGTHS[int(np.argmin(errors))]
    return strengths


def main(results: Path, dataset: str, out: Path) -> None:
    """Measure the methods on one dataset."""
    limit_threads(1)
    config = load([f"dataset={dataset}"])
    place = results / "data" / config.scene.name / f"{config.stars.name}.h5"
    product = read_stars(place, "template")
    stars = bounded_stars(config, product)
    rows = []

    def add(name, level, reference, error, seconds):
        mean, stderr = clustered_mean(error, stars.field)
        rows.append(
            {
                "dataset": dataset,
                "method": name,
                "reference": reference,
                "noise_level": level,
                "mse": mean,
                "stderr": stderr,
                "median": np.median(error),
                "n": error.size,
                "ms_per_star": 1000 * seconds / error.size,
            }
        )
        print(rows[-1], flush=True)

    for name in DENOISERS:
        for reference in config.dataset.references:
            # Stars and noise of a method that is told the noise level.
            data = training_set(config, LinearMmse, product, "random", reference)
            strengths = best_strengths(name, data)
            for level, noisy in stars.noisy.items():
                started = time.process_time()
                nearest = min(strengths, key=lambda candidate: abs(np.log(candidate / level)))
                psf = denoised(name, noisy, data.noise.kappa * level, strengths[nearest])
                took = time.process_time() - started
                add(name, level, reference, mse(psf, stars.truth[reference]), took)
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    table = pd.DataFrame(rows).assign(date=date.today().isoformat(), commit=commit)
    table.to_csv(out, index=False, float_format="%.5g")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
