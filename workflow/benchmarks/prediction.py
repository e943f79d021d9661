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

from measure import alone, cost_of_command, write, yes
from psfdae.belonging import STARS, require
from psfdae.cli import File, command, program
from psfdae.configuration.compose import ConfigError
from psfdae.configuration.consistency import SIMULATION
from psfdae.configuration.schema import Config
from psfdae.files import ProductError, read_product
from psfdae.reading import read_table
from psfdae.rng import stream
from psfdae.stars.fields import assign_fields, draw_jitter, perturb, relative_field
from psfdae.stars.framing import brightest_pixel, crop_jittered, normalise_flux
from psfdae.stars.noise import NoiseModel, mixed_levels

REQUIRED_SHARE = 0.6  # of the bare network's throughput, which a prediction must reach
ALLOWED_MB = 1000.0  # memory that it may take
ALLOWED_RATIO = 0.1  # relative difference of the MSE from that of the workflow's own stars
REPEATS = 3  # timings at most; each takes as long as three predictions
WARM_UP = 4  # blocks of stars that are computed before the clock starts
BARE_STAMPS = 8192  # that the bare network sees over and over: it must not fill the memory
SAMPLES = 256  # of POPPY across the pupil
OVERSAMPLING = 4  # its sub-samples per pixel and axis; their error falls with the square

READS = (*SIMULATION, "noise", "benchmark")
Bundle = Annotated[File, "Model bundle of the dataset."]


@command("throughput", reads=READS)
def throughput(
    config: Config,
    stars: Annotated[File, "Product of the stage stars."],
    bundle: Bundle,
    out: Annotated[File, "CSV with stamps per second and memory."],
) -> None:
    """Time predict from FITS to FITS beside the bare network, on a quiet machine."""
    require(stars, read_product(stars, "stars", ()).config, STARS, config)
    require_bundle(bundle, config)
    settings = config.benchmark
    work = (settings.star_counts[-1], settings.threads, min(settings.repeats, REPEATS))
    with TemporaryDirectory() as folder:
        cube = Path(folder, "stars.fits")
        alone(1, make_cube, config.model_dump(), stars, work[0], cube)
        rates, peak_mb = alone(settings.threads, time_prediction, cube, bundle, *work)
    bare = max(rates["bare_shared_per_s"], rates["bare_parallel_per_s"])
    share = rates["predict_per_s"] / bare
    row = {"stamps": work[0], "stamp_px": config.framing.stamp_px, "threads": work[1]}
    row |= {"repeats": work[2], **rates, "bare_per_s": bare}
    row |= {"share": share, "required_share": REQUIRED_SHARE}
    row |= {"peak_mb": peak_mb, "allowed_mb": ALLOWED_MB}
    write(out, [row | {"met": yes(share >= REQUIRED_SHARE and peak_mb < ALLOWED_MB)}])


def make_cube(tree, stars, count, out):
    """Write a FITS cube of the noise-free stars of a product in turn, sky and noise added."""
    from psfdae.own_stars.example import write_cube

    images = read_product(stars, "stars", ("realisation",))["realisation"]
    rng = stream(tree["seed"], "prediction", "cube")
    noise = NoiseModel(tree["noise"]["kappa"], tree["noise"]["background_photons"])
    cube = np.empty((count, *images.shape[1:]), np.float32)
    for start in range(0, count, BARE_STAMPS):
        rows = np.arange(start, min(start + BARE_STAMPS, count))
        flux = noise.flux(mixed_levels(np.asarray(tree["noise"]["levels"]), rows.size, rng))
        light = flux[:, None, None] * images[rows % len(images)]
        cube[rows] = rng.poisson(light + noise.background)
    write_cube(out, cube, PIXSCALE=tree["telescope"]["pixel_scale_arcsec"], GAIN=1.0)


def time_prediction(cube, bundle, stamps, threads, repeats):
    """Medians of stamps per second of `psfdae predict` and of the bare network, in turn.

    The bare network runs in one forward pass at a time on all threads ("shared"), and in as
    many passes as threads beside each other. Then the memory of the prediction in MB,
    interpreter and libraries included.
    """
    from psfdae.own_stars.model import BLOCK, load_model

    model, peak = load_model(bundle), 0.0
    side = model.info.stamp_px
    model.predict(np.zeros((WARM_UP * BLOCK, side, side), np.float32), threads=threads)
    options = ["--model", bundle, "--threads", threads, "--overwrite", "--quiet"]
    rates = {"bare_shared": [], "bare_parallel": [], "predict": []}
    for _ in range(repeats):
        cost = cost_of_command(["predict", cube, *options], cube.with_name("psf.fits"))
        peak = max(peak, cost["peak_b"])
        rates["predict"].append(stamps / cost["time_s"])
        for way in ("shared", "parallel"):
            rates[f"bare_{way}"].append(bare_rate(model, stamps, threads, way))
    medians = {f"{name}_per_s": np.median(values) for name, values in rates.items()}
    return medians, peak / 2**20


