"""The PSF where a star stands, by psfdae and by other packages, on simulated images of scene 1.

`field` simulates an image whose PSFs are known. Any package that was fitted to the training
stars of psfdae's list says its PSF at the places of the stars that were held out; `places` fits
centre, flux and sky of these stars in one way for all, and measures the errors.
"""

from datetime import date
from pathlib import Path
from typing import Annotated

import click
import numpy as np
import pandas as pd
from scipy.stats import sem

from psfdae.base.files import atomic_path
from psfdae.base.options import File
from psfdae.base.reading import read_table
from psfdae.base.rng import stream
from psfdae.commands.cli import program
from psfdae.image.stamps import central_pixel
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.schema import Config
from psfdae_paper.source import git_commit
from psfdae_paper.stars.example import add_stamps, write_field

SIDE = 48  # px of a simulated star
PITCH = 64  # px of the lattice of the stars
ASIDE_PX = 8  # of stars from it, at most, per axis
SKY = 1000.0  # electrons per pixel
SNR = (150.0, 1500.0)  # of the stars, by a matched filter
SMOOTHING_PX, ISOPHOTE = 1.0, 0.1  # of the listed centroids: σ, and part of the peak
NEAR_PX = 6  # of the brightest pixel from the list
FARTHEST = 3  # px of a star's centre from the frame's middle, at the start
ROUNDS = 30  # of Gauss-Newton steps
STEP = 0.5  # px, at most
TESTED, DRAWS = 500, 4  # stars whose stated errors are tested, and images of each
FAINT_SNR = (5.0, 10.0, 20.0, 50.0)
LANCZOS = 4  # of the interpolation of sampled PSFs


