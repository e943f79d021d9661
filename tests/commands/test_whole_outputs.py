"""A full disk, a limit on file sizes, and kills: outputs are whole or absent, and so are sets."""

from __future__ import annotations

import errno
import gzip
import os
import resource
import tempfile
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from astropy.io import fits
from astropy.table import QTable
from click.testing import CliRunner

from command_line import printed, psfdae, refused
from image_training import few_draws
from psfdae import Stars
from psfdae.base import files
from psfdae.commands import photometry, predict, train, wavefront
from psfdae.commands.cli import main
from psfdae.image.errors import ObservationError
from psfdae.image.tables import write_table
from psfdae.methods.networks.weights import save_checkpoint, save_weights
from psfdae_paper.configuration.compose import config_dir
from small_field import field, write
from small_field import table as list_of

# --- One file


@contextmanager
def largest_file(size):
    """A limit of the kernel on the size of files that this process writes, as on a full disk."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


VALUES = np.random.default_rng(0).random((300, 6, 6))
FRAME = pd.DataFrame(VALUES.reshape(300, -1)).rename(columns=str)
STAR_TABLE = QTable({"x": VALUES.ravel()})


def stream(path):
    """A product that is written piece by piece."""
    columns = {"a": files.Empty(VALUES.shape, float, "1", "x")}
    with files.stream_product(path, "stars", columns, {}) as data:
        for start in range(0, 300, 32):
            data["a"][start : start + 32] = VALUES[start : start + 32]


def product(path):
    files.write_product(path, "stars", {"a": files.Column(VALUES, "1", "x")}, {})


WRITERS = {
    "a.h5": product,
    "b.h5": stream,
    "a.csv": partial(files.write_csv, table=FRAME),
    "b.csv": partial(files.write_columns, columns={"x": VALUES.ravel()}),
    "a.parquet": partial(files.write_parquet, table=FRAME),
    "a.fits": partial(files.write_fits, hdus=fits.HDUList([fits.PrimaryHDU(VALUES)])),
    "b.fits": partial(write_table, table=STAR_TABLE),
    "c.csv": partial(write_table, table=STAR_TABLE),
    "c.ecsv": partial(write_table, table=STAR_TABLE),
    "a.safetensors": lambda path: save_weights(path, {"x": torch.tensor(VALUES)}, {}),
    "a.pt": lambda path: save_checkpoint(path, "1", {"x": VALUES.tolist()}),
}


@pytest.mark.parametrize("part", [0.0, 0.001, 0.1, 0.5, 0.99])
@pytest.mark.parametrize("name", WRITERS)
def test_a_file_without_space_is_named_and_leaves_nothing(tmp_path, name, part):
    """The space may end at any size; HDF5 2.0 would end the process."""
    WRITERS[name](tmp_path / name)
    size = (tmp_path / name).stat().st_size
    (tmp_path / name).unlink()
    with largest_file(int(part * size)), pytest.raises(OSError, match="File too large") as error:
        WRITERS[name](tmp_path / name)
    assert error.value.filename == str(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["packed file", "array in memory", "no temporary folder"])
def test_a_full_temporary_folder_is_not_a_damaged_image(tmp_path, monkeypatch, kind):
    image, place = field()
    content = write(tmp_path / "i.fits", image).read_bytes()
    (tmp_path / "i.fits.gz").write_bytes(gzip.compress(content, 1))
    if kind == "no temporary folder":
        text = "No usable temporary directory found in ['/tmp']"

        def absent():
            raise FileNotFoundError(errno.ENOENT, text)

        monkeypatch.setattr(tempfile, "gettempdir", absent)
    given = fits.PrimaryHDU(image) if kind == "array in memory" else tmp_path / "i.fits.gz"
    with largest_file(2**16), pytest.raises(ObservationError, match=r"no temporary copy.*TMPDIR"):
        Stars.from_image(given, list_of(place), origin=0, pixel_scale_arcsec=0.6)


# --- All files of a command


def once(patch, module, *names):
    """Let functions of a module compute their result the first time only."""
    for name in names:
        results, function = {}, getattr(module, name)

        def call(*words, results=results, function=function, **named):
            key = str(named)
            if key not in results:
                results[key] = function(*words, **named)
            return results[key]

        patch.setattr(module, name, call)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """An image, its list and its model; what takes time is computed once."""
    folder = tmp_path_factory.mktemp("inputs")
    image, place = field()
    write(folder / "i.fits", image)
    write(folder / "j.fits", image[::-1].copy())
    list_of(place).write(folder / "i.csv")
    words = ("--catalogue", folder / "i.csv", "--origin", 0, "--method", "field")
    settings = ("framing.stamp_px=12", "field.orders=[0]", "field.modes=8")
    with few_draws(), pytest.MonkeyPatch.context() as patch:
        printed("train", folder / "i.fits", *words, *settings, "--out", folder / "model")
        simulated = ["telescope=example_zernike", "--image-snr", 80, "grid.points=3"]
        printed("simulate", *simulated, "--out", folder / "sky")
        once(patch, photometry, "measure_all_stars")
        once(patch, predict, "open_for_model")
        once(patch, wavefront, "measure_wavefronts")
        once(patch, train, "fit_method", "pack_model", "adapt_to_exposures", "validate")
        patch.setattr(train, "collect_stars", once_of(train.collect_stars))
        yield folder


def once_of(function):
    """The same of a class method."""
    results = {}

    def of(sources, settings):
        key = str([source.path for source in sources])
        if key not in results:
            results[key] = function(sources, settings)
        return results[key]

    return of


def commands(folder):
    """Words of each command that writes several files, and the names of its outputs, last the main.

    They are written below the folder `out`.
    """
    out, image = folder / "out", folder / "i.fits"
    by_list = ("--catalogue", folder / "i.csv", "--origin", 0)
    model = ("--model", folder / "model/i.psf.safetensors")
    telescope = config_dir() / "telescope" / "example_zernike.yaml"
    sensed = ("--catalogue", folder / "sky/stars.csv", "--telescope", telescope)
    trained = ("train", image, "--method", "field", "--report", out / "p.html", *by_list)
    settings = ("framing.stamp_px=12", "field.orders=[0]", "field.modes=8")
    residual = ("--residual", out / "r.fits")
    plot = ("--plot", out / "p.png", "--out", out / "a.fits")
    return {
        "photometry": ("photometry", image, *by_list, *model, *residual, "--out", out / "a.csv"),
        "predict": ("predict", image, "--detect", *model, *plot),
        "wavefront": ("wavefront", folder / "sky/image.fits", *sensed, *plot),
        "train": (*trained, "--out", out / "m", *settings),
        "adapt": ("adapt", folder / "j.fits", "--detect", *model, "--out", out / "j"),
        "psf": ("psf", model[1], "--at", "9,9", "--out", out / "a.fits"),
        "night table": ("paper", "night", "table", folder / "part.csv", "--out", out / "a.csv"),
        "example field": (
            *("example", "field", "--side", 100, "--bright", 1, "--faint", 2, "--seed", 1),
            *("--catalogue", out / "a.csv", "--out", out / "a.fits"),
        ),
    }


NAMES = (
    *("photometry", "predict", "psf", "night table", "example field"),
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("train", "adapt", "wavefront")),
)


def contents(folder):
    """Bytes of the files by their names, without temporary ones."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(p.relative_to(folder)): p.read_bytes() for p in paths if p.suffix != ".tmp"}


