"""Tables for readers: errors of all methods side by side, as Markdown, LaTeX and HTML.

Inputs: tables of numbers. Outputs: tables of texts, and files of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd

from psfdae.base.files import write_text
from psfdae.methods import method
from psfdae_paper.configuration.methods import list_methods
from psfdae_paper.evaluation.measure import CELL
from psfdae_paper.evaluation.paper import read_paper_names, read_published

Note = Annotated[str, "How the run differs from the paper's; empty if it does not."]
"""Option of commands that draw or tabulate errors beside the paper's."""

PAGE_ROWS = 40
"""Rows that fit on a page; longer tables of LaTeX may break."""

LATEX_SIGNS = {"λ": r"$\lambda$", "±": r"$\pm$", "×": r"$\times$", "10⁶": "$10^6$", "−": "$-$"}
"""Signs of the texts that LaTeX has in mathematics."""

PAGE = """<!DOCTYPE html>
<html lang="en"><meta charset="utf-8"><style>
body {{ font: 14px sans-serif; margin: 1.5em; }}
table {{ border-collapse: collapse; }}
th, td {{ border: 1px solid #ccc; padding: .2em .5em; text-align: right; white-space: nowrap; }}
th, td:first-child {{ background: #f2f2f2; }}
p.note {{ color: #b00020; font-weight: bold; }}
</style>
{}
</html>
"""
"""Page that holds tables; it needs no other file."""


def format_error(value: float, stderr: float) -> str:
    """Return a number with its standard error, both to two digits of the latter."""
    if not np.isfinite(stderr) or stderr <= 0.0:
        return "" if not np.isfinite(value) else f"{value:.4g}"
    # Decimals up to the second digit of the standard error.
    decimals = max(0, 1 - int(np.floor(np.log10(stderr))))
    return f"{value:.{decimals}f} ± {stderr:.{decimals}f}"


def tabulate_methods(metrics: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Return the errors of all methods side by side, and the paper's beside them.

    Parameters
    ----------
    metrics : DataFrame
        Tidy rows of the stage `collect`, with the columns value, stderr and seed_stderr.
    metric : str
        "mse", in millionths, or "ssim".

    Returns
    -------
    DataFrame
        A row for each dataset, split, reference and noise level; a column of texts for each method,
        and for each method of the paper, whose values do not depend on the reference. The standard
        error is of the test stars and of the seeds, as far as the latter was measured.
    """
    unit = 1e6 if metric == "mse" else 1.0
    rows = metrics[metrics.metric == metric]
    stderr = unit * np.hypot(rows["stderr"], rows["seed_stderr"].fillna(0.0))
    texts = [format_error(v, e) for v, e in zip(unit * rows["value"], stderr, strict=True)]
    table = rows.assign(text=texts).pivot(index=CELL, columns="method", values="text").fillna("")
    # Methods in the order of the configuration, others after them.
    order = [kind.name for kind in list_methods()]
    columns = sorted(table.columns, key=lambda n: order.index(n) if n in order else len(order))
    table = table[columns].rename(columns=lambda name: method(name).look.label)
    # The paper's values of the same dataset and noise level, for test stars of all fields.
    paper = read_published("psf")
    paper = paper[paper.metric == metric].replace({"method": read_paper_names()})
    values = paper.set_index(["dataset", "noise_level", "method"])["value"]
    for name in dict.fromkeys(paper["method"]):
        table[f"{method(name).look.label.partition(' (')[0]}, paper"] = [
            f"{unit * values[dataset, level, name]:.4g}"
            if split == "random" and (dataset, level, name) in values.index
            else ""
            for dataset, split, _, level in table.index
        ]
    table = table.reset_index().rename(columns={"noise_level": "λ"})
    table["λ"] = table["λ"].map("{:g}".format)
    table.columns.name = None
    return table


def write_tables(
    tables: Mapping[Path, tuple[str, pd.DataFrame]], page: Path, note: str = ""
) -> None:
    """Write tables of texts as Markdown and LaTeX, and all of them as one page of HTML.

    Parameters
    ----------
    tables : mapping
        Title and texts of each table by a path; the endings of its files are .md and .tex.
        The title is the line above the table, and the caption in LaTeX.
    page : Path
        HTML page.
    note : str
        How the run differs from the paper's; empty if it does not.
    """
    parts = [f'<p class="note">{escape(note)}</p>'] if note else []
    for path, (title, table) in tables.items():
        markdown = table.to_markdown(index=False, disable_numparse=True)
        heading = f"{title}\n\n**{note}**" if note else title
        write_text(path.with_suffix(".md"), f"{heading}\n\n{markdown}\n")
        # LaTeX escapes the texts; signs that need mathematics follow.
        caption = f"{title.rstrip('.')}. {note}".rstrip(". ")
        caption = caption.replace("_", r"\_").replace("%", r"\%")
        is_long = len(table) > PAGE_ROWS
        latex = table.to_latex(index=False, escape=True, caption=caption, longtable=is_long)
        for sign, command in LATEX_SIGNS.items():
            latex = latex.replace(sign, command)
        write_text(path.with_suffix(".tex"), latex)
        parts += [f"<h3>{escape(title)}</h3>", table.to_html(index=False, border=0)]
    write_text(page, PAGE.format("\n".join(parts)))
