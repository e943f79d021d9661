"""Images like those of public reports: what the two commands of the README make of each.

    python strange_images.py TABLE FOLDER [KIND[:SEED] ...]      # without kinds: all

Each kind is an image with known stars, made with numpy. `train --method field` and
`photometry` run on it with default settings, and a row of TABLE compares the fluxes with the true
ones. Rows of TABLE of the same kind and seed are replaced; FOLDER keeps images, models and what was
printed.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from scipy.spatial import cKDTree

from psfdae_paper.source import git_commit

GAIN, READ_NOISE, SKY = 1.5, 5.0, 300.0
"""Electrons per count, electrons, counts per pixel."""

SIZE_PX, STARS = 600, 310
"""Side of an image and its stars: as dense as 700 stars on 900 × 900 px."""


@dataclass(frozen=True)
class Case:
    """An image with its true stars.

    Attributes
    ----------
    hdus : HDUList
        The file.
    stars : Table
        id, x, y (0-based pixels), flux (counts over the whole plane).
    star_list : Table or None
        With which the commands run; None: `--detect`.
    reach_px : float
        Farther from every true star than this, a source that is trained on is no star.
    suffix : str
        Of the file.
    """

    hdus: fits.HDUList
    stars: Table
    star_list: Table | None = None
    reach_px: float = 1.5
    suffix: str = ".fits"


# Profiles of stars, each of flux 1 and averaged over pixels.


def plane(side: int, x: float, y: float, samples: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Return sub-pixels' distances (px) from a centre, in columns and rows of a stamp."""
    axis = (np.arange(side * samples) + 0.5) / samples - 0.5
    columns, rows = np.meshgrid(axis - x, axis - y)
    return columns, rows


def binned(values: np.ndarray, side: int) -> np.ndarray:
    """Return the means (side, side) of the sub-pixels of each pixel."""
    samples = len(values) // side
    return values.reshape(side, samples, side, samples).mean(axis=(1, 3))


def moffat(
    side: int,
    x: float,
    y: float,
    u: float,
    v: float,
    fwhm: float = 2.8,
    samples: int = 5,
) -> np.ndarray:
    """Return a Moffat profile, β = 3, of which width and shape change with the place u, v in ±1."""
    fwhm, e1, e2 = fwhm * (1 + 0.1 * u * v), 0.08 * u, 0.08 * v
    columns, rows = plane(side, x, y, samples)
    # (1 + r²/α²)^-β with FWHM = 2 α √(2^(1/β) − 1), of the integral π α²/(β − 1)/|det|.
    alpha = fwhm / 2 / np.sqrt(2 ** (1 / 3) - 1)
    first, second = columns * (1 + e1) + rows * e2, rows * (1 - e1) + columns * e2
    light = (1 + (first**2 + second**2) / alpha**2) ** -3
    return binned(light, side) * 2 * (1 - e1**2 - e2**2) / (np.pi * alpha**2)


def ring(side: int, x: float, y: float, u: float, v: float) -> np.ndarray:
    """Return a star out of focus: a disc of 7 px with the shadow of the secondary mirror."""
    columns, rows = plane(side, x, y)
    disc = 1 / (1 + np.exp((np.hypot(columns, rows) - 7.0) / 0.5))
    hole = 1 / (1 + np.exp((np.hypot(columns - 0.4 * u, rows - 0.4 * v) - 2.5) / 0.5))
    light = binned(np.clip(disc - hole, 0, None), side)
    return light / light.sum()


def trail(side: int, x: float, y: float, u: float, v: float) -> np.ndarray:
    """Return a star that moved by 5 px at 30° while the shutter was open: elongation 2 : 1."""
    steps = np.linspace(-2.5, 2.5, 11)
    at = [(x + s * np.cos(np.pi / 6), y + s * np.sin(np.pi / 6)) for s in steps]
    return np.mean([moffat(side, *place, u, v, samples=3) for place in at], axis=0)


# Images.


