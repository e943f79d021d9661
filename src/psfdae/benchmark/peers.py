"""Other ways to the same stamps: padded FFTs, POPPY and HCIPy.

All get the pupil array and the OPD array of our kernel. POPPY counts the phase
the other way, so its images are turned by 180°. They integrate over a pixel by
equal sub-samples, whose error falls as the square of their number. What a user
could reuse from star to star is built before the clock starts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.benchmark.cases import Case, pupil_of
from psfdae.benchmark.propagation import Setting, Trial, kernel_trials, time_trials, yes
from psfdae.benchmark.timing import use_threads
from psfdae.optics.pupil import Pupil
from psfdae.optics.sampling import ARCSEC
from psfdae.stars.framing import normalise_flux

if TYPE_CHECKING:
    import pandas as pd

WAVELENGTH_M = 1e-6
"""Any wavelength will do: OPDs are in waves and angles in λ/D of a 1 m pupil."""

FOCAL_LENGTH_M = 10.0

GRID_TOLERANCE = 5e-5
"""Relative error of the pixel scale that a grid of an FFT may have."""

REQUIRED_SPEEDUP = {"poppy_mft": 40.0, "poppy_fresnel": 400.0}
"""How many times faster than a peer the kernel has to be at equal error."""

KERNEL_STAMPS = 4
"""Stamps per timing of the kernel in units of `benchmark.stamps`."""

PEER_COLUMNS = (
    *("scene", "aberration", "method", "samples", "nodes", "precision", "threads"),
    *("time_ms", "mse", "within_budget"),
)

KERNEL_COLUMNS = ("samples", "nodes", "precision", "batch", "time_ms", "mse")

COMPARED = (
    *PEER_COLUMNS,
    *(f"kernel_{name}" for name in KERNEL_COLUMNS),
    *("speedup", "required", "met"),
)
"""Columns of the comparison at equal error."""

Propagate = Callable[[], np.ndarray]


@dataclass(frozen=True)
class Peer:
    """A method with its pupil samples, sub-samples per pixel and axis, and precision."""

    method: str
    samples: int
    nodes: int
    precision: str = "complex128"


def peers_of(case: Case, thorough: bool, coarse: int = 126) -> list[Peer]:
    """What is set beside the kernel for one case.

    Parameters
    ----------
    case : Case
    thorough : bool
        With the packages POPPY and HCIPy, and all sub-samplings.
    coarse : int
        Second grid size N beside that of the case.
    """
    fine = case.samples
    if not thorough:
        return [Peer("fft", fine, 2), Peer("fft_pruned", fine, 2)]
    chosen = [Peer("fft", fine, q, p) for q in (2, 4, 8) for p in ("complex64", "complex128")]
    chosen += [Peer("fft_pruned", fine, q, "complex64") for q in (2, 4, 8, 16)]
    for method in ("poppy_mft", "hcipy"):
        chosen += [Peer(method, coarse, q) for q in (2, 4, 8)]
        chosen += [Peer(method, fine, q) for q in (2, 4, 8, 16)]
        chosen += [Peer(method, fine, q, "complex64") for q in (4, 8)]
    sizes = ((coarse, 4), (fine, 2), (fine, 4), (fine, 8))
    # Fresnel propagation samples the image by the padding; below 2 it aliases its own phases.
    chosen += [Peer("poppy_fresnel", n, q) for n, q in sizes if q / case.pixel >= 2.0]
    return list(dict.fromkeys(chosen))


def peer_trials(
    cases: Sequence[Case], peers: Sequence[Sequence[Peer]], threads: int, stamps: int
) -> list[Trial]:
    """Trials of the peers, one list of peers per case, one stamp per call.

    Parameters
    ----------
    stamps : int
        Stamps per timing, but for Fresnel propagation, which takes long enough.
    """
    trials = []
    for case, chosen in zip(cases, peers, strict=True):
        for peer in chosen:
            use_threads("numpy", threads)
            samples, propagate = build(case, peer, threads)
            stamp = normalise_flux(propagate().astype(np.float64))[0]
            setting = (samples, peer.nodes, peer.precision, "numpy", threads, 1)
            calls = 1 if peer.method == "poppy_fresnel" else stamps
            again = partial(_repeated, case, peer, threads, calls)
            trials.append(Trial(case, peer.method, setting, stamp, again, calls))
    return trials


def _repeated(case: Case, peer: Peer, threads: int, calls: int) -> Callable[[], Any]:
    use_threads("numpy", threads)
    propagate = build(case, peer, threads)[1]
    propagate()
    return lambda: [propagate() for _ in range(calls)]


def time_methods(
    cases: Sequence[Case],
    settings: Sequence[Sequence[Setting]],
    peers: Sequence[Sequence[Peer]],
    threads: int,
    repeats: int,
    stamps: int,
) -> list[dict[str, Any]]:
    """Rows of the kernel and of its peers, in turn in one process; run it in a fresh one.

    Parameters
    ----------
    settings, peers : one list per case; an empty list of peers for none
    threads : int
        Threads of the peers.
    repeats : int
    stamps : int
        Size of a timing. The kernel does more than a peer: it is faster, and its
        threads start and get their scratch space once per set of stars.
    """
    trials = kernel_trials(cases, settings, KERNEL_STAMPS * stamps)
    return time_trials(
        [*trials, *peer_trials(cases, peers, threads, max(1, stamps // 16))], repeats
    )


def build(case: Case, peer: Peer, threads: int) -> tuple[int, Propagate]:
    """The pupil samples that a peer really has, and its propagation of one star."""
    if peer.method in ("fft", "fft_pruned"):
        return padded_fft(case, peer, threads)
    _limit_numexpr(threads)
    builders = {"poppy_mft": poppy_mft, "poppy_fresnel": poppy_fresnel, "hcipy": hcipy_fraunhofer}
    return builders[peer.method](case, peer)


def commensurate_grid(
    samples: int, pixel: float, subsamples: int, multiple: int = 2
) -> tuple[int, int]:
    """Pupil samples and padded size with which an FFT hits a pixel's sub-samples.

    The samples of the padded image are N/N_padded λ/D apart; a whole number of
    them must make a pixel.

    Parameters
    ----------
    samples : int
        Least number N of pupil samples; up to 30 % more are tried.
    pixel : float
        Pixel width in λ/D.
    subsamples : int
        Sub-samples per pixel and axis.
    multiple : int
        The padded size must be a multiple of it, N must be even.

    Returns
    -------
    samples, padded : int
        The smallest pair whose pixel scale is right within `GRID_TOLERANCE` and
        whose padded size suits the FFT; otherwise the most exact pair.
    """
    from scipy.fft import next_fast_len

    start = samples + samples % 2
    pairs = []
    for n in range(start, int(1.3 * samples) + 2, 2):
        padded = multiple * round(n * subsamples / pixel / multiple)
        mismatch = abs(n * subsamples / padded / pixel - 1.0)
        if mismatch < GRID_TOLERANCE and next_fast_len(padded) == padded:
            return n, padded
        pairs.append((mismatch, n, padded))
    return min(pairs)[1:]


def _towards_stamp(case: Case, pupil: Pupil, step: float = 0.0) -> np.ndarray:
    """OPD in waves that moves the centre of the stamp to the middle of the image.

    Parameters
    ----------
    step : float
        Sampling of an FFT's image in λ/D: its points lie half a step off those of a stamp.
    """
    row, column = -0.5 * (case.pixel * case.offset_px[0]) - 0.25 * step
    return row * pupil.axis[:, None] + column * pupil.axis[None, :]


def _subsamples(case: Case, subsamples: int) -> np.ndarray:
    """Indices of the stamp's sub-samples along an axis, 0 in the middle of the image."""
    side = case.stamp_px * subsamples
    return np.arange(side) - side // 2


