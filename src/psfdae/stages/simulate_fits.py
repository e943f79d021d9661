"""Simulated PSFs as FITS files: a cube, and an image as a camera would deliver it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import psfdae
from psfdae.evaluation.telescope_figure import FieldOfPsfs
from psfdae.files import write_fits
from psfdae.own_stars.example import add_stamps, write_field
from psfdae.own_stars.photometry import noise_equivalent_px
from psfdae.rng import stream
from psfdae.stars.framing import normalise_flux

SKY = 1000.0
"""Photons per pixel of the sky."""

MARGIN_PX = 8
"""Sky between stamps."""


def write_psfs(config: Any, fields: FieldOfPsfs, path: Path) -> None:
    """Write the static PSFs as a cube, with a table of where they are.

    The primary HDU holds the fraction of the light on each pixel, (F, d, d), the
    table FIELDS one row per PSF. Both carry no date: the same PSFs, the same bytes.

    Parameters
    ----------
    config : stage config of `templates`
    fields : FieldOfPsfs
    path : path of the FITS file
    """
    from astropy.io import fits

    telescope = config.telescope
    cube = fits.PrimaryHDU(fields.psf.astype(np.float32))
    for card in (
        ("TELESCOP", telescope.name, "telescope of the configuration"),
        ("PIXSCALE", telescope.pixel_scale_arcsec, "[arcsec] width of a pixel"),
        ("WAVELEN", telescope.wavelength_m, "[m] wavelength"),
        ("APERTURE", telescope.diameter_m, "[m] diameter"),
        ("BUNIT", "1", "fraction of the light of the star"),
        ("CREATOR", f"psfdae {psfdae.__version__}", ""),
    ):
        cube.header.append(card)
    x, y = np.rad2deg(fields.field).T
    columns = (
        ("id", "K", None, np.arange(len(fields.psf))),
        ("x_deg", "D", "deg", x),
        ("y_deg", "D", "deg", y),
        ("energy", "D", None, fields.energy),
        ("fwhm", "D", "arcsec", fields.fwhm_arcsec),
        ("ellipticity", "D", None, fields.ellipticity),
        ("position_angle", "D", "deg", fields.position_angle_deg),
    )
    table = fits.BinTableHDU.from_columns(
        [fits.Column(name=n, format=f, unit=u, array=a) for n, f, u, a in columns], name="FIELDS"
    )
    write_fits(path, fits.HDUList([cube, table]))


def write_image(
    config: Any, fields: FieldOfPsfs, snr: float, seed: int, path: Path, catalogue: Path
) -> None:
    """Write an image with one noisy star per field, and its catalogue.

    The stars are moved together, so that little sky lies between them; their order
    on the detector is that of the field. Their flux is F = snr √(B A), with the sky B
    and the noise-equivalent area A of the mean PSF (King 1983, PASP 95, 163): the
    S/N of a matched filter that is limited by the sky.

    Parameters
    ----------
    config : stage config of `templates`
    fields : FieldOfPsfs
    snr : float
        > 0.
    seed : int
    path, catalogue : FITS image and CSV
    """
    stamps, _ = normalise_flux(fields.psf.astype(np.float64))
    side = stamps.shape[-1]
    flux = snr * np.sqrt(SKY * noise_equivalent_px(stamps.mean(axis=0)))
    pitch = side + MARGIN_PX
    columns, rows = fields.grid.max(axis=0) + 1
    x, y = (fields.grid * pitch + pitch // 2).T.astype(np.float64)
    expected = np.full((int(rows) * pitch, int(columns) * pitch), SKY)
    add_stamps(expected, flux * stamps, x, y)
    rng = stream(seed, "simulated image", config.telescope.name)
    write_field(
        path,
        catalogue,
        rng.poisson(expected).astype(np.float32),
        x,
        y,
        pixel_scale_arcsec=config.telescope.pixel_scale_arcsec,
        GAIN=1.0,
        TELESCOP=config.telescope.name,
    )