def places(rng: np.random.Generator, count: int, size: int, distance_px: float = 0.0) -> np.ndarray:
    """Return positions (count, 2), x and y, no two nearer than `distance_px`."""
    accepted: list[np.ndarray] = []
    while len(accepted) < count:
        new = rng.uniform(4, size - 5, 2)
        if all(np.hypot(*(new - place)) >= distance_px for place in accepted):
            accepted.append(new)
    return np.array(accepted)


def fluxes(rng: np.random.Generator, count: int, low: float, high: float) -> np.ndarray:
    """Return fluxes (count,), N(> F) ∝ F^−0.625, as stars of which 10^(0.25 m) are brighter."""
    power = 0.625
    return (low**-power + rng.uniform(size=count) * (high**-power - low**-power)) ** (-1 / power)


def light_of(
    place: np.ndarray,
    flux: np.ndarray,
    size: int,
    psf: Callable[..., np.ndarray] = moffat,
    half: int = 30,
    **shape: float,
) -> np.ndarray:
    """Return the light (size, size) of stars in counts, each drawn within ± `half` px."""
    pad, side = half + 2, 2 * half + 1
    image = np.zeros((size + 2 * pad, size + 2 * pad))
    for (x, y), counts in zip(place, flux, strict=True):
        column, row = round(x), round(y)
        u, v = 2 * x / size - 1, 2 * y / size - 1
        star = psf(side, half + x - column, half + y - row, u, v, **shape)
        square = np.s_[row + 2 : row + 2 + side, column + 2 : column + 2 + side]
        image[square] += counts * star
    return image[pad:-pad, pad:-pad]


def exposed(
    rng: np.random.Generator, light: np.ndarray, gain: np.ndarray | float = GAIN
) -> np.ndarray:
    """Return counts with photon and read noise of an image (h, w) of expected counts."""
    electrons = rng.poisson(np.clip(light, 0, None) * gain) + rng.normal(0, READ_NOISE, light.shape)
    return electrons / gain


def table_of(place: np.ndarray, flux: np.ndarray) -> Table:
    """Return the true stars."""
    number = 1000 + np.arange(len(flux))
    return Table({"id": number, "x": place[:, 0], "y": place[:, 1], "flux": flux})


def file_of(image: np.ndarray, **cards: object) -> fits.HDUList:
    """Return an image with the header of a camera; a card that is None is left out."""
    cards = {"GAIN": GAIN, "RDNOISE": READ_NOISE, "SATURATE": 60000.0, "PIXSCALE": 0.6, **cards}
    header = fits.Header([(key, value) for key, value in cards.items() if value is not None])
    return fits.HDUList([fits.PrimaryHDU(image.astype(np.float32), header)])


def scene(
    seed: int,
    count: int = STARS,
    size: int = SIZE_PX,
    distance_px: float = 0.0,
    low: float = 500.0,
    high: float = 3e5,
    **drawing: object,
) -> tuple[np.random.Generator, np.ndarray, Table]:
    """Return random numbers, the light of stars without sky and noise, and the stars."""
    rng = np.random.default_rng(seed)
    place = places(rng, count, size, distance_px)
    flux = fluxes(rng, count, low, high)
    return rng, light_of(place, flux, size, **drawing), table_of(place, flux)


# Kinds that psfdae is known to treat, with other seeds and smaller.


def usual(seed: int) -> Case:
    """Stars of a FWHM of 2.8 px that changes over the field."""
    rng, light, stars = scene(seed)
    return Case(file_of(exposed(rng, light + SKY)), stars)


def cosmics(seed: int) -> Case:
    """53 hot pixels and 11 tracks of cosmic rays on the usual image."""
    rng, light, stars = scene(seed)
    image = exposed(rng, light + SKY)
    row, column = rng.integers(0, SIZE_PX, (2, 53))
    image[row, column] += rng.uniform(300, 2e4, 53)
    for _ in range(11):
        (y, x), angle, length = rng.uniform(20, 580, 2), rng.uniform(0, np.pi), rng.uniform(3, 15)
        for step in np.arange(0, length, 0.5):
            pixel = int(y + step * np.sin(angle)), int(x + step * np.cos(angle))
            image[pixel] += rng.uniform(500, 5000)
    return Case(file_of(image), stars)


