"""Fraunhofer propagation from a pupil to the pixels of a stamp, and to nothing else.

The field at the image angle u (in λ/D) of a pupil with transmission A(x) and
OPD W(x) in waves, x in pupil radii, is

    E(u) = Σ A(x) exp(2πi W(x)) exp(−πi u·x),

two matrix products per stamp (a matrix DFT, Soummer et al. 2007, Opt. Express
15, 15935). Only the wanted points are computed; there is no padded grid. Pupil
grid and stamp are symmetric about the chief ray, so the even part of the pupil
field meets cosines only, the odd part sines only, each on half of the pupil and
for half of the stamp; the other half follows by a sign. That is a quarter of
the arithmetic, all of it with real matrices in the GEMM of numpy or torch.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from psfdae.optics.pupil import Pupil
from psfdae.threads import side_by_side

Backend = Literal["numpy", "torch"]
Precision = Literal["complex64", "complex128"]


def pixel_nodes(pixel: float, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Legendre nodes and weights across a pixel of width `pixel` around 0.

    One node is the point sample at the pixel's centre. The weights sum to the
    pixel's width.
    """
    positions, weights = np.polynomial.legendre.leggauss(nodes)
    return 0.5 * pixel * positions, 0.5 * pixel * weights


class StampPropagator:
    """Batched operator from OPD maps to pixel-integrated stamps.

    The stamp is centred on the chief ray moved by an offset per star, which
    enters as a tilt: all stars share the same matrices. For an even stamp the
    chief ray falls on a pixel corner. Several threads may use one propagator at
    the same time: each has scratch space of its own.

    Parameters
    ----------
    pupil : Pupil
        Transmission on an M × M grid.
    stamp_px : int
        Pixels d along a side of the stamp.
    pixel : float
        Pixel width in λ/D.
    nodes : int
        Gauss–Legendre nodes per pixel and axis; 1 samples the centre (the
        result is then intensity × pixel area).
    precision : "complex64" or "complex128"
    backend : "numpy" or "torch"
    """

    def __init__(
        self,
        pupil: Pupil,
        stamp_px: int,
        pixel: float,
        nodes: int,
        precision: Precision = "complex128",
        backend: Backend = "numpy",
    ) -> None:
        self.stamp_px = stamp_px
        self.pixel = pixel
        self.nodes = nodes
        self._xp = _array_module(backend)
        self.real_dtype = np.dtype(np.float32 if precision == "complex64" else np.float64)
        self._half = (pupil.axis.size + 1) // 2
        axis = pupil.axis[-self._half :]
        points, weights = self._half_points()
        angle = np.pi * np.outer(axis, points)
        # Of an odd grid the middle sample is its own mirror image and counts once.
        self._cos = self._array(np.cos(angle) * np.where(axis == 0.0, 0.5, 1.0)[:, None])
        self._sin = self._array(np.sin(angle))
        bins = weights / np.sqrt(pupil.light)
        # Products with these add up the nodes of every pixel of a half and of both halves.
        self._bins_x, self._bins_y = self._array(bins), self._array(np.kron(np.eye(2), bins).T)
        self._amplitude = self._array(pupil.amplitude)
        self._axis = self._array(pupil.axis)
        self._work = threading.local()

    def _half_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes from the chief ray on, shape (m,), and their weights in pixels, (⌈d/2⌉, m)."""
        d, q = self.stamp_px, self.nodes
        inside, weights = pixel_nodes(self.pixel, q)
        centres = (np.arange(d) - 0.5 * (d - 1)) * self.pixel
        m = (d * q + 1) // 2
        bins = np.kron(np.eye(d), weights)[d // 2 :, -m:]
        if d * q % 2:
            # The node on the chief ray belongs to both halves.
            bins[:, 0] *= 0.5
        return (centres[:, None] + inside).ravel()[-m:], bins

    def __call__(self, opd: Any, offset_px: np.ndarray | None = None) -> np.ndarray:
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
        m = self._cos.shape[1]
        even, odd = self._fold("y", self._field(opd, offset_px))
        cosine = self._product("cy", even.swapaxes(-1, -2), self._cos)
        sine = self._product("sy", odd.swapaxes(-1, -2), self._sin)
        # [pupil x, (real, imaginary) × (above, below the chief ray) × node].
        columns = self._buffer("columns", batch, n, 2, 2, m)
        xp.add(cosine[0], sine[1], out=columns[:, :, 0, 0])
        xp.subtract(cosine[1], sine[0], out=columns[:, :, 1, 0])
        xp.subtract(cosine[0], sine[1], out=columns[:, :, 0, 1])
        xp.add(cosine[1], sine[0], out=columns[:, :, 1, 1])
        even, odd = self._fold("x", columns.reshape(1, batch, n, 4 * m))
        cosine = self._product("cx", self._cos.T, even[0]).reshape(batch, m, 2, 2 * m)
        sine = self._product("sx", self._sin.T, odd[0]).reshape(batch, m, 2, 2 * m)
        return self._assemble(cosine, sine)

    def _fold(self, name: str, values: Any) -> tuple[Any, Any]:
        """Even and odd part over the third axis, shape (…, half, …) each."""
        xp = self._xp
        upper = values[:, :, -self._half :]
        mirrored = xp.flip(values[:, :, : self._half], (2,))
        even = self._buffer("even" + name, *upper.shape)
        odd = self._buffer("odd" + name, *upper.shape)
        xp.add(upper, mirrored, out=even)
        xp.subtract(upper, mirrored, out=odd)
        return even, odd

    def _product(self, name: str, left: Any, right: Any) -> Any:
        lead = left.shape[:-2] or right.shape[:-2]
        out = self._buffer(name, *lead, left.shape[-2], right.shape[-1])
        return self._xp.matmul(left, right, out=out)

    def _assemble(self, cosine: Any, sine: Any) -> np.ndarray:
        """Pixels of the stamp from the products over x.

        |C ∓ iS|² = |C|² + |S|² ± 2 (C_r S_i − C_i S_r) on either side in x.
        """
        xp, (batch, m, _, _) = self._xp, cosine.shape
        intensity = self._buffer("intensity", 2, batch, m, 2 * m)
        term = self._buffer("term", batch, m, 2 * m)
        total, cross = intensity
        xp.multiply(cosine[:, :, 0], sine[:, :, 1], out=cross)
        cross -= xp.multiply(cosine[:, :, 1], sine[:, :, 0], out=term)
        xp.multiply(cosine[:, :, 0], cosine[:, :, 0], out=total)
        for part in (cosine[:, :, 1], sine[:, :, 0], sine[:, :, 1]):
            total += xp.multiply(part, part, out=term)
        # Axes: [sum, cross term], star, distance in x, side in y, distance in y.
        binned = np.asarray(self._bins_x @ (intensity @ self._bins_y))
        d, half = self.stamp_px, (self.stamp_px + 1) // 2
        pixels = binned.reshape(2, batch, half, 2, half)
        above, below = slice(d // 2, None), slice(half - 1, None, -1)
        # The middle pixel of an odd stamp receives from both sides.
        stamp = np.zeros((batch, d, d), self.real_dtype)
        for sign, columns in ((2.0, above), (-2.0, below)):
            one_side = pixels[0] + sign * pixels[1]
            stamp[:, above, columns] += one_side[:, :, 0].swapaxes(1, 2)
            stamp[:, below, columns] += one_side[:, :, 1].swapaxes(1, 2)
        return stamp

    def _field(self, opd: Any, offset_px: np.ndarray | None) -> Any:
        """Real and imaginary part of the pupil field, shape (2, B, M, M)."""
        xp, shape = self._xp, tuple(opd.shape)
        phase = self._buffer("phase", *shape)
        xp.multiply(
            self._array(opd) if isinstance(opd, np.ndarray) else opd, 2.0 * np.pi, out=phase
        )
        if offset_px is not None:
            # Looking at a stamp moved by +u is the tilt that moves the image by −u.
            tilt = self._array(np.pi * self.pixel * np.asarray(offset_px, float))
            phase -= tilt[:, 0, None, None] * self._axis[:, None]
            phase -= tilt[:, 1, None, None] * self._axis
        field = self._buffer("field", 2, *shape)
        xp.cos(phase, out=field[0])
        xp.sin(phase, out=field[1])
        field *= self._amplitude
        return field

    def _array(self, array: np.ndarray) -> Any:
        array = np.ascontiguousarray(array, dtype=self.real_dtype)
        return array if self._xp is np else self._xp.from_numpy(array)

    def _buffer(self, name: str, *shape: int) -> Any:
        """Scratch space kept between calls: fresh pages would cost more than the arithmetic."""
        kept = self._work.__dict__
        buffer = kept.get(name)
        if buffer is None or tuple(buffer.shape) != shape:
            buffer = kept[name] = self._array(np.empty(shape, self.real_dtype))
        return buffer


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
