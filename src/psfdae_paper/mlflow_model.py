"""Model bundles of runs, as `mlflow.pyfunc` loads them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.model.bundle import SUFFIX, write_bundle
from psfdae.model.packing import uncalibrated
from psfdae.model.psf_model import PsfModel, load_model
from psfdae.model.star_sets import read_stars
from psfdae.rng import stream
from psfdae_paper.configuration.compose import part

if TYPE_CHECKING:
    from psfdae_paper.tracking import Fit

READS = ("seed", "noise", "parts")
"""Groups of settings that tell which stars a fit was trained on, and with which noise."""


class Restorer:
    """A model of PSFs as MLflow calls it."""

    def __init__(self, model: PsfModel) -> None:
        self.model = model

    def predict(self, model_input: np.ndarray, params: Mapping[str, Any] | None = None) -> Any:
        """Return PSFs of stamps (n, d, d), times their fluxes; stamps in any unit, with sky."""
        return self.model.predict(model_input).psf


def _load_pyfunc(path: str) -> Restorer:
    """Load the bundle of a folder, as `mlflow.pyfunc.load_model` asks for."""
    (bundle,) = Path(path).glob(f"*{SUFFIX}")
    return Restorer(load_model(bundle))


def write_model(fit: Fit, stars: Path, reference: str, name: str, folder: Path) -> np.ndarray:
    """Write the bundle of a fit without errors, which take a minute; return an example of input.

    No PSF depends on the errors, and `psfdae bundle` measures them. The example is a noisy stamp
    of a test star on its sky, in photons, shape (1, d, d).
    """
    described, product = fit.kind.described(fit.place), read_stars(stars, reference)
    config = part(READS, {group: described[group] for group in READS})
    fitted = fit.kind.load(fit.place, reference)
    bundle, held_out = uncalibrated(
        fitted, product, reference, config, described, name, "not stated"
    )
    write_bundle(bundle, folder / f"{name}{SUFFIX}")
    noise, rng = held_out.noise, stream(config.seed, "noise", "example")
    flux = noise.flux(float(np.median(config.noise.levels)))
    counts = rng.poisson(flux * held_out.images[:1] + noise.background)
    return np.asarray(counts, np.float32)
