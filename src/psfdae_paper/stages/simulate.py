"""Stages `simulate`, `figure telescope`, `example-field`, `example-night`: simulated PSFs, images.

`simulate` turns the settings of a telescope into its static PSFs over the field: a product, a
figure, a table and, on request, a FITS cube and an image with a star per field. `example-field`
makes the image of a star field for the examples of the pages, `example-night` many images.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click
import numpy as np

from psfdae.base.errors import Error
from psfdae.base.figures import write_png
from psfdae.base.files import (
    Product,
    as_yaml,
    atomic_path,
    check_outputs,
    read_product,
    write_bytes,
    write_csv,
    write_fits,
    write_text,
)
from psfdae.base.options import File, Folder
from psfdae.base.rng import stream
from psfdae.base.version import __version__
from psfdae.optics.pupil import SamplingError
from psfdae.stars.moments import measure_shapes
from psfdae.stars.noise import noise_equivalent_px
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.configuration.consistency import STATIC
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stages.stars import templates
from psfdae_paper.stars.example import (
    ExampleField,
    FieldRecipe,
    add_stamps,
    write_cube,
    write_field,
)
from psfdae_paper.stars.example import example_field as simulate_field
from psfdae_paper.stars.framing import FramingError, Propagation, cut_margin, normalise_flux
from psfdae_paper.stars.nights import (
    NightRecipe,
    describe_telescope,
    simulate_night,
    simulate_reference_stars,
)
from psfdae_paper.stars.scenes import template_wavefronts

if TYPE_CHECKING:
    from psfdae_paper.evaluation.figures import FieldOfPsfs

ENOUGH_LIGHT = 0.8
"""Fraction of the light that a stamp has to hold, unless there is a warning."""


class StampSizeError(Error, ValueError):
    """The PSFs of a telescope do not fit into their stamps."""


@command("simulate")
def simulate(
    out: Folder | None = None,
    fits: bool = False,
    image_snr: Annotated[float | None, click.FloatRange(min=0, min_open=True, max=1e6)] = None,
    seed: Annotated[int, click.IntRange(min=0)] = 0,
    least_energy: Annotated[float, click.FloatRange(0, 1)] = 0.1,
    overrides: Annotated[tuple[str, ...], {"argument": True}] = (),
) -> None:
    """Draw the PSFs of a telescope over its field: psfdae simulate telescope=NAME.

    Writes templates.h5, psfs.png and fields.csv.

    The telescope is an option of the group `telescope`, or a file of your own. The figure shows the
    PSFs at their positions in the field; the table has, for each field point, the light inside the
    stamp, the FWHM in arcsec, ellipticity and position angle in degrees. If the PSFs do not fit
    into their stamps, there is an error before any file is written.

    Parameters
    ----------
    out : Path, optional
        Folder. [default: name of the telescope]
    fits : bool
        Also write the PSFs as FITS cube, psfs.fits.
    image_snr : float, optional
        Also write an image with a noisy star per field, image.fits, and stars.csv.
    seed : int
        Seed of the image's noise.
    least_energy : float
        Minimum fraction of the light in a stamp.
    overrides : sequence of str
        Words of Hydra such as telescope=NAME.
    """
    # A user's telescope is used with the dataset for single telescopes.
    if not any(word.startswith(("dataset=", "scene=", "stars=")) for word in overrides):
        overrides = ("dataset=_telescope", *overrides)
    config = load_stage(STATIC, overrides)
    # Settings of the static PSFs are checked; then the PSFs are propagated and measured.
    folder = out or Path(config.telescope.name)
    # No file is written if the PSFs do not fit.
    with atomic_path(folder / "templates.h5") as temporary:
        templates(config, temporary)
        fields = measure_fields(read_product(temporary, "templates"))
        warnings = check_stamps(config, fields, least_energy)
    # The figure and the table of the same measurements.
    figure_telescope(folder / "templates.h5", folder / "fields.csv", folder / "psfs.png")
    names = ["templates.h5", "psfs.png", "fields.csv"]
    if fits:
        write_psfs(config, fields, folder / "psfs.fits")
        names.append("psfs.fits")
    if image_snr:
        image, catalogue = folder / "image.fits", folder / "stars.csv"
        write_image(config, fields, image_snr, seed, image, catalogue)
        names += ["image.fits", "stars.csv"]
    # Warnings come last, where they are read.
    for line in warnings:
        print(f"psfdae: {line}", file=sys.stderr)
    telescope, energy, fwhm = config.telescope, fields.table.energy, fields.table.fwhm_arcsec
    print(
        f"{telescope.name}: {len(fields.psf)} fields, pixels of {telescope.pixel:.3g} λ/D, "
        f"light inside the stamp {energy.min():.3f} … {energy.max():.3f}, "
        f"FWHM {fwhm.min():.3g} … {fwhm.max():.3g} arcsec"
    )
    print(f"{folder}: {', '.join(names)}")


@command("paper figure telescope")
def figure_telescope(templates: File, table: File, out: File) -> None:
    """Draw the static PSFs of a telescope with their light and their width, and tabulate them.

    The table has field angles in degrees, the light inside the stamp, FWHM in arcsec, ellipticity
    and position angle in degrees of every field point.

    Parameters
    ----------
    templates : Path
        Product of the stage templates.
    table : Path
        CSV, a row per field point.
    out : Path
        PNG.
    """
    # `psfdae example` runs without pandas, which figures and tables need.
    from psfdae_paper.evaluation.figures import draw_field

    # Table and figure of the same measurements, angles in degrees.
    product = read_product(templates, "templates")
    fields, telescope = measure_fields(product), product.config["telescope"]
    write_csv(table, fields.table, digits=6)
    write_png(draw_field(fields, telescope["name"], telescope["pixel_scale_arcsec"]), out)


def measure_fields(product: Product) -> FieldOfPsfs:
    """Measure the shapes of the stamps of the product "templates", without their margin.

    Widths become arcsec by the telescope's pixel scale.

    Parameters
    ----------
    product : Product
        Product "templates", with one PSF for each of the F field points.

    Returns
    -------
    FieldOfPsfs
        PSFs (F, d, d) with the light of each inside its stamp, FWHM in arcsec, ellipticity, and
        position angle in degrees.
    """
    import pandas as pd

    from psfdae_paper.evaluation.figures import FieldOfPsfs

    psf, (x, y) = cut_margin(product), np.rad2deg(product["field"]).T
    shapes = measure_shapes(psf)
    columns = {
        "x_deg": x,
        "y_deg": y,
        "energy": product["energy"],
        "fwhm_arcsec": shapes.fwhm_px * product.config["telescope"]["pixel_scale_arcsec"],
        "ellipticity": shapes.ellipticity,
        "position_angle_deg": shapes.position_angle_deg,
        "pupil_samples": product["pupil_samples"],
    }
    return FieldOfPsfs(psf, product["grid"], product["field"], pd.DataFrame(columns))


def check_stamps(config: Config, fields: FieldOfPsfs, least_energy: float) -> list[str]:
    """Return warnings: stamps with too little light, and undersampled PSFs.

    Parameters
    ----------
    config : Config
        Stage configuration of `templates`.
    fields : FieldOfPsfs
        Static PSFs on stamps, with the light inside each stamp and the FWHM.
    least_energy : float
        Fraction of the light below which a stamp is an error; below `ENOUGH_LIGHT` it is a warning.

    Raises
    ------
    StampSizeError
        If a stamp contains less than `least_energy`.
    """
    warnings = []
    # Light of each PSF inside its stamp.
    energy, side = fields.table.energy.to_numpy(), config.framing.stamp_px
    if energy.min() < ENOUGH_LIGHT:
        # The field with the least light decides which stamp is large enough.
        worst_field = int(energy.argmin())
        x, y = np.rad2deg(fields.field[worst_field])
        # Stamps up to four times as wide are tried.
        max_px, share = 4 * side, f"{ENOUGH_LIGHT:.0%}"
        stamp_px = _find_stamp_px(config, worst_field, max_px)
        size = f"framing.stamp_px={stamp_px}" if stamp_px else f"no stamp up to {max_px} px"
        message = (
            f"{int((energy < ENOUGH_LIGHT).sum())} of {energy.size} fields have less than "
            f"{share} of their light inside {side} × {side} px, the least "
            f"{energy[worst_field]:.1%} at ({x:.3g}, {y:.3g})°; {size} contains {share} everywhere"
        )
        if energy.min() < least_energy:
            raise StampSizeError(f"telescope = {config.telescope.name}: {message} (--least-energy)")
        warnings.append(message)
    # Below 1.5 pixels the FWHM has less than two samples across: the pixels alias.
    fwhm_px = np.median(fields.table.fwhm_arcsec) / config.telescope.pixel_scale_arcsec
    if fwhm_px < 1.5:
        warnings.append(
            f"the PSFs are {fwhm_px:.2f} px wide (median FWHM with the pixel): undersampled; the "
            "image of a star depends more on its position in the pixel than on the optics"
        )
    return warnings


def _find_stamp_px(config: Config, worst_field: int, max_px: int) -> int | None:
    """Return the side of the smallest even stamp with enough light of a field.

    None if it would be larger than `max_px`, or if the PSF cannot be computed on such a stamp.

    Parameters
    ----------
    config : Config
        Stage configuration of `templates`.
    worst_field : int
        Number of the field with the least light inside its stamp.
    max_px : int
        Side of the largest stamp that is tried.
    """
    # One propagation on the largest stamp; pixels of smaller ones are the same.
    framing = config.framing.model_copy(update={"stamp_px": max_px})
    source, optics = template_wavefronts(config), config.optics
    try:
        propagation = Propagation(source, config.telescope, optics, framing, framing.search_px)
        stamp = propagation.frame(max_px, stars=np.array([worst_field]))[0][0]
    except (SamplingError, FramingError):
        return None
    # Smaller stamps are the middle of the largest one.
    for size in range(config.framing.stamp_px + 2, max_px + 1, 2):
        centre = slice((max_px - size) // 2, (max_px + size) // 2)
        if stamp[centre, centre].sum() >= ENOUGH_LIGHT:
            return size
    return None


def write_psfs(config: Config, fields: FieldOfPsfs, path: Path) -> None:
    """Write the static PSFs as a FITS cube, with a table of their fields.

    The primary HDU has the fraction of the light on each pixel, (F, d, d); the table FIELDS has
    one row per PSF. Neither has a date, so that the same PSFs give the same bytes.

    Parameters
    ----------
    config : Config
        Stage configuration of `templates`.
    fields : FieldOfPsfs
        Static PSFs and their shapes.
    path : Path
        FITS file.
    """
    from astropy.io import fits
    from astropy.table import Table

    # Primary HDU: the PSFs, with the scale of their pixels on the sky.
    telescope = config.telescope
    cube = fits.PrimaryHDU(fields.psf.astype(np.float32))
    for card in (
        ("TELESCOP", telescope.name, "telescope of the configuration"),
        ("PIXSCALE", telescope.pixel_scale_arcsec, "[arcsec] width of a pixel"),
        ("WAVELEN", telescope.wavelength_m, "[m] wavelength"),
        ("APERTURE", telescope.diameter_m, "[m] diameter"),
        ("BUNIT", "1", "fraction of the light of the star"),
        ("CREATOR", f"psfdae {__version__}", ""),
    ):
        cube.header.append(card)
    # Table of the fields; units are in the header, not in the names.
    names = {"fwhm_arcsec": "fwhm", "position_angle_deg": "position_angle"}
    rows = fields.table.drop(columns="pupil_samples").rename(columns=names)
    rows.insert(0, "id", np.arange(len(rows)))
    units = {"x_deg": "deg", "y_deg": "deg", "fwhm": "arcsec", "position_angle": "deg"}
    table = fits.BinTableHDU(Table.from_pandas(rows, units=units), name="FIELDS")
    write_fits(path, fits.HDUList([cube, table]))


def write_image(
    config: Config, fields: FieldOfPsfs, snr: float, seed: int, path: Path, catalogue: Path
) -> None:
    """Write an image with one noisy star per field, and its catalogue.

    The stars are close together, with 8 px of sky between their stamps. They have the same order on
    the detector as in the field, and the catalogue has their field angles. Their flux is
    F = snr √(B A), with the sky B and the noise-equivalent area A of the mean PSF (King 1983,
    PASP 95, 163): the S/N of a matched filter that is limited by the sky.

    Parameters
    ----------
    config : Config
        Stage configuration of `templates`.
    fields : FieldOfPsfs
        Static PSFs, each of which becomes a star.
    snr : float
        Signal-to-noise ratio of each star, > 0.
    seed : int
        Seed of the photon noise.
    path, catalogue : Path
        FITS image and CSV file.
    """
    # Flux of a star from its S/N; all stars have the same one.
    stamps, _ = normalise_flux(fields.psf.astype(np.float64))
    sky = 1000.0  # photons per pixel
    flux = snr * np.sqrt(sky * noise_equivalent_px(stamps.mean(axis=0)))
    # Expected photons: sky, and the stars at the positions of their field points, with 8 px of sky
    # between stamps.
    pitch = stamps.shape[-1] + 8
    # The detector has a cell for each field of the square grid.
    columns, rows = fields.grid.max(axis=0) + 1
    x, y = (fields.grid * pitch + pitch // 2).T.astype(np.float64)
    expected_photons = np.full((int(rows) * pitch, int(columns) * pitch), sky)
    add_stamps(expected_photons, flux * stamps, x, y)
    # Photon noise only: a gain of 1, without read noise.
    rng = stream(seed, "simulated image", config.telescope.name)
    write_field(
        path,
        catalogue,
        rng.poisson(expected_photons).astype(np.float32),
        x,
        y,
        pixel_scale_arcsec=config.telescope.pixel_scale_arcsec,
        columns={name: fields.table[name].to_numpy() for name in ("x_deg", "y_deg")},
        GAIN=1.0,
        TELESCOP=config.telescope.name,
    )


@command("example field")
def write_example_field(
    catalogue: File,
    seed: Annotated[int, click.IntRange(min=0)] = 1,
    side: Annotated[int, click.IntRange(min=100)] = FieldRecipe.side_px,
    bright: Annotated[int, click.IntRange(min=1)] = FieldRecipe.bright,
    faint: Annotated[int, click.IntRange(min=0)] = FieldRecipe.faint,
    *,
    out: File,
) -> None:
    """Simulate an image of a star field with its star list, as an example.

    The list is like a catalogue of the image: numbers, pixel and sky coordinates of all stars
    except the faint halves of blends. The same seed gives the same image.

    Parameters
    ----------
    seed : int
        Seed of positions, fluxes and noise of the stars.
    catalogue : Path
        CSV file for the star list.
    side : int
        Pixels along a side.
    bright : int
        Bright stars.
    faint : int
        Faint stars.
    out : Path
        FITS image.
    """
    check_outputs((out,), (catalogue,))
    write_example(out, catalogue, seed, side_px=side, bright=bright, faint=faint)


def write_example(out: Path, catalogue: Path, seed: int, **attributes: int) -> ExampleField:
    """Write a simulated image and its star list; `attributes` are fields of `FieldRecipe`.

    The image has a WCS and the cards GAIN and SATURATE; the list has pixel (1-based)
    and sky coordinates of all stars but the companions of blended ones.

    Parameters
    ----------
    out, catalogue : Path
        FITS image, in counts, and CSV list.
    seed : int
        Seed of positions, fluxes and noise of the stars.
    **attributes
        Fields of `FieldRecipe`, such as `side_px=600` or `bright=80`.

    Returns
    -------
    ExampleField
        The image with the true position, flux and PSF of every star.
    """
    # The recipe with the given sizes and numbers of stars.
    recipe = FieldRecipe(**attributes)  # type: ignore[arg-type]  # no pair of numbers among them
    field = simulate_field(recipe, seed)
    x, y = field.centroid.T
    write_field(
        *(out, catalogue, field.image.astype(np.float32), x, y),
        pixel_scale_arcsec=recipe.pixel_scale_arcsec,
        GAIN=recipe.gain,
        SATURATE=float(recipe.saturation),
    )
    return field


@command("example night")
def example_night(
    out: Folder,
    seed: Annotated[int, click.IntRange(min=0)] = 1,
    exposures: Annotated[int, click.IntRange(min=12)] = NightRecipe.exposures,
) -> None:
    """Simulate a night of a telescope, with bad images among them, as an example.

    truth.csv has a row for each image: its fault if it has one, FWHM and ellipticity of its PSF
    in the middle and in the corners, without clouds or trail. reference.csv has the stars with
    their magnitudes, telescope.yaml the telescope. The same seed gives the same images.

    Parameters
    ----------
    seed : int
        Seed of stars, noise and faults.
    out : Path
        Folder for images, truth.csv, reference.csv and telescope.yaml.
    exposures : int
        Images.
    """
    import pandas as pd

    recipe, reference = NightRecipe(exposures=exposures), out / "reference.csv"
    stars = simulate_reference_stars(recipe, seed)
    write_csv(reference, stars["ra", "dec", "mag"].to_pandas(), digits=9)
    write_text(out / "telescope.yaml", as_yaml(describe_telescope(recipe.field)))
    rows: list[dict[str, object]] = []
    for number, (counts, cards, truth) in enumerate(simulate_night(recipe, stars, seed)):
        path = out / f"exposure_{number:03d}.fits"
        write_cube(path, counts, **cards)
        # Half of the file is lost, as when a disk is full.
        if truth["fault"] == "truncated file":
            write_bytes(path, path.read_bytes()[: path.stat().st_size // 2])
        rows.append({"image": path, "reference": reference, **truth})
    write_csv(out / "truth.csv", pd.DataFrame(rows), digits=6)
    print(f"next: snakemake night --config images='{out}/*.fits'")
