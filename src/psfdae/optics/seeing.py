"""Stamps blurred by a long exposure through the atmosphere.

The blur is a convolution with a round profile, the same over the whole field. It multiplies
the transfer function, as the pixel does: on the lags l of the pupil's samples

    |E(u)|² = Σ_l c_l exp(−πi l·spacing·u)

(`psfdae.optics.derivatives.PeriodSampling`), and stamps are the sums of c_l times the
transfer functions of profile and pixel. Nothing is cut off or interpolated, but the image
is periodic with the period of the pupil grid, and so are the wings of the profile
(`Profile.reach`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from psfdae.optics.propagation import FieldPropagator, Precision, real_dtype
from psfdae.optics.pupil import Pupil
from psfdae.optics.wavefronts import legendre


@dataclass(frozen=True)
class Profile:
    """Round profile of sum 1: Moffat (1969, A&A 3, 455), or a Gaussian.

    Attributes
    ----------
    fwhm : float
        Full width at half maximum in λ/D.
    beta : float or None
        Exponent of (1 + r²/a²)^−β, above 1; None for the Gaussian.
    """

    fwhm: float
    beta: float | None = None
    negligible_wing: ClassVar[float] = 1e-4
    """Fraction of the profile's maximum below which wings of the next period are negligible.

    They add some 1e-5 of the light to single pixels at the edge of a stamp, an MSE of 1e-10.
    """

    @property
    def scale(self) -> float:
        """Core radius a, or the Gaussian's standard deviation, in λ/D."""
        # Half of the maximum at half of the FWHM.
        if self.beta is None:
            return float(self.fwhm / np.sqrt(8.0 * np.log(2.0)))
        return float(0.5 * self.fwhm / np.sqrt(2.0 ** (1.0 / self.beta) - 1.0))

    def transfer(self, frequency: np.ndarray) -> np.ndarray:
        """Return the Fourier transform at frequencies in cycles per λ/D, 1 at 0; any shape.

        The transform of the Moffat profile is 2 (z/2)^ν K_ν(z) / Γ(ν) with ν = β − 1, z = 2πaf.
        """
        # The Gaussian exp(−r²/2σ²) has the transform exp(−(2πσf)²/2).
        z = 2.0 * np.pi * self.scale * frequency
        if self.beta is None:
            return np.exp(-0.5 * z**2)
        from scipy.special import gamma, kv

        # K_ν is infinite at 0; the limit there is 1.
        order, is_zero = self.beta - 1.0, z == 0.0
        z = np.where(is_zero, 1.0, z)
        return np.where(is_zero, 1.0, 2.0 * (0.5 * z) ** order * kv(order, z) / gamma(order))

    @property
    def reach(self) -> float:
        """Radius in λ/D at which the profile has fallen to `negligible_wing` of its maximum."""
        # The radius r of exp(−r²/2σ²) or (1 + r²/a²)^−β = wing.
        if self.beta is None:
            return float(self.scale * np.sqrt(-2.0 * np.log(self.negligible_wing)))
        return float(self.scale * np.sqrt(self.negligible_wing ** (-1.0 / self.beta) - 1.0))


@dataclass(frozen=True)
class Broadening:
    """Derivative of a profile with respect to the logarithm of its width, in place of a profile.

    A stamp is linear in the profile's transfer function: a stamp that is "blurred" by this
    derivative is the derivative of the stamp.
    """

    profile: Profile

    def transfer(self, frequency: np.ndarray) -> np.ndarray:
        """Return the derivative of the transfer function, 0 at 0."""
        # Central difference over ± 0.1 % of the width.
        step = 1e-3
        broad, narrow = (
            replace(self.profile, fwhm=self.profile.fwhm * np.exp(change)).transfer(frequency)
            for change in (step, -step)
        )
        # d/d ln(width), because the widths are scaled by exp(± step).
        return np.asarray((broad - narrow) / (2.0 * step))


