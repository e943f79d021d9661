"""Centroid-centred stamps of wavefronts given by Zernike coefficients.

The centroid of an image lies at the mean slope of the wavefront over the lit
pupil. Every Zernike polynomial therefore takes its own tilt along that cancels
its mean slope, once; the centring stays linear in the coefficients, and derivatives
are derivatives of centred stamps.
"""

from __future__ import annotations

from functools import partial
from math import prod

import numpy as np

from psfdae.base.errors import Error
from psfdae.optics.derivatives import PeriodSampling, SampledStamps, normalise_with_derivatives
from psfdae.optics.wavefronts import (
    FIRST_NOLL,
    PupilModes,
    movable_modes,
    noll_to_nm,
    radial_polynomial,
    zernike,
)
from psfdae.telescope.settings import Telescope
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.schema import WholePeriodOptics
from psfdae_paper.stars.framing import normalise_flux


class EnergyError(Error, ValueError):
    """A stamp holds too little of the light."""


def mean_slope(j: int, obscuration: float) -> tuple[float, float]:
    """Return the mean gradient (x, y) of Noll polynomial j over an annulus, per pupil radius.

    By the divergence theorem it is an integral along the two rims, which vanishes except for terms
    with one cycle per turn, |m| = 1.
    """
    n, m = noll_to_nm(j)
    if abs(m) != 1:
        return 0.0, 0.0
    # With Z = √(2(n + 1)) R(r) cos θ, ∮ Z cos θ dl = π √(2(n + 1)) r R(r) along a rim of radius r.
    # The mean over the annulus of area π (1 − ε²) is the difference of the rims at 1, where R = 1,
    # and at ε.
    radial = radial_polynomial(n, m, np.float64(obscuration))  # type: ignore[arg-type]  # one radius
    inner_rim = obscuration * float(radial)
    slope = float(np.sqrt(2.0 * (n + 1.0)) * (1.0 - inner_rim) / (1.0 - obscuration**2))
    return (slope, 0.0) if m > 0 else (0.0, slope)


def centre_modes(highest: int, obscuration: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the OPD of unit Zernike coefficients with their centring tilts, (highest − 3, ...).

    The OPD is in waves. Its sign turns the lead of a wavefront, which coefficients count, into an
    OPD. Stamps are then seen as the detector shows them: columns run along +x
    and rows along +y, the directions of the field angles.

    Parameters
    ----------
    highest : int
        Highest Noll index; the first is `FIRST_NOLL`.
    obscuration : float
        Linear central obscuration of the pupil that is centred.
    x, y : ndarray, shape (...)
        Pupil coordinates in pupil radii.
    """
    modes = []
    for j in range(FIRST_NOLL, highest + 1):
        # A wavefront Z moves the centroid by its mean slope s: −Z + s·(x, y) leaves it.
        slope_x, slope_y = mean_slope(j, obscuration)
        modes.append(slope_x * x + slope_y * y - zernike(j, x, y))
    return np.stack(modes)


class AlignmentStamps:
    """Operator that turns Zernike coefficients into centred stamps and their derivatives.

    Each wavefront uses the smallest grid size that its slopes allow.
    Batches run in `optics.threads` threads; results do not depend on their number.

    Parameters
    ----------
    telescope : Telescope
        Obscuration and pixel scale of the telescope.
    optics : WholePeriodOptics
        Sampling and precision of the propagation.
    alignment : Alignment
        Size of the stamps, highest Zernike term and minimum light in a stamp.
    movable : bool
        Two more coefficients, the last, move the stamp's star along x and y, in pixels.
    """

    def __init__(
        self,
        telescope: Telescope,
        optics: WholePeriodOptics,
        alignment: Alignment,
        movable: bool = False,
    ) -> None:
        self.alignment, self.movable = alignment, movable
        # Pupil modes whose sum is the OPD of a centred stamp.
        modes: PupilModes = partial(centre_modes, alignment.highest_zernike, telescope.obscuration)
        if movable:
            modes = partial(movable_modes, modes, telescope.pixel)
        # Stamps are nearly as wide as the period of the image, which is transformed whole.
        self.propagation = SampledStamps(
            telescope.obscuration,
            modes,
            PeriodSampling,
            alignment.stamp_px,
            telescope.pixel,
            optics.precision,
            optics.pupil_samples,
            batch=optics.batch,
            threads=optics.threads,
        )

    def __call__(self, zernikes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Propagate flux-normalised stamps.

        Parameters
        ----------
        zernikes : ndarray, shape (..., J)
            Coefficients Noll 4 … 3 + J in waves.

        Returns
        -------
        stamps : ndarray, shape (..., d, d)
            Each sums to 1; in the configured precision.
        energy : ndarray, shape (...)
            Fraction of the light inside the stamp.

        Raises
        ------
        SamplingError
            If a wavefront needs more samples than the largest grid has.
        EnergyError
            If a stamp holds less than `alignment.least_energy`.
        """
        # Flatten the leading axes to one list of wavefronts; then normalise the stamps to flux 1.
        shape = zernikes.shape[:-1]
        raw = self.propagation.stamps(zernikes.reshape(-1, zernikes.shape[-1]))
        stamps, energy = normalise_flux(raw)
        self._check_energy(energy)
        return stamps.reshape(*shape, *stamps.shape[1:]), energy.reshape(shape)

    def derivatives(
        self, zernikes: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Propagate flux-normalised stamps and their derivatives.

        Parameters
        ----------
        zernikes : ndarray, shape (..., J)
            Coefficients in waves.
        directions : ndarray, shape (..., K, J)
            Changes of the coefficients per unit parameter, such as
            `QuadraticModel.jacobian` returns.

        Returns
        -------
        stamps : ndarray, shape (..., d, d)
            Each sums to 1.
        derivatives : ndarray, shape (..., K, d, d)
            Derivatives per unit parameter; each sums to 0. If stamps are movable, two more follow,
            by the position of the star along x and y in pixels.

        Raises
        ------
        SamplingError
            If a wavefront needs more samples than the largest grid has.
        EnergyError
            If a stamp holds less than `alignment.least_energy`.
        """
        shape = zernikes.shape[:-1]
        # An emulator may give all derivatives: only the stamps are left to compute.
        if not (directions.shape[-2] or self.movable):
            return self(zernikes)[0], np.empty((*shape, 0, *[self.alignment.stamp_px] * 2))
        # Flatten the leading axes to one list of wavefronts.
        zernikes = zernikes.reshape(prod(shape), -1)
        directions = directions.reshape(prod(shape), *directions.shape[len(shape) :])
        # The flux of a stamp depends on the state, too: the quotient is differentiated.
        raw = self.propagation.derivatives(zernikes, directions, by_position=self.movable)
        stamps, slopes, energy = normalise_with_derivatives(*raw)
        self._check_energy(energy)
        return stamps.reshape(*shape, *stamps.shape[1:]), slopes.reshape(*shape, *slopes.shape[1:])

    def _check_energy(self, energy: np.ndarray) -> None:
        """Raise EnergyError if a stamp holds too small a fraction of the light."""
        # Light outside the stamp is missing from its flux. "not >=" rejects NaN, too.
        minimum = self.alignment.least_energy
        if not energy.min() >= minimum:
            darkest = int(energy.argmin())
            raise EnergyError(
                f"stamp {darkest} holds {energy[darkest]:.4g} of the light "
                f"(alignment.least_energy = {minimum:g}); {int((energy < minimum).sum())} of "
                f"{energy.size} stamps hold too little: alignment.stamp_px = "
                f"{self.alignment.stamp_px} is too small for these states"
            )
