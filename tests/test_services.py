"""Files that others' services read: jobs, forms, the catalog of workflows, the citation."""

from __future__ import annotations

import sys

import pytest

from docs_pages import ROOT
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
