"""Links of README and docs lead somewhere, and the site is built without a warning."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
import yaml

from docs_pages import ROOT, anchors, links, pages, read


@pytest.mark.parametrize("page", pages())
def test_links_lead_somewhere(page):
    for link in links(read(page)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target.read_text(encoding="utf-8")), link


def test_anchors_are_those_of_github():
    text = "# A `b` c\n## Noise λ = 3e-4?\n## A b c\n```sh\n# no heading\n```\n"
    assert anchors(text) == ["a-b-c", "noise-λ--3e-4", "a-b-c-1"]


def nav_pages(nav):
    for entry in nav:
        for target in entry.values():
            if isinstance(target, str):
                yield target
            else:
                yield from nav_pages(target)


def test_every_page_is_in_the_navigation():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    nav = yaml.safe_load(text[text.index("\nnav:") :])["nav"]
    of_root = {"README.md": "index.md"}
    expected = {of_root.get(p, p.removeprefix("docs/").lower()) for p in pages()}
    assert set(nav_pages(nav)) == expected


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    # --quiet would hide warnings from --strict as well.
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        check=False,
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    return folder


def test_site_needs_no_other_server(site):
    htmls = sorted(site.glob("*.html"))
    assert len(htmls) > len(pages())
    loaded = re.compile(r"<(?:script|img|link)[^>]+(?:src|href)=\"?(https?:)?//")
    for path in htmls:
        assert not loaded.search(path.read_text(encoding="utf-8")), path.name
    for path in site.rglob("*.css"):
        assert not re.search(r"url\(\"?https?:|@import", path.read_text(encoding="utf-8")), path


def test_images_and_files_are_in_the_site(site):
    for path in site.glob("*.html"):
        text = re.sub(r"<pre.*?</pre>", "", path.read_text(encoding="utf-8"), flags=re.S)
        for target in re.findall(r"(?:src|href)=\"([^\"#]+)\"", text):
            if not re.match(r"[a-z]+:", target):
                assert (site / target.lstrip("/")).exists(), f"{path.name}: {target}"
