"""Stage `bank`: fresh draws of the simulator, framed so that they can be mirrored."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from psfdae.bounds.bank import MIRROR_MARGIN
from psfdae.cli import File, command
from psfdae.configuration.schema import Config
from psfdae.configuration.stages import SIMULATION
from psfdae.files import Column, write_product
from psfdae.rng import stream
from psfdae.stages.common import drawn_columns, limit_threads, star_wavefronts
from psfdae.stars.fields import assign_fields
from psfdae.stars.framing import Propagation

FINE_RUNGS = (158, 190)
"""Pupil samples that a bank may use besides `optics.pupil_samples`.

The sampling guard decides as it does for stars. Such stamps of scene 1 differ from
those of N = 222 by an MSE of 4e-11 at most, below any noise of the datasets, and
take half the time.
"""


@command("bank", reads=(*SIMULATION, "bounds"))
def bank(
    config: Config,
    out: Annotated[File, "HDF5 product with fresh stars, framed so that they can be mirrored."],
) -> None:
    """Simulate the bank of fresh stars behind the posterior mean."""
    limit_threads(1)  # batches run side by side
    # Another name gives other random streams: no training or test star is in the bank.
    named = {"name": f"{config.stars.name}_bank", "count": config.bounds.bank_stars}
    drawn = config.model_copy(update={"stars": config.stars.model_copy(update=named)})
    fields = drawn.grid.points**2
    name, count = drawn.stars.name, drawn.stars.count
    star_field = assign_fields(count, fields, stream(drawn.seed, "field", name))
    source = star_wavefronts(drawn, star_field)
    ladder = sorted({*FINE_RUNGS, *drawn.optics.pupil_samples})
    optics = drawn.optics.model_copy(
        update={"pupil_samples": ladder, "threads": config.bounds.threads}
    )
    framing = drawn.framing
    propagation = Propagation(source, drawn.telescope, optics, framing, drawn.stars.search_px)
    framed, peak = propagation.framed(framing.stamp_px + 2 * (framing.jitter_px + MIRROR_MARGIN))
    columns = {
        "framed": Column(
            framed.astype(np.float32), "1", "pixel flux as a fraction of the light, with margin"
        ),
        "field_index": Column(star_field, "1", "field of the star"),
        "peak": Column(peak, "pixel", "brightest pixel (row, column) from the chief ray"),
        **drawn_columns(source),
        "pupil_samples": Column(propagation.samples, "1", "pupil samples N"),
    }
    write_product(out, "bank", columns, config.model_dump())
