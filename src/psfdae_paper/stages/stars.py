"""Stages `templates` and `stars`: static PSFs, and noise-free stars with both references.

Input: settings of a scene. Outputs: HDF5 products with stamps of flux 1, namely the static PSF of
every field point, and single stars, each with its own noise-free image (realisation) and the static
PSF of its field (template). Noise is added later, by the stages that need it.
"""

from __future__ import annotations

import numpy as np

from psfdae.base import belonging
from psfdae.base.files import Column, Empty, read_product, stream_product, write_product
from psfdae.base.options import File
from psfdae.base.progress import steps
from psfdae.base.rng import stream
from psfdae.base.threads import limit_threads
from psfdae.stars.splits import draw_jitter, draw_phase
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.consistency import SIMULATION, STATIC
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stars.fields import assign_fields, square_grid
from psfdae_paper.stars.framing import Propagation, crop_jittered, normalise_flux
from psfdae_paper.stars.scenes import aberration_columns, star_wavefronts, template_wavefronts

STARS_AT_A_TIME = 1024
"""Stars that are propagated before they are written; they limit the memory."""


@command("paper templates", reads=STATIC)
def templates(config: Config, out: File) -> None:
    """Propagate the static PSF of every field point.

    A PSF is the fraction of the light on each pixel. Its brightest pixel is in the middle, and it
    has a margin, from which stamps with any centring error are cut.

    The product also has the light inside each stamp, the position of the brightest pixel, the angle
    of each field point in radians, and the number of pupil samples.

    Parameters
    ----------
    config : Config
        Scene, telescope, framing, grid, wavefront and optics.
    out : Path
        HDF5 product with the static PSF of every field point.
    """
    limit_threads(1)  # batches run in parallel
    framing = config.framing
    # Wavefront of each field, and its image around the brightest pixel.
    source = template_wavefronts(config)
    propagation = Propagation(source, config.telescope, config.optics, framing, framing.search_px)
    side = framing.stamp_px + 2 * framing.jitter_px
    psf, peak = propagation.frame(side)
    # The stamp without the margin.
    stamp = slice(framing.jitter_px, side - framing.jitter_px)
    # Field angles of a square grid, centred on the optical axis.
    index, angle_deg = square_grid(config.grid.points, config.grid.spacing_deg)
    columns = {
        "psf": Column(
            psf.astype(np.float32), "1", "pixel flux as a fraction of the light, jitter margin"
        ),
        "energy": Column(psf[:, stamp, stamp].sum(axis=(1, 2)), "1", "light inside the stamp"),
        "peak": Column(peak, "pixel", "brightest pixel (row, column) from the chief ray"),
        "grid": Column(index, "1", "grid index (ix, iy) of the field"),
        "field": Column(np.deg2rad(angle_deg), "rad", "field angle (x, y)"),
        "pupil_samples": Column(propagation.samples, "1", "pupil samples N"),
    }
    write_product(out, "templates", columns, config.model_dump())


@command("paper stars", reads=SIMULATION)
def stars(config: Config, templates: File, out: File) -> None:
    """Simulate noise-free stars with random aberrations.

    Each star has its own image (realisation) and the static PSF of its field (template), both on a
    stamp of flux 1 with the same centring error, and the random numbers that made it.

    Without random aberrations (stars.aberration_fraction = 0) realisations and templates are the
    same. The product is without noise: each stage draws it for the noise levels that it needs.

    Parameters
    ----------
    config : Config
        Settings of the simulation, with seed and number of stars.
    templates : Path
        Product of the stage templates.
    out : Path
        HDF5 product with noise-free stars.
    """
    # A realisation has static and random aberrations, a template static ones only. Both are
    # framed on their own brightest pixel, moved by the same jitter and normalised by the flux
    # inside the stamp (eq. 8). With `framing.subpixel` the pixel grid of a realisation is
    # displaced by up to half a pixel from the template's. All random numbers are drawn first,
    # about 100 bytes per star; then images are made and written, `STARS_AT_A_TIME`.
    static = read_product(templates, "templates", ("psf", "grid"))
    belonging.require(templates, static.config, belonging.STATIC, config)
    # Field, centring error and sub-pixel phase of each star, each from a stream of its own.
    framing, name, count = config.framing, config.stars.name, config.stars.count
    star_field = assign_fields(count, len(static["psf"]), stream(config.seed, "field", name))
    jitter = draw_jitter(count, framing.jitter_px, stream(config.seed, "jitter", name))
    phase = np.zeros((count, 2))
    if framing.subpixel:
        phase = draw_phase(count, stream(config.seed, "phase", name))
    # All stars, each on a stamp of d × d pixels.
    shape = (count, framing.stamp_px, framing.stamp_px)
    columns: dict[str, Column | Empty] = {
        "template": Empty(shape, np.float32, "1", "static PSF, sum 1"),
        "field_index": Column(star_field, "1", "field of the star"),
        "grid": Column(static["grid"], "1", "grid index (ix, iy) of every field"),
        "jitter": Column(jitter, "pixel", "centring error (row, column)"),
    }
    # Fraction of the light that is inside the stamp, before it is normalised.
    energy = Empty((count,), np.float64, "1", "light inside the stamp")
    # Without random aberrations, realisations are the templates.
    propagation = None
    if config.stars.aberration_fraction > 0:
        limit_threads(1)  # batches run in parallel
        source = star_wavefronts(config, star_field)
        propagation = Propagation(
            source, config.telescope, config.optics, framing, config.stars.search_px
        )
        columns |= {
            "realisation": Empty(shape, np.float32, "1", "noise-free image, sum 1"),
            "energy": energy,
            "peak": Empty(
                (count, 2), np.int64, "pixel", "brightest pixel (row, column) from the chief ray"
            ),
            **aberration_columns(source),
            "pupil_samples": Column(propagation.samples, "1", "pupil samples N"),
        }
        if framing.subpixel:
            columns["phase"] = Column(phase, "pixel", "position of the pixel grid (row, column)")
    else:
        columns |= {"realisation": columns["template"], "energy": energy}
    with stream_product(out, "stars", columns, config.model_dump()) as data:
        for start in steps("stars", range(0, count, STARS_AT_A_TIME)):
            # Indices of the stars that are made together.
            part = np.arange(start, min(start + STARS_AT_A_TIME, count))
            # The static PSF of the field, cut with the centring error of the star.
            static_psfs = static["psf"][star_field[part]].astype(np.float64)
            jittered_psfs = crop_jittered(static_psfs, jitter[part], framing.jitter_px)
            arrays = dict(zip(("template", "energy"), normalise_flux(jittered_psfs), strict=True))
            # The star's own image; the light inside the stamp refers to the realisation.
            if propagation is not None:
                stamps, peak = propagation.frame(framing.stamp_px, jitter[part], part, phase[part])
                arrays["realisation"], arrays["energy"] = normalise_flux(stamps)
                arrays["peak"] = peak
            for column, values in arrays.items():
                data[column][start : start + STARS_AT_A_TIME] = values
