"""From stamps of stars to their PSFs: photometry, network, uncertainty, shapes, flags.

`PsfModel` works on arrays; `psfdae.stages.predict` on files, piece by piece.
"""

from psfdae.prediction.flags import StarFlag
from psfdae.prediction.model import PredictionError, PsfModel, load_model
from psfdae.prediction.results import Prediction

__all__ = ["Prediction", "PredictionError", "PsfModel", "StarFlag", "load_model"]
