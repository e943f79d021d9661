"""Bright stars of a telescope that a file describes, for a training without an image."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from psfdae.base.rng import stream
from psfdae.image.fits_file import write_temporary
from psfdae.image.image_input import ImageInput
from psfdae.image.stamps import cut
from psfdae.image.star_criteria import brightest_pixels
from psfdae.optics.pupil import SamplingError
from psfdae.sensing.stars import SensingError, StarOptics
from psfdae.telescope.field import build_terms
from psfdae.telescope.settings import OwnTelescope
from psfdae.training.settings import Settings

FIELD_POINTS = 50
"""Stars along a side of the field."""

SNR = 2000.0
"""S/N of the stars over the noise of the sky, far above the S/N to which they are degraded."""

SKY = 1000.0
"""Photons of the sky in a pixel."""

REACH_PX = 12
"""Largest distance of a star's brightest pixel from its chief ray."""


def simulate_stars(telescope: OwnTelescope, path: Path, settings: Settings) -> ImageInput:
    """Simulate bright stars all over the field of a telescope, with aberrations of its prior.

    Parameters
    ----------
    telescope : OwnTelescope
        Telescope with the prior of its aberrations.
    path : Path
        Its file, which messages name.
    settings : Settings
        Sizes of the stamps, and the seed.

    Returns
    -------
    ImageInput
        Cube of stamps of `FIELD_POINTS`² stars, and their pixels from a corner of the field.

    Raises
    ------
    SensingError
        If a wavefront needs a finer pupil grid than any.
    """
    from astropy.io import fits

    # One star in each cell of the field, in its middle half: neighbours are half a cell apart.
    rng, count = stream(settings.seed, "telescope stars"), FIELD_POINTS**2
    cell = np.stack(np.divmod(np.arange(count), FIELD_POINTS), axis=1)
    fraction = (cell + rng.uniform(0.25, 0.75, (count, 2))) / FIELD_POINTS
    angle_deg = (2.0 * fraction - 1.0) * telescope.field_edge_deg
    # Coefficients from the prior, and chief rays anywhere in their pixels.
    terms = build_terms(telescope, angle_deg)
    side = settings.framing.stamp_px + 2 * settings.calibration_stars.margin_px
    optics, star = StarOptics(telescope, terms, side + 2 * REACH_PX), np.arange(count)
    waves = optics.coefficients(star, rng.standard_normal(terms.mean.shape))
    place_px = rng.uniform(-0.5, 0.5, (count, 2))
    try:
        images = optics.operator.stamps(optics.mode_coefficients(star, waves, place_px))
    except SamplingError as error:
        raise SensingError(f"{path}: aberrations need a finer pupil grid ({error})") from error
    # The brightest pixel goes to the middle; photons of star and sky are Poisson distributed.
    images = cut(images, side, brightest_pixels(images, REACH_PX)[0]).astype(np.float64)
    flux = SNR * np.sqrt(SKY / (images**2).sum(axis=(1, 2)))
    counts = rng.poisson(flux[:, None, None] * images + SKY).astype(np.float32)
    # A file in memory has the name of the telescope's file.
    content = io.BytesIO()
    fits.PrimaryHDU(counts).writeto(content)
    content.seek(0)
    width_px = 2.0 * telescope.field_edge_deg * 3600.0 / telescope.pixel_scale_arcsec
    return ImageInput(
        write_temporary(path, content),
        catalogue=fraction * width_px,
        pixel_scale_arcsec=telescope.pixel_scale_arcsec,
        gain=1.0,
    )
