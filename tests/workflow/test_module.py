"""Another project takes the workflow as a module, in its own folder and with its own telescope."""

from __future__ import annotations

import shutil

import pytest

from docs_pages import blocks, read
from psfdae.base.files import read_product
from workflow_runs import NO_CLUSTER, ROOT, captured, environment

pytestmark = pytest.mark.workflow

NEW_FILES = {
    "/path/to/psfdae": str(ROOT),
    "results/": "out/",
    '"preset": "fast"': '"preset": "smoke", "results": "out"',
    "telescope=mine": "telescope=mine methods=[noisy,dae]",
    "rule errors": "rule stars",
}
"""Changes by the test to the Snakefile of docs/reproduce.md; a rule there has a name of ours."""
GLOBALS = "RESULTS, DATASET, settings = 'elsewhere', 3, None\n"
TELESCOPE = """
name: mine
diameter_m: 0.6
obscuration: 0.4
wavelength_m: 6.0e-7
pixel_scale_arcsec: 0.2
"""


@pytest.mark.slow
def test_a_project_builds_dataset3_with_its_telescope(tmp_path):
    shutil.copytree(ROOT / "config", tmp_path / "config")
    (tmp_path / "config/telescope/mine.yaml").write_text(TELESCOPE)
    (text,) = blocks(read("docs/reproduce.md"), "snakemake")
    for old, new in NEW_FILES.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "Snakefile").write_text(GLOBALS + text)

    def run(*arguments):
        line = ["snakemake", "--cores", "1", *arguments]
        paths = environment(PYTHONPATH=str(ROOT / "src"), **NO_CLUSTER)
        process = captured(line, cwd=tmp_path, env=paths)
        assert process.returncode == 0, process.stdout + process.stderr
        return process.stdout + process.stderr

    run("psfdae_dataset3", "stars")
    stars = read_product(tmp_path / "out/data/seidel/seidel_10pct.h5", "stars", ())
    assert stars.config["telescope"]["name"] == "mine"
    assert stars.config["telescope"]["pixel_scale_arcsec"] == 0.2
    table = (tmp_path / "errors.csv").read_text()
    assert table == (tmp_path / "out/tables/dataset3_mse.csv").read_text()
    assert (tmp_path / "out/mlflow/dataset3.csv").is_file()
    file_names = {path.name for path in tmp_path.iterdir()}
    assert file_names == {".snakemake", "Snakefile", "config", "out", "errors.csv"}
    assert "Nothing to be done" in run("--dry-run", "psfdae_dataset3", "stars")
