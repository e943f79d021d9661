"""The wheel as a user installs it, outside the checkout and without an extra: light, and useful."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from matplotlib.image import imread

from docs_pages import blocks, read
from fits_inputs import write_cube
from prediction_stars import observe
from psfdae_paper.stages.simulate import write_example
from workflow_runs import PATH, ROOT, captured, clone

pytestmark = pytest.mark.slow

LARGEST_MB = 600
"""Size of the whole environment on the disk."""

OF_EXTRAS = ("torch", "hydra", "mlflow", "pyarrow", "snakemake")
"""Modules that a plain installation has not."""

HERE = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}


class Installed:
    """A fresh virtual environment with the wheel and what it requires, nothing else."""

    def __init__(self, folder):
        self.folder = folder
        wheels, self.venv = folder / "wheels", folder / "venv"
        pip = [sys.executable, "-m", "pip"]
        build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels, ROOT]
        self.succeeded(*pip, *build)
        self.succeeded(sys.executable, "-m", "venv", self.venv)
        if self.run(*pip, "index", "versions", "click").returncode:
            pytest.skip("pip reaches no index from which to install what the wheel requires")
        (wheel,) = wheels.glob("*.whl")
        self.succeeded(self.venv / "bin/python", "-m", "pip", "install", wheel)

    def run(self, *words):
        """A finished program, run in a folder that is not the checkout."""
        return captured(list(map(str, words)), cwd=self.folder, env=HERE)

    def succeeded(self, *words):
        run = self.run(*words)
        assert run.returncode == 0, run.stderr
        return run.stdout.strip()

    def python(self, code):
        """The output of a line of Python."""
        return self.succeeded(self.venv / "bin/python", "-c", code)

    def psfdae(self, *words):
        return self.run(self.venv / "bin/psfdae", *words)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    return Installed(tmp_path_factory.mktemp("wheel"))


def test_installation_is_small_and_holds_nothing_of_an_extra(installed):
    module = Path(installed.python("import psfdae; print(psfdae.__file__)"))
    assert module.is_relative_to(installed.venv)
    blocks = sum(path.lstat().st_blocks for path in installed.venv.rglob("*"))
    assert blocks * 512 < LARGEST_MB * 1e6
    find = f"[n for n in {OF_EXTRAS} if importlib.util.find_spec(n)]"
    assert installed.python(f"import importlib.util; print({find})") == "[]"


def test_import_loads_no_heavy_package(installed):
    """It is imported at once because NumPy and others are not."""
    heavy = "{'numpy', 'scipy', 'astropy', 'matplotlib', 'sklearn'}"
    assert installed.python(f"import sys, psfdae; print({heavy} & set(sys.modules))") == "set()"


def test_the_shipped_model_predicts(installed, field_psfs, shipped):
    """The command and the call there give what this environment does, and better than the star."""
    observed = observe(field_psfs[:64], 0.002)
    scale = shipped.info.pixel_scale_arcsec
    write_cube(installed.folder / "stars.fits", observed.stamps, PIXSCALE=scale)
    run = installed.psfdae("predict", "stars.fits", "--out", "psf.fits")
    assert run.returncode == 0, run.stderr
    psf = fits.getdata(installed.folder / "psf.fits", "PSF")
    np.testing.assert_allclose(psf, shipped.predict(observed.stamps).psf, rtol=1e-3, atol=1e-2)
    error = np.square(psf / observed.flux - observed.truth).mean()
    assert error < observed.noise**2 / 5
    stamps = "astropy.io.fits.getdata('stars.fits')"
    call = f"psfdae.load_model().predict({stamps}).psf[0].max()"
    largest = float(installed.python(f"import astropy.io.fits, psfdae; print({call})"))
    assert largest == pytest.approx(float(psf[0].max()), rel=1e-5)


def test_a_command_of_the_reproduction_names_its_extra(installed):
    run = installed.psfdae("train", "--stars", "stars.h5", "--out", "model")
    assert run.returncode == 2
    assert run.stderr.startswith("psfdae: ")
    assert "psfdae[paper]" in run.stderr


def test_the_first_session_as_written(installed, tmp_path):
    """In a fresh copy of the source tree; its picture is that of docs/first_session.md."""
    folder, page = clone(tmp_path / "psfdae"), read("docs/first_session.md")
    lines = [*blocks(page, "sh"), "python - <<'END'\n", *blocks(page, "python"), "END"]
    run = captured(["bash", "-ec", "".join(lines)], cwd=folder, env=HERE | {"PATH": PATH})
    assert run.returncode == 0, run.stderr
    drawn, shown = (
        imread(place / "first_session.png") for place in (folder, ROOT / "docs/figures")
    )
    assert drawn.shape == shown.shape
    assert np.abs(drawn - shown).mean() < 0.01


FOUR_LINES = """
import psfdae
stars = psfdae.Stars.from_image("image.fits", catalogue="stars.csv")
model = psfdae.fit(stars, method="field")
report = psfdae.validate(model, stars)
model.save("image.psf.safetensors"); report.save("page.html")
print(model.bundle.sha256)
"""


def test_four_lines_of_python_train_and_judge_a_model(installed):
    """The command leaves the same model."""
    image, stars = installed.folder / "image.fits", installed.folder / "stars.csv"
    sizes = {"side_px": 400, "bright": 60, "faint": 20, "blended": 1, "saturated": 1}
    write_example(image, stars, seed=3, **sizes)
    digest = installed.python(FOUR_LINES).split()[-1]
    assert (installed.folder / "page.html").stat().st_size > 10_000
    words = ("from-stars", image, "--catalogue", stars, "--method", "field", "--out", "trained")
    run = installed.psfdae(*words)
    assert run.returncode == 0, run.stderr
    assert digest in installed.psfdae("describe", "trained/image.psf.safetensors").stdout
