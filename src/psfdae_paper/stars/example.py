"""A simulated exposure of a star field, its truth known, and small files to try things on.

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

from psfdae.files import atomic_path, write_fits
from psfdae.image.observation import central_pixel
from psfdae.noise import noise_equivalent_px
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae.rng import stream

OVERSAMPLING = 3  # sub-pixels per axis; seeing leaves nothing beyond their Nyquist frequency
RENDER_PX = 32  # side of the square into which a star is drawn
MAX_SIGNAL = 65535  # largest number of a 16-bit camera
BATCH = 32  # stars that are propagated at a time


@dataclass(frozen=True)
class FieldRecipe:
    """What the exposure shows."""

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
    sky_e: float = 300.0  # electrons per pixel in the middle
    sky_slope: float = 0.1  # relative rise from left to right
    read_noise_e: float = 6.0  # electrons per pixel
    gain: float = 1.6  # electrons per count
    saturation: int = 60000  # counts at which the camera clips
    pixel_scale_arcsec: float = 1.2


@dataclass(frozen=True)
class ExampleField:
    """An exposure with its truth."""

    image: np.ndarray  # counts, uint16
    position: np.ndarray  # (n, 2), x, y of the chief ray, 0-based pixel centres
    centroid: np.ndarray  # (n, 2), x, y of the centre of light, as a catalogue would have it
    flux: np.ndarray  # (n,), electrons
    psf: np.ndarray  # as of `star_images`, without companions
    kind: np.ndarray  # "bright", "faint", "saturated" or "blended"


def example_field(recipe: FieldRecipe, seed: int) -> ExampleField:
    """Simulate an exposure; the same recipe and seed give the same pixels."""
    rng = stream(seed, "example field")
    counts = (recipe.bright, recipe.faint, recipe.saturated, recipe.blended)
    kind = np.repeat(["bright", "faint", "saturated", "blended"], counts)
    margin = RENDER_PX / 2
    position = rng.uniform(margin, recipe.side_px - margin, size=(kind.size, 2))
    # Companions are 4 to 7 px away.
    distance = rng.uniform(4.0, 7.0, size=recipe.blended)
    angle = rng.uniform(0.0, 2.0 * np.pi, size=recipe.blended)
    away = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    everyone = np.concatenate([position, position[kind == "blended"] + away])
    psf = star_images(recipe, everyone)
    flux = _fluxes(recipe, kind, rng)
    light = np.zeros((recipe.side_px,) * 2)
    each = np.concatenate([flux, flux[kind == "blended"] / 3.0])
    add_stamps(light, each[:, None, None] * psf, *everyone.T)
    ramp = 1.0 + recipe.sky_slope * np.linspace(-0.5, 0.5, recipe.side_px)
    expected = recipe.sky_e * np.broadcast_to(ramp, light.shape) + light
    electrons = rng.poisson(expected) + recipe.read_noise_e * rng.standard_normal(expected.shape)
    counted = np.clip(np.rint(electrons / recipe.gain), 0, min(recipe.saturation, MAX_SIGNAL))
    psf = psf[: kind.size]
    axis = np.arange(RENDER_PX) - RENDER_PX // 2
    centre = np.stack([psf.sum(axis=1) @ axis, psf.sum(axis=2) @ axis], axis=1)
    centroid = np.rint(position) + centre
    return ExampleField(counted.astype(np.uint16), position, centroid, flux, psf, kind)


def star_images(recipe: FieldRecipe, position: np.ndarray) -> np.ndarray:
    """Noise-free images of stars at positions of the field.

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        (x, y) in pixels.

    Returns
    -------
    ndarray, shape (n, RENDER_PX, RENDER_PX), float32
        Sum 1; the pixel nearest to the position has the index RENDER_PX/2.
    """
    fine = OVERSAMPLING * RENDER_PX
    field = position / (0.5 * recipe.side_px) - 1.0
    source = seidel_wavefronts(np.tile(recipe.seidel, (len(field), 1)), field)
    pupil = annular_pupil(128, 0.35)
    propagate = StampPropagator(pupil, fine, recipe.pixel / OVERSAMPLING, precision="complex64")
    blur = _moffat_transfer(recipe.seeing_px * OVERSAMPLING, fine)
    # The chief ray is at the corner between the two middle sub-pixels of the fine image.
    shift = position - np.rint(position) + 0.5
    out = np.empty((len(field), RENDER_PX, RENDER_PX), np.float32)
    for start in range(0, len(field), BATCH):
        part = np.arange(start, min(start + BATCH, len(field)))
        sharp = propagate(source.opd(part, pupil, propagate.real_dtype))
        phase = _shift_transfer(shift[part] * OVERSAMPLING, fine)
        blurred = np.fft.irfft2(np.fft.rfft2(sharp) * blur * phase, s=(fine, fine))
        binned = blurred.reshape(len(part), RENDER_PX, OVERSAMPLING, RENDER_PX, OVERSAMPLING)
        pixels = np.clip(binned.sum(axis=(2, 4)), 0.0, None)
        out[part] = pixels / pixels.sum(axis=(1, 2), keepdims=True)
    return out


def _moffat_transfer(fwhm: float, side: int) -> np.ndarray:
    """Fourier transform of a centred Moffat profile of exponent 3, sum 1."""
    core = 0.5 * fwhm / np.sqrt(2.0 ** (1.0 / 3.0) - 1.0)
    axis = np.fft.fftfreq(side, 1.0 / side)
    profile = (1.0 + (axis[:, None] ** 2 + axis**2) / core**2) ** -3.0
    return np.fft.rfft2(profile / profile.sum()).real


def _shift_transfer(shift: np.ndarray, side: int) -> np.ndarray:
    """Factors that move images by (x, y) pixels, shape (n, side, side//2 + 1)."""
    rows = np.exp(-2j * np.pi * np.fft.fftfreq(side) * shift[:, 1, None])
    columns = np.exp(-2j * np.pi * np.fft.rfftfreq(side) * shift[:, 0, None])
    factors: np.ndarray = rows[:, :, None] * columns[:, None, :]
    return factors


def _fluxes(recipe: FieldRecipe, kind: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Flux of every star in electrons."""
    axis_psf = star_images(recipe, np.full((1, 2), recipe.side_px / 2.0))[0]
    noise = np.sqrt((recipe.sky_e + recipe.read_noise_e**2) * noise_equivalent_px(axis_psf))
    draw = rng.uniform(size=kind.size)
    faint = (kind == "faint")[:, None]
    low, high = np.where(faint, recipe.faint_snr, recipe.bright_snr).T
    flux = noise * low * (high / low) ** draw
    # Twice to four times what fills the brightest pixel.
    full = recipe.saturation * recipe.gain / axis_psf.max()
    fluxes: np.ndarray = np.where(kind == "saturated", full * (2.0 + 2.0 * draw), flux)
    return fluxes


def add_stamps(image: np.ndarray, stamps: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Add stamps (n, d, d) to an image, in place; what is off the image is lost.

    The stamp's pixel (d/2, d/2) goes to the pixel nearest to the 0-based position.
    """
    d = stamps.shape[-1]
    rows = central_pixel(y)[:, None, None] - d // 2 + np.arange(d)[:, None]
    columns = central_pixel(x)[:, None, None] - d // 2 + np.arange(d)
    rows, columns = np.broadcast_arrays(rows, columns)
    inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
    np.add.at(image, (rows[inside], columns[inside]), stamps[inside])


# Files.


def write_cube(path: Path, stamps: np.ndarray, **cards: str | float) -> None:
    """Write an array, such as stamps, as a FITS image, float64 as float32, with header cards."""
    _write_image(path, stamps, cards)


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

    The image has a tangential WCS with north up; the catalogue has the columns id,
    X_IMAGE, Y_IMAGE (1-based, as in SExtractor) and ra, dec (degrees), and `columns` besides.
    `x`, `y` are 0-based.
    """
    from astropy.table import Table
    from astropy.wcs import WCS

    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = (150.0, 2.0)
    wcs.wcs.crpix = [(image.shape[1] + 1) / 2, (image.shape[0] + 1) / 2]
    wcs.wcs.cdelt = [-pixel_scale_arcsec / 3600.0, pixel_scale_arcsec / 3600.0]
    _write_image(path, image, {**wcs.to_header(), **cards})
    ra, dec = wcs.all_pix2world(x, y, 0)
    rows = {"id": np.arange(len(x)), "X_IMAGE": x + 1, "Y_IMAGE": y + 1, "ra": ra, "dec": dec}
    rows |= columns or {}
    with atomic_path(catalogue) as temporary:
        formats = {"X_IMAGE": "%.4f", "Y_IMAGE": "%.4f", "ra": "%.8f", "dec": "%.8f"}
        Table(rows).write(temporary, format="ascii.csv", formats=formats, overwrite=True)


def _write_image(path: Path, pixels: np.ndarray, cards: Mapping[str, object]) -> None:
    from astropy.io import fits

    pixels = pixels.astype(np.float32) if pixels.dtype == np.float64 else pixels
    write_fits(path, fits.HDUList([fits.PrimaryHDU(pixels, fits.Header(list(cards.items())))]))
