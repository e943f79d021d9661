"""Data products, the command line, and what counts as a stage's code."""

from __future__ import annotations

import csv
import errno
import io
import itertools
import json
import os
import pty
import re
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest

from command_line import printed, psfdae, refused, typed
from psfdae.base import progress
from psfdae.base.files import (
    Column,
    OutputError,
    ProductError,
    as_csv,
    atomic_path,
    check_outputs,
    find_left_over,
    read_product,
    write_columns,
    write_csv,
    write_parquet,
    write_product,
    write_text,
)
from psfdae.base.reading import read_table
from psfdae.commands import terminal
from psfdae.commands.cli import as_click, command_modules, stage
from psfdae.commands.terminal import bar, bar_or_lines


def write(path, values=None):
    values = np.arange(6.0).reshape(2, 3) if values is None else values
    columns = {"a": Column(values, "m", "a length"), "b": Column(values, "m", "the same")}
    write_product(path, "lengths", columns, {"seed": 1})


def test_product_describes_itself(tmp_path):
    path = tmp_path / "p.h5"
    write(path)
    product = read_product(path, "lengths")
    assert (product["b"] == np.arange(6.0).reshape(2, 3)).all()
    assert product.config == {"seed": 1}
    with h5py.File(path) as file:
        assert file["a"].attrs["unit"] == "m"
        assert file.attrs["psfdae_version"]
        assert isinstance(file.get("b", getlink=True), h5py.SoftLink)


def test_same_config_gives_the_same_bytes(tmp_path):
    write(tmp_path / "one.h5")
    time.sleep(1.1)
    write(tmp_path / "two.h5")
    assert (tmp_path / "one.h5").read_bytes() == (tmp_path / "two.h5").read_bytes()


@pytest.mark.parametrize(
    ("kind", "names"), [("stars", None), ("lengths", ("c",)), ("lengths", None)]
)
def test_damaged_product_is_named(tmp_path, kind, names):
    """A product of another kind, one without an array, one with a flipped bit."""
    path = tmp_path / "p.h5"
    write(path, np.random.default_rng(0).random((200, 30)))
    if kind == "lengths" and names is None:
        content = bytearray(path.read_bytes())
        content[-3000] ^= 1
        path.write_bytes(content)
    with pytest.raises(ProductError, match=r"p\.h5: "):
        read_product(path, kind, names)


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_writer_leaves_is_removed_by_the_next_one(tmp_path):
    """The old file stays; temporary files of a process that runs, or of other names, do, too."""
    path = tmp_path / "file.txt"
    path.write_text("old")
    code = (
        "import os, sys; from psfdae.base.files import atomic_path\n"
        "with atomic_path(sys.argv[1]) as new: new.write_text('half'); os.kill(os.getpid(), 9)"
    )
    for _ in range(2):
        assert subprocess.run([sys.executable, "-c", code, path], check=False).returncode == -9
    assert path.read_text() == "old"
    (left,) = find_left_over(tmp_path, path.name)
    others = [tmp_path / name for name in (".file.txt.tmp", f".x{left.name[1:]}", left.name[1:])]
    for other in others:
        other.touch()
    with atomic_path(path) as running:
        assert not left.exists()
        write_text(path, "new")
        assert running.exists()
    assert {*tmp_path.iterdir()} == {path, *others}


def test_a_file_that_is_replaced_keeps_mode_and_link(tmp_path):
    path, link, absent = (tmp_path / name for name in ("file.txt", "link.txt", "absent.txt"))
    link.symlink_to(path.name)
    for mode in (0o600, 0o640, 0o444):
        path.touch()
        path.chmod(mode)
        for target in (path, link):
            write_text(target, str(mode))
            assert path.stat().st_mode & 0o7777 == mode and path.read_text() == str(mode)
    assert link.readlink() == Path("file.txt")
    (tmp_path / "hanging.txt").symlink_to(absent)
    write_text(tmp_path / "hanging.txt", "new")
    assert absent.read_text() == "new"


@pytest.mark.parametrize("kind", ["device", "pipe", "folder", "circle", "link to a device"])
def test_an_output_replaces_nothing_but_a_file(tmp_path, kind):
    path = tmp_path / "out.fits"
    if kind == "device":
        path = Path(os.devnull)
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(os.devnull if "device" in kind else path)
    before = path.lstat()
    for write in (lambda: check_outputs([path], []), lambda: write_text(path, "new")):
        with pytest.raises(OutputError, match=rf"({path}|{os.devnull}): is a .*, not a file"):
            write()
    assert (path.lstat().st_mode, path.lstat().st_ino) == (before.st_mode, before.st_ino)


