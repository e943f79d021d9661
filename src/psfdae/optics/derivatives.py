"""A stamp and its derivatives with respect to coefficients of pupil modes.

The OPD is a sum of modes, W = Σ c_j M_j. The field in the image is that of
`psfdae.optics.propagation`, E = Σ A exp(2πiW) exp(−πiu·x). A direction v in the
space of coefficients changes it by dE = Σ 2πi (Σ v_j M_j) A exp(2πiW) exp(−πiu·x),
another such sum, and the intensity by d|E|² = 2 Re(E* dE): derivatives are exact.
Modes are polynomials of the pupil's coordinates, sums of products P_a(x) P_b(y) of Legendre
polynomials. The field of such a product is two matrix products with weighted matrices, and those
along x serve all b: all directions together cost a few stamps. Where directions are few and modes
many, a field for each direction costs less.

Three ways lead from the pupil to the pixels, a `Sampling` each:

- `PointSampling`: the points of `StampPropagator` and a matrix DFT, for stamps
  narrower than the image's period;
- `PeriodSampling`: the whole period of the image by a Fourier transform. The
  intensity is a trigonometric polynomial, which its samples determine, so pixels
  are integrated exactly. It is the faster one for stamps nearly as wide as it;
- `psfdae.optics.seeing.BlurredSampling`: the same period, blurred by the atmosphere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from scipy import fft

from psfdae.optics.propagation import Precision, image_points, in_batches
from psfdae.optics.pupil import Pupil, annular_pupil, choose_samples, required_samples
from psfdae.optics.seeing import WholePeriod
from psfdae.optics.wavefronts import Modes, legendre, legendre_expansion, mode_slopes, slope_ranges


class Sampling(Protocol):
    """Points of the image plane, and what they contribute to the pixels of a stamp."""

    dtype: np.dtype
    """float32 or float64, of the pixels."""

    product_cost: float
    """Time of a product of polynomials over that of a direction by itself, as measured."""

    def along_x(self, pupil_fields: np.ndarray, degrees: Sequence[int] = (0,)) -> np.ndarray:
        """Rows of the pupil to points, times P_a(x) for all degrees a.

        Parameters
        ----------
        pupil_fields : ndarray, shape (B, M, M)
        degrees : sequence of A int
            Of Legendre polynomials.

        Returns
        -------
        ndarray, shape (A, B, M, m)
        """

    def along_y(self, rows: np.ndarray, degrees: Sequence[int] = (0,)) -> np.ndarray:
        """Columns of those, (B, M, m), to points, times P_b(y) for all degrees b, (A, B, m, m).

        Together they give fields at the points, up to a common phase of each.
        """

    def to_pixels(self, values: np.ndarray) -> np.ndarray:
        """Pixels (..., d, d) of intensities, or of their slopes, at the points (..., m, m)."""


class Separable:
    """Points of which one matrix P (d, m) makes pixels, P I Pᵀ."""

    pixels: np.ndarray
    dtype: np.dtype

    def to_pixels(self, values: np.ndarray) -> np.ndarray:
        """See `Sampling`."""
        return np.asarray(self.pixels @ (values @ self.pixels.T))


class PointSampling(Separable):
    """The points of `image_points` on both sides of the chief ray; its parameters."""

    product_cost = 0.1

    # Pupil and points are symmetric about the chief ray. Even and odd parts of the pupil fields
    # meet cosines or sines, so that products are real and a quarter as large.

    def __init__(self, pupil: Pupil, stamp_px: int, pixel: float, precision: Precision) -> None:
        half, even, odd = image_points(pupil, stamp_px, pixel)
        self._samples = (pupil.axis.size + 1) // 2
        self._axis = pupil.axis[-self._samples :]
        # Of an odd grid the middle sample is its own mirror image.
        alone = np.where(self._axis == 0.0, 0.5, 1.0)[:, None]
        angle = np.pi * np.outer(self._axis, half)
        self._waves = np.stack([np.cos(angle), np.sin(angle)]) * alone
        above = 0.5 * np.hstack([(even - odd)[::-1].T, (even + odd).T])
        # The middle pixel of an odd stamp is its own mirror image.
        below = above[::-1, ::-1][: stamp_px // 2]
        self.dtype = np.empty(0, precision).real.dtype
        self.pixels = np.vstack([below, above]).astype(self.dtype)
        self._weighted: dict[int, np.ndarray] = {}

    def along_x(self, pupil_fields: np.ndarray, degrees: Sequence[int] = (0,)) -> np.ndarray:
        """See `Sampling`, m = all points."""
        first, last = (
            pupil_fields[..., self._samples - 1 :: -1],
            pupil_fields[..., -self._samples :],
        )
        parts = _real_parts(last + first), _real_parts(last - first)
        shape = (2, *pupil_fields.shape[:-1], -1)
        found = []
        for a in degrees:
            waves = [parts[(a + k) % 2] @ self._matrix(a)[k] for k in (0, 1)]
            found.append(_joined(*(wave.reshape(shape) for wave in waves)))
        return np.stack(found)

    def along_y(self, rows: np.ndarray, degrees: Sequence[int] = (0,)) -> np.ndarray:
        """See `Sampling`."""
        # Transposed, so that both ways are the same products.
        return self.along_x(rows.swapaxes(-1, -2), degrees).swapaxes(-1, -2)

    def _matrix(self, degree: int) -> np.ndarray:
        """Cosines and sines times P_a(x) over half of the pupil, shape (2, M/2, m/2)."""
        if degree not in self._weighted:
            weighted = legendre([degree], self._axis)[0][:, None] * self._waves
            self._weighted[degree] = weighted.astype(self.dtype)
        return self._weighted[degree]


def _real_parts(array: np.ndarray) -> np.ndarray:
    """Rows (n, M) of the real, then of the imaginary part: one matrix for one product."""
    return np.stack([array.real, array.imag]).reshape(-1, array.shape[-1])


def _joined(cosines: np.ndarray, sines: np.ndarray) -> np.ndarray:
    """C − iS at the points above the chief ray, C + iS below, of real and imaginary parts."""
    (cos_re, cos_im), (sin_re, sin_im) = cosines, sines
    half = cos_re.shape[-1]
    out = np.empty((*cos_re.shape[:-1], 2 * half), np.result_type(cos_re, np.complex64))
    above, below = out[..., half:], out[..., half - 1 :: -1]
    above.real, above.imag = cos_re + sin_im, cos_im - sin_re
    below.real, below.imag = cos_re - sin_im, cos_im + sin_re
    return out


class PeriodSampling(Separable, WholePeriod):
    """Equidistant points over the period of the image, 2/spacing λ/D.

    With lags l of the pupil's samples, |E(u)|² = Σ_l c_l exp(−πi l·spacing·u); the
    integral over a pixel multiplies c_l by the pixel's width and a sinc. Twice as
    many points as samples determine all c_l. Pixels beyond the period repeat those
    inside.
    """

    def __init__(self, pupil: Pupil, stamp_px: int, pixel: float, precision: Precision) -> None:
        samples = pupil.axis.size
        self._axis = pupil.axis
        self.points = fft.next_fast_len(2 * samples)
        lags = np.arange(1 - samples, samples)
        frequency = 0.5 * pupil.spacing * lags
        centres = _centres(stamp_px, pixel)
        to_pixels = (
            pixel * np.sinc(frequency * pixel) * np.exp(-2j * np.pi * np.outer(centres, frequency))
        )
        from_points = np.exp(2j * np.pi * np.outer(lags, np.arange(self.points)) / self.points)
        self.dtype = np.empty(0, precision).real.dtype
        # A pixel's width along the axis, a wave of the image gains this phase.
        moved = to_pixels * (2j * np.pi * pixel * frequency)
        self.pixels, self._moved = (
            ((waves @ from_points).real / self.points).astype(self.dtype)
            for waves in (to_pixels, moved)
        )

    def slopes_by_place(self, values: np.ndarray) -> np.ndarray:
        """Derivatives of the pixels of intensities (B, m, m) by the image's place.

        Along x and y, per pixel; shape (B, 2, d, d).
        """
        pairs = (self.pixels, self._moved), (self._moved, self.pixels)
        return np.stack([of_y @ (values @ of_x.T) for of_y, of_x in pairs], axis=1)


def _centres(stamp_px: int, pixel: float) -> np.ndarray:
    return (np.arange(stamp_px) - 0.5 * (stamp_px - 1)) * pixel


class ModalStamps:
    """Stamps of wavefronts that are sums of pupil modes, and their derivatives.

    Parameters
    ----------
    pupil : Pupil
        Transmission on an M × M grid.
    modes : Modes
    sampling : Sampling
        Made for the same pupil.
    pixel : float
        Pixel width in λ/D; the unit of offsets.
    """

    def __init__(self, pupil: Pupil, modes: Modes, sampling: Sampling, pixel: float) -> None:
        self.dtype = dtype = sampling.dtype
        self.shape = pupil.amplitude.shape
        self._sampling = sampling
        self._pixel = pixel
        self._axis = pupil.axis.astype(dtype)
        images = modes(pupil.axis[None, :], pupil.axis[:, None])
        self._modes = np.ascontiguousarray(images.reshape(len(images), -1), dtype)
        self._amplitude = (pupil.amplitude / np.sqrt(pupil.light)).astype(dtype)
        degrees, coefficients = legendre_expansion(modes)
        self._coefficients = coefficients.astype(dtype)
        self._products = [*map(tuple, degrees)]
        # What is needed along y with each degree along x; the constant first, it is the field.
        self._degrees = [
            [0] * (a == 0) + [b for c, b in self._products if c == a]
            for a in range(degrees[:, 0].max() + 1)
        ]

    def stamps(self, coefficients: np.ndarray, offset_px: np.ndarray | None = None) -> np.ndarray:
        """Stamps of a batch.

        Parameters
        ----------
        coefficients : ndarray, shape (B, J)
        offset_px : ndarray, shape (B, 2), optional
            Position (row, column) of the stamp's centre from the chief ray, in pixels.

        Returns
        -------
        ndarray, shape (B, d, d)
            Fraction of the light through the pupil on each pixel.
        """
        sampling = self._sampling
        (rows,) = sampling.along_x(self._pupil_fields(coefficients, offset_px))
        (field,) = sampling.along_y(rows)
        return sampling.to_pixels(field.real**2 + field.imag**2)

    def derivatives(
        self,
        coefficients: np.ndarray,
        directions: np.ndarray | None = None,
        offset_px: np.ndarray | None = None,
        places: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Stamps of a batch and their derivatives along directions of the coefficients.

        Parameters
        ----------
        coefficients : ndarray, shape (B, J)
        directions : ndarray, shape (B, K, J) or (K, J), optional
            Changes of the coefficients per unit parameter, the Jacobian's
            transpose; by default the coefficients themselves, K = J.
        offset_px : ndarray, shape (B, 2), optional
            As in `stamps`; kept fixed.
        places : bool
            Two more derivatives, by the place of the image along x and y, in pixels. They follow
            from the image, which is why they cost little; its sampling must be `PeriodSampling`.

        Returns
        -------
        stamps : ndarray, shape (B, d, d)
        derivatives : ndarray, shape (B, K, d, d), or (B, K + 2, d, d) with `places`
            Per unit parameter.
        """
        if directions is None:
            directions = np.eye(len(self._modes))
        directions = directions.astype(self.dtype)
        if directions.ndim == 2:
            directions = directions[None]
        pupil_fields = self._pupil_fields(coefficients, offset_px)
        few = directions.shape[1] < self._sampling.product_cost * len(self._products)
        derivatives = self._by_direction if few else self._by_product
        intensity, slopes = derivatives(pupil_fields, directions)
        if places:
            assert isinstance(self._sampling, PeriodSampling)
            slopes = np.concatenate([slopes, self._sampling.slopes_by_place(intensity)], axis=1)
        return self._sampling.to_pixels(intensity), slopes

    def _by_direction(
        self, pupil_fields: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Intensities at the points and slopes of the pixels, each direction a field of its own."""
        sampling, (count, *shape) = self._sampling, pupil_fields.shape
        changed = np.empty((count, 1 + directions.shape[1], *shape), pupil_fields.dtype)
        changed[:, 0] = pupil_fields
        opd = (directions @ self._modes).reshape(*directions.shape[:2], *shape)
        np.multiply(pupil_fields[:, None], opd, out=changed[:, 1:])
        (rows,) = sampling.along_x(changed.reshape(-1, *shape))
        (fields,) = sampling.along_y(rows)
        image, *changes = np.moveaxis(fields.reshape(*changed.shape[:2], *fields.shape[1:]), 1, 0)
        slopes = np.empty((count, len(changes), *image.shape[1:]), self.dtype)
        for k, change in enumerate(changes):
            slopes[:, k] = image.imag * change.real - image.real * change.imag
        return image.real**2 + image.imag**2, (4.0 * np.pi) * sampling.to_pixels(slopes)

    def _by_product(
        self, pupil_fields: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Intensities and slopes as above, from those of all products of Legendre polynomials."""
        sampling, weights = self._sampling, directions @ self._coefficients
        slopes: dict[tuple[int, int], np.ndarray] = {}
        for a, rows in enumerate(sampling.along_x(pupil_fields, range(len(self._degrees)))):
            degrees = self._degrees[a]
            changes = sampling.along_y(rows, degrees)
            if a == 0:
                image = changes[0]
            for b, change in zip(degrees, changes, strict=True):
                # Half of 2 Re(E* i G)
                slope = image.imag * change.real - image.real * change.imag
                slopes[a, b] = sampling.to_pixels(slope)
        each = (4.0 * np.pi) * np.stack([slopes[place] for place in self._products], axis=1)
        shape = (len(each), weights.shape[1], *each.shape[2:])
        found = (weights @ each.reshape(*each.shape[:2], -1)).reshape(shape)
        return image.real**2 + image.imag**2, found

    def opd(self, coefficients: np.ndarray) -> np.ndarray:
        """OPD maps in waves, shape (B, M, M)."""
        opd = np.asarray(coefficients, self._modes.dtype) @ self._modes
        return np.asarray(opd.reshape(-1, *self.shape))

    def _pupil_fields(self, coefficients: np.ndarray, offset_px: np.ndarray | None) -> np.ndarray:
        phase = self.opd(coefficients) * (2.0 * np.pi)
        if offset_px is not None:
            # Looking at a stamp moved by +u is the tilt that moves the image by −u.
            tilt = (np.pi * self._pixel * np.asarray(offset_px, float)).astype(phase.dtype)
            phase -= tilt[:, 0, None, None] * self._axis[:, None]
            phase -= tilt[:, 1, None, None] * self._axis
        fields = np.empty(phase.shape, np.result_type(phase.dtype, np.complex64))
        np.cos(phase, out=fields.real)
        np.sin(phase, out=fields.imag)
        fields *= self._amplitude
        return fields


class SampledStamps:
    """Stamps of sums of modes, each on the smallest pupil grid that its slopes allow.

    Batches run side by side in threads; results do not depend on their number.

    Parameters
    ----------
    obscuration : float
        Linear central obscuration of the pupil.
    modes : Modes
    sampling : callable
        From a pupil to its `Sampling`.
    stamp_px : int
        Pixels d along a side.
    pixel : float
        Pixel width in λ/D.
    sizes : sequence of int
        Pupil samples N to choose from, ascending.
    reach : float
        Distance in λ/D around a stamp from which light is spread into it.
    batch, threads : int
        Stamps or derivatives that are propagated together, and batches at once.
    """

    def __init__(
        self,
        obscuration: float,
        modes: Modes,
        sampling: Callable[[Pupil], Sampling],
        stamp_px: int,
        pixel: float,
        sizes: Sequence[int],
        reach: float = 0.0,
        batch: int = 16,
        threads: int = 1,
    ) -> None:
        self.stamp_px, self.pixel, self.sizes, self.reach = stamp_px, pixel, tuple(sizes), reach
        self._obscuration, self._modes, self._sampling = obscuration, modes, sampling
        self._batch, self._threads = batch, threads
        self._slopes = mode_slopes(modes)
        self._operators: dict[int, ModalStamps] = {}

    def operator(self, samples: int) -> ModalStamps:
        """The operator on a pupil grid with N samples across; made once, then kept."""
        if samples not in self._operators:
            pupil = annular_pupil(samples, self._obscuration)
            self._operators[samples] = ModalStamps(
                pupil, self._modes, self._sampling(pupil), self.pixel
            )
        return self._operators[samples]

    def samples(self, coefficients: np.ndarray, offset_px: np.ndarray | None = None) -> np.ndarray:
        """Pupil samples N of each wavefront, (B, J) to (B,); offsets as in `ModalStamps.stamps`.

        Raises
        ------
        SamplingError
            If the largest grid size is below what a wavefront needs.
        """
        offset_px = np.zeros((len(coefficients), 2)) if offset_px is None else offset_px
        half = np.array([-0.5, 0.5]) * self.stamp_px
        edges = (offset_px[:, ::-1, None] + half) * self.pixel  # (x, y) from (row, column)
        edges = edges + np.array([-self.reach, self.reach])
        return choose_samples(
            required_samples(slope_ranges(self._slopes, coefficients), edges), self.sizes
        )

    def stamps(self, coefficients: np.ndarray, offset_px: np.ndarray | None = None) -> np.ndarray:
        """Return stamps as `ModalStamps.stamps` does; raises as `samples`."""
        out = np.empty((len(coefficients), self.stamp_px, self.stamp_px), self._dtype)

        def prepare(samples: int) -> Callable[[np.ndarray], None]:
            operator = self.operator(samples)

            def propagate(part: np.ndarray) -> None:
                offset = None if offset_px is None else offset_px[part]
                out[part] = operator.stamps(coefficients[part], offset)

            return propagate

        in_batches(self.samples(coefficients, offset_px), self._batch, self._threads, prepare)
        return out

    def derivatives(
        self,
        coefficients: np.ndarray,
        directions: np.ndarray,
        offset_px: np.ndarray | None = None,
        samples: np.ndarray | None = None,
        places: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives along directions (B, K, J); raises as `samples`.

        `samples` (B,) are pupil samples, by default as many as the stamps need.
        """
        count, side = directions.shape[1] + 2 * places, self.stamp_px
        stamps = np.empty((len(coefficients), side, side), self._dtype)
        slopes = np.empty((len(coefficients), count, side, side), self._dtype)

        def prepare(samples: int) -> Callable[[np.ndarray], None]:
            operator = self.operator(samples)

            def differentiate(part: np.ndarray) -> None:
                offset = None if offset_px is None else offset_px[part]
                stamps[part], slopes[part] = operator.derivatives(
                    coefficients[part], directions[part], offset, places
                )

            return differentiate

        if samples is None:
            samples = self.samples(coefficients, offset_px)
        in_batches(samples, max(1, self._batch // count), self._threads, prepare)
        return stamps, slopes

    @property
    def _dtype(self) -> np.dtype:
        return self.operator(self.sizes[0]).dtype


def normalise_with_derivatives(
    stamps: np.ndarray, derivatives: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Divide stamps (..., d, d) by their own flux, and differentiate the quotient.

    Returns
    -------
    normalised : ndarray, shape (..., d, d)
        Sum 1.
    derivatives : ndarray, shape (..., K, d, d)
        Of `normalised`; each sums to 0.
    flux : ndarray, shape (...)
    """
    flux = stamps.sum(axis=(-2, -1))
    normalised = stamps / flux[..., None, None]
    change = derivatives.sum(axis=(-2, -1))[..., None, None]
    slope = (derivatives - normalised[..., None, :, :] * change) / flux[..., None, None, None]
    return normalised, slope, flux
