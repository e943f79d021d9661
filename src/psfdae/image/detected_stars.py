"""`detect`: the stars of an image as a table."""

from __future__ import annotations

from typing import Unpack

import numpy as np

from psfdae.base.arguments import check_arguments
from psfdae.base.types import QTable
from psfdae.image.containers import ImageLike
from psfdae.image.image_input import ImageInput, PixelKeywords
from psfdae.image.opening import open_observation
from psfdae.image.tables import star_table


@check_arguments
def detect(image: ImageLike, threshold: float = 5.0, **options: Unpack[PixelKeywords]) -> QTable:
    """Find the stars of an image.

    Parameters
    ----------
    image : path-like, array, NDData, HDU or HDUList
        FITS image. Mask, uncertainty, unit, WCS and meta of CCDData and NDData are used.
    threshold : float
        Detection limit in σ above the sky.
    **options
        Options of the image, such as `mask`, `extension` or `gain`, named and explained in
        `psfdae.image.image_input.ImageOptions`.

    Returns
    -------
    QTable
        A row for each star: `id`, `x` and `y` (0-based pixels), `ra` and `dec` (ICRS, if the image
        has a WCS), `flux_iso` (light above the threshold) and `background` (sky per pixel). All
        calls that take a star list take it.

    Raises
    ------
    Error
        If the image or an option cannot be used, or no star is found.

    Examples
    --------
    >>> detected = psfdae.detect(image, gain=1.0)
    >>> len(detected), detected.colnames
    (36, ['id', 'x', 'y', 'flux_iso', 'background'])
    """
    return find_stars(ImageInput.build(image, {**options, "detect": threshold}))


def find_stars(source: ImageInput) -> QTable:
    """Return the table of `detect` for an image with its options, of which `detect` is set."""
    # Stamps are not needed here: the least side that an image may have.
    observation = open_observation(source, stamp_px=8)
    assert observation.detections is not None
    stars = observation.detections.table
    # SExtractor's X_IMAGE counts from 1.
    x, y = (np.asarray(stars[name]) - 1.0 for name in ("X_IMAGE", "Y_IMAGE"))
    columns = {"id": np.asarray(stars["id"]), "x": x, "y": y, **observation.sky_columns(x, y)}
    columns["flux_iso"] = np.asarray(stars["FLUX_ISO"])
    columns["background"] = np.asarray(stars["BACKGROUND"])
    return star_table(columns, observation.unit)
