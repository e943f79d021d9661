"""An image of which every number is known: not square, an elongated PSF with wings, a turned WCS.

Counts of a star of the flux F at (x, y) are F times the integral of `profile` over each pixel.
"""

from __future__ import annotations

import numpy as np
from astropy.io import fits
from astropy.table import Table
from scipy.optimize import least_squares

WIDTH, HEIGHT = 430, 270
GAIN, READ_NOISE, SKY, SATURATION = 2.0, 4.0, 150.0, 40000.0
MAJOR_PX, MINOR_PX, ANGLE_DEG = 2.2, 1.3, 30.0  # σ along the axes, and angle from +x to +y
CORE, WING_PX = 0.72, 6.0  # light of the Gaussian; radius of the wings
SCALE_ARCSEC, TURN_DEG, RA_DEG, DEC_DEG = 0.5, 25.0, 210.0, -35.0
REACH_PX, OVER = 45, 5  # half of the frame of a star, and points per pixel along an axis
NOISE = np.sqrt(SKY / GAIN + (READ_NOISE / GAIN) ** 2)


def profile(dx, dy):
    """Light per square pixel of a star of flux 1: a Gaussian, and wings of a Moffat of β = 2.5."""
    angle = np.deg2rad(ANGLE_DEG)
    along, across = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
    core = np.exp(-0.5 * ((along / MAJOR_PX) ** 2 + (across / MINOR_PX) ** 2))
    core /= 2 * np.pi * MAJOR_PX * MINOR_PX
    wings = 1.5 / (np.pi * WING_PX**2) * (1 + (dx**2 + dy**2) / WING_PX**2) ** -2.5
    return CORE * core + (1 - CORE) * wings


def light(x, y, about=None):
    """The light of a star of flux 1 in (2 REACH_PX + 1)² pixels about one, by default its own."""
    column, row = pixel(x, y) if about is None else about
    axis = (np.arange((2 * REACH_PX + 1) * OVER) + 0.5) / OVER - 0.5 - REACH_PX
    fine = profile(axis + column - x, (axis + row - y)[:, None])
    return fine.reshape(2 * REACH_PX + 1, OVER, 2 * REACH_PX + 1, OVER).mean((1, 3))


def pixel(x, y):
    """Column and row of the pixel of a position."""
    return int(np.floor(x + 0.5)), int(np.floor(y + 0.5))


def middle(frame, side):
    """The middle of a frame: a stamp of an even or odd side, its pixel at index side // 2."""
    start = REACH_PX - side // 2
    return frame[start : start + side, start : start + side]


def expose(stars, seed):
    """Counts (h, w) of stars with `x`, `y` and `flux`, with photon and read noise."""
    rng, pad = np.random.default_rng(seed), REACH_PX + 1
    counts = np.full((HEIGHT + 2 * pad, WIDTH + 2 * pad), SKY)
    for x, y, flux in stars.iterrows("x", "y", "flux"):
        column, row = (value + pad - REACH_PX for value in pixel(x, y))
        side = 2 * REACH_PX + 1
        counts[row : row + side, column : column + side] += flux * light(x, y)
    counts = counts[pad:-pad, pad:-pad]
    counts = rng.poisson(counts * GAIN) / GAIN + rng.normal(0, READ_NOISE / GAIN, counts.shape)
    return np.minimum(counts, SATURATION)


def header(**cards):
    """Cards of the camera and of the WCS, which is turned and mirrored as on the sky."""
    turn = np.deg2rad(TURN_DEG)
    wcs = {
        "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": RA_DEG, "CRVAL2": DEC_DEG,
        "CRPIX1": 101.0, "CRPIX2": 41.0,
        "CD1_1": -SCALE_ARCSEC / 3600 * np.cos(turn), "CD1_2": SCALE_ARCSEC / 3600 * np.sin(turn),
        "CD2_1": SCALE_ARCSEC / 3600 * np.sin(turn), "CD2_2": SCALE_ARCSEC / 3600 * np.cos(turn),
    }  # fmt: skip
    camera = {"GAIN": GAIN, "RDNOISE": READ_NOISE, "SATURATE": SATURATION, "BUNIT": "adu"}
    return fits.Header({**camera, **wcs, **cards}.items())


def on_sky(x, y):
    """Right ascension and declination of a pixel, degrees, by the formula of the projection."""
    turn, scale = np.deg2rad(TURN_DEG), np.deg2rad(SCALE_ARCSEC / 3600)
    dx, dy = x - 100.0, y - 40.0  # from the pixel of the axis, counted from 0
    east = scale * (-np.cos(turn) * dx + np.sin(turn) * dy)
    north = scale * (np.sin(turn) * dx + np.cos(turn) * dy)
    sine, cosine = np.sin(np.deg2rad(DEC_DEG)), np.cos(np.deg2rad(DEC_DEG))
    ra = RA_DEG + np.rad2deg(np.arctan2(east, cosine - north * sine))
    dec = np.arcsin((sine + north * cosine) / np.sqrt(1 + east**2 + north**2))
    return ra, np.rad2deg(dec)


