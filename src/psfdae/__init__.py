"""psfdae: point spread function modelling with a denoising autoencoder.

For the stars of an image::

    stars = psfdae.Stars.from_image("image.fits", catalogue="stars.csv")
    model = psfdae.fit(stars, method="field")
    report = psfdae.validate(model, stars)
    model.save("image.psf.safetensors")

For a telescope whose optics are known::

    wavefronts = psfdae.wavefront(stamps, "telescope.yaml", field_deg=field, joint=True)

`load_model` gives a trained model; its methods `predict` and `psf_at` give PSFs. Only calls named
for it, such as `save`, write files; no call changes the threads or random generators of the
process. In a terminal, long calls show a progress bar. Wrong input raises `Error`.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING

from psfdae.base import progress
from psfdae.base.version import __version__
from psfdae.commands import terminal

progress.show_with(terminal.bar)

if TYPE_CHECKING:
    from psfdae.api import PsfModel, Stars, fit, load_model
    from psfdae.base.errors import Error
    from psfdae.denoise.prediction import Prediction
    from psfdae.image.detected_stars import detect
    from psfdae.image.stamps import StarFlag
    from psfdae.psf.interface import PredictionError
    from psfdae.report.report import Report
    from psfdae.report.validation import validate
    from psfdae.sensing.results import Wavefronts, wavefront
    from psfdae.telescope.settings import read_telescope

_MODULES = {
    "Error": "base.errors",
    "Prediction": "denoise.prediction",
    "PredictionError": "psf.interface",
    "PsfModel": "api",
    "Report": "report.report",
    "StarFlag": "image.stamps",
    "Stars": "api",
    "Wavefronts": "sensing.results",
    "detect": "image.detected_stars",
    "fit": "api",
    "load_model": "api",
    "read_telescope": "telescope.settings",
    "validate": "report.validation",
    "wavefront": "sensing.results",
}

__all__ = [
    "Error",
    "Prediction",
    "PredictionError",
    "PsfModel",
    "Report",
    "StarFlag",
    "Stars",
    "Wavefronts",
    "__version__",
    "detect",
    "fit",
    "load_model",
    "read_telescope",
    "validate",
    "wavefront",
]


if not TYPE_CHECKING:  # a type checker would accept any name of a module with __getattr__

    def __getattr__(name: str) -> object:
        """Import a public name on first use (PEP 562), so that `import psfdae` is fast."""
        if name in _MODULES:
            return getattr(import_module(f"psfdae.{_MODULES[name]}"), name)
        # With `name` and `obj`, Python suggests a similar name.
        text = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(text, name=name, obj=sys.modules[__name__])


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted({*globals(), *_MODULES})