def bare_rate(model, stamps, threads, way):
    """Stamps per second of the network alone, on images that are in memory."""
    import torch

    from psfdae.estimators.dae_network import predict
    from psfdae.own_stars.model import BLOCK, one_thread_each
    from psfdae.threads import side_by_side

    side, factor, network = (
        model.info.stamp_px,
        model.info.image_scale,
        model.engine.estimator.network,
    )
    mean = model.bundle.flux_model.mean.reshape(1, side, side).astype(np.float32)
    images = np.repeat(mean, min(BARE_STAMPS, stamps), axis=0)
    rounds = -(-stamps // len(images))
    blocks = rounds * np.array_split(images, range(BLOCK, len(images), BLOCK))

    def apply(some):
        return predict(network, some, factor, BLOCK)

    if way == "shared":
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        seconds = Timer(partial(apply, images)).timeit(rounds)
        torch.set_num_threads(before)
    else:
        with one_thread_each():
            seconds = Timer(partial(side_by_side, apply, blocks, threads)).timeit(1)
    return rounds * len(images) / seconds


@command("poppy", reads=READS)
def poppy(
    config: Config,
    bundle: Bundle,
    evaluation: Annotated[File, "CSV of the stage evaluate for the same network."],
    out: Annotated[File, "CSV with the errors at each noise level."],
    count: Annotated[int, click.IntRange(min=2), "Stars that POPPY simulates."] = 500,
) -> None:
    """Predict stars that POPPY has simulated and compare with the workflow's table.

    Once with flux and sky level given, as in the workflow's tables, and once with both
    estimated. Stars without a usable flux (lost) are left out of the estimated columns.
    """
    from psfdae.own_stars.model import load_model

    require_bundle(bundle, config)
    table, levels = read_table(evaluation), config.noise.levels
    expected = {level: table_mse(table, level, evaluation) for level in levels}
    model, truth, rows = load_model(bundle), poppy_stars(config, count), []
    noise = NoiseModel(config.noise.kappa, config.noise.background_photons)
    for level, mse in expected.items():
        rng = stream(config.seed, "poppy", "noise", f"{level:.6g}")
        flux = float(noise.flux(level))
        stamps = rng.poisson(flux * truth + noise.background).astype(np.float32)
        given = model.predict(stamps, flux=flux, background=noise.background, gain=1.0)
        estimated = model.predict(stamps, gain=1.0)
        snr = 1.0 / (noise.kappa * level * model.info.noise_equivalent_px**0.5)
        row = {"noise_level": level, "snr": snr, "stars": count, "mse_table": mse}
        row |= quality(given, truth, flux, mse, "given")
        row |= quality(estimated, truth, flux, mse, "estimated")
        row["lost"] = np.isnan(estimated.psf).any(axis=(1, 2)).sum()
        row["allowed_ratio"] = ALLOWED_RATIO
        rows.append(row | {"met": yes(abs(row["ratio_given"] - 1.0) <= ALLOWED_RATIO)})
    write(out, rows)


def require_bundle(bundle, config):
    """Refuse a bundle whose training stars are not of the configured scene."""
    from psfdae.own_stars.bundle import read_bundle

    trained_on = read_bundle(bundle).info.config.get("stars")
    if isinstance(trained_on, dict):
        require(bundle, trained_on, STARS, config)


def quality(found, truth, flux, expected, which):
    """Mean errors of PSFs of flux 1, and how many pixels are within the uncertainty."""
    kept = np.isfinite(found.psf).all(axis=(1, 2))
    psf, error = found.psf[kept], found.uncertainty[kept]
    squares = np.square(psf / found.flux[kept, None, None] - truth[kept]).mean(axis=(1, 2))
    inside, mse = np.abs(psf - flux * truth[kept]) <= error, squares.mean()
    row = {"mse": mse, "stderr": squares.std(ddof=1) / squares.size**0.5, "ratio": mse / expected}
    return {f"{name}_{which}": value for name, value in {**row, "coverage": inside.mean()}.items()}


def table_mse(table, level, path):
    """MSE of the DAE in a table of the stage `evaluate`."""
    wanted = (table["method"] == "dae") & (table["metric"] == "mse")
    values = table.loc[wanted & np.isclose(table["noise_level"], level), "value"]
    if len(values) != 1:
        raise ProductError(f"{path}: {len(values)} rows with the DAE's MSE at λ = {level:g}")
    return float(values.iloc[0])


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
    program(throughput, poppy)
