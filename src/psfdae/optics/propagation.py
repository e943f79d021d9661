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


class SearchPropagator(StampPropagator):
    """The same operator for a wide window around the chief ray, without offsets.

    Pupil and window are symmetric about the chief ray, so both sums are taken
    over one half of the pupil, of the even part with cosines and of the odd part
    with sines, and for one half of the window; the other half follows by a sign.
    That is a quarter of the products. It rounds differently from the parent
    class (1e-6 of the peak in single precision), which makes the stamps.

    Parameters
    ----------
    pupil, pixel, nodes, precision
        As for `StampPropagator`; numpy only.
    stamp_px : int
        Side of the window, even.
    """

    def __init__(
        self, pupil: Pupil, stamp_px: int, pixel: float, nodes: int, precision: Precision
    ) -> None:
        super().__init__(pupil, stamp_px, pixel, nodes, precision, "numpy")
        if stamp_px % 2:
            raise ValueError(f"stamp_px = {stamp_px}: the window must have an even side")
        self._half = (pupil.axis.size + 1) // 2
        half = pupil.axis[-self._half :]
        points = np.arange(stamp_px // 2)[:, None] * pixel + 0.5 * pixel
        angle = np.pi * np.outer(half, (points + pixel_nodes(pixel, nodes)[0]).ravel())
        # Of an odd grid the middle sample is its own mirror image and counts once.
        once = np.where(half == 0.0, 0.5, 1.0)[:, None]
        self._cos = self._array(np.cos(angle) * once)
        self._sin = self._array(np.sin(angle))
        # Products with these add up the nodes of every pixel.
        bins = np.kron(np.eye(points.size), self._weights[:nodes])
        self._bins_x, self._bins_y = self._array(bins), self._array(np.kron(np.eye(2), bins).T)

    def __call__(self, opd: np.ndarray, offset_px: np.ndarray | None = None) -> np.ndarray:
        """Window images, shape (B, stamp_px, stamp_px); see `StampPropagator`."""
        batch, n, _ = opd.shape
        m = self._cos.shape[1]
        even, odd = self._fold("y", self._field(opd, offset_px))
        cosine = self._product("cy", even.swapaxes(-1, -2), self._cos)
        sine = self._product("sy", odd.swapaxes(-1, -2), self._sin)
        # [pupil x, (real, imaginary) × (above, below the chief ray) × point].
        columns = self._buffer("columns", batch, n, 2, 2, m)
        np.add(cosine[0], sine[1], out=columns[:, :, 0, 0])
        np.subtract(cosine[1], sine[0], out=columns[:, :, 1, 0])
        np.subtract(cosine[0], sine[1], out=columns[:, :, 0, 1])
        np.add(cosine[1], sine[0], out=columns[:, :, 1, 1])
        even, odd = self._fold("x", columns.reshape(1, batch, n, 4 * m))
        cosine = self._product("cx", self._cos.T, even[0]).reshape(batch, m, 2, 2 * m)
        sine = self._product("sx", self._sin.T, odd[0]).reshape(batch, m, 2, 2 * m)
        return self._assemble(cosine, sine)

    def _fold(self, axis: str, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Even and odd part over the third axis, shape (…, half, …) each."""
        mirrored, upper = values[:, :, self._half - 1 :: -1], values[:, :, -self._half :]
        even = self._buffer("even" + axis, *upper.shape)
        odd = self._buffer("odd" + axis, *upper.shape)
        return np.add(upper, mirrored, out=even), np.subtract(upper, mirrored, out=odd)

    def _product(self, name: str, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        lead = left.shape[:-2] or right.shape[:-2]
        return np.matmul(
            left, right, out=self._buffer(name, *lead, left.shape[-2], right.shape[-1])
        )

    def _assemble(self, cosine: np.ndarray, sine: np.ndarray) -> np.ndarray:
        """Pixels of the whole window from the products over x.

        |C ∓ iS|² = |C|² + |S|² ± 2 (C_r S_i − C_i S_r) on either side in x.
        """
        batch, m, _, _ = cosine.shape
        half = self.stamp_px // 2
        intensity = self._buffer("intensity", 2, batch, m, 2 * m)
        np.add((cosine**2).sum(axis=2), (sine**2).sum(axis=2), out=intensity[0])
        crossed = cosine * sine[:, :, ::-1]
        np.subtract(crossed[:, :, 0], crossed[:, :, 1], out=intensity[1])
        # Axes: [sum, cross term], star, distance in x, side in y, distance in y.
        pixels = (self._bins_x @ (intensity @ self._bins_y)).reshape(2, batch, half, 2, half)
        window = np.empty((batch, self.stamp_px, self.stamp_px), self.real_dtype)
        for sign, columns in ((2.0, slice(half, None)), (-2.0, slice(half - 1, None, -1))):
            one_side = pixels[0] + sign * pixels[1]
            window[:, half:, columns] = one_side[:, :, 0].swapaxes(1, 2)
            window[:, half - 1 :: -1, columns] = one_side[:, :, 1].swapaxes(1, 2)
        return window


def _array_module(backend: Backend) -> Any:
    if backend == "numpy":
        return np
    if backend == "torch":
        import torch

        return torch
    raise ValueError(f"optics.backend = {backend!r}: expected 'numpy' or 'torch'")
