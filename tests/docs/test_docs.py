"""README and docs: numbers of the run of record, and a site without a dead link."""

from __future__ import annotations

import importlib
import json
import os
import re
import sys

import pytest
import yaml

import psfdae
from docs_pages import ROOT, pages, read
from psfdae_paper.configuration.compose import compose
from psfdae_paper.workflow.run import CommandLine
from workflow_runs import captured

sys.path.append(str(ROOT / "docs"))
sentences = importlib.import_module("page_sentences")
tables = sentences.tables


@pytest.mark.parametrize("page", sentences.SENTENCES)
def test_numbers_in_sentences_are_those_of_the_tables(page):
    """A sentence that differs is printed as the tables of today give it."""
    text = " ".join(read(page).split())
    expected = [" ".join(sentence.split()) for sentence in sentences.SENTENCES[page]()]
    assert expected and [sentence for sentence in expected if sentence not in text] == []


@pytest.mark.parametrize("name", ["cpu_s", "tests_s", "install_s", "peak_mb"])
@pytest.mark.parametrize("is_null", [True, False])
def test_a_record_without_a_number_of_the_readme_is_named(name, is_null, monkeypatch, tmp_path):
    """The CPU time is null if the log of a job lacks it: its division ended in a TypeError."""
    run = tables.provenance()
    del run[name]
    text = json.dumps(run | ({name: None} if is_null else {}))
    (tmp_path / "provenance.json").write_text(text)
    monkeypatch.setattr(tables, "RECORD", tmp_path)
    with pytest.raises(ValueError, match=f"provenance.json: {name} not known; run the record"):
        [*sentences.readme()]


def test_the_prose_in_the_readme_has_no_other_number():
    text = " ".join(re.sub(r"^```.*?^```", "", read("README.md"), flags=re.M | re.S).split())
    for sentence in sentences.SENTENCES["README.md"]():
        text = text.replace(" ".join(sentence.split()), "")
    # The year of the paper, numbers of scenes, the S/N of a picture, and powers of ten are left;
    # the number in a name, such as AVX-512, is none.
    assert {*re.findall(r"(?<![\w-])\d+(?:[.,]\d+)*", text)} <= {"1", "2", "3", "10", "2020"}
    assert not re.search(r"\b(twice|(two|three|four|five|six|ten) (to \w+ )?times)\b", text)


def test_every_table_of_a_page_has_rows_and_every_function_a_page():
    page_of_table = {}
    for page in pages():
        for link in tables.LINK.finditer(read(page)):
            assert (ROOT / page).parent.joinpath(link["path"]).exists(), (page, link["path"])
            page_of_table[link["name"]] = page
    assert page_of_table.keys() == tables.TABLES.keys()
    for name, table in tables.TABLES.items():
        frame = table()
        assert len(frame) > 1 and frame.columns.is_unique, name
        assert not frame.astype(str).isin(["nan"]).any(axis=None), name


def test_a_table_of_an_earlier_record_gets_its_date(monkeypatch):
    runs = tables.provenance()["other_runs"]
    name, row = next(item for item in runs.items() if item[0].endswith(".csv"))
    monkeypatch.setitem(tables.TABLES, "both", lambda: tables.pd.DataFrame({"a": [1], "b": [2.5]}))
    page, path = ROOT / "README.md", f"results/reference/{name}"
    text = tables.insert_tables(f'Text.\n\n[All]({path} "table both")\n', page)
    processor = f" on {row['cpu']}" if "cpu" in row else ""
    date = f"recorded {row['date']} at commit {row['commit'][:12]}{processor}"
    date += ", not with the run of record"
    # The table, and below it the link.
    assert text == (f"Text.\n\n| a | b |\n| --- | --- |\n| 1 | 2.5 |\n\n*[All]({path}), {date}.*\n")
    # A file of the run of record itself needs no date.
    assert tables.recorded(tables.RECORD / "runtime.csv") == ""


def test_sources_of_pages_have_no_marks_and_the_readme_is_short():
    # Of comments, only the directives of the site are left.
    for page in ("README.md", *(page for page in pages() if page.startswith("docs/"))):
        assert not re.search(r"<!--(?!site\n)", read(page)), page
    assert len(read("README.md").splitlines()) <= 120


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
        # Neither the reference of a module nor a link in place of a table is left.
        assert "&lt;!--" not in text and "<p>:::" not in text and 'title="table ' not in text, page
    for path in tmp_path.rglob("*.css"):
        assert not re.search(r"url\(\"?https?:|@import", path.read_text(encoding="utf-8")), path


def test_every_group_and_word_of_the_configuration_is_on_its_page():
    """Comments on single keys are in the files (test_configuration)."""
    page = read("config/README.md")
    groups = {
        group for choice in ("dataset3", "alignment") for group in compose([f"dataset={choice}"])
    }
    assert len(groups) > 25
    assert [group for group in sorted(groups) if f"`{group}`" not in page] == []
    assert [key for key in CommandLine.model_fields if f"| `{key}` |" not in page] == []


def test_versions_agree():
    cited = yaml.safe_load(read("CITATION.cff"))
    assert cited["version"] == psfdae.__version__
    assert re.search(r"^## (\S+)", read("CHANGELOG.md"), re.M)[1] == psfdae.__version__


def test_files_that_the_guide_for_contributors_names_exist():
    """A file without a folder is in the folder of the file before it."""
    rows = [row for row in read("CONTRIBUTING.md").splitlines() if row.startswith("| ")]
    names = [re.findall(r"`(\w[\w/]*(?:/|\.py))`", row) for row in rows]
    assert sum(map(len, names)) > 50
    for row in names:
        folder = ""
        for name in row:
            folder = name[: name.rindex("/") + 1] if "/" in name else folder
            path = f"{folder}{name.rpartition('/')[2]}"
            # Rows of what to add have folders of either package.
            places = ("src/psfdae", "src", "src/psfdae/image")
            assert any((ROOT / place / path).exists() for place in places), path


def anchors(page):
    """Anchors of the headings of a page, as GitHub makes them."""
    # A comment in a code block is no heading.
    text = re.sub(r"^```.*?^```", "", read(page), flags=re.M | re.S)
    headings = re.findall(r"^#+ (.*)", text.lower(), re.M)
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in headings}


def test_pages_named_in_the_code_exist():
    """Links of docstrings, comments and messages; the site checks the links of pages."""
    links = set()
    # Text files alone; the files of config/ are checked with its own page.
    for name in ("src", "workflow", "profiles", "studies", "tests"):
        for path in (ROOT / name).rglob("*"):
            if path.suffix in {".py", ".smk", ".yaml", ".rst", ".md", ".sh"}:
                text = path.read_text(encoding="utf-8")
                links |= set(re.findall(r"\bdocs/(\w+\.(?:md|ipynb))(?:#([\w-]+))?", text))
    assert len(links) > 10
    for name, anchor in links:
        assert (ROOT / "docs" / name).is_file(), name
        assert not anchor or anchor in anchors(f"docs/{name}"), (name, anchor)
