"""README and docs: numbers of the run of record, and a site without a dead link."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
import yaml

import psfdae
from docs_pages import ROOT, pages
from workflow_runs import captured

TABLES = ROOT / "docs/tables.py"


def check(tables):
    line = [sys.executable, str(tables), "--check"]
    return captured(line, cwd=ROOT)


def test_numbers_are_those_of_the_run_of_record():
    found = check(TABLES)
    assert found.returncode == 0, f"{found.stderr}\npython docs/tables.py renews them"


def test_a_typed_number_is_named(tmp_path):
    for folder in ("src", "config", "results"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/tables.py").write_text(TABLES.read_text(encoding="utf-8"))
    mark = "<!-- tables/stability.csv where verdict != 'pass': {len(case)} -->"
    (tmp_path / "README.md").write_text(f"Rows: {mark}0<!-- end -->.\n")
    assert check(tmp_path / "docs/tables.py").returncode == 0
    (tmp_path / "README.md").write_text(f"Rows: {mark}1<!-- end -->.\n")
    found = check(tmp_path / "docs/tables.py")
    assert (found.returncode, found.stderr) == (1, "README.md: tables/stability.csv\n")
    subprocess.run([sys.executable, str(tmp_path / "docs/tables.py")], check=True)
    assert (tmp_path / "README.md").read_text() == f"Rows: {mark}0<!-- end -->.\n"


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
    for page, words in (("cli", "psfdae predict"), ("configuration", "train.lr</code></td>")):
        text = (site / f"docs/{page}.html").read_text(encoding="utf-8")
        assert words in text
        assert "&lt;!--" not in text
        assert ":::" not in text


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
