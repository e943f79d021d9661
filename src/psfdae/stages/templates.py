"""Stage `templates`: the static PSF at every field point of a scene."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from psfdae.cli import File, command
from psfdae.configuration.schema import Config
from psfdae.configuration.stages import STATIC
from psfdae.files import Column, write_product
from psfdae.stages.common import limit_threads, template_wavefronts
from psfdae.stars.fields import square_grid
from psfdae.stars.framing import Propagation


@command("templates", reads=STATIC)
def templates(
    config: Config,
    out: Annotated[File, "HDF5 product with the static PSF of every field point."],
) -> None:
    """Propagate the static PSF of every field point."""
    limit_threads(1)  # batches run side by side
    framing = config.framing
    source = template_wavefronts(config)
    propagation = Propagation(source, config.telescope, config.optics, framing, framing.search_px)
    side = framing.stamp_px + 2 * framing.jitter_px
    psf, peak = propagation.framed(side)
    inner = slice(framing.jitter_px, side - framing.jitter_px)
    index, angle_deg = square_grid(config.grid.points, config.grid.spacing_deg)
    columns = {
        "psf": Column(
            psf.astype(np.float32), "1", "pixel flux as a fraction of the light, jitter margin"
        ),
        "energy": Column(psf[:, inner, inner].sum(axis=(1, 2)), "1", "light inside the stamp"),
        "peak": Column(peak, "pixel", "brightest pixel (row, column) from the chief ray"),
        "grid": Column(index, "1", "grid index (ix, iy) of the field"),
        "field": Column(np.deg2rad(angle_deg), "rad", "field angle (x, y)"),
        "pupil_samples": Column(propagation.samples, "1", "pupil samples N"),
    }
    write_product(out, "templates", columns, config.model_dump())
