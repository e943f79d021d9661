"""Fluxes, and stars that are not as they should be."""

import numpy as np
import pytest

from psfdae.denoise.flux_model import FluxModel, robust_flux
from psfdae.denoise.stamp_arrays import make_stamps
from psfdae.image.sky import border_median
from psfdae.image.stamps import StarFlag

pytestmark = pytest.mark.slow
SIGMAS = 4.0  # sampling errors that a measured RMS may be off by
LEVELS = [("seidel", level) for level in (3e-5, 3e-4, 1e-3, 2e-3, 3e-3, 5e-3)]
LEVELS += [("turbulence", level) for level in (3e-4, 5e-3)]


@pytest.mark.parametrize(("scene", "level"), LEVELS)
def test_noisy_sum(bench, record, scene, level):
    """Equation 8 with a noisy sum, beside the robust flux of the same images."""
    stars, model = bench.test_stars(scene), bench.flux_models[scene]
    sampling = SIGMAS / np.sqrt(2 * len(stars))
    images = bench.noise.draw(stars, level, bench.stream("flux", scene, f"{level:.6g}"))
    sky, photon_noise = bench.noise.kappa * level, 1.0 / float(bench.noise.flux(level))
    expected = np.sqrt(stars[0].size * sky**2 + photon_noise)
    # A star of known PSF and unknown flux cannot be measured better than this (Cramér–Rao).
    limit = rms(sky / np.sqrt((stars.astype(np.float64) ** 2).sum(axis=(1, 2))))
    by_sum = rms(images.sum(axis=(1, 2), dtype=np.float64) - 1)
    robust = rms(robust_flux(images, model).flux - 1)
    case, low, high = f"{scene}, λ = {level:.0e}", 1 - sampling, expected * (1 + sampling)
    if level == 3e-4:
        record.within(case, "relative error of the noisy sum", by_sum, expected * low, high)
    # From a noise level of 1e-3, the robust flux must beat the sum.
    rms_limit = by_sum * low if level >= 1e-3 else high
    record.within(case, "relative error of the robust flux", robust, limit * low, rms_limit)
    record.point(f"{scene}, noisy sum", level, by_sum, expected)
    record.point(f"{scene}, robust flux", level, robust, expected)


def test_broken_stars(bench, record):
    """One broken star in a batch: its flags, its flux and its neighbours."""
    good = bright_stars(bench, 8)
    intact, star, middle = measured(bench, good), good[3], good.shape[-1] // 2
    neighbour_px, equal_arrays, shifts = (middle + 2, middle - 1), [], []
    for defect, broken, flags in (
        ("with negative sum", -star, "OUTLIER+NO_FLUX"),
        ("of a single photon and no sky", put(0 * star, (middle, middle), 1), "OUTLIER+NO_FLUX"),
        ("with all NaN", put(star, ..., np.nan), "MASKED+NO_FLUX"),
        ("with a NaN", put(star, neighbour_px, np.nan), "MASKED"),
        ("with a pixel of 1e30", put(star, neighbour_px, 1e30), "OUTLIER"),
    ):
        photometry = measured(bench, put(good, 3, broken))
        record.equal(f"star {defect}", "flags", names(photometry.flags[3]), flags)
        intact_stars = (
            [np.delete(x, 3, axis=0) for x in (m.images, m.flux)] for m in (photometry, intact)
        )
        equal_arrays += map(np.array_equal, *intact_stars)
        if "NO_FLUX" in flags:
            equal_arrays.append(not photometry.images[3].any())
        else:
            shifts.append(abs(photometry.flux[3] - intact.flux[3]) / photometry.flux_error[3])
    case = "broken stars"
    record.equal(case, "image zero without flux, neighbours bit by bit", all(equal_arrays), True)
    # A few pixels less cost no more than the error that the estimate states.
    record.at_most(case, "change of the flux over its error", max(shifts), 2)


def put(images, place, value):
    """A copy with a value at a place."""
    out = images.copy()
    out[place] = value
    return out


def test_hot_pixels(bench, record):
    """One pixel off the core too bright by 1e-3 … 1e6 times the star's flux."""
    model, stars = bench.flux_models["seidel"], bench.test_stars()
    images = bench.noise.draw(stars, bench.level, bench.stream("hot pixel")).astype(np.float64)
    clean_rms = rms(robust_flux(images, model).flux - 1)
    # An excess that hides in the range of the training set counts in full at most.
    tolerated = model.pixel_range[1].reshape(stars.shape[1:])[3, 4]
    hidden = tolerated + (FluxModel.clip_sigma + SIGMAS) * bench.noise.kappa * bench.level
    for excess in (1e-2, 1.0, 1e6):
        hot = put(images, (slice(None), 3, 4), images[:, 3, 4] + excess)
        robust, by_sum = rms(robust_flux(hot, model).flux - 1), rms(hot.sum(axis=(1, 2)) - 1)
        case, bound = (
            f"hot pixel of {excess:g} times",
            np.hypot(1.1 * clean_rms, min(excess, hidden)),
        )
        record.at_most(f"{case} the flux", "error of the flux", robust, bound)
        record.point("hot pixel, noisy sum", excess, by_sum, bound)
        record.point("hot pixel, robust flux", excess, robust, bound)


def measured(bench, images):
    """Photometry of stamps of which nothing is known, as `predict` does it."""
    numbers = dict.fromkeys(("flux", "background", "noise", "gain"))
    masks = dict.fromkeys(("bad", "saturated"))
    stars, _ = make_stamps(images, images.shape[-1], "stress", numbers, masks, None, None)
    sky = border_median(stars.data, stars.bad)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return bench.photometer.measure(stars.data, stars.bad, sky, stars)


def bright_stars(bench, count):
    stars = bench.test_stars()[:count]
    return bench.noise.draw(stars, bench.level, bench.stream("bright")).astype(np.float64)


def names(flags):
    return "+".join(flag.name for flag in StarFlag if int(flags) & flag) or "none"


def rms(values):
    return float(np.sqrt(np.mean(values**2)))
