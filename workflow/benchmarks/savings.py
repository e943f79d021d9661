"""What a scene does not compute, what that saves, and what it does to the result."""

import subprocess
import sys
from dataclasses import replace
from functools import partial
from importlib.util import find_spec

import numpy as np
from scipy.special import j0

from measure import time_calls, use_threads
from propagators import Setting, build, configured_setting, fresnel_grid, kernel
from psfdae_paper.configuration.compose import part
from psfdae_paper.optics.propagation import EXTRA_POINTS
from psfdae_paper.optics.pupil import choose_samples
from psfdae_paper.optics.turbulence import structure_function
from psfdae_paper.optics.wavefronts import (
    MONOMIALS,
    ModalWavefronts,
    monomial_images,
    zernike_images,
)
from psfdae_paper.stages.common import template_wavefronts
from psfdae_paper.stars.framing import crop_jittered
from scenes import READS, Selection, pupil_of, relative_to_peak, spread_evenly, stamp_mse

OF_PEAK = "largest difference / peak"
AS_MSE = "MSE of the normalised stamp"
STRUCTURE = "largest relative difference of the structure function"

PACKAGES = ("hydra", "batoid", "poppy", "mlflow")  # that no stage of scenes 1 and 2 imports
ZERNIKES = partial(zernike_images, tuple(range(1, 38)))  # of a customary fit (Noll 1 … 37)
PISTON_WAVES = 0.37  # any piston: it must not matter


def saving(item, seconds, change, unit=OF_PEAK, per="star", skipped="yes"):
    """One row: `seconds` with and without the work, per star, set or process.

    `change` is what leaving the work out does to the result; `skipped` is whether the scene
    does, or has tried and kept it.
    """
    with_s, without_s = seconds
    row = {"item": item, "per": per, "with_s": with_s, "without_s": without_s}
    row |= {"saving": with_s / without_s, "change": change}
    return row | {"unit": unit, "skipped": skipped}


def timed_savings(tree, scene, cases, datasets):
    """All rows of a scene that need a clock; so many datasets share its stars.

    The configuration comes as a tree, for this is to run in a process of its own.
    """
    config, case = part(READS, tree), cases[-1]
    backend, threads = config.optics.backend, config.benchmark.threads
    use_threads(backend, threads)
    rows = [*superfluous_optics(config.benchmark, scene, case)]
    use_threads(backend, 1)  # batches run side by side
    rows += repeated_work(config, scene, len(config.noise.levels) * datasets)
    use_threads(backend, threads)
    kind = seidel_terms if config.wavefront.kind == "seidel" else turbulent_waves
    return [*rows, *kind(config, scene, case)]


