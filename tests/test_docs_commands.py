"""Every command of README and docs does what it says, on tiny sizes or as a dry run."""

from __future__ import annotations

import re
import shutil
import subprocess

import numpy as np
import pytest
from click.testing import CliRunner

from docs_pages import ROOT, Command, blocks, commands, pages, read
from psfdae.bundle import read_bundle
from psfdae.cli import main
from psfdae.configuration.compose import forget
from psfdae.documentation.graphs import rule_topics
from psfdae.files import write_text
from psfdae.observations.examples import write_field
from test_compare import errors
from workflow_runs import command, environment, job_counts

TINY = {
    "templates": ["grid.points=5"],
    "stars": ["grid.points=5", "stars.count=200"],
    "train": ["preset=smoke", "parts.train_stars=150", "parts.test_stars=50"],
    "config": [],
    "simulate": ["grid.points=3"],
    "predict": [],
    "describe": [],
    "compare": [],
}
"""What makes a command quick; one that is not here has no handler."""

TESTED_ELSEWHERE = {
    "docs/own_stars.md": "test_from_stars.py",
    "docs/own_telescope.md": "test_own_telescope.py",
}
"""Pages whose commands another test runs from first to last."""

NOT_RUN = {"conda": "makes a second environment", ".": "activates the environment"}
"""Commands that no test runs, and why."""

IGNORED_OPTIONS = {"--cores": 1, "--jobs": 1, "-n": 0, "--dry-run": 0}
"""Options of snakemake, with their number of values, that a dry run on two cores replaces."""

ONE_VALUE = ("--workflow-profile", "--max-threads")
MANY_VALUES = ("--default-resources", "--set-resources", "--groups", "--slurm-array-jobs")
"""Options of snakemake on a cluster, which a dry run gets as they stand."""

RULES = rule_topics(ROOT / "workflow/rules")


class NoHandlerError(Exception):
    """A page has a command that no test knows how to run."""


@pytest.fixture
def sandbox(tmp_path, monkeypatch):
    """A working folder with a config tree of its own and finished trainings to compare."""
    shutil.copytree(ROOT / "config", tmp_path / "config")
    shutil.copytree(ROOT / "profiles", tmp_path / "profiles")
    for run in ("results", "results/paper", "results/smoke"):
        for network in ("random-realisation", "held_out-realisation"):
            write_network(tmp_path / run, f"dataset3/{network}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PSFDAE_CONFIG", str(tmp_path / "config"))
    forget()
    yield tmp_path
    forget()


def write_network(results, place):
    folder = results / "dae" / place
    write_text(folder / "config.yaml", f"train:\n  lr: 0.004\nrun: {results.name}\n")
    write_text(folder / "history.csv", "epoch,train_mse,validation_mse,seconds\n1,2e-5,1e-5,3\n")
    table = results / "evaluation" / f"{place}.parquet"
    table.parent.mkdir(parents=True, exist_ok=True)
    errors(1, 1e-5).to_parquet(table)


@pytest.fixture(scope="module")
def observation(tmp_path_factory):
    """An image with nine stars and its catalogue, for the model that comes with the package."""
    folder = tmp_path_factory.mktemp("observation")
    info = read_bundle(None).info
    x, y = (axis.ravel() for axis in np.meshgrid([30.0, 60, 90], [30.0, 60, 90]))
    paths = folder / "image.fits", folder / "stars.csv"
    sky = np.random.default_rng(1).normal(100, 3, (120, 120))
    scale = info.pixel_scale_arcsec
    stamps = 5e3 * star_stamps(9, info.stamp_px)
    write_field(*paths, stamps, x, y, shape=sky.shape, background=sky, pixel_scale_arcsec=scale)
    return paths


def star_stamps(count, side):
    """Round stars of flux 1, brightest in the middle."""
    grid = np.arange(side) - side // 2
    image = np.exp(-0.5 * (grid[:, None] ** 2 + grid**2) / 1.5**2)
    return np.tile(image / image.sum(), (count, 1, 1))


def run(command: Command, folder):
    """Run a command that is no workflow; snakemake has a test of its own."""
    first, *rest = command.words
    if first == "psfdae":
        run_psfdae(rest)
    elif first == "cat":
        write_heredoc(command, folder)
    elif first == "cp":
        subprocess.run(command.words, cwd=folder, check=True)
    elif first == "make":
        run_make(rest)
    elif first not in (*NOT_RUN, "snakemake"):
        raise NoHandlerError(" ".join(command.words))


def run_psfdae(words):
    if words[0] not in TINY:
        raise NoHandlerError(f"psfdae {words[0]}")
    result = CliRunner().invoke(main, [*words, *TINY[words[0]]])
    assert result.exit_code == 0, result.output or result.exception


