"""Fraunhofer propagation from a pupil to the pixels of a stamp, and to nothing else.

The field at the image angle u (in λ/D) of a pupil with transmission A(x) and
OPD W(x) in waves, x in pupil radii, is

    E(u) = Σ A(x) exp(2πi W(x)) exp(−πi u·x),

two matrix products per stamp (a matrix DFT, Soummer et al. 2007, Opt. Express
15, 15935). Only the wanted points are computed; there is no padded grid. Pupil
and points are symmetric about the chief ray. With s and t the even and odd part
of the phase 2πW over y, two rows of the pupil together are

    exp(is) cos(t − πu y) = exp(is) (cos t cos πuy + sin t sin πuy),

so one half of the pupil and of the points suffices, and all products are real.

The spectrum of an intensity ends at the largest distance of two points of the
pupil. Two points per λ/D and a few more therefore determine it on the whole
stamp, and with it the light on every pixel: far fewer points than a quadrature
in each pixel needs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from psfdae.optics.pupil import Pupil
from psfdae.threads import side_by_side

if TYPE_CHECKING:
    from torch import Tensor

Backend = Literal["numpy", "torch"]
Precision = Literal["complex64", "complex128"]

EXTRA_POINTS = 6
"""Points beyond two per λ/D; they integrate a wave to 5e-4 of a pixel's width."""

IN_CACHE = 2**17
"""Samples of the pupil that are worked on together: their phases stay in a core's cache."""


