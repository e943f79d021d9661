"""A simulated night of a telescope with its truth, and the positions at which PSFs are measured.

A recipe and a seed give exposures of two fields, some minutes apart. The seeing follows the airmass
and drifts; the focus drifts until the observer corrects it; each exposure is pointed a little
differently. Five exposures are bad: two through clouds, one trailed, one with the shutter closed,
and one whose file is truncated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial

import numpy as np

from psfdae.base.rng import stream
from psfdae.base.types import Table
from psfdae.stars.moments import measure_shapes
from psfdae_paper.stars.example import (
    FieldRecipe,
    add_stamps,
    example_field,
    expose,
    star_images,
    tangent_plane,
)

PLACES = {
    "centre": (0.5, 0.5),
    "lower_left": (0.1, 0.1),
    "lower_right": (0.9, 0.1),
    "upper_left": (0.1, 0.9),
    "upper_right": (0.9, 0.9),
}
"""Positions where the PSF of an image is measured: x and y over numbers of columns and rows."""

FAULTS = {0.14: "clouds", 0.37: "trailed", 0.55: "truncated file", 0.74: "clouds", 0.87: "no stars"}
"""Fault of the exposure after this fraction of the night."""


@dataclass(frozen=True)
class NightRecipe:
    """Exposures of a simulated night, and how the telescope changes in it."""

    exposures: int = 60
    field: FieldRecipe = field(
        default=FieldRecipe(
            side_px=512,
            bright=120,
            faint=80,
            saturated=2,
            blended=0,
            bright_snr=(150.0, 3000.0),
            seeing_px=2.1,
            seidel=(0.1, 0.6, 0.2, 0.2, 0.0),
        )
    )
    minutes: float = 3.0  # from one exposure to the next
    dither_px: float = 12.0  # largest offset of a pointing along either axis
    # The focus drifts between these fractions of the night, by this many waves W020 at the edge of
    # the pupil, and is then corrected.
    focus_drift: tuple[float, float] = (0.3, 0.7)
    focus_waves: float = 0.6
    extinction_mag: float = 0.15  # per airmass
    cloud_transmission: float = 0.06
    trail_px: float = 8.0


def locate_places(image_px: tuple[int, int]) -> np.ndarray:
    """Return x and y (5, 2) of `PLACES` in an image of `image_px` columns and rows.

    They are at centres of pixels, so that sizes do not depend on the sub-pixel phase.
    """
    return np.asarray(np.rint(np.array(list(PLACES.values())) * (np.array(image_px) - 1)))


def measure_places(
    psf_at: Callable[[np.ndarray], np.ndarray], image_px: tuple[int, int], prefix: str = ""
) -> dict[str, float]:
    """Return FWHM (px) and ellipticity of the PSF at `PLACES`, by names such as `fwhm_px_centre`.

    Parameters
    ----------
    psf_at : callable
        Returns PSFs (n, d, d) at positions (n, 2), x and y in pixels.
    image_px : tuple of int
        Columns and rows of the image.
    prefix : str
        Begins each name.
    """
    shapes = measure_shapes(psf_at(locate_places(image_px)))
    return {
        f"{prefix}{name}_{place}": float(value)
        for name, values in (("fwhm_px", shapes.fwhm_px), ("ellipticity", shapes.ellipticity))
        for place, value in zip(PLACES, values, strict=True)
    }


def describe_telescope(recipe: FieldRecipe) -> dict[str, object]:
    """Return the telescope of an exposure in focus, as a file of config/telescope describes it.

    Seidel terms are sums of Zernike terms: with Noll's normalisation, ρ² = Z4/(2√3) + …,
    ρ⁴ = Z11/(6√5) + Z4/(2√3) + …, ρ³ cos θ = Z8/(3√8) + …, and ρ² cos 2θ = Z6/√6; pistons and
    tilts are left out. The field vector is 1 at the middle of an edge of the image.
    """
    spherical, coma, astigmatism, curvature, _ = recipe.seidel
    # A pixel of 1 rad on the sky would be 1/(λ/D) λ/D wide.
    wavelength_m, pixel_rad = 6.0e-7, np.deg2rad(recipe.pixel_scale_arcsec / 3600.0)
    field_squared = float((curvature + 0.5 * astigmatism) / np.sqrt(12.0))
    along_axes = float(0.5 * astigmatism / np.sqrt(6.0))
    linear = float(coma / (3.0 * np.sqrt(8.0)))
    terms = {
        "z4": {
            "constant": float(spherical / np.sqrt(12.0)),
            "xx": field_squared,
            "yy": field_squared,
        },
        "z5": {"xy": 2.0 * along_axes},
        "z6": {"xx": along_axes, "yy": -along_axes},
        "z7": {"y": linear},
        "z8": {"x": linear},
        "z11": {"constant": float(spherical / (6.0 * np.sqrt(5.0)))},
    }
    seeing_arcsec = recipe.seeing_px * recipe.pixel_scale_arcsec
    return {
        "name": "example_night",
        "diameter_m": float(recipe.pixel * wavelength_m / pixel_rad),
        "obscuration": 0.35,
        "wavelength_m": wavelength_m,
        "pixel_scale_arcsec": recipe.pixel_scale_arcsec,
        "field_edge_deg": 0.5 * recipe.side_px * recipe.pixel_scale_arcsec / 3600.0,
        "aberrations": {"kind": "zernike", "terms": terms},
        "seeing": {"kind": "moffat", "fwhm_arcsec": seeing_arcsec, "beta": 3.0},
        # The focus may run away by as much, and seeing changes.
        "prior": {"waves": 0.1, "seeing": 0.2},
    }


def simulate_reference_stars(recipe: NightRecipe, seed: int) -> Table:
    """Return the stars of the night's two fields.

    Columns are the number of the field, pixel position (x, y) without a dither, sky position (ra,
    dec) in degrees, and magnitude with zero point 25 for one count.
    """
    from astropy.table import Table, vstack

    fields = []
    for number in range(2):
        exposure = example_field(recipe.field, seed + number)
        wcs = tangent_plane(
            exposure.image.shape, recipe.field.pixel_scale_arcsec, (150 + number, 2)
        )
        ra, dec = wcs.all_pix2world(*exposure.centroid.T, 0)
        x, y = exposure.position.T
        magnitude = 25.0 - 2.5 * np.log10(exposure.flux / recipe.field.gain)
        names = ("field", "x", "y", "ra", "dec", "mag")
        fields.append(Table([np.full(len(x), number), x, y, ra, dec, magnitude], names=names))
    return vstack(fields)


def simulate_night(
    recipe: NightRecipe, stars: Table, seed: int
) -> Iterator[tuple[np.ndarray, dict[str, str | float], dict[str, object]]]:
    """Yield the exposures of a night; the same recipe and seed give the same pixels.

    Parameters
    ----------
    recipe : NightRecipe
        Exposures, focus, seeing, clouds and trail.
    stars : Table
        Stars of both fields (`simulate_reference_stars`).
    seed : int
        Seed of pointing, seeing and photon noise.

    Yields
    ------
    counts : ndarray of uint16, shape (h, w)
        Pixels of the camera.
    cards : dict
        Cards of the header.
    truth : dict
        What is wrong with the exposure ("" if nothing is), and the shape of its PSF.
    """
    rng, start = stream(seed, "example night"), datetime(2026, 1, 15, 20, tzinfo=UTC)
    faults = {round(part * recipe.exposures): fault for part, fault in FAULTS.items()}
    shape, log_seeing = (recipe.field.side_px,) * 2, 0.0
    for number in range(recipe.exposures):
        part, fault = number / recipe.exposures, faults.get(number, "")
        # Each field is followed from 45° off the zenith to the zenith. Seeing grows with the
        # airmass to the power 0.6 (Roddier 1981, Prog. Opt. 19, 281), and wanders about it.
        airmass = 1.0 / np.cos(np.deg2rad(45.0 * (1.0 - 2.0 * part % 1.0)))
        log_seeing = 0.9 * log_seeing + 0.03 * rng.standard_normal()
        drift_start, drift_end = recipe.focus_drift
        optics = replace(
            recipe.field,
            seeing_px=recipe.field.seeing_px * airmass**0.6 * np.exp(log_seeing),
            defocus_waves=recipe.focus_waves
            * (part - drift_start)
            / (drift_end - drift_start)
            * (drift_start < part < drift_end),
        )
        # Stars of the field at this pointing, their light dimmed by air and clouds. A trail is the
        # sum of short exposures along a line.
        field_stars = stars[stars["field"] == int(2 * part)]
        dither = rng.uniform(-recipe.dither_px, recipe.dither_px, size=2)
        position = np.stack([field_stars["x"], field_stars["y"]], axis=1) + dither
        cloud = {"clouds": recipe.cloud_transmission, "no stars": 0.0}.get(fault, 1.0)
        magnitude = field_stars["mag"] + recipe.extinction_mag * (airmass - 1.0)
        electrons = optics.gain * cloud * 10 ** (0.4 * (25.0 - np.array(magnitude)))
        steps = np.linspace(-0.5, 0.5, 9) * recipe.trail_px if fault == "trailed" else np.zeros(1)
        starlight = np.zeros(shape)
        for step in steps:
            trail_position = position + np.array([step, 0.0])
            stamps = electrons[:, None, None] / len(steps) * star_images(optics, trail_position)
            add_stamps(starlight, stamps, *trail_position.T)
        # Header of the exposure: pointing, time and camera.
        wcs = tangent_plane(shape, optics.pixel_scale_arcsec, (150 + int(2 * part), 2))
        wcs.wcs.crpix += dither
        time = start + number * timedelta(minutes=recipe.minutes)
        cards: dict[str, str | float] = {
            "DATE-OBS": f"{time:%Y-%m-%dT%H:%M:%S}",
            "AIRMASS": round(float(airmass), 4),
            "FILTER": "r",
            "INSTRUME": "example camera",
            "GAIN": optics.gain,
        }
        cards |= {"SATURATE": float(optics.saturation), **wcs.to_header()}
        truth = measure_places(partial(star_images, optics), shape, "true_")
        # Defocus W020 ρ² of the drift and of the telescope in focus, as Zernike term.
        w020 = optics.seidel[0] + optics.defocus_waves
        truth["true_telescope_z4.constant_wave"] = float(w020 / np.sqrt(12.0))
        yield expose(optics, starlight, rng), cards, {"fault": fault, **truth}
