"""PSFs of faint copies by another package, fitted to the training stars of the same list.

usage: peers.py PACKAGE SAMPLING ORDER IMAGE SELECTION FAINT.npz OUT.npz

PACKAGE is piff, psfex or epsf; SAMPLING the samples' distance in pixels (1 or 0.5); ORDER that of
the polynomial over the field (epsf has none). OUT has, of every copy and S/N, the PSF at the fitted
centre (`fitted<S/N>`), its average over the posterior of the centre (`averaged<S/N>`), the same
where it is known how far faint.py moves a frame (`framed<S/N>`), as psfdae knows it from its own
framing, and the fitted flux (`flux<S/N>`); and of the package its `version` and `fit_cpu_s`, what
its fit took. Flux, sky and centre are unknown to it; the noise, which weighs the centres, is given.
"""

import os
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from faint import MOVE, SNR, around, brightest, padded
from scipy.interpolate import make_interp_spline
from scipy.linalg import solve

STEP, REACH = 0.25, 3  # px: of drawn centres, which go that far from the middle
CENTRES = ("fitted", "averaged", "framed")
FRAMED = MOVE + 0.5  # px per axis from the middle, in which all centres are
FIELD = 40  # px beyond the image
GAIN, SATURATE = 2.0, 4000  # electrons a count, and counts, where the header has none


def training(image, selection, half=10):
    """Training stars: (x, y), brightest pixel, stamp without sky, noise."""
    data, stars = padded(image, FIELD), Table.read(selection, format="ascii.csv")
    for s in stars[stars["part"] == "training"]:
        px, py = brightest(data, s["x"], s["y"], FIELD)
        yield (s["x"], s["y"]), (px, py), *around(data, px, py, half, FIELD)


def piff(image, selection, side, sampling, order):
    """Piff's PixelGrid with a polynomial over the field, as wide as the stamps."""
    import galsim
    import piff

    stars, half, gain = [], side // 2 + 2, fits.getheader(image).get("GAIN", GAIN)
    for (x, y), (px, py), stamp, sigma in training(image, selection, half):
        frame = galsim.Image(stamp, xmin=int(px) - half + 1, ymin=int(py) - half + 1, scale=1.0)
        # Its photons, and one per cent of the star that no model fits.
        variance = sigma**2 + stamp.clip(0) / gain + (0.01 * stamp) ** 2
        weight = galsim.Image(1 / variance, xmin=frame.xmin, ymin=frame.ymin, scale=1.0)
        place = galsim.PositionD(float(x) + 1, float(y) + 1)
        stars.append(piff.Star(piff.StarData(frame, place, weight=weight), None))
    # With `centered`, its default, samples of half a pixel do not converge (158 stars become 60,
    # and chi-squared 8 a degree of freedom), and those of a pixel err 3 to 9 % more (one split).
    model = piff.PixelGrid(sampling, round(side / sampling) + 1, centered=False)
    outliers = [piff.ChisqOutliers(nsigma=6, max_remove=0.02)]
    piff.BasisPolynomial._solve_direct_python = normal_equations
    psf = piff.SimplePSF(model, piff.BasisPolynomial(order), outliers=outliers)
    psf.fit(stars, {0: galsim.PixelScale(1.0)}, None)

    def draw(x, y, dx, dy, width):
        frame = galsim.Image(width, width, scale=1.0)
        frame.setOrigin(int(x) + 1 - width // 2, int(y) + 1 - width // 2)
        centre = (x + 1 + dx, y + 1 + dy)
        return psf.draw(x=x + 1, y=y + 1, image=frame, center=centre, chipnum=0, flux=1.0).array

    return draw


def normal_equations(polynomial, stars, logger):
    """Piff's own equations as one product of matrices: its sum over stars takes minutes."""
    basis = np.array([polynomial.basis(star) for star in stars])
    matrix, vector = (np.array([getattr(star.fit, a) for star in stars]) for a in ("alpha", "beta"))
    size, terms = vector.shape[1], basis.shape[1]
    pairs = (basis[:, :, None] * basis[:, None]).reshape(len(stars), -1)
    matrix = (matrix.reshape(len(stars), -1).T @ pairs).reshape(size, size, terms, terms)
    matrix = matrix.transpose(0, 2, 1, 3).reshape(size * terms, -1)
    solution = solve(matrix, (vector.T @ basis).ravel(), assume_a="pos", check_finite=False)
    polynomial.q += solution.reshape(polynomial.q.shape)


def psfex(image, selection, side, sampling, order):
    """PSFEx on source-extractor's catalogue of the image, cut to the training stars."""
    import galsim
    from galsim.des import DES_PSFEx
    from scipy.spatial import cKDTree

    targets = np.array([place for place, *_ in training(image, selection)]) + 1.0
    samples = 25 if sampling == 1 else 51
    columns = "NUMBER X_IMAGE Y_IMAGE FLUX_RADIUS FLUX_APER(1) FLUXERR_APER(1) ELONGATION FLAGS"
    columns = f"{columns} SNR_WIN VIGNET(27,27)".replace(" ", "\n")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "sex.param").write_text(columns)
        words = "-c /dev/null -CATALOG_NAME all.cat -CATALOG_TYPE FITS_LDAC -FILTER N"
        words += " -PARAMETERS_NAME sex.param -DETECT_THRESH 5 -ANALYSIS_THRESH 5"
        words += f" -SATUR_LEVEL {fits.getheader(image).get('SATURATE', SATURATE)}"
        run = ["source-extractor", str(Path(image).resolve()), *words.split()]
        subprocess.run(run, cwd=folder, check=True, capture_output=True)
        with fits.open(f"{folder}/all.cat") as file:
            sources = file[2].data
            tree = cKDTree(np.stack([sources["X_IMAGE"], sources["Y_IMAGE"]], axis=1))
            distance, row = tree.query(targets)
            file[2].data = sources[np.unique(row[distance < 2.0])]
            file[2].data["FLAGS"][:] = 0
            print(f"psfex: {len(file[2].data)} of {len(targets)} training stars")
            file.writeto(f"{folder}/train.cat")
        words = f"train.cat -c /dev/null -PSF_SIZE {samples},{samples} -PSF_SAMPLING {sampling}"
        # All stars of the list.
        words += " -SAMPLE_AUTOSELECT N -SAMPLE_MAXELLIP 1 -SAMPLE_FWHMRANGE 0.1,100"
        words += " -SAMPLE_MINSN 1 -CHECKPLOT_TYPE NONE -CHECKIMAGE_TYPE NONE -WRITE_XML N"
        run = ["psfex", *words.split(), "-PSFVAR_DEGREES", f"{order}"]
        subprocess.run(run, cwd=folder, check=True, capture_output=True)
        model = DES_PSFEx("train.psf", dir=folder)

    def draw(x, y, dx, dy, width):
        frame = galsim.Image(width, width, scale=1.0)
        profile = model.getPSF(galsim.PositionD(x + 1 + dx, y + 1 + dy))
        # The true centre of an even image is half a pixel before its middle pixel.
        offset = (dx + 0.5, dy + 0.5)
        return profile.drawImage(image=frame, method="no_pixel", offset=offset).array

    return draw


