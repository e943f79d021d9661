"""Fraunhofer propagation from a pupil to the pixels of a stamp.

The field at the image angle u (in λ/D) of a pupil with amplitude transmission A(x)
and OPD W(x) in waves, x in pupil radii, is

    E(u) = Σ A(x) exp(2πi W(x)) exp(−πi u·x),

two matrix products per stamp (a matrix DFT, Soummer et al. 2007, Opt. Express
15, 15935). Only the necessary points are computed, without a padded grid. The pupil is
the same at +y and −y, and the points are symmetric about the chief ray. With s and t the
even and odd part of the phase 2πW over y, the rows of the pupil at +y and −y together are

    2 A exp(is) cos(t − πu_y y) = 2 A exp(is) (cos t cos πu_y y + sin t sin πu_y y),

so that half of the pupil and of the points is enough, and all products are real.

The spectrum of an intensity is limited by the largest distance of two points of
the pupil. Two points per λ/D and a few more therefore determine the intensity on
the whole stamp, and the light on every pixel. A quadrature in each pixel would
need far more points.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol

import numpy as np

from psfdae.base.threads import run_parallel
from psfdae.base.types import Tensor
from psfdae.optics.pupil import Pupil

Backend = Literal["numpy", "torch"]
Precision = Literal["complex64", "complex128"]

EXTRA_POINTS = 6
"""Points in addition to two per λ/D; they integrate a wave to 5e-4 of a pixel's width."""


def real_dtype(precision: Precision) -> np.dtype:
    """Return float32 or float64, the type of the real part in a precision."""
    return np.empty(0, precision).real.dtype