def write_heredoc(command, folder):
    *_, arrow, path = command.words
    assert arrow == ">"
    (folder / path).write_text(command.heredoc)
    forget()


def run_make(words):
    makefile = (ROOT / "Makefile").read_text()
    for target in (word for word in words if "=" not in word):
        assert re.search(rf"^{target}:", makefile, re.M), target
    # What a shell would fill in is not there.
    words = [re.sub(r"\$\([^)]*\)", "", word) for word in words]
    listed = ["make", "--dry-run", "--directory", str(ROOT), *words]
    subprocess.run(listed, env=environment(), check=True, capture_output=True)


def targets_and_settings(words):
    """What a snakemake command builds, and how: options of a cluster, what follows --config."""
    targets, options, settings = [], [], []
    words = list(words[1:])
    while words:
        word = words.pop(0)
        if word == "--config":
            while words and re.match(r"\w+=", words[0]):
                settings.append(words.pop(0))
        elif word.partition("=")[0] in ONE_VALUE + MANY_VALUES:
            values = [] if "=" in word else [words.pop(0)]
            while word in MANY_VALUES and words and not words[0].startswith("-"):
                values.append(words.pop(0))
            options += [word, *values]
        elif word in IGNORED_OPTIONS:
            del words[: IGNORED_OPTIONS[word]]
        elif word == "--forcerun":
            # In a dry run of an empty folder everything runs; the rules must exist.
            while words and not words[0].startswith("-"):
                assert words.pop(0) in RULES
        elif word.startswith("-"):
            raise NoHandlerError(f"snakemake {word}")
        else:
            targets.append(word)
    named = re.findall(r"(\w+)[:,]|,(\w+)|(\w+)=model", " ".join(options))
    assert {name for names in named for name in names if name} <= set(RULES)
    return targets, (tuple(options), tuple(settings))


def own_pages():
    return [page for page in pages() if page not in TESTED_ELSEWHERE]


@pytest.mark.parametrize("page", [p for p in own_pages() if commands(read(p))])
def test_commands_run(page, sandbox, observation):
    for path in observation:
        shutil.copy(path, sandbox)
    for line in commands(read(page)):
        run(line, sandbox)


def snakemake_pages():
    return [p for p in own_pages() if any(c.words[0] == "snakemake" for c in commands(read(p)))]


@pytest.mark.slow
@pytest.mark.workflow
@pytest.mark.parametrize("page", snakemake_pages())
def test_workflow_commands_have_jobs(page, sandbox):
    """All targets of a page that need no settings in one dry run."""
    together: dict[tuple, list] = {}
    for line in commands(read(page)):
        if line.words[0] in ("cat", "cp"):
            run(line, sandbox)
        elif line.words[0] == "snakemake":
            targets, settings = targets_and_settings(line.words)
            together.setdefault(settings, []).extend(targets)
    for (options, settings), targets in together.items():
        line = [*command(sandbox, *options, "--dry-run", *targets), *settings]
        done = subprocess.run(
            line, cwd=sandbox, env=environment(), capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        jobs = job_counts(done.stdout)
        assert set(targets) <= set(jobs), (settings, targets)


@pytest.mark.parametrize(("page", "test"), TESTED_ELSEWHERE.items())
def test_the_other_test_reads_the_page(page, test):
    assert commands(read(page))
    assert page.removeprefix("docs/") in (ROOT / "tests" / test).read_text(encoding="utf-8")


def test_python_blocks_run(sandbox):
    side = read_bundle(None).info.stamp_px
    found = [body for page in own_pages() for body in blocks(read(page), "python")]
    assert found
    for body in found:
        names = {"stamps": 5e3 * star_stamps(4, side) + 100.0}
        exec(compile(body, "page", "exec"), names)
        assert names["prediction"].psf.shape == names["stamps"].shape


@pytest.mark.parametrize("words", [("frobnicate",), ("psfdae", "frobnicate")])
def test_a_command_without_handler_fails(words, tmp_path):
    with pytest.raises(NoHandlerError, match="frobnicate"):
        run(Command(words), tmp_path)


def test_unknown_target_of_make_fails():
    with pytest.raises(AssertionError, match="frobnicate"):
        run_make(["frobnicate"])


def test_blocks_are_read_to_the_word():
    text = "```sh\ncat > a.yaml <<'END'\nx: 1  # kept\nEND\npsfdae a \\\n  b='c d' # gone\n```\n"
    assert commands(text) == [
        Command(("cat", ">", "a.yaml"), "x: 1  # kept\n"),
        Command(("psfdae", "a", "b=c d")),
    ]