def epsf(image, selection, side, sampling, order):
    """photutils' EPSFBuilder, the same PSF all over the field."""
    from photutils.psf import EPSFBuilder, EPSFStar, EPSFStars

    stars = [
        EPSFStar(stamp[3:-2, 3:-2], cutout_center=(x - px + 7, y - py + 7))
        for (x, y), (px, py), stamp, _ in training(image, selection)
    ]
    builder = EPSFBuilder(oversampling=round(1 / sampling), progress_bar=False)
    built = builder(EPSFStars(stars))
    model = getattr(built, "epsf", None) or built[0]

    def draw(x, y, dx, dy, width):
        rows, columns = np.mgrid[:width, :width]
        return model.evaluate(columns, rows, 1.0, width // 2 + dx, width // 2 + dy)

    return draw


class Centres:
    """PSFs of sum 1 of a place at any centre, (dy, dx) from the middle: cubic splines."""

    def __init__(self, draw, x, y, side):
        drawn_px, parts, cache = side + 2 * REACH, round(1 / STEP), {}
        count = 2 * REACH * parts - parts + 1
        self.offsets = (np.arange(count) - count // 2) * STEP
        self.psfs = np.empty((count, count, side, side))
        for i, dy in enumerate(self.offsets):
            for j, dx in enumerate(self.offsets):
                whole_px = np.floor([dy, dx]).astype(int)
                part = (dy - whole_px[0], dx - whole_px[1])
                if part not in cache:
                    cache[part] = np.array(draw(x, y, part[1], part[0], drawn_px), np.float64)
                row, column = REACH - whole_px
                self.psfs[i, j] = cache[part][row : row + side, column : column + side]
        self.psfs /= self.psfs.sum(axis=(2, 3), keepdims=True)
        self.above_sky = self.psfs - self.psfs.mean(axis=(2, 3), keepdims=True)  # of the sky
        self.norm = np.square(self.above_sky).sum(axis=(2, 3))
        self.spline = make_interp_spline(self.offsets, np.eye(count), k=3)

    def between(self, centres, *tables):
        """Values of tables over the offsets at centres (n, 2)."""
        inside = np.clip(centres, self.offsets[0], self.offsets[-1])
        rows, columns = self.spline(inside[:, 0]), self.spline(inside[:, 1])
        return [((rows @ table) * columns).sum(axis=1) for table in tables]

    def mean(self, centres, weight):
        """Weighted mean of the PSFs at centres."""
        rows, columns = self.spline(centres[:, 0]), self.spline(centres[:, 1])
        return np.tensordot((rows * weight[:, None]).T @ columns / weight.sum(), self.psfs, 2)


def lattice(centre, shape, count):
    """Centres (count², 2) about one; `shape` (2, 2) takes ±1 to the edge."""
    line = np.linspace(-1.0, 1.0, count)
    return centre + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) @ shape.T


def restored(centres, stamp, sigma):
    """PSFs of CENTRES, and the flux."""
    product = np.tensordot(centres.above_sky, stamp.astype(np.float64), 2)

    def gain(points):
        """Return the fall of χ² by the star, the norm of the PSF, and the flux; the sky is free."""
        match, norm = centres.between(points, product, centres.norm)
        return np.maximum(match, 0.0) ** 2 / (norm * sigma**2), norm, match / norm

    def best_centre(start, limit_px):
        """Best centre within `most`, searched for from a lattice within `start`."""
        points = lattice(np.zeros(2), np.eye(2) * start, 17)
        centre = points[gain(points)[0].argmax()]
        for step in (0.25, 0.0625, 0.0156, 0.0039):
            trial_centres = np.clip(lattice(centre, np.eye(2) * step, 9), -limit_px, limit_px)
            centre = trial_centres[gain(trial_centres)[0].argmax()]
        return centre

    def averaged(centre, limit_px):
        """Over four standard errors about it, of a parabola: then the posterior itself weighs."""
        around = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]])
        peak, up, down, east, west, corner, opposite = gain(centre + 0.05 * around)[0]
        mixed = (corner + opposite - up - down - east - west + 2 * peak) / 2
        bend = np.array([[2 * peak - up - down, -mixed], [-mixed, 2 * peak - east - west]])
        value, axes = np.linalg.eigh(bend / 0.05**2)  # of χ², twice the inverse variance
        nodes = lattice(centre, axes * np.clip(4.0 / np.sqrt(value.clip(1e-9) / 2), 0.02, 2.0), 17)
        nodes = nodes[np.abs(nodes).max(axis=1) <= limit_px]
        fall, norm, _ = gain(nodes)
        return centres.mean(nodes, np.exp((fall - fall.max()) / 2) / np.sqrt(norm))

    farthest = centres.offsets[-1]
    centre = best_centre(2.0, farthest)
    framed = centre if np.abs(centre).max() <= FRAMED else best_centre(FRAMED, FRAMED)
    psfs = centres.mean(centre[None], np.ones(1)), averaged(centre, farthest)
    return *psfs, averaged(framed, FRAMED), gain(centre[None])[2][0]


