"""Pupil grids: their transmission, and the number of samples that aliasing requires."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfdae.base.errors import Error


@dataclass(frozen=True)
class Pupil:
    """Pupil sampled on a square grid.

    Attributes
    ----------
    amplitude : ndarray, shape (M, M), float64
        Amplitude transmission, indexed [y, x].
    axis : ndarray, shape (M,), float64
        Coordinates of the samples along either axis, in pupil radii.
    """

    amplitude: np.ndarray
    axis: np.ndarray

    @property
    def spacing(self) -> float:
        """Distance of two samples in pupil radii; the image repeats every 2/spacing λ/D."""
        return float(self.axis[1] - self.axis[0])

    @property
    def light(self) -> float:
        """Light of the whole image plane, in the image's unit |Σ A exp(…)|² times (λ/D)².

        (2/spacing)² Σ A, because a grey cell transmits light in proportion to its lit area. By
        Parseval's theorem, one period of the image holds Σ A² instead, a few thousandths less:
        the image of the grey pupil lacks faint outer light and agrees with the true one inside.
        """
        return (2.0 / self.spacing) ** 2 * float(self.amplitude.sum())


def pupil_axis(samples: int, guard: int = 0) -> np.ndarray:
    """Return the cell-centred coordinates of a pupil grid along one axis.

    Parameters
    ----------
    samples : int
        Number of samples N across the pupil's diameter.
    guard : int
        Cells added outside the pupil at either end.

    Returns
    -------
    ndarray, shape (N + 2·guard,)
        Coordinates in pupil radii; without guard cells −1 + 1/N … 1 − 1/N.
    """
    return (2.0 * np.arange(-guard, samples + guard) + 1.0) / samples - 1.0


def disc_coverage(samples: int, radius: float, guard: int = 0) -> np.ndarray:
    """Compute the fraction of each cell of a pupil grid that lies inside a centred disc.

    Only the cells that the rim crosses are subdivided, so the cost of a fine
    subdivision grows with the rim's length and not with the area.

    Parameters
    ----------
    samples, guard : int
        Grid as in `pupil_axis`.
    radius : float
        Radius of the disc in pupil radii, 0 … 1.

    Returns
    -------
    ndarray, shape (M, M), float64
        Coverage, 0 … 1.
    """
    # By symmetry, only distances from the centre matter.
    x = np.abs(pupil_axis(samples, guard))
    half = 1.0 / samples  # half of a cell's side
    # Distance of the nearest and of the farthest point of each cell from the centre.
    low, high = np.maximum(x - half, 0), x + half
    nearest = np.hypot(low[:, None], low)
    farthest: np.ndarray = np.hypot(high[:, None], high)
    # Cells are inside, outside, or crossed by the rim; crossed cells get 64 × 64 sub-samples.
    coverage = (farthest <= radius).astype(np.float64)
    rows, columns = np.nonzero((nearest < radius) & (farthest > radius))
    # The share of the sub-samples of a crossed cell that are in the disc.
    offset = pupil_axis(64) * half
    y = x[rows][:, None, None] + offset[None, :, None]
    x = x[columns][:, None, None] + offset[None, None, :]
    coverage[rows, columns] = (y**2 + x**2 <= radius**2).mean(axis=(1, 2))
    return coverage


def annular_pupil(samples: int, obscuration: float, sharpen: bool = True) -> Pupil:
    """Make an annular pupil with grey edges.

    A grey (area-weighted) edge is the pupil convolved with one cell, which
    dims the outer image by a second moment of 1/12 cell². `sharpen` removes
    this moment, A − ∇²A/24 with the five-point Laplacian: the squared error of
    the stamps of scene 1 falls to about a tenth at equal N. The correction
    extends one cell outside of the rim, hence the guard cells, and over- and
    undershoots by a few per cent there.

    Parameters
    ----------
    samples : int
        Samples N across the outer diameter; the grid is N + 2 wide.
    obscuration : float
        Linear central obscuration, 0 ≤ ε < 1.
    sharpen : bool
        Correct the second moment of the grey edge.

    Raises
    ------
    ValueError
        If `obscuration` is outside [0, 1).
    """
    if not 0.0 <= obscuration < 1.0:
        raise ValueError(f"obscuration = {obscuration} is outside [0, 1)")
    # Lit fraction of every cell: the outer disc minus the central obscuration.
    grey = disc_coverage(samples, 1.0, guard=1)
    if obscuration:
        grey = grey - disc_coverage(samples, obscuration, guard=1)
    if sharpen:
        # A − ∇²A/24.
        frame = np.pad(grey, 1)
        neighbours = frame[:-2, 1:-1] + frame[2:, 1:-1] + frame[1:-1, :-2] + frame[1:-1, 2:]
        grey = grey - (neighbours - 4.0 * grey) / 24.0
    return Pupil(grey, pupil_axis(samples, guard=1))


class SamplingError(Error, ValueError):
    """Error of a pupil grid that is too coarse for a wavefront or for the stamp's position."""