def _bin(image: np.ndarray, subsamples: int) -> np.ndarray:
    side = image.shape[0] // subsamples
    return image.reshape(side, subsamples, side, subsamples).sum(axis=(1, 3))


def padded_fft(case: Case, peer: Peer, threads: int) -> tuple[int, Propagate]:
    """Zero-padded FFT of the pupil, binned to pixels.

    Method "fft" transforms the whole grid; "fft_pruned" leaves out the rows that
    hold no light and the columns that nobody looks at.
    """
    from scipy import fft

    samples, padded = commensurate_grid(peer.samples, case.pixel, peer.nodes)
    pupil, precision = pupil_of(samples, case.obscuration), np.dtype(peer.precision)
    opd = case.batch(pupil, 1, np.zeros(0, precision).real.dtype)[0]
    ramp = np.exp(2j * np.pi * _towards_stamp(case, pupil, samples / padded))
    amplitude = (pupil.amplitude * ramp).astype(precision)
    seen, size = _subsamples(case, peer.nodes) % padded, pupil.axis.size

    def whole() -> np.ndarray:
        grid = np.zeros((padded, padded), precision)
        grid[:size, :size] = amplitude * np.exp(2j * np.pi * opd)
        field = fft.fft2(grid, workers=threads, overwrite_x=True)
        return field[np.ix_(seen, seen)]

    def pruned() -> np.ndarray:
        pupil_rows = fft.fft(amplitude * np.exp(2j * np.pi * opd), n=padded, workers=threads)
        return fft.fft(pupil_rows[:, seen], n=padded, axis=0, workers=threads)[seen]

    field_of = whole if peer.method == "fft" else pruned
    return samples, lambda: _bin(np.abs(field_of()) ** 2, peer.nodes)


