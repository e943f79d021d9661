"""A plain `pip install` of the wheel, without extras, does what the pages on own images say."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits

from docs_pages import FENCE, ROOT, read
from fits_inputs import write_cube
from prediction_stars import observe
from workflow_runs import captured

pytestmark = pytest.mark.slow

PAGES = ("README", "docs/training", "docs/photometry", "docs/python")

OTHER_PROGRAMS = ("make", "snakemake", "pip", "python3", ".")
"""First words of lines that install psfdae or build the reproduction."""

SMALL = {"example": "--side=700 --bright=60 --faint=80"}
"""Options that make a command quick."""

EXAMPLE = "psfdae example field --out image.fits --catalogue stars.csv"
NOTEBOOK = ROOT / "docs/first_session.ipynb"

PREPARATION = {
    "README": EXAMPLE,
    "docs/python": f"""{EXAMPLE}
python - <<'END'
import numpy as np
from astropy.io import fits
from astropy.table import Table
image, table = fits.getdata("image.fits"), Table.read("stars.csv")
place = np.stack([table["X_IMAGE"], table["Y_IMAGE"]], axis=1) - 1
place = place[(abs(place - 350) < 300).all(axis=1)][:8]
corners = np.rint(place).astype(int) - 8
np.savez("cut.npz", xy=place, stamps=[image[y : y + 16, x : x + 16] for x, y in corners])
END""",
}
"""Shell lines that make what the reader of a page has: an image with its list, and stamps."""

LINES_BEFORE = {"docs/python": 'import numpy as np\nglobals().update(np.load("cut.npz"))\n'}
"""Lines of Python before those of a page."""


@pytest.fixture(scope="module")
def light(tmp_path_factory):
    """Folder `bin` of a fresh virtual environment with the wheel and what it requires."""
    folder = tmp_path_factory.mktemp("light")
    pip = [sys.executable, "-m", "pip"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, ROOT]
    subprocess.run([*pip, *build], check=True, cwd=folder)
    subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
    if captured([*pip, "index", "versions", "click"]).returncode:
        pytest.skip("pip reaches no index from which to install what the wheel requires")
    (wheel,) = folder.glob("*.whl")
    programs = folder / "venv/bin"
    subprocess.run([programs / "python", "-m", "pip", "install", "--quiet", wheel], check=True)
    return programs


def run(light, folder, script):
    """Output of a bash script in a folder, `psfdae` and `python` being the environment's."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment["PATH"] = f"{light}{os.pathsep}{os.environ['PATH']}"
    process = captured(["bash", "-euc", script], cwd=folder, env=environment)
    assert process.returncode == 0, f"{script}\n{process.stdout}{process.stderr}"
    return process.stdout


def script_of(page):
    """The shell and Python blocks of a page as one bash script, in their order."""
    lines = PREPARATION.get(page, "").splitlines()
    session = LINES_BEFORE.get(page, "")
    for _, language, body in FENCE.findall(read(f"{page}.md")):
        if language == "python":
            # Python blocks of a page are one session, but shell commands come between them.
            lines += ["python - <<'END'", session, body, "END"]
        if language == "sh":
            lines += body.splitlines()
    return "\n".join(filter(None, (shell_line(line) for line in lines)))


def shell_line(line):
    """A line of a script, made quick."""
    words = shlex.split(line, comments=True) if re.match(r"[\w.]+ ", line) else []
    if not words or words[0] not in ("psfdae", *OTHER_PROGRAMS):
        return line
    if words[0] in OTHER_PROGRAMS:
        return ""
    small = SMALL.get(words[1], "")
    sparse = "cp image.fits sparse.fits\n" if "sparse.fits" in words[:4] else ""
    return f"{sparse}{line} {small}"


@pytest.mark.parametrize("page", PAGES)
def test_commands_and_python_lines_of_a_page_run_without_extras(light, page, tmp_path):
    script = script_of(page)
    assert "psfdae" in script
    run(light, tmp_path, script)
    if page == "README":
        # The four lines of Python and the command make the same model.
        models = [tmp_path / f"{place}image.psf.safetensors" for place in ("", "model/")]
        assert models[0].read_bytes() == models[1].read_bytes()
        assert (tmp_path / "page.html").stat().st_size > 10_000


def test_notebook_shows_what_its_cells_show_here(light, tmp_path):
    """Words are the same, numbers within the rounding of other machines, pictures as large."""
    run(light, tmp_path, f"python {ROOT}/docs/notebook.py {NOTEBOOK} again.ipynb")
    committed, executed = (shown(path) for path in (NOTEBOOK, tmp_path / "again.ipynb"))
    assert [words for words, _ in executed] == [words for words, _ in committed]
    for (_, numbers), (_, expected) in zip(executed, committed, strict=True):
        np.testing.assert_allclose(numbers, expected, rtol=0.05, atol=0.05)
    assert NOTEBOOK.stat().st_size < 400_000


def shown(notebook):
    """Words and numbers of each text that a notebook's cells show."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    texts = ["".join(output.get("data", output).get("text/plain", "image")) for output in outputs]
    number = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]\d+)?")
    return [(number.sub("n", text).split(), [*map(float, number.findall(text))]) for text in texts]


def test_environment_is_small_and_holds_no_extra(light, tmp_path):
    blocks = sum(path.lstat().st_blocks for path in light.parent.rglob("*"))
    assert blocks * 512 < 700e6  # bytes on the disk; torch alone takes as much
    names = ("torch", "hydra", "mlflow", "pyarrow", "snakemake")
    code = f"import importlib.util as u; print([n for n in {names} if u.find_spec(n)])"
    assert run(light, tmp_path, f'python -c "{code}"') == "[]\n"


def test_help_lists_what_works_here_and_names_the_extra_for_the_others(light, tmp_path):
    lines = run(light, tmp_path, "psfdae --help")
    for heading in (
        "Your images:",
        "Telescopes:",
        'with the extra "paper": pip install',
    ):
        assert heading in lines
    assert "train" in lines and "snakemake" not in lines and "  fit " not in lines
    refusal = run(light, tmp_path, "psfdae paper fit dae --stars a.h5 --out b 2>&1 || test $? = 2")
    assert re.fullmatch(
        r'psfdae: this command needs hydra-core: pip install ".*\.whl\[paper\]"\n', refusal
    )


def test_shipped_model_predicts_what_it_does_here(light, tmp_path, field_psfs, shipped):
    observed = observe(field_psfs[:64], 0.002)
    scale = shipped.info.pixel_scale_arcsec
    write_cube(tmp_path / "stars.fits", observed.stamps, PIXSCALE=scale)
    run(light, tmp_path, "psfdae predict stars.fits --out psf.fits")
    psf = fits.getdata(tmp_path / "psf.fits", "PSF")
    np.testing.assert_allclose(psf, shipped.predict(observed.stamps).psf, rtol=1e-3, atol=1e-2)
    # Better than the noisy star by five in the mean squared error.
    assert np.square(psf / observed.flux - observed.truth).mean() < observed.noise**2 / 5
