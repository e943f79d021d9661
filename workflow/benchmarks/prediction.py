"""How fast `psfdae predict` is, and how good on stars that another package has simulated.

Pupil, wavefront, propagation and pixels of these are POPPY's (Perrin et al. 2012, Proc. SPIE
8442), from the recipe alone; of ours are only the random numbers and the rule that frames a star.
"""

import logging
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from timeit import Timer
from typing import Annotated

import click
import numpy as np

from measure import isolate, measure_command, write, yes
from psfdae.base.belonging import STARS, require
from psfdae.base.files import read_product
from psfdae.base.options import File
from psfdae.base.rng import stream
from psfdae.base.settings import ConfigError
from psfdae.commands.cli import program
from psfdae.stars.noise import NoiseModel, draw_levels
from psfdae.stars.splits import draw_jitter
from psfdae.training import star_sets
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.compose import part
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stars.fields import assign_fields, perturb, relative_field
from psfdae_paper.stars.framing import brightest_pixel, crop_jittered, normalise_flux

REQUIRED_SHARE = 0.6  # of the bare network's throughput, which a prediction must reach
ALLOWED_MB = 1000.0  # memory in MiB that it may take
ALLOWED_RATIO = 0.1  # relative difference of the MSE from that of the workflow's own stars
REPEATS = 3  # timings at most; each takes as long as three predictions
WARM_UP = 4  # blocks of stars that are computed before the clock starts
BARE_STAMPS = 8192  # that the bare network sees over and over: it must not fill the memory
SAMPLES = 256  # of POPPY across the pupil
BRIGHTNESS = ("brightest", "others")  # of the pixels of a star
FALSE_ALARMS = 0.01  # fraction of typical stars above a limit
NOISY_EACH = 4  # noisy images of each star: of one each, too few would make the limit
COMPANION_FLUX, COMPANION_PX = 0.3, 3.0  # of a neighbour, in units of the star's, and its distance
RAY_FLUX, RAY_PX = 0.03, 3  # of a cosmic ray in a pixel, and its length
OVERSAMPLING = 4  # its sub-samples per pixel and axis; their error falls with the square

READS = (*SIMULATION, "noise", "benchmark")
TESTED = (*READS, "parts")


@command("throughput", reads=READS)
def throughput(
    config: Config,
    stars: Annotated[File, "Product of the stage stars."],
    bundle: Annotated[File, "Model bundle of the dataset, of a network."],
    mixture: Annotated[File, "Another, of a mixture."],
    out: Annotated[File, "CSV with stamps per second and memory."],
) -> None:
    """Time predict from FITS to FITS beside the bare network, on a quiet machine."""
    require(stars, read_product(stars, "stars", ()).config, STARS, config)
    for model in (bundle, mixture):
        require_bundle(model, config)
    settings = config.benchmark
    work = (settings.star_counts[-1], settings.threads, min(settings.repeats, REPEATS))
    with TemporaryDirectory() as folder:
        cube = Path(folder, "stars.fits")
        isolate(1, make_cube, config.model_dump(), stars, work[0], cube)
        rates, peak_mb = isolate(settings.threads, time_prediction, cube, bundle, mixture, *work)
    bare = max(rates["bare_shared_per_s"], rates["bare_parallel_per_s"])
    share = rates["predict_per_s"] / bare
    row = {"stamps": work[0], "stamp_px": config.framing.stamp_px, "threads": work[1]}
    row |= {"repeats": work[2], **rates, "bare_per_s": bare}
    row |= {"share": share, "required_share": REQUIRED_SHARE}
    row |= {"peak_mb": peak_mb, "allowed_mb": ALLOWED_MB}
    write(out, [row | {"met": yes(share >= REQUIRED_SHARE and peak_mb < ALLOWED_MB)}])


def make_cube(tree, stars, count, out):
    """Write a FITS cube of the noise-free stars of a product in turn, sky and noise added."""
    from psfdae_paper.stars.example import write_cube

    images = read_product(stars, "stars", ("realisation",))["realisation"]
    rng = stream(tree["seed"], "prediction", "cube")
    noise = NoiseModel(tree["noise"]["kappa"], tree["noise"]["background_photons"])
    cube = np.empty((count, *images.shape[1:]), np.float32)
    for start in range(0, count, BARE_STAMPS):
        rows = np.arange(start, min(start + BARE_STAMPS, count))
        flux = noise.flux(draw_levels(np.asarray(tree["noise"]["levels"]), rows.size, rng))
        light = flux[:, None, None] * images[rows % len(images)]
        cube[rows] = rng.poisson(light + noise.background)
    write_cube(out, cube, PIXSCALE=tree["telescope"]["pixel_scale_arcsec"], GAIN=1.0)


