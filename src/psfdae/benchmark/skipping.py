"""What a scene no longer computes, and what that saves."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from psfdae.benchmark.cases import Case, Scene, Selection, pupil_of
from psfdae.benchmark.choice import Sample, stamp_mse
from psfdae.benchmark.peers import Peer, build, fresnel_grid
from psfdae.benchmark.propagation import batch_of, yes
from psfdae.benchmark.timing import time_calls, use_threads
from psfdae.configuration.schema import Benchmark
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import Pupil
from psfdae.optics.sampling import choose_samples
from psfdae.stars.framing import crop_jittered, normalise_flux

COLUMNS = (*("item", "scene", "per", "with_s", "without_s", "saving", "change", "unit", "skipped"),)
"""Columns of the table of savings.

`per` is what the times hold for (star, set, process), `change` what leaving the
work out does to the result, in `unit`; `skipped` is "no" for what was tried and kept.
"""

OF_PEAK = "largest difference / peak"
AS_MSE = "MSE of the normalised stamp"

PACKAGES = ("hydra", "batoid", "aotools", "poppy", "mlflow")
"""Packages that the stages of scenes 1 and 2 do not import."""

STAGE = "psfdae.stages.stars"


def saving(
    item: str,
    scene: str,
    per: str,
    with_s: float,
    without_s: float,
    change: float,
    unit: str,
    skipped: bool = True,
) -> dict[str, Any]:
    """One row of the table.

    Parameters
    ----------
    item, scene, per, unit : str
    with_s, without_s : float
        Seconds with and without the work.
    change : float
        How much the result changes without it.
    skipped : bool
        Whether the scene leaves it out.
    """
    ratio = with_s / without_s
    values = (item, scene, per, with_s, without_s, ratio, change, unit, yes(skipped))
    return dict(zip(COLUMNS, values, strict=True))


def kernel_of(scene: Scene, case: Case, stamp_px: int | None = None) -> StampPropagator:
    """The kernel with the scene's settings for a case, for another stamp size if named."""
    return StampPropagator(
        pupil_of(case.samples, case.obscuration),
        case.stamp_px if stamp_px is None else stamp_px,
        case.pixel,
        scene.optics.nodes,
        scene.optics.precision,
        scene.optics.backend,
    )


