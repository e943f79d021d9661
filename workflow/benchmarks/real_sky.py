"""psfdae beside other packages, on faint copies of the bright stars of a real image.

`faint` cuts the stars that `from-stars` held out, and adds noise until they are faint. Any
package that has learnt from the training stars of the same list may estimate the PSFs of these
stamps, where it is installed; `compare` puts its errors beside those of a model bundle.
"""

from datetime import date
from pathlib import Path
from typing import Annotated

import click
import numpy as np

from measure import write
from psfdae.cli import File, command, program
from psfdae.files import atomic_path
from psfdae.reading import read_table
from psfdae.rng import stream
from psfdae.source import git_commit

SNR = (5, 10, 20, 50)  # of the copies, by a matched filter
FLUX = 1000.0  # of every copy, counts
MOVE_PX = 1  # frames are moved by whole pixels of up to this, per axis
RING_PX = 8  # around a stamp, from which its sky is measured


@command("faint")
def faint(
    image: Annotated[File, {"argument": True}, "FITS image."],
    selection: Annotated[File, "selection.csv of from-stars on this image."],
    out: Annotated[File, "NPZ with the stamps, for all packages."],
    stamp_px: Annotated[int, click.IntRange(min=6), "Side of the stamps."] = 16,
    copies: Annotated[int, click.IntRange(min=1), "Of each star."] = 10,
    seed: Annotated[int, "Of moves and noise."] = 0,
) -> None:
    """Cut the held-out stars of an image and make them faint.

    `noisy<S/N>` (copies, d, d) are the stamps, `truth` their PSFs of sum 1, `idx` the star of each,
    `pos` (stars, 2) the brightest pixel (x, y) of each star. Every frame is moved by a random
    whole pixel, so that no package profits from where the middle is.
    """
    from astropy.io import fits
    from astropy.stats import sigma_clipped_stats

    stars = read_table(selection).query("part == 'held out'")
    data = np.asarray(fits.getdata(image), np.float64)
    half, reach = stamp_px // 2, stamp_px // 2 + MOVE_PX + RING_PX
    data = np.pad(np.nan_to_num(data, nan=np.nanmedian(data)), reach, mode="reflect")
    wide, position, noise = [], [], []
    for x, y in np.rint(stars[["x", "y"]].to_numpy()).astype(int) + reach:
        core = data[y - 2 : y + 3, x - 2 : x + 3]
        row, column = np.unravel_index(core.argmax(), core.shape) + np.array([y, x]) - 2
        around = data[row - reach : row + reach, column - reach : column + reach].copy()
        around[RING_PX:-RING_PX, RING_PX:-RING_PX] = np.nan
        _, sky, sigma = sigma_clipped_stats(around[np.isfinite(around)], stdfunc="mad_std")
        edge = half + MOVE_PX
        wide.append(data[row - edge : row + edge, column - edge : column + edge] - sky)
        position.append((column - reach, row - reach))
        noise.append(sigma)
    rng = stream(seed, "real sky")
    star = np.repeat(np.arange(len(wide)), copies)
    move = rng.integers(-MOVE_PX, MOVE_PX + 1, (star.size, 2))
    at = MOVE_PX + move[:, :, None] + np.arange(stamp_px)
    truth = np.stack(wide)[star[:, None, None], at[:, 0, :, None], at[:, 1, None, :]]
    flux = truth.sum(axis=(1, 2))
    truth /= flux[:, None, None]
    own = np.array(noise)[star] / flux
    square = np.square(truth).sum(axis=(1, 2)) - stamp_px**2 * own**2
    width = np.sqrt(np.maximum(square, 0.0)).mean()
    arrays = {"truth": truth, "idx": star, "pos": np.array(position), "own": own}
    for snr in SNR:
        more = np.sqrt(np.maximum((width / snr) ** 2 - own**2, 0.0))
        noisy = truth + more[:, None, None] * rng.standard_normal(truth.shape)
        arrays[f"noisy{snr}"] = (FLUX * noisy).astype(np.float32)
    with atomic_path(out) as temporary, temporary.open("wb") as file:
        np.savez(file, flux=FLUX, SNR=np.array(SNR), **arrays)


@command("compare")
def compare(
    stamps: Annotated[File, {"argument": True}, "NPZ of `faint`."],
    bundle: Annotated[File, "Model of from-stars on the training stars of the same list."],
    others: Annotated[
        tuple[str, ...],
        {"flag": "--other"},
        "NAME=NPZ with est<S/N> (copies, d, d) and flux<S/N> (copies,) of another package.",
    ],
    out: Annotated[File, "CSV with the errors of each package at each S/N."],
) -> None:
    """Errors of PSFs of sum 1, and of fluxes, beside the best of the other packages.

    Standard errors are those of the stars, each the mean of its copies; that of the ratio is
    paired. The truth's own noise is in every error (`own_mse`).
    """
    from psfdae.own_stars.model import load_model

    known, model = np.load(stamps), load_model(bundle)
    star = known["idx"]
    found = {name: np.load(Path(file)) for name, file in (o.split("=", 1) for o in others)}
    rows = []
    for snr in known["SNR"].tolist():
        ours = model.predict(known[f"noisy{snr}"], position=known["pos"][star].astype(float))
        psfs = {"psfdae": (ours.psf, ours.flux)}
        psfs |= {name: (file[f"est{snr}"], file[f"flux{snr}"]) for name, file in found.items()}
        errors = {name: of_stars(psf, known["truth"], star) for name, (psf, _) in psfs.items()}
        best = min(found, key=lambda name: errors[name].mean())
        for name, error in errors.items():
            flux = psfs[name][1] / known["flux"] - 1.0
            ratio = error.mean() / errors[best].mean()
            paired = (error - ratio * errors[best]) / errors[best].mean()
            row = {"snr": snr, "package": name, "stars": len(error), "copies": len(star)}
            row |= {"mse": error.mean(), "stderr": standard_error(error)}
            row |= {"best": best, "ratio": ratio, "ratio_stderr": standard_error(paired)}
            row |= {"flux_bias": np.nanmean(flux), "flux_scatter": np.nanstd(flux)}
            row |= {"bias_stderr": standard_error(mean_of_copies(flux, star))}
            row |= {"lost": int(np.isnan(flux).sum()), "own_mse": np.square(known["own"]).mean()}
            row |= {"date": date.today().isoformat(), "commit": git_commit()}
            rows.append(row)
    write(out, rows)


def of_stars(psf, truth, star):
    """Mean squared error of every star (stars,); one of a copy without a PSF is that of 0."""
    psf = np.asarray(psf, float)
    psf = np.nan_to_num(psf / psf.sum(axis=(1, 2), keepdims=True))
    return mean_of_copies(np.square(psf - truth).mean(axis=(1, 2)), star)


def mean_of_copies(values, star):
    """Of every star; copies without a value are left out."""
    kept = np.isfinite(values)
    return np.bincount(star[kept], values[kept]) / np.bincount(star[kept])


def standard_error(values):
    """Of a mean."""
    return values.std(ddof=1) / np.sqrt(len(values))


if __name__ == "__main__":
    program(faint, compare)
