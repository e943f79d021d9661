"""A simulated exposure of a star field with its truth, and small image files with catalogues.

The optics are a slow telescope with Seidel aberrations that grow towards the edge
of the field; a Moffat profile (Moffat 1969, A&A 3, 455) stands for seeing and
guiding. Stars lie at random sub-pixel positions. The camera adds a sky with a
gradient, photon noise, read noise and its saturation level; a few stars saturate,
a few have a close companion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psfdae.base.files import atomic_path, write_fits
from psfdae.base.rng import stream
from psfdae.base.types import WCS
from psfdae.image.stamps import central_pixel
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import MONOMIALS, seidel_wavefronts
from psfdae.stars.noise import noise_equivalent_px


@dataclass(frozen=True)
class FieldRecipe:
    """Telescope, camera, sky and stars of a simulated exposure."""

    side_px: int = 1500
    bright: int = 300  # stars, uniform in the logarithm of their signal to noise
    faint: int = 700
    saturated: int = 6  # further bright stars, above the camera's limit
    blended: int = 20  # further ones with a companion of a third of their flux at 4 to 7 px
    # Range of F / (σ √A), with A the noise-equivalent area of the PSF on the optical axis.
    bright_snr: tuple[float, float] = (120.0, 3000.0)
    faint_snr: tuple[float, float] = (5.0, 100.0)
    seeing_px: float = 2.2  # FWHM of the Moffat profile, exponent 3
    pixel: float = 2.0  # width in λ/D
    # W040, W131, W222, W220, W311 in waves at the middle of an edge.
    seidel: tuple[float, ...] = (0.1, 1.6, 0.5, 0.5, 0.0)
    defocus_waves: float = 0.0  # W020 ρ² over the whole field
    sky_e: float = 300.0  # electrons per pixel in the middle
    sky_slope: float = 0.1  # relative rise from left to right
    read_noise_e: float = 6.0  # electrons per pixel
    gain: float = 1.6  # electrons per count
    saturation: int = 60000  # counts at which the camera clips
    pixel_scale_arcsec: float = 1.2
    stamp_px: int = 32  # side of the square into which a star is drawn


@dataclass(frozen=True)
class ExampleField:
    """A simulated exposure with the true position, flux and PSF of its n stars."""

    image: np.ndarray  # counts, uint16
    position: np.ndarray  # (n, 2), x, y of the chief ray, 0-based pixel centres
    centroid: np.ndarray  # (n, 2), x, y of the centre of light, as a catalogue would have it
    flux: np.ndarray  # (n,), electrons
    psf: np.ndarray  # as of `star_images`, without companions
    kind: np.ndarray  # "bright", "faint", "saturated" or "blended"


def example_field(recipe: FieldRecipe, seed: int) -> ExampleField:
    """Simulate an exposure; the same recipe and seed give the same pixels."""
    # Stars anywhere in the image, but not so near to its edge that their stamps leave it.
    rng = stream(seed, "example field")
    counts = (recipe.bright, recipe.faint, recipe.saturated, recipe.blended)
    kind = np.repeat(["bright", "faint", "saturated", "blended"], counts)
    margin = recipe.stamp_px / 2
    position = rng.uniform(margin, recipe.side_px - margin, size=(kind.size, 2))
    # A companion of each blended star, 4 to 7 px from it, in a random direction.
    distance = rng.uniform(4.0, 7.0, size=recipe.blended)
    angle = rng.uniform(0.0, 2.0 * np.pi, size=recipe.blended)
    separation = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    source_position = np.concatenate([position, position[kind == "blended"] + separation])
    psf = star_images(recipe, source_position)
    # Noise of the flux of a faint star on the axis: σ √A, A the noise-equivalent area.
    axis_psf = star_images(recipe, np.full((1, 2), recipe.side_px / 2.0))[0]
    flux_noise = np.sqrt((recipe.sky_e + recipe.read_noise_e**2) * noise_equivalent_px(axis_psf))
    # Signal to noise uniform in its logarithm between two limits.
    draw = rng.uniform(size=kind.size)
    is_faint = (kind == "faint")[:, None]
    lowest_snr, highest_snr = np.where(is_faint, recipe.faint_snr, recipe.bright_snr).T
    unsaturated_flux = flux_noise * lowest_snr * (highest_snr / lowest_snr) ** draw
    # Saturated stars: two to four times the flux that fills the brightest pixel.
    saturating_flux = recipe.saturation * recipe.gain / axis_psf.max()
    saturated_flux = saturating_flux * (2.0 + 2.0 * draw)
    flux = np.where(kind == "saturated", saturated_flux, unsaturated_flux)
    # Light of all stars in electrons; companions have a third of the flux.
    starlight = np.zeros((recipe.side_px,) * 2)
    source_flux = np.concatenate([flux, flux[kind == "blended"] / 3.0])
    add_stamps(starlight, source_flux[:, None, None] * psf, *source_position.T)
    image = expose(recipe, starlight, rng)
    # Centres of light from the first moments of the noise-free stamps, whose sum is 1.
    psf = psf[: kind.size]
    axis = np.arange(recipe.stamp_px) - recipe.stamp_px // 2
    centre_in_stamp = np.stack([psf.sum(axis=1) @ axis, psf.sum(axis=2) @ axis], axis=1)
    centroid = np.rint(position) + centre_in_stamp
    return ExampleField(image, position, centroid, flux, psf, kind)


def expose(recipe: FieldRecipe, starlight: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the counts (h, w), uint16, that the camera reads of light (h, w) in electrons."""
    # Camera: a sky that rises from left to right, photon noise, read noise, whole counts, and
    # clipping at the saturation level or the largest number of 16 bits.
    ramp = 1.0 + recipe.sky_slope * np.linspace(-0.5, 0.5, starlight.shape[1])
    expected_e = recipe.sky_e * np.broadcast_to(ramp, starlight.shape) + starlight
    photo_electrons = rng.poisson(expected_e)
    electrons = photo_electrons + recipe.read_noise_e * rng.standard_normal(expected_e.shape)
    counts = np.clip(np.rint(electrons / recipe.gain), 0, min(recipe.saturation, 65535))
    return np.asarray(counts, np.uint16)