def events(patch, number, fault, *also):
    """Call `fault` in place of the write to disk, or of a call of `also`, with this number."""
    count = 0

    def counted(function):
        def call(*words, **named):
            nonlocal count
            count += 1
            return fault() if count == number else function(*words, **named)

        return call

    for place, name in ((os, "fsync"), *also):
        patch.setattr(place, name, counted(getattr(place, name)))
    return lambda: count


def clear(folder):
    """Remove the files of a folder."""
    for path in sorted(folder.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()


@pytest.fixture
def expected(inputs, request):
    """Words of a command, and what it writes undisturbed."""
    pd.DataFrame({"image": ["a.fits"], "name": ["a"], "reason": ["none"]}).to_csv(
        inputs / "part.csv", index=False
    )
    (inputs / "out").mkdir(exist_ok=True)
    clear(inputs / "out")
    words = commands(inputs)[request.param]
    printed(*words)
    whole = contents(inputs / "out")
    assert whole
    return words, whole


@pytest.mark.parametrize("expected", NAMES, indirect=True)
def test_a_command_that_is_killed_can_be_repeated(inputs, expected):
    """Before any output is on the disk, or has its name: the same again gives the same bytes."""
    (words, whole), out = expected, inputs / "out"
    for number in range(1, 200):
        clear(out)
        # A process that ends without any of its clean-up, as by a signal that it cannot catch.
        if (child := os.fork()) == 0:
            with pytest.MonkeyPatch.context() as patch:
                events(patch, number, lambda: os._exit(9), (Path, "replace"))
                CliRunner().invoke(main, list(map(str, words)))
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        left = contents(out)
        # What has its name is whole.
        assert left.items() <= whole.items(), number
        if code == 0:
            break
        printed(*words)
        assert contents(out) == whole, number
    assert code == 0 and number > 2


@pytest.mark.parametrize("expected", NAMES, indirect=True)
def test_a_full_disk_at_any_output_is_one_line(inputs, expected):
    """It names the output, leaves no temporary file, and the same again gives the same bytes."""
    (words, whole), out = expected, inputs / "out"

    def full():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for number in range(1, 200):
        clear(out)
        with pytest.MonkeyPatch.context() as patch:
            count = events(patch, number, full)
            result = psfdae(*words)
        if count() < number:
            break
        assert result.exit_code == 2, number
        line = next(text for text in result.output.splitlines() if text.startswith("psfdae: "))
        assert "No space left" in line and any(name in line for name in whole), line
        assert contents(out).items() <= whole.items() and not [*out.rglob("*.tmp")], number
        printed(*words)
        assert contents(out) == whole
    assert number > 1


@pytest.mark.parametrize("expected", ["photometry", "predict", "psf"], indirect=True)
def test_an_interrupt_at_any_output_leaves_all_earlier_files_or_all_new_ones(inputs, expected):
    """Ctrl-C before a file is on the disk or has its name, of a command that replaces its files."""
    (words, whole), out = expected, inputs / "out"
    earlier = dict.fromkeys(whole, b"earlier")

    def interrupt():
        raise KeyboardInterrupt

    outcomes = set()
    for number in range(1, 200):
        for name, content in earlier.items():
            (out / name).write_bytes(content)
        with pytest.MonkeyPatch.context() as patch:
            count = events(patch, number, interrupt, (Path, "replace"))
            result = psfdae(*words, "--overwrite")
        left = contents(out)
        assert left in (earlier, whole) and not [*out.rglob("*.tmp")], number
        if count() < number:
            break
        assert result.exit_code == 1
        outcomes.add(left == whole)
    assert result.exit_code == 0
    assert outcomes == ({False, True} if len(whole) > 1 else {False})


@pytest.mark.parametrize("step", ["fit_method", "pack_model", "validate"])
def test_a_training_that_is_interrupted_leaves_nothing(inputs, monkeypatch, step):
    """Ctrl-C at any step removes the files that the run has written, and no others."""
    out, older = inputs / "out", inputs / "out" / "m" / "notes.txt"
    (inputs / "out").mkdir(exist_ok=True)
    clear(out)
    older.parent.mkdir()
    older.write_text("kept")

    def interrupt(*_, **__):
        assert len(contents(out)) > 1
        raise KeyboardInterrupt

    monkeypatch.setattr(train, step, interrupt)
    assert psfdae(*commands(inputs)["train"]).exit_code == 1
    assert [path for path in out.rglob("*") if path.is_file()] == [older]


def test_a_model_has_no_picture_of_the_one_that_it_replaces(inputs):
    """Without a report, the picture of an earlier model is removed."""
    out = inputs / "out"
    out.mkdir(exist_ok=True)
    clear(out)
    words = commands(inputs)["train"]
    printed(*words)
    picture = out / "m" / "report.png"
    assert picture.exists()
    without_report = [w for w in words if w not in ("--report", out / "p.html")]
    printed(*without_report, "--overwrite")
    assert (out / "m" / "report.csv").exists() and not picture.exists()


@pytest.mark.parametrize("expected", ["photometry", "predict", "psf"], indirect=True)
def test_a_command_without_space_writes_nothing(inputs, expected):
    """The kernel limits the size, whichever library writes."""
    (words, whole), out = expected, inputs / "out"
    clear(out)
    with largest_file(2900):
        result = psfdae(*words)
    assert result.exit_code == 2 and "File too large" in result.output
    assert any(str(out / name) in result.output for name in whole)
    assert not [path for path in out.rglob("*") if path.is_file()]


@pytest.mark.parametrize("expected", ["photometry"], indirect=True)
def test_outputs_of_another_are_kept(inputs, expected):
    """A file with the name of a second output is the user's if no run was cut off."""
    (words, _), out = expected, inputs / "out"
    (out / "a.csv").unlink()
    assert "r.fits: exists already; --overwrite replaces it" in refused(*words)
