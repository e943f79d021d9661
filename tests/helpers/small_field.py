"""A field of 70 Gaussian stars on 300 × 300 pixels, with photon noise, for tests of its input."""

from __future__ import annotations

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

SIZE, COUNT, GAIN, READ, SKY = 300, 70, 1.5, 5.0, 300.0
CAMERA = {"gain": GAIN, "read_noise": READ, "pixel_scale_arcsec": 0.6, "saturate": 6e4}


def noisy(light, rng):
    """Counts of light above the sky, with photon and read noise."""
    return rng.poisson((light + SKY) * GAIN) / GAIN + rng.normal(0, READ / GAIN, light.shape)


def field(seed=3):
    """Counts (300, 300), float32, and positions (70, 2), x and y from 0."""
    rng = np.random.default_rng(seed)
    # A star in the middle third of each cell of a grid, so that none has a close neighbour.
    cell = np.stack(np.meshgrid(np.arange(10), np.arange(7)), axis=-1).reshape(-1, 2)
    place = (cell + rng.uniform(0.33, 0.67, (COUNT, 2))) * [30.0, 42.0]
    flux = 10 ** rng.uniform(4.0, 5.0, COUNT)
    y, x = np.indices((SIZE, SIZE))
    light = np.zeros((SIZE, SIZE))
    for (x0, y0), f in zip(place, flux, strict=True):
        light += f * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * 1.3**2)) / (2 * np.pi * 1.3**2)
    return noisy(light, rng).astype(np.float32), place


def moffat(fwhm):
    """Profile of a star by its distance in px, of the light 1, β = 3."""
    alpha = fwhm / 2 / np.sqrt(2 ** (1 / 3) - 1)
    return lambda r: 2 / (np.pi * alpha**2) * (1 + (r / alpha) ** 2) ** -3


def ring(r):
    """Star out of focus: a disc of 7 px with a hole of 2.5 px, of the light 1 within 1 %."""
    disc = 1 / (1 + np.exp((r - 7.0) / 0.5)) - 1 / (1 + np.exp((r - 2.5) / 0.5))
    return np.clip(disc, 0, None) / 135.0


def drawn(profile, place, flux, size, half=40, over=5):
    """Light (size, size) of stars at places (n, 2), x and y, each pixel the mean of many points."""
    light = np.zeros((size + 2 * half, size + 2 * half))
    axis = (np.arange((2 * half + 1) * over) + 0.5) / over - 0.5 - half
    for (x, y), total in zip(place, flux, strict=True):
        column, row = round(x), round(y)
        r = np.hypot(axis - (x - column), axis[:, None] - (y - row))
        star = profile(r).reshape(2 * half + 1, over, 2 * half + 1, over).mean((1, 3))
        light[row : row + 2 * half + 1, column : column + 2 * half + 1] += total * star
    return light[half:-half, half:-half]


def image_of(profile, flux, size, spacing_px, seed=1, edge=20):
    """Noisy image (size, size) of stars at least `apart` px from each other, and their places."""
    rng, place = np.random.default_rng(seed), []
    while len(place) < len(flux):
        new = rng.uniform(edge, size - 1 - edge, 2)
        if all(np.hypot(*(new - old)) >= spacing_px for old in place):
            place.append(new)
    return noisy(drawn(profile, place, flux, size), rng), np.array(place)


def header(**cards):
    """Cards of the camera, and others."""
    camera = {"GAIN": GAIN, "RDNOISE": READ, "SATURATE": 6e4, "PIXSCALE": 0.6}
    return fits.Header({**camera, **cards}.items())


SCALE = 0.6 / 3600
TANGENT = WCS(
    header(CRPIX1=150, CRPIX2=150, CRVAL1=10.0, CRVAL2=20.0, CDELT1=-SCALE, CDELT2=SCALE)
    + header(CTYPE1="RA---TAN", CTYPE2="DEC--TAN")
)


def write(path, image, **cards):
    """An image with the camera's header."""
    fits.writeto(path, image, header(**cards), overwrite=True)
    return path


def table(place, origin=0, names=("x", "y")):
    """A list of positions that count from an origin."""
    return Table(list((place + origin).T), names=names)


def stetson(listed, name):
    """A list of DAOPHOT, of numbers and positions from 1."""
    lines = [" NL    NX    NY  LOWBAD HIGHBAD  THRESH     AP1", "  1   300   300     1.0     6e4"]
    lines += ["", *(f"{k:7d} {x:8.3f} {y:8.3f}   15.000    0.010" for k, x, y in listed)]
    name.write_text("\n".join(lines) + "\n")
