"""Every command of README and docs does what it says, on tiny sizes or as a dry run."""

from __future__ import annotations

import ast
import re
import shlex
import shutil
from importlib import import_module
from subprocess import PIPE, STDOUT

import click
import numpy as np
import pytest

from command_line import printed
from docs_pages import FENCE, ROOT, Command, blocks, commands, pages, read
from fits_inputs import write_field
from image_training import few_draws
from psfdae.commands.cli import main
from psfdae.denoise.bundle import read_bundle
from workflow_runs import clone, shell

SMALL = ("parts.train_stars=60", "parts.test_stars=20")
"""Makes `psfdae train` quick."""

TESTED_ELSEWHERE = {
    **{
        f"docs/{name}.md": "library/training/test_from_stars.py"
        for name in ("training", "photometry")
    },
    "docs/own_telescope.md": "docs/test_own_telescope.py",
}
"""Pages whose commands another test runs from first to last."""

NOT_RUN = ("conda", "python3", "pip", ".")
"""Programs that make or activate a second environment."""

DRY = {
    *(f"make reproduce{more}" for more in ("", " CORES=4", " TRACK=live")),
    *(f"make reproduce PRESET={preset}" for preset in ("smoke", "paper")),
    *(
        f"make reproduce TARGETS=dataset3 RESULTS=results/{words}"
        for words in ("best SET=$(psfdae paper best dae_width)", "lr2e-3 SET=train.lr=2e-3")
    ),
    "make report RESULTS=results/lr2e-3 TARGETS=dataset3",
    *(f"snakemake {t}" for t in ("scene1", "scene2", "scene3", "tables")),
    *(f"make {t}" for t in ("benchmark", "stability", "bounds", "report")),
    "snakemake night --config images=night/*.fits",
    *(f"snakemake sweep --cores all --config sweep={s}" for s in ("dae_width", "network_epochs")),
    "snakemake experiment --cores all --config name=mine",
    "snakemake tracking --forcerun track track_alignment",
    *(f"make {t}" for t in ("mlflow", "mlflow PORT=5001", "reference")),
    *(f"make test{t}" for t in ("", "-all", "-docs", "-pythons")),
}
"""Commands that take over 10 minutes, need a run that does, or would run this test: planned."""


def check_words(line, targets):
    """A command is one of `psfdae`, of the Makefile, or of a program that a test runs."""
    program, *words = line.split() if isinstance(line, str) else line.words
    if program == "make":
        assert {word for word in words if "=" not in word} <= targets, line
    elif program == "psfdae":
        command, context = main, click.Context(main)
        while isinstance(command, click.Group) and words and words[0][0].isalpha():
            command = command.get_command(context, words.pop(0))
        assert command is not None, line
        options = {name for option in command.params for name in option.opts} | {"-h", "--help"}
        assert {w.partition("=")[0] for w in words if w[0] == "-"} <= options, line
    else:
        assert program in ("cat", "cp", "snakemake", *NOT_RUN), line


@pytest.fixture(scope="module")
def targets():
    """Targets of the Makefile."""
    return set(re.findall(r"^([\w-]+):", read("Makefile"), re.M))


def test_every_command_is_one_that_there_is_and_a_test_reads_its_page(targets):
    for page, test in TESTED_ELSEWHERE.items():
        assert page.removesuffix(".md") in read(f"tests/{test}")
    for page in pages():
        for line in commands(read(page)):
            check_words(line, targets)


def test_every_command_in_a_sentence_is_one_that_there_is(targets):
    """In pages, docstrings and messages; the history of changes has commands of its time."""
    texts = [*(ROOT / "src").glob("**/*.py"), *(ROOT / "docs").glob("*.py"), ROOT / "Makefile"]
    texts += [*(ROOT / "config").glob("**/*.yaml"), *map(ROOT.joinpath, pages())]
    lines = {
        " ".join(line.split())
        for path in texts
        if path.name != "CHANGELOG.md"
        for line in re.findall(r"`((?:psfdae|make) [a-z][^`<]*)`", path.read_text("utf-8"))
    } - {"psfdae paper name"}  # how CONTRIBUTING.md names any command
    assert len(lines) > 40
    for line in lines:
        check_words(line, targets)