def star_images(recipe: FieldRecipe, position: np.ndarray) -> np.ndarray:
    """Return noise-free images of stars at positions of the field.

    Parameters
    ----------
    recipe : FieldRecipe
        Optics, seeing, pixel scale and size of the stamps.
    position : ndarray, shape (n, 2)
        (x, y) in pixels.

    Returns
    -------
    ndarray, shape (n, d, d), float32
        Sum 1, d = `recipe.stamp_px`; the pixel nearest to the position has the index d/2.
    """
    # Optics on a grid of 3 × 3 sub-pixels, beyond whose Nyquist frequency seeing leaves nothing.
    oversampling, side = 3, recipe.stamp_px
    fine = oversampling * side
    field = position / (0.5 * recipe.side_px) - 1.0  # −1 … 1 along either axis
    source = seidel_wavefronts(np.tile(recipe.seidel, (len(field), 1)), field)
    source.coefficients[:, [MONOMIALS.index("xx"), MONOMIALS.index("yy")]] += recipe.defocus_waves
    pupil = annular_pupil(128, 0.35)
    propagate = StampPropagator(pupil, fine, recipe.pixel / oversampling, precision="complex64")
    # Seeing: a Moffat profile (1 + r²/α²)^(−3) of sum 1, which falls to 1/2 at
    # r = α √(2^(1/3) − 1) = FWHM/2.
    core_radius = 0.5 * recipe.seeing_px * oversampling / np.sqrt(2.0 ** (1.0 / 3.0) - 1.0)
    axis = np.fft.fftfreq(fine, 1.0 / fine)
    profile = (1.0 + (axis[:, None] ** 2 + axis**2) / core_radius**2) ** -3.0
    blur = np.fft.rfft2(profile / profile.sum()).real
    # The chief ray is at the corner between the two middle sub-pixels of the fine image.
    shift = position - np.rint(position) + 0.5
    stamps = np.empty((len(field), side, side), np.float32)
    for start in range(0, len(field), 32):
        part = np.arange(start, min(start + 32, len(field)))
        sharp = propagate(source.opd(part, pupil, propagate.real_dtype))
        # Seeing and sub-pixel position are factors of the Fourier transform: a shift by (x, y)
        # multiplies it by exp(−2πi f_y y) exp(−2πi f_x x).
        subpixels = shift[part] * oversampling
        rows = np.exp(-2j * np.pi * np.fft.fftfreq(fine) * subpixels[:, 1, None])
        columns = np.exp(-2j * np.pi * np.fft.rfftfreq(fine) * subpixels[:, 0, None])
        phase = rows[:, :, None] * columns[:, None, :]
        blurred_stamps = np.fft.irfft2(np.fft.rfft2(sharp) * blur * phase, s=(fine, fine))
        # Sum of the sub-pixels of each pixel, without ripples below 0, of flux 1.
        sub_pixels = blurred_stamps.reshape(len(part), side, oversampling, side, oversampling)
        pixels = np.clip(sub_pixels.sum(axis=(2, 4)), 0.0, None)
        stamps[part] = pixels / pixels.sum(axis=(1, 2), keepdims=True)
    return stamps