def relative_to_peak(stamps: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference of normalised stamps in units of each reference's peak."""
    stamps, reference = normalise_flux(stamps)[0], normalise_flux(reference)[0]
    return float((np.abs(stamps - reference).max((-2, -1)) / reference.max((-2, -1))).max())


def superfluous_optics(scene: Scene, cases: Sequence[Case], benchmark: Benchmark) -> list[dict]:
    """Rows on planes, pixels and padding that nobody looks at; run it in a fresh process."""
    use_threads(scene.optics.backend, benchmark.threads)
    strong = cases[-1]
    rows = [_focal_plane(scene, strong, benchmark), _padding(scene, strong, benchmark)]
    if benchmark.peers:
        rows.insert(0, _fresnel(scene, strong, benchmark))
    return rows


def _fresnel(scene: Scene, case: Case, benchmark: Benchmark) -> dict[str, Any]:
    """Fresnel planes to the focus against the Fraunhofer integral, both by POPPY."""
    peer = Peer("poppy_fresnel", case.samples, 4)
    samples, padded, _ = fresnel_grid(case, peer)
    # The pixel that the padded array really has, so that both look at the same points.
    case = replace(case, pixel=peer.nodes * samples / padded)
    ways = [
        build(case, replace(peer, method=method, samples=samples), benchmark.threads)[1]
        for method in ("poppy_fresnel", "poppy_mft")
    ]
    times = [time_calls(propagate, benchmark.repeats).median_s for propagate in ways]
    planes, direct = (propagate() for propagate in ways)
    change = relative_to_peak(direct, planes)
    return saving("Fresnel planes", scene.name, "star", *times, change, OF_PEAK)


def _focal_plane(scene: Scene, case: Case, benchmark: Benchmark) -> dict[str, Any]:
    """The whole period of the image against the stamp."""
    small = kernel_of(scene, case)
    side = 2 * int(case.samples / case.pixel / 2)
    large = kernel_of(scene, case, side)
    pupil = pupil_of(case.samples, case.obscuration)
    opd, single = case.batch(pupil, 1, small.real_dtype), max(1, benchmark.stamps // 16)
    row, column = (case.offset_px[0] + (side - case.stamp_px) // 2).astype(int)
    cut = np.s_[:, row : row + case.stamp_px, column : column + case.stamp_px]
    with_s = time_calls(lambda: large(opd), benchmark.repeats).median_s
    without_s = time_calls(lambda: small(opd, case.offset_px), benchmark.repeats, single).median_s
    change = relative_to_peak(small(opd, case.offset_px), large(opd)[cut])
    return saving(
        "Pixels outside the stamp", scene.name, "star", with_s, without_s, change, OF_PEAK
    )


def _padding(scene: Scene, case: Case, benchmark: Benchmark) -> dict[str, Any]:
    """A padded FFT with eight sub-samples per pixel against the matrix products."""
    _, padded = build(case, Peer("fft", case.samples, 8, scene.optics.precision), benchmark.threads)
    kernel = kernel_of(scene, case)
    pupil = pupil_of(case.samples, case.obscuration)
    opd = case.batch(pupil, 1, kernel.real_dtype)
    with_s = time_calls(padded, benchmark.repeats).median_s
    calls = max(1, benchmark.stamps // 16)
    without_s = time_calls(lambda: kernel(opd, case.offset_px), benchmark.repeats, calls).median_s
    change = relative_to_peak(kernel(opd, case.offset_px)[0], padded())
    return saving("Zero-padded grid", scene.name, "star", with_s, without_s, change, OF_PEAK)


def repeated_work(
    scene: Scene, benchmark: Benchmark, stars: int, levels: int, datasets: int
) -> list[dict[str, Any]]:
    """Rows on stamps that would be made more than once; run it in a fresh process.

    Parameters
    ----------
    stars : int
        Stars of a set.
    levels : int
        Noise levels of a dataset.
    datasets : int
        Datasets that share the stars.
    """
    use_threads(scene.optics.backend, 1)  # batches run side by side
    every = _spread(len(scene.stars), benchmark.stamps)
    propagation = scene.propagation(Selection(scene.stars, every), scene.search_px)
    side = scene.framing.stamp_px

    def stamps() -> np.ndarray:
        return propagation.stamps(side, propagation.brightest())

    per_wavefront = time_calls(stamps, benchmark.repeats).median_s / every.size
    once = per_wavefront * len(scene.stars)
    change = relative_to_peak(stamps(), stamps())
    times = levels * datasets
    rows = [
        saving("Stamps anew for each λ", scene.name, "set", times * once, once, change, OF_PEAK)
    ]
    by_field, change = _one_per_field(scene, benchmark)
    count = len(scene.templates)
    rows.append(
        saving(
            "Templates anew for each star",
            *(scene.name, "set", by_field * stars, by_field * count, change, OF_PEAK),
        )
    )
    return rows


def _one_per_field(scene: Scene, benchmark: Benchmark) -> tuple[float, float]:
    """Time of a template, and what cutting a star out of a framed one changes."""
    some = _spread(len(scene.templates), benchmark.stamps)
    source = Selection(scene.templates, some)
    propagation = scene.propagation(source, scene.framing.search_px)
    margin, side = scene.framing.jitter_px, scene.framing.stamp_px
    peak = propagation.brightest()
    jitter = np.resize([[-margin, margin], [margin, 0]], (some.size, 2))
    framed = propagation.stamps(side + 2 * margin, peak).astype(np.float32)
    direct = propagation.stamps(side, peak - jitter)
    cut = crop_jittered(framed.astype(np.float64), jitter, margin)

    def stamps() -> np.ndarray:
        return propagation.stamps(side + 2 * margin, propagation.brightest())

    seconds = time_calls(stamps, benchmark.repeats).median_s / some.size
    return seconds, relative_to_peak(cut, direct)


def _spread(total: int, count: int) -> np.ndarray:
    return np.unique(np.linspace(0, total - 1, min(total, count)).round().astype(int))


def finer_than_needed(
    scene: Scene, sample: Sample, time_ms: Mapping[tuple[int, int, str], float]
) -> list[dict[str, Any]]:
    """Rows on grids, nodes and digits beyond the budget, from the errors of a sample.

    Parameters
    ----------
    scene, sample
    time_ms : mapping of (samples, nodes, precision) to the time of a stamp in ms
    """
    optics, ladder = scene.optics, tuple(scene.optics.pupil_samples)
    own, everyone = (choose_samples(n, ladder) for n in (sample.needed, sample.population))
    configured = sample.at(own, optics.nodes, optics.precision)
    finest = np.full_like(own, ladder[-1])
    variants = (
        ("Every star on the finest grid", finest, optics.nodes, optics.precision),
        ("Two nodes more per axis", own, optics.nodes + 2, optics.precision),
        ("Double precision", own, optics.nodes, "complex128"),
    )
    rungs, count = np.unique(everyone, return_counts=True)

    def mean_s(grids: np.ndarray, nodes: int, precision: str) -> float:
        times = [time_ms[int(n), nodes, precision] for n in grids]
        return 1e-3 * float(np.average(times, weights=count))

    without_s = mean_s(rungs, optics.nodes, optics.precision)
    rows = []
    for item, grids, nodes, precision in variants:
        population = np.full_like(rungs, ladder[-1]) if grids is finest else rungs
        change = float(stamp_mse(sample.at(grids, nodes, precision), configured).max())
        with_s = mean_s(population, nodes, precision)
        rows.append(saving(item, scene.name, "star", with_s, without_s, change, AS_MSE))
    return rows


def imports(repeats: int, packages: Sequence[str] = PACKAGES) -> list[dict[str, Any]]:
    """Rows on packages that a stage does not load: start of an interpreter with and without.

    Packages that are not installed are left out.
    """
    from importlib.util import find_spec

    def start(*modules: str) -> float:
        command = [sys.executable, "-c", f"import {', '.join(modules)}"]

        def run() -> None:
            subprocess.run(command, check=True, capture_output=True)

        return time_calls(run, repeats).median_s

    alone = start(STAGE)
    return [
        saving(f"Import of {name}", "all", "process", start(STAGE, name), alone, 0.0, "none")
        for name in packages
        if find_spec(name) is not None
    ]


def stamp_timer(
    scene: Scene, case: Case, opd_of: Any, benchmark: Benchmark
) -> tuple[float, np.ndarray]:
    """Time of a star from its wavefront to its stamp, and the stamps of a batch.

    Parameters
    ----------
    opd_of : callable of a Pupil and a dtype
        Makes the OPD of `batch_of` stars.
    """
    kernel = kernel_of(scene, case)
    pupil: Pupil = pupil_of(case.samples, case.obscuration)
    batch = batch_of(scene.optics, benchmark)
    offset = np.repeat(case.offset_px, batch, axis=0)

    def run() -> np.ndarray:
        return kernel(opd_of(pupil, kernel.real_dtype), offset)

    calls = max(1, benchmark.stamps // batch)
    return time_calls(run, benchmark.repeats, calls).median_s / batch, run()