def poppy_mft(case: Case, peer: Peer) -> tuple[int, Propagate]:
    """POPPY's matrix DFT to a detector, binned to pixels."""
    import astropy.units as u
    import poppy

    pupil = pupil_of(peer.samples, case.obscuration)
    opd = case.batch(pupil, 1, np.dtype(float))[0] + _towards_stamp(case, pupil)
    opd_m = opd * WAVELENGTH_M
    element = _poppy_pupil(pupil, opd_m, peer)
    width = pupil.axis.size / peer.samples
    system = poppy.OpticalSystem(npix=pupil.axis.size, pupil_diameter=width * u.m, verbose=False)
    system.add_pupil(element)
    system.add_detector(
        pixelscale=case.pixel * WAVELENGTH_M / ARCSEC,
        fov_pixels=case.stamp_px,
        oversample=peer.nodes,
    )

    def propagate() -> np.ndarray:
        element.opd = opd_m
        return _bin(system.calc_psf(wavelength=WAVELENGTH_M)[0].data[::-1, ::-1], peer.nodes)

    return peer.samples, propagate


def poppy_fresnel(case: Case, peer: Peer) -> tuple[int, Propagate]:
    """POPPY's Fresnel propagation from the pupil through a lens to its focus, binned to pixels.

    The padding sets the sampling of the image, so that no interpolation is needed.
    """
    import astropy.units as u
    import poppy

    samples, padded, padding = fresnel_grid(case, peer)
    pupil, beam = pupil_of(samples, case.obscuration), padded // padding
    opd = case.batch(pupil, 1, np.dtype(float))[0]
    opd_m = (opd + _towards_stamp(case, pupil, samples / padded)) * WAVELENGTH_M
    element = _poppy_pupil(pupil, opd_m, peer)
    system = poppy.FresnelOpticalSystem(
        pupil_diameter=beam / samples * u.m, npix=beam, beam_ratio=1.0 / padding, verbose=False
    )
    focal_length = FOCAL_LENGTH_M * u.m
    system.add_optic(element)
    system.add_optic(poppy.QuadraticLens(focal_length))
    focus = poppy.ScalarTransmission(planetype=poppy.poppy_core.PlaneType.image, name="focus")
    system.add_optic(focus, distance=focal_length)
    seen = padded // 2 - _subsamples(case, peer.nodes)

    def propagate() -> np.ndarray:
        element.opd = opd_m
        image = system.calc_psf(wavelength=WAVELENGTH_M)[0].data
        return _bin(image[np.ix_(seen, seen)], peer.nodes)

    return samples, propagate


