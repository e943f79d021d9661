"""Installation without an extra: what needs none works, the rest says which extra to install."""

from __future__ import annotations

import sys
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from command_line import refused
from psfdae import load_model
from psfdae.base import errors
from psfdae.base.errors import MissingExtraError
from psfdae.commands.cli import refusal
from psfdae.denoise.bundle import write_bundle
from workflow_runs import ROOT, captured


@pytest.fixture(autouse=True)
def metadata(monkeypatch):
    """The requirements of pyproject.toml as those of the installed package."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = project["dependencies"] + [
        f"{line}; extra == '{extra}'"
        for extra, names in project["optional-dependencies"].items()
        for line in names
    ]
    monkeypatch.setattr(errors, "requires", lambda name: lines)


@pytest.fixture
def without(monkeypatch):
    """Make imports of modules fail, as where they are not installed."""
    return lambda *names: [monkeypatch.setitem(sys.modules, name, None) for name in names]


@pytest.fixture
def bundle(network, tmp_path):
    """The file of a model that is a network."""
    path = tmp_path / "network.psf.safetensors"
    write_bundle(network.bundle, path)
    return path


def test_a_network_without_torch_names_the_extra(bundle, without):
    without("torch")
    line = f"the model 'wfsat' needs torch: {errors.install_line('dae')}"
    with pytest.raises(MissingExtraError) as caught:
        load_model(bundle)
    assert (str(caught.value), caught.value.name) == (line, "torch")
    assert isinstance(caught.value, ImportError)
    out = bundle.with_name("psf.fits")
    output = refused("predict", "stars.fits", "--model", bundle, "--out", out)
    assert output == f"psfdae: {line}\n"


def test_a_mixture_predicts_without_torch(shipped, without):
    side = shipped.info.stamp_px
    stamps = np.random.default_rng(3).poisson(100.0, (2, side, side)).astype(np.float32)
    stamps[:, side // 2, side // 2] += 5000.0
    expected = shipped.predict(stamps)
    without("torch")
    np.testing.assert_array_equal(load_model().predict(stamps).psf, expected.psf)


@pytest.mark.parametrize("module", ["no_such_module", "hydra.no_such_module", "psfdae.nothing"])
def test_what_no_extra_brings_stays_a_traceback(module):
    error = ModuleNotFoundError("…", name=module)
    assert refusal(error) is None
    with pytest.raises(ModuleNotFoundError) as caught, errors.require_extra("it"):
        raise error
    assert caught.value is error


@pytest.mark.parametrize(
    ("note", "line"),
    [
        ('{{"url": "file://{folder}"}}', 'pip install "{folder}[dae]"'),
        ('{{"url": "https://host/psfdae.whl"}}', 'pip install ".[dae]" in the folder of'),
        ("", 'pip install ".[dae]" in the folder of'),
    ],
)
def test_an_extra_is_installed_from_where_psfdae_was(monkeypatch, tmp_path, note, line):
    """Source of the installation as pip notes it (PEP 610): psfdae is on no index."""
    text = note.format(folder=tmp_path) or None
    installed = SimpleNamespace(read_text=lambda name: text)
    monkeypatch.setattr(errors, "distribution", lambda name: installed)
    assert errors.install_line("dae").startswith(line.format(folder=tmp_path))


def test_the_example_field_needs_no_extra():
    """Its stage is the paper's, but pages on own images begin with it."""
    absent = ("pandas", "hydra", "omegaconf", "mlflow", "torch", "snakemake")
    code = (
        f"import sys; sys.modules |= dict.fromkeys({absent})\nimport psfdae_paper.stages.simulate"
    )
    assert captured([sys.executable, "-c", code]).returncode == 0
