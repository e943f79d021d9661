"""Choice of the training stars of images: bright, isolated, and like a PSF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from psfdae.image.image import Image
from psfdae.image.image_input import ImageInput
from psfdae.image.observation import Observation
from psfdae.image.opening import open_observation
from psfdae.image.selection import Verdict
from psfdae.image.stamp_cube import StampCube
from psfdae.training.neighbours import subtract_neighbours
from psfdae.training.settings import Settings
from psfdae.training.star_choice import (
    ENOUGH_STARS,
    MIN_STARS_WITH_ERROR,
    choose_bright_stars,
    few_stars_notes,
    require_one_camera,
    require_unique_names,
)
from psfdae.training.star_residuals import reject_misfits
from psfdae.training.stars import ImageStars, join_stars, select_stars


def collect_stars(sources: Sequence[ImageInput], settings: Settings) -> ImageStars:
    """Choose the bright stars of images, and make training data of them.

    Parameters
    ----------
    sources : sequence of ImageInput
        Images of one camera. A single image must have enough stars itself; of several, all
        together must.
    settings : Settings
        Limits on the stars, stamps and parts.

    Raises
    ------
    Error
        If an image or its list cannot be used, or too few stars are bright enough.
    """
    require_unique_names(sources)
    calibration = settings.calibration_stars
    observations: Sequence[Observation] = [
        open_observation(source, settings.framing.stamp_px, calibration.margin_px).assume_scale()
        for source in sources
    ]
    for observation in observations:
        if isinstance(observation, StampCube):
            observation.check_planes()
    require_one_camera(observations)
    observations, candidates, relaxed_settings, notes = choose_bright_stars(observations, settings)
    # Bright stars of each image; in a crowded image again without their neighbours.
    exposures = []
    for source, observation, image_candidates in zip(
        sources, observations, candidates, strict=True
    ):
        candidates_like_psf = reject_misfits(image_candidates, relaxed_settings, observation.gain)
        # Of several images, one may have few stars or none.
        if len(sources) == 1:
            stars_min = relaxed_settings.calibration_stars.stars_min
            candidates_like_psf.require(observation.path, stars_min, observation.remarks)
        stars = select_stars(source, observation, candidates_like_psf, relaxed_settings)
        if is_crowded(stars):
            stars = subtract_neighbours(stars, calibration.neighbour_ratio)
        exposures.append(stars)
    stars = exposures[0] if len(exposures) == 1 else join_stars(exposures)
    few_notes = few_stars_notes(stars.candidates.bright.row, stars.held_out)
    return replace(stars, notes=(*stars.notes, *notes, *few_notes))


def is_crowded(stars: ImageStars) -> bool:
    """Return True if so many bright stars have neighbours that it pays to subtract these.

    Parameters
    ----------
    stars : ImageStars
        Stars of one image.
    """
    # Neighbours can only be fitted in an image with known positions, not in a cube of stamps.
    is_image = isinstance(stars.observation, Image)
    if not is_image or not np.isfinite(stars.candidates.bright.position).all():
        return False
    # With fewer than 5 stars, a field cannot be fitted; if fewer stars have neighbours than not,
    # the stars without are enough.
    crowded_count = np.count_nonzero(stars.candidates.verdict == Verdict.CROWDED)
    enough = max(len(stars), ENOUGH_STARS)
    return len(stars) >= MIN_STARS_WITH_ERROR and bool(crowded_count >= enough)
