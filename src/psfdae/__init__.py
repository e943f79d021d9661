"""psfdae: point spread function modelling with a denoising autoencoder.

For stars of your own::

    stars = psfdae.Stars.from_image("image.fits", catalogue="stars.csv")
    model = psfdae.fit(stars, method="field")
    report = psfdae.validate(model, stars)
    model.save("image.psf.safetensors")

`load_model` gives a trained model; its methods `predict` and `psf_at` give PSFs. No call writes a
file unless it is named for that, prints, or changes threads or random generators of the process.
Refusals are of the class `Error`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from psfdae.version import __version__

if TYPE_CHECKING:
    from psfdae.errors import Error
    from psfdae.image.stamps import StarFlag
    from psfdae.model.fitting import fit
    from psfdae.model.prediction import Prediction
    from psfdae.model.psf_model import PredictionError, PsfModel, load_model
    from psfdae.model.stars import Stars
    from psfdae.model.validation import Report, validate

_MODULES = {
    "Error": "errors",
    "Prediction": "model.prediction",
    "PredictionError": "model.psf_model",
    "PsfModel": "model.psf_model",
    "Report": "model.validation",
    "StarFlag": "image.stamps",
    "Stars": "model.stars",
    "fit": "model.fitting",
    "load_model": "model.psf_model",
    "validate": "model.validation",
}

__all__ = [
    "Error",
    "Prediction",
    "PredictionError",
    "PsfModel",
    "Report",
    "StarFlag",
    "Stars",
    "__version__",
    "fit",
    "load_model",
    "validate",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562): nobody waits for what is not used."""
    if name in _MODULES:
        return getattr(import_module(f"psfdae.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """What there is, loaded or not."""
    return sorted({*globals(), *_MODULES})
