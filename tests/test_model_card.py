"""The model card: what a bundle says of itself, and what it does not."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from command_line import psfdae
from docs_pages import FENCE, read
from psfdae.commands.describe import NO_BREAK, SAID, model_card


def card(bundle, **changes):
    """Card of a bundle of which some facts are others."""
    return model_card(replace(bundle, info=bundle.info.model_copy(update=changes)))


@pytest.fixture(scope="module")
def bundle(shipped):
    return shipped.bundle


def test_the_page_is_what_the_command_prints():
    done = psfdae("describe", "--card")
    assert done.exit_code == 0, done.output
    assert read("docs/model_card.md") == done.output, "make docs renews it"


def test_table_is_the_metrics_and_every_column_is_explained(bundle):
    text = card(bundle).partition("## Errors by S/N")[2].partition("\n## ")[0]
    head, _, *rows = (line.strip("| ").split(" | ") for line in text.splitlines() if "|" in line)
    assert set(head) <= set(SAID) and all(f"- {name}: " in text for name in head)
    found = {name: [row[i] for row in rows] for i, name in enumerate(head)}
    for name, key in (("MSE", "mse"), ("S/N", "snr")):
        expected = [row[key] for row in bundle.info.metrics]
        assert [float(value) for value in found[name]] == pytest.approx(expected, rel=1e-2)
    covered = [100 * row["coverage68"] for row in bundle.info.metrics]
    assert [float(v.rstrip("%")) for v in found["in error68"]] == pytest.approx(covered, abs=0.1)


def outside(text):
    """A page without its code."""
    return re.sub(r"`[^`\n]*`", "", FENCE.sub("", text))


def test_no_text_of_a_file_becomes_markdown(bundle):
    hostile = f"x` <script> | ``` \n# y\n---{30 * ' # z'}"
    config = bundle.info.config | {hostile: {hostile: hostile}, "``` \n": 1}
    text = card(bundle, name=hostile, licence=hostile, config=config)
    plain = f"x' <script> | ''' # y ---{30 * ' # z'}".replace(" ", NO_BREAK)
    assert f"# Model card of `{plain}`\n" in text
    titles = [line for line in text.splitlines() if line.startswith("#")]
    assert len(titles) == 1 + 7 and text.splitlines().count("---") == 2
    assert len(FENCE.findall(text)) == 2
    assert "x\\` \\<script\\> \\|" in text and not re.search(r"(?<!\\)<script", outside(text))
