"""Stage `docs`: pages whose numbers all come from the run of record."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from psfdae.files import write_text


def run(reference: Path, templates: Path, root: Path) -> list[Path]:
    """Render every `*.j2` template below a folder.

    Templates see `csv(name)`, a table of the run of record as a list of rows;
    `table(name)`, one of its Markdown files; and `provenance`. Numbers are
    formatted in the template, never typed.

    Parameters
    ----------
    reference : folder of the run of record
    templates : folder of the templates; their relative path names the page
    root : folder below which the pages are written

    Returns
    -------
    list of Path
        The pages.
    """
    pages = render(reference, templates)
    for name, text in pages.items():
        write_text(root / name, text)
    return [root / name for name in pages]


def render(reference: Path, templates: Path) -> dict[str, str]:
    """Pages by name, as `run` writes them."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(templates),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,
    )
    environment.filters["sci"] = lambda value, digits=2: f"{float(value):.{digits}e}"
    environment.filters["fixed"] = lambda value, digits=2: f"{float(value):.{digits}f}"
    context = {
        "csv": lambda name: _rows(reference / name),
        "table": lambda name: (reference / name).read_text(encoding="utf-8").strip(),
        "provenance": json.loads((reference / "provenance.json").read_text()),
    }
    return {
        name.removesuffix(".j2"): environment.get_template(name).render(context)
        for name in environment.list_templates(extensions=["j2"])
    }


def _rows(path: Path) -> list[dict[str, Any]]:
    import pandas as pd

    return pd.read_csv(path).to_dict("records")
