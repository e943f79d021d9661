"""CPU time and memory of a model of an image, and of its photometry, beside other programs.

Every tool gets the same images, one core, and only the pixels: it finds the stars itself. Images
are simulated fields of three sizes, and further ones of the user. psfdae runs at this commit and at
an earlier one, with the same packages. PSFEx runs after SExtractor, whose photometry takes the PSF
of PSFEx; EPSFBuilder and Piff get sources by photutils and make models alone. A tool that is not
installed is left out.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import time
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import click

from psfdae.base.files import write_text

ROOT = Path(__file__).resolve().parents[2]
FIELDS = {"s512": (512, 120, 80), "s900": (900, 200, 500), "s2048": (2048, 500, 1500)}
"""Side in px, and numbers of bright and of faint stars, of each simulated image."""

BEFORE = "e20301a"  # before spikes, halos and shared noise were measured
THREADS = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR")}
EVERY_S = 0.02  # between looks at the memory of a process
SIMULATE = """
import sys
from dataclasses import replace
from astropy.io import fits
from psfdae_paper.stars.nights import NightRecipe, simulate_night, simulate_reference_stars
out, side, bright, faint = sys.argv[1], *map(int, sys.argv[2:])
recipe = NightRecipe()
recipe = replace(recipe, field=replace(recipe.field, side_px=side, bright=bright, faint=faint))
counts, cards, _ = next(simulate_night(recipe, simulate_reference_stars(recipe, 1), 1))
fits.PrimaryHDU(counts, fits.Header(list(cards.items()))).writeto(out)
"""
"""Program that writes the first exposure of a simulated night."""

SOURCES = """
import sys
import numpy as np
from astropy.io import fits
from photutils.background import Background2D
from photutils.detection import DAOStarFinder
image = fits.getdata(sys.argv[1]).astype(float)
sky = Background2D(image, 64)
data, sigma = image - sky.background, sky.background_rms_median
found = DAOStarFinder(5 * sigma, 3.0)(data)
x, y = (np.array(found[n if n in found.colnames else n.replace("_", "")])
        for n in ("x_centroid", "y_centroid"))
half = 12
inside = (np.minimum(x, y) > half) & (x < data.shape[1] - half - 1) & (y < data.shape[0] - half - 1)
# Of sources whose nearest neighbour is over 12 px away, the 200 brightest.
distance = np.hypot(x[:, None] - x, y[:, None] - y) + 1e9 * np.eye(len(x))
rows = np.flatnonzero(inside & (distance.min(axis=1) > half))
rows = rows[np.argsort(-np.array(found["flux"])[rows])][:200]
x, y, row, column = x[rows], y[rows], np.rint(y[rows]).astype(int), np.rint(x[rows]).astype(int)
axis = np.arange(-half, half + 1)
stamps = data[row[:, None, None] + axis[:, None], column[:, None, None] + axis]
"""
"""Sources and stamps (n, 25, 25) for the packages that find no stars themselves."""

PEERS = {
    "epsfbuilder": """
from photutils.psf import EPSFBuilder, EPSFStar, EPSFStars
stars = [EPSFStar(s, cutout_center=(a - b + half, c - d + half), id_label=k + 1)
         for k, (s, a, b, c, d) in enumerate(zip(stamps, x, column, y, row))]
EPSFBuilder(oversampling=2, progress_bar=False)(EPSFStars(stars))
""",
    "piff": """
import galsim, piff
stars = []
for s, a, b, c, d in zip(stamps, x, column, y, row):
    frame = galsim.Image(s, xmin=int(b) - half + 1, ymin=int(d) - half + 1, scale=1.0)
    weight = 1.0 / (sigma**2 + s.clip(0) + (0.01 * s) ** 2)
    weight = galsim.Image(weight, xmin=frame.xmin, ymin=frame.ymin, scale=1.0)
    place = galsim.PositionD(float(a) + 1, float(c) + 1)
    stars.append(piff.Star(piff.StarData(frame, place, weight=weight), None))