def count_samples(slopes: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Compute the smallest number of pupil samples that represents a wavefront and its stamp.

    There are two conditions per axis. The OPD may change by half a wave per sample:
    N ≥ 4·max|∂W/∂ρ|. And the image of the pupil grid repeats every N λ/D:
    no replica of the geometric blur, which spans 2·∂W/∂ρ, may overlap the stamp.

    Parameters
    ----------
    slopes : ndarray, shape (..., 2, 2)
        [axis, (min, max)] slope of the OPD in waves per pupil radius.
    reach : ndarray, shape (..., 2, 2)
        [axis, (min, max)] edges of the stamp in λ/D from the chief ray.

    Returns
    -------
    ndarray of int, shape (...)
        Smallest number N of samples.

    Raises
    ------
    SamplingError
        If a slope is not finite.
    """
    # Half a wave per sample of 2/N radii: N ≥ 4 |∂W/∂ρ|.
    for_slope = 4.0 * np.abs(slopes).max(axis=(-2, -1))
    # Replicas of the geometric blur 2 ∂W/∂ρ, N λ/D away, stay clear of the stamp on both sides.
    blur = 2.0 * slopes
    upper, lower = blur[..., 1] - reach[..., 0], reach[..., 1] - blur[..., 0]
    for_replica = np.maximum(upper, lower).max(axis=-1)
    min_samples = np.maximum(for_slope, for_replica)
    if not np.isfinite(min_samples).all():
        wavefront = int(np.flatnonzero(~np.isfinite(min_samples))[0])
        raise SamplingError(f"wavefront {wavefront} is not finite: no grid can sample it")
    # Larger numbers would overflow as integers; no grid is that large.
    return np.asarray(np.ceil(np.minimum(min_samples, 2.0**53)), np.int64)


def pixel_width(scale_arcsec: float, diameter_m: float, wavelength_m: float) -> float:
    """Return the width of a pixel in units of λ/D."""
    # λ/D is an angle in radians.
    arcsec = np.pi / 180.0 / 3600.0
    return scale_arcsec * arcsec * diameter_m / wavelength_m


def choose_samples(samples: np.ndarray, sizes: tuple[int, ...]) -> np.ndarray:
    """Choose the smallest of the available grid sizes that is enough for each wavefront.

    Parameters
    ----------
    samples : ndarray of int, shape (B,)
        Result of `count_samples`.
    sizes : tuple of int
        Available grid sizes N, ascending.

    Returns
    -------
    ndarray of int, shape (B,)
        Grid size of each wavefront.

    Raises
    ------
    SamplingError
        If a wavefront needs more samples than the largest size; names the required N.
    """
    # The message names the grid that the worst wavefront needs.
    largest = int(samples.max())
    if largest > sizes[-1]:
        star = int(samples.argmax())
        raise SamplingError(
            f"optics.pupil_samples = {list(sizes)}: wavefront {star} needs N ≥ {largest} pupil "
            "samples (half a wave per sample, replicas clear of the stamp); "
            f"{(samples > sizes[-1]).sum()} of {samples.size} wavefronts exceed the last value"
        )
    return np.asarray(sizes)[np.searchsorted(sizes, samples)]