def test_programs_of_studies_use_what_there_is(targets):
    """They are run by hand, so that a name that was moved is otherwise seen years later."""
    for path in sorted((ROOT / "studies").glob("*/*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module.startswith("psfdae"):
                module = import_module(node.module)
                for name in (alias.name for alias in node.names if not hasattr(module, alias.name)):
                    import_module(f"{node.module}.{name}")
    for path in sorted((ROOT / "studies").glob("*/README.md")):
        # Their blocks have lines for other folders and programs, which are not checked.
        for block in (body for *_, body in FENCE.findall(path.read_text("utf-8"))):
            for line in re.findall(r"^(?:psfdae|make) .*", block.replace("\\\n", " "), re.M):
                check_words(Command(tuple(shlex.split(line, comments=True))), targets)


@pytest.fixture(scope="module")
def observation(tmp_path_factory):
    """An image with 64 stars and its catalogue, for the model that comes with the package."""
    folder = tmp_path_factory.mktemp("observation")
    info = read_bundle(None).info
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(30.0, 270, 30)]))
    paths = folder / "image.fits", folder / "stars.csv"
    sky = np.random.default_rng(1).normal(100, 3, (270, 270))
    scale = info.pixel_scale_arcsec
    stamps = 5e3 * star_stamps(64, info.stamp_px)
    write_field(*paths, stamps, x, y, shape=sky.shape, background=sky, pixel_scale_arcsec=scale)
    return paths


def star_stamps(count, side):
    """Round stars of flux 1, brightest in the middle."""
    grid = np.arange(side) - side // 2
    image = np.exp(-0.5 * (grid[:, None] ** 2 + grid**2) / 1.5**2)
    return np.tile(image / image.sum(), (count, 1, 1))


def test_commands_of_the_readme_run(observation, tmp_path, monkeypatch):
    for path in observation:
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    lines = [line.words[1:] for line in commands(read("README.md")) if line.words[0] == "psfdae"]
    assert {words[0] for words in lines} == {"train", "predict"}
    for words in lines:
        with few_draws():
            printed(*words, *(SMALL if words[0] == "train" else ()))
    assert {"model.html", "psfs.fits", "psfs.png"} <= {path.name for path in tmp_path.iterdir()}


@pytest.fixture(scope="module")
def house(smoke, tmp_path_factory, observation):
    """A fresh copy of the source tree with the results of a run, and an image."""
    folder = clone(tmp_path_factory.mktemp("house") / "psfdae")
    for name in ("results", ".snakemake"):
        shutil.copytree(smoke / name, folder / name, dirs_exist_ok=True)
    for path in observation:
        shutil.copy(path, folder)
    return folder


def typed(line):
    """Command that a user types, or its plan alone."""
    command = " ".join(line.words)
    if "--workflow-profile" in line.words or (command in DRY and line.words[0] == "snakemake"):
        return f"{line.typed} --dry-run" if "#" not in line.typed else f"{command} --dry-run"
    if command in DRY:
        return line.typed.replace("make", "make --dry-run", 1)
    return line.typed


@pytest.mark.written
@pytest.mark.workflow
@pytest.mark.parametrize("page", sorted({*pages()} - {*TESTED_ELSEWHERE}))
def test_commands_as_written(page, house, tmp_path):
    """Run a command in a shell with the environment active and nothing else set."""
    for line in commands(read(page)):
        folder = house
        if line.words == ("make", "clean"):
            folder = clone(tmp_path / "clean")
        elif "compare" in line.words and not (house / line.words[3]).exists():
            for name in ("dae", "evaluation"):
                shutil.copytree(house / "results" / name, house / line.words[3] / name)
        if line.words[0] in NOT_RUN:
            continue
        process = shell(folder, typed(line), stdout=PIPE, stderr=STDOUT, text=True)
        output, _ = process.communicate()
        assert process.returncode == 0, f"{line.typed}\n{output}"


def test_python_blocks_run(tmp_path, monkeypatch):
    side = read_bundle(None).info.stamp_px
    bodies = [b for p in pages() if p not in TESTED_ELSEWHERE for b in blocks(read(p), "python")]
    # Those that train on an image run in test_library.py, that of a telescope in test_sensing.py;
    # what that of a registered model says is in test_registry.py.
    bodies = [
        b for b in bodies if not re.search("from_image|predict_image|psfdae.wavefront|mlflow", b)
    ]
    assert bodies
    (shipped,) = (ROOT / "src/psfdae/denoise/bundles").glob("*.safetensors")
    shutil.copy(shipped, tmp_path / "image.psf.safetensors")
    monkeypatch.chdir(tmp_path)
    for body in bodies:
        names = {"stamps": 5e3 * star_stamps(4, side) + 100.0, "xy": np.zeros((4, 2))}
        exec(compile(body, "page", "exec"), names)
        assert names["prediction"].psf.shape == names["stamps"].shape
