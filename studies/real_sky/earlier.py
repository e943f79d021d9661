"""PSFs of faint copies by psfdae at an earlier commit, whose `src` is in PYTHONPATH.

usage: earlier.py FAINT.npz BUNDLE OUT.npz

BUNDLE is a model of the same training stars by that commit. OUT, called COMMIT-0-0-SPLIT.npz, has
PSFs and fluxes as those of peers.py: compare.py gives the errors of psfdae over its errors.
"""

import sys

import numpy as np
from faint import SNR

from psfdae import __version__, load_model


def main(faint_stars, bundle, out):
    copies, model = np.load(faint_stars), load_model(bundle)
    place = copies["at"][copies["star"]].astype(float)
    results = {"version": __version__, "fit_cpu_s": np.nan}
    for snr in SNR:
        predictions = model.predict(copies[f"noisy{snr}"], position=place)
        psf = predictions.psf
        results[f"averaged{snr}"] = psf / psf.sum(axis=(1, 2), keepdims=True)
        results[f"flux{snr}"] = predictions.flux
    np.savez_compressed(out, **results)


if __name__ == "__main__":
    main(*sys.argv[1:])
