"""Other ways to the same stamps: padded FFTs, POPPY and HCIPy.

All get the pupil array and the OPD array of our kernel. POPPY counts the phase the other
way, so its images are turned by 180°. They integrate over a pixel by equal sub-samples,
whose error falls as the square of their number. What a user could reuse from star to star is
built before the clock starts.
"""

import logging
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module

import numpy as np

from kernel import Setting, Trial, kernel_trials, time_trials
from measure import use_threads, yes
from psfdae.optics.pupil import ARCSEC
from psfdae.stars.framing import normalise_flux
from scenes import pupil_of

WAVELENGTH_M = 1e-6  # any will do: OPDs are in waves and angles in λ/D of a 1 m pupil
FOCAL_LENGTH_M = 10.0
GRID_TOLERANCE = 5e-5  # relative error of the pixel scale of an FFT's grid
REQUIRED_SPEEDUP = {"poppy_mft": 40.0, "poppy_fresnel": 400.0}  # of the kernel at equal error
KERNEL_STAMPS = 4  # per timing of the kernel in units of `benchmark.stamps`

PEER_COLUMNS = ["scene", "aberration", "method", "samples", "nodes", "precision", "threads"]
PEER_COLUMNS += ["time_ms", "mse", "within_budget"]
KERNEL_COLUMNS = ["samples", "nodes", "precision", "batch", "time_ms", "mse"]


@dataclass(frozen=True)
class Peer:
    """A method with its pupil samples, sub-samples per pixel and axis, and precision."""

    method: str
    samples: int
    nodes: int
    precision: str = "complex128"


def peers_of(case, thorough, coarse=126):
    """What is set beside the kernel: FFTs and, if thorough, POPPY and HCIPy on two grids."""
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


def peer_trials(cases, peers, threads, stamps):
    """Trials of the peers, a list per case, one stamp per call.

    A timing has `stamps`, but one of Fresnel propagation, which takes long enough.
    """
    trials = []
    for case, chosen in zip(cases, peers, strict=True):
        for peer in chosen:
            use_threads("numpy", threads)
            samples, propagate = build(case, peer, threads)
            stamp = normalise_flux(propagate().astype(np.float64))[0]
            setting = Setting(samples, peer.nodes, peer.precision, "numpy", threads, 1)
            calls = 1 if peer.method == "poppy_fresnel" else stamps
            again = partial(_repeated, case, peer, threads, calls)
            trials.append(Trial(case, peer.method, setting, stamp, again, calls))
    return trials


def _repeated(case, peer, threads, calls):
    use_threads("numpy", threads)
    propagate = build(case, peer, threads)[1]
    propagate()
    return lambda: [propagate() for _ in range(calls)]


