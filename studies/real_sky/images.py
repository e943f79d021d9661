"""Images simulated with GalSim whose PSFs are known, for the same comparison as the real one.

usage: images.py KIND IMAGE.fits

leaves the image, its list IMAGE.csv (id, x, y of bright stars, 0-based) and the truth IMAGE.npz:
`psf` (stars, s, s), noise-free images of the flux 1 with their pixel, by id, and `pixel`
(stars, 2), which pixel (x, y) of the image their [s/2, s/2] is. KIND:

    moffat        ellipticity and width change over the field
    optics        Kolmogorov seeing and aberrations that change over the field
    undersampled  as moffat, with a FWHM of 1.3 px
    crowded       as moffat, with 30 stars in 100 × 100 px, of which the bright ones are listed
    shapes        as moffat; ellipticity and width scatter from star to star, too
    aberrations   as optics; the aberrations scatter from star to star, too

All but `crowded` have bright stars alone, on a lattice whose places are displaced at random.
"""

import sys
from pathlib import Path

import galsim
import numpy as np
from astropy.io import fits
from astropy.table import Table
from scipy.spatial import cKDTree

SIDE = 48  # px of a star's image
SKY = 1000.0  # electrons per pixel; the gain is 1
SNR = (100.0, 1000.0)  # of listed stars, by a matched filter
LATTICE, PITCH, ASIDE = 18, 48, 6.0  # stars a side, px between them, px from the lattice
CROWD, LEAST_SNR, SLOPE = (1000, 3000), 7.0, 0.6  # side in px, stars; N(> S/N) ~ S/N^-SLOPE
SHAPE, WIDTH = 0.05, 0.08  # of the scatter: RMS of both shears, and of the FWHM over itself
WAVES = 0.06  # RMS of each aberration, waves; of those of third order half of it
BETA, FWHM, UNDERSAMPLED = 3.0, 2.4, 1.3  # of Moffat profiles before the pixel, px
SEEING, SCALE = 1.1, 0.6  # FWHM of Kolmogorov's profile in arcsec; arcsec per px
BLEND_PX = 3.0  # px: nearer stars are one in the list
WINDOW_PX, WINDOW, ROUNDS = 7, 1.2, 20  # px about a star, σ in px, of the centroids that are listed


def moffat(u, v, fwhm, scatter):
    """Moffat profile at (u, v), from -1 to 1 over the field; `scatter` (3,) in RMS."""
    g1 = 0.02 + 0.05 * u + 0.04 * (u**2 - v**2) + SHAPE * scatter[0]
    g2 = -0.02 + 0.04 * v + 0.08 * u * v + SHAPE * scatter[1]
    relative_fwhm = (1 + 0.03 * u + 0.06 * (u**2 + v**2)) * np.exp(WIDTH * scatter[2])
    return galsim.Moffat(beta=BETA, fwhm=fwhm * relative_fwhm * SCALE).shear(g1=g1, g2=g2)


def optics(u, v, scatter):
    """Seeing, and a telescope of half a metre; Noll's aberrations 4 to 11; `scatter` (8,)."""
    square, waves = u**2 + v**2, np.zeros(12)
    defocus, astigmatism = 0.05 + 0.1 * square, (0.2 * u * v, 0.03 + 0.1 * (u**2 - v**2))
    waves[4:9] = (defocus, *astigmatism, 0.1 * v, 0.1 * u)
    waves[11] = 0.04
    waves[4:9] += WAVES * scatter[:5]
    waves[9:] += WAVES / 2 * scatter[5:]
    telescope = galsim.OpticalPSF(lam=600, diam=0.5, obscuration=0.35, aberrations=waves)
    return galsim.Convolve(galsim.Kolmogorov(fwhm=SEEING), telescope)


def profile(kind, u, v, rng):
    """Return the profile of one star, at (u, v) from -1 to 1 over the field."""
    scatter = rng.standard_normal(8) * (kind in ("shapes", "aberrations"))
    if kind in ("optics", "aberrations"):
        return optics(u, v, scatter)
    return moffat(u, v, UNDERSAMPLED if kind == "undersampled" else FWHM, scatter)


