"""From sky coordinates to pixels, and the pixel scale of a WCS."""

from __future__ import annotations

from typing import Any

import numpy as np

NEAR = 1.0
"""Stars farther off the image than this many image sizes are not corrected for distortion."""


def pixel_scale(wcs: Any) -> float:
    """Side in arcseconds of a square as large as a pixel at the reference point."""
    from astropy.wcs.utils import proj_plane_pixel_area

    return float(np.sqrt(proj_plane_pixel_area(wcs))) * 3600.0


def sky_to_pixel(
    wcs: Any, ra: np.ndarray, dec: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Positions of stars in an image from their ICRS coordinates.

    Distortions are inverted by iteration, and only for stars near the image: far
    from it their polynomials fold back, and a star degrees away would seem to be
    in the image (Shupe et al. 2005, ASP Conf. 347, 491 define them for the image).

    Parameters
    ----------
    wcs : astropy WCS, celestial
    ra, dec : ndarray, shape (n,)
        Degrees.
    shape : (rows, columns) of the image

    Returns
    -------
    x, y : ndarray, shape (n,)
        0-based pixel centres; NaN for stars that the projection cannot show.
    """
    from astropy.coordinates import SkyCoord
    from astropy.wcs import NoConvergence
    from astropy.wcs.utils import skycoord_to_pixel

    stars = SkyCoord(ra, dec, unit="deg")
    x, y = (np.array(v, dtype=np.float64) for v in skycoord_to_pixel(stars, wcs, mode="wcs"))
    rows, columns = shape
    near = (np.abs(x - columns / 2) < (0.5 + NEAR) * columns) & (
        np.abs(y - rows / 2) < (0.5 + NEAR) * rows
    )
    if wcs.has_distortion and near.any():
        try:
            x[near], y[near] = skycoord_to_pixel(stars[near], wcs, mode="all")
        except NoConvergence as error:
            solution = np.array(error.best_solution, dtype=np.float64)
            if error.divergent is not None:
                solution[error.divergent] = np.nan
            x[near], y[near] = solution.T
    return x, y
