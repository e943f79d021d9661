"""Stamps of stars as functions of their aberrations, and the posterior of the aberrations.

The input is standardised Seidel coefficients, fields and stamp offsets, the output propagated
stamps and their derivatives by the coefficients. All searches and samples of a posterior use them.

Propagation and derivatives are the library's (`psfdae.optics`). The parameters are not the
parameters of `psfdae.sensing.stars.StarOptics`: a simulated stamp has the sum 1, stands at whole
pixels about its brightest one, and is moved by distortion; a star of an image has a position, a
flux and a sky of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import get_args

import numpy as np

from psfdae.optics.derivatives import PointSampling, SampledStamps, normalise_with_derivatives
from psfdae.optics.propagation import Precision
from psfdae.optics.wavefronts import MONOMIALS, monomial_coefficients, monomial_images
from psfdae.telescope.settings import Telescope
from psfdae_paper.bounds.posterior import Likelihood
from psfdae_paper.configuration.schema import Framing, Optics
from psfdae_paper.stars.framing import normalise_flux


@dataclass(frozen=True)
class StampModel:
    """Stamps as functions of standardised coefficients z, c = mean + sd z, with z ~ N(0, 1).

    Attributes
    ----------
    mean, sd : ndarray, shape (5,)
        Prior of the coefficients in waves (`psfdae_paper.stars.fields.perturb`).
    field : ndarray, shape (F, 2)
        Relative field vectors.
    telescope, optics, framing : Telescope, Optics, Framing
        Groups of the configuration.
    max_abs_z : float
        Maximum of |z|; draws outside it get weight 0. The prior probability outside it is 2e-9; the
        tails of the proposals reach aberrations that cannot be propagated.
    is_coarse : bool
        True if wavefronts with small slopes may have fewer than 126 pupil samples.
    """

    mean: np.ndarray
    sd: np.ndarray
    field: np.ndarray
    telescope: Telescope
    optics: Optics
    framing: Framing
    max_abs_z: float = 6.0
    is_coarse: bool = False

    def coarsen(self, likelihood: Likelihood) -> StampModel:
        """Return the model on coarser pupil grids if their error is far below the noise.

        Stamps on the coarsest grids that the sampling guard allows differ from stamps with N = 318
        by an MSE ε of 4e-10 on average.
        """
        # Change of χ² by the error, Σ ε F²/B with the smallest variance of a pixel, the sky's B.
        pixels = self.framing.stamp_px**2
        chi2_change = pixels * 4e-10 * likelihood.flux**2 / likelihood.background
        return self._coarse_model if chi2_change < 0.1 else self

    @cached_property
    def _coarse_model(self) -> StampModel:
        """The same model on coarser pupil grids, kept with its propagators."""
        return replace(self, is_coarse=True)

    def standardise(self, seidel: np.ndarray) -> np.ndarray:
        """Return z of coefficients in waves, both (n, 5); 0 where they cannot vary."""
        # z = (c − mean) / sd
        varies = self.sd > 0
        return np.where(varies, (seidel - self.mean) / np.where(varies, self.sd, 1.0), 0.0)

    def coefficients(self, z: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Return monomial coefficients in waves, shape (n, 8), of z (n, 5) at fields (n,)."""
        return monomial_coefficients(self.mean + self.sd * z, self.field[field])

    def directions(self, field: np.ndarray) -> np.ndarray:
        """Return the change of the monomials' coefficients by z at fields (n,), shape (n, 5, 8)."""
        # Coefficients are linear in the Seidel terms: a unit of z_k changes them as sd_k waves do.
        return monomial_coefficients(np.diag(self.sd), self.field[field][:, None])

    def tilt_coefficients(self, shift_px: np.ndarray) -> np.ndarray:
        """Return the coefficients (n, 8) that move a stamp by pixels (row, column), (n, 2).

        A pixel is a tilt by half its width in λ/D (`StampPropagator`).
        """
        tilt = np.zeros((len(shift_px), len(MONOMIALS)))
        # The last two monomials are x and y; columns run along x and rows along y.
        tilt[:, -2:] = 0.5 * self.telescope.pixel * shift_px[:, ::-1]
        return tilt

    def stamps(self, z: np.ndarray, field: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Propagate stamps of sum 1 in single precision.

        Parameters
        ----------
        z : ndarray, shape (n, 5)
            Standardised coefficients.
        field : ndarray of int, shape (n,)
            Field of every stamp.
        offset : ndarray, shape (n, 2)
            Middle of the stamp (row, column) from the chief ray, in pixels.

        Returns
        -------
        ndarray, shape (n, d, d), float32
        """
        stamps = self._operators["complex64"].stamps(self.coefficients(z, field), offset)
        # Light outside the stamp is lost: the sum is normalised to 1, as for all stamps.
        return normalise_flux(stamps)[0]

    def derivatives(
        self,
        coefficients: np.ndarray,
        directions: np.ndarray,
        offset: np.ndarray,
        samples: np.ndarray | None = None,
        precision: Precision = "complex64",
    ) -> tuple[np.ndarray, np.ndarray]:
        """Propagate stamps of sum 1 and their derivatives, both in float64.

        Parameters
        ----------
        coefficients : ndarray, shape (n, 8)
            Coefficients of the monomials in waves.
        directions : ndarray, shape (n, K, 8)
            Change of the coefficients by each of K parameters.
        offset : ndarray, shape (n, 2)
            Middle of the stamp (row, column) from the chief ray, in pixels.
        samples : ndarray of int, shape (n,), optional
            Pupil samples; by default as many as the stamps need.
        precision : str
            Precision of the propagation.

        Returns
        -------
        stamps : ndarray, shape (n, P)
        derivatives : ndarray, shape (n, K, P)
        """
        # The sum of a stamp depends on the parameters, too: normalising changes the derivatives.
        raw = self._operators[precision].derivatives(coefficients, directions, offset, samples)
        stamps, slopes, _ = normalise_with_derivatives(*raw)
        return (
            stamps.reshape(len(offset), -1).astype(np.float64),
            slopes.reshape(*directions.shape[:2], -1).astype(np.float64),
        )

    @cached_property
    def _operators(self) -> dict[Precision, SampledStamps]:
        """Propagators by precision, on the smallest pupil grid that the sampling guard allows."""
        # Stamps differ from stamps with N = 222 by an MSE of 4e-11 on average and 7e-10 at most.
        pupil_samples = {126, 158, 190, 222, 254, 318, 398, 478, 574, 690, 830, 1000}
        if self.is_coarse:
            pupil_samples |= {62, 78, 94, 110}
        return {
            precision: SampledStamps(
                self.telescope.obscuration,
                monomial_images,
                PointSampling,
                self.framing.stamp_px,
                self.telescope.pixel,
                precision,
                sorted(pupil_samples | {*self.optics.pupil_samples}),
                batch=len(self.sd) * self.optics.batch,
            )
            for precision in get_args(Precision)
        }


@dataclass(frozen=True)
class StarPosteriors:
    """Posteriors of the aberrations of n stars, given their photons.

    Attributes
    ----------
    noisy : ndarray, shape (n, d, d)
        Noisy images of one noise level, flux 1, without sky.
    likelihood : Likelihood
        Likelihood at the stars' noise level.
    model : StampModel
        Prior of the aberrations, and the stamps that they give.
    """

    noisy: np.ndarray
    likelihood: Likelihood
    model: StampModel

    @cached_property
    def counts(self) -> np.ndarray:
        """Photons in every pixel, sky included, shape (n, P)."""
        return self.likelihood.counts(self.noisy)

    def take(self, stars: np.ndarray) -> StarPosteriors:
        """Return the posteriors of the stars with these numbers, in the order given."""
        return StarPosteriors(self.noisy[stars], self.likelihood, self.model)
