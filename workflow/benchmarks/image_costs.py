"""CPU time and memory of a model of an image, and of its photometry, beside other programs.

Every tool gets the same images, one core, and only the pixels: it finds the stars itself. Images
are simulated fields of three sizes, and further ones of the user. psfdae runs at this commit and at
an earlier one, with the same packages. PSFEx runs after SExtractor, whose photometry takes the PSF
of PSFEx; EPSFBuilder and Piff get sources by photutils and make models alone. A tool that is not
installed is left out; Piff may be in a folder that PYTHONPATH names.

Then psfdae at this commit runs alone on fields of more and more stars, and of more and more pixels.
"""

import gzip
import os
import shutil
import subprocess
import sys
import tarfile
from dataclasses import replace
from datetime import date
from importlib.util import find_spec
from io import BytesIO
from itertools import chain
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory

import click

from figures import image_growth
from psfdae.base.figures import apply_style, write_png
from psfdae.base.files import write_csv
from psfdae_paper.source import git_commit

ROOT = Path(__file__).resolve().parents[2]
FIELDS = "512:200 900:700 2048:2000"
GROWTH = "512:300 1024:300 2048:300 4096:300 8192:300 " + " ".join(
    f"4096:{stars}" for stars in (100, 1000, 3000, 10_000, 30_000)
)
"""Side in px and number of stars of each simulated image, for all tools and for psfdae alone."""

BEFORE = "e20301a"  # before spikes, halos and shared noise were measured
THREADS = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR")}
MEASURE = """
import os, resource, sys
_, status = os.waitpid(os.posix_spawnp(sys.argv[2], sys.argv[2:], os.environ), 0)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
peak_b = used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
with open(sys.argv[1], "w") as file:
    print(used.ru_utime + used.ru_stime, peak_b, file=file)
sys.exit(status != 0)
"""
"""Program that runs a command, and writes what it and its descendants used to a file.

These are CPU seconds of all together and bytes of the largest one. The system's peak of a process
is not below the memory of the process that started it, which is therefore this small program.
"""

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


def parse_sizes(context, option, text):
    """Return (side, stars) of each word of a text such as "512:200 900:700"."""
    try:
        sizes = [tuple(map(int, word.split(":"))) for word in text.split()]
        if all(side >= 64 and stars >= 1 for side, stars in sizes):
            return sizes
    except ValueError:
        pass
    raise click.BadParameter(f"{text!r}: expected words SIDE:STARS, with sides of 64 px or more")


SIZES = {"metavar": "SIZES", "callback": parse_sizes, "show_default": True}


