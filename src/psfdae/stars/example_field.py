"""A simulated exposure of a star field: an image to try the tools on, its truth known.

The optics are a slow telescope with Seidel aberrations that grow towards the edge
of the field; a Moffat profile (Moffat 1969, A&A 3, 455) stands for seeing and
guiding. Stars lie at random sub-pixel positions. The camera adds a sky with a
gradient, photon noise, read noise and its saturation level; a few stars saturate,
a few have a close companion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae.rng import stream

OVERSAMPLING = 3
"""Sub-pixels per pixel and axis; the seeing leaves nothing beyond their Nyquist frequency."""

RENDER_PX = 32
"""Side of the square into which a star is drawn, in pixels."""

MAX_SIGNAL = 65535
"""Largest number of a 16-bit camera."""

BATCH = 32
"""Stars that are propagated at a time."""


@dataclass(frozen=True)
class FieldRecipe:
    """What the exposure shows.

    Attributes
    ----------
    side_px : int
        Side of the image.
    bright, faint : int
        Stars of either kind. The bright ones follow a uniform distribution in
        log(signal to noise).
    saturated, blended : int
        Further bright stars: above the camera's limit, and with a companion of a
        third of their flux at 4 to 7 px.
    bright_snr, faint_snr : (float, float)
        Range of signal to noise, F / (σ √A), with A the noise-equivalent area of the
        PSF on the optical axis.
    seeing_px : float
        FWHM of the Moffat profile, exponent 3.
    pixel : float
        Pixel width in λ/D.
    seidel : tuple of float
        W040, W131, W222, W220, W311 in waves at the middle of an edge.
    sky_e, sky_slope : float
        Sky in electrons per pixel in the middle, and its relative rise from left to right.
    read_noise_e : float
        Electrons per pixel.
    gain : float
        Electrons per count.
    saturation : int
        Counts at which the camera clips.
    pixel_scale_arcsec : float
    """

    side_px: int = 1500
    bright: int = 300
    faint: int = 700
    saturated: int = 6
    blended: int = 20
    bright_snr: tuple[float, float] = (120.0, 3000.0)
    faint_snr: tuple[float, float] = (5.0, 100.0)
    seeing_px: float = 2.2
    pixel: float = 2.0
    seidel: tuple[float, ...] = (0.1, 1.6, 0.5, 0.5, 0.0)
    sky_e: float = 300.0
    sky_slope: float = 0.1
    read_noise_e: float = 6.0
    gain: float = 1.6
    saturation: int = 60000
    pixel_scale_arcsec: float = 1.2


@dataclass(frozen=True)
class ExampleField:
    """An exposure with its truth.

    Attributes
    ----------
    image : ndarray, shape (side, side), uint16
        Counts.
    position : ndarray, shape (n, 2)
        (x, y) of the chief ray of every star, 0-based pixel centres.
    centroid : ndarray, shape (n, 2)
        (x, y) of the centre of light, as a catalogue would have it.
    flux : ndarray, shape (n,)
        Electrons of every star.
    psf : ndarray, shape (n, RENDER_PX, RENDER_PX), float32
        Noise-free star, sum 1; its pixel [RENDER_PX/2, RENDER_PX/2] is the one
        nearest to the position. Companions are not in it.
    kind : ndarray of str, shape (n,)
        "bright", "faint", "saturated" or "blended".
    recipe : FieldRecipe
    """

    image: np.ndarray
    position: np.ndarray
    centroid: np.ndarray
    flux: np.ndarray
    psf: np.ndarray
    kind: np.ndarray
    recipe: FieldRecipe


def example_field(recipe: FieldRecipe, seed: int) -> ExampleField:
    """Simulate an exposure; the same recipe and seed give the same pixels."""
    rng = stream(seed, "example field")
    counts = (recipe.bright, recipe.faint, recipe.saturated, recipe.blended)
    kind = np.repeat(["bright", "faint", "saturated", "blended"], counts)
    margin = RENDER_PX / 2
    position = rng.uniform(margin, recipe.side_px - margin, size=(kind.size, 2))
    companion = _companions(position[kind == "blended"], rng)
    psf = star_images(recipe, np.concatenate([position, companion]))
    flux = _fluxes(recipe, kind, rng)
    light = np.concatenate([flux, flux[kind == "blended"] / 3.0])
    expected = _sky(recipe)
    _add_stars(expected, np.concatenate([position, companion]), light[:, None, None] * psf)
    electrons = rng.poisson(expected) + recipe.read_noise_e * rng.standard_normal(expected.shape)
    counted = np.clip(np.rint(electrons / recipe.gain), 0, min(recipe.saturation, MAX_SIGNAL))
    image, psf = counted.astype(np.uint16), psf[: kind.size]
    return ExampleField(image, position, _centroids(position, psf), flux, psf, kind, recipe)


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
    propagate = StampPropagator(pupil, fine, recipe.pixel / OVERSAMPLING, 2, "complex64")
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


def noise_area(psf: np.ndarray) -> float:
    """Noise-equivalent area 1/Σp² of a PSF of sum 1, in pixels (King 1983, PASP 95, 163)."""
    return float(1.0 / (psf.astype(np.float64) ** 2).sum())


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
    return rows[:, :, None] * columns[:, None, :]


def _fluxes(recipe: FieldRecipe, kind: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Flux of every star in electrons."""
    middle = np.full((1, 2), recipe.side_px / 2.0)
    axis_psf = star_images(recipe, middle)[0]
    noise = np.sqrt((recipe.sky_e + recipe.read_noise_e**2) * noise_area(axis_psf))
    draw = rng.uniform(size=kind.size)
    low, high = np.where(
        (kind == "faint")[None, :],
        np.array(recipe.faint_snr)[:, None],
        np.array(recipe.bright_snr)[:, None],
    )
    flux = noise * low * (high / low) ** draw
    # Twice to four times what fills the brightest pixel.
    full = recipe.saturation * recipe.gain / axis_psf.max()
    return np.where(kind == "saturated", full * (2.0 + 2.0 * draw), flux)


def _companions(position: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Positions 4 to 7 px away."""
    distance = rng.uniform(4.0, 7.0, size=len(position))
    angle = rng.uniform(0.0, 2.0 * np.pi, size=len(position))
    return position + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _sky(recipe: FieldRecipe) -> np.ndarray:
    ramp = np.linspace(-0.5, 0.5, recipe.side_px)
    return recipe.sky_e * np.broadcast_to(1.0 + recipe.sky_slope * ramp, (ramp.size,) * 2).copy()


def _centroids(position: np.ndarray, psf: np.ndarray) -> np.ndarray:
    axis = np.arange(RENDER_PX) - RENDER_PX // 2
    columns, rows = psf.sum(axis=1) @ axis, psf.sum(axis=2) @ axis
    return np.rint(position) + np.stack([columns, rows], axis=1)


def _add_stars(image: np.ndarray, position: np.ndarray, light: np.ndarray) -> None:
    """Add stamps at their nearest pixels, what is outside is cut off."""
    half, side = RENDER_PX // 2, len(image)
    padded = np.zeros((side + 2 * half, side + 2 * half))
    for (column, row), star in zip(np.rint(position).astype(int), light, strict=True):
        padded[row : row + RENDER_PX, column : column + RENDER_PX] += star
    image += padded[half : half + side, half : half + side]