def fresnel_grid(case: Case, peer: Peer) -> tuple[int, int, int]:
    """Pupil samples, samples of the whole padded array, and padding factor (a power of two)."""
    padding = 2 ** int(np.log2(peer.nodes / case.pixel))
    return *commensurate_grid(peer.samples, case.pixel, peer.nodes, 2 * padding), padding


def _poppy_pupil(pupil: Pupil, opd_m: np.ndarray, peer: Peer) -> Any:
    """POPPY's element with our arrays, on a pupil of 1 m; sets POPPY's precision, too."""
    import logging

    import astropy.units as u
    import poppy

    logging.getLogger("poppy").setLevel(logging.ERROR)
    poppy.conf.double_precision = peer.precision == "complex128"
    scale = 0.5 * pupil.spacing * u.m / u.pixel
    return poppy.ArrayOpticalElement(
        transmission=pupil.amplitude, opd=opd_m, pixelscale=scale, name="pupil"
    )


def hcipy_fraunhofer(case: Case, peer: Peer) -> tuple[int, Propagate]:
    """HCIPy's Fraunhofer propagator with the transform that it picks, binned to pixels."""
    import hcipy

    pupil, precision = pupil_of(peer.samples, case.obscuration), np.dtype(peer.precision)
    opd = case.batch(pupil, 1, np.zeros(0, precision).real.dtype)[0].ravel()
    width = pupil.axis.size * pupil.spacing / 2.0
    grid = hcipy.make_pupil_grid(pupil.axis.size, width)
    side, step = case.stamp_px * peer.nodes, case.pixel / peer.nodes
    corner = case.pixel * case.offset_px[0, ::-1] - 0.5 * (side - 1) * step
    image_grid = hcipy.CartesianGrid(hcipy.RegularCoords([step] * 2, [side] * 2, corner))
    propagator = hcipy.FraunhoferPropagator(grid, image_grid, focal_length=1.0)
    amplitude = pupil.amplitude.ravel().astype(precision)

    def propagate() -> np.ndarray:
        field = hcipy.Field(amplitude * np.exp(2j * np.pi * opd), grid)
        image = propagator(hcipy.Wavefront(field, 1.0)).intensity
        return _bin(np.asarray(image).reshape(side, side), peer.nodes)

    return peer.samples, propagate


def _limit_numexpr(threads: int) -> None:
    """POPPY and HCIPy use numexpr's own threads where it is installed."""
    try:
        import numexpr
    except ImportError:
        return
    numexpr.set_num_threads(threads)


def compare(table: pd.DataFrame) -> pd.DataFrame:
    """Every setting of a peer beside our cheapest setting that errs no more.

    Both were timed in one process (backend numpy) with the same threads.

    Parameters
    ----------
    table : DataFrame
        Rows of `psfdae.benchmark.propagation`.

    Returns
    -------
    DataFrame
        Columns `COMPARED`; peers that err less than every setting of ours are left out.
    """
    import pandas as pd

    ours = table[(table["method"] == "kernel") & (table["backend"] == "numpy")]
    rows = []
    for peer in table[table["method"] != "kernel"].to_dict("records"):
        as_good = ours[
            (ours["scene"] == peer["scene"])
            & (ours["aberration"] == peer["aberration"])
            & (ours["threads"] == peer["threads"])
            & (ours["mse"] <= peer["mse"])
        ]
        if as_good.empty:
            continue
        best = as_good.loc[as_good["time_ms"].idxmin()]
        speedup = peer["time_ms"] / best["time_ms"]
        required = REQUIRED_SPEEDUP.get(peer["method"])
        verdict = "" if required is None else yes(speedup >= required)
        theirs = [peer[name] for name in PEER_COLUMNS]
        rows.append((*theirs, *best[list(KERNEL_COLUMNS)], speedup, required, verdict))
    return pd.DataFrame(rows, columns=list(COMPARED))
