"""psfdae: point spread function modelling with a denoising autoencoder.

The package follows the science: `optics` turns wavefronts into pixels, `stars`
turns pixels into noisy star images, `models` learns the point spread function
from them, `evaluation` measures how well. `stages` binds one step of each to
files; the command line and the Snakemake workflow call stages only.

For stars of your own, `load_model` gives a trained model and its method `predict`
their PSFs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from psfdae.own_stars.model import (
        Prediction,
        PredictionError,
        PsfModel,
        StarFlag,
        load_model,
    )

__version__ = "0.1.0"

__all__ = ["Prediction", "PredictionError", "PsfModel", "StarFlag", "__version__", "load_model"]


def __getattr__(name: str) -> Any:
    """Import the model on first use (PEP 562): the command line must not wait for torch."""
    if name in __all__:
        from psfdae.own_stars import model

        return getattr(model, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """What there is, loaded or not."""
    return sorted({*globals(), *__all__})