def add_stamps(image: np.ndarray, stamps: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Add stamps (n, d, d) to an image, in place, without pixels that are off the image.

    The stamp's pixel (d/2, d/2) is added to the pixel nearest to the 0-based position.
    """
    side = stamps.shape[-1]
    rows = central_pixel(y)[:, None, None] - side // 2 + np.arange(side)[:, None]
    columns = central_pixel(x)[:, None, None] - side // 2 + np.arange(side)
    rows, columns = np.broadcast_arrays(rows, columns)
    # `add.at` adds each stamp where several overlap; indexed assignment would keep the last one.
    inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
    np.add.at(image, (rows[inside], columns[inside]), stamps[inside])


def tangent_plane(
    shape: tuple[int, ...], pixel_scale_arcsec: float, centre_deg: tuple[float, float] = (150, 2)
) -> WCS:
    """Return the WCS of an image (h, w), north up, about (RA, Dec) in its middle."""
    from astropy.wcs import WCS

    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = centre_deg
    wcs.wcs.crpix = [(shape[1] + 1) / 2, (shape[0] + 1) / 2]
    wcs.wcs.cdelt = [-pixel_scale_arcsec / 3600.0, pixel_scale_arcsec / 3600.0]
    return wcs


def write_cube(path: Path, stamps: np.ndarray, **cards: str | float) -> None:
    """Write an array, such as stamps, as a FITS image, float64 as float32, with header cards."""
    from astropy.io import fits

    stamps = stamps.astype(np.float32) if stamps.dtype == np.float64 else stamps
    write_fits(path, fits.HDUList([fits.PrimaryHDU(stamps, fits.Header(list(cards.items())))]))


def write_field(
    path: Path,
    catalogue: Path,
    image: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    pixel_scale_arcsec: float = 1.0,
    columns: Mapping[str, np.ndarray] | None = None,
    **cards: str | float,
) -> None:
    """Write an image with header cards, float64 as float32, and a CSV catalogue of its stars.

    The image has a tangential WCS with north up, about RA 150°, Dec 2°.

    Parameters
    ----------
    path, catalogue : Path
        Files to write: the image, and its list with the columns id, X_IMAGE, Y_IMAGE (1-based, as
        in SExtractor), ra and dec (degrees).
    image : ndarray, shape (h, w)
        Counts.
    x, y : ndarray, shape (n,)
        0-based positions of the stars.
    pixel_scale_arcsec : float
        Width of a pixel on the sky.
    columns : mapping of str to ndarray, shape (n,), optional
        Further columns of the list, by name.
    **cards
        Header cards, such as `GAIN=1.6`.
    """
    from astropy.table import Table

    wcs = tangent_plane(image.shape, pixel_scale_arcsec)
    # A card of the caller replaces one of the coordinates.
    write_cube(path, image, **{**wcs.to_header(), **cards})
    ra, dec = wcs.all_pix2world(x, y, 0)
    rows = {"id": np.arange(len(x)), "X_IMAGE": x + 1, "Y_IMAGE": y + 1, "ra": ra, "dec": dec}
    rows |= columns or {}
    with atomic_path(catalogue) as temporary:
        formats = {"X_IMAGE": "%.4f", "Y_IMAGE": "%.4f", "ra": "%.8f", "dec": "%.8f"}
        Table(rows).write(temporary, format="ascii.csv", formats=formats, overwrite=True)
