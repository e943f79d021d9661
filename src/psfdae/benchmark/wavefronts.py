"""Savings in the wavefronts: terms and waves that a scene does not need."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import j0

from psfdae.benchmark.cases import Case, Scene, Selection
from psfdae.benchmark.propagation import batch_of
from psfdae.benchmark.skipping import OF_PEAK, relative_to_peak, saving, stamp_timer
from psfdae.benchmark.timing import use_threads
from psfdae.configuration.schema import Benchmark, VonKarman
from psfdae.optics.pupil import Pupil
from psfdae.optics.seidel import MONOMIALS, monomial_images
from psfdae.optics.turbulence import Footprints, structure_function
from psfdae.optics.wavefronts import ModalWavefronts, Modes, WavefrontSource
from psfdae.optics.zernike import zernike_basis

if TYPE_CHECKING:
    from psfdae.stars.turbulence_scene import TurbulentWavefronts

ZERNIKES = 37
"""Zernike polynomials of a customary fit (Noll 1 … 37)."""

PISTON_WAVES = 0.37
"""Any piston: it must not matter."""

STRUCTURE = "largest relative difference of the structure function"


def equal_stars(
    modes: Modes, coefficients: np.ndarray, count: int
) -> Callable[[Pupil, np.dtype], np.ndarray]:
    """OPDs of `count` equal stars, as a function of pupil and precision."""
    source = ModalWavefronts(modes, np.tile(coefficients, (count, 1)))
    return partial(source.opd, np.arange(count))


def with_piston(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The eight monomials and a constant, shape (9, ...)."""
    images = monomial_images(x, y)
    return np.concatenate([images, np.ones_like(images[:1])])


