"""Stars of scene 1 that another package has simulated: POPPY, from the recipe alone.

Pupil, wavefront, propagation and pixels are POPPY's (Perrin et al. 2012, Proc. SPIE 8442);
of ours are only the random numbers and the rule that frames a star.
"""

import logging

import numpy as np

from psfdae.configuration.compose import ConfigError
from psfdae.rng import stream
from psfdae.stars.fields import assign_fields, draw_jitter, perturb, relative_field
from psfdae.stars.framing import brightest_pixel, crop_jittered, normalise_flux

SAMPLES = 256  # across the pupil
OVERSAMPLING = 4  # sub-samples per pixel and axis; their error falls with the square


def poppy_stars(config, count):
    """Noise-free stars of sum 1 with random aberrations, framed as those of the training.

    Shape (count, d, d), float64. The draws are new: other aberrations, fields and jitter than
    in training and test.
    """
    if config.scene.name != "seidel":
        raise ConfigError(f"scene {config.scene.name!r}: only 'seidel' is simulated with POPPY")

    def draws(name):
        return stream(config.seed, "poppy", name)

    framing, search_px = config.framing, config.stars.search_px
    field = relative_field(config.grid)
    field = field[assign_fields(count, len(field), draws("field"))]
    static = np.tile(config.wavefront.coefficients, (count, 1))
    seidel = perturb(static, config.stars.aberration_fraction, draws("aberration"))
    jitter = draw_jitter(count, framing.jitter_px, draws("jitter"))
    reach = search_px + framing.stamp_px // 2 + framing.jitter_px
    image_of = poppy_telescope(config.telescope, 2 * reach)
    images = (image_of(*star) for star in zip(seidel, field, strict=True))
    stamps = [framed(*star, framing, search_px) for star in zip(images, jitter, strict=True)]
    return normalise_flux(np.stack(stamps))[0]


def framed(image, jitter, framing, search_px):
    """Stamp (d, d) whose brightest pixel within ± `search_px` is at (d/2, d/2) + jitter."""
    edge = (image.shape[0] - 2 * search_px) // 2
    row, column = brightest_pixel(image[edge:-edge, edge:-edge], framing.tie)
    reach = framing.stamp_px // 2 + framing.jitter_px
    rows, columns = (slice(edge + p - reach, edge + p + reach) for p in (row, column))
    return crop_jittered(image[None, rows, columns], jitter[None], framing.jitter_px)[0]


def poppy_telescope(telescope, side_px):
    """Light on side × side pixels (even: the chief ray falls on a corner) as a function.

    Of Seidel coefficients in waves and a field point; aberrations as in Welford (1986), ch. 8.
    """
    import astropy.units as u
    import poppy

    logging.getLogger("poppy").setLevel(logging.ERROR)
    poppy.conf.double_precision = True
    radius_m, wavelength_m = 0.5 * telescope.diameter_m, telescope.wavelength_m

    class SeidelWavefront(poppy.AnalyticOpticalElement):  # type: ignore[misc]
        seidel, field = np.zeros(5), np.zeros(2)

        def get_opd(self, wave):
            y, x = (axis / radius_m for axis in self.get_coordinates(wave))
            rho2, height2 = x**2 + y**2, float(self.field @ self.field)
            along = self.field[0] * x + self.field[1] * y
            spherical, coma, astigmatism, curvature, distortion = self.seidel
            waves = spherical * rho2**2 + coma * rho2 * along + astigmatism * along**2
            waves += curvature * height2 * rho2 + distortion * height2 * along
            return waves * wavelength_m

        def get_transmission(self, wave):
            return np.ones(wave.shape)

    wavefront = SeidelWavefront(name="Seidel", planetype=poppy.poppy_core.PlaneType.pupil)
    radius = radius_m * u.m
    pupil = [poppy.CircularAperture(radius=radius), wavefront]
    if telescope.obscuration > 0:
        secondary = telescope.obscuration * radius
        pupil.insert(1, poppy.SecondaryObscuration(secondary_radius=secondary, n_supports=0))
    system = poppy.OpticalSystem(npix=SAMPLES, pupil_diameter=2 * radius, verbose=False)
    system.add_pupil(poppy.CompoundAnalyticOptic(pupil))
    scale = telescope.pixel_scale_arcsec
    system.add_detector(pixelscale=scale, fov_pixels=side_px, oversample=OVERSAMPLING)

    def image(seidel, field):
        wavefront.seidel, wavefront.field = seidel, field
        fine = system.calc_psf(wavelength=wavelength_m)[0].data
        # POPPY counts the phase the other way, which turns the image by 180 degrees.
        binned = fine[::-1, ::-1].reshape(side_px, OVERSAMPLING, side_px, OVERSAMPLING)
        return binned.sum(axis=(1, 3))

    return image
