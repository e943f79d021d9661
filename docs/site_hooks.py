"""MkDocs hooks: pages of the root folder, and links to files that are not below docs.

On GitHub a page links to the repository's files by their relative paths. The site has
the same pages and copies of the files that they link to, so links are led there.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
ROOT_PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")
CELL = re.compile(r"<td[^>]*>[^<]*")
NUMBER = re.compile(r"[-+−]?\d[\d.]*e[-+]\d+")
FENCE = re.compile(r"^(```|~~~).*?^\1", re.M | re.S)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages of the root folder, and copies of what the pages link to."""
    for name, page in ROOT_PAGES.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / name)))
    for page in [file for file in files if file.src_uri.endswith(".md")]:
        for target in _targets(Path(page.abs_src_path).read_text(encoding="utf-8"), page.src_uri):
            uri = _site_uri(target)
            # MkDocs itself names a link without a file.
            if files.get_file_from_path(uri) is None and (ROOT / target).is_file():
                files.append(File.generated(config, uri, abs_src_path=str(ROOT / target)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead relative links to where the site has the file."""
    source = page.file.src_uri
    folder = posixpath.dirname(source)

    def led(match: re.Match[str]) -> str:
        target = _target(match[2], source)
        if target is None:
            return match[0]
        return match[1] + posixpath.relpath(_site_uri(target), folder or ".") + match[3]

    pieces, end = [], 0
    for fence in FENCE.finditer(markdown):
        pieces += [LINK.sub(led, markdown[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join([*pieces, LINK.sub(led, markdown[end:])])


def on_page_content(html: str, **_: Any) -> str:
    """Keep numbers such as 2.5e-06 in cells of tables on one line."""

    def kept(cell: re.Match[str]) -> str:
        return NUMBER.sub(r'<span class="number">\g<0></span>', cell[0])

    return CELL.sub(kept, html)


def _targets(markdown: str, source: str) -> set[str]:
    links = LINK.findall(FENCE.sub("", markdown))
    return {target for _, link, _ in links if (target := _target(link, source)) is not None}


def _target(link: str, source: str) -> str | None:
    """Path of a link's file in the repository; none for other servers."""
    if re.match(r"[a-z]+:", link):
        return None
    of_root = {page: name for name, page in ROOT_PAGES.items()}
    written = of_root.get(source, posixpath.join("docs", source))
    return posixpath.normpath(posixpath.join(posixpath.dirname(written), link))


def _site_uri(target: str) -> str:
    """Where the site has a file of the repository."""
    return ROOT_PAGES.get(target, target.removeprefix("docs/"))
