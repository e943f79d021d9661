"""The conda environment, the lock files and pyproject.toml agree."""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from importlib.metadata import version

import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from docs_pages import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TORCH = re.search(r"^torch==(.+)$", (ROOT / "requirements/torch.in").read_text(), re.M)[1]
CONDA_NAMES = {
    "pytorch-cpu": "torch",
    "snakemake-minimal": "snakemake",
    "matplotlib-base": "matplotlib",
}


def required(*extras):
    """Requirements of pyproject.toml by package: of the plain package, and of extras."""
    lines = list(PROJECT["dependencies"])
    for name in extras:
        lines += PROJECT["optional-dependencies"][name]
    packages = {canonicalize_name(r.name): r for r in map(Requirement, lines)}
    self_requirement = packages.pop("psfdae", None)
    return packages | (required(*self_requirement.extras) if self_requirement else {})


DECLARED = required("paper", "dev")
"""Packages of the environments of make and conda."""


def locked(path):
    """Versions of each package of a lock file, which differ between Pythons."""
    versions = defaultdict(set)
    text = re.sub(r"^#.*\n", "", (ROOT / path).read_text(), flags=re.M)
    for block in re.split(r"\n(?=[^ ])", text.strip()):
        name, pin = re.match(r"([A-Za-z0-9_.-]+)==([^ ;]+)", block).groups()
        versions[canonicalize_name(name)].add(pin)
    return versions


def test_conda_requires_what_pyproject_requires():
    parts = yaml.safe_load((ROOT / "environment.yml").read_text())["dependencies"]
    lines = [line for line in parts if isinstance(line, str)]
    lines += [line for line in parts[-1]["pip"] if line != "--editable ."]
    specifiers = {CONDA_NAMES.get(r.name, r.name): r.specifier for r in map(Requirement, lines)}
    assert str(specifiers.pop("python")) == PROJECT["requires-python"]
    specifiers.pop("pip")
    expected = {name: r.specifier for name, r in DECLARED.items()}
    expected["torch"] = SpecifierSet(f"=={TORCH}")
    assert {canonicalize_name(name): s for name, s in specifiers.items()} == expected


def test_locked_and_installed_versions_satisfy_pyproject():
    versions = locked("requirements.lock")
    for name, requirement in DECLARED.items():
        if name != "torch":
            assert all(map(requirement.specifier.contains, versions[name])), name
        assert requirement.specifier.contains(version(name), prereleases=True), name
