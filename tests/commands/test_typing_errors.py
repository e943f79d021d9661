"""A word that is mistyped is answered with the word that was meant."""

import subprocess
import sys
from pathlib import Path

import pytest

import psfdae as library
from command_line import psfdae
from docs_pages import ROOT


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An image with its list, and a telescope whose YAML file has a mistyped key."""
    folder = tmp_path_factory.mktemp("typed")
    words = ["--side", 200, "--bright", 5, "--faint", 5]
    words += ["--out", folder / "image.fits", "--catalogue", folder / "stars.csv"]
    assert psfdae("example", "field", *words).exit_code == 0
    telescope = (ROOT / "config/telescope/example_zernike.yaml").read_text()
    (folder / "telescope.yaml").write_text(telescope.replace("diameter_m", "diametre_m"))
    return folder


LISTED = "image.fits --catalogue stars.csv --origin 0"


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("trian image.fits", "did you mean train?"),
        ("alignment state", "did you mean states?"),
        ("train image.fits --detct --out o", "'--detect'"),
        (f"predict {LISTED} --flux-colum flux --out o.fits", "'--flux-column'"),
        ("train image.fits --detect --method feild --out o", "did you mean field?"),
        ("train image.fits --detect --out o snr_min=20", "calibration_stars.snr_min?"),
        ("train image.fits --detect --out o field.order=[1]", "did you mean field.orders?"),
        ("train image.fits --detect --out o methods=[gmn]", "did you mean gmm?"),
        (f"predict {LISTED} --flux-column X_IMAG --out o.fits", "did you mean X_IMAGE?"),
        ("predict imag.fits --detect --out o.fits", "did you mean image.fits?"),
        ("predict image.fits --catalogue star.csv --out o.fits", "did you mean stars.csv?"),
        ("predict image.fits --detect --gain 2adu --out o.fits", "not a valid float"),
        ("describe nowhere/m.psf.safetensors", "nor is there a folder nowhere"),
        ("wavefront image.fits --detect --telescope telescop.yaml --out o.fits", "telescope.yaml?"),
        ("wavefront image.fits --detect --telescope telescope.yaml --out o.fits", "diameter_m?"),
        ("simulate telescope=example_seidle", "did you mean example_seidel?"),
        ("config telescope.wavelenght_m=1", "did you mean telescope.wavelength_m?"),
        ("config dataset=datset3", "did you mean dataset3?"),
        ("config datset=dataset3", "did you mean dataset?"),
        ("config preset=fsat", "did you mean fast?"),
        ("config telescope=wfsta", "did you mean wfsat?"),
        ("config train.lrr=1", "did you mean train.lr?"),
        ("config -m train.lr=1e-3,2e-3", "snakemake sweep --config sweep=NAME"),
        ("config --multirun", "snakemake sweep --config sweep=NAME"),
        ("config --cfg job", "psfdae paper config OVERRIDES"),
    ],
)
def test_a_mistyped_word_of_a_command_is_answered_with_the_one_meant(
    folder, monkeypatch, line, meant
):
    monkeypatch.chdir(folder)
    result = psfdae(*line.split())
    assert result.exit_code == 2, result.output
    # The last line says it; above it click repeats how the command is used.
    assert meant in " ".join(result.output.splitlines()[-1:])
    assert not Path("o").exists()


def test_a_mistyped_name_in_python_is_answered_with_the_one_meant(folder):
    with pytest.raises(library.Error, match=r"did you mean snr_min\?"):
        library.Stars.from_image(folder / "image.fits", detect=True, snr_mn=20)
    with pytest.raises(library.Error, match=r"gain=2\.0 m: expected a number of electron/adu"):
        from astropy import units

        library.Stars.from_image(folder / "image.fits", detect=True, gain=2 * units.m)
    line = [sys.executable, "-c", "import psfdae; psfdae.lod_model"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1].endswith("Did you mean: 'load_model'?")


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
@pytest.mark.parametrize(
    ("line", "option"),
    [
        (f"wavefront {LISTED} --telescope telescope.yaml --out o.fits --axis 3", "--axis"),
        ("train image.fits --detect --out o --snr-min", "--snr-min"),
        ("photometry image.fits --detect --model m --out o.csv --zero-point", "--zero-point"),
        ("psf image.fits --out o.fits --at 1,", "--at"),
    ],
)
def test_no_option_takes_a_number_that_is_not_finite(folder, monkeypatch, number, line, option):
    monkeypatch.chdir(folder)
    names = sorted(folder.iterdir())
    gap = "" if line.endswith(",") else " "
    run = psfdae(*f"{line}{gap}{number}".split())
    assert run.exit_code == 2
    assert option in run.stderr and number in run.stderr
    assert sorted(folder.iterdir()) == names


@pytest.mark.workflow
@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("snakemake -n datset3", "no target datset3; did you mean dataset3?"),
        ("snakemake -n --config prset=fast", "did you mean preset?"),
        ("snakemake -n sweep --config sweep=gmn", "did you mean gmm?"),
        ("make -n reproduce PRESTE=smoke", "PRESTE: no variable of this Makefile"),
    ],
)
def test_a_mistyped_word_of_the_workflow_is_answered_with_the_one_meant(words, meant):
    done = subprocess.run(words.split(), capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode
    assert meant in (done.stdout + done.stderr).splitlines()[-1]
