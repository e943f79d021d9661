"""README and docs: numbers of the run of record, and a site without a dead link."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import sys

import pandas as pd
import pytest
import yaml

import psfdae
from docs_pages import ROOT, pages, read
from psfdae_paper.configuration.alignment import CHOICE
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


@pytest.fixture
def fill(tables, tmp_path, monkeypatch):
    """Text of a page, and what has drifted, by a record of which two tables and a figure stay."""
    record = tmp_path / "results/reference"
    record.mkdir(parents=True)
    for name in ("new", "old", "older"):
        (record / f"{name}.csv").write_text("a,b\n1,2\n")
    kept = {"old.csv": {"commit": "1" * 40, "date": "2026-01-02"}}
    kept |= {"figures/old.png": kept["old.csv"]}
    kept |= {"older.csv": {"commit": "2" * 40, "date": "2026-01-01"}}
    (record / "provenance.json").write_text(json.dumps({"commit": "3" * 40, "kept": kept}))
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    monkeypatch.setattr(tables, "REFERENCE", record)
    tables.joined = lambda *names: pd.concat([tables.csv(name) for name in names])

    def filled(text):
        drifted = []
        (tmp_path / "README.md").write_text(text)
        return tables.filled(tmp_path / "README.md", drifted), drifted

    return filled


def test_a_typed_number_is_named_and_renewed(tables, fill, tmp_path, monkeypatch):
    text, drifted = fill("Of <!-- new.csv: {a} -->2<!-- end --> stars.\n")
    assert drifted == ["README.md: new.csv"]
    with pytest.raises(SystemExit, match=r"README\.md: new\.csv"):
        tables.main()
    monkeypatch.setattr(sys, "argv", ["tables.py"])
    tables.main()
    assert (tmp_path / "README.md").read_text() == text
    assert text == "Of <!-- new.csv: {a} -->1<!-- end --> stars.\n"


HEADED = "| a |\n|---|\n"
TABLE = f"<!-- {{}}.csv: | {{{{a}}}} | -->\n{HEADED}| 1 |\n<!-- end -->\n"


@pytest.mark.parametrize(
    ("page", "mark"),
    [
        (TABLE, "\n*Recorded 2026-01-02 at commit 111111111111, not with the run of record.*\n"),
        (
            "Of <!-- {}.csv: {{a}} -->1<!-- end --> stars.\n",
            " (recorded 2026-01-02 at commit 111111111111)",
        ),
    ],
)
def test_what_is_of_an_earlier_record_is_marked(fill, page, mark):
    assert fill(page.format("new")) == (page.format("new"), [])
    text, drifted = fill(page.format("old"))
    assert drifted == ["README.md: old.csv"]
    assert text == page.format("old").replace("<!-- end -->", f"{mark}<!-- end -->")
    assert fill(text) == (text, [])


@pytest.mark.parametrize("names", ["new.csv old.csv", "old.csv older.csv"])
def test_tables_of_two_commits_are_not_joined(fill, names):
    with pytest.raises(SystemExit, match=r"README\.md: .* two commits"):
        fill(f"<!-- joined {names}: {{a.sum()}} -->2<!-- end -->\n")


def test_a_figure_of_an_earlier_record_has_a_mark_beside_it(fill):
    figure = "![x](results/reference/figures/old.png)\n"
    for beside in ("", TABLE.format("new"), TABLE.format("older"), f"{TABLE.format('old')}## On\n"):
        with pytest.raises(SystemExit, match=r"figures/old\.png"):
            fill(beside + figure)
    fill(TABLE.format("old") + figure)


@pytest.mark.slow
def test_site_has_every_page_no_dead_link_and_needs_no_other_server(tmp_path):
    # --quiet would hide warnings from --strict as well.
    line = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    built = captured(line, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    assert built.returncode == 0, built.stderr
    loaded = re.compile(r"<(?:script|img|link)[^>]+(?:src|href)=\"?(https?:)?//")
    for page in pages():
        path = tmp_path / re.sub(r"README$", "index", page[:-3])
        text = path.with_suffix(".html").read_text(encoding="utf-8")
        assert not loaded.search(text), page
        # Neither a mark of a number nor one of the reference of a module is left.
        assert "&lt;!--" not in text and "<p>:::" not in text, page
    for path in tmp_path.rglob("*.css"):
        assert not re.search(r"url\(\"?https?:|@import", path.read_text(encoding="utf-8")), path
    for page, words in (("docs/cli", "psfdae predict"), ("config/index", "train.lr</code></td>")):
        assert words in (tmp_path / f"{page}.html").read_text(encoding="utf-8")


def leaves(tree, name=""):
    """Keys of a tree of settings."""
    for key, value in tree.items():
        inner = f"{name}.{key}" if name else key
        yield from leaves(value, inner) if isinstance(value, dict) else [inner]


def test_every_key_that_a_file_of_the_configuration_sets_is_documented():
    page = read("config/README.md")
    trees = [compose(CHOICE), *(compose([f"dataset={name}"]) for name in dataset_names())]
    # A user names lenses.
    keys = {re.sub(r"\.lenses\.\w+", ".lenses", key) for tree in trees for key in leaves(tree)}
    assert len(keys) > 150
    assert [key for key in sorted(keys) if f"| `{key}` |" not in page] == []
    schema = yaml.safe_load(read("workflow/schemas/command_line.schema.yaml"))
    assert [key for key in schema["properties"] if f"| `{key}` |" not in page] == []


def test_versions_agree_and_the_way_of_a_star_names_files():
    cited = yaml.safe_load(read("CITATION.cff"))
    assert cited["version"] == psfdae.__version__
    assert re.search(r"^## (\S+)", read("CHANGELOG.md"), re.M)[1] == psfdae.__version__
    section = read("docs/architecture.md").partition("way of one star")[2].partition("## ")[0]
    way = re.findall(r"^\| `([^`]+)` \|", section, re.M)
    assert len(way) >= 20 and all((ROOT / path).is_file() for path in way)