def few_12(seed: int) -> Case:
    """Twelve bright stars on 200 × 200 px."""
    rng, light, stars = scene(seed, 12, 200, 20, 3e4, 2e5, fwhm=2.6)
    return Case(file_of(exposed(rng, light + SKY)), stars, stars)


def wide(seed: int) -> Case:
    """Stars of a FWHM of 12 px."""
    rng, light, stars = scene(seed, 53, SIZE_PX, 40, 1e5, 5e6, fwhm=12.0, half=60)
    return Case(file_of(exposed(rng, light + SKY), SATURATE=1e9), stars)


def rings(seed: int) -> Case:
    """Stars out of focus, of 14 px, with their list."""
    rng, light, stars = scene(seed, 67, SIZE_PX, 30, 5e4, 2e6, psf=ring)
    return Case(file_of(exposed(rng, light + SKY), SATURATE=1e9), stars, stars, 4.0)


def half_empty(seed: int) -> Case:
    """Half of the image is 0."""
    rng, light, stars = scene(seed)
    image = exposed(rng, light + SKY)
    image[: SIZE_PX // 2] = 0.0
    return Case(file_of(image), stars[stars["y"] > SIZE_PX // 2])


# Kinds of public reports.


def nebula(seed: int) -> Case:
    """A gradient of stray light from 300 to 900 counts, and a nebula with structure of 10 to 60 px.

    The nebula has an RMS of 150 counts. Its filaments are the light above the mean of a random
    field of the power spectrum k^−3.5 that is smoothed by a Gaussian of σ = 4 px.
    """
    rng, light, stars = scene(seed)
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(SIZE_PX), np.fft.fftfreq(SIZE_PX)))
    wave[0, 0] = np.inf
    shape = wave**-1.75 * np.exp(-0.5 * (2 * np.pi * 4.0 * np.minimum(wave, 1.0)) ** 2)
    cloud = np.fft.ifft2(np.fft.fft2(rng.normal(size=wave.shape)) * shape).real
    cloud = np.clip(cloud, 0, None)
    gradient = np.linspace(0, 600, SIZE_PX)[None] + SKY
    return Case(file_of(exposed(rng, light + gradient + 150 * cloud / cloud.std())), stars)


def bleeding(seed: int, **cards: object) -> Case:
    """Six saturated stars: charge that runs along columns, and four spikes of diffraction."""
    rng, light, stars = scene(seed)
    place, flux = rng.uniform(60, SIZE_PX - 60, (6, 2)), rng.uniform(5e6, 5e7, 6)
    light += light_of(place, flux, SIZE_PX, half=50)
    row, column = np.indices(light.shape)
    for (x, y), counts in zip(place, flux, strict=True):
        # Spikes along the diagonals, 1.5 px wide, falling as 1/r² from 2e-5 of the flux at 10 px.
        for sign in (-1, 1):
            along = np.abs((column - x) + sign * (row - y)) / np.sqrt(2)
            across = np.abs((column - x) - sign * (row - y)) / np.sqrt(2)
            height = 2e-5 * counts / (1 + (along / 10) ** 2)
            light += height * np.exp(-0.5 * (across / 0.8) ** 2) * (along < 120)
    image = exposed(rng, light + SKY)
    # Charge above the full well runs up and down its column until it has found room.
    full = 60000.0
    for c in np.flatnonzero((image > full).any(axis=0)):
        excess = np.clip(image[:, c] - full, 0, None)
        core = np.flatnonzero(excess)
        image[:, c] = np.minimum(image[:, c], full)
        for direction, edge in ((-1, core[0]), (1, core[-1])):
            charge, r = excess.sum() / 2, edge
            while charge > 0 and 0 <= r < SIZE_PX:
                room = min(full - image[r, c], charge)
                image[r, c], charge, r = image[r, c] + room, charge - room, r + direction
    stars = table_of(
        np.vstack([np.stack([stars["x"], stars["y"]], axis=1), place]),
        np.append(stars["flux"], flux),
    )
    return Case(file_of(image, **cards), stars)


def bleeding_unsaid(seed: int) -> Case:
    """The same without SATURATE in the header."""
    return bleeding(seed, SATURATE=None)


def trailed(seed: int) -> Case:
    """Stars that moved by 5 px at 30° during the exposure."""
    rng, light, stars = scene(seed, psf=trail)
    return Case(file_of(exposed(rng, light + SKY)), stars)


def amplifiers(seed: int) -> Case:
    """Two amplifiers: 1.5 electrons per count, and 1.2 with a bias that is 40 counts too high.

    The header has the gain of the first.
    """
    rng, light, stars = scene(seed)
    gain = np.where(np.arange(SIZE_PX) < SIZE_PX // 2, 1.5, 1.2)[None]
    electrons = (light + SKY) * GAIN
    image = exposed(rng, electrons / gain, gain) + np.where(gain < 1.5, 40.0, 0.0)
    stars["flux"] *= np.where(stars["x"] < SIZE_PX / 2 - 0.5, 1.0, 1.5 / 1.2)
    return Case(file_of(image), stars)


def resampled(seed: int) -> Case:
    """Moved by half a pixel with bilinear interpolation: pixels show half of the noise of sums."""
    rng, light, stars = scene(seed)
    image = exposed(rng, light + SKY)
    image = (image[1:, 1:] + image[:-1, 1:] + image[1:, :-1] + image[:-1, :-1]) / 4
    stars["x"] -= 0.5
    stars["y"] -= 0.5
    return Case(file_of(image), stars)


def unsigned(seed: int) -> Case:
    """Whole counts up to 65535 as 16 bits with BZERO, compressed (.fz), without SATURATE."""
    rng, light, stars = scene(seed, low=2000.0, high=5e6)
    image = np.clip(np.rint(exposed(rng, light + SKY)), 0, 65535).astype(np.uint16)
    header = fits.Header([("GAIN", GAIN), ("RDNOISE", READ_NOISE)])
    packed = fits.CompImageHDU(image, header, compression_type="RICE_1")
    return Case(fits.HDUList([fits.PrimaryHDU(), packed]), stars, suffix=".fits.fz")


def quantised(seed: int) -> Case:
    """Compressed with steps of the noise, without dither, as `fpack -q0 1` does."""
    rng, light, stars = scene(seed)
    image = exposed(rng, light + SKY).astype(np.float32)
    header = fits.Header([("GAIN", GAIN), ("RDNOISE", READ_NOISE), ("SATURATE", 60000.0)])
    compression = {"compression_type": "RICE_1", "quantize_level": 1.0, "quantize_method": -1}
    packed = fits.CompImageHDU(image, header, **compression)
    return Case(fits.HDUList([fits.PrimaryHDU(), packed]), stars, suffix=".fits.fz")


def satellites(seed: int) -> Case:
    """Two trails right across the image, of 100 and 1000 counts in their middle line."""
    rng, light, stars = scene(seed)
    row, column = np.indices(light.shape)
    for height in (100.0, 1000.0):
        angle, (x, y) = rng.uniform(0, np.pi), rng.uniform(200, 400, 2)
        across = (row - y) * np.cos(angle) - (column - x) * np.sin(angle)
        light += height * np.exp(-0.5 * (across / 1.2) ** 2)
    return Case(file_of(exposed(rng, light + SKY)), stars)


def undersampled(seed: int) -> Case:
    """Stars of a FWHM of 1.2 px."""
    rng, light, stars = scene(seed, fwhm=1.2, samples=15, half=20)
    return Case(file_of(exposed(rng, light + SKY)), stars)


def crowded_undersampled(seed: int) -> Case:
    """2500 stars of a FWHM of 1.3 px on 400 × 400 px, on a sky that changes from 200 to 600 counts.

    The brightest ones have a neighbour of a fiftieth of their light within 12 px, nearly all of
    them.
    """
    rng, light, stars = scene(seed, 2500, 400, low=150.0, fwhm=1.3)
    across, down = np.meshgrid(np.linspace(-1, 1, 400), np.linspace(-1, 1, 400))
    sky = 400.0 + 150.0 * across + 50.0 * np.sin(4.0 * down + 2.0 * across)
    return Case(file_of(exposed(rng, light + sky)), stars)


def galaxies(seed: int) -> Case:
    """500 galaxies among 310 stars: exponential discs of scales of 1 to 4 px, seen by the PSF."""
    rng, light, stars = scene(seed)
    place, flux = places(rng, 500, SIZE_PX), fluxes(rng, 500, 1000.0, 1e5)
    discs = np.zeros_like(light)
    row, column = np.indices(light.shape)
    for (x, y), counts in zip(place, flux, strict=True):
        scale, ratio, angle = rng.uniform(1, 4), rng.uniform(0.3, 1), rng.uniform(0, np.pi)
        part = np.s_[max(int(y) - 40, 0) : int(y) + 41, max(int(x) - 40, 0) : int(x) + 41]
        dx, dy = column[part] - x, row[part] - y
        first, second = (
            dx * np.cos(angle) + dy * np.sin(angle),
            dy * np.cos(angle) - dx * np.sin(angle),
        )
        disc = np.exp(-np.hypot(first, second / ratio) / scale)
        discs[part] += counts * disc / (2 * np.pi * ratio * scale**2)
    psf = np.zeros_like(light)
    psf[:61, :61] = moffat(61, 30, 30, 0, 0)
    psf = np.roll(psf, (-30, -30), axis=(0, 1))
    discs = np.fft.ifft2(np.fft.fft2(discs) * np.fft.fft2(psf)).real
    return Case(file_of(exposed(rng, light + discs + SKY)), stars)


def halo(seed: int) -> Case:
    """One star of 2e8 counts: its core is saturated, its halo has 6000 counts at 20 px, ∝ r^−2."""
    rng, light, stars = scene(seed)
    x, y = rng.uniform(200, 400, 2)
    row, column = np.indices(light.shape)
    radius = np.hypot(row - y, column - x)
    light += 6000.0 / (1 + (radius / 20) ** 2) + 2e7 * np.exp(-0.5 * (radius / 1.2) ** 2)
    light += 2e6 / (1 + (radius / 3) ** 3)
    return Case(file_of(np.minimum(exposed(rng, light + SKY), 60000.0)), stars)


def difference(seed: int) -> Case:
    """The difference of two exposures: half of 120 variable stars became fainter, others cancel."""
    rng, constant, _ = scene(seed)
    place, flux = places(rng, 120, SIZE_PX, 12), fluxes(rng, 120, 5000.0, 2e5)
    brighter = np.arange(120) % 2 == 0
    image = exposed(rng, constant + light_of(place[brighter], flux[brighter], SIZE_PX) + SKY)
    image -= exposed(rng, constant + light_of(place[~brighter], flux[~brighter], SIZE_PX) + SKY)
    return Case(file_of(image), table_of(place[brighter], flux[brighter]))


def rotated(seed: int) -> Case:
    """A mosaic turned by 20°: NaN around it, a quarter of it exposed four times as long."""
    rng, light, stars = scene(seed)
    row, column = np.indices(light.shape) - SIZE_PX / 2
    angle = np.deg2rad(20)
    along, across = (
        column * np.cos(angle) + row * np.sin(angle),
        row * np.cos(angle) - column * np.sin(angle),
    )
    gain = np.where((along > 0) & (across > 0), 4 * GAIN, GAIN)
    image = exposed(rng, light + SKY, gain)
    inside = np.maximum(np.abs(along), np.abs(across)) < 230
    image[~inside] = np.nan
    at = np.rint(stars["y"]).astype(int), np.rint(stars["x"]).astype(int)
    return Case(file_of(image), stars[inside[at]])


def sip_list(seed: int) -> Case:
    """A WCS with SIP, but CTYPE without -SIP, and a list of sexagesimal texts."""
    rng, light, stars = scene(seed)
    cards = {
        "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CUNIT1": "deg", "CUNIT2": "deg",
        "CRPIX1": 300.5, "CRPIX2": 300.5, "CRVAL1": 150.0, "CRVAL2": -12.0,
        "CD1_1": -0.6 / 3600, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.6 / 3600,
        "A_ORDER": 2, "A_2_0": 3e-5, "A_0_2": -2e-5, "B_ORDER": 2, "B_1_1": 4e-5,
    }  # fmt: skip
    hdus = file_of(exposed(rng, light + SKY), **cards, PIXSCALE=None)
    sky = WCS(hdus[0].header).pixel_to_world(stars["x"], stars["y"])
    ra = sky.ra.to_string("hourangle", sep=":", precision=4, pad=True)
    dec = sky.dec.to_string("deg", sep=":", precision=3, alwayssign=True, pad=True)
    return Case(hdus, stars, Table({"id": stars["id"], "ra": ra, "dec": dec}))


def broken_wcs(seed: int) -> Case:
    """A WCS of which the matrix has no inverse, with a projection that nobody knows."""
    rng, light, stars = scene(seed)
    cards = {
        "CTYPE1": "RA---TNX", "CTYPE2": "DEC--TNX", "CRPIX1": 300.5, "CRPIX2": "300.5",
        "CRVAL1": 150.0, "CRVAL2": -12.0, "CD1_1": 0.0, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.0,
        "WAT1_001": "wtype=tnx axtype=ra lngcor = '3. 2. 2. 2.",
    }  # fmt: skip
    return Case(file_of(exposed(rng, light + SKY), **cards), stars)


SEEDS = {
    **dict.fromkeys((usual, cosmics, few_12, wide, rings, half_empty), (101, 102)),
    **dict.fromkeys((nebula, bleeding, bleeding_unsaid, trailed, amplifiers, resampled), (201,)),
    **dict.fromkeys((unsigned, quantised, satellites, undersampled, galaxies, halo), (201,)),
    crowded_undersampled: tuple(range(301, 311)),
    **dict.fromkeys((difference, rotated, sip_list, broken_wcs), (201,)),
}
"""Kinds in the order of the table, and the seeds of their rows."""


# The two commands and their judgement.


@dataclass
class Run:
    """Output of a command, and its cost."""

    code: int
    text: str
    cpu_s: float
    refusal: str = field(default="")


def run(words: list[object]) -> Run:
    """Run psfdae with one thread."""
    cpu_before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.run(
        [sys.executable, "-m", "psfdae", *map(str, words)],
        check=False, capture_output=True, text=True, env={**os.environ, **threads},
    )  # fmt: skip
    cost = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - cpu_before
    lines = process.stderr.strip().splitlines()
    refusal = lines[-1] if process.returncode and lines else ""
    if "Traceback" in process.stderr:
        refusal = f"TRACEBACK {refusal}"
    return Run(process.returncode, process.stdout + process.stderr, cost, refusal)


def judged(kind: str, seed: int, case: Case, folder: Path) -> dict[str, object]:
    """Run both commands on a case and compare with the truth; a row of the table.

    Bias (median) and scatter (1.48 times the median deviation) of the flux in per cent, the median
    stated error, and the part within one stated error are of the brighter half of the stars. Fakes
    are sources without a flag that are farther than 2 px from every star; far off are stars of the
    brighter half without a flag that are wrong by 10 stated errors and 5 %.
    """
    place = folder / f"{kind}_{seed}"
    place.mkdir(parents=True, exist_ok=True)
    image = place / f"image{case.suffix}"
    case.hdus.writeto(image, overwrite=True)
    case.stars.write(place / "truth.csv", overwrite=True)
    stars: list[object] = ["--detect"]
    if case.star_list is not None:
        case.star_list.write(place / "list.csv", overwrite=True)
        stars = ["--catalogue", place / "list.csv"]
        stars += ["--origin", "0"] if "x" in case.star_list.colnames else []
    row: dict[str, object] = {"kind": kind, "seed": seed}
    model = ["--method", "field", "--out", place / "model", "--overwrite"]
    fit = run(["train", image, *stars, *model])
    (place / "from_stars.txt").write_text(fit.text)
    row |= {"from_stars": fit.code, "cpu_s": fit.cpu_s, "refusal": fit.refusal[:200]}
    if fit.code:
        return row
    truth = cKDTree(np.stack([case.stars["x"], case.stars["y"]], axis=1))
    selection = Table.read(place / "model" / "selection.csv", format="ascii.csv")
    learnt = selection[np.isin(selection["part"], ["training", "held out"])]
    off, _ = truth.query(np.stack([learnt["x"], learnt["y"]], axis=1))
    row |= {"learnt": len(learnt), "wrong": int((off > case.reach_px).sum())}
    (bundle,) = (place / "model").glob("*.psf.safetensors")
    out = ["--model", bundle, "--out", place / "photometry.csv", "--overwrite"]
    job = run(["photometry", image, *stars, *out])
    (place / "photometry.txt").write_text(job.text)
    row |= {"photometry": job.code, "cpu_s": fit.cpu_s + job.cpu_s, "refusal": job.refusal[:200]}
    if job.code:
        return row
    measured = Table.read(place / "photometry.csv", format="ascii.csv")
    measured = measured[np.isfinite(measured["x"]) & np.isfinite(measured["y"])]
    positions = np.stack([measured["x"], measured["y"]], axis=1)
    distance, nearest = cKDTree(positions).query(truth.data)
    flux = np.array(case.stars["flux"])
    ratio = np.array(measured["flux"])[nearest] / flux - 1
    error = np.array(measured["flux_error"])[nearest] / flux
    clean = np.array(measured["flags"]) == 0
    bright = (distance < 1.5) & (flux > np.median(flux)) & np.isfinite(ratio)
    is_off = clean[nearest] & bright & (np.abs(ratio) > 10 * error) & (np.abs(ratio) > 0.05)
    deviation = np.abs(ratio[bright] - np.median(ratio[bright]))
    return row | {
        "n": int(bright.sum()),
        "bias_percent": 100 * np.median(ratio[bright]),
        "scatter_percent": 148.26 * np.median(deviation),
        "stated_percent": 100 * np.nanmedian(error[bright]),
        "within": np.mean(np.abs(ratio[bright]) < error[bright]),
        "fakes": int((clean & (truth.query(positions)[0] > max(2.0, case.reach_px))).sum()),
        "far_off": int(is_off.sum()),
    }


COUNTS = ["from_stars", "photometry", "learnt", "wrong", "n", "fakes", "far_off"]
PER_CENT = ["bias_percent", "scatter_percent", "stated_percent"]
COLUMNS = ["kind", "seed", *COUNTS[:5], *PER_CENT, "within", *COUNTS[5:], "cpu_s", "refusal"]
COLUMNS += ["date", "commit"]


def main(table: Path, folder: Path, *names: str) -> None:
    """Make, run and judge the kinds that are named."""
    kinds = {kind.__name__: kind for kind in SEEDS}
    pairs = [(name, seed) for name, kind in kinds.items() for seed in SEEDS[kind]]
    if names:
        pairs = [p for p in pairs if {p[0], f"{p[0]}:{p[1]}"} & set(names)]
    for name, seed in pairs:
        row = judged(name, seed, kinds[name](seed), folder)
        row |= {"date": date.today().isoformat(), "commit": git_commit()}
        rows = pd.DataFrame([row], columns=COLUMNS)
        if table.exists():
            old_rows = pd.read_csv(table)
            is_same = (old_rows["kind"] == name) & (old_rows["seed"] == seed)
            rows = pd.concat([old_rows[~is_same], rows])
        place = rows["kind"].map({kind: place for place, kind in enumerate(kinds)})
        rows = rows.assign(place=place).sort_values(["place", "seed"]).drop(columns="place")
        rows[COUNTS] = rows[COUNTS].astype("Int64")
        rows.to_csv(table, index=False, float_format="%.4g")
        print(rows[(rows["kind"] == name) & (rows["seed"] == seed)].T.to_string(header=False))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
