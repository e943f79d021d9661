"""The width of the seeing, found with the state of the telescope, over simulated nights.

    python studies/wavefront/seeing.py OUT.csv

Nights of 12 stars of the telescope `example_zernike`, S/N 100, in a Gaussian seeing of 1.8 arcsec.
The file of the telescope says 1.5 arcsec, and the prior leaves it free by 15 %.
"""

from __future__ import annotations

import subprocess
import sys
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd

import psfdae
from psfdae.base.threads import limit_threads
from psfdae.sensing.stars import StarOptics
from psfdae.telescope.field import build_terms, model_telescope
from psfdae.telescope.settings import Prior, Seeing, read_telescope
from psfdae_paper.configuration.base import config_dir

STATED, TRUE_FWHM, WIDTH = 1.5, 1.8, 0.15
STARS, SNR, SKY, NIGHTS = 12, 100.0, 1000.0, 40


def main(out: Path) -> None:
    """Simulate nights, and fit each."""
    limit_threads(1)
    telescope = read_telescope(config_dir() / "telescope" / "example_zernike.yaml")

    def example(fwhm: float, prior: float):
        seeing = Seeing(kind="gaussian", fwhm_arcsec=fwhm)
        return telescope.model_copy(update={"seeing": seeing, "prior": Prior(seeing=prior)})

    rows = []
    for seed in range(NIGHTS):
        rng = np.random.default_rng(seed)
        angle = rng.uniform(-1.0, 1.0, (STARS, 2)) * telescope.field_edge_deg
        true_telescope = example(TRUE_FWHM, 0.0)
        model, terms = model_telescope(true_telescope, angle), build_terms(true_telescope, angle)
        truth = model.mean + model.sd * rng.standard_normal(model.sd.size)
        waves = np.einsum("mk,mkj->mj", model.coefficients(truth), terms.to_modes)
        place = rng.uniform(-0.5, 0.5, (STARS, 2))
        operator = StarOptics(true_telescope, terms, 16).operator
        images = operator.stamps(np.concatenate([waves, place], axis=1)).astype(float)
        flux = SNR * np.sqrt(SKY / (images**2).sum(axis=(1, 2)))
        counts = rng.poisson(flux[:, None, None] * images + SKY).astype(float)
        state = psfdae.wavefront(
            counts, example(STATED, WIDTH), field_deg=angle, noise=SKY**0.5, gain=1.0, joint=True
        ).joint
        strongest = np.abs(state.correlation[-1, :-1]).argmax()
        pull = (state.value[:-1] - truth) / state.error[:-1]
        row = {"night": seed, "found": state.value[-1], "error": state.error[-1]}
        row |= {"pull_of_others": np.sqrt(np.mean(pull**2)), "stars": len(state.star)}
        row |= {"with": state.model.names[strongest]}
        rows.append(row | {"correlation": state.correlation[-1, strongest], "truth": TRUE_FWHM})
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    table = pd.DataFrame(rows).assign(date=date.today().isoformat(), commit=commit)
    table.to_csv(out, index=False, float_format="%.5g")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
