"""README and docs: numbers of the run of record, and a site without a dead link."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import sys

import pytest
import yaml

import psfdae
from docs_pages import ROOT, pages, read
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import compose, dataset_names
from workflow_runs import captured


@pytest.fixture
def tables(monkeypatch):
    """The script docs/tables.py, run with --check."""
    spec = importlib.util.spec_from_file_location("tables", ROOT / "docs/tables.py")
    tables = importlib.util.module_from_spec(spec)
    monkeypatch.syspath_prepend(ROOT / "docs")
    monkeypatch.setattr(sys, "argv", ["tables.py", "--check"])
    spec.loader.exec_module(tables)
    return tables


def test_numbers_are_those_of_the_run_of_record(tables):
    tables.main()  # it exits with the names of what has drifted; without --check it renews them


@pytest.mark.parametrize(
    ("name", "mark"), [("new", ""), ("old", " (recorded 2026-01-02 at commit 111111111111)")]
)
def test_a_typed_number_is_named_and_renewed_with_its_record(
    tables, tmp_path, monkeypatch, name, mark
):
    record, page = tmp_path / "results/reference", tmp_path / "README.md"
    record.mkdir(parents=True)
    (record / f"{name}.csv").write_text("a,b\n1,2\n")
    old_record = {"old.csv": {"commit": "1" * 40, "date": "2026-01-02"}}
    (record / "provenance.json").write_text(json.dumps({"commit": "3" * 40, "kept": old_record}))
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    monkeypatch.setattr(tables, "REFERENCE", record)
    sources = tmp_path / "docs/numbers.yaml"
    sources.parent.mkdir()
    sources.write_text(f"README.md: [{{table: {name}.csv, numbers: {{stars: '{{a}}'}}}}]")
    page.write_text("Of <!--n:stars-->2<!--/--> stars.\n")
    with pytest.raises(SystemExit, match=r"README\.md: stars"):
        tables.main()
    monkeypatch.setattr(sys, "argv", ["tables.py"])
    tables.main()
    assert page.read_text() == f"Of <!--n:stars-->1{mark}<!--/--> stars.\n"
    # A key of the page alone, or of the file of all keys alone, is refused.
    for text in ("No number.\n", "<!--n:stars-->1<!--/--> of <!--n:all-->2<!--/-->"):
        page.write_text(text)
        with pytest.raises(SystemExit, match="only one of both has"):
            tables.main()


@pytest.mark.slow
def test_site_has_every_page_no_dead_link_and_needs_no_other_server(tmp_path):
    # --quiet would hide warnings from --strict as well.
    line = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    built = captured(line, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    # With the index as a script, the search works in pages that are opened from the disk.
    assert built.returncode == 0 and (tmp_path / "search/search_index.js").is_file(), built.stderr
    loaded = re.compile(r"<(?:script|img|link)[^>]+(?:src|href)=\"?(https?:)?//")
    for page in pages():
        path = tmp_path / re.sub(r"README$", "index", page[:-3])
        text = path.with_suffix(".html").read_text(encoding="utf-8")
        assert not loaded.search(text), page
        # Neither a mark of a number nor one of the reference of a module is left.
        assert "&lt;!--" not in text and "<p>:::" not in text, page
    for path in tmp_path.rglob("*.css"):
        assert not re.search(r"url\(\"?https?:|@import", path.read_text(encoding="utf-8")), path


def leaves(tree, name=""):
    """Keys of a tree of settings."""
    for key, value in tree.items():
        path = f"{name}.{key}" if name else key
        yield from leaves(value, path) if isinstance(value, dict) else [path]


def test_every_key_that_a_file_of_the_configuration_sets_is_documented():
    page = read("config/README.md")
    trees = [compose(Alignment.choice), *(compose([f"dataset={name}"]) for name in dataset_names())]
    # A user names lenses.
    keys = {re.sub(r"\.lenses\.\w+", ".lenses", key) for tree in trees for key in leaves(tree)}
    assert len(keys) > 150
    assert [key for key in sorted(keys) if f"| `{key}` |" not in page] == []
    schema = yaml.safe_load(read("workflow/schemas/command_line.schema.yaml"))
    assert [key for key in schema["properties"] if f"| `{key}` |" not in page] == []


def test_versions_agree():
    cited = yaml.safe_load(read("CITATION.cff"))
    assert cited["version"] == psfdae.__version__
    assert re.search(r"^## (\S+)", read("CHANGELOG.md"), re.M)[1] == psfdae.__version__
