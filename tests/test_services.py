"""Files that others' services read: jobs, forms, the catalog of workflows, the citation."""

from __future__ import annotations

import re
import sys

import pytest
import yaml

from docs_pages import ROOT, read
from workflow_runs import captured

JOBS = sorted((ROOT / ".github/workflows").glob("*.yml"))
SCHEMAS = {
    "vendor.github-workflows": JOBS,
    "custom.github-workflows-require-timeout": JOBS,
    "vendor.github-issue-forms": [*(ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml")],
    "vendor.citation-file-format": [ROOT / "CITATION.cff"],
    "workflow_catalog.schema.yaml": [ROOT / ".snakemake-workflow-catalog.yml"],
}


@pytest.mark.parametrize(("schema", "files"), SCHEMAS.items())
def test_files_are_valid(schema, files):
    assert files
    path = ROOT / "tests/data" / schema
    option = ("--schemafile", str(path)) if path.is_file() else ("--builtin-schema", schema)
    done = captured([sys.executable, "-m", "check_jsonschema", *option, *map(str, files)])
    assert done.returncode == 0, done.stdout


def test_the_catalog_finds_what_it_asks_for():
    assert all((ROOT / name).is_file() for name in ("workflow/Snakefile", "config/README.md"))
    assert {"snakemake", "workflow"} <= set(re.findall(r"\w+", read("README.md").lower()))


def test_jobs_call_make_and_nothing_else():
    targets = re.findall(r"^([a-z-]+):.*## ", read("Makefile"), re.M)
    for path in JOBS:
        jobs = yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"].values()
        for lines in ([step["run"] for step in job["steps"] if "run" in step] for job in jobs):
            assert len(lines) == 1
            called = re.fullmatch(r"make ([a-z-]+)( [A-Z]+=(\w+|\$\{\{ matrix\.\w+ \}\}))*", *lines)
            assert called and called[1] in targets, lines


def test_pythons_of_the_jobs_are_those_of_the_package():
    jobs = yaml.safe_load(read(".github/workflows/ci.yml"))["jobs"]
    pythons = jobs["pythons"]["strategy"]["matrix"]["python"]
    assert re.search(r"^PYTHONS \?= (.+)", read("Makefile"), re.M)[1].split() == pythons
    assert f'requires-python = ">={pythons[0]}"' in read("pyproject.toml")


UV = """#!/bin/sh
case "$*" in
*"python find"*) case "$*" in *3.1[12]*) ;; *) exit 2 ;; esac ;;
*venv*) for v; do :; done; mkdir -p "$v" ;;
esac
"""
"""A program that finds the Pythons 3.11 and 3.12 only."""


@pytest.mark.parametrize(
    ("pythons", "code", "words"),
    [
        ("3.11 3.14", 0, "Not on this machine, skipped: Python 3.14\nPassed: Python 3.11\n"),
        ("3.11 3.12", 1, "Failed: Python 3.12\nPassed: Python 3.11\n"),
        ("3.14", 1, "Passed: Python of no version\n"),
    ],
)
def test_a_python_that_is_missing_is_named_and_no_pass(tmp_path, pythons, code, words):
    (tmp_path / "uv").write_text(UV)
    (tmp_path / "uv").chmod(0o755)
    tests = ["sh", "-c", 'case "$PATH" in *3.12-*) exit 1;; esac']
    environment = {"PATH": f"{tmp_path}:/usr/bin:/bin", "RESOLUTION": "highest"}
    line = ["sh", str(ROOT / "tests/pythons.sh"), *tests]
    done = captured(line, cwd=tmp_path, env=environment | {"PYTHONS": pythons})
    assert (done.returncode, done.stdout.endswith(words)) == (code, True), done.stdout
