"""Ways from a wavefront to its stamp, timed alike: our kernel, padded FFTs, POPPY, HCIPy.

All get the pupil array and the OPD array of our kernel. POPPY counts the phase the other
way, so its images are turned by 180°. The peers integrate over a pixel by equal sub-samples,
whose error falls as the square of their number. What a user could reuse from star to star is
built before the clock starts.
"""

import logging
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import import_module
from itertools import product

import numpy as np

from measure import isolate, pareto, time_in_rounds, use_threads, yes
from psfdae.base.threads import run_parallel
from psfdae.optics.propagation import EXTRA_POINTS, StampPropagator
from psfdae.optics.pupil import SamplingError
from psfdae_paper.stars.framing import normalise_flux
from scenes import pupil_of

GRIDS = (
    62,
    94,
    126,
    158,
    190,
    286,
)  # pupil samples tried beside the configured ones; even with guard cells
POINTS = (0, 2, 4, EXTRA_POINTS, EXTRA_POINTS + 2)  # extra points of the kernel
BATCHES = (1, 4, 16, 64)  # stamps per call
PRECISIONS = ("complex64", "complex128")
WAVELENGTH_M = 1e-6  # any will do: OPDs are in waves and angles in λ/D of a 1 m pupil
FOCAL_LENGTH_M = 10.0
GRID_TOLERANCE = 5e-5  # relative error of the pixel scale of an FFT's grid
REQUIRED_SPEEDUP = {"poppy_mft": 40.0, "poppy_fresnel": 400.0}  # of the kernel at equal error
KERNEL_STAMPS = 4  # per timing of the kernel in units of `benchmark.stamps`

EQUAL = ["scene", "aberration", "threads", "processes"]
PEER_COLUMNS = ["scene", "aberration", "method", "samples", "points", "precision", "threads"]
PEER_COLUMNS += ["processes", "time_ms", "mse", "within_budget"]
TIMES = ["time_ms", "time_ms_low", "time_ms_high"]
KERNEL_COLUMNS = ["samples", "points", "precision", "batch", "time_ms", "mse"]


@dataclass(frozen=True)
class Setting:
    """One way to run a method: `points` are sub-samples per pixel, or the kernel's extra points."""

    method: str
    samples: int
    points: int
    precision: str = "complex128"
    backend: str = "numpy"
    threads: int = 1
    batch: int = 1
    processes: int = 1


def candidate_samples(optics, thorough):
    """Grid sizes N to try: the configured grid_sizes, coarser ones and those between, ascending."""
    first, *_, last = optics.pupil_samples
    coarser = GRIDS if thorough else [n for n in GRIDS if n < first][-1:]
    return sorted({*(n for n in coarser if n < last), *optics.pupil_samples})


def configured_setting(optics, benchmark, samples):
    """The kernel of the config for a wavefront that is given N `samples`.

    Its batch is the configured one, but no more than are timed.
    """
    batch = min(optics.batch, benchmark.stamps)
    options = (EXTRA_POINTS, optics.precision, optics.backend, optics.threads, batch)
    return Setting("kernel", samples, *options)


def kernel_settings(optics, benchmark, samples, backend):
    """Settings that are timed for a wavefront that is given N `samples`.

    Grid sizes and points in numpy, at the configured precision and batch and on all threads; in
    either backend precisions, batches and threads around the setting in use.
    """
    used = replace(configured_setting(optics, benchmark, samples), backend=backend)
    grids = candidate_samples(optics, benchmark.peers)
    points = POINTS if benchmark.peers else POINTS[-2:]
    threads, batches = sorted({1, benchmark.threads}), BATCHES if benchmark.peers else (1,)
    options = (used.precision, backend, benchmark.threads, used.batch)
    shapes = product(grids, points) if backend == "numpy" else ()
    settings = [Setting("kernel", *shape, *options) for shape in shapes]
    for precision, t, batch in product(PRECISIONS, threads, batches):
        settings.append(replace(used, precision=precision, threads=t, batch=batch))
    return list(dict.fromkeys([*settings, used]))


def list_peers(case, benchmark, coarse=126):
    """Return settings of other codes: FFTs and, if wanted, POPPY and HCIPy on two grids."""
    fine, single = case.samples, {"precision": "complex64"}
    if not benchmark.peers:
        peers = [Setting("fft", fine, 2), Setting("fft_pruned", fine, 2)]
    else:
        peers = [Setting("fft", fine, q, p) for q in (2, 4, 8) for p in PRECISIONS]
        peers += [Setting("fft_pruned", fine, q, **single) for q in (2, 4, 8, 16)]
        for method in ("poppy_mft", "hcipy"):
            peers += [Setting(method, coarse, q) for q in (2, 4, 8)]
            peers += [Setting(method, fine, q) for q in (2, 4, 8, 16)]
            peers += [Setting(method, fine, q, **single) for q in (4, 8)]
        sizes = ((coarse, 4), (fine, 2), (fine, 4), (fine, 8))
        # Fresnel propagation samples the image by the padding; below 2 it aliases its phases.
        peers += [Setting("poppy_fresnel", n, q) for n, q in sizes if q / case.pixel >= 2.0]
    return [replace(peer, threads=benchmark.threads) for peer in dict.fromkeys(peers)]


