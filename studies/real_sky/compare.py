"""Table of the errors of all packages, over the stars of all splits.

usage: compare.py FOLDER OUT.csv

FOLDER is that of run.sh. OUT has a row for every S/N, package, setting and kind of centre. `mse` is
that of PSFs of sum 1, the mean over stars, each the mean of its copies; the truth's own noise
(`own_mse`) is in it. `ratio` is psfdae's over it, of the same copies. Every `stderr` is that of the
stars. Fluxes, relative to the true one, are those of the fitted centre, of copies that have one.
"""

import sys
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd
from faint import FLUX, SNR
from scipy.stats import sem

from psfdae import __version__, load_model
from psfdae_paper.source import git_commit

SETTING = ["package", "sampling_px", "order", "centre"]
SPLITS = 5


def ours(known, bundle):
    """(setting, S/N, PSFs, fluxes) of psfdae, and what the record says of it."""
    place, model = known["at"][known["star"]].astype(float), load_model(bundle)
    for snr in SNR:
        found = model.predict(known[f"noisy{snr}"], position=place)
        psf = found.psf / found.psf.sum(axis=(1, 2), keepdims=True)
        yield ("psfdae", "", "", "averaged"), snr, psf, found.flux, {"version": __version__}


def theirs(file):
    """The same of a file of peers.py, with the centre fitted and averaged."""
    package, sampling, order, _ = file.stem.split("-")
    found = np.load(file)
    about = {"version": str(found["version"]), "fit_cpu_s": float(found["fit_cpu_s"])}
    for snr in SNR:
        for centre in ("fitted", "averaged"):
            setting = (package, sampling, order if package != "epsf" else "", centre)
            yield setting, snr, found[f"{centre}{snr}"], found[f"flux{snr}"], about


def of_stars(folder, split):
    """A row for every star of a split, setting and S/N."""
    known = np.load(folder / f"faint{split}.npz")
    star = pd.Series(known["id"][known["star"]], name="id")
    own = np.square(known["own"])
    (bundle,) = (folder / f"ours{split}").glob("*.psf.safetensors")
    peers = sorted(folder.glob(f"*-*-*-{split}.npz"))
    for found in (ours(known, bundle), *map(theirs, peers)):
        for setting, snr, psf, flux, about in found:
            # A copy without a PSF counts as an image of 0.
            error = np.square(np.nan_to_num(psf) - known["truth"]).mean(axis=(1, 2))
            off = flux / FLUX - 1.0
            copies = {"copies": 1, "mse": error, "own_mse": own, "off": off, "off2": off**2}
            table = pd.DataFrame(copies).groupby(star).mean().assign(copies=star.value_counts())
            yield table.assign(**dict(zip(SETTING, setting, strict=True)), snr=snr, **about)


def row(cell, reference):
    """A row of the table, of the stars of a setting and those of psfdae."""
    ratio = reference.mse.mean() / cell.mse.mean()
    found = {"version": cell.version.iloc[0], "fit_cpu_s": cell.fit_cpu_s.mean()}
    found |= {"stars": len(cell), "copies": cell.copies.sum()}
    found |= {"mse": cell.mse.mean(), "stderr": sem(cell.mse), "ratio": ratio}
    found["ratio_stderr"] = sem(reference.mse - ratio * cell.mse) / cell.mse.mean()
    bias = cell.off.mean()
    found |= {"flux_bias": bias, "bias_stderr": sem(cell.off)}
    found |= {"flux_scatter": np.sqrt(cell.off2.mean() - bias**2)}
    return found | {"own_mse": cell.own_mse.mean()}


def main(folder, out):
    splits = [pd.concat(of_stars(Path(folder), split)) for split in range(SPLITS)]
    stars = pd.concat(splits).sort_index()
    rows = []
    for (snr, *setting), cell in stars.groupby(["snr", *SETTING]):
        reference = stars.query("snr == @snr and package == 'psfdae'")
        # Every star is held out once.
        if not cell.index.equals(reference.index) or not cell.index.is_unique:
            sys.exit(f"{setting}: {len(cell)} stars, not the {len(reference)} of psfdae")
        rows.append({"snr": snr} | dict(zip(SETTING, setting, strict=True)) | row(cell, reference))
    table = pd.DataFrame(rows).assign(date=date.today().isoformat(), commit=git_commit())
    table.to_csv(out, index=False, float_format="%.6g")


if __name__ == "__main__":
    main(*sys.argv[1:])
