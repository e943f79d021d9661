"""Stars of scene 1 that another package has simulated: POPPY, from the recipe alone.

Pupil, wavefront, propagation and pixels are POPPY's (Perrin et al. 2012, Proc. SPIE
8442); of ours are only the random numbers and the rule that frames a star.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from psfdae.rng import stream
from psfdae.stars.fields import assign_fields, draw_jitter, perturb, relative_field
from psfdae.stars.framing import brightest_pixel, crop_jittered, normalise_flux

SAMPLES = 256
"""Pupil samples across the diameter."""

OVERSAMPLING = 4
"""Sub-samples per pixel and axis; their error falls with the square."""


class PoppyError(RuntimeError):
    """POPPY is missing, or the scene is not one that it can be given here."""


def poppy_stars(config: Any, count: int) -> np.ndarray:
    """Noise-free stars with random aberrations, framed as those of the training.

    The draws are new: other aberrations, fields and jitter than in training and test.

    Parameters
    ----------
    config : stage config (seed, scene, telescope, grid, wavefront, stars, framing)
    count : int

    Returns
    -------
    ndarray, shape (count, d, d), float64
        Of flux 1.

    Raises
    ------
    PoppyError
        If POPPY is not installed, or the scene is not that of the Seidel terms.
    """
    if config.scene.name != "seidel":
        raise PoppyError(f"scene {config.scene.name!r}: only 'seidel' is simulated with POPPY")
    framing = config.framing
    field = relative_field(config.grid)
    field = field[assign_fields(count, len(field), stream(config.seed, "poppy", "field"))]
    seidel = perturb(
        np.tile(config.wavefront.coefficients, (count, 1)),
        config.stars.aberration_fraction,
        stream(config.seed, "poppy", "aberration"),
    )
    jitter = draw_jitter(count, framing.jitter_px, stream(config.seed, "poppy", "jitter"))
    reach = config.stars.search_px + framing.stamp_px // 2 + framing.jitter_px
    telescope = _Telescope(config.telescope, 2 * reach)
    out = np.empty((count, framing.stamp_px, framing.stamp_px))
    for star in range(count):
        image = telescope.image(seidel[star], field[star])
        out[star] = _framed(image, jitter[star], framing, config.stars.search_px)
    return normalise_flux(out)[0]


def _framed(image: np.ndarray, jitter: np.ndarray, framing: Any, search_px: int) -> np.ndarray:
    """Stamp (d, d) whose brightest pixel within ± `search_px` is at (d/2, d/2) + jitter."""
    edge = (image.shape[0] - 2 * search_px) // 2
    row, column = brightest_pixel(image[edge:-edge, edge:-edge], framing.tie)
    margin, half = framing.jitter_px, framing.stamp_px // 2
    rows = slice(edge + row - half - margin, edge + row + half + margin)
    columns = slice(edge + column - half - margin, edge + column + half + margin)
    return crop_jittered(image[None, rows, columns], jitter[None], margin)[0]


class _Telescope:
    """POPPY's optical system of a telescope with Seidel aberrations.

    Parameters
    ----------
    telescope : config group
    side_px : int
        Side of the images, even: the chief ray falls on a pixel corner.
    """

    def __init__(self, telescope: Any, side_px: int) -> None:
        poppy = _import_poppy()
        import astropy.units as u

        radius = 0.5 * telescope.diameter_m * u.m
        self._wavelength_m = telescope.wavelength_m
        self._side_px = side_px
        self._wavefront = _seidel_element(poppy)(telescope.diameter_m, telescope.wavelength_m)
        pupil = [poppy.CircularAperture(radius=radius), self._wavefront]
        if telescope.obscuration > 0:
            secondary = telescope.obscuration * radius
            pupil.insert(1, poppy.SecondaryObscuration(secondary_radius=secondary, n_supports=0))
        self._system = poppy.OpticalSystem(npix=SAMPLES, pupil_diameter=2 * radius, verbose=False)
        self._system.add_pupil(poppy.CompoundAnalyticOptic(pupil))
        self._system.add_detector(
            pixelscale=telescope.pixel_scale_arcsec, fov_pixels=side_px, oversample=OVERSAMPLING
        )

    def image(self, seidel: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Light on every pixel, shape (side, side), of coefficients in waves at a field point."""
        self._wavefront.seidel, self._wavefront.field = seidel, field
        fine = self._system.calc_psf(wavelength=self._wavelength_m)[0].data
        # POPPY counts the phase the other way, which turns the image by 180 degrees.
        binned = fine[::-1, ::-1].reshape(self._side_px, OVERSAMPLING, self._side_px, OVERSAMPLING)
        return binned.sum(axis=(1, 3))


def _seidel_element(poppy: Any) -> Any:
    """Class of an optical element with third-order aberrations (Welford 1986, chapter 8)."""

    class SeidelWavefront(poppy.AnalyticOpticalElement):  # type: ignore[misc]
        def __init__(self, diameter_m: float, wavelength_m: float) -> None:
            super().__init__(name="Seidel", planetype=poppy.poppy_core.PlaneType.pupil)
            self.radius_m, self.wavelength_m = 0.5 * diameter_m, wavelength_m
            self.seidel, self.field = np.zeros(5), np.zeros(2)

        def get_opd(self, wave: Any) -> np.ndarray:
            y, x = self.get_coordinates(wave)
            x, y = x / self.radius_m, y / self.radius_m
            rho2, height2 = x**2 + y**2, float(self.field @ self.field)
            along = self.field[0] * x + self.field[1] * y
            spherical, coma, astigmatism, curvature, distortion = self.seidel
            waves = spherical * rho2**2 + coma * rho2 * along + astigmatism * along**2
            waves += curvature * height2 * rho2 + distortion * height2 * along
            return waves * self.wavelength_m

        def get_transmission(self, wave: Any) -> np.ndarray:
            return np.ones(wave.shape)

    return SeidelWavefront


def _import_poppy() -> Any:
    import logging

    try:
        import poppy
    except ImportError as error:
        raise PoppyError(f"{error}: the extra 'dev' holds it") from error
    logging.getLogger("poppy").setLevel(logging.ERROR)
    poppy.conf.double_precision = True
    return poppy
