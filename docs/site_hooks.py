"""MkDocs hooks: the site's files lie as in the repository."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PUBLISHED = (
    *("*.md", "LICENSE", "CITATION.cff", "config/*.md"),
    *("docs/*.md", "docs/*.css", "docs/*.js", "docs/figures/*.png"),
    *("results/reference/**/*.png", "results/reference/**/*.csv", "studies/*/*.csv"),
    "src/psfdae_paper/configuration/schema.py",
)
"""What pages are and link to; links are relative and the same on GitHub."""

CELL = re.compile(r"<td[^>]*>[^<]*")
NUMBER = re.compile(r"[-+−]?\d[\d.]*e[-+]\d+")


def on_files(files: Files, config: Any) -> Files:
    """Keep what plugins and the theme add, and add the pages where the repository has them."""
    for file in [file for file in files if file.src_dir == config.docs_dir]:
        files.remove(file)
    for path in sorted(path for pattern in PUBLISHED for path in ROOT.glob(pattern)):
        uri = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, uri, abs_src_path=str(path)))
    return files


SITE_ONLY = re.compile(r"<!--site\n(.*?)-->", re.S)
MEMBERS = re.compile(r"^::: (\S+) \[(.*)\]$", re.M)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put in the references that only the site has, which pages keep in a comment."""

    def directives(comment: re.Match[str]) -> str:
        members = r"::: \1\n    options:\n      members: [\2]"
        return re.sub(r"^(?=:::)", "\n", MEMBERS.sub(members, comment[1]), flags=re.M)

    return SITE_ONLY.sub(directives, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Keep numbers such as 2.5e-06 in cells of tables on one line."""

    def kept(cell: re.Match[str]) -> str:
        return NUMBER.sub(r'<span class="number">\g<0></span>', cell[0])

    return CELL.sub(kept, html)