def time_prediction(cube, bundle, mixture, stamps, threads, repeats):
    """Medians of stamps per second of `psfdae predict` and of the bare network, in turn.

    Those of the mixture are from one run.

    The bare network runs in one forward pass at a time on all threads ("shared"), and in as
    many passes as threads beside each other. Then the memory of the prediction in MiB,
    interpreter and libraries included.
    """
    from psfdae.api import load_model

    model, peak = load_model(bundle), 0.0
    side = model.info.stamp_px
    warm_up = np.zeros((WARM_UP * model.denoiser.block_size, side, side), np.float32)
    model.predict(warm_up, threads=threads)
    options = ["--model", bundle, "--threads", threads, "--overwrite", "--quiet"]
    rates = {"bare_shared": [], "bare_parallel": [], "predict": []}
    for _ in range(repeats):
        cost = measure_command(["predict", cube, *options], cube.with_name("psf.fits"))
        peak = max(peak, cost["peak_b"])
        rates["predict"].append(stamps / cost["time_s"])
        for way in ("shared", "parallel"):
            rates[f"bare_{way}"].append(time_network(model, stamps, threads, way))
    options[1] = mixture
    cost = measure_command(["predict", cube, *options], cube.with_name("psf.fits"))
    peak, rates["mixture"] = max(peak, cost["peak_b"]), [stamps / cost["time_s"]]
    medians = {f"{name}_per_s": np.median(values) for name, values in rates.items()}
    return medians, peak / 2**20


