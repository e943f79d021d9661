"""Observed star images: FITS cubes of stamps, or FITS images with a star catalogue.

`open_observation` checks everything that can be checked without reading pixels and
returns an `Observation`, whose `chunks` then stream the stamps. Whatever is wrong
with a file ends in one `ObservationError` of one line that names the file.

| input | stamps | positions |
|---|---|---|
| cube (n, d, d), or one stamp (d, d) | as stored | from the catalogue, row by row, or NaN |
| image (h, w) and a catalogue | cut at the rounded position | of the catalogue |
"""

from psfdae.observations.errors import ObservationError
from psfdae.observations.observation import Observation, Stamps
from psfdae.observations.opening import open_observation

__all__ = ["Observation", "ObservationError", "Stamps", "open_observation"]