def time_settings(pairs, repeats, stamps):
    """Rows of pairs of a case and a setting, timed in turn in this process.

    Times are those of one stamp, whatever ran beside it. The kernel does more per timing than
    a peer: it is faster, and its threads start and get their scratch space once per set of
    stars. Settings that a wavefront refuses (its grid would alias) are left out.
    """
    trials, builders = [], []
    for case, setting in pairs:
        try:
            samples, propagate = build(case, replace(setting, batch=1))
        except SamplingError:
            continue
        difference = normalise_flux(propagate().astype(np.float64))[0][0] - case.truth
        batches = max(1, stamps // 16)
        if setting.method == "kernel":
            batches = max(setting.threads, KERNEL_STAMPS * stamps // setting.batch)
        elif setting.method == "poppy_fresnel":  # takes long enough
            batches = 1
        trials.append((case, replace(setting, samples=samples), difference, batches))
        builders.append(partial(prepare_batches, case, setting, batches))
    timed, rows = time_in_rounds(builders, repeats), []
    for (case, setting, difference, batches), seconds in zip(trials, timed, strict=True):
        low, median, high = 1e3 * np.percentile(seconds, [25, 50, 75]) / (batches * setting.batch)
        mse = float((difference**2).mean())
        row = {"scene": case.scene, "aberration": case.aberration, **asdict(setting)}
        row |= {"repeats": repeats, "time_ms": median, "time_ms_low": low, "time_ms_high": high}
        row |= {"error_peak": np.abs(difference).max() / case.truth.max(), "mse": mse}
        rows.append({**row, "budget": case.budget, "within_budget": yes(mse <= case.budget)})
    return rows


def time_in_processes(pairs, repeats, stamps, processes):
    """Rows of `time_settings` where so many processes of one thread run side by side.

    The time of a stamp is that of one process over their number.
    """
    results = isolate(1, time_settings, pairs, repeats, stamps, processes=processes)
    rows = []
    for copies in zip(*results, strict=True):
        times = {key: np.mean([r[key] for r in copies]) / processes for key in TIMES}
        rows.append({**copies[0], **times, "processes": processes})
    return rows


def prepare_batches(case, setting, batches):
    """A callable that propagates so many batches, set up and warmed up."""
    _, propagate = build(case, setting)
    # The kernel's numpy batches run side by side as in a scene, torch's on its own threads.
    threads = setting.threads if (setting.method, setting.backend) == ("kernel", "numpy") else 1

    def run(count):
        run_parallel(lambda _: propagate(), range(count), threads)

    run(threads)
    return partial(run, batches)


def build(case, setting):
    """Pupil samples that a method really has, and its stamps (batch, d, d) as a function.

    Sets the threads of the libraries that it uses.
    """
    if setting.method == "kernel":
        use_threads(setting.backend, 1 if setting.backend == "numpy" else setting.threads)
        propagate, opd = kernel(case, setting, case.stamp_px)
        offset = np.repeat(case.offset_px, setting.batch, axis=0)
        return setting.samples, partial(propagate, opd, offset)
    use_threads("numpy", setting.threads)
    with suppress(ImportError):  # POPPY and HCIPy use numexpr's own threads where there is one
        import_module("numexpr").set_num_threads(setting.threads)
    builders = {"poppy_mft": poppy_mft, "poppy_fresnel": poppy_fresnel, "hcipy": hcipy_fraunhofer}
    samples, fine_image = builders.get(setting.method, padded_fft)(case, setting)
    return samples, lambda: _bin(fine_image(), setting.points)[None]


def kernel(case, setting, stamp_px):
    """Our propagation to stamps of a side, and the OPDs of a batch."""
    pupil = pupil_of(setting.samples, case.obscuration)
    settings = (setting.points, setting.precision, setting.backend)
    propagate = StampPropagator(pupil, stamp_px, case.pixel, *settings)
    return propagate, case.batch(pupil, setting.batch, propagate.real_dtype)


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


def padded_fft(case, peer):
    """Zero-padded FFT of the pupil.

    Method "fft" transforms the whole grid; "fft_pruned" leaves out the rows that hold no
    light and the columns that nobody looks at.
    """
    from scipy import fft

    samples, padded = commensurate_grid(peer.samples, case.pixel, peer.points)
    pupil, precision = pupil_of(samples, case.obscuration), np.dtype(peer.precision)
    opd = case.batch(pupil, 1, np.zeros(0, precision).real.dtype)[0]
    ramp = np.exp(2j * np.pi * _towards_stamp(case, pupil, samples / padded))
    amplitude = (pupil.amplitude * ramp).astype(precision)
    points, size = _subsamples(case, peer.points) % padded, pupil.axis.size

    def unpruned():
        grid = np.zeros((padded, padded), precision)
        grid[:size, :size] = amplitude * np.exp(2j * np.pi * opd)
        return fft.fft2(grid, workers=peer.threads, overwrite_x=True)[np.ix_(points, points)]

    def pruned():
        rows = fft.fft(amplitude * np.exp(2j * np.pi * opd), n=padded, workers=peer.threads)
        return fft.fft(rows[:, points], n=padded, axis=0, workers=peer.threads)[points]

    field_of = unpruned if peer.method == "fft" else pruned
    return samples, lambda: np.abs(field_of()) ** 2


def poppy_mft(case, peer):
    """POPPY's matrix DFT to a detector."""
    import astropy.units as u
    import poppy

    pupil = pupil_of(peer.samples, case.obscuration)
    width = pupil.axis.size / peer.samples
    system = poppy.OpticalSystem(npix=pupil.axis.size, pupil_diameter=width * u.m, verbose=False)
    image = _poppy_image(system, system.add_pupil, case, peer, pupil)
    scale = case.pixel * WAVELENGTH_M / np.deg2rad(1.0 / 3600.0)
    system.add_detector(pixelscale=scale, fov_pixels=case.stamp_px, oversample=peer.points)
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
    points = np.ix_(*[padded // 2 - _subsamples(case, peer.points)] * 2)
    return samples, lambda: image()[points]


def fresnel_grid(case, peer):
    """Pupil samples, samples of the whole padded array, and padding factor (a power of two)."""
    padding = 2 ** int(np.log2(peer.points / case.pixel))
    return *commensurate_grid(peer.samples, case.pixel, peer.points, 2 * padding), padding


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
    side, step = case.stamp_px * peer.points, case.pixel / peer.points
    corner = case.pixel * case.offset_px[0, ::-1] - 0.5 * (side - 1) * step
    image_grid = hcipy.CartesianGrid(hcipy.RegularCoords([step] * 2, [side] * 2, corner))
    propagator = hcipy.FraunhoferPropagator(grid, image_grid, focal_length=1.0)
    amplitude = pupil.amplitude.ravel().astype(peer.precision)

    def image():
        field = hcipy.Field(amplitude * np.exp(2j * np.pi * opd), grid)
        intensity = propagator(hcipy.Wavefront(field, 1.0)).intensity
        return np.asarray(intensity).reshape(side, side)

    return peer.samples, image


def mark_pareto_fronts(rows, used):
    """The table with its Pareto fronts and the settings in use, by aberration."""
    import pandas as pd

    table = pd.DataFrame(rows).assign(pareto="no")
    for _, group in table.groupby(["scene", "aberration"]):
        front = pareto(group["time_ms"].to_numpy(), group["mse"].to_numpy())
        table.loc[group.index[front], "pareto"] = "yes"
    in_use = [asdict(used[row["aberration"]]).items() <= row.items() for row in rows]
    return table.assign(used=np.where(in_use, "yes", "no"))


def compare(table):
    """Every setting of a peer beside our cheapest setting that errs no more.

    Both were timed in the same way (backend numpy), in one process with the same threads or
    in as many processes. Peers that err less than every setting of ours are left out.
    """
    kernel = table[(table["method"] == "kernel") & (table["backend"] == "numpy")]
    kernel = kernel[[*EQUAL, *KERNEL_COLUMNS]]
    kernel = kernel.rename(columns={name: f"kernel_{name}" for name in KERNEL_COLUMNS})
    peers = table.loc[table["method"] != "kernel", PEER_COLUMNS].reset_index()
    pairs = peers.merge(kernel, on=EQUAL).query("kernel_mse <= mse").reset_index(drop=True)
    fastest = pairs.groupby("index")["kernel_time_ms"].idxmin()
    rows = pairs.loc[fastest].drop(columns="index").reset_index(drop=True)
    rows["speedup"] = rows["time_ms"] / rows["kernel_time_ms"]
    rows["required"] = rows["method"].map(REQUIRED_SPEEDUP)
    is_met = (rows["speedup"] >= rows["required"]).map(yes)
    return rows.assign(met=is_met.where(rows["required"].notna(), ""))
