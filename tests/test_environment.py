"""The conda environment, the lock files and pyproject.toml agree."""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TORCH = re.search(r"^torch==(.+)$", (ROOT / "requirements/torch.in").read_text(), re.M)[1]
CONDA_NAMES = {
    "pytorch-cpu": "torch",
    "snakemake-minimal": "snakemake",
    "matplotlib-base": "matplotlib",
}
LOCKS = ["requirements.lock", *(f"requirements/{n}.lock" for n in ("build", "torch", "torch-cpu"))]


def required(*extras):
    """Requirements of pyproject.toml by package: of the plain package, and of extras."""
    lines = list(PROJECT["dependencies"])
    for name in extras:
        lines += PROJECT["optional-dependencies"][name]
    packages = {canonicalize_name(r.name): r for r in map(Requirement, lines)}
    more = packages.pop("psfdae", None)
    return packages | (required(*more.extras) if more else {})


DECLARED = required("paper", "dev")
"""What the environment of make and conda holds."""


def locked(path):
    """Versions and hashes of each package of a lock file; versions differ between Pythons."""
    versions, hashes = defaultdict(set), defaultdict(set)
    text = re.sub(r"^#.*\n", "", (ROOT / path).read_text(), flags=re.M)
    for block in re.split(r"\n(?=[^ ])", text.strip()):
        name, pin = re.match(r"([A-Za-z0-9_.-]+)==([^ ;]+)", block).groups()
        versions[canonicalize_name(name)].add(pin)
        hashes[canonicalize_name(name)] |= set(re.findall(r"--hash=sha256:([0-9a-f]{64})\b", block))
    return versions, hashes


def test_conda_requires_what_pyproject_requires():
    parts = yaml.safe_load((ROOT / "environment.yml").read_text())["dependencies"]
    lines = [line for line in parts if isinstance(line, str)]
    lines += [line for line in parts[-1]["pip"] if line != "--editable ."]
    ours = {CONDA_NAMES.get(r.name, r.name): r.specifier for r in map(Requirement, lines)}
    assert str(ours.pop("python")) == PROJECT["requires-python"]
    ours.pop("pip")
    expected = {name: r.specifier for name, r in DECLARED.items()}
    expected["torch"] = SpecifierSet(f"=={TORCH}")
    assert {canonicalize_name(name): s for name, s in ours.items()} == expected


def test_locked_and_installed_versions_satisfy_pyproject():
    versions, _ = locked("requirements.lock")
    for name, requirement in DECLARED.items():
        if name != "torch":
            assert all(map(requirement.specifier.contains, versions[name])), name
        assert requirement.specifier.contains(version(name), prereleases=True), name


@pytest.mark.parametrize("path", LOCKS)
def test_locks_agree_and_every_locked_requirement_has_a_hash(path):
    versions, hashes = locked(path)
    everyone, _ = locked("requirements.lock")
    assert [name for name in versions if not hashes[name]] == []
    if path != "requirements/torch-cpu.lock":
        shared = versions.keys() & everyone.keys()
        assert len(shared) > 3
        assert {n: versions[n] for n in shared} == {n: everyone[n] for n in shared}
    if "/torch" in path:
        assert versions["torch"] <= {TORCH, f"{TORCH}+cpu"}
    else:
        assert not [name for name in versions if name == "torch" or name.startswith("nvidia")]
