"""The conda environment, the lock file and pyproject.toml say the same."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
CONDA_NAMES = {
    "pytorch-cpu": "torch",
    "snakemake-minimal": "snakemake",
    "matplotlib-base": "matplotlib",
}


@pytest.fixture(scope="module")
def declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = project["dependencies"] + project["optional-dependencies"]["dev"]
    return {canonicalize_name(r.name): r for r in map(Requirement, lines)}


@pytest.fixture(scope="module")
def conda():
    return yaml.safe_load((ROOT / "environment.yml").read_text())


@pytest.fixture(scope="module")
def locked():
    pins = re.findall(
        r"^([A-Za-z0-9_.-]+)==([^ ;\\]+)", (ROOT / "requirements.lock").read_text(), re.M
    )
    return {canonicalize_name(name): pin for name, pin in pins}


def test_conda_requires_what_pyproject_requires(declared, conda):
    requirements = [Requirement(line) for line in conda["dependencies"] if isinstance(line, str)]
    ours = {CONDA_NAMES.get(r.name, r.name): r.specifier for r in requirements}
    del ours["pip"]
    python = ours.pop("python")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert str(python) == project["requires-python"]
    assert {canonicalize_name(n): s for n, s in ours.items()} == {
        n: r.specifier for n, r in declared.items()
    }


def test_conda_channels(conda):
    assert conda["channels"] == ["conda-forge", "bioconda", "nodefaults"]


def test_lock_satisfies_pyproject(declared, locked):
    for name, requirement in declared.items():
        if name != "torch":
            assert requirement.specifier.contains(locked[name]), name


def test_installed_versions_satisfy_pyproject(declared):
    for name, requirement in declared.items():
        assert requirement.specifier.contains(version(name), prereleases=True), name


def test_torch_is_pinned_outside_the_hashed_lock(declared, locked):
    assert re.fullmatch(r"==[0-9.]+", str(declared["torch"].specifier))
    assert "torch" not in locked
    assert not [name for name in locked if name.startswith("nvidia")]


def test_every_locked_requirement_has_a_hash():
    text = (ROOT / "requirements.lock").read_text()
    blocks = re.split(r"\n(?=[A-Za-z0-9])", text.strip())
    assert all("--hash=sha256:" in block for block in blocks if "==" in block)
