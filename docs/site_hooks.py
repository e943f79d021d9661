"""MkDocs hooks: the site's files lie as in the repository."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))
from page_tables import insert_tables  # noqa: E402

PUBLISHED = (
    *("*.md", "LICENSE", "CITATION.cff", "config/*.md"),
    *("docs/*.md", "docs/*.ipynb", "docs/*.css", "docs/*.js", "docs/figures/*.png"),
    "docs/trained_kernel.py",
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
        # The page of a notebook stands beside the notebook itself, which readers can download.
        if path.suffix == ".ipynb":
            page_uri = uri.replace(".ipynb", ".md")
            files.append(File.generated(config, page_uri, content=notebook_page(path)))
    return files


TABLE_CLASS = re.compile(r'(?<=<table) class="[^"]*"')


def notebook_page(path: Path) -> str:
    """Return a notebook as Markdown: its text, its code, and what the code shows."""
    parts = [f"[Download this notebook]({path.name})"]
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        is_code = cell["cell_type"] == "code"
        parts.append(f"```python\n{source}\n```" if is_code else source)
        for output in cell.get("outputs", []):
            # Of the forms of an output, the richest one. HTML on one line is a block of Markdown,
            # and tables without a class look like those of other pages.
            forms = {name: "".join(lines) for name, lines in output.get("data", {}).items()}
            if "image/png" in forms:
                parts.append(f"![Figure](data:image/png;base64,{forms['image/png']})")
            elif "text/html" in forms:
                html = TABLE_CLASS.sub("", forms["text/html"]).replace("\n", "")
                parts.append(f"<div>{html}</div>")
            else:
                text = forms.get("text/plain") or "".join(output.get("text", []))
                parts.append(f"```text\n{text.rstrip()}\n```")
    # The title comes first.
    parts[:2] = parts[1::-1]
    return "\n\n".join(parts) + "\n"


SITE_ONLY = re.compile(r"<!--site\n(.*?)-->", re.S)
MEMBERS = re.compile(r"^::: (\S+) \[(.*)\]$", re.M)


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Insert the references and tables of the site, and link notebooks as the pages they are."""

    def directives(comment: re.Match[str]) -> str:
        # Methods of the base classes are members, too.
        members = r"::: \1\n    options:\n      members: [\2]\n      inherited_members: true"
        return re.sub(r"^(?=:::)", "\n", MEMBERS.sub(members, comment[1]), flags=re.M)

    # The page of a notebook, which is made in memory, links the file itself.
    if page.file.abs_src_path:
        markdown = markdown.replace(".ipynb)", ".md)")
        markdown = insert_tables(markdown, Path(page.file.abs_src_path))
    return SITE_ONLY.sub(directives, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Keep numbers such as 2.5e-06 in cells of tables on one line."""

    def kept(cell: re.Match[str]) -> str:
        return NUMBER.sub(r'<span class="number">\g<0></span>', cell[0])

    return CELL.sub(kept, html)
