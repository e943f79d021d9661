"""The conda environment, the lock files and pyproject.toml agree."""

from __future__ import annotations

import os
import re
import subprocess
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
INDEX = "https://example.org/cpu"
LOCKS = ["requirements.lock", *(f"requirements/{n}.lock" for n in ("build", "torch", "torch-cpu"))]

# Stands in for python: notes its arguments, and offers versions of torch.
RECORDER = """#!/bin/sh
echo "$*" >>"$LOG"
case "$*" in
"-m venv "*) mkdir -p "$3/bin" && cp "$0" "$3/bin/python" ;;
*" index versions torch"*) echo "Available versions: $OFFERED" ;;
esac
"""


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


def test_make_env_installs_nothing_without_a_hash(tmp_path):
    python = tmp_path / "python"
    python.write_text(RECORDER)
    python.chmod(0o755)
    line = ["make", "env", f"PYTHON={python}", f"VENV={tmp_path / 'venv'}", f"TORCH_INDEX={INDEX}"]
    variables = {"OFFERED": f"{TORCH}+cpu", "LOG": str(tmp_path / "log"), "MAKEFLAGS": ""}
    subprocess.run(line, cwd=ROOT, env=os.environ | variables, check=True, capture_output=True)
    steps = (tmp_path / "log").read_text().splitlines()
    installs = [step for step in steps if " install " in step]
    assert len(installs) > 3
    assert all("--require-hashes" in step or "--no-index" in step for step in installs), installs
    assert all("--no-build-isolation" in step for step in installs), installs
    torch = next(step for step in installs if "torch==" in step)
    assert torch.endswith(f" --constraint requirements/torch-cpu.lock torch=={TORCH}")
    assert [step for step in installs if f"--index-url {INDEX} " in step] == [torch]