def complex_field(phase: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """Return A exp(iφ) of real phases φ (..., M, M) in rad and an amplitude A (M, M)."""
    # cos φ + i sin φ, written into one array.
    field = np.empty(phase.shape, np.result_type(phase.dtype, np.complex64))
    np.cos(phase, out=field.real)
    np.sin(phase, out=field.imag)
    field *= amplitude
    return field


def image_points(
    pupil: Pupil, stamp_px: int, pixel: float, extra: int = EXTRA_POINTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose points on one side of a stamp's axis, and weights from intensities to pixels.

    Chebyshev points of the stamp, mapped so that they are nearly equidistant as far as the error
    permits (Kosloff & Tal-Ezer 1993, J. Comput. Phys. 104, 457). The weights integrate every
    wave that an intensity can contain, by least squares.

    Parameters
    ----------
    pupil : Pupil
        Pupil, whose width limits the spectrum of the intensity.
    stamp_px : int
        Pixels d along a side.
    pixel : float
        Pixel width in λ/D.
    extra : int
        Points along the whole axis in addition to two per λ/D; two more gain about one digit.

    Returns
    -------
    points : ndarray, shape (m,)
        Distance from the chief ray in λ/D, ascending.
    even_weights, odd_weights : ndarray, shape (m, ⌈d/2⌉)
        For the intensity I (m,) at the points, even_weights.T @ I is its integral over each
        pixel from the chief ray outward if I is even about the chief ray, odd_weights.T @ I if
        I is odd.
    """
    # Half of the points. Two per λ/D resolve the highest frequency: in cycles per λ/D, it is the
    # width of the pupil in diameters, half of its width in radii. `extra` more are for the
    # accuracy.
    edge = 0.5 * stamp_px * pixel
    highest = 0.5 * (pupil.axis.size - 1) * pupil.spacing
    m = max(1, (int(np.ceil(4.0 * edge * highest)) + extra + 1) // 2)
    # Points arcsin(s x)/arcsin(s) of Chebyshev's x, with s = 1/cosh(ln(10^digits)/2m).
    digits = max(1.0, 0.5 * extra)
    spread = 1.0 / np.cosh(np.log(10.0) * digits / (2 * m))
    chebyshev = np.sin(0.5 * np.pi * (np.arange(m) + 0.5) / m)
    points = edge * np.arcsin(spread * chebyshev) / np.arcsin(spread)
    # Integrals of cosines and sines over the pixels: value at the centre × width × sinc.
    centres = (np.arange(stamp_px // 2, stamp_px) - 0.5 * (stamp_px - 1)) * pixel
    wave = 2.0 * np.pi * np.linspace(0.0, highest, 4 * m)[:, None]
    width = pixel * np.sinc(wave / (2.0 * np.pi) * pixel)
    even_weights, odd_weights = (
        np.linalg.lstsq(part(wave * points), part(wave * centres) * width, rcond=1e-12)[0]
        for part in (np.cos, np.sin)
    )
    return points, even_weights, odd_weights


class StampPropagator:
    """Operator from batches of OPD maps to pixel-integrated stamps.

    The stamp is centred on the chief ray plus an offset per star. The offset is a
    tilt of the wavefront, so that all stars share the same matrices. For an even
    stamp the chief ray falls on a pixel corner. Several threads may use one
    propagator at the same time: each has its own scratch space.

    Parameters
    ----------
    pupil : Pupil
        Transmission on an M × M grid, the same above and below the chief ray.
    stamp_px : int
        Pixels d along a side of the stamp.
    pixel : float
        Pixel width in λ/D.
    extra : int
        Points of the image in addition to two per λ/D, see `image_points`.
    precision : "complex64" or "complex128"
        Precision of the fields.
    backend : "numpy" or "torch"
        Library of the matrix products.

    Raises
    ------
    ValueError
        If the pupil's halves differ, or the backend is unknown.
    """

    def __init__(
        self,
        pupil: Pupil,
        stamp_px: int,
        pixel: float,
        extra: int = EXTRA_POINTS,
        precision: Precision = "complex128",
        backend: Backend = "numpy",
    ) -> None:
        # One half of the pupil stands for both.
        if not np.allclose(pupil.amplitude, pupil.amplitude[::-1], atol=1e-9):
            raise ValueError("pupil: its halves above and below the chief ray differ")
        # numpy or torch, which have functions of the same names.
        self._xp: Any = np
        if backend == "torch":
            import torch

            self._xp = torch
        elif backend != "numpy":
            raise ValueError(f"optics.backend = {backend!r}: expected 'numpy' or 'torch'")
        self.stamp_px = stamp_px
        self.pixel = pixel
        self.real_dtype = real_dtype(precision)
        self._half = half = (pupil.axis.size + 1) // 2
        # Cosines and sines from the pupil's columns to the points along x.
        points, even_weights, odd_weights = image_points(pupil, stamp_px, pixel, extra)
        angle = np.pi * np.outer(pupil.axis, points)
        waves = np.stack([np.cos(angle), np.sin(angle)])
        self._from_x = self._array(waves)
        # The same along y for both halves of the pupil. The middle row of an odd grid is its own
        # mirror image and counts once.
        multiplicity = np.where(pupil.axis[-half:] == 0.0, 1.0, 2.0)
        self._from_y = self._array((waves[:, -half:] * multiplicity[:, None]).swapaxes(1, 2))
        # Weights from intensities to pixels, even and odd ones.
        weights = np.stack([even_weights, odd_weights]) / np.sqrt(pupil.light)
        self._to_x, self._to_y = self._array(weights), self._array(weights.swapaxes(1, 2))
        self._amplitude = self._array(pupil.amplitude[-half:])
        self._axis = self._array(pupil.axis)
        self._scratch = threading.local()

    def __call__(self, opd: np.ndarray | Tensor, offset_px: np.ndarray | None = None) -> np.ndarray:
        """Propagate a batch of wavefronts to stamps.

        Parameters
        ----------
        opd : array, shape (B, M, M)
            OPD in waves; a numpy array or, with the torch backend, a tensor.
        offset_px : ndarray, shape (B, 2), optional
            Position (row, column) of the stamp's centre relative to the chief
            ray, in pixels.

        Returns
        -------
        ndarray, shape (B, d, d)
            Fraction of the light through the pupil that falls on each pixel
            (over the whole image plane it sums to 1).
        """
        xp, (batch, n, _) = self._xp, opd.shape
        m = self._from_y.shape[1]
        opd = self._array(opd) if isinstance(opd, np.ndarray) else opd
        # A shift of the stamp by +u is a tilt that moves the image by −u.
        tilt = np.zeros((batch, 2)) if offset_px is None else np.asarray(offset_px, float)
        tilt = self._array(-np.pi * self.pixel * tilt)
        # Along y. Axes: [cosine or sine in y, real or imaginary, star, point in y, pupil x]. Stars
        # with 2^17 samples are processed together: their phases fit into a core's cache.
        rows = self._buffer("rows", 2, 2, batch, m, n)
        size = max(1, 2**17 // n**2)
        for part in (slice(start, start + size) for start in range(0, batch, size)):
            fields = self._fold_fields(opd[part], tilt[part])
            xp.matmul(self._from_y[:, None, None], fields, out=rows[:, :, part])
        # Along x, with a leading axis: cosine or sine in x.
        field = self._buffer("field", 2, 2, 2, batch, m, m)
        xp.matmul(rows, self._from_x[:, None, None, None], out=field)
        return self._pixels(self._intensities(field))

    def _fold_fields(self, opd: Any, tilt: Any) -> Any:
        """Return exp(is) cos t and exp(is) sin t over half of the pupil, (2, 2, b, half, M).

        s and t are the even and odd part of the phase over y. The second axis is the real or
        imaginary part.
        """
        xp, half, shape = self._xp, self._half, (len(opd), self._half, opd.shape[-1])
        upper, lower = opd[:, -half:], xp.flip(opd[:, :half], (1,))
        # s = π (W(y) + W(−y)) and t = π (W(y) − W(−y)); tilts along x are even, along y odd.
        phase = self._buffer("phase", 2, *shape)
        xp.add(upper, lower, out=phase[0])
        xp.subtract(upper, lower, out=phase[1])
        phase *= np.pi
        phase[0] += tilt[:, 1, None, None] * self._axis
        phase[1] += tilt[:, 0, None, None] * self._axis[-half:, None]
        waves = self._buffer("waves", 2, 2, *shape)
        # cos and sin of s and t; exp(is) = cos s + i sin s, times the transmission.
        xp.cos(phase, out=waves[0])
        xp.sin(phase, out=waves[1])
        waves[:, 0] *= self._amplitude
        fields = self._buffer("fields", 2, 2, *shape)
        return xp.multiply(waves[:, 0], waves[:, None, 1], out=fields)

    def _intensities(self, field: Any) -> Any:
        """Return the even and odd parts of |E|² over x and over y, (2, 2, B, m, m).

        Parts that are odd in x are halved. `field` holds [cosine or sine in x, in y, real or
        imaginary]. With C and S the cosine and sine parts in y, the field at (a x, b y), a and b
        each ±1, is (C + b S)_cos − i a (C + b S)_sin; the subscript is the part in x.
        """
        xp, shape = self._xp, tuple(field.shape[3:])
        product = self._buffer("product", 2, 2, 2, *shape)
        intensity = self._buffer("intensity", 2, 2, *shape)
        # Even over x and y: the squares of all parts.
        intensity[0, 0] = xp.multiply(field, field, out=product).reshape(8, *shape).sum(0)
        # Even over x and odd over y: twice the products of cosines and sines in y.
        half = product[0]
        xp.multiply(field[:, 0], field[:, 1], out=half)
        intensity[0, 1] = 2.0 * half.reshape(4, *shape).sum(0)
        # Odd over x: products of real and imaginary parts across cosines and sines in x. They are
        # even over y for equal parts in y, and odd for different ones.
        (cos_re, cos_im), (sin_re, sin_im) = field[0].swapaxes(0, 1), field[1].swapaxes(0, 1)
        exchanged_parts = (xp.flip(sin_re, (0,)), xp.flip(sin_im, (0,)))
        for parity, (re, im) in enumerate(((sin_re, sin_im), exchanged_parts)):
            xp.multiply(cos_re, im, out=half[0])
            xp.multiply(cos_im, re, out=half[1])
            intensity[1, parity] = half[0].sum(0) - half[1].sum(0)
        return intensity

    def _pixels(self, intensity: Any) -> np.ndarray:
        """Return stamps (B, d, d) of the parts of the intensity at the points."""
        # Weights along x, then along y, for even and odd parts.
        along_x = self._xp.matmul(intensity, self._to_x[:, None, None])
        parts = np.asarray(self._xp.matmul(self._to_y[:, None], along_x))
        d, half = self.stamp_px, (self.stamp_px + 1) // 2
        above, below = slice(d // 2, None), slice(half - 1, None, -1)
        # Pixels at ±x and ±y are even ± odd parts; parts odd in x were halved, hence the factor 2.
        # The middle pixel of an odd stamp is written by both sides, which agree.
        stamp = np.empty((len(parts[0, 0]), d, d), self.real_dtype)
        for sign, columns in ((2.0, above), (-2.0, below)):
            even_rows, odd_rows = parts[0] + sign * parts[1]
            stamp[:, above, columns] = even_rows + odd_rows
            stamp[:, below, columns] = even_rows - odd_rows
        return stamp

    def _array(self, array: np.ndarray) -> Any:
        """Return an array of the backend in the propagator's precision."""
        array = np.ascontiguousarray(array, dtype=self.real_dtype)
        return array if self._xp is np else self._xp.from_numpy(array)

    def _buffer(self, name: str, *shape: int) -> Any:
        """Return scratch space that is kept between calls, one array for each thread.

        New pages of memory would take more time than the arithmetic.
        """
        # One array for each name, as large as any batch has needed; a smaller one uses its start.
        buffers, size = vars(self._scratch), math.prod(shape)
        if name not in buffers or len(buffers[name]) < size:
            buffers[name] = self._array(np.empty(size, self.real_dtype))
        return buffers[name][:size].reshape(shape)


class Sampling(Protocol):
    """Points of the image plane, and their contributions to the pixels of a stamp."""

    dtype: np.dtype
    """float32 or float64, of the pixels."""

    product_cost: float
    """Measured time for a product of polynomials, over the time for a single direction."""

    @property
    def propagator(self) -> StampPropagator | None:
        """Faster propagation of stamps without derivatives, if there is one."""

    def along_x(self, pupil_fields: np.ndarray, degrees: Sequence[int] = (0,)) -> np.ndarray:
        """Propagate rows of the pupil, times P_a(x) for all degrees a, to m points along x.

        Parameters
        ----------
        pupil_fields : ndarray, shape (B, M, M)
            Complex fields in the pupil, indexed [wavefront, y, x].
        degrees : sequence of A int
            Degrees of Legendre polynomials.

        Returns
        -------
        ndarray, shape (A, B, M, m)
            Field over pupil y and the points along x.
        """

    def along_y(self, rows: np.ndarray, degrees: Sequence[int] = (0,)) -> np.ndarray:
        """Propagate columns of such fields (B, M, m), times P_b(y) for all degrees b, to points.

        The result (A, B, m, m) is the field at the points, up to a common phase of each point.
        """

    def to_pixels(self, values: np.ndarray) -> np.ndarray:
        """Return pixels (..., d, d) of intensities, or their slopes, at the points (..., m, m)."""


class FieldPropagator:
    """Operator from batches of OPD maps to stamps, for any sampling of the image.

    Parameters
    ----------
    pupil : Pupil
        Transmission on an M × M grid.
    sampling : Sampling
        Points of the image, made for the same pupil.
    pixel : float
        Pixel width in λ/D; the unit of offsets.
    """

    def __init__(self, pupil: Pupil, sampling: Sampling, pixel: float) -> None:
        self.real_dtype, self._sampling, self._pixel = sampling.dtype, sampling, pixel
        self._axis = pupil.axis.astype(self.real_dtype)
        # The transmission is divided by the root of the pupil's light, for a total light of 1.
        self._amplitude = (pupil.amplitude / np.sqrt(pupil.light)).astype(self.real_dtype)

    def __call__(self, opd: np.ndarray, offset_px: np.ndarray | None = None) -> np.ndarray:
        """Return stamps (B, d, d) of OPD maps (B, M, M) in waves, shifted by (B, 2) pixels."""
        sampling = self._sampling
        if sampling.propagator is not None:
            return sampling.propagator(opd, offset_px)
        # The field by two transforms, and the light on the pixels from its intensity. Stars with
        # 2^16 samples are processed together: their fields fit into a core's cache.
        stamps, size = [], max(1, 2**16 // opd.shape[-1] ** 2)
        for part in (slice(start, start + size) for start in range(0, max(len(opd), 1), size)):
            offset = None if offset_px is None else offset_px[part]
            (rows,) = sampling.along_x(self.pupil_fields(opd[part], offset))
            (field,) = sampling.along_y(rows)
            stamps.append(sampling.to_pixels(field.real**2 + field.imag**2))
        return np.concatenate(stamps)

    def pupil_fields(self, opd: np.ndarray, offset_px: np.ndarray | None) -> np.ndarray:
        """Return A exp(2πiW) of a batch, with the tilt that shows the image at an offset."""
        phase = opd.astype(self.real_dtype, copy=False) * (2.0 * np.pi)
        if offset_px is not None:
            # A shift of the stamp by +u is a tilt that moves the image by −u.
            tilt = (np.pi * self._pixel * np.asarray(offset_px, float)).astype(phase.dtype)
            phase -= tilt[:, 0, None, None] * self._axis[:, None]
            phase -= tilt[:, 1, None, None] * self._axis
        return complex_field(phase, self._amplitude)


def run_grids(
    samples: np.ndarray,
    size: int,
    threads: int,
    prepare: Callable[[int], Callable[[np.ndarray], None]],
) -> None:
    """Process wavefronts in batches that share a pupil grid, in parallel threads.

    Parameters
    ----------
    samples : ndarray of int, shape (B,)
        Samples N along a side of the pupil grid of every wavefront.
    size : int
        Largest number of wavefronts in a batch.
    threads : int
        Number of batches at once; linear algebra should use one thread meanwhile.
    prepare : callable
        Function of N that returns the function for one batch. This takes indices into `samples`,
        shape (b,), and stores its own results.
    """
    # Grid by grid, beginning with the coarsest.
    for count in np.unique(samples):
        members = np.flatnonzero(samples == count)
        batches = np.array_split(members, range(size, members.size, size))
        run_parallel(prepare(int(count)), batches, threads)