def time_network(model, stamps, threads, way):
    """Stamps per second of the network alone, on images that are in memory."""
    import torch

    from psfdae.base.threads import run_parallel, use_one_thread_each
    from psfdae.methods.networks.dae import run_network

    side, factor, network = model.stamp_px, model.info.image_scale, model.method.network
    mean = model.bundle.flux_model.mean.reshape(1, side, side).astype(np.float32)
    images = np.repeat(mean, min(BARE_STAMPS, stamps), axis=0)
    rounds = -(-stamps // len(images))
    size = model.denoiser.block_size
    blocks = rounds * np.array_split(images, range(size, len(images), size))

    def apply(images):
        return run_network(network, images, factor, size)

    if way == "shared":
        threads_before = torch.get_num_threads()
        torch.set_num_threads(threads)
        seconds = Timer(partial(apply, images)).timeit(rounds)
        torch.set_num_threads(threads_before)
    else:
        with use_one_thread_each():
            seconds = Timer(partial(run_parallel, apply, blocks, threads)).timeit(1)
    return rounds * len(images) / seconds


@command("poppy", reads=READS)
def poppy(
    config: Config,
    bundles: Annotated[tuple[File, ...], {"flag": "--bundle"}, "Model bundles of the dataset."],
    out: Annotated[File, "CSV with the errors of each bundle at each noise level."],
    count: Annotated[int, click.IntRange(min=2), "Stars that POPPY simulates."] = 1500,
) -> None:
    """Predict stars that POPPY has simulated and compare with the bundles' own test stars.

    Once with flux and sky level given, as for the test stars, and once with both estimated.
    Stars without a usable flux (lost) are left out of the estimated columns.
    """
    for bundle in bundles:
        require_bundle(bundle, config)
    truth = poppy_stars(config, count)
    write(out, [row for bundle in bundles for row in bundle_errors(bundle, truth, config)])


def bundle_errors(bundle, truth, config):
    """Errors of a bundle on noise-free stars of flux 1, a row for each noise level."""
    from psfdae.api import load_model

    model, noise = (
        load_model(bundle),
        NoiseModel(config.noise.kappa, config.noise.background_photons),
    )
    for tested in model.info.metrics:
        level = tested["noise_level"]
        rng = stream(config.seed, "poppy", "noise", f"{level:.6g}")
        flux = float(noise.flux(level))
        stamps = rng.poisson(flux * truth + noise.background).astype(np.float32)
        prediction = model.predict(stamps, flux=flux, background=noise.background, gain=1.0)
        estimated = model.predict(stamps, gain=1.0)
        row = {"bundle": model.info.name, "method": model.info.method, "noise_level": level}
        row |= {"snr": tested["snr"], "stars": len(truth), "mse_table": tested["mse"]}
        row |= summarise_errors(prediction, truth, flux, tested["mse"], "given")
        row |= summarise_errors(estimated, truth, flux, tested["mse"], "estimated")
        row["lost"] = np.isnan(estimated.psf).any(axis=(1, 2)).sum()
        row["allowed_ratio"] = ALLOWED_RATIO
        yield row | {"met": yes(abs(row["ratio_given"] - 1.0) <= ALLOWED_RATIO)}


def require_bundle(bundle, config):
    """Refuse a bundle whose training stars are not of the configured scene."""
    from psfdae.denoise.bundle import read_bundle

    trained_on = read_bundle(bundle).info.config.get("stars")
    if isinstance(trained_on, dict):
        require(bundle, trained_on, STARS, config)


def summarise_errors(result, truth, flux, expected, case):
    """Mean errors of PSFs of flux 1, and how many pixels are within the uncertainty.

    `coverage95` is of `UNCERT` times `ratio95`.
    """
    from psfdae.denoise.error_model import brightest

    good = np.isfinite(result.psf).all(axis=(1, 2))
    psf, width = result.psf[good], result.uncertainty[good]
    ratio = result.ratio95[good, None, None], result.ratio95_bright[good, None, None]
    width95 = width * np.where(brightest(psf), *ratio[::-1])
    squares = np.square(psf / result.flux[good, None, None] - truth[good]).mean(axis=(1, 2))
    error, mse = np.abs(psf - flux * truth[good]), squares.mean()
    row = {"mse": mse, "stderr": squares.std(ddof=1) / squares.size**0.5, "ratio": mse / expected}
    row |= {"coverage": (error <= width).mean()}
    row |= {"coverage95": (error <= width95).mean()}
    return {f"{name}_{case}": value for name, value in row.items()}


@command("coverage", reads=TESTED)
def coverage(
    config: Config,
    stars: Annotated[tuple[File, ...], {"flag": "--stars"}, "Products of the stage stars."],
    bundles: Annotated[tuple[File, ...], {"flag": "--bundle"}, "Model bundles of these stars."],
    out: Annotated[File, "CSV with the coverage by bundle, noise level and brightness."],
) -> None:
    """How many pixels of test stars are within `UNCERT`, and within `ratio95` times it.

    Either half of the stars, with flux and sky found, by what the other half says of the errors.
    """
    from psfdae.denoise.bundle import read_bundle

    products = [star_sets.read_stars(path, "template") for path in stars]
    rows = []
    for path in bundles:
        bundle = read_bundle(path)
        matching = (p for p in products if p.config == bundle.info.config["stars"])
        product = next(matching, None) or refuse(path, stars)
        rows += tabulate_coverage(bundle, product, config.seed)
    write(out, rows)


def refuse(bundle, stars):
    """Say that none of the products has the stars of a bundle."""
    raise ConfigError(f"{bundle}: was trained on other stars than {', '.join(map(str, stars))}")


def tabulate_coverage(bundle, product, seed):
    """Rows of a bundle: noise level, S/N, brightness, and part of the pixels that is covered."""
    from psfdae.api import PsfModel
    from psfdae.denoise.bundle import estimator
    from psfdae.denoise.error_model import brightest
    from psfdae.training.calibration import fit_case_scales, fit_half_widths

    trained, fitted = bundle.info.config["train"], estimator(bundle)
    settings = part(("seed", "noise", "parts"), trained)
    noise, rng = star_sets.noise_model(settings), stream(seed, "coverage", bundle.info.name)
    reference = bundle.info.reference
    test = star_sets.split_stars(product, trained["split"], settings).test
    # Images of one star of an image are of one half.
    star = product["field_index"][test] if trained["split"] == "held_out" else test
    is_odd = np.unique(star, return_inverse=True)[1] % 2 == 1
    halves = [
        star_sets.HeldOutStars.select(product, reference, noise, test[half])
        for half in (is_odd, ~is_odd)
    ]
    cells = {}
    for judges, judged in (halves, halves[::-1]):
        model = PsfModel(bundle, fitted)
        model = model.replace_errors(fit_half_widths(model, judges, seed)[0])
        model = model.replace_errors(fit_case_scales(model, judges, seed))
        for tested in bundle.info.metrics:
            level = tested["noise_level"]
            flux = float(noise.flux(level))
            stamps = rng.poisson(flux * judged.images + noise.background).astype(np.float32)
            result = model.predict(stamps, gain=1.0, position=judged.position)
            good = np.isfinite(result.psf).all(axis=(1, 2))
            # As the calibration has it: the own noise of stars of an image is no error.
            error = flux * judged.errors(result.psf / flux)[good] / result.uncertainty[good]
            bright = brightest(result.psf[good])
            ratios = result.ratio95_bright, result.ratio95
            for name, pixels, ratio in zip(BRIGHTNESS, (bright, ~bright), ratios, strict=True):
                inside = (error <= 1), (error <= ratio[good, None, None])
                key = level, tested["snr"], name
                cells.setdefault(key, []).append([good.sum(), *(i[pixels].mean() for i in inside)])
    for (level, snr, name), parts in cells.items():
        of_half = np.array(parts)
        row = {"bundle": bundle.info.name, "method": bundle.info.method, "noise_level": level}
        row |= {"snr": snr, "pixels": name, "stars": int(of_half[:, 0].sum())}
        shares = np.average(of_half[:, 1:], axis=0, weights=of_half[:, 0])
        yield row | dict(zip(("coverage68", "coverage95"), shares, strict=True))


@command("strange", reads=TESTED)
def outliers(
    config: Config,
    stars: Annotated[File, "Product of the stage stars."],
    bundle: Annotated[File, "Model bundle of a method with a law of stars."],
    out: Annotated[File, "CSV with the stars found, by kind and noise level."],
) -> None:
    """Find stars unlike the training by `distance` and by the outlier score, at equal false alarms.

    Of the test stars a part of `FALSE_ALARMS` is above either limit. Then each of them gets a
    companion, or is hit by a cosmic ray, or is turned by 90 degrees, or gives way to a Gaussian as
    wide as the mean star.
    """
    from psfdae.api import load_model

    product = star_sets.read_stars(stars, "realisation")
    require(stars, product.config, STARS, config)
    require_bundle(bundle, config)
    model, noise = (
        load_model(bundle),
        NoiseModel(config.noise.kappa, config.noise.background_photons),
    )
    images = product["realisation"][star_sets.split_stars(product, "random", config).test]
    images = np.tile(images, (NOISY_EACH, 1, 1))
    rows = []
    for level in config.noise.levels:
        limits = {}
        for kind, changed in changed_stars(images, stream(config.seed, "strange", "draws")).items():
            rng = stream(config.seed, "strange", "noise", f"{level:.6g}", kind)
            flux = noise.flux(level)
            stamps = rng.poisson(flux * changed + noise.background).astype(np.float32)
            prediction = model.predict(stamps, gain=1.0)
            # Tables of the record name the outlier score so.
            scores = {"distance": prediction.distance, "strangeness": prediction.outlier_score}
            for measure, score in scores.items():
                values = score[np.isfinite(score)]
                limits.setdefault(measure, np.quantile(values, 1.0 - FALSE_ALARMS))
                row = {"noise_level": level, "kind": kind, "measure": measure}
                row |= {"stars": values.size, "false_alarms": FALSE_ALARMS}
                rows.append(row | {"found": (values > limits[measure]).mean()})
    write(out, rows)


def changed_stars(images, rng):
    """Stars as they are, then others by kind, each of flux 1; shape (n, d, d)."""
    count, side = len(images), images.shape[-1]
    place = np.arange(side) - side // 2
    angle, pixel = rng.uniform(0, 2 * np.pi, count), rng.integers(3, side - 3, (count, 2))
    shift = np.rint(COMPANION_PX * np.stack([np.sin(angle), np.cos(angle)], axis=1)).astype(int)
    shifted = [np.roll(star, by, axis=(0, 1)) for star, by in zip(images[::-1], shift, strict=True)]
    hit = images.copy()
    for along in range(RAY_PX):  # a straight one, along a row
        hit[np.arange(count), pixel[:, 0], np.minimum(pixel[:, 1] + along, side - 1)] += RAY_FLUX
    radius2 = np.square(place[:, None]) + np.square(place)
    width2 = np.mean((images * radius2).sum(axis=(1, 2))) / 2.0
    kinds = {
        "usual": images,
        "companion": images + COMPANION_FLUX * np.stack(shifted),
        "cosmic ray": hit,
        "turned": np.rot90(images, axes=(1, 2)),
        "Gaussian": np.broadcast_to(np.exp(-0.5 * radius2 / width2), images.shape),
    }
    return {
        kind: changed / changed.sum(axis=(1, 2))[:, None, None] for kind, changed in kinds.items()
    }


def poppy_stars(config, count):
    """Noise-free stars of sum 1 with random aberrations, framed as those of the training.

    Shape (count, d, d), float64. The draws are new: other aberrations, fields and jitter than
    in training and test.
    """
    if config.scene.name != "seidel":
        raise ConfigError(f"scene {config.scene.name!r}: only 'seidel' is simulated with POPPY")

    def draws(name):
        return stream(config.seed, "poppy", name)

    framing, search_px = config.framing, config.stars.search_px
    field = relative_field(config.grid)
    field = field[assign_fields(count, len(field), draws("field"))]
    static = np.tile(config.wavefront.coefficients, (count, 1))
    seidel = perturb(static, config.stars.aberration_fraction, draws("aberration"))
    jitter = draw_jitter(count, framing.jitter_px, draws("jitter"))
    reach = search_px + framing.stamp_px // 2 + framing.jitter_px
    image_of = poppy_telescope(config.telescope, 2 * reach)
    images = (image_of(*star) for star in zip(seidel, field, strict=True))
    stamps = [framed(*star, framing, search_px) for star in zip(images, jitter, strict=True)]
    return normalise_flux(np.stack(stamps))[0]


def framed(image, jitter, framing, search_px):
    """Stamp (d, d) whose brightest pixel within ± `search_px` is at (d/2, d/2) + jitter."""
    edge = (image.shape[0] - 2 * search_px) // 2
    row, column = brightest_pixel(image[edge:-edge, edge:-edge], framing.tie)
    reach = framing.stamp_px // 2 + framing.jitter_px
    rows, columns = (slice(edge + p - reach, edge + p + reach) for p in (row, column))
    return crop_jittered(image[None, rows, columns], jitter[None], framing.jitter_px)[0]


def poppy_telescope(telescope, side_px):
    """Light on side × side pixels (even: the chief ray falls on a corner) as a function.

    Of Seidel coefficients in waves and a field point; aberrations as in Welford (1986), ch. 8.
    """
    import astropy.units as u
    import poppy

    logging.getLogger("poppy").setLevel(logging.ERROR)
    poppy.conf.double_precision = True
    radius_m, wavelength_m = 0.5 * telescope.diameter_m, telescope.wavelength_m

    class SeidelWavefront(poppy.AnalyticOpticalElement):  # type: ignore[misc]
        seidel, field = np.zeros(5), np.zeros(2)

        def get_opd(self, wave):
            y, x = (axis / radius_m for axis in self.get_coordinates(wave))
            rho2, height2 = x**2 + y**2, float(self.field @ self.field)
            along = self.field[0] * x + self.field[1] * y
            spherical, coma, astigmatism, curvature, distortion = self.seidel
            waves = spherical * rho2**2 + coma * rho2 * along + astigmatism * along**2
            waves += curvature * height2 * rho2 + distortion * height2 * along
            return waves * wavelength_m

        def get_transmission(self, wave):
            return np.ones(wave.shape)

    wavefront = SeidelWavefront(name="Seidel", planetype=poppy.poppy_core.PlaneType.pupil)
    radius = radius_m * u.m
    pupil = [poppy.CircularAperture(radius=radius), wavefront]
    if telescope.obscuration > 0:
        secondary = telescope.obscuration * radius
        pupil.insert(1, poppy.SecondaryObscuration(secondary_radius=secondary, n_supports=0))
    system = poppy.OpticalSystem(npix=SAMPLES, pupil_diameter=2 * radius, verbose=False)
    system.add_pupil(poppy.CompoundAnalyticOptic(pupil))
    scale = telescope.pixel_scale_arcsec
    system.add_detector(pixelscale=scale, fov_pixels=side_px, oversample=OVERSAMPLING)

    def image(seidel, field):
        wavefront.seidel, wavefront.field = seidel, field
        fine = system.calc_psf(wavelength=wavelength_m)[0].data
        # POPPY counts the phase the other way, which turns the image by 180 degrees.
        binned = fine[::-1, ::-1].reshape(side_px, OVERSAMPLING, side_px, OVERSAMPLING)
        return binned.sum(axis=(1, 3))

    return image


if __name__ == "__main__":
    program(throughput, poppy, coverage, outliers)
