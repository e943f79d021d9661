"""Stress tests of wavefronts, sampling and propagation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.sampling import SamplingError, check_opd
from psfdae.optics.turbulence import SPECTRUM
from psfdae.optics.wavefronts import ModalWavefronts, WavefrontSource, seidel_wavefronts
from psfdae.stability.bench import Bench, Scene, stamp_mse
from psfdae.stability.rows import (
    Entry,
    Point,
    agrees_or_refused,
    at_most,
    equal,
    refused,
    within,
)
from psfdae.stages.common import template_wavefronts
from psfdae.stars.framing import FramingError
from psfdae.stars.scene import Propagation
from psfdae.stars.turbulence_scene import CYCLES_PER_DIAMETER

FACTORS = (1, 2, 3, 5, 7, 10, 20, 30, 50, 100)
"""Factors on a wavefront."""

FINER = (254, 318, 398, 512, 640, 800, 1024, 1280, 1600, 2048)
"""Grid sizes N that continue those of the config."""

FINEST = 2700
"""Largest N of a converged reference; beyond it a stamp needs GBs."""

FIELDS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
"""Relative field of the test stars: axis, edge, corner."""

PIXELS_ARCSEC = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.2, 0.3, 0.6, 1.0, 3.0, 10.0)
"""Pixel scales over four decades."""


def needed_nodes(pixel: float) -> int:
    """Gauss–Legendre nodes that resolve the finest fringes across a pixel of `pixel` λ/D.

    The image has no structure finer than λ/D, so the phase of its fastest fringe
    turns by 2π·pixel across a pixel; q nodes integrate it once q exceeds half the
    amplitude of the phase, π·pixel/2, by a few.
    """
    return int(np.ceil(0.5 * np.pi * pixel + 4))


def stronger_aberrations(bench: Bench) -> Iterator[Entry]:
    """Seidel aberrations times 1 … 100: within the budget or refused."""
    scene, budget = bench.seidel, bench.budget(bench.seidel)
    static = scene.config.wavefront.coefficients
    peak = _propagation(scene, _seidel(3 * static), _longer(scene), 64).brightest()
    for factor in FACTORS:
        source = _seidel(factor * static)
        offset = np.rint(peak * factor / 3).astype(int)
        reach = max(scene.config.stars.search_px, int(np.abs(offset).max()) + 8)
        truth = _reference(scene, source, offset, reach)
        for label, ladder in (
            ("configured grids", scene.config.optics.pupil_samples),
            ("grids up to 2048", _longer(scene)),
        ):
            row, error = agrees_or_refused(
                f"aberrations × {factor}",
                f"MSE of normalised stamps, {label}",
                lambda s=source, n=ladder, o=offset, r=reach, t=truth: _error(scene, s, n, o, r, t),
                budget,
                (SamplingError,),
            )
            yield row
        yield Point("aberrations", factor, error, budget)
        if truth is not None:
            ignored = _unguarded(scene, source, offset, truth)
            yield Point("aberrations, guard ignored", factor, ignored, budget)
            if factor == 10:
                # A guard that refuses what would have been right would be of no use.
                yield within(
                    f"aberrations × {factor}",
                    "MSE of normalised stamps if the guard is ignored",
                    ignored,
                    budget,
                    np.inf,
                )


def stronger_turbulence(bench: Bench) -> Iterator[Entry]:
    """Fried's parameter divided by 1 … 1000: within the budget or refused."""
    scene, budget = bench.turbulence, bench.budget(bench.turbulence)
    telescope, reach = scene.config.telescope, scene.config.framing.search_px
    grid = scene.config.grid.model_copy(update={"points": 1})
    highest = CYCLES_PER_DIAMETER / telescope.diameter_m
    for factor in (1, 3, 10, 30, 100, 1000):
        r0 = scene.config.wavefront.r0_m / factor
        wavefront = scene.config.wavefront.model_copy(update={"r0_m": r0})
        config = scene.config.model_copy(update={"grid": grid, "wavefront": wavefront})
        try:
            source = template_wavefronts(config)
        except SamplingError:
            yield equal(f"turbulence, r0 / {factor}", "outcome", "SamplingError", "SamplingError")
            yield Point("turbulence", factor, None, budget)
            continue
        offset = np.zeros((len(source), 2), int)
        truth = _reference(scene, source, offset, reach)
        row, error = agrees_or_refused(
            f"turbulence, r0 / {factor}",
            "MSE of normalised stamps, grids up to 2048",
            lambda s=source, o=offset, t=truth: _error(scene, s, _longer(scene), o, reach, t),
            budget,
            (SamplingError,),
        )
        yield row
        yield Point("turbulence", factor, error, budget)
        if error is not None:
            # ∫ of the spectrum beyond the last wave. This part of the light lands beyond the
            # stamp; its square is what comes back and changes the normalised stamp.
            left_out = 1.2 * np.pi * SPECTRUM * (r0 * highest) ** (-5 / 3)
            yield at_most(
                f"turbulence, r0 / {factor}", "phase variance left out (rad²)", left_out, 0.1
            )


