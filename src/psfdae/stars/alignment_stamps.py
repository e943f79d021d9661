"""Centroid-centred stamps of wavefronts given by Zernike coefficients.

The centroid of an image lies at the mean slope of the wavefront over the lit
pupil. Every Zernike polynomial therefore takes its own tilt along that cancels
its mean slope, once; the centring stays linear in the coefficients and a
derivative of a stamp is that of the centred stamp.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from psfdae.configuration.alignment import Alignment, AlignmentOptics
from psfdae.configuration.schema import Telescope
from psfdae.optics.derivatives import (
    ModalStamps,
    NodeSampling,
    PeriodSampling,
    normalise_with_derivatives,
)
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.sampling import choose_samples, required_samples
from psfdae.optics.zernike import noll_to_nm, radial_polynomial, zernike
from psfdae.stars.framing import normalise_flux
from psfdae.threads import side_by_side

FIRST_NOLL = 4
"""Piston and tilts do not show in a centred stamp."""

SLOPE_POINTS = 49
"""Points per axis at which slopes of wavefronts are measured."""

STEP = 1e-4
"""Step of the central differences of polynomials; they err by less than 1e-6."""


class EnergyError(ValueError):
    """A stamp holds too little of the light."""


def mean_slope(j: int, obscuration: float) -> tuple[float, float]:
    """Mean gradient (x, y) of a Noll polynomial over an annulus, per pupil radius.

    By the divergence theorem it is an integral along the two rims; only terms
    with one cycle per turn have one.

    Parameters
    ----------
    j : int
        Noll index.
    obscuration : float
        Linear central obscuration ε.
    """
    n, m = noll_to_nm(j)
    if abs(m) != 1:
        return 0.0, 0.0
    inner = obscuration * float(radial_polynomial(n, m, np.float64(obscuration)))
    slope = float(np.sqrt(2.0 * (n + 1.0)) * (1.0 - inner) / (1.0 - obscuration**2))
    return (slope, 0.0) if m > 0 else (0.0, slope)


def centred_modes(highest: int, obscuration: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """OPD of unit Zernike coefficients with their centring tilts.

    The sign turns the lead of a wavefront, which coefficients count, into an
    OPD. Stamps are then seen as the detector shows them: columns run along +x
    and rows along +y, the directions of the field angles.

    Parameters
    ----------
    highest : int
        Highest Noll index; the first is `FIRST_NOLL`.
    obscuration : float
        Linear central obscuration of the pupil that is centred.
    x, y : ndarray
        Pupil coordinates in pupil radii.

    Returns
    -------
    ndarray, shape (highest − 3, ...)
        In waves.
    """
    modes = []
    for j in range(FIRST_NOLL, highest + 1):
        slope_x, slope_y = mean_slope(j, obscuration)
        modes.append(slope_x * x + slope_y * y - zernike(j, x, y))
    return np.stack(modes)


class AlignmentStamps:
    """Operator from Zernike coefficients to centred stamps and their derivatives.

    Parameters
    ----------
    telescope, optics, alignment : config groups

    Notes
    -----
    Each wavefront uses the smallest grid of the ladder that its slopes allow.
    Batches run in `optics.threads` threads; results do not depend on their number.
    """

    def __init__(self, telescope: Telescope, optics: AlignmentOptics, alignment: Alignment) -> None:
        self.telescope = telescope
        self.optics = optics
        self.alignment = alignment
        self._operators: dict[int, ModalStamps] = {}
        self._slopes = _slope_basis(alignment.highest_zernike, telescope.obscuration)

    @property
    def noll(self) -> np.ndarray:
        """Noll indices of the J coefficients."""
        return np.arange(FIRST_NOLL, self.alignment.highest_zernike + 1)

    def __call__(self, zernikes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flux-normalised stamps.

        Parameters
        ----------
        zernikes : ndarray, shape (B, J)
            Noll 4 … 3 + J in waves.

        Returns
        -------
        stamps : ndarray, shape (B, d, d)
            Each sums to 1; in the configured precision.
        energy : ndarray, shape (B,)
            Fraction of the light inside the stamp.

        Raises
        ------
        SamplingError
            If the ladder ends below what a wavefront needs.
        EnergyError
            If a stamp holds less than `alignment.least_energy`.
        """
        side = self.alignment.stamp_px
        out = np.empty((len(zernikes), side, side), self._real)

        def propagate(operator: ModalStamps, part: np.ndarray) -> None:
            out[part] = operator.stamps(zernikes[part])

        self._run(zernikes, self.optics.batch, propagate)
        stamps, energy = normalise_flux(out)
        self._check_energy(energy)
        return stamps, energy

    def derivatives(
        self, zernikes: np.ndarray, directions: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flux-normalised stamps and their derivatives.

        Parameters
        ----------
        zernikes : ndarray, shape (B, J)
            In waves.
        directions : ndarray, shape (B, K, J), optional
            Changes of the coefficients per unit parameter; by default the
            coefficients are the parameters, K = J.

        Returns
        -------
        stamps : ndarray, shape (B, d, d)
            Each sums to 1.
        derivatives : ndarray, shape (B, K, d, d)
            Per unit parameter; each sums to 0.

        Raises
        ------
        SamplingError, EnergyError
            As for stamps.
        """
        side, count = self.alignment.stamp_px, len(self.noll)
        if directions is None:
            directions = np.broadcast_to(np.eye(count), (len(zernikes), count, count))
        stamps = np.empty((len(zernikes), side, side), self._real)
        slopes = np.empty((len(zernikes), directions.shape[1], side, side), self._real)
        energy = np.empty(len(zernikes), self._real)

        def propagate(operator: ModalStamps, part: np.ndarray) -> None:
            raw = operator.derivatives(zernikes[part], directions[part])
            stamps[part], slopes[part], energy[part] = normalise_with_derivatives(*raw)

        self._run(zernikes, max(1, self.optics.batch // directions.shape[1]), propagate)
        self._check_energy(energy)
        return stamps, slopes

    def samples(self, zernikes: np.ndarray) -> np.ndarray:
        """Pupil samples N that each wavefront gets, shape (B,).

        Raises
        ------
        SamplingError
            If the ladder ends below what a wavefront needs: half a wave per
            sample, and no replica of the image on the stamp.
        """
        slopes = np.empty((len(zernikes), 2, 2))
        for axis, basis in enumerate(self._slopes):
            for start in range(0, len(zernikes), 1024):
                values = zernikes[start : start + 1024] @ basis
                slopes[start : start + 1024, axis, 0] = values.min(axis=1)
                slopes[start : start + 1024, axis, 1] = values.max(axis=1)
        half = 0.5 * self.alignment.stamp_px * self.telescope.pixel
        reach = np.broadcast_to([-half, half], (2, 2))
        return choose_samples(required_samples(slopes, reach), tuple(self.optics.pupil_samples))

    def operator(self, samples: int) -> ModalStamps:
        """The operator on a pupil grid with N samples across; made once, then kept."""
        if samples not in self._operators:
            telescope, optics, side = self.telescope, self.optics, self.alignment.stamp_px
            pupil = annular_pupil(samples, telescope.obscuration)
            x, y = pupil.axis[None, :], pupil.axis[:, None]
            modes = centred_modes(self.alignment.highest_zernike, telescope.obscuration, x, y)
            how = (pupil, side, telescope.pixel)
            sampling = (
                PeriodSampling(*how, optics.precision)
                if optics.nodes is None
                else NodeSampling(*how, optics.nodes, optics.precision)
            )
            self._operators[samples] = ModalStamps(pupil, modes, sampling, telescope.pixel)
        return self._operators[samples]

    @property
    def _real(self) -> np.dtype:
        return np.empty(0, self.optics.precision).real.dtype

    def _run(
        self,
        zernikes: np.ndarray,
        size: int,
        work: Callable[[ModalStamps, np.ndarray], None],
    ) -> None:
        samples = self.samples(zernikes)
        tasks = []
        for n in np.unique(samples):
            members = np.flatnonzero(samples == n)
            batches = np.array_split(members, range(size, members.size, size))
            tasks += [(self.operator(int(n)), batch) for batch in batches]
        side_by_side(lambda task: work(*task), tasks, self.optics.threads)

    def _check_energy(self, energy: np.ndarray) -> None:
        least = self.alignment.least_energy
        if not energy.min() >= least:
            worst = int(energy.argmin())
            raise EnergyError(
                f"stamp {worst} holds {energy[worst]:.4g} of the light "
                f"(alignment.least_energy = {least:g}); {int((energy < least).sum())} of "
                f"{energy.size} stamps hold too little: alignment.stamp_px = "
                f"{self.alignment.stamp_px} is too small for these states"
            )


def _slope_basis(highest: int, obscuration: float) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of the centred modes over the lit annulus and its outer rim, (J, points) each."""
    axis = np.linspace(-1.0, 1.0, SLOPE_POINTS)
    xx, yy = np.meshgrid(axis, axis)
    radius = np.hypot(xx, yy)
    lit = (radius <= 1.0) & (radius >= obscuration)
    angle = np.linspace(0.0, 2.0 * np.pi, 4 * SLOPE_POINTS, endpoint=False)
    x = np.append(xx[lit], np.cos(angle))
    y = np.append(yy[lit], np.sin(angle))

    def modes(dx: float, dy: float) -> np.ndarray:
        return centred_modes(highest, obscuration, x + dx, y + dy)

    return (
        (modes(STEP, 0.0) - modes(-STEP, 0.0)) / (2.0 * STEP),
        (modes(0.0, STEP) - modes(0.0, -STEP)) / (2.0 * STEP),
    )
