"""How well a star's PSF can be known at all, on the images whose stars scatter at random.

usage: bound.py KIND FAINT.npz

KIND is shapes or aberrations of images.py, FAINT what faint.py made of it. Both law of the scatter
and the field's PSF are known exactly, and the PSF is linear in scatter and centre; flux and sky are
unknown, and the centre is somewhere in the frame. Printed are the least mean squared error and
that of the field's PSF with its centre fitted, by S/N. At S/N 5 it is not linear enough.
"""

import sys

import galsim
import numpy as np
from faint import FLUX, MOVE, SNR
from images import FWHM, LATTICE, PITCH, SCALE, moffat, optics

EVERY, STEP, PART = 5, 0.05, 0.7  # of the stars; px and RMS of the derivatives
LAWS = {"shapes": (lambda u, v, s: moffat(u, v, FWHM, s), 3), "aberrations": (optics, 8)}


def stamp(star, off, side):
    """Image of a profile of the sum 1, its centre `off` px from the pixel [s/2, s/2]."""
    frame = galsim.Image(side, side, scale=SCALE)
    image = star.drawImage(frame, offset=galsim.PositionD(*(off + 0.5))).array.ravel()
    return image / image.sum(dtype=float)


def errors(law, count, at, off, sigma, side):
    """Least error and that of the field's PSF, for noise `sigma` of a star of flux 1."""

    def image(scatter, move=(0.0, 0.0)):
        return stamp(law(*(2 * at / (LATTICE * PITCH) - 1), scatter), off + move, side)

    still, axes, moves = np.zeros(count), PART * np.eye(count), STEP * np.eye(2)
    moving = [(image(still, e) - image(still, -e)) / (2 * STEP) for e in moves]
    shapes = np.array([(image(e) - image(-e)) / (2 * PART) for e in axes])
    base = np.stack([image(still), np.ones(side**2), *moving], axis=1)
    place = [0.0, 0.0, *[3.0 / (MOVE + 0.5) ** 2] * 2]  # 1/variance of a centre in the frame
    for s in sigma:
        design = np.column_stack([base, shapes.T])
        prior = np.diag([*place, *np.ones(count)])
        spread = np.linalg.inv(design.T @ design / s**2 + prior)[2:, 2:]
        fit = np.linalg.solve(base.T @ base / s**2 + np.diag(place), base.T / s**2)[2:]
        offsets = np.column_stack([base[:, 2:] / np.sqrt(place[2:]), shapes.T])
        missed = base[:, 2:] @ (fit @ offsets) - offsets
        of_field = s**2 * np.square(base[:, 2:] @ fit).sum() + np.square(missed).sum()
        yield np.trace(design[:, 2:] @ spread @ design[:, 2:].T) / side**2, of_field / side**2


def main(kind, faint):
    faint_stars = np.load(faint)
    law, side, rng = LAWS[kind], faint_stars["truth"].shape[-1], np.random.default_rng(1)
    sigma = [float(faint_stars[f"sigma{snr}"]) / FLUX for snr in SNR]
    places = faint_stars["at"][::EVERY]
    all_errors = [[*errors(*law, at, rng.uniform(-0.5, 0.5, 2), sigma, side)] for at in places]
    for snr, (bound, field) in zip(SNR, np.mean(all_errors, axis=0), strict=True):
        print(f"{kind} S/N {snr}: least {bound:.2e}, field {field:.2e}, {bound / field:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
