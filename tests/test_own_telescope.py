"""The tutorial docs/own_telescope.md, from the telescope's file to restored stars."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from astropy.io import fits
from click.testing import CliRunner

from psfdae.cli import main
from psfdae.configuration.compose import config_dir, forget
from test_workflow import planned

ROOT = Path(__file__).resolve().parents[1]
HEREDOC = re.compile(r"cat > (\S+) <<'END'\n(.*?)\nEND\n", re.S)
STARS = ["grid.points=3", "stars.count=200"]
TINY = {
    "simulate": ["grid.points=3"],
    "stars": STARS,
    "train": [
        *("train.epochs=1", "dae.widths=[4,4,4,4,4,4,4,4,4]"),
        *("parts.train_stars=160", "parts.test_stars=40", *STARS),
    ],
    "bundle": ["parts.train_stars=160", "parts.test_stars=40", *STARS],
    "predict": ["--threads", "1", "--quiet"],
}
"""What makes each command small."""

pytestmark = pytest.mark.workflow


@pytest.fixture(scope="module")
def blocks():
    """The page's shell blocks."""
    text = (ROOT / "docs/own_telescope.md").read_text(encoding="utf-8")
    return re.findall(r"```sh\n(.*?)```", text, re.S)


@pytest.fixture(scope="module")
def workshop(blocks, tmp_path_factory):
    """A copy of the configuration with the files that the page writes."""
    folder = tmp_path_factory.mktemp("own")
    shutil.copytree(config_dir(), folder / "config")
    for block in blocks:
        for name, text in HEREDOC.findall(block):
            (folder / name).write_text(text + "\n", encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PSFDAE_CONFIG", str(folder / "config"))
        patch.chdir(folder)
        forget()
        yield folder
    forget()


def commands(blocks, program):
    lines = [line for block in blocks for line in HEREDOC.sub("", block).splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith(f"{program} ")]


def test_every_line_is_run_by_a_test(blocks):
    left = [line for block in blocks for line in HEREDOC.sub("", block).splitlines()]
    assert {line.split()[0] for line in left if line.strip()} == {"psfdae", "snakemake"}


def test_page_from_the_telescope_s_file_to_restored_stars(blocks, workshop):
    steps = commands(blocks, "psfdae")
    assert {"simulate", "stars", "train", "bundle", "predict"} == {step[0] for step in steps}
    for step in steps:
        result = CliRunner().invoke(main, [*step, *TINY[step[0]]])
        assert result.exit_code == 0, (step, result.output, result.exception)
    for name in ("mine/psfs.png", "mine/psfs.fits", "example_seidel/psfs.png", "night/map.png"):
        assert (workshop / name).stat().st_size > 5000
    with fits.open(workshop / "night/restored.fits") as restored:
        assert restored["PSF"].data.shape == (9, 16, 16)
        assert len(restored["STARS"].data) == 9


def test_page_s_dataset_is_a_target(blocks, workshop):
    targets = commands(blocks, "snakemake")
    assert targets == [["mytarget"]]
    jobs = planned(workshop, *targets[0])
    assert {"telescope_templates", "telescope_stars", "figure_telescope"} <= set(jobs)
    assert {"train", "bundle", "evaluate"} <= set(jobs)
    assert not {"templates", "stars"} & set(jobs)