SPECIAL = {
    # What is special of a star: where it is, its flux, and by how much its list is off.
    "right edge": (WIDTH - 3.0, 133.0, 4e4, 0, 0),
    "left edge": (2.0, 97.0, 4e4, 0, 0),
    "upper edge": (205.0, HEIGHT - 3.0, 4e4, 0, 0),
    "lower edge": (190.0, 2.0, 4e4, 0, 0),
    "saturated": (62.0, 44.0, 2.0e6, 0, 0),
    "masked": (98.0, 44.0, 4e4, 0, 0),
    "faint": (134.0, 44.0, 160.0, 0, 0),
    "moved": (170.0, 44.0, 4e4, 2, -2),
    "far": (314.0, 44.0, 4e4, 3, -3),
    "lost": (206.0, 44.0, 9e4, 8, 0),
    "pair": (242.0, 44.0, 4e4, 0, 0),
    "pair too": (242.0, 47.5, 3e4, 0, 0),
    "group": (278.0, 44.0, 4e4, 0, 0),
    "group too": (286.0, 44.0, 3e4, 0, 0),
}


def stars(seed, faintest=3.9, special=False):
    """Stars alone, and perhaps special ones: `kind`, true `x`, `y`, `flux`, and `x0`, `y0` listed.

    The list is off by up to 0.4 px, by another amount for each star.
    """
    rng, step = np.random.default_rng(seed), 36.0
    columns, rows = np.meshgrid(np.arange(26, WIDTH - 20, step), np.arange(80, HEIGHT - 20, step))
    if not special:
        columns, rows = np.meshgrid(columns[0], np.append(44.0, rows[:, 0]))
    x, y = (axis.ravel() + rng.uniform(-4, 4, axis.size) for axis in (columns, rows))
    table = Table({"x": x, "y": y, "flux": 10 ** rng.uniform(faintest, 5.4, len(x))})
    table["kind"] = np.full(len(x), "alone", dtype="U12")
    table["x0"], table["y0"] = (table[c] + rng.uniform(-0.4, 0.4, len(x)) for c in "xy")
    if special:
        for kind, (x, y, flux, off_x, off_y) in SPECIAL.items():
            table.add_row([x, y, flux, kind, x + off_x, y + off_y])
    table["id"] = 100 + 3 * np.arange(len(table))[::-1]
    return table


def truth(stars, fluxrad, side, box, gain=GAIN):
    """True light of isolated stars, and the smallest errors that noise allows.

    Keys are `total`, the light within `fluxrad`; `stamp`, that in stamps of a `side` about the
    pixels of the list; `snr` of a matched filter; and errors and correlations of flux, sky, row and
    column by the Fisher matrix, in the stamp with a free sky, and in a `box` of pixels without.
    `chi2` is that of the box, if the `gain` of the fit is not the true one.
    """
    index = np.indices((2 * REACH_PX + 1,) * 2) - REACH_PX
    rows = []
    for x, y, flux, x0, y0 in stars.iterrows("x", "y", "flux", "x0", "y0"):
        about = pixel(x0, y0)
        frame = light(x, y, about)
        distance = np.hypot(index[1] + about[0] - x, index[0] + about[1] - y)
        stamp = middle(frame, side)
        row = {"total": flux * frame[distance <= fluxrad].sum(), "stamp": flux * stamp.sum()}
        photons = flux * middle(frame, box)
        row["chi2"] = np.mean((NOISE**2 + photons / GAIN) / (NOISE**2 + photons / gain))
        row["snr"] = flux * np.sqrt((stamp**2).sum()) / NOISE
        # Derivatives of a pixel by the flux in the stamp, the sky, and the place.
        by_row, by_column = (
            flux * (light(x + dx, y + dy, about) - light(x - dx, y - dy, about)) / 2e-3
            for dx, dy in ((0, 1e-3), (1e-3, 0))
        )
        slopes = frame / stamp.sum(), np.ones_like(frame), by_row, by_column
        for place, size, parts in (("stamp", side, slopes), ("box", box, slopes[::2] + slopes[3:])):
            design = np.array([middle(part, size).ravel() for part in parts])
            variance = NOISE**2 + flux * middle(frame, size).ravel() / gain
            covariance = np.linalg.inv(design / variance @ design.T)
            error = np.sqrt(np.diag(covariance))
            names = ("flux", "background", "y", "x") if size == side else ("flux", "y", "x")
            for first, name in enumerate(names):
                row[f"{name}_error_{place}"] = error[first]
                for second, other in enumerate(names[:first]):
                    value = covariance[first, second] / error[first] / error[second]
                    row[f"corr_{other}_{name}_{place}"] = value
        rows.append(row)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def gaussian_shape():
    """FWHM (px), ellipticity and position angle (deg) of the Gaussian that fits a star best."""
    row, column = np.indices((14, 14)) - 7.0
    star = middle(light(0.0, 0.0), 14)

    def misfit(parameters):
        peak, x, y, major, minor, angle = parameters
        along = (column - x) * np.cos(angle) + (row - y) * np.sin(angle)
        across = (row - y) * np.cos(angle) - (column - x) * np.sin(angle)
        model = peak * np.exp(-0.5 * ((along / major) ** 2 + (across / minor) ** 2))
        return 100 * (model - star).ravel()

    *_, major, minor, angle = least_squares(misfit, [0.1, 0, 0, 2.5, 1.5, 0.3]).x
    return 2.3548 * np.sqrt(major * minor), 1 - minor / major, np.rad2deg(angle)
