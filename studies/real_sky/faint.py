"""Cut the held-out stars and add noise until they are faint, for all packages.

usage: faint.py IMAGE SELECTION OUT.npz [SIDE] [COPIES]

SELECTION is the selection.csv that `psfdae train` leaves: id, x, y (0-based), part. OUT has
`noisy<S/N>` (copies, side, side) of flux FLUX without sky, `sigma<S/N>`, their noise, `truth`,
their PSFs of sum 1, `star` (copies,), the star of each among the held-out ones, `id` and `at`
(stars, 2), their brightest pixels (x, y), `own` (copies,), the noise of the truth. Every frame is
moved by a random whole pixel per axis, so that no package profits from where the middle is.

The stars are cut from the image, with their own noise and that of their sky. Beside an image of
images.py there is IMAGE.npz: then they are cut from its noise-free stars, and `own` is 0.
"""

import sys
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.stats import sigma_clipped_stats
from astropy.table import Table

SNR = (5, 10, 20, 50)  # of the copies, by a matched filter
FLUX = 1000.0
MOVE, RING = 1, 8  # px: of frames, and around a stamp, from which its sky is measured


def padded(image, reach):
    """An image that goes on beyond its edges."""
    data = np.asarray(fits.getdata(image), np.float64)
    return np.pad(np.nan_to_num(data, nan=np.nanmedian(data)), reach, mode="reflect")


def around(data, x, y, half, reach):
    """Stamp without its sky about pixel (x, y) of a padded image, and the noise of its pixels."""
    row, column = y + reach, x + reach
    side = half + RING
    ring = data[row - side : row + side, column - side : column + side].copy()
    ring[RING:-RING, RING:-RING] = np.nan
    _, sky, sigma = sigma_clipped_stats(ring[np.isfinite(ring)], stdfunc="mad_std")
    return data[row - half : row + half, column - half : column + half] - sky, sigma


def brightest(data, x, y, reach):
    """Brightest pixel (x, y) within 2 px of a position."""
    x, y = int(np.rint(x)), int(np.rint(y))
    core = data[y + reach - 2 : y + reach + 3, x + reach - 2 : x + reach + 3]
    row, column = np.unravel_index(core.argmax(), core.shape)
    return x + column - 2, y + row - 2


def noise_free(true_stars, star, at, half):
    """Stamp of a star of images.py about pixel (x, y) of its image."""
    psf = np.pad(np.asarray(true_stars["psf"][star], np.float64), half)
    column, row = at - true_stars["pixel"][star] + psf.shape[-1] // 2
    return psf[row - half : row + half, column - half : column + half]


def main(image, selection, out, side=10, copies=10):
    side, copies = int(side), int(copies)
    half, reach = side // 2 + MOVE, side // 2 + MOVE + RING + 3
    data, stars = padded(image, reach), Table.read(selection, format="ascii.csv")
    stars = stars[stars["part"] == "held out"]
    at = np.array([brightest(data, s["x"], s["y"], reach) for s in stars])
    file = Path(image).with_suffix(".npz")
    if file.exists():
        npz, own_noise = np.load(file), np.zeros(len(stars))
        frames = [noise_free(npz, s, xy, half) for s, xy in zip(stars["id"], at, strict=True)]
    else:
        frames, own_noise = zip(*(around(data, x, y, half, reach) for x, y in at), strict=True)
    rng = np.random.default_rng(int(stars["id"].sum()))
    star = np.repeat(np.arange(len(stars)), copies)
    move = rng.integers(0, 2 * MOVE + 1, (star.size, 2))[:, :, None] + np.arange(side)
    truth = np.stack(frames)[star[:, None, None], move[:, 0, :, None], move[:, 1, None, :]]
    flux = truth.sum(axis=(1, 2))
    truth /= flux[:, None, None]
    own_noise = np.array(own_noise)[star] / flux
    # Noise-equivalent width of the mean star: the squares of its noise are no light.
    square = np.square(truth).sum(axis=(1, 2)) - side**2 * own_noise**2
    width = np.sqrt(np.maximum(square, 0.0)).mean()
    arrays = {"truth": truth, "star": star, "at": at, "own": own_noise, "id": np.array(stars["id"])}
    for snr in SNR:
        added_noise = np.sqrt(np.maximum((width / snr) ** 2 - own_noise**2, 0.0))
        noisy = truth + added_noise[:, None, None] * rng.standard_normal(truth.shape)
        arrays |= {
            f"noisy{snr}": (FLUX * noisy).astype(np.float32),
            f"sigma{snr}": FLUX * width / snr,
        }
    np.savez(out, **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