def test_a_full_disk_is_named_with_the_file_that_has_no_space(tmp_path):
    with pytest.raises(OSError, match="No space left") as refusal, atomic_path(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert refusal.value.filename == str(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


FORMULAE = ("=1+1", "+a", "-a", "@a", "\ta", "a\n=1", "a\r=1", "\r=1")


@pytest.mark.parametrize("write_rows", ["frame", "columns", "rows"])
def test_no_cell_of_a_csv_is_a_formula(tmp_path, write_rows):
    """Neither a name of a column nor a text; psfdae reads what was there before."""
    texts = [*FORMULAE, "-1.5", "a=1", "'a"]
    columns, path = {"=x": texts, "y": [-1.5] * len(texts)}, tmp_path / "a.csv"
    if write_rows == "frame":
        write_csv(path, pd.DataFrame(columns))
    elif write_rows == "columns":
        write_columns(path, columns)
    else:
        names, rows = [*columns], zip(*columns.values(), strict=True)
        write_text(path, as_csv([dict(zip(names, row, strict=True)) for row in rows]))
    with path.open(newline="") as file:
        cells = {cell for row in csv.reader(file) for cell in row}
    assert {cell for cell in cells if cell.startswith(("=", "+", "-", "@", "\t", "\r"))} == {"-1.5"}
    table = read_table(path, "=x", "y")
    # A carriage return, which ends a row to many readers, is a blank.
    assert table["=x"].tolist() == [text.replace("\r", " ") for text in texts]
    assert table["y"].tolist() == columns["y"]


def test_flipped_bytes_of_a_parquet_file_are_found(tmp_path):
    """Those of its pages have a checksum; a flip in the names at its end changes no value."""
    rng, path = np.random.default_rng(1), tmp_path / "a.parquet"
    table = pd.DataFrame(rng.random((9000, 4)), columns=["a", "b", "c", "d"])
    table["name"] = [f"star {number % 70}" for number in range(len(table))]
    write_parquet(path, table)
    whole, found = path.read_bytes(), 0
    for position in np.linspace(0, len(whole) - 1, 30).astype(int):
        content = bytearray(whole)
        content[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)
        try:
            changed = read_table(path)
        except ProductError as error:
            assert "a.parquet: damaged" in str(error)
            found += 1
        else:
            assert (changed.to_numpy() == table.to_numpy()).all()
    assert found >= 27


def test_the_manifest_of_a_run_shows_which_files_have_changed(tmp_path):
    names = ("data/a.h5", "tables/b.csv", "logs/a.log", "reference/b.csv")
    names += ("lr2e-3/data/c.h5", "lr2e-3/.settings/fit.yaml")
    for name in (*names, "runtime.csv", "tables/.b.csv.0.tmp"):
        write_text(tmp_path / name, f"content of {name}\n")
    for _ in range(2):  # the second time there is a manifest, which is no product
        assert psfdae("paper", "manifest", tmp_path).exit_code == 0
    line = ["sha256sum", "--check", "--strict", "SHA256SUMS"]
    check = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert check.stdout.splitlines() == ["data/a.h5: OK", "tables/b.csv: OK"]
    (tmp_path / "data/a.h5").write_text("content of data/a.h4\n")
    check = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert check.returncode == 1 and "data/a.h5: FAILED" in check.stdout


LIGHT = """
import importlib, json, pkgutil, sys
found = {}
PACKAGES = ("poppy", "batoid", "mlflow", "hydra", "snakemake")

def done(step, *unwanted):
    found[step] = [name for name in unwanted if name in sys.modules]

from click.testing import CliRunner
from psfdae.commands.cli import main
assert CliRunner().invoke(main, ["--help"]).exit_code == 0
done("--help", "torch", "mlflow", "hydra", "snakemake", "numpy", "pandas")

import psfdae
assert psfdae.__version__ and callable(psfdae.load_model)
from psfdae_paper.stages.stars import stars, templates
done("import of the simulation", "torch", "pandas", "skimage", "sklearn", *PACKAGES)

import psfdae_paper.stages
for module in pkgutil.iter_modules(psfdae_paper.stages.__path__):
    importlib.import_module(f"psfdae_paper.stages.{module.name}")
done("import of the stages", "torch", "matplotlib", *PACKAGES)
print(json.dumps(found))
"""


def test_nothing_loads_packages_that_it_does_without():
    """One interpreter runs all, from what must be lightest to what may load most."""
    line = [sys.executable, "-c", LIGHT]
    process = subprocess.run(line, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    loaded = json.loads(process.stdout.splitlines()[-1])
    assert len(loaded) == 3
    assert not any(loaded.values()), loaded


def test_progress_is_a_bar_in_a_terminal(monkeypatch):
    """A task within a task moves the bar of the outer one; fewer steps than stated end at 100 %."""
    monkeypatch.setattr("time.time", itertools.count(0.0, 0.6).__next__)
    error = io.StringIO()
    error.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", error)
    with progress.use_display(bar):
        for _ in progress.steps("stars", range(4)):
            assert list(progress.steps("inner", "abcd")) == ["a", "b", "c", "d"]
        with progress.task("field", 9) as advance:
            advance(4)
            advance(1)
    shown = error.getvalue()
    # The first sixteenths of the stars may pass before the bar is drawn; then each is shown.
    percents = [int(p) for p in re.findall(r"(\d+)%", shown.partition("field")[0])]
    assert percents == sorted(percents)
    assert {31, 56, 81, 100} <= {*percents}
    assert shown.count("inner") > 3
    assert shown.count("100%") >= 2


def test_a_bar_appears_before_the_first_step_has_ended(monkeypatch):
    """Of a task whose first step is long, the bar shows that something happens."""
    error = io.StringIO()
    error.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", error)
    shown = threading.Event()
    write = error.write
    monkeypatch.setattr(error, "write", lambda text: (shown.set(), write(text)), raising=False)
    with progress.use_display(bar), progress.task("image", 2):
        assert shown.wait(60.0)
    assert "image" in error.getvalue()


def test_no_bar_is_drawn_after_the_end_of_a_task(monkeypatch):
    """A timer may fire at the moment when the task ends."""
    error, timers = io.StringIO(), []
    error.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", error)

    class LateTimer(threading.Timer):
        def run(self):
            timers.append(self)
            self.finished.wait()
            time.sleep(0.1)
            self.function()

    monkeypatch.setattr(terminal, "Timer", LateTimer)
    with progress.use_display(bar), progress.task("image", 2):
        pass
    shown = error.getvalue()
    timers[0].join()
    assert error.getvalue() == shown


def test_progress_in_a_log_is_a_line_in_ten_seconds(monkeypatch, capsys):
    """A log has ten lines of 100 steps of 1 s, and with them what is left at this pace."""
    seconds = itertools.count(0.0, 1.0)
    monkeypatch.setattr("time.time", seconds.__next__)
    with progress.use_display(bar_or_lines), progress.task("training", 100) as advance:
        for step in range(100):
            advance(1, f"epoch {step + 1}")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 9
    assert lines[0] == "training: 10%  about 90 s left  epoch 10"


def test_every_option_is_explained():
    """A new option needs an entry under Parameters of its command."""
    for name in command_modules():
        options = [p for p in as_click(stage(name)).params if p.param_type_name == "option"]
        assert options and all(option.help for option in options), name


def test_every_command_takes_quiet(tmp_path):
    """A command says what it did, unless it is told to be quiet; an error is said in any case."""
    for name in command_modules():
        assert "--quiet" in {option.opts[0] for option in as_click(stage(name)).params}, name
    assert psfdae("describe").output
    assert not psfdae("describe", "--quiet").output
    assert refused("describe", "none.psf.safetensors", "--quiet")


def test_a_command_shows_a_bar_in_a_terminal_and_lines_in_a_log(tmp_path):
    """The same task in a pseudo-terminal, in a file, and with --quiet in a pseudo-terminal."""
    text = """
import time
from psfdae.base.progress import task
from psfdae.commands.cli import command, program

time.time = iter(range(0, 1000, 6)).__next__

@command("long")
def long():
    with task("field", 4) as advance:
        for _ in range(4):
            advance(1)
    print("finished")

program(long)
"""
    program = tmp_path / "long.py"
    program.write_text(text)
    shown = {}
    for words in ((), ("--quiet",)):
        # What the process writes to its terminal is read from the other end.
        master, slave = pty.openpty()
        line = [sys.executable, program, "long", *words]
        subprocess.run(line, stdout=slave, stderr=slave, stdin=slave, check=True)
        os.close(slave)
        with suppress(OSError):  # Linux's way to say that the other end was closed
            shown[words] = os.read(master, 10**6).decode()
        os.close(master)
    assert "100%" in shown[()]
    assert "finished" in shown[()]
    assert ("--quiet",) not in shown
    line = [sys.executable, program, "long"]
    in_log = subprocess.run(line, capture_output=True, text=True, check=True)
    assert in_log.stdout == "finished\n"
    assert in_log.stderr.startswith("field: 50%  about ")
    assert len(in_log.stderr.splitlines()) == 1


def test_wrong_config_and_missing_input_are_one_message_and_exit_code_2(tmp_path):
    out = tmp_path / "t.h5"
    line = refused("paper", "templates", "--out", out, "telescope.wavelength_m=-1")
    assert line.startswith("psfdae: telescope.wavelength_m = -1: ")
    line = refused("paper", "stars", "--templates", "none.h5", "--out", out)
    assert line == "psfdae: none.h5: no such file\n"
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("predct", "No such command 'predct'; did you mean predict?"),
        (
            "paper config -m train.lr=1e-3,2e-3",
            "-m: several values are a sweep: .*config sweep=NAME",
        ),
        ("paper fit --multirun train.lr=1e-3,2e-3", "--multirun: several values are a sweep"),
        (
            "paper config --cfg job",
            "--cfg: psfdae paper config OVERRIDES prints the composed configuration",
        ),
    ],
)
def test_a_mistyped_command_and_options_of_hydra_are_answered(words, message):
    result = psfdae(*words.split())
    assert result.exit_code == 2
    assert re.search(f"Error: {message}".replace("?", r"\?"), result.output), result.output


@pytest.mark.parametrize("name", ["predict", "nonsense"])
def test_the_configuration_of_a_stage_without_one_lists_the_stages_that_have_one(name):
    """Each listed stage is accepted: commands that read no configuration are not listed."""
    result = psfdae("paper", "config", "--stage", name)
    assert result.exit_code == 2
    message = f"Invalid value for --stage: '{name}' reads no configuration; stages that do: "
    listed = result.output.split(message)[1].strip().split(", ")
    assert {"paper fit", "paper config", "simulate"} < {*listed}
    assert all(stage(command).stage.settings is not None for command in listed)
    assert not {"predict", "photometry", "validate"} & {*listed}


def test_the_help_lists_the_calls_of_python_and_the_stages_below_paper():
    """A user's commands are verbs of Python's calls; the workflow's are one group."""
    output = printed("--help")
    words = re.findall(r"^  ([a-z]+)  ", output, re.MULTILINE)
    assert len(words) <= 16 and output.count("\n") < 50
    verbs = {"train", "validate", "detect", "predict", "photometry", "residual", "adapt"}
    assert verbs | {"psf", "wavefront", "describe", "example", "paper"} <= {*words}
    # Stages are below `paper`, none beside it.
    stages = set(re.findall(r"^  ([a-z-]+)  ", printed("paper", "--help"), re.MULTILINE))
    assert {"fit", "stars", "evaluate", "bounds"} < stages and not stages & {*words}


@pytest.mark.parametrize(
    ("former", "present"),
    [
        ("from-stars", "train"),
        ("exposure", "adapt"),
        ("example-field", "example field"),
        ("fit", "paper fit"),
        ("evaluate", "paper evaluate"),
        ("alignment states", "paper alignment states"),
    ],
)
def test_a_former_name_of_a_command_works_and_says_the_present_one(former, present):
    word, *more = former.split()
    new_word = " ".join(present.split()[: len(present.split()) - len(more)])
    output = typed(*former.split(), "--help").output
    line, _, help_text = output.partition("\n")
    assert line == f"psfdae: {word} is now psfdae {new_word}"
    assert f" {present} " in help_text.splitlines()[0]
    assert help_text == psfdae(*present.split(), "--help").output


def test_options_of_the_image_are_one_group_at_the_end_of_the_help():
    for name in ("train", "validate", "detect", "predict", "photometry", "residual", "adapt"):
        own, _, of_image = printed(name, "--help").partition("\nOptions of an image")
        assert "--out" in own and "--gain" in of_image, name
        assert "--gain" not in own and "--out" not in of_image, name