def image_points(
    pupil: Pupil, stamp_px: int, pixel: float, extra: int = EXTRA_POINTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on one side of a stamp's axis, and what intensities there say about the pixels.

    Chebyshev points of the stamp that are spread as far as a wanted error allows, until they
    are nearly equidistant (Kosloff & Tal-Ezer 1993, J. Comput. Phys. 104, 457). The weights
    integrate every wave that an intensity can hold, by least squares.

    Parameters
    ----------
    pupil : Pupil
    stamp_px : int
        Pixels d along a side.
    pixel : float
        Pixel width in λ/D.
    extra : int
        Points along the whole axis beyond two per λ/D; two more gain about one digit.

    Returns
    -------
    points : ndarray, shape (m,)
        In λ/D from the chief ray, ascending.
    even, odd : ndarray, shape (m, ⌈d/2⌉)
        An intensity that is the same on both sides has eᵀI on the pixels from the chief
        ray on; one that changes its sign has oᵀI.
    """
    edge, highest = 0.5 * stamp_px * pixel, 0.5 * (pupil.axis.size - 1) * pupil.spacing
    m = max(1, (int(np.ceil(4.0 * edge * highest)) + extra + 1) // 2)
    digits = max(1.0, 0.5 * extra)
    spread = 1.0 / np.cosh(np.log(10.0) * digits / (2 * m))
    chebyshev = np.sin(0.5 * np.pi * (np.arange(m) + 0.5) / m)
    points = edge * np.arcsin(spread * chebyshev) / np.arcsin(spread)
    centres = (np.arange(stamp_px // 2, stamp_px) - 0.5 * (stamp_px - 1)) * pixel
    wave = 2.0 * np.pi * np.linspace(0.0, highest, 4 * m)[:, None]
    width = pixel * np.sinc(wave / (2.0 * np.pi) * pixel)
    even, odd = (
        np.linalg.lstsq(part(wave * points), part(wave * centres) * width, rcond=1e-12)[0]
        for part in (np.cos, np.sin)
    )
    return points, even, odd


class StampPropagator:
    """Batched operator from OPD maps to pixel-integrated stamps.

    The stamp is centred on the chief ray moved by an offset per star, which
    enters as a tilt: all stars share the same matrices. For an even stamp the
    chief ray falls on a pixel corner. Several threads may use one propagator at
    the same time: each has scratch space of its own.

    Parameters
    ----------
    pupil : Pupil
        Transmission on an M × M grid, the same above and below the chief ray.
    stamp_px : int
        Pixels d along a side of the stamp.
    pixel : float
        Pixel width in λ/D.
    extra : int
        Points of the image beyond two per λ/D, see `image_points`.
    precision : "complex64" or "complex128"
    backend : "numpy" or "torch"

    Raises
    ------
    ValueError
        If the pupil's halves differ, or the backend is another.
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
        if not np.allclose(pupil.amplitude, pupil.amplitude[::-1], atol=1e-9):
            raise ValueError("pupil: its halves above and below the chief ray differ")
        self.stamp_px = stamp_px
        self.pixel = pixel
        self._xp = _array_module(backend)
        self.real_dtype = np.dtype(np.float32 if precision == "complex64" else np.float64)
        self._half = half = (pupil.axis.size + 1) // 2
        points, even, odd = image_points(pupil, stamp_px, pixel, extra)
        angle = np.pi * np.outer(pupil.axis, points)
        waves = np.stack([np.cos(angle), np.sin(angle)])
        self._from_x = self._array(waves)
        # Both halves in one. Of an odd grid the middle row is its own mirror image.
        alone = np.where(pupil.axis[-half:] == 0.0, 1.0, 2.0)
        self._from_y = self._array((waves[:, -half:] * alone[:, None]).swapaxes(1, 2))
        bins = np.stack([even, odd]) / np.sqrt(pupil.light)
        self._to_x, self._to_y = self._array(bins), self._array(bins.swapaxes(1, 2))
        self._amplitude = self._array(pupil.amplitude[-half:])
        self._axis = self._array(pupil.axis)
        self._work = threading.local()

    def __call__(self, opd: np.ndarray | Tensor, offset_px: np.ndarray | None = None) -> np.ndarray:
        """Propagate a batch.

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
        # Looking at a stamp moved by +u is the tilt that moves the image by −u.
        tilt = np.zeros((batch, 2)) if offset_px is None else np.asarray(offset_px, float)
        tilt = self._array(-np.pi * self.pixel * tilt)
        # Axes: [cosine or sine in y, real or imaginary, star, point in y, pupil x].
        rows = self._buffer("rows", 2, 2, batch, m, n)
        size = max(1, IN_CACHE // n**2)
        for part in (slice(start, start + size) for start in range(0, batch, size)):
            fields = self._folded(opd[part], tilt[part])
            xp.matmul(self._from_y[:, None, None], fields, out=rows[:, :, part])
        field = self._buffer("field", 2, 2, 2, batch, m, m)
        xp.matmul(rows, self._from_x[:, None, None, None], out=field)
        return self._pixels(self._intensities(field))

    def _folded(self, opd: Any, tilt: Any) -> Any:
        """exp(is) cos t and exp(is) sin t of the pupil field, each (re, im), (2, 2, b, half, M)."""
        xp, half, shape = self._xp, self._half, (len(opd), self._half, opd.shape[-1])
        upper, mirrored = opd[:, -half:], xp.flip(opd[:, :half], (1,))
        phase = self._buffer("phase", 2, *shape)
        xp.add(upper, mirrored, out=phase[0])
        xp.subtract(upper, mirrored, out=phase[1])
        phase *= np.pi
        phase[0] += tilt[:, 1, None, None] * self._axis
        phase[1] += tilt[:, 0, None, None] * self._axis[-half:, None]
        waves = self._buffer("waves", 2, 2, *shape)
        xp.cos(phase, out=waves[0])
        xp.sin(phase, out=waves[1])
        waves[:, 0] *= self._amplitude
        fields = self._buffer("fields", 2, 2, *shape)
        return xp.multiply(waves[:, 0], waves[:, None, 1], out=fields)

    def _intensities(self, field: Any) -> Any:
        """Even and odd parts over x and over y, shape (2, 2, B, m, m), those odd in x halved.

        `field` holds [cosine or sine in x, in y, real or imaginary]. At ±x and ±y the field
        is (C ± S)_cos ∓ i (C ± S)_sin.
        """
        xp, shape = self._xp, tuple(field.shape[3:])
        product = self._buffer("product", 2, 2, 2, *shape)
        found = self._buffer("intensity", 2, 2, *shape)
        (cos_re, cos_im), (sin_re, sin_im) = field[0].swapaxes(0, 1), field[1].swapaxes(0, 1)
        found[0, 0] = xp.multiply(field, field, out=product).reshape(8, *shape).sum(0)
        half = product[0]
        xp.multiply(field[:, 0], field[:, 1], out=half)
        found[0, 1] = 2.0 * half.reshape(4, *shape).sum(0)
        for parity, (re, im) in enumerate(
            ((sin_re, sin_im), (xp.flip(sin_re, (0,)), xp.flip(sin_im, (0,))))
        ):
            xp.multiply(cos_re, im, out=half[0])
            xp.multiply(cos_im, re, out=half[1])
            found[1, parity] = half[0].sum(0) - half[1].sum(0)
        return found

    def _pixels(self, intensity: Any) -> np.ndarray:
        """Pixels of the stamp from the parts of the intensity at the points."""
        along = self._xp.matmul(intensity, self._to_x[:, None, None])
        parts = np.asarray(self._xp.matmul(self._to_y[:, None], along))
        d, half = self.stamp_px, (self.stamp_px + 1) // 2
        above, below = slice(d // 2, None), slice(half - 1, None, -1)
        # The middle pixel of an odd stamp is written by both sides, which agree.
        stamp = np.empty((len(parts[0, 0]), d, d), self.real_dtype)
        for sign, columns in ((2.0, above), (-2.0, below)):
            even, odd = parts[0] + sign * parts[1]
            stamp[:, above, columns] = even + odd
            stamp[:, below, columns] = even - odd
        return stamp

    def _array(self, array: np.ndarray) -> Any:
        array = np.ascontiguousarray(array, dtype=self.real_dtype)
        return array if self._xp is np else self._xp.from_numpy(array)

    def _buffer(self, name: str, *shape: int) -> Any:
        """Scratch space kept between calls: fresh pages would cost more than the arithmetic."""
        kept: dict[tuple[int, ...], Any] = vars(self._work).setdefault(name, {})
        if shape not in kept:
            kept[shape] = self._array(np.empty(shape, self.real_dtype))
        return kept[shape]


def in_batches(
    samples: np.ndarray,
    size: int,
    threads: int,
    prepare: Callable[[int], Callable[[np.ndarray], None]],
) -> None:
    """Work on wavefronts in batches that share a pupil grid, side by side in threads.

    Parameters
    ----------
    samples : ndarray of int, shape (B,)
        Pupil samples N of every wavefront.
    size : int
        Most wavefronts in a batch.
    threads : int
        Batches at once; linear algebra should be on one thread meanwhile.
    prepare : callable
        From N to the work on a batch, which gets its wavefronts' numbers, shape (b,).
    """
    for count in np.unique(samples):
        members = np.flatnonzero(samples == count)
        batches = np.array_split(members, range(size, members.size, size))
        side_by_side(prepare(int(count)), batches, threads)


def _array_module(backend: Backend) -> Any:
    if backend == "numpy":
        return np
    if backend == "torch":
        import torch

        return torch
    raise ValueError(f"optics.backend = {backend!r}: expected 'numpy' or 'torch'")
