"""Model bundles as `pyfunc` models of MLflow, which loads and serves them by this module's name."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.base.rng import stream
from psfdae.base.version import __version__
from psfdae.denoise.bundle import SUFFIX, Bundle, write_bundle
from psfdae.denoise.star_model import StarModel


class ServedModel:
    """Model bundle as MLflow calls it: stamps in, PSFs out.

    Parameters
    ----------
    path : str or Path
        Model bundle.
    """

    def __init__(self, path: str | Path) -> None:
        self.model = StarModel.load(path)

    def predict(self, stamps: np.ndarray, params: dict[str, Any] | None = None) -> np.ndarray:
        """Return the PSFs of stamps (n, s, s) times their fluxes, as `psfdae predict` does."""
        return self.model.predict(stamps).psf


_load_pyfunc = ServedModel
"""Name by which MLflow calls a loader."""


def write_pyfunc(bundle: Bundle, folder: Path) -> None:
    """Write a bundle as a `pyfunc` model with signature, input example and requirements.

    Parameters
    ----------
    bundle : Bundle
        Model of the stars of a telescope.
    folder : Path
        New folder. Its requirements name this version of psfdae, with torch for a network.
    """
    from mlflow.models import ModelSignature
    from mlflow.pyfunc import save_model
    from mlflow.types import Schema, TensorSpec

    info = bundle.info
    # Any number of stamps: inputs in any unit with their sky, outputs PSFs times fluxes.
    shape = (info.stamp_px, info.stamp_px)
    schema = Schema([TensorSpec(np.dtype(np.float32), (-1, *shape))])
    # The mean star on a sky of B = 10,000 photons in each pixel, whose noise √B is, over the
    # flux of the star, the smallest of the training.
    sky = 1e4
    photons = np.sqrt(sky) / info.noise_min * np.maximum(bundle.flux_model.mean, 0.0) + sky
    example = stream(0, "mlflow", "example").poisson(photons.reshape(1, *shape))
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary, f"{info.name}{SUFFIX}")
        write_bundle(bundle, path)
        save_model(
            folder,
            loader_module=__name__,
            data_path=str(path),
            signature=ModelSignature(schema, schema),
            input_example=example.astype(np.float32),
            pip_requirements=[f"psfdae{'[dae]' if info.dae else ''}=={__version__}"],
        )
