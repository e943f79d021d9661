"""The page docs/own_telescope.md, from the telescope's file to PSFs and its state."""

from __future__ import annotations

import shutil

import pytest
from astropy.io import fits

from command_line import printed
from docs_pages import commands, read
from psfdae_paper.configuration.compose import clear_caches, config_dir
from workflow_runs import planned

PARTS = ["parts.train_stars=200", "parts.test_stars=40"]
TINY = {
    "simulate": ["grid.points=3"],
    "train": ["--method", "gmm", "gmm.components=[4]", *PARTS],
    "predict": ["--threads", "1", "--quiet"],
    "wavefront": ["--quiet"],
}
"""Words that make each command small."""

LINES = commands(read("docs/own_telescope.md"))

pytestmark = [pytest.mark.workflow, pytest.mark.slow]


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """A copy of the configuration with the files that the page writes."""
    folder = tmp_path_factory.mktemp("own")
    shutil.copytree(config_dir(), folder / "config")
    for line in LINES:
        if line.words[0] == "cat":
            (folder / line.words[-1]).write_text(line.heredoc, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PSFDAE_CONFIG", str(folder / "config"))
        patch.chdir(folder)
        clear_caches()
        yield folder
    clear_caches()


def words(program):
    return [list(line.words[1:]) for line in LINES if line.words[0] == program]


def test_page_from_the_telescope_s_file_to_restored_stars(workshop):
    assert set(TINY) == {line[0] for line in words("psfdae")}
    for line in words("psfdae"):
        printed(*line, *TINY[line[0]])
    examples = [f"example_{kind}" for kind in ("seidel", "newtonian", "ritchey_chretien")]
    figures = [f"{folder}/psfs.png" for folder in (*examples, "mine", "hazy")]
    for name in (*figures, "mine/psfs.fits", "night/map.png"):
        assert (workshop / name).stat().st_size > 5000
    with fits.open(workshop / "night/restored.fits") as restored:
        assert restored["PSF"].data.shape == (9, 16, 16)
        assert len(restored["STARS"].data) == 9


def test_page_s_dataset_is_a_target(workshop):
    assert words("snakemake") == [["mytarget"]]
    jobs = set(planned(workshop, "mytarget"))
    rules = {"templates", "stars", "figure_telescope", "train", "bundle", "evaluate"}
    assert rules <= jobs
