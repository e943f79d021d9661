"""Stage `stars`: noise-free star images with both of their references."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np

from psfdae.belonging import STATIC, require
from psfdae.cli import File, command
from psfdae.configuration.schema import Config
from psfdae.configuration.stages import SIMULATION
from psfdae.files import Column, Empty, read_product, stream_product
from psfdae.rng import stream
from psfdae.stages.common import drawn_columns, limit_threads, star_wavefronts
from psfdae.stars.fields import assign_fields, draw_jitter, draw_phase
from psfdae.stars.framing import crop_jittered, normalise_flux

STARS_AT_A_TIME = 1024
"""Stars that are propagated before they are written; memory does not grow beyond them."""


@command("stars", reads=SIMULATION)
def stars(
    config: Config,
    templates: Annotated[File, "Product of the stage templates."],
    out: Annotated[File, "HDF5 product with noise-free stars."],
) -> None:
    """Simulate noise-free stars with random aberrations."""
    # A realisation has static and random aberrations, a template static ones only. Both are
    # framed on their own brightest pixel, moved by the same jitter and normalised by the flux
    # inside the stamp (eq. 8). With `framing.subpixel` the pixel grid of a realisation lies
    # anywhere within ± half a pixel of the template's. All random numbers are drawn first,
    # about 100 bytes per star; images are made and written `STARS_AT_A_TIME`.
    fixed = read_product(templates, "templates", ("psf", "grid"))
    require(templates, fixed.config, STATIC, config)
    name, count, jitter_px = config.stars.name, config.stars.count, config.framing.jitter_px
    star_field = assign_fields(count, len(fixed["psf"]), stream(config.seed, "field", name))
    jitter = draw_jitter(count, jitter_px, stream(config.seed, "jitter", name))
    phase = np.zeros((count, 2))
    if config.framing.subpixel:
        phase = draw_phase(count, stream(config.seed, "phase", name))
    columns: dict[str, Column | Empty] = {
        "template": _images(config, "static PSF, sum 1"),
        "field_index": Column(star_field, "1", "field of the star"),
        "grid": Column(fixed["grid"], "1", "grid index (ix, iy) of every field"),
        "jitter": Column(jitter, "pixel", "centring error (row, column)"),
    }
    if config.stars.aberration_fraction > 0:
        propagation = _propagation(config, star_field)
        columns |= _realisation_columns(config, propagation)
        if config.framing.subpixel:
            columns["phase"] = Column(phase, "pixel", "position of the pixel grid (row, column)")
    else:
        propagation = None
        columns["realisation"] = columns["template"]
        columns["energy"] = Empty((count,), np.float64, "1", "light inside the stamp")
    with stream_product(out, "stars", columns, config.model_dump()) as data:
        for chunk in _chunks(count):
            part = slice(chunk[0], chunk[-1] + 1)
            cut = _templates(fixed["psf"][star_field[chunk]], jitter[chunk], jitter_px)
            if propagation is not None:
                cut |= _realisations(config, propagation, chunk, jitter[chunk], phase[chunk])
            for column, values in cut.items():
                data[column][part] = values


def _chunks(count: int) -> Iterator[np.ndarray]:
    for start in range(0, count, STARS_AT_A_TIME):
        yield np.arange(start, min(start + STARS_AT_A_TIME, count))


def _images(config: Config, about: str) -> Empty:
    side = config.framing.stamp_px
    return Empty((config.stars.count, side, side), np.float32, "1", about)


def _templates(framed: np.ndarray, jitter: np.ndarray, margin: int) -> dict[str, np.ndarray]:
    cropped = crop_jittered(framed.astype(np.float64), jitter, margin)
    template, energy = normalise_flux(cropped)
    return {"template": template, "energy": energy}


def _propagation(config: Config, star_field: np.ndarray) -> Any:
    from psfdae.stars.framing import Propagation

    limit_threads(1)  # batches run side by side
    source = star_wavefronts(config, star_field)
    return Propagation(
        source, config.telescope, config.optics, config.framing, config.stars.search_px
    )


def _realisation_columns(config: Config, propagation: Any) -> dict[str, Column | Empty]:
    count = config.stars.count
    about_peak = "brightest pixel (row, column) from the chief ray"
    return {
        "realisation": _images(config, "noise-free image, sum 1"),
        "energy": Empty((count,), np.float64, "1", "light inside the stamp"),
        "peak": Empty((count, 2), np.int64, "pixel", about_peak),
        **drawn_columns(propagation.source),
        "pupil_samples": Column(propagation.samples, "1", "pupil samples N"),
    }


def _realisations(
    config: Config, propagation: Any, stars: np.ndarray, jitter: np.ndarray, phase: np.ndarray
) -> dict[str, np.ndarray]:
    stamps, peak = propagation.framed(config.framing.stamp_px, jitter, stars, phase)
    realisation, energy = normalise_flux(stamps)
    return {"realisation": realisation, "energy": energy, "peak": peak}