def places(kind, rng):
    """Side of the image in px, positions (n, 2) as x, y, and S/N of its stars."""
    if kind == "crowded":
        side, count = CROWD
        bounds = np.array([SNR[1], LEAST_SNR]) ** -SLOPE
        return side, rng.uniform(0, side, (count, 2)), rng.uniform(*bounds, count) ** (-1 / SLOPE)
    lattice = (np.stack(np.divmod(np.arange(LATTICE**2), LATTICE), axis=1) + 0.5) * PITCH
    position = lattice + rng.uniform(-ASIDE, ASIDE, lattice.shape)
    return LATTICE * PITCH, position, np.exp(rng.uniform(*np.log(SNR), len(position)))


def drawn_image(star, off):
    """Image of a profile, its centre `off` px from the pixel [s/2, s/2]."""
    frame = galsim.Image(SIDE, SIDE, scale=SCALE)
    return star.drawImage(frame, offset=galsim.PositionD(*(off + 0.5))).array


def centroid(counts, pixel):
    """(x, y) of a star near a pixel: centroids in a Gaussian window, as a star list has them."""
    x, y = pixel
    light = counts[y - WINDOW_PX : y + WINDOW_PX + 1, x - WINDOW_PX : x + WINDOW_PX + 1] - SKY
    axis, off = np.arange(-WINDOW_PX, WINDOW_PX + 1), np.zeros(2)
    for _ in range(ROUNDS):
        rows, columns = (np.exp(-(((axis - at) / WINDOW) ** 2) / 2) for at in off[::-1])
        weight = light * rows[:, None] * columns
        shift = np.array([(weight * axis).sum(), (weight * axis[:, None]).sum()]) / weight.sum()
        off = np.clip(2 * shift - off, -2, 2)  # a window hides about half of the way
    return pixel + off


def main(kind, image):
    rng = np.random.default_rng(list(kind.encode()))
    side, position, snr = places(kind, rng)
    pixel = np.rint(position).astype(int)
    psf = [
        drawn_image(profile(kind, *(2 * at / side - 1), rng), at - middle)
        for at, middle in zip(position, pixel, strict=True)
    ]
    psf = np.array(psf, np.float32)
    flux = snr * np.sqrt(SKY / np.square(psf).sum(axis=(1, 2)))
    light = np.full((side + 2 * SIDE,) * 2, SKY)
    for (x, y), star in zip(pixel + SIDE // 2, flux[:, None, None] * psf, strict=True):
        light[y : y + SIDE, x : x + SIDE] += star
    counts = rng.poisson(light[SIDE:-SIDE, SIDE:-SIDE]).astype(np.float32)
    inside = ((pixel >= WINDOW_PX) & (pixel < side - WINDOW_PX)).all(axis=1)
    # Of two stars that look like one, a list has the brighter.
    blends = cKDTree(position).query_pairs(BLEND_PX, output_type="ndarray").T
    hidden = np.where(snr[blends[0]] < snr[blends[1]], *blends)
    inside[hidden] = False
    listed = np.flatnonzero(inside & (snr >= SNR[0]))
    at = np.array([centroid(counts, pixel[star]) for star in listed])
    out = Path(image)
    header = fits.Header({"GAIN": 1.0, "SATURATE": 6e4, "PIXSCALE": SCALE})
    fits.PrimaryHDU(counts, header).writeto(out, overwrite=True)
    columns = {"id": np.arange(len(listed)), "x": at[:, 0], "y": at[:, 1]}
    Table(columns).write(out.with_suffix(".csv"), overwrite=True)
    np.savez(out.with_suffix(".npz"), psf=psf[listed], pixel=pixel[listed])
    print(f"{kind}: {len(psf)} stars, {len(listed)} listed")


if __name__ == "__main__":
    main(*sys.argv[1:])
