"""Table of the errors of all packages, over the stars of all splits.

usage: compare.py OUT.csv FOLDER...

A FOLDER is that of run.sh for one image, which has its name. OUT has a row for every image, S/N,
package, setting and kind of centre. `mse` is that of PSFs of sum 1, the mean over stars, each the
mean of its copies; the truth's own noise (`own_mse`) is in it. `ratio` is psfdae's over it, of the
same copies, and `median_ratio` that of the median star. Every `stderr` is that of the stars; of the
median, by drawing the stars anew. Fluxes, relative to the true one, are those of the fitted centre,
of copies that have one. What is printed is psfdae over the best setting of all packages.
"""

import sys
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd
from faint import FLUX, SNR
from peers import CENTRES
from scipy.stats import sem

from psfdae import __version__, load_model
from psfdae_paper.source import git_commit

SETTING = ["package", "sampling_px", "order", "centre"]
DRAWS = 1000  # of the stars, for the error of a median


def psfdae_results(faint_stars, bundle):
    """(setting, S/N, PSFs, fluxes) of psfdae, and what the record says of it."""
    place, model = faint_stars["at"][faint_stars["star"]].astype(float), load_model(bundle)
    for snr in SNR:
        predictions = model.predict(faint_stars[f"noisy{snr}"], position=place)
        psf = predictions.psf / predictions.psf.sum(axis=(1, 2), keepdims=True)
        yield ("psfdae", "", "", "averaged"), snr, psf, predictions.flux, {"version": __version__}


def peer_results(file):
    """The same of a file of peers.py, with each kind of centre."""
    package, sampling, order, _ = file.stem.split("-")
    results = np.load(file)
    about = {"version": str(results["version"]), "fit_cpu_s": float(results["fit_cpu_s"])}
    for snr in SNR:
        for centre in (centre for centre in CENTRES if f"{centre}{snr}" in results):
            setting = (package, sampling, order if package != "epsf" else "", centre)
            yield setting, snr, results[f"{centre}{snr}"], results[f"flux{snr}"], about


def of_stars(folder, split):
    """A row for every star of a split, setting and S/N."""
    faint_stars = np.load(folder / f"faint{split}.npz")
    star = pd.Series(faint_stars["id"][faint_stars["star"]], name="id")
    own_noise2 = np.square(faint_stars["own"])
    (bundle,) = (folder / f"ours{split}").glob("*.psf.safetensors")
    peers = sorted(folder.glob(f"*-*-*-{split}.npz"))
    for results in (psfdae_results(faint_stars, bundle), *map(peer_results, peers)):
        for setting, snr, psf, flux, about in results:
            # A copy without a PSF counts as an image of 0.
            error = np.square(np.nan_to_num(psf) - faint_stars["truth"]).mean(axis=(1, 2))
            off = flux / FLUX - 1.0
            copies = {"copies": 1, "mse": error, "own_mse": own_noise2, "off": off, "off2": off**2}
            table = pd.DataFrame(copies).groupby(star).mean().assign(copies=star.value_counts())
            yield table.assign(**dict(zip(SETTING, setting, strict=True)), snr=snr, **about)


def row(cell, reference):
    """A row of the table, of the stars of a setting and those of psfdae."""
    ratio = reference.mse.mean() / cell.mse.mean()
    values = {"version": cell.version.iloc[0], "fit_cpu_s": cell.fit_cpu_s.mean()}
    values |= {"stars": len(cell), "copies": cell.copies.sum()}
    values |= {"mse": cell.mse.mean(), "stderr": sem(cell.mse), "ratio": ratio}
    values["ratio_stderr"] = sem(reference.mse - ratio * cell.mse) / cell.mse.mean()
    bias = cell.off.mean()
    values |= {"flux_bias": bias, "bias_stderr": sem(cell.off)}
    values |= {"flux_scatter": np.sqrt(cell.off2.mean() - bias**2)}
    of_each = (reference.mse / cell.mse).to_numpy()
    resampled = np.random.default_rng(0).choice(of_each, (DRAWS, len(of_each)))
    values |= {"median_ratio": np.median(of_each)}
    values["median_stderr"] = np.median(resampled, axis=1).std()
    return values | {"own_mse": cell.own_mse.mean()}


def of_image(folder):
    """Rows of one image."""
    splits = [file.stem.removeprefix("faint") for file in folder.glob("faint?.npz")]
    stars = pd.concat(rows for split in splits for rows in of_stars(folder, split)).sort_index()
    for (snr, *setting), cell in stars.groupby(["snr", *SETTING]):
        reference = stars.query("snr == @snr and package == 'psfdae'")
        # Every star is held out once.
        if not cell.index.equals(reference.index) or not cell.index.is_unique:
            sys.exit(f"{setting}: {len(cell)} stars, not the {len(reference)} of psfdae")
        about = {"image": folder.name, "snr": snr} | dict(zip(SETTING, setting, strict=True))
        yield about | row(cell, reference)


def main(out, *folders):
    table = pd.DataFrame(row for folder in folders for row in of_image(Path(folder).resolve()))
    table = table.assign(date=date.today().isoformat(), commit=git_commit())
    table.to_csv(out, index=False, float_format="%.6g")
    print(f"| image | S/N | {' | '.join(CENTRES)} | median star: {' | '.join(CENTRES)} |")
    print("|---|---" + 2 * len(CENTRES) * "|---" + "|")
    peers = table[table.package != "psfdae"]
    for (image, snr), cell in peers.groupby(["image", "snr"], sort=False):
        lowest = cell.loc[cell.groupby("centre").mse.idxmin()].set_index("centre").reindex(CENTRES)
        cells = [
            f"{best_cell[name]:.2f} ± {best_cell[error]:.2f}"
            for name, error in (("ratio", "ratio_stderr"), ("median_ratio", "median_stderr"))
            for _, best_cell in lowest.iterrows()
        ]
        print(f"| {image} | {snr} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main(*sys.argv[1:])
