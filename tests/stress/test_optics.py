"""Wavefronts, sampling and propagation."""

import numpy as np
import pytest

from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import SamplingError, annular_pupil
from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae_paper.stars.framing import FramingError
from psfdae_paper.stars.scenes import TurbulentWavefronts, template_wavefronts
from stress.bench import changed, propagation, stamp_mse

FINER = (254, 318, 398, 512, 640, 800, 1024, 1280, 1600, 2048)  # N beyond the config's
FINEST = 2700  # largest N of a converged reference; beyond it a stamp needs GBs
# Relative field of the test stars: axis, edge, corner; and stamps about their chief rays.
FIELDS, CENTRED = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), np.zeros((3, 2), int)
QUANTITY = "MSE of normalised stamps"


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1, 5, 10, 20])
def test_stronger_aberrations(bench, record, factor):
    """Seidel aberrations times 1 … 20: within the budget or refused."""
    config, budget = bench.seidel.config, bench.budget(bench.seidel.config)
    static, grids = config.wavefront.coefficients, config.optics.pupil_samples
    source, peak = seidel(factor * static), stamper(config, seidel(3 * static), 64).brightest()
    offset = np.rint(peak * factor / 3).astype(int)
    reach = max(config.stars.search_px, int(np.abs(offset).max()) + 8)
    truth = reference(config, source, offset, reach)
    case, setup = f"aberrations × {factor}", (config, source, offset, reach, truth, budget)
    record.point("aberrations", factor, agreement(record, case, *setup), budget)
    if truth is not None:
        # The largest configured grid, whatever the wavefront needs.
        pupil = annular_pupil(grids[-1], config.telescope.obscuration)
        sizes = config.framing.stamp_px, config.telescope.pixel
        opd = source.opd(np.arange(len(source)), pupil, np.dtype(np.float64))
        ignored = stamp_mse(StampPropagator(pupil, *sizes)(opd, offset), truth)
        record.point("aberrations, guard ignored", factor, ignored, budget)
        if factor == 10:
            # A guard that refuses what would have been right would be of no use.
            record.within(case, f"{QUANTITY} if the guard is ignored", ignored, budget, np.inf)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1, 10, 100])
def test_stronger_turbulence(bench, record, factor):
    """Fried's parameter divided by 1 … 100: within the budget or refused."""
    config, budget = bench.turbulence.config, bench.budget(bench.turbulence.config)
    wavefront = {"r0_m": config.wavefront.r0_m / factor}
    stronger, case = changed(config, grid={"points": 1}, wavefront=wavefront), f"r0 / {factor}"
    try:
        source = template_wavefronts(stronger)
    except SamplingError:
        record.equal(f"turbulence, {case}", "outcome", "SamplingError", "SamplingError")
        record.point("turbulence", factor, None, budget)
        return
    setup = (config, source, np.zeros((len(source), 2), int), config.framing.search_px)
    error = agreement(record, f"turbulence, {case}", *setup, reference(*setup), budget)
    record.point("turbulence", factor, error, budget)


class Ramps(list):
    """OPD maps that rise by so many waves per sample of the grid of the slopes."""

    def opd(self, index, axis, dtype):
        ramp = (
            0.5 * TurbulentWavefronts.slope_samples * np.broadcast_to(axis, (axis.size, axis.size))
        )
        return (np.array(self)[index, None, None] * ramp).astype(dtype)


def test_broken_wavefronts(bench, record):
    """Wavefronts that are not finite, absurdly strong or too steep for the grid."""
    config, static = bench.seidel.config, bench.seidel.config.wavefront.coefficients
    bad = seidel(np.stack([static, static * np.nan, static]))
    with record.refused("a wavefront NaN among good ones", SamplingError):
        propagation(config, bad).stamps(16, CENTRED)
    steep = TurbulentWavefronts(Ramps([0.51]))
    with record.refused("OPD map, 0.51 waves per sample", SamplingError):
        propagation(bench.turbulence.config, steep, pupil_samples=[steep.slope_samples])
    with record.refused("brightest pixel outside the search window", FramingError):
        stamper(config, seidel(3 * static), 4).brightest()


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-3, 1.0, 10.0])
def test_pixel_scale(bench, record, scale):
    """Pixels over four decades."""
    config, budget = bench.seidel.config, bench.budget(bench.seidel.config)
    source = seidel_wavefronts(np.tile(config.wavefront.coefficients, (2, 1)), FIELDS[:2])
    peak = stamper(config, source).brightest()
    offset = np.rint(peak * config.telescope.pixel_scale_arcsec / scale).astype(int)
    rescaled = changed(config, telescope={"pixel_scale_arcsec": scale})
    setup = (rescaled, source, offset, config.stars.search_px)
    error = agreement(record, f"pixel of {scale:g} arcsec", *setup, reference(*setup), budget)
    record.point("pixel scale", scale, error, budget)


def agreement(record, case, config, source, offset, reach, truth, budget, **optics):
    """Row: within the budget of the truth, or refused; MSE, None if refused, ∞ without a truth."""
    expected, error = f"≤ {budget:.3g} or SamplingError", None
    try:
        stamps = stamper(config, source, reach, **optics).stamps(config.framing.stamp_px, offset)
        error = np.inf if truth is None else stamp_mse(stamps, truth)
        record.row(case, QUANTITY, expected, f"{error:.3g}", error <= budget)
    except SamplingError:
        record.row(case, QUANTITY, expected, "SamplingError", True)
    return error


def reference(config, source, offset, reach):
    """Stamps at twice the samples that the guard asks for; None if that is too many."""
    try:
        guarded = stamper(config, source, reach, extra_grids=[FINEST]).samples.max()
    except SamplingError:
        return None
    samples = min(2 * int(guarded), FINEST)
    if samples < 1.2 * guarded:
        return None
    pupil = annular_pupil(samples, config.telescope.obscuration)
    kernel = StampPropagator(pupil, config.framing.stamp_px, config.telescope.pixel, extra=16)
    stars = np.arange(len(source))[:, None]
    opds = (source.opd(star, pupil, kernel.real_dtype) for star in stars)
    return np.concatenate([kernel(*star) for star in zip(opds, offset[:, None], strict=True)])


def stamper(config, source, search_px=None, extra_grids=(), **optics):
    """Propagation star by star, on the configured grids, continued, by default."""
    configured = config.optics.pupil_samples
    grids = [*configured, *(n for n in FINER if n > configured[-1]), *extra_grids]
    return propagation(config, source, search_px, **{"pupil_samples": grids, "batch": 1} | optics)


def seidel(coefficients):
    """Axis, edge and corner with the same (5,) or their own (3, 5) coefficients."""
    return seidel_wavefronts(np.broadcast_to(coefficients, (3, 5)).copy(), FIELDS)