def broken_wavefronts(bench: Bench) -> Iterator[Entry]:
    """Wavefronts that are not finite, absurdly strong or too steep for the grid."""
    scene = bench.seidel
    static = scene.config.wavefront.coefficients
    ladder = scene.config.optics.pupil_samples
    for label, factor in (("NaN", np.nan), ("infinite", np.inf), ("times 1e20", 1e20)):
        bad = np.stack([static, static * factor, static])
        yield refused(
            f"a wavefront {label} among good ones",
            lambda s=bad: _propagation(scene, _seidel(s), ladder).stamps(16, np.zeros((3, 2), int)),
            SamplingError,
        )
    pupil = annular_pupil(64, 0.0).amplitude
    ramp = np.linspace(0.0, 1.0, pupil.shape[0])[None] * np.ones_like(pupil)
    steps = pupil.shape[0] - 1
    yield refused(
        "OPD map, NaN", lambda: check_opd(np.where(ramp > 0.5, np.nan, ramp), pupil), SamplingError
    )
    yield refused(
        "OPD map, 0.51 waves per sample",
        lambda: check_opd(0.51 * steps * ramp, pupil),
        SamplingError,
    )
    narrow = 4
    yield refused(
        "brightest pixel outside the search window",
        lambda: _propagation(scene, _seidel(3 * static), _longer(scene), narrow).brightest(),
        FramingError,
    )


def pixel_scales(bench: Bench) -> Iterator[Entry]:
    """Pixels over four decades, with the configured nodes and with those they need."""
    scene, budget = bench.seidel, bench.budget(bench.seidel)
    telescope, optics = scene.config.telescope, scene.config.optics
    source = seidel_wavefronts(np.tile(scene.config.wavefront.coefficients, (2, 1)), FIELDS[:2])
    peak = _propagation(scene, source, _longer(scene)).brightest()
    reach = scene.config.stars.search_px
    for scale in PIXELS_ARCSEC:
        offset = np.rint(peak * telescope.pixel_scale_arcsec / scale).astype(int)
        rescaled = _rescaled(scene, scale)
        needed = needed_nodes(rescaled.config.telescope.pixel)
        truth = _reference(rescaled, source, offset, reach, needed + 4)
        for label, nodes in (("configured nodes", optics.nodes), ("nodes it needs", needed)):
            row, error = agrees_or_refused(
                f"pixel of {scale:g} arcsec",
                f"MSE of normalised stamps, {label}",
                lambda s=rescaled, o=offset, n=nodes, t=truth: _error(
                    s, source, _longer(scene), o, reach, t, n
                ),
                budget,
                (SamplingError,),
            )
            yield row
            yield Point(f"pixel scale, {label}", scale, error, budget)


def similar_telescopes(bench: Bench) -> Iterator[Entry]:
    """Aperture and wavelength over decades at the same λ/D per pixel: the same stamps."""
    scene = bench.seidel
    telescope, source = scene.config.telescope, _seidel(scene.config.wavefront.coefficients)
    offset = np.zeros((3, 2), int)
    stamps = [
        _propagation(
            _with_telescope(
                scene,
                diameter_m=telescope.diameter_m * factor,
                wavelength_m=telescope.wavelength_m * factor,
            ),
            source,
            _longer(scene),
            precision="complex128",
        ).stamps(16, offset)
        for factor in (1.0, 1e-1, 1e1, 1e3)
    ]
    worst = max(np.abs(s / stamps[0] - 1).max() for s in stamps[1:])
    # Rounding of p = pixel · D/λ turns the phase of the outermost pixel by πN·ε at most.
    yield at_most(
        "D and λ times 0.1 … 1000",
        "largest relative difference of a pixel",
        float(worst),
        1e3 * np.pi * 256 * np.finfo(float).eps,
    )