def superfluous_optics(benchmark, scene, case):
    """Planes between pupil and focus, pixels outside the stamp, and a padded grid."""
    threads = benchmark.threads
    if benchmark.peers:
        peer = Setting("poppy_fresnel", case.samples, 4, threads=threads)
        samples, padded, _ = fresnel_grid(case, peer)
        # The pixel that the padded array really has, so that both look at the same points.
        same = replace(case, pixel=peer.points * samples / padded)
        planes, direct = (
            build(same, replace(peer, method=method, samples=samples))[1]
            for method in ("poppy_fresnel", "poppy_mft")
        )
        seconds = [time_calls(way, benchmark.repeats) for way in (planes, direct)]
        yield saving("Fresnel planes", seconds, relative_to_peak(direct(), planes()))
    side = 2 * int(case.samples / case.pixel / 2)
    used = replace(configured_setting(scene.optics, benchmark, case.samples), batch=1)
    (small, opd), (large, _) = (kernel(case, used, px) for px in (case.stamp_px, side))
    row, column = (case.offset_px[0] + (side - case.stamp_px) // 2).astype(int)
    cut = np.s_[:, row : row + case.stamp_px, column : column + case.stamp_px]
    fft = Setting("fft", case.samples, 8, scene.optics.precision, threads=threads)
    _, padded_fft = build(case, fft)
    lean, calls = partial(small, opd, case.offset_px), max(1, benchmark.stamps // 16)
    for item, way, stamps in (
        ("Pixels outside the stamp", partial(large, opd), large(opd)[cut]),
        ("Zero-padded grid", padded_fft, padded_fft()),
    ):
        repeats = benchmark.repeats
        seconds = (time_calls(way, repeats), time_calls(lean, repeats, calls))
        yield saving(item, seconds, relative_to_peak(lean(), stamps))


def repeated_work(config, scene, times):
    """Stamps that would be made anew for every use of a star, templates for every star."""
    side, margin = scene.framing.stamp_px, scene.framing.jitter_px

    def timed(source, search_px, side):
        some = spread_evenly(len(source), config.benchmark.stamps)
        way = scene.propagation(Selection(source, some), search_px)
        return way, time_calls(lambda: way.framed(side), config.benchmark.repeats) / some.size

    way, star_s = timed(scene.stars, scene.search_px, side)
    seconds = (times * star_s * len(scene.stars), star_s * len(scene.stars))
    change = relative_to_peak(way.framed(side)[0], way.framed(side)[0])
    yield saving("Stamps anew for each λ", seconds, change, per="set")

    way, field_s = timed(scene.templates, scene.framing.search_px, side + 2 * margin)
    framed, peak = way.framed(side + 2 * margin)
    jitter = np.resize([[-margin, margin], [margin, 0]], peak.shape)
    cut = crop_jittered(framed.astype(np.float32).astype(np.float64), jitter, margin)
    seconds = (field_s * config.stars.count, field_s * len(scene.templates))
    change = relative_to_peak(cut, way.framed(side, jitter)[0])
    yield saving("Templates anew for each star", seconds, change, per="set")


def stamp_timer(benchmark, scene, case, opd_of):
    """Time of a star from its wavefront to its stamp, and the stamps of a batch."""
    used = configured_setting(scene.optics, benchmark, case.samples)
    propagate, _ = kernel(case, used, case.stamp_px)
    pupil = pupil_of(case.samples, case.obscuration)
    offset = np.repeat(case.offset_px, used.batch, axis=0)

    def run():
        return propagate(opd_of(pupil, propagate.real_dtype), offset)

    calls = max(1, benchmark.stamps // used.batch)
    return time_calls(run, benchmark.repeats, calls) / used.batch, run()


def equal_stars(modes, coefficients, count):
    """OPDs of `count` equal stars, as a function of pupil and precision."""
    source = ModalWavefronts(modes, np.tile(coefficients, (count, 1)))
    return partial(source.opd, np.arange(count))


def with_piston(x, y):
    """The eight monomials and a constant, shape (9, ...)."""
    images = monomial_images(x, y)
    return np.concatenate([images, np.ones_like(images[:1])])


def zernike_fit(monomials, points=65):
    """Zernike coefficients, shape (37,), of a wavefront that is given by its eight monomials.

    Least squares on a square grid in the unit disc; the monomials lie in the space of the
    first 15 Zernikes, so the fit is exact.
    """
    axis = np.linspace(-1.0, 1.0, points)
    x, y = np.meshgrid(axis, axis)
    x, y = (coordinate[x**2 + y**2 <= 1.0] for coordinate in (x, y))
    return np.linalg.lstsq(ZERNIKES(x, y).T, monomials @ monomial_images(x, y), rcond=None)[0]


def seidel_terms(config, scene, case):
    """Piston, 37 Zernikes in place of eight monomials, and distortion.

    Distortion is a mere tilt: without it time would be saved. Stamps are framed on whole
    pixels, so the image's place within a pixel stays, and they need it.
    """
    monomials, tilts = scene.stars.coefficients[case.source.index[0]], MONOMIALS.index("x")

    def timed(modes, coefficients):
        opd_of = equal_stars(modes, coefficients, min(config.optics.batch, config.benchmark.stamps))
        return stamp_timer(config.benchmark, scene, case, opd_of)

    lean_s, stamps = timed(monomial_images, monomials)
    for item, modes, coefficients in (
        ("Piston", with_piston, np.append(monomials, PISTON_WAVES)),
        ("37 Zernikes", ZERNIKES, zernike_fit(monomials)),
    ):
        with_s, other = timed(modes, coefficients)
        yield saving(item, (with_s, lean_s), relative_to_peak(stamps, other))
    without_s, _ = timed(lambda x, y: monomial_images(x, y)[:tilts], monomials[:tilts])
    undistorted = other_templates(config, distortion=0.0)
    change = framed_change(scene, undistorted, scene.templates, config.benchmark.stamps)
    yield saving("Distortion (tilt)", (lean_s, without_s), change, skipped="no")


def turbulent_waves(config, scene, case):
    """The tilt of the turbulence (no time to save, but other stamps), and twice the waves."""
    benchmark, turbulence, plain = config.benchmark, config.wavefront, scene.templates
    tilted = other_templates(config, remove_tilt=False)
    doubled = other_templates(config, waves=2 * turbulence.waves)
    stars = np.arange(min(config.optics.batch, benchmark.stamps)) % len(plain)

    def timed(source):
        opds = [partial(wavefronts.opd, stars) for wavefronts in (source, plain)]
        return [stamp_timer(benchmark, scene, case, opd_of)[0] for opd_of in opds]

    change = framed_change(scene, plain, tilted, benchmark.stamps)
    yield saving("Tilt of the turbulence", timed(tilted), change)
    radius_m = 0.5 * scene.telescope.diameter_m
    distance_m = np.geomspace(0.06, 2.0, 25) * radius_m
    theory = structure_function(distance_m, turbulence.r0_m, turbulence.outer_scale_m)
    few, many = (mean_structure(s.footprints, distance_m / radius_m) for s in (plain, doubled))
    change = (np.abs(few - many) / theory).max()
    yield saving("Twice the plane waves", timed(doubled), change, STRUCTURE)


def other_templates(config, **wavefront):
    """The scene's static wavefronts with changed keys of the group `wavefront`."""
    changed = config.wavefront.model_copy(update=wavefront)
    return template_wavefronts(config.model_copy(update={"wavefront": changed}))


def mean_structure(footprints, distance):
    """Structure function of drawn plane waves at distances in pupil radii, in rad².

    A wave of modulus a and wave number κ contributes a² [1 − J0(κ r)], averaged over its phase
    and over direction.
    """
    modulus = 2.0 * np.pi * np.abs(footprints.coefficients[0])
    kappa = np.hypot(*footprints.wavevector.T)
    return modulus**2 @ (1.0 - j0(np.outer(kappa, distance)))


def framed_change(scene, changed, right, stars):
    """Largest change of some stamps, each framed on its own brightest pixel."""
    some, search_px = spread_evenly(len(right), stars), scene.framing.search_px
    ways = [scene.propagation(Selection(source, some), search_px) for source in (changed, right)]
    return relative_to_peak(*(way.framed(scene.framing.stamp_px)[0] for way in ways))


def finer_than_needed(scene, sample, time_ms):
    """Rows on grids, points and digits beyond the budget, from the errors of a sample."""
    optics, ladder = scene.optics, tuple(scene.optics.pupil_samples)
    own, everyone = (choose_samples(n, ladder) for n in (sample.needed, sample.population))
    rungs, count = np.unique(everyone, return_counts=True)

    def way(finest, points, precision):
        """Mean seconds of all stars, and the stamps of the sample."""
        of_all, of_sample = (np.full_like(n, ladder[-1]) if finest else n for n in (rungs, own))
        times = [time_ms[int(n), points, precision] for n in of_all]
        stamps = sample.at(of_sample, points, precision)
        return 1e-3 * np.average(times, weights=count), stamps

    without_s, configured = way(False, EXTRA_POINTS, optics.precision)
    for item, *setting in (
        ("Every star on the finest grid", True, EXTRA_POINTS, optics.precision),
        ("Two points more per axis", False, EXTRA_POINTS + 2, optics.precision),
        ("Double precision", False, EXTRA_POINTS, "complex128"),
    ):
        with_s, stamps = way(*setting)
        yield saving(item, (with_s, without_s), stamp_mse(stamps, configured).max(), AS_MSE)


def imports(repeats, packages):
    """Start of an interpreter with and without packages that are installed and not imported."""

    def start(*more):
        command = [
            sys.executable,
            "-c",
            f"import {', '.join(('psfdae_paper.stages.stars', *more))}",
        ]
        return time_calls(lambda: subprocess.run(command, check=True), repeats)

    lean_s = start()
    for name in packages:
        if find_spec(name) is not None:
            yield saving(f"Import of {name}", (start(name), lean_s), 0.0, "none", "process")
