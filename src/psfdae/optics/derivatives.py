"""Stamps and their derivatives with respect to coefficients of pupil modes.

The OPD is a sum of modes, W = Σ c_j M_j. The field in the image is, as in
`psfdae.optics.propagation`, E = Σ A exp(2πiW) exp(−πiu·x). A direction v in the
space of coefficients changes it by dE = Σ 2πi (Σ v_j M_j) A exp(2πiW) exp(−πiu·x),
another sum of this form, and the intensity by d|E|² = 2 Re(E* dE): derivatives are exact.
Modes are polynomials of the pupil's coordinates, sums of products P_a(x) P_b(y) of Legendre
polynomials. The field of such a product is two matrix products with weighted matrices; the products
along x are shared by all b, so that all directions together take the time of a few stamps. Where
directions are few and modes many, a field for each direction takes less time.

There are four ways from the pupil to the pixels, each of them a `propagation.Sampling`:

- `PointSampling`: the points of `StampPropagator` and a matrix DFT, for stamps
  narrower than the image's period;
- `ImageSampling`: the same points; derivatives from the field in the image, with an error of 2e-4
  in half of the time or less;
- `PeriodSampling`: the whole period of the image by a Fourier transform. The
  intensity is a trigonometric polynomial, which its samples determine, so pixels
  are integrated exactly. It is faster for stamps nearly as wide as the period;
- `psfdae.optics.seeing.BlurredSampling`: the same period, blurred by the atmosphere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from psfdae.optics.propagation import (
    FieldPropagator,
    Precision,
    Sampling,
    StampPropagator,
    image_points,
    real_dtype,
    run_grids,
)
from psfdae.optics.pupil import Pupil, annular_pupil, choose_samples, count_samples
from psfdae.optics.seeing import WholePeriod
from psfdae.optics.wavefronts import (
    PupilModes,
    legendre,
    legendre_expansion,
    mode_slopes,
    slope_ranges,
)

StampsAndSlopes = tuple[np.ndarray, np.ndarray]
"""Stamps (B, d, d), or intensities at points, and derivatives of the stamps, (B, K, d, d)."""


class SeparableSampling:
    """Sampling in which one matrix P (d, m) converts intensities I to pixels, P I Pᵀ."""

    pixel_weights: np.ndarray
    dtype: np.dtype

    def to_pixels(self, values: np.ndarray) -> np.ndarray:
        """Return pixels as `Sampling` does."""
        return np.asarray(self.pixel_weights @ (values @ self.pixel_weights.T))


class PointSampling(SeparableSampling):
    """Points of `image_points` on both sides of the chief ray, with its parameters.

    Pupil and points are symmetric about the chief ray. Even and odd parts of the pupil fields
    are multiplied by cosines or sines, so that products are real and a quarter as large.
    """

    product_cost = 0.1

    def __init__(self, pupil: Pupil, stamp_px: int, pixel: float, precision: Precision) -> None:
        self.dtype = real_dtype(precision)
        # Points on one side of the chief ray; the points on the other side mirror them.
        half, even_weights, odd_weights = image_points(pupil, stamp_px, pixel)
        # Cosines and sines over half of the pupil. The middle sample of an odd grid is its own
        # mirror image and counts once.
        self._samples = (pupil.axis.size + 1) // 2
        self._axis = pupil.axis[-self._samples :]
        multiplicity = np.where(self._axis == 0.0, 0.5, 1.0)[:, None]
        angle = np.pi * np.outer(self._axis, half)
        self._waves = np.stack([np.cos(angle), np.sin(angle)]) * multiplicity
        # Weights of the pixels above the chief ray, and mirrored ones for the pixels below; the
        # middle pixel of an odd stamp is its own mirror image.
        mirror_weights = (even_weights - odd_weights)[::-1]
        above = 0.5 * np.hstack([mirror_weights.T, (even_weights + odd_weights).T])
        below = above[::-1, ::-1][: stamp_px // 2]
        self.pixel_weights = np.vstack([below, above]).astype(self.dtype)
        # Waves times P_a(x), by the degree a.
        self._weighted_waves: dict[int, np.ndarray] = {}
        self.propagator = StampPropagator(pupil, stamp_px, pixel, precision=precision)

    def along_x(self, pupil_fields: np.ndarray, degrees: Sequence[int] = (0,)) -> np.ndarray:
        """Propagate along x as `Sampling` does, to all points."""
        # Even and odd parts of the field; real and imaginary parts as rows of one matrix.
        mirror_fields = pupil_fields[..., self._samples - 1 :: -1]
        upper_fields = pupil_fields[..., -self._samples :]
        parts = [
            np.stack([part.real, part.imag]).reshape(-1, self._samples)
            for part in (upper_fields + mirror_fields, upper_fields - mirror_fields)
        ]
        shape = (2, *pupil_fields.shape[:-1], -1)
        fields = []
        # Waves times P_a are made once for each degree, and kept.
        for degree in degrees:
            # An even polynomial keeps the parity, an odd one changes it: the even part of the
            # product is multiplied by cosines, the odd part by sines.
            if degree not in self._weighted_waves:
                weighted_waves = legendre([degree], self._axis)[0][:, None] * self._waves
                self._weighted_waves[degree] = weighted_waves.astype(self.dtype)
            # Sums over half of the pupil: C of the product's even part, S of its odd part.
            cosine_waves, sine_waves = self._weighted_waves[degree]
            cos_re, cos_im = (parts[degree % 2] @ cosine_waves).reshape(shape)
            sin_re, sin_im = (parts[(degree + 1) % 2] @ sine_waves).reshape(shape)
            # C − iS at the points above the chief ray, C + iS below.
            points = cos_re.shape[-1]
            field_shape = (*cos_re.shape[:-1], 2 * points)
            field = np.empty(field_shape, np.result_type(cos_re, np.complex64))
            above, below = field[..., points:], field[..., points - 1 :: -1]
            above.real, above.imag = cos_re + sin_im, cos_im - sin_re
            below.real, below.imag = cos_re - sin_im, cos_im + sin_re
            fields.append(field)
        return np.stack(fields)

    def along_y(self, rows: np.ndarray, degrees: Sequence[int] = (0,)) -> np.ndarray:
        """Propagate along y as `Sampling` does."""
        # Transposed, so that both directions use the same products.
        return self.along_x(rows.swapaxes(-1, -2), degrees).swapaxes(-1, -2)


class ImageSampling(PointSampling):
    """Points of `PointSampling`, from whose fields the derivatives follow, with its parameters.

    A polynomial times the pupil field gives a derivative of the image's field, a linear combination
    of its values: with waves V = exp(−πi x u) of pupil samples x and points u, P_a V ≈ V Q_aᵀ. The
    matrices Q_a of least squares are real for even a, and imaginary for odd a.
    """

    def __init__(self, pupil: Pupil, stamp_px: int, pixel: float, precision: Precision) -> None:
        super().__init__(pupil, stamp_px, pixel, precision)
        self._pupil_axis = pupil.axis
        half, _, _ = image_points(pupil, stamp_px, pixel)
        self._all_waves = np.exp(-1j * np.pi * np.outer(pupil.axis, [*-half[::-1], *half]))
        self._matrices: dict[int, np.ndarray] = {}

    def _combine(self, degree: int) -> np.ndarray:
        """Return Q_a, or Q_a / i for an odd degree a; it is kept."""
        if degree not in self._matrices:
            # Small singular values are left out: they would amplify rounding.
            weighted_waves = legendre([degree], self._pupil_axis)[0][:, None] * self._all_waves
            matrix = np.linalg.lstsq(self._all_waves, weighted_waves, rcond=1e-5)[0].T
            part = matrix.imag if degree % 2 else matrix.real
            self._matrices[degree] = part.astype(self.dtype)
        return self._matrices[degree]

    def differentiate(
        self, pupil_fields: np.ndarray, degrees: Mapping[int, Sequence[int]]
    ) -> tuple[np.ndarray, dict[tuple[int, int], np.ndarray]]:
        """Return intensities at the points, and pixels of Im E Re G − Re E Im G of products.

        G is the field of P_a(x) P_b(y); `degrees` has all b of each a.
        """
        (rows,) = self.along_x(pupil_fields)
        (field,) = self.along_y(rows)
        image, slopes = np.stack([field.real, field.imag]), {}
        for a, y_degrees in degrees.items():
            along_x = image @ self._combine(a).T
            for b in y_degrees:
                real, imaginary = self._combine(b) @ along_x
                # Each odd degree has a factor i.
                if (a + b) % 2:
                    slope = image[1] * -imaginary - image[0] * real
                else:
                    sign = -1.0 if a % 2 else 1.0
                    slope = sign * (image[1] * real - image[0] * imaginary)
                slopes[a, b] = self.to_pixels(slope)
        return image[0] ** 2 + image[1] ** 2, slopes


class PeriodSampling(SeparableSampling, WholePeriod):
    """Equidistant points over the period of the image, 2/spacing λ/D.

    With lags l of the pupil's samples, |E(u)|² = Σ_l c_l exp(−πi l·spacing·u); the
    integral over a pixel multiplies c_l by the pixel's width and a sinc. Twice as
    many points as samples determine all c_l. Pixels outside of the period repeat the
    pixels inside.
    """

    def __init__(self, pupil: Pupil, stamp_px: int, pixel: float, precision: Precision) -> None:
        super().__init__(pupil, precision)
        # Lags between samples, as frequencies of the image in cycles per λ/D.
        samples = pupil.axis.size
        lags = np.arange(1 - samples, samples)
        frequency = 0.5 * pupil.spacing * lags
        centres = (np.arange(stamp_px) - 0.5 * (stamp_px - 1)) * pixel
        # From the points to c_l, and from c_l to the pixels.
        from_points = np.exp(2j * np.pi * np.outer(lags, np.arange(self.points)) / self.points)
        waves = np.exp(-2j * np.pi * np.outer(centres, frequency))
        to_pixels = pixel * np.sinc(frequency * pixel) * waves
        # A shift of the image by a pixel's width multiplies c_l by a phase; this is its derivative.
        to_slopes = to_pixels * (2j * np.pi * pixel * frequency)
        self.pixel_weights, self._slope_weights = (
            ((matrix @ from_points).real / self.points).astype(self.dtype)
            for matrix in (to_pixels, to_slopes)
        )

    def position_slopes(self, values: np.ndarray) -> np.ndarray:
        """Return derivatives with respect to the position along x and y, per pixel, (B, 2, d, d).

        `values` (B, m, m) are the intensities at the points.
        """
        # Product rule: along one axis the derivative, along the other the pixel itself.
        along_x = self.pixel_weights @ (values @ self._slope_weights.T)
        along_y = self._slope_weights @ (values @ self.pixel_weights.T)
        return np.stack([along_x, along_y], axis=1)


class ModalStamps:
    """Stamps of wavefronts that are sums of pupil modes, and their derivatives.

    Parameters
    ----------
    pupil : Pupil
        Transmission on an M × M grid.
    modes : PupilModes
        Function that returns the J modes at pupil points.
    sampling : Sampling
        Points of the image, made for the same pupil.
    pixel : float
        Pixel width in λ/D; the unit of offsets.
    """

    def __init__(self, pupil: Pupil, modes: PupilModes, sampling: Sampling, pixel: float) -> None:
        self.dtype = dtype = sampling.dtype
        self.shape = pupil.amplitude.shape
        self._sampling = sampling
        self._propagator = FieldPropagator(pupil, sampling, pixel)
        # Images of the modes as rows of a matrix.
        images = modes(pupil.axis[None, :], pupil.axis[:, None])
        self._modes = np.ascontiguousarray(images.reshape(len(images), -1), dtype)
        # Modes as sums of products P_a(x) P_b(y), for derivatives along many directions.
        degrees, coefficients = legendre_expansion(modes)
        self._coefficients = coefficients.astype(dtype)
        # Degrees (a, b) of the Legendre products in the modes.
        self._products = [*map(tuple, degrees)]
        # Degrees along y for each degree along x; the constant comes first, it is the field itself.
        self._degrees = {0: [0]}
        for a, b in sorted(self._products):
            self._degrees.setdefault(a, []).append(b)

    def stamps(self, coefficients: np.ndarray, offset_px: np.ndarray | None = None) -> np.ndarray:
        """Compute the stamps of a batch.

        Parameters
        ----------
        coefficients : ndarray, shape (B, J)
            Coefficients of the modes in waves.
        offset_px : ndarray, shape (B, 2), optional
            Position (row, column) of the stamp's centre from the chief ray, in pixels.

        Returns
        -------
        ndarray, shape (B, d, d)
            Fraction of the light through the pupil on each pixel.
        """
        return self._propagator(self.opd(coefficients), offset_px)

    def derivatives(
        self,
        coefficients: np.ndarray,
        directions: np.ndarray,
        offset_px: np.ndarray | None = None,
        by_position: bool = False,
    ) -> StampsAndSlopes:
        """Compute stamps of a batch and their derivatives along directions of the coefficients.

        Parameters
        ----------
        coefficients : ndarray, shape (B, J)
            Coefficients of the modes in waves.
        directions : ndarray, shape (B, K, J), or (1, K, J) for all stamps
            Changes of the coefficients per unit parameter, the Jacobian's transpose.
        offset_px : ndarray, shape (B, 2), optional
            As in `stamps`; kept fixed.
        by_position : bool
            Add two derivatives, with respect to the position of the image along x and y in pixels.
            They follow from the image and take little time; needs a `PeriodSampling`.

        Returns
        -------
        stamps : ndarray, shape (B, d, d)
        derivatives : ndarray, shape (B, K, d, d), or (B, K + 2, d, d) with `by_position`
            Per unit parameter.
        """
        directions = directions.astype(self.dtype)
        pupil_fields = self._propagator.pupil_fields(self.opd(coefficients), offset_px)
        # The cheaper way: a field for each direction, or for each product of polynomials.
        if directions.shape[1] < self._sampling.product_cost * len(self._products):
            intensity, slopes = self._use_directions(pupil_fields, directions)
        else:
            intensity, slopes = self._use_products(pupil_fields, directions)
        # A shift of the image is a tilt of the wavefront, but needs no additional field.
        if by_position:
            assert isinstance(self._sampling, PeriodSampling)
            slopes = np.concatenate([slopes, self._sampling.position_slopes(intensity)], axis=1)
        return self._sampling.to_pixels(intensity), slopes

    def _use_directions(self, pupil_fields: np.ndarray, directions: np.ndarray) -> StampsAndSlopes:
        """Return intensities at the points, and slopes of the pixels by a field per direction."""
        sampling, (count, *shape) = self._sampling, pupil_fields.shape
        # Pupil fields, and their products with the OPD of each direction: E and G, dE = 2πi G.
        fields = np.empty((count, 1 + directions.shape[1], *shape), pupil_fields.dtype)
        fields[:, 0] = pupil_fields
        opd = (directions @ self._modes).reshape(*directions.shape[:2], *shape)
        np.multiply(pupil_fields[:, None], opd, out=fields[:, 1:])
        # All of them are propagated as one batch.
        (rows,) = sampling.along_x(fields.reshape(-1, *shape))
        (images,) = sampling.along_y(rows)
        images = images.reshape(*fields.shape[:2], *images.shape[1:])
        image, *changes = np.moveaxis(images, 1, 0)
        # 2 Re(E* dE) = 4π Re(i E* G) = 4π (Im E Re G − Re E Im G).
        slopes = np.empty((count, len(changes), *image.shape[1:]), self.dtype)
        for k, change in enumerate(changes):
            slopes[:, k] = image.imag * change.real - image.real * change.imag
        return image.real**2 + image.imag**2, (4.0 * np.pi) * sampling.to_pixels(slopes)

    def _use_products(self, pupil_fields: np.ndarray, directions: np.ndarray) -> StampsAndSlopes:
        """Return intensities and slopes as above, by a field per product of polynomials."""
        sampling = self._sampling
        slopes: dict[tuple[int, int], np.ndarray] = {}
        if isinstance(sampling, ImageSampling):
            intensity, slopes = sampling.differentiate(pupil_fields, self._degrees)
        else:
            rows_of_degrees = sampling.along_x(pupil_fields, [*self._degrees])
            for (a, y_degrees), rows in zip(self._degrees.items(), rows_of_degrees, strict=True):
                # P_a(x) along x is shared by all P_b(y); P_0 P_0 is the field itself.
                changes = sampling.along_y(rows, y_degrees)
                if a == 0:
                    image = changes[0]
                for b, change in zip(y_degrees, changes, strict=True):
                    # Im E Re G − Re E Im G, as by direction; stored as pixels, which are fewer.
                    slope = image.imag * change.real - image.real * change.imag
                    slopes[a, b] = sampling.to_pixels(slope)
            intensity = image.real**2 + image.imag**2
        # Slopes along a direction are sums of the products' slopes times their coefficients in it.
        weights = directions @ self._coefficients
        by_product = [slopes[degrees] for degrees in self._products]
        product_slopes = (4.0 * np.pi) * np.stack(by_product, axis=1)
        flat = weights @ product_slopes.reshape(*product_slopes.shape[:2], -1)
        shape = (len(product_slopes), weights.shape[1], *product_slopes.shape[2:])
        return intensity, flat.reshape(shape)

    def opd(self, coefficients: np.ndarray) -> np.ndarray:
        """Return OPD maps in waves, shape (B, M, M)."""
        # W = Σ c_j M_j at all samples, as one matrix product.
        opd = np.asarray(coefficients, self._modes.dtype) @ self._modes
        return np.asarray(opd.reshape(-1, *self.shape))


class SampledStamps:
    """Stamps of sums of modes, each on the smallest pupil grid that its slopes allow.

    Batches run in parallel threads; results do not depend on the number of threads.

    Parameters
    ----------
    obscuration : float
        Linear central obscuration of the pupil.
    modes : PupilModes
        Function that returns the J modes at pupil points.
    sampling : callable
        Function of pupil, stamp_px, pixel and the keyword precision that returns a `Sampling`.
    stamp_px : int
        Pixels d along a side.
    pixel : float
        Pixel width in λ/D.
    precision : "complex64" or "complex128"
        Precision of the fields.
    sizes : sequence of int
        Pupil samples N to choose from, ascending.
    reach : float
        Distance in λ/D around a stamp from which blur brings light into it.
    batch, threads : int
        Number of stamps or derivatives in a batch, and of batches at once.
    """

    def __init__(
        self,
        obscuration: float,
        modes: PupilModes,
        sampling: Callable[..., Sampling],
        stamp_px: int,
        pixel: float,
        precision: Precision,
        sizes: Sequence[int],
        reach: float = 0.0,
        batch: int = 16,
        threads: int = 1,
    ) -> None:
        self.stamp_px, self.pixel, self.sizes, self.reach = stamp_px, pixel, tuple(sizes), reach
        self._obscuration, self._modes, self._sampling = obscuration, modes, sampling
        self._precision, self._batch, self._threads = precision, batch, threads
        self._dtype = real_dtype(precision)
        # Slopes of the modes determine the grid that a wavefront needs.
        self._slopes = mode_slopes(modes)
        self._operators: dict[int, ModalStamps] = {}

    def operator(self, samples: int) -> ModalStamps:
        """Return the operator on a pupil grid with N samples across; it is cached."""
        if samples not in self._operators:
            # The grid, the points of its image, and the modes on it.
            pupil = annular_pupil(samples, self._obscuration)
            sampling = self._sampling(pupil, self.stamp_px, self.pixel, precision=self._precision)
            self._operators[samples] = ModalStamps(pupil, self._modes, sampling, self.pixel)
        return self._operators[samples]

    def samples(self, coefficients: np.ndarray, offset_px: np.ndarray | None = None) -> np.ndarray:
        """Return the pupil samples N of each wavefront, (B,), for coefficients (B, J).

        For the offsets see `ModalStamps.stamps`.

        Raises
        ------
        SamplingError
            If a wavefront needs more samples than the largest grid has.
        """
        offset_px = np.zeros((len(coefficients), 2)) if offset_px is None else offset_px
        # Edges of the stamp along x and y in λ/D, extended by the reach of the blur.
        half = np.array([-0.5, 0.5]) * self.stamp_px
        edges = (offset_px[:, ::-1, None] + half) * self.pixel
        edges = edges + np.array([-self.reach, self.reach])
        # The slopes of each wavefront determine its grid.
        min_samples = count_samples(slope_ranges(self._slopes, coefficients), edges)
        return choose_samples(min_samples, self.sizes)

    def stamps(self, coefficients: np.ndarray, offset_px: np.ndarray | None = None) -> np.ndarray:
        """Return stamps as `ModalStamps.stamps` does; raises as `samples`."""
        stamps = np.empty((len(coefficients), self.stamp_px, self.stamp_px), self._dtype)

        def propagate(operator: ModalStamps, batch: np.ndarray) -> None:
            offset = None if offset_px is None else offset_px[batch]
            stamps[batch] = operator.stamps(coefficients[batch], offset)

        self._run(propagate, self.samples(coefficients, offset_px), self._batch)
        return stamps

    def derivatives(
        self,
        coefficients: np.ndarray,
        directions: np.ndarray,
        offset_px: np.ndarray | None = None,
        samples: np.ndarray | None = None,
        by_position: bool = False,
    ) -> StampsAndSlopes:
        """Return stamps and derivatives along directions (B, K, J), as `ModalStamps` does.

        The argument `samples` (B,) sets the pupil samples, by default as many as the stamps need.
        Raises as the method `samples`.
        """
        side = self.stamp_px
        count = directions.shape[1] + 2 * by_position
        stamps = np.empty((len(coefficients), side, side), self._dtype)
        slopes = np.empty((len(coefficients), count, side, side), self._dtype)

        def differentiate(operator: ModalStamps, batch: np.ndarray) -> None:
            offset = None if offset_px is None else offset_px[batch]
            wavefronts = coefficients[batch], directions[batch], offset
            stamps[batch], slopes[batch] = operator.derivatives(*wavefronts, by_position)

        # A wavefront with K derivatives counts as K stamps in the size of a batch.
        samples = self.samples(coefficients, offset_px) if samples is None else samples
        self._run(differentiate, samples, max(1, self._batch // count))
        return stamps, slopes

    def _run(self, work: Callable[..., None], samples: np.ndarray, size: int) -> None:
        """Call `work` with the operator and the numbers of each batch of wavefronts."""
        run_grids(samples, size, self._threads, lambda n: partial(work, self.operator(n)))


def normalise_with_derivatives(
    stamps: np.ndarray, derivatives: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Divide stamps p (..., d, d) by their flux f = Σ p, and differentiate the quotient.

    Returns
    -------
    unit_stamps : ndarray, shape (..., d, d)
        Stamps of sum 1.
    derivatives : ndarray, shape (..., K, d, d)
        (∂p − (p/f) ∂f)/f; each sums to 0.
    flux : ndarray, shape (...)
        Sum f of each stamp.
    """
    # Derivative of the quotient p/f: (∂p − (p/f) ∂f)/f.
    flux = stamps.sum(axis=(-2, -1))
    unit_stamps = stamps / flux[..., None, None]
    flux_slope = derivatives.sum(axis=(-2, -1))[..., None, None]
    slope = (derivatives - unit_stamps[..., None, :, :] * flux_slope) / flux[..., None, None, None]
    return unit_stamps, slope, flux