def time_methods(cases, settings, peers, threads, repeats, stamps):
    """Rows of the kernel and of its peers, one list per case, in turn in one process.

    The kernel does more than a peer per timing: it is faster, and its threads start and get
    their scratch space once per set of stars.
    """
    trials = kernel_trials(cases, settings, KERNEL_STAMPS * stamps)
    trials += peer_trials(cases, peers, threads, max(1, stamps // 16))
    return time_trials(trials, repeats)


def build(case, peer, threads):
    """The pupil samples that a peer really has, and its propagation of one star to pixels."""
    builders = {"poppy_mft": poppy_mft, "poppy_fresnel": poppy_fresnel, "hcipy": hcipy_fraunhofer}
    builder = builders.get(peer.method, partial(padded_fft, threads=threads))
    with suppress(ImportError):  # POPPY and HCIPy use numexpr's own threads where there is one
        import_module("numexpr").set_num_threads(threads)
    samples, fine_image = builder(case, peer)
    return samples, lambda: _bin(fine_image(), peer.nodes)


def commensurate_grid(samples, pixel, subsamples, multiple=2):
    """Pupil samples and padded size with which an FFT hits a pixel's sub-samples.

    The samples of the padded image are N/N_padded λ/D apart; a whole number of them must make
    a pixel of width `pixel` λ/D. N is even, at least `samples` and up to 30 % more, the padded
    size a `multiple`: the smallest pair whose pixel scale is right within `GRID_TOLERANCE` and
    whose padded size suits the FFT; otherwise the most exact pair.
    """
    from scipy.fft import next_fast_len

    pairs = []
    for n in range(samples + samples % 2, int(1.3 * samples) + 2, 2):
        padded = multiple * round(n * subsamples / pixel / multiple)
        mismatch = abs(n * subsamples / padded / pixel - 1.0)
        if mismatch < GRID_TOLERANCE and next_fast_len(padded) == padded:
            return n, padded
        pairs.append((mismatch, n, padded))
    return min(pairs)[1:]


def _towards_stamp(case, pupil, step=0.0):
    """OPD in waves that moves the centre of the stamp to the middle of the image.

    The points of an FFT's image of sampling `step` λ/D lie half a step off those of a stamp.
    """
    row, column = -0.5 * (case.pixel * case.offset_px[0]) - 0.25 * step
    return row * pupil.axis[:, None] + column * pupil.axis[None, :]


def _subsamples(case, subsamples):
    """Indices of the stamp's sub-samples along an axis, 0 in the middle of the image."""
    side = case.stamp_px * subsamples
    return np.arange(side) - side // 2


def _bin(image, subsamples):
    side = image.shape[0] // subsamples
    return image.reshape(side, subsamples, side, subsamples).sum(axis=(1, 3))


def padded_fft(case, peer, threads):
    """Zero-padded FFT of the pupil.

    Method "fft" transforms the whole grid; "fft_pruned" leaves out the rows that hold no
    light and the columns that nobody looks at.
    """
    from scipy import fft

    samples, padded = commensurate_grid(peer.samples, case.pixel, peer.nodes)
    pupil, precision = pupil_of(samples, case.obscuration), np.dtype(peer.precision)
    opd = case.batch(pupil, 1, np.zeros(0, precision).real.dtype)[0]
    ramp = np.exp(2j * np.pi * _towards_stamp(case, pupil, samples / padded))
    amplitude = (pupil.amplitude * ramp).astype(precision)
    seen, size = _subsamples(case, peer.nodes) % padded, pupil.axis.size

    def whole():
        grid = np.zeros((padded, padded), precision)
        grid[:size, :size] = amplitude * np.exp(2j * np.pi * opd)
        return fft.fft2(grid, workers=threads, overwrite_x=True)[np.ix_(seen, seen)]

    def pruned():
        rows = fft.fft(amplitude * np.exp(2j * np.pi * opd), n=padded, workers=threads)
        return fft.fft(rows[:, seen], n=padded, axis=0, workers=threads)[seen]

    field_of = whole if peer.method == "fft" else pruned
    return samples, lambda: np.abs(field_of()) ** 2


def poppy_mft(case, peer):
    """POPPY's matrix DFT to a detector."""
    import astropy.units as u
    import poppy

    pupil = pupil_of(peer.samples, case.obscuration)
    width = pupil.axis.size / peer.samples
    system = poppy.OpticalSystem(npix=pupil.axis.size, pupil_diameter=width * u.m, verbose=False)
    image = _poppy_image(system, system.add_pupil, case, peer, pupil)
    scale = case.pixel * WAVELENGTH_M / ARCSEC
    system.add_detector(pixelscale=scale, fov_pixels=case.stamp_px, oversample=peer.nodes)
    return peer.samples, lambda: image()[::-1, ::-1]


def poppy_fresnel(case, peer):
    """POPPY's Fresnel propagation from the pupil through a lens to its focus.

    The padding sets the sampling of the image, so that no interpolation is needed.
    """
    import astropy.units as u
    import poppy

    samples, padded, padding = fresnel_grid(case, peer)
    pupil, beam = pupil_of(samples, case.obscuration), padded // padding
    system = poppy.FresnelOpticalSystem(
        pupil_diameter=beam / samples * u.m, npix=beam, beam_ratio=1.0 / padding, verbose=False
    )
    image = _poppy_image(system, system.add_optic, case, peer, pupil, samples / padded)
    focal_length = FOCAL_LENGTH_M * u.m
    system.add_optic(poppy.QuadraticLens(focal_length))
    focus = poppy.ScalarTransmission(planetype=poppy.poppy_core.PlaneType.image, name="focus")
    system.add_optic(focus, distance=focal_length)
    seen = np.ix_(*[padded // 2 - _subsamples(case, peer.nodes)] * 2)
    return samples, lambda: image()[seen]


def fresnel_grid(case, peer):
    """Pupil samples, samples of the whole padded array, and padding factor (a power of two)."""
    padding = 2 ** int(np.log2(peer.nodes / case.pixel))
    return *commensurate_grid(peer.samples, case.pixel, peer.nodes, 2 * padding), padding


def _poppy_image(system, add, case, peer, pupil, step=0.0):
    """Image of a system, as a function, that begins with our arrays on a pupil of 1 m.

    Sets POPPY's precision, too.
    """
    import astropy.units as u
    import poppy

    logging.getLogger("poppy").setLevel(logging.ERROR)
    poppy.conf.double_precision = peer.precision == "complex128"
    opd_m = (case.batch(pupil, 1, float)[0] + _towards_stamp(case, pupil, step)) * WAVELENGTH_M
    scale = 0.5 * pupil.spacing * u.m / u.pixel
    element = poppy.ArrayOpticalElement(
        transmission=pupil.amplitude, opd=opd_m, pixelscale=scale, name="pupil"
    )
    add(element)

    def image():
        element.opd = opd_m
        return system.calc_psf(wavelength=WAVELENGTH_M)[0].data

    return image


def hcipy_fraunhofer(case, peer):
    """HCIPy's Fraunhofer propagator with the transform that it picks."""
    import hcipy

    pupil = pupil_of(peer.samples, case.obscuration)
    opd = case.batch(pupil, 1, np.zeros(0, peer.precision).real.dtype)[0].ravel()
    grid = hcipy.make_pupil_grid(pupil.axis.size, pupil.axis.size * pupil.spacing / 2.0)
    side, step = case.stamp_px * peer.nodes, case.pixel / peer.nodes
    corner = case.pixel * case.offset_px[0, ::-1] - 0.5 * (side - 1) * step
    image_grid = hcipy.CartesianGrid(hcipy.RegularCoords([step] * 2, [side] * 2, corner))
    propagator = hcipy.FraunhoferPropagator(grid, image_grid, focal_length=1.0)
    amplitude = pupil.amplitude.ravel().astype(peer.precision)

    def image():
        field = hcipy.Field(amplitude * np.exp(2j * np.pi * opd), grid)
        intensity = propagator(hcipy.Wavefront(field, 1.0)).intensity
        return np.asarray(intensity).reshape(side, side)

    return peer.samples, image


def compare(table):
    """Every setting of a peer beside our cheapest setting that errs no more.

    Both were timed in one process (backend numpy) with the same threads. Peers that err less
    than every setting of ours are left out.
    """
    import pandas as pd

    ours = table[(table["method"] == "kernel") & (table["backend"] == "numpy")]
    rows = []
    for peer in table[table["method"] != "kernel"].to_dict("records"):
        same = [ours[key] == peer[key] for key in ("scene", "aberration", "threads")]
        as_good = ours[np.logical_and.reduce([*same, ours["mse"] <= peer["mse"]])]
        if as_good.empty:
            continue
        best = as_good.loc[as_good["time_ms"].idxmin()]
        speedup = peer["time_ms"] / best["time_ms"]
        required = REQUIRED_SPEEDUP.get(peer["method"])
        verdict = "" if required is None else yes(speedup >= required)
        theirs = [peer[name] for name in PEER_COLUMNS]
        rows.append((*theirs, *best[KERNEL_COLUMNS], speedup, required, verdict))
    ours = [f"kernel_{name}" for name in KERNEL_COLUMNS]
    return pd.DataFrame(rows, columns=[*PEER_COLUMNS, *ours, "speedup", "required", "met"])
