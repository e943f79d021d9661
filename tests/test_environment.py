"""The conda environment, the lock files and pyproject.toml say the same, and pip takes them."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from importlib.metadata import packages_distributions, version
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
CONDA_NAMES = {
    "pytorch-cpu": "torch",
    "snakemake-minimal": "snakemake",
    "matplotlib-base": "matplotlib",
}
CONDA_ONLY = {"pip", "python"}
TRANSITIVE = {
    "sqlalchemy": "of mlflow",
    "numexpr": "of poppy",
    "asdf": "of asdf-astropy, which photutils takes from Python 3.12 on; tests/pythons.sh has it",
}
NOT_IMPORTED = {
    "pywavelets": "scikit-image's wavelets need it",
    "pyarrow": "writes the Parquet files of pandas",
    "snakemake": "runs the workflow",
    "snakemake-executor-plugin-slurm": "runs it on a cluster",
}
LOCKS = ["requirements.lock", *(f"requirements/{n}.lock" for n in ("build", "torch", "torch-cpu"))]

# Stands in for python: notes what it is asked, and offers versions of torch.
RECORDER = """#!/bin/sh
echo "$*" >>"$LOG"
case "$*" in
"-m venv "*) mkdir -p "$3/bin" && cp "$0" "$3/bin/python" ;;
*" index versions torch"*) echo "Available versions: $OFFERED" ;;
esac
"""


def required(*extras):
    """Requirements of pyproject.toml by package: of the plain package, and of extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = sum(
        (project["optional-dependencies"][name] for name in extras), project["dependencies"]
    )
    found = {canonicalize_name(r.name): r for r in map(Requirement, lines)}
    more = found.pop("psfdae", None)
    return found | (required(*more.extras) if more else {})


@pytest.fixture(scope="module")
def declared():
    """What the environment of make and conda holds."""
    return required("paper", "dev")


@pytest.fixture(scope="module")
def torch_pin():
    """The version of torch in that environment."""
    return re.search(r"^torch==(.+)$", (ROOT / "requirements/torch.in").read_text(), re.M)[1]


@pytest.fixture(scope="module")
def conda():
    return yaml.safe_load((ROOT / "environment.yml").read_text())


@pytest.fixture(scope="module")
def pip_part(conda):
    return next(part["pip"] for part in conda["dependencies"] if isinstance(part, dict))


def locked(path):
    """Versions and hashes of each package of a lock file; versions differ between Pythons."""
    versions, hashes = defaultdict(set), defaultdict(set)
    text = re.sub(r"^#.*\n", "", (ROOT / path).read_text(), flags=re.M)
    for block in re.split(r"\n(?=[^ ])", text.strip()):
        name, pin = re.match(r"([A-Za-z0-9_.-]+)==([^ ;]+)", block).groups()
        versions[canonicalize_name(name)].add(pin)
        hashes[canonicalize_name(name)] |= set(re.findall(r"--hash=sha256:([0-9a-f]{64})\b", block))
    return versions, hashes


def test_conda_requires_what_pyproject_requires(declared, conda, pip_part, torch_pin):
    lines = [line for line in conda["dependencies"] if isinstance(line, str)]
    lines += [line for line in pip_part if line != "--editable ."]
    ours = {CONDA_NAMES.get(r.name, r.name): r.specifier for r in map(Requirement, lines)}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert str(ours["python"]) == project["requires-python"]
    wanted = {n: r.specifier for n, r in declared.items()}
    wanted["torch"] = SpecifierSet(f"=={torch_pin}")
    assert {canonicalize_name(n): s for n, s in ours.items() if n not in CONDA_ONLY} == wanted


def test_the_plain_package_is_light():
    plain = required()
    assert len(plain) <= 12
    heavy = {"torch", "hydra-core", "mlflow", "pyarrow", "snakemake"}
    assert heavy <= required("paper").keys() - plain.keys()
    assert required("dae").keys() - plain.keys() == {"torch", "tqdm"}


def test_snakefile_asks_for_the_snakemake_of_pyproject(declared):
    text = (ROOT / "workflow/Snakefile").read_text()
    asked = re.search(r'^min_version\("([0-9.]+)"\)', text, re.M)[1]
    assert f">={asked}" in map(str, declared["snakemake"].specifier)


@pytest.mark.parametrize(
    ("name", "vulnerable"),
    [("hydra-core", "1.3.3"), ("mlflow", "3.15.2"), ("snakemake", "9.16.3")],
)
def test_versions_with_known_vulnerabilities_are_refused(declared, name, vulnerable):
    assert not declared[name].specifier.contains(vulnerable)