def energy(bench: Bench) -> Iterator[Entry]:
    """Parseval: one period of the image holds the light of the pupil."""
    samples = 32
    pupil = annular_pupil(samples, 0.3)
    period = 2.0 / pupil.spacing
    rng = np.random.default_rng(bench.seed)
    opd = rng.uniform(-0.5, 0.5, (2, *pupil.amplitude.shape))
    for pixels in (1, 4, 16, 64):
        pixel = period / pixels
        nodes = needed_nodes(pixel) + 16
        for precision, bound in (("complex128", 1e-10), ("complex64", 1e-5)):
            kernel = StampPropagator(pupil, pixels, pixel, nodes, precision)  # type: ignore[arg-type]
            total = kernel(opd.astype(kernel.real_dtype)).sum(axis=(1, 2), dtype=np.float64)
            yield at_most(
                f"Parseval, pixel of {pixel:.3g} λ/D, {precision}",
                "|energy − 1| over one period",
                float(np.abs(total - 1).max()),
                bound,
            )
    fine = annular_pupil(256, 0.3)
    for pixel in (1e-6, 1e-4, 1e-2):
        kernel = StampPropagator(fine, 2, pixel, 2, "complex128")
        peak = kernel(np.zeros((1, *fine.amplitude.shape)))[0, 0, 0]
        # Diffraction-limited peak, π/4 (1 − ε²) per (λ/D)². What an annulus diffracts beyond
        # ±N/2 λ/D, 2/(π² N/2 (1 − ε)), the grid counts as inside; the image bends by (π p)²/4.
        expected = 0.25 * np.pi * (1 - 0.3**2) * pixel**2
        outside = 2 / (np.pi**2 * 128 * (1 - 0.3))
        yield within(
            f"diffraction-limited peak, pixel of {pixel:g} λ/D",
            "relative excess of the peak pixel over its analytic value",
            float(peak / expected - 1),
            -0.25 * (np.pi * pixel) ** 2,
            outside,
        )


def _seidel(coefficients: np.ndarray) -> ModalWavefronts:
    """Axis, edge and corner with the same (5,) or their own (3, 5) coefficients."""
    return seidel_wavefronts(np.broadcast_to(coefficients, (len(FIELDS), 5)).copy(), FIELDS)


def _longer(scene: Scene) -> list[int]:
    """The configured grids, continued."""
    configured = scene.config.optics.pupil_samples
    return [*configured, *(n for n in FINER if n > configured[-1])]


def _propagation(
    scene: Scene,
    source: WavefrontSource,
    ladder: list[int],
    search_px: int | None = None,
    nodes: int | None = None,
    precision: str | None = None,
) -> Propagation:
    optics = scene.config.optics.model_copy(
        update={
            "pupil_samples": list(ladder),
            "nodes": nodes or scene.config.optics.nodes,
            "precision": precision or scene.config.optics.precision,
            "batch": 1,
        }
    )
    search = search_px or scene.config.stars.search_px
    return Propagation(source, scene.config.telescope, optics, scene.config.framing, search)


def _error(
    scene: Scene,
    source: WavefrontSource,
    ladder: list[int],
    offset: np.ndarray,
    reach: int,
    truth: np.ndarray | None,
    nodes: int | None = None,
) -> float:
    """Largest MSE against the reference; infinite where nothing can confirm the stamp."""
    stamps = _propagation(scene, source, ladder, reach, nodes).stamps(
        scene.config.framing.stamp_px, offset
    )
    return np.inf if truth is None else stamp_mse(stamps, truth)


def _reference(
    scene: Scene, source: WavefrontSource, offset: np.ndarray, reach: int, nodes: int = 8
) -> np.ndarray | None:
    """Stamps at twice the samples that the guard asks for; None if that is too many."""
    try:
        guarded = _propagation(scene, source, [*_longer(scene), FINEST], reach, nodes)
    except SamplingError:
        return None
    samples = min(2 * int(guarded.samples.max()), FINEST)
    if samples < 1.2 * guarded.samples.max():
        return None
    fine = _propagation(scene, source, [samples], reach, nodes, "complex128")
    return fine.stamps(scene.config.framing.stamp_px, offset)


def _unguarded(
    scene: Scene, source: WavefrontSource, offset: np.ndarray, truth: np.ndarray
) -> float:
    """Error of the largest configured grid, whatever the wavefront needs."""
    config = scene.config
    pupil = annular_pupil(config.optics.pupil_samples[-1], config.telescope.obscuration)
    kernel = StampPropagator(
        pupil, config.framing.stamp_px, config.telescope.pixel, config.optics.nodes
    )
    opd = source.opd(np.arange(len(source)), pupil, np.dtype(np.float64))
    return stamp_mse(kernel(opd, offset), truth)


def _rescaled(scene: Scene, pixel_scale_arcsec: float) -> Scene:
    return _with_telescope(scene, pixel_scale_arcsec=pixel_scale_arcsec)


def _with_telescope(scene: Scene, **update: Any) -> Scene:
    telescope = scene.config.telescope.model_copy(update=update)
    return Scene(
        scene.config.model_copy(update={"telescope": telescope}), scene.images, scene.least_level
    )


CASES = (
    stronger_aberrations,
    stronger_turbulence,
    broken_wavefronts,
    pixel_scales,
    similar_telescopes,
    energy,
)
"""All cases of this module."""
