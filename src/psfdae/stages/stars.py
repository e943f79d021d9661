"""Stage `stars`: noise-free star images with both of their references."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from psfdae.files import Column, read_product, write_product
from psfdae.rng import stream
from psfdae.stages.common import limit_threads, scene_module
from psfdae.stars.fields import assign_fields, draw_jitter
from psfdae.stars.framing import crop_jittered, normalise_flux, stamp_offset


def run(config: Any, templates: Path, out: Path) -> None:
    """Put stars on fields, perturb, propagate and frame them.

    Every star gets a realisation (static and random aberrations) and a template
    (static only), each framed on its own brightest pixel and moved by the same
    jitter, each normalised by the flux inside its stamp (eq. 8).

    Parameters
    ----------
    config : stage config (seed, telescope, grid, wavefront, stars, framing, optics)
    templates : path of the product "templates" of the scene
    out : path of the HDF5 product "stars"
    """
    fixed = read_product(templates, "templates", ("psf", "grid"))
    name, count, jitter_px = config.stars.name, config.stars.count, config.framing.jitter_px
    star_field = assign_fields(count, len(fixed["psf"]), stream(config.seed, "field", name))
    jitter = draw_jitter(count, jitter_px, stream(config.seed, "jitter", name))
    cropped = crop_jittered(fixed["psf"][star_field].astype(np.float64), jitter, jitter_px)
    template, energy = normalise_flux(cropped)
    template = template.astype(np.float32)
    columns = {
        "template": Column(template, "1", "static PSF, sum 1"),
        "field_index": Column(star_field, "1", "field of the star"),
        "grid": Column(fixed["grid"], "1", "grid index (ix, iy) of every field"),
        "jitter": Column(jitter, "pixel", "centring error (row, column)"),
    }
    if config.stars.aberration_fraction > 0:
        columns |= _realisations(config, star_field, jitter)
    else:
        columns["realisation"] = Column(template, "1", "noise-free image: the template")
        columns["energy"] = Column(energy, "1", "light inside the stamp")
    write_product(out, "stars", columns, config.model_dump())


def _realisations(config: Any, star_field: np.ndarray, jitter: np.ndarray) -> dict[str, Column]:
    from psfdae.stars.scene import Propagation

    limit_threads(config.optics.threads)
    source = scene_module(config.scene.name).star_wavefronts(config, star_field)
    propagation = Propagation(
        source, config.telescope, config.optics, config.framing, config.stars.search_px
    )
    peak = propagation.brightest()
    stamps = propagation.stamps(config.framing.stamp_px, stamp_offset(peak, jitter))
    realisation, energy = normalise_flux(stamps)
    return {
        "realisation": Column(realisation.astype(np.float32), "1", "noise-free image, sum 1"),
        "energy": Column(energy, "1", "light inside the stamp"),
        "peak": Column(peak, "pixel", "brightest pixel (row, column) from the chief ray"),
        "seidel": Column(source.seidel, "wave", "W040, W131, W222, W220, W311 at H = 1"),
        "pupil_samples": Column(propagation.samples, "1", "pupil samples N"),
    }
