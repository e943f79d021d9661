"""Fraunhofer propagation from a pupil to the pixels of a stamp, and to nothing else.

The field at the image angle u (in λ/D) of a pupil with transmission A(x) and
OPD W(x) in waves, x in pupil radii, is

    E(u) = Σ A(x) exp(2πi W(x)) exp(−πi u·x),

two matrix products per stamp (a matrix DFT, Soummer et al. 2007, Opt. Express
15, 15935). Only the wanted points are computed; there is no padded grid. The
products are written with real matrices, cosine and sine side by side, which
runs at the full speed of the real GEMM of numpy and of torch alike.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from psfdae.optics.pupil import Pupil

Backend = Literal["numpy", "torch"]
Precision = Literal["complex64", "complex128"]

ARCSEC = np.pi / 180.0 / 3600.0
"""One arc second in radians."""


def pixel_in_lambda_over_d(pixel_scale: float, wavelength: float, diameter: float) -> float:
    """Pixel width in units of λ/D; pixel scale in radians, lengths in metres."""
    return pixel_scale * diameter / wavelength


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
    chief ray falls on a pixel corner.

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
        centres = (np.arange(stamp_px) - 0.5 * (stamp_px - 1)) * pixel
        inside, weights = pixel_nodes(pixel, nodes)
        angle = np.pi * np.outer(pupil.axis, (centres[:, None] + inside).ravel())
        self._dft = self._array(np.hstack([np.cos(angle), np.sin(angle)]))
        self._dft_t = self._array(np.hstack([np.cos(angle), np.sin(angle)]).T)
        # Parseval: one period of the image, (2/spacing)² (λ/D)², holds (2/spacing)² ΣA².
        total = (2.0 / pupil.spacing) ** 2 * float((pupil.amplitude**2).sum())
        self._weights = self._array(np.tile(weights, stamp_px) / np.sqrt(total))
        self._amplitude = self._array(pupil.amplitude)
        self._axis = self._array(pupil.axis)
        self._work: dict[str, Any] = {}

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
        d, q = self.stamp_px, self.nodes
        m = d * q
        field = self._field(opd, offset_px)
        # exp(iφ)(c − i s) for every row of every pupil: all sums over x.
        half = xp.matmul(
            field.reshape(2 * batch * n, n),
            self._dft,
            out=self._buffer("half", 2 * batch * n, 2 * m),
        ).reshape(2, batch, n, 2, m)
        rows = self._buffer("rows", batch, n, 2 * m)
        xp.add(half[0, :, :, 0], half[1, :, :, 1], out=rows[:, :, :m])
        xp.subtract(half[1, :, :, 0], half[0, :, :, 1], out=rows[:, :, m:])
        image = xp.matmul(self._dft_t, rows, out=self._buffer("image", batch, 2 * m, 2 * m))
        real = image[:, :m, :m] + image[:, m:, m:]
        imag = image[:, :m, m:] - image[:, m:, :m]
        intensity = (real**2 + imag**2) * (self._weights[:, None] * self._weights)
        return np.asarray(intensity.reshape(batch, d, q, d, q).sum((2, 4)))

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
        buffer = self._work.get(name)
        if buffer is None or tuple(buffer.shape) != shape:
            buffer = self._work[name] = self._array(np.empty(shape, self.real_dtype))
        return buffer


def _array_module(backend: Backend) -> Any:
    if backend == "numpy":
        return np
    if backend == "torch":
        import torch

        return torch
    raise ValueError(f"optics.backend = {backend!r}: expected 'numpy' or 'torch'")