outliers = [piff.ChisqOutliers(nsigma=6, max_remove=0.02)]
psf = piff.SimplePSF(piff.PixelGrid(1.0, 17), piff.BasisPolynomial(2), outliers=outliers)
psf.fit(stars, {0: galsim.PixelScale(1.0)}, None)
""",
}
"""Models by other Python packages, of `SOURCES`."""

SEXTRACTOR = "-c /dev/null -FILTER N -DETECT_THRESH 5 -ANALYSIS_THRESH 5 -CATALOG_TYPE FITS_LDAC"
COLUMNS = "NUMBER X_IMAGE Y_IMAGE FLUX_RADIUS FLUX_APER(1) FLUXERR_APER(1) ELONGATION FLAGS SNR_WIN"


@click.command()
@click.argument("image", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option("--against", default="", help=f"Commit that is compared with.  [default: {BEFORE}]")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="CSV of the costs.")
def compare_tools(image: tuple[Path, ...], against: str, out: Path) -> None:
    """Time models and photometry of simulated images and of each IMAGE, on a quiet machine.

    The table has a row for each image, tool and step.
    """
    rows = []
    with TemporaryDirectory() as name:
        folder = Path(name)
        commit = against or BEFORE
        trees = {"psfdae": ROOT, f"psfdae {commit}": extract_commit(commit, folder / "earlier")}
        for label, size in FIELDS.items():
            words = [sys.executable, "-c", SIMULATE, folder / f"{label}.fits", *size]
            subprocess.run([*map(str, words)], check=True)
        paths = (*(folder / f"{label}.fits" for label in FIELDS), *image)
        for number, path in enumerate(paths):
            # Images of different folders may have the same name.
            place = folder / f"image{number}"
            place.mkdir()
            for tool, step, words, environment in list_runs(path.resolve(), trees, place):
                row = {"image": path.stem, "tool": tool, "step": step}
                rows.append(row | measure_process(words, place, environment))
                print(*rows[-1].values(), flush=True)
                # Written after each run, so that an interruption loses none.
                lines = [",".join(map(str, line.values())) for line in rows]
                write_text(out, "\n".join([",".join(rows[0]), *lines]) + "\n")


def extract_commit(commit: str, folder: Path) -> Path:
    """Write the files of a commit to a folder, and return it."""
    words = ["git", "-C", str(ROOT), "archive", commit, "src"]
    archive = subprocess.run(words, check=True, capture_output=True).stdout
    with tarfile.open(fileobj=BytesIO(archive)) as files:
        files.extractall(folder, filter="data")
    return folder


def list_runs(image, trees, folder):
    """Yield tool, step, words of the command, and its environment; each step follows the last."""
    for number, (tool, tree) in enumerate(trees.items()):
        environment = {"PYTHONPATH": str(tree / "src")}
        is_renamed = (tree / "src/psfdae/commands/train.py").exists()
        train = "train" if is_renamed else "from-stars"
        start = [sys.executable, "-m", "psfdae"]
        model = folder / f"{image.stem}-{number}"
        words = [*start, train, image, "--detect", "--method", "field", "--out", model]
        yield tool, "train", words, environment
        bundle = model / f"{image.stem}.psf.safetensors"
        words = [*start, "photometry", image, "--detect", "--model", bundle]
        yield tool, "photometry", [*words, "--out", folder / f"{model.name}.csv"], environment
    for name, text in PEERS.items():
        if name != "piff" or find_spec("piff"):
            yield name, "train", [sys.executable, "-c", SOURCES + text, image], {}
    sextractor = shutil.which("source-extractor") or shutil.which("sex")
    if sextractor and shutil.which("psfex"):
        (folder / "train.param").write_text(f"{COLUMNS} VIGNET(27,27)".replace(" ", "\n"))
        (folder / "psf.param").write_text("NUMBER\nX_IMAGE\nY_IMAGE\nFLUX_PSF\nFLUXERR_PSF\n")
        find = f"{sextractor} {image} {SEXTRACTOR} -CATALOG_NAME stars.cat"
        find = f"{find} -PARAMETERS_NAME train.param"
        fit = "psfex stars.cat -c /dev/null -PSFVAR_DEGREES 2 -CHECKPLOT_TYPE NONE"
        fit = f"{fit} -CHECKIMAGE_TYPE NONE -WRITE_XML N -NTHREADS 1"
        yield "psfex", "train", ["sh", "-c", f"{find} && {fit}"], {}
        measure = f"{sextractor} {image} {SEXTRACTOR} -CATALOG_NAME fluxes.cat"
        measure = f"{measure} -PARAMETERS_NAME psf.param -PSF_NAME stars.psf"
        yield "psfex", "photometry", measure.split(), {}


def measure_process(words, folder, environment):
    """Return CPU seconds and peak memory in MB of a command; a failure ends with its message."""
    log = folder / "log"
    with log.open("w") as output:
        child = subprocess.Popen(
            [*map(str, words)], cwd=folder, env={**os.environ, **THREADS, **environment},
            stdout=output, stderr=subprocess.STDOUT,
        )  # fmt: skip
        # The peak that the system keeps may be that of this process, from which it was forked.
        peak_kb = 0
        while (ended := os.wait4(child.pid, os.WNOHANG))[0] == 0:
            peak_kb = max(peak_kb, read_peak(child.pid))
            time.sleep(EVERY_S)
    child.returncode = os.waitstatus_to_exitcode(ended[1])
    if child.returncode:
        raise click.ClickException(f"{' '.join(map(str, words))}: {log.read_text()[-2000:]}")
    return {"cpu_s": round(ended[2].ru_utime + ended[2].ru_stime, 1), "peak_mb": peak_kb // 1024}


def read_peak(process: int) -> int:
    """Return the largest peak of the memory of a process and its children, in kB."""
    peaks = [0]
    for number in [process, *list_children(process)]:
        try:
            text = Path(f"/proc/{number}/status").read_text()
        except OSError:  # it has ended
            continue
        peaks += [int(line.split()[1]) for line in text.splitlines() if line.startswith("VmHWM:")]
    return max(peaks)


def list_children(process: int) -> list[int]:
    """Return the numbers of the processes that a process started."""
    try:
        words = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return []
    return [int(word) for word in words]


if __name__ == "__main__":
    compare_tools()