def imports(path):
    """Modules that a file imports from other packages."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module


def test_imports_are_declared_and_what_is_declared_is_imported(declared):
    paths = [path for folder in ("src", "workflow") for path in (ROOT / folder).rglob("*.py")]
    names = {name.split(".")[0] for path in paths for name in imports(path)}
    names -= {path.stem for path in (ROOT / "workflow").rglob("*.py")}  # programs beside each other
    packages = packages_distributions()
    imported = {
        name: {canonicalize_name(package) for package in packages.get(name, [name])}
        for name in names - sys.stdlib_module_names - {"psfdae", "psfdae_paper"}
    }
    known = declared.keys() | TRANSITIVE.keys()
    assert [name for name, found in imported.items() if not found & known] == []
    assert required("paper").keys() - set().union(*imported.values()) == NOT_IMPORTED.keys()


@pytest.mark.slow
def test_pip_takes_the_pip_part_as_conda_hands_it_over(pip_part, tmp_path):
    """conda joins the lines to a requirements file and runs pip beside environment.yml."""
    python = tmp_path / "venv" / "bin" / "python"
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}

    def pip(*args):
        line = [python, "-m", "pip", "install", "--quiet", "--no-deps", *args]
        done = subprocess.run(line, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr

    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], env=env, check=True)
    pip("--require-hashes", "--requirement", "requirements/build.lock")
    requirements = tmp_path / "condaenv.requirements.txt"
    requirements.write_text("\n".join(pip_part))
    pip("--upgrade", "--no-build-isolation", "--requirement", requirements)
    found = "import importlib.util as u; print(u.find_spec('psfdae').origin)"
    shown = subprocess.check_output([python, "-I", "-c", found], text=True, env=env).strip()
    assert shown == str(ROOT / "src" / "psfdae" / "__init__.py")


def test_locked_and_installed_versions_satisfy_pyproject(declared):
    versions, _ = locked("requirements.lock")
    for name, requirement in declared.items():
        if name != "torch":
            assert all(map(requirement.specifier.contains, versions[name])), name
        assert requirement.specifier.contains(version(name), prereleases=True), name


def test_torch_and_cuda_are_locked_apart(declared, torch_pin):
    assert declared["torch"].specifier.contains(torch_pin)
    apart = locked("requirements/torch.lock")[0]
    cpu = locked("requirements/torch-cpu.lock")[0]
    assert apart["torch"] == {torch_pin}
    assert cpu["torch"] - apart["torch"] == {f"{torch_pin}+cpu"}
    assert any(name.startswith("nvidia") for name in apart)
    everyone = locked("requirements.lock")[0]
    assert not [name for name in everyone if name == "torch" or name.startswith("nvidia")]


@pytest.mark.parametrize("path", ["requirements/build.lock", "requirements/torch.lock"])
def test_locks_agree_on_what_they_share(path):
    versions, everyone = locked(path)[0], locked("requirements.lock")[0]
    shared = versions.keys() & everyone.keys()
    assert len(shared) > 3
    assert {n: versions[n] for n in shared} == {n: everyone[n] for n in shared}


@pytest.mark.parametrize("path", LOCKS)
def test_every_locked_requirement_has_a_hash(path):
    versions, hashes = locked(path)
    assert versions
    assert [name for name in versions if not hashes[name]] == []


@pytest.mark.parametrize(
    ("index", "offered", "lock"),
    [
        ("", "2.99.0, {pin}", "torch"),
        ("", "2.99.0, {pin}+cpu, {pin}", "torch-cpu"),
        ("https://example.org/cpu", "{pin}+cpu", "torch-cpu"),
    ],
)
def test_make_env_installs_nothing_without_a_hash(index, offered, lock, torch_pin, tmp_path):
    python = tmp_path / "python"
    python.write_text(RECORDER)
    python.chmod(0o755)
    line = ["make", "env", f"PYTHON={python}", f"VENV={tmp_path / 'venv'}", f"TORCH_INDEX={index}"]
    env = {"OFFERED": offered.format(pin=torch_pin), "LOG": str(tmp_path / "log"), "MAKEFLAGS": ""}
    subprocess.run(line, cwd=ROOT, env=os.environ | env, check=True, capture_output=True)
    installs = [step for step in Path(env["LOG"]).read_text().splitlines() if " install " in step]
    assert len(installs) > 3
    assert all("--require-hashes" in step or "--no-index" in step for step in installs), installs
    assert all("--no-build-isolation" in step for step in installs), installs
    torch = next(step for step in installs if "torch==" in step)
    assert torch.endswith(f" --constraint requirements/{lock}.lock torch=={torch_pin}")
    assert [step for step in installs if "--index-url" in step] == ([torch] if index else [])
    assert not index or f"--index-url {index} " in torch