@command("field", reads=SIMULATION)
def field(
    config: Config,
    image: Annotated[File, "FITS image."],
    catalogue: Annotated[File, "CSV file for the star list."],
    truth: Annotated[File, "NPZ with the stars' images, in the order of the list."],
    stars: Annotated[int, click.IntRange(min=1), "Anywhere over the 11 × 11 fields."] = 2000,
) -> None:
    """Simulate an image of scene 1, all fields side by side.

    The aberrations are those of one telescope; `stars.aberration_fraction` scatters them from
    star to star. The list has centroids inside an isophote. `psf` (stars, s, s) are parts of all
    light of a star; their pixel (s/2, s/2) is `pixel` (stars, 2), x and y in the image.
    """
    from psfdae.optics.propagation import StampPropagator
    from psfdae.optics.pupil import annular_pupil, pixel_width
    from psfdae.optics.wavefronts import seidel_wavefronts

    telescope, optics = config.telescope, config.optics
    scale = telescope.pixel_scale_arcsec
    rng = stream(config.seed, "simulated sky")
    count = int(np.ceil(np.sqrt(stars)))
    lattice = np.stack(np.divmod(rng.permutation(count**2)[:stars], count), axis=1)
    position = (lattice + 0.5) * PITCH + rng.uniform(-ASIDE_PX, ASIDE_PX, lattice.shape)
    pixel, side = central_pixel(position), count * PITCH
    scatter = 1.0 + config.stars.aberration_fraction * rng.standard_normal((stars, 5))
    seidel = scatter * config.wavefront.coefficients
    source = seidel_wavefronts(seidel, 2.0 * position / side - 1.0)
    pupil = annular_pupil(max(optics.pupil_samples), telescope.obscuration)
    width = pixel_width(scale, telescope.diameter_m, telescope.wavelength_m)
    propagate = StampPropagator(pupil, SIDE, width, precision=optics.precision)
    # The middle of an even stamp is the corner of four pixels.
    off = (pixel - 0.5 - position)[:, ::-1]
    parts = np.array_split(np.arange(stars), -(-stars // optics.batch))
    psf = [propagate(source.opd(part, pupil, propagate.real_dtype), off[part]) for part in parts]
    psf = np.concatenate(psf).astype(np.float32)
    snr = SNR[0] * (SNR[1] / SNR[0]) ** rng.uniform(size=stars)
    flux = snr * np.sqrt(SKY / np.square(psf).sum(axis=(1, 2)))
    expected = np.full((side, side), SKY)
    add_stamps(expected, flux[:, None, None] * psf, *pixel.T)
    listed = pixel - SIDE // 2 + np.array([_centroid(star) for star in psf])
    counts = rng.poisson(expected).astype(np.float32)
    write_field(image, catalogue, counts, *listed.T, pixel_scale_arcsec=scale, GAIN=1.0)
    with atomic_path(truth) as temporary, temporary.open("wb") as file:
        np.savez(file, psf=psf, pixel=pixel)


def _centroid(star):
    """Centroid (x, y) of what is brighter than an isophote around the brightest pixel."""
    from scipy import ndimage

    smooth = ndimage.gaussian_filter(star, SMOOTHING_PX)
    parts, _ = ndimage.label(smooth > ISOPHOTE * smooth.max())
    row, column = ndimage.center_of_mass(smooth, parts, parts.flat[smooth.argmax()])
    return column, row


@command("places")
def places(
    image: Annotated[File, {"argument": True}, "FITS image of `field`."],
    truth: Annotated[File, "NPZ of `field`."],
    selection: Annotated[File, "selection.csv of train on image and list."],
    bundle: Annotated[File, "Its model, of the method field."],
    out: Annotated[File, "CSV with the errors of each package."],
    packages: Annotated[
        tuple[str, ...],
        {"flag": "--other"},
        "NAME=FILE of a package fitted to the same stars: a .psf of PSFEx, or NPZ with psf "
        "(held-out stars, m, m), PSFs at the listed places about the pixel m//2, and oversampling.",
    ] = (),
) -> None:
    """Errors of PSFs of sum 1 at the places of the stars that were held out.

    Their pixels give centre, flux and sky by least squares, in the same way for all packages.
    `over` is the error of psfdae over that of a package. Standard errors are those over the
    stars, that of `over` the paired one.
    """
    from astropy.io import fits

    from psfdae.api import load_model

    model, table, npz = load_model(bundle), read_table(selection), np.load(truth)
    test, side = np.flatnonzero(table["part"] == "held out"), model.info.stamp_px
    position = table[["x", "y"]].to_numpy()[test]
    data = np.pad(np.asarray(fits.getdata(image), float), SIDE, mode="reflect")
    frame = central_pixel(position) + SIDE
    cores = _cut(data, frame, 2 * NEAR_PX).reshape(len(test), -1)
    frame += np.stack(np.divmod(cores.argmax(axis=1), 2 * NEAR_PX)[::-1], axis=1) - NEAR_PX
    stamps = _cut(data, frame, side)
    psfs = np.pad(npz["psf"][test].astype(float), ((0, 0), (SIDE, SIDE), (SIDE, SIDE)))
    at = frame - npz["pixel"][test] + SIDE // 2
    psfs = np.concatenate(
        [_cut(star, pixel[None], side) for star, pixel in zip(psfs, at, strict=True)]
    )
    psfs /= psfs.sum(axis=(1, 2), keepdims=True)
    field_model = model.method.model
    terms = field_model.terms(position)
    draws = {"psfdae": lambda centre: field_model.images(terms, centre, side)}
    for package, file in (text.split("=", 1) for text in packages):
        draws[package] = _sampled(Path(file), position, side)
    errors = {
        package: np.square(_fitted(draw, stamps) - psfs).mean(axis=(1, 2))
        for package, draw in draws.items()
    }
    rows = []
    for package, error in errors.items():
        over = errors["psfdae"].mean() / error.mean()
        paired = (errors["psfdae"] - over * error) / error.mean()
        row = {"package": package, "stars": len(test), "learnt": sum(table["part"] == "training")}
        row |= {"mse": error.mean(), "stderr": sem(error)}
        row |= {"over": over, "over_stderr": sem(paired)}
        rows.append(row | {"date": date.today().isoformat(), "commit": git_commit()})
    pd.DataFrame(rows).to_csv(out, index=False, float_format="%.6g")


@command("errors")
def errors(
    truth: Annotated[File, {"argument": True}, "NPZ of `field`."],
    selection: Annotated[File, "selection.csv of train on a part of its list."],
    bundle: Annotated[File, "Its model, of the method field."],
    out: Annotated[File, "CSV with the parts of the errors that are within the stated ones."],
) -> None:
    """Do the stated errors hold, for stars that train was not given?

    They are drawn anew with noise of S/N 5 to 50. Of each star, a model knows where it stands.
    `flux` and `psf` are the parts of fluxes and pixels within the stated errors, with standard
    errors clustered by star; `flux_pull` is what 68.27 % of the errors of fluxes are below.
    """
    from psfdae.api import load_model
    from psfdae.methods.metrics import cluster_mean

    model, npz, rows = load_model(bundle), np.load(truth), []
    listed, place = read_table(selection)[["x", "y"]].to_numpy(), npz["pixel"]
    fresh = np.abs(place[:, None] - listed).max(axis=2).min(axis=1) > PITCH / 2
    star, side = np.repeat(np.flatnonzero(fresh)[:TESTED], DRAWS), model.info.stamp_px
    image = np.stack([_framed(psf, side) for psf in npz["psf"][star].astype(float)])
    everything = npz["psf"][star].sum(axis=(1, 2))
    area, rng = 1.0 / np.square(image).sum(axis=(1, 2)), stream(0, "simulated sky", "errors")
    for snr in FAINT_SNR:
        light = snr * np.sqrt(SKY * area)[:, None, None]
        stamps = rng.poisson(SKY + light * image).astype(float) - SKY
        result = model.predict(stamps, position=place[star], gain=np.ones(len(star)))
        inside, total = (light * image).sum(axis=(1, 2)), light[:, 0, 0] * everything
        # A model calls flux what is above a ring around the star.
        part = np.median(result.flux / inside)
        off = np.abs(result.flux - part * inside) / result.flux_error
        within_errors = {
            "flux": off < 1.0,
            "psf": (np.abs(result.psf - light * image) < result.uncertainty).mean(axis=(1, 2)),
        }
        row = {"snr": snr, "stars": len(np.unique(star)), "images": len(star)}
        row |= {
            "flux_over_stamp": part,
            "flux_total_over_all": np.median(result.flux_total / total),
        }
        row["flux_pull"] = np.quantile(off, 0.6827)
        for name, of in within_errors.items():
            row[name], row[f"{name}_stderr"] = cluster_mean(of.astype(float), star)
        rows.append(row | {"date": date.today().isoformat(), "commit": git_commit()})
    pd.DataFrame(rows).to_csv(out, index=False, float_format="%.6g")


def _framed(psf, side):
    """The stamp (d, d) of a star, brightest pixel at (d/2, d/2)."""
    row, column = np.divmod(psf.argmax(), SIDE)
    return _cut(np.pad(psf, side), np.array([[column, row]]) + side, side)[0]


def _cut(image, pixel, side):
    """Stamps (n, d, d) whose pixel (d/2, d/2) is a pixel (n, 2), x and y, of an image."""
    x, y = (pixel.T[..., None] - side // 2) + np.arange(side)
    return image[y[:, :, None], x[:, None, :]]


def _sampled(path, position, side):
    """Return a function that draws a package's PSFs (n, d, d) at centres (n, 2) (row, column)."""
    if path.suffix == ".psf":
        psf, step = _psfex(path, position + 1.0)
    else:
        samples = np.load(path)
        psf, step = samples["psf"], 1.0 / samples["oversampling"]
    grid = step * (np.arange(psf.shape[-1]) - psf.shape[-1] // 2)

    def draw(centre):
        rows, columns = ((np.arange(side) - side // 2 - c[:, None])[..., None] for c in centre.T)
        rows, columns = (_lanczos((a - grid) / step) for a in (rows, columns))
        return rows @ psf @ columns.transpose(0, 2, 1)

    return draw


def _psfex(path, position):
    """PSFs (n, m, m) of a file of PSFEx at 1-based positions (n, 2), and their step in pixels."""
    from astropy.io import fits

    with fits.open(path) as file:
        header, terms = file["PSF_DATA"].header, file["PSF_DATA"].data["PSF_MASK"][0]
    zero, scale = (np.array([header[f"POL{key}{i}"] for i in (1, 2)]) for key in ("ZERO", "SCAL"))
    x, y = ((position - zero) / scale).T
    degree = header["POLDEG1"]
    powers = [x**i * y**j for j in range(degree + 1) for i in range(degree + 1 - j)]
    return np.tensordot(np.stack(powers, axis=1), terms.astype(float), 1), header["PSF_SAMP"]


def _lanczos(t):
    """Weights (…, m) of samples at distances, their sum 1."""
    weight = np.where(np.abs(t) < LANCZOS, np.sinc(t) * np.sinc(t / LANCZOS), 0.0)
    return weight / weight.sum(axis=-1, keepdims=True)


def _fitted(draw, stamps):
    """PSFs of sum 1 in the frames of stamps (n, d, d), by least squares."""

    def solved(centre, *extra_columns):
        parts = np.stack([draw(centre), np.ones_like(stamps), *extra_columns], axis=-1)
        parts = parts.reshape(len(stamps), -1, parts.shape[-1])
        scales = np.linalg.pinv(parts) @ flat
        return scales[..., 0], np.square(flat - parts @ scales).sum(axis=(1, 2))

    flat = stamps.reshape(len(stamps), -1, 1)
    axis = np.arange(-FARTHEST, FARTHEST + 1.0)
    starts = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    first = [solved(np.tile(start, (len(stamps), 1)))[1] for start in starts]
    centre, min_chi2, part = starts[np.argmin(first, axis=0)], np.min(first, axis=0), 1.0
    for _ in range(ROUNDS):
        # Changes with the row and the column of the centre, from differences.
        slopes = [(draw(centre + e) - draw(centre - e)) / 0.04 for e in 0.02 * np.eye(2)]
        scales, _ = solved(centre, *slopes)
        move = np.clip(scales[:, 2:] / scales[:, :1], -STEP, STEP) * part
        chi2 = solved(centre + move)[1]
        is_improved = chi2 < min_chi2
        centre = np.where(is_improved[:, None], centre + move, centre)
        min_chi2 = np.minimum(chi2, min_chi2)
        part = np.where(is_improved, 1.0, np.asarray(part).ravel() / 2)[:, None]
    psf = draw(centre)
    return psf / psf.sum(axis=(1, 2), keepdims=True)


if __name__ == "__main__":
    program(field, places, errors)