class WholePeriod:
    """Fields over the whole period of the image, by Fourier transforms.

    Part of a `psfdae.optics.derivatives.Sampling`.

    Parameters
    ----------
    pupil : Pupil
        Pupil whose fields are propagated.
    precision : "complex64" or "complex128"
        Precision of the fields.
    """

    product_cost = 0.6
    propagator = None

    def __init__(self, pupil: Pupil, precision: Precision) -> None:
        from scipy import fft  # here, because every configuration knows the profiles

        self.dtype = real_dtype(precision)
        self._axis = pupil.axis
        # Twice as many points as samples determine the intensity.
        self.points = fft.next_fast_len(2 * pupil.axis.size)

    def along_x(self, pupil_fields: np.ndarray, degrees: Sequence[int] = (0,)) -> np.ndarray:
        """Propagate along x as `Sampling` does, to m = `points` points."""
        return self._transform(pupil_fields, degrees, -1)

    def along_y(self, rows: np.ndarray, degrees: Sequence[int] = (0,)) -> np.ndarray:
        """Propagate along y as `Sampling` does."""
        return self._transform(rows, degrees, -2)

    def _transform(self, fields: np.ndarray, degrees: Sequence[int], axis: int) -> np.ndarray:
        """Return fields (B, ., .) times Legendre polynomials, transformed along an axis."""
        from scipy import fft

        # Zeros after the samples of the pupil, up to the number of points.
        shape = [len(degrees), *fields.shape]
        shape[axis] = self.points
        padded_fields = np.zeros(shape, fields.dtype)
        # The axis that is transformed comes last.
        along = padded_fields if axis == -1 else padded_fields.swapaxes(-1, -2)
        lit = along[..., : len(self._axis)]
        values = fields if axis == -1 else fields.swapaxes(-1, -2)
        # P_0 = 1 needs no product.
        if max(degrees):
            weights = legendre(degrees, self._axis).astype(self.dtype)
            np.multiply(values, weights[:, None, None], out=lit)
        else:
            lit[:] = values
        return np.asarray(fft.fft(padded_fields, axis=axis, overwrite_x=True))


class BlurredSampling(WholePeriod):
    """Whole period of the image, blurred; a `psfdae.optics.derivatives.Sampling`.

    Parameters
    ----------
    pupil : Pupil
        Pupil whose fields are propagated.
    stamp_px : int
        Pixels d along a side.
    pixel : float
        Pixel width in λ/D.
    profile : Profile or Broadening
        Blur, or its derivative with respect to the logarithm of the width.
    precision : "complex64" or "complex128"
        Precision of the fields.
    """

    def __init__(
        self,
        pupil: Pupil,
        stamp_px: int,
        pixel: float,
        profile: Profile | Broadening,
        precision: Precision,
    ) -> None:
        from scipy import fft

        super().__init__(pupil, precision)
        # Cycles per pixel of the lags l along rows and columns. The image is real: lags of one
        # sign along the columns represent both signs and have twice the weight.
        # Lag k has the frequency ½ k · spacing in cycles per λ/D; fftfreq gives k/n.
        n = self.points
        step = 0.5 * pupil.spacing * pixel * n
        rows, columns = step * fft.fftfreq(n)[:, None], step * fft.rfftfreq(n)
        multiplicity = np.where(columns == 0.0, 1.0, 2.0)
        # Transfer functions of the pixel and of the profile.
        blur = profile.transfer(np.hypot(rows, columns) / pixel)
        weights = multiplicity * (pixel / n) ** 2 * np.sinc(rows) * np.sinc(columns)
        self._transfer = (weights * blur).astype(self.dtype)
        # The inverse transform from the lags only to the centres of the pixels.
        centres = np.arange(stamp_px) - 0.5 * (stamp_px - 1)
        self._to_rows, self._to_columns = (
            np.exp(2j * np.pi * np.outer(centres, frequency)).astype(precision)
            for frequency in (rows.ravel(), columns)
        )

    def to_pixels(self, values: np.ndarray) -> np.ndarray:
        """Return pixels (..., d, d) of intensities (..., n, n)."""
        from scipy import fft

        # Lags c_l of the intensity times the transfer functions.
        spectrum = fft.rfft2(values) * self._transfer
        return np.asarray(((self._to_rows @ spectrum) @ self._to_columns.T).real)


class BlurredPropagator(FieldPropagator):
    """Propagator from OPD maps to blurred stamps, with the parameters of `StampPropagator`.

    Works with numpy only, in any number of threads.
    """

    def __init__(
        self,
        pupil: Pupil,
        stamp_px: int,
        pixel: float,
        profile: Profile,
        precision: Precision = "complex128",
    ) -> None:
        sampling = BlurredSampling(pupil, stamp_px, pixel, profile, precision)
        super().__init__(pupil, sampling, pixel)
