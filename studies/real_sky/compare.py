"""Errors of all packages on the faint copies of one split.

usage: compare.py SPLIT FAINT.npz BUNDLE OUT.csv NAME=PEER.npz …

OUT has a row for every star, S/N, package and kind of centre: the mean squared error of its PSF of
sum 1, averaged over the copies, whose truth's own noise (`own_mse`) is in every error.
"""

import sys

import numpy as np
import pandas as pd
from faint import SNR

from psfdae import load_model


def main(split, faint, bundle, out, *peers):
    known, rows = np.load(faint), []
    star, model = known["star"], load_model(bundle)
    for snr in SNR:
        place = known["at"][star].astype(float)
        ours = model.predict(known[f"noisy{snr}"], position=place).psf
        psfs = {("psfdae", "averaged"): ours / ours.sum(axis=(1, 2), keepdims=True)}
        for name, file in (peer.split("=", 1) for peer in peers):
            found = np.load(file)
            psfs |= {(name, kind): found[f"{kind}{snr}"] for kind in ("fitted", "averaged")}
        for (name, kind), psf in psfs.items():
            # A copy without a PSF counts as an image of 0.
            error = np.square(np.nan_to_num(psf) - known["truth"]).mean(axis=(1, 2))
            for number, which in enumerate(known["id"]):
                row = {"split": split, "id": which, "snr": snr, "package": name, "centre": kind}
                own = np.square(known["own"][star == number]).mean()
                rows.append(row | {"mse": error[star == number].mean(), "own_mse": own})
    pd.DataFrame(rows).to_csv(out, index=False, float_format="%.6g")


if __name__ == "__main__":
    main(*sys.argv[1:])