def version(package):
    """Release of a package in use."""
    if package == "psfex":
        printed = subprocess.run(["psfex", "--version"], check=True, capture_output=True, text=True)
        return printed.stdout.split()[2]
    return metadata.version({"epsf": "photutils"}.get(package, package))


def main(package, sampling, order, image, selection, faint, out):
    copies = np.load(faint)
    side = copies["truth"].shape[-1]
    make = {"piff": piff, "psfex": psfex, "epsf": epsf}[package]
    draw = make(image, selection, side, float(sampling), int(order))
    results = {"version": version(package), "fit_cpu_s": sum(os.times()[:4])} | {
        f"{name}{snr}": np.empty(copies["truth"].shape[: 1 if name == "flux" else 3])
        for snr in SNR
        for name in (*CENTRES, "flux")
    }
    for star, (x, y) in enumerate(copies["at"]):
        centres = Centres(draw, x, y, side)
        for snr in SNR:
            for copy in np.flatnonzero(copies["star"] == star):
                stamp = copies[f"noisy{snr}"][copy]
                for name, values in zip(
                    (*CENTRES, "flux"),
                    restored(centres, stamp, float(copies[f"sigma{snr}"])),
                    strict=True,
                ):
                    results[f"{name}{snr}"][copy] = values
    np.savez_compressed(f"{out}.part.npz", **results)
    Path(f"{out}.part.npz").replace(out)
    for snr in SNR:
        errors = [np.square(results[f"{n}{snr}"] - copies["truth"]).mean() for n in CENTRES]
        print(package, sampling, order, snr, *(f"{error:.3e}" for error in errors))


if __name__ == "__main__":
    main(*sys.argv[1:])