@click.command()
@click.argument("image", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option("--against", default="", help=f"Commit that is compared with.  [default: {BEFORE}]")
@click.option("--fields", default=FIELDS, **SIZES, help="SIDE:STARS of simulated images.")
@click.option("--growth", default=GROWTH, **SIZES, help="The same, for psfdae alone.")
@click.option("--results", required=True, type=click.Path(path_type=Path), help="Folder.")
def compare_tools(image, against, fields, growth, results):
    """Time models and photometry of simulated images and of each IMAGE, on a quiet machine.

    The folder RESULTS gets tables/benchmark_images.csv, with a row for each image, tool and step,
    without costs where the tool failed, and figures/benchmark/images.png, of the growth. Each row
    has the date and the commit. Stars are those that were simulated. The ratio of the CPU time to
    the earlier commit's is printed.
    """
    import pandas as pd
    from astropy.io import fits

    rows, failures, commit = [], 0, against or BEFORE
    run = {"date": date.today().isoformat(), "commit": git_commit()}
    # Images for all tools, then those for psfdae at this commit.
    images = [*dict.fromkeys([*fields, *image])]
    own_images = [*dict.fromkeys(size for size in growth if size not in fields)]
    if not images + own_images:
        raise click.UsageError("no image: name one, or sizes with --fields or --growth")
    with TemporaryDirectory() as name:
        trees = {"psfdae": ROOT, f"psfdae {commit}": extract_commit(commit, Path(name, "earlier"))}
        named_images = zip(images + own_images, name_images(images + own_images), strict=True)
        for number, (source, image_name) in enumerate(named_images):
            # Images of different folders may have the same name.
            folder = Path(name, f"image{number}")
            folder.mkdir()
            path = write_image(source, folder)
            about = {"image": image_name, "pixels": prod(fits.getdata(path).shape)}
            about["stars"] = None if isinstance(source, Path) else source[1]
            if number < len(images):
                runs = chain(list_own_runs(path, trees, folder), list_peer_runs(path, folder))
            else:
                runs = list_own_runs(path, {"psfdae": ROOT}, folder)
            for tool, step, words, environment in runs:
                row = about | {"tool": tool, "step": step, "cpu_s": None, "peak_mb": None} | run
                try:
                    row |= measure_process(words, folder, environment)
                except click.ClickException as error:
                    failures += 1
                    click.echo(f"{image_name}, {tool}, {step} failed: {error.message}", err=True)
                rows.append(row)
                print(*row.values(), flush=True)
                # Written after each run, so that an interruption loses none.
                table = pd.DataFrame(rows)
                write_csv(results / "tables/benchmark_images.csv", table)
            shutil.rmtree(folder)
    wide = table.pivot_table("cpu_s", ["image", "step"], "tool", sort=False).reindex(columns=trees)
    ratios = (wide.psfdae / wide.iloc[:, 1]).dropna().round(2)
    print("CPU time over the earlier commit's:", ratios.to_string(), sep="\n")
    # Simulated images without a failure.
    drawn = table[table["tool"] == "psfdae"].dropna()
    if len(drawn):
        write_png(apply_style(image_growth)(drawn), results / "figures/benchmark/images.png")
    if failures:
        raise click.ClickException(f"{failures} of {len(rows)} commands failed, see above")


def name_images(sources):
    """Return a name for each image: its file's, with folder and ending where two would be equal."""
    names = [get_stem(source) for source in sources]
    paths = {source: source.resolve() for source in sources if isinstance(source, Path)}
    root = os.path.commonpath([path.parent for path in paths.values()]) if paths else None
    return [
        str(paths[source].relative_to(root)) if source in paths and names.count(name) > 1 else name
        for source, name in zip(sources, names, strict=True)
    ]


def get_stem(source):
    """Return the name of an image without its ending; it may have dots."""
    if isinstance(source, Path):
        return source.name.split(".fit")[0]
    side, stars = source
    return f"s{side}_{stars}"


def write_image(source, folder):
    """Write a simulated field of (side, stars), or a copy of an image; return its path."""
    path = folder / f"{get_stem(source)}.fits"
    if isinstance(source, Path):
        # SExtractor reads no compressed image.
        content = source.read_bytes()
        path.write_bytes(gzip.decompress(content) if source.suffix == ".gz" else content)
        return path
    from psfdae_paper.stars.example import example_field, write_cube
    from psfdae_paper.stars.nights import NightRecipe

    # A quarter of the stars is bright enough for a model.
    side, stars = source
    sizes = {"bright": stars // 4, "side_px": side}
    recipe = replace(NightRecipe().field, faint=stars - stars // 4, saturated=0, **sizes)
    image = example_field(recipe, 1).image
    write_cube(path, image, GAIN=recipe.gain, SATURATE=float(recipe.saturation))
    return path


def extract_commit(commit: str, folder: Path) -> Path:
    """Write the files of a commit to a folder, and return it."""
    words = ["git", "-C", str(ROOT), "archive", commit, "src"]
    archive = subprocess.run(words, check=True, capture_output=True).stdout
    with tarfile.open(fileobj=BytesIO(archive)) as files:
        files.extractall(folder, filter="data")
    return folder


def list_own_runs(image, trees, folder):
    """Yield tool, step, words and environment of the commands of psfdae at each commit."""
    for number, (tool, tree) in enumerate(trees.items()):
        environment = {"PYTHONPATH": str(tree / "src")}
        is_renamed = (tree / "src/psfdae/commands/train.py").exists()
        start = [sys.executable, "-m", "psfdae"]
        train = [*start, "train" if is_renamed else "from-stars", image, "--method", "field"]
        model = folder / f"model{number}"
        yield tool, "train", [*train, "--detect", "--name", "image", "--out", model], environment
        words = [*start, "photometry", image, "--detect"]
        words += ["--model", model / "image.psf.safetensors", "--out", folder / f"{number}.csv"]
        yield tool, "photometry", words, environment


def list_peer_runs(image, folder):
    """Yield tool, step, words and environment of the commands of the other programs."""
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
    """Return CPU seconds and peak memory in MB of a command and the processes that it starts.

    A failure ends with its message. Of several processes, the largest memory counts.
    """
    used, log = folder / "used", folder / "log"
    with log.open("w") as output:
        run = subprocess.run(
            [sys.executable, "-I", "-S", "-c", MEASURE, used, *map(str, words)],
            cwd=folder, env={**os.environ, **THREADS, **environment}, check=False,
            stdout=output, stderr=subprocess.STDOUT,
        )  # fmt: skip
    if run.returncode:
        raise click.ClickException(f"{' '.join(map(str, words))}: {log.read_text()[-2000:]}")
    cpu_s, peak_b = map(float, used.read_text().split())
    return {"cpu_s": round(cpu_s, 2), "peak_mb": round(peak_b / 1e6)}


if __name__ == "__main__":
    compare_tools()
