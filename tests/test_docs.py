"""README and docs: numbers of the run of record, and a site without a dead link."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys

import pandas as pd
import pytest
import yaml

import psfdae
from docs_pages import ROOT, pages, read
from psfdae_paper.configuration.alignment import CHOICE
from psfdae_paper.configuration.compose import compose, dataset_names
from workflow_runs import captured

TABLES = ROOT / "docs/tables.py"


def check(tables):
    line = [sys.executable, str(tables), "--check"]
    return captured(line, cwd=ROOT)


def test_numbers_are_those_of_the_run_of_record():
    found = check(TABLES)
    assert found.returncode == 0, f"{found.stderr}\npython docs/tables.py renews them"


def test_a_typed_number_is_named(tmp_path):
    (tmp_path / "docs").mkdir()
    for name in ("src", "config", "results", "workflow", "docs/keys.py"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "docs/tables.py").write_text(TABLES.read_text(encoding="utf-8"))
    mark = "<!-- tables/stability.csv where verdict != 'pass': {len(case)} -->"
    (tmp_path / "README.md").write_text(f"Rows: {mark}0<!-- end -->.\n")
    assert check(tmp_path / "docs/tables.py").returncode == 0
    (tmp_path / "README.md").write_text(f"Rows: {mark}1<!-- end -->.\n")
    found = check(tmp_path / "docs/tables.py")
    assert (found.returncode, found.stderr) == (1, "README.md: tables/stability.csv\n")
    subprocess.run([sys.executable, str(tmp_path / "docs/tables.py")], check=True)
    assert (tmp_path / "README.md").read_text() == f"Rows: {mark}0<!-- end -->.\n"


@pytest.fixture
def fill(tmp_path, monkeypatch):
    """Text of a page, and what has drifted, by a record of which two tables and a figure stay."""
    spec = importlib.util.spec_from_file_location("tables", TABLES)
    tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tables)
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


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    # --quiet would hide warnings from --strict as well.
    line = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    built = captured(line, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    assert built.returncode == 0, built.stderr
    return folder


def test_site_has_every_page_and_needs_no_other_server(site):
    htmls = [site / re.sub(r"README$", "index", page[:-3]) for page in pages()]
    loaded = re.compile(r"<(?:script|img|link)[^>]+(?:src|href)=\"?(https?:)?//")
    for path in htmls:
        assert not loaded.search(path.with_suffix(".html").read_text(encoding="utf-8")), path.name
    for path in site.rglob("*.css"):
        assert not re.search(r"url\(\"?https?:|@import", path.read_text(encoding="utf-8")), path


def test_site_has_the_references_and_no_mark(site):
    for page, words in (("cli", "psfdae predict"), ("../config/index", "train.lr</code></td>")):
        text = (site / f"docs/{page}.html").read_text(encoding="utf-8")
        assert words in text
        assert "&lt;!--" not in text
        assert ":::" not in text


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


def test_versions_agree():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == psfdae.__version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+)", changes, re.M)[1] == psfdae.__version__


def test_the_way_of_a_star_is_short_and_names_files():
    page = (ROOT / "docs/architecture.md").read_text()
    way = re.findall(
        r"^\| `([^`]+)` \|", page.partition("way of one star")[2].partition("## ")[0], re.M
    )
    assert 20 <= len(way) <= 25 and len(set(way)) == len(way)
    assert all((ROOT / path).is_file() for path in way)