def without_tilt(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The monomials but x and y, which only distortion uses, shape (6, ...)."""
    return monomial_images(x, y)[: MONOMIALS.index("x")]


def zernikes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Z_1 … Z_37, shape (37, ...)."""
    return zernike_basis(ZERNIKES, *np.broadcast_arrays(x, y))


def zernike_fit(monomials: np.ndarray, points: int = 65) -> np.ndarray:
    """Zernike coefficients of a wavefront that is given by its monomials.

    Least squares on the points of a square grid in the unit disc; the monomials
    lie in the space of the first 15 Zernikes, so the fit is exact.

    Parameters
    ----------
    monomials : ndarray, shape (8,)
        In waves.

    Returns
    -------
    ndarray, shape (37,)
    """
    axis = np.linspace(-1.0, 1.0, points)
    x, y = np.meshgrid(axis, axis)
    inside = x**2 + y**2 <= 1.0
    images = zernikes(x[inside], y[inside])
    wanted = monomials @ monomial_images(x[inside], y[inside])
    return np.linalg.lstsq(images.T, wanted, rcond=None)[0]


def superfluous_seidel_terms(
    scene: Scene, case: Case, monomials: np.ndarray, benchmark: Benchmark
) -> list[dict[str, Any]]:
    """Rows on piston and on 37 Zernikes in place of eight monomials, for one star.

    Parameters
    ----------
    monomials : ndarray, shape (8,)
        Coefficients of the case's wavefront in waves.
    """
    use_threads(scene.optics.backend, benchmark.threads)
    batch = batch_of(scene.optics, benchmark)
    lean = equal_stars(monomial_images, monomials, batch)
    variants = (
        ("Piston", equal_stars(with_piston, np.append(monomials, PISTON_WAVES), batch)),
        (f"{ZERNIKES} Zernikes", equal_stars(zernikes, zernike_fit(monomials), batch)),
    )
    without_s, stamps = stamp_timer(scene, case, lean, benchmark)
    rows = []
    for item, opd_of in variants:
        with_s, other = stamp_timer(scene, case, opd_of, benchmark)
        change = relative_to_peak(stamps, other)
        rows.append(saving(item, scene.name, "star", with_s, without_s, change, OF_PEAK))
    return rows


def dropped_distortion(
    scene: Scene,
    case: Case,
    monomials: np.ndarray,
    undistorted: WavefrontSource,
    benchmark: Benchmark,
) -> dict[str, Any]:
    """Row on distortion, a mere tilt: it would save time, but the stamps need it.

    Stamps are framed on whole pixels, so the image's place within a pixel stays.

    Parameters
    ----------
    undistorted : WavefrontSource
        The scene's templates without distortion.
    """
    use_threads(scene.optics.backend, benchmark.threads)
    batch = batch_of(scene.optics, benchmark)
    kept = monomials[: MONOMIALS.index("x")]
    with_s, _ = stamp_timer(scene, case, equal_stars(monomial_images, monomials, batch), benchmark)
    without_s, _ = stamp_timer(scene, case, equal_stars(without_tilt, kept, batch), benchmark)
    change = _framed_change(scene, undistorted, scene.templates, benchmark.stamps)
    return saving(
        "Distortion (tilt)", scene.name, "star", with_s, without_s, change, OF_PEAK, skipped=False
    )


def removed_tilt(
    scene: Scene, case: Case, tilted: WavefrontSource, benchmark: Benchmark
) -> dict[str, Any]:
    """Row on the tilt of turbulence: no time to save, but other stamps."""
    use_threads(scene.optics.backend, benchmark.threads)
    with_s = _source_time(scene, case, tilted, benchmark)
    without_s = _source_time(scene, case, scene.templates, benchmark)
    change = _framed_change(scene, scene.templates, tilted, benchmark.stamps)
    return saving("Tilt of the turbulence", scene.name, "star", with_s, without_s, change, OF_PEAK)


def doubled_waves(
    scene: Scene,
    case: Case,
    doubled: TurbulentWavefronts,
    turbulence: VonKarman,
    benchmark: Benchmark,
) -> dict[str, Any]:
    """Row on twice as many plane waves.

    Parameters
    ----------
    doubled : TurbulentWavefronts
        The scene's templates with twice the waves.
    turbulence : config group `wavefront`
    """
    use_threads(scene.optics.backend, benchmark.threads)
    with_s = _source_time(scene, case, doubled, benchmark)
    without_s = _source_time(scene, case, scene.templates, benchmark)
    radius_m = 0.5 * scene.telescope.diameter_m
    distance_m = np.geomspace(0.06, 2.0, 25) * radius_m
    theory = structure_function(distance_m, turbulence.r0_m, turbulence.outer_scale_m)
    many, few = (
        mean_structure(source.footprints, distance_m / radius_m)
        for source in (doubled, scene.templates)
    )
    change = float((np.abs(few - many) / theory).max())
    return saving("Twice the plane waves", scene.name, "star", with_s, without_s, change, STRUCTURE)


def mean_structure(footprints: Footprints, distance: np.ndarray) -> np.ndarray:
    """Structure function of drawn plane waves, averaged over their phases and over direction.

    A wave of modulus a and wave number κ contributes a² [1 − J0(κ r)].

    Parameters
    ----------
    distance : ndarray, shape (n,)
        In pupil radii.

    Returns
    -------
    ndarray, shape (n,)
        rad².
    """
    modulus = 2.0 * np.pi * np.abs(footprints.coefficients[0])
    kappa = np.hypot(*footprints.wavevector.T)
    return modulus**2 @ (1.0 - j0(np.outer(kappa, distance)))


def _source_time(scene: Scene, case: Case, source: WavefrontSource, benchmark: Benchmark) -> float:
    stars = np.arange(batch_of(scene.optics, benchmark)) % len(source)

    def opd_of(pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        return source.opd(stars, pupil, dtype)

    return stamp_timer(scene, case, opd_of, benchmark)[0]


def _framed_change(
    scene: Scene, changed: WavefrontSource, right: WavefrontSource, stars: int
) -> float:
    """Largest change of some stamps, each framed on its own brightest pixel."""
    some = np.unique(np.linspace(0, len(right) - 1, min(len(right), stars)).round().astype(int))
    stamps = []
    for source in (changed, right):
        propagation = scene.propagation(Selection(source, some), scene.framing.search_px)
        stamps.append(propagation.stamps(scene.framing.stamp_px, propagation.brightest()))
    return relative_to_peak(*stamps)
