"""The model card: what a bundle says of itself, and what it does not."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
import yaml
from click.testing import CliRunner

from docs_pages import FENCE, read
from psfdae.cli import main
from psfdae.commands.describe import NO_BREAK, SAID, model_card


def card(bundle, **changes):
    """Card of a bundle of which some facts are others."""
    return model_card(replace(bundle, info=bundle.info.model_copy(update=changes)))


def header(text):
    return yaml.safe_load(text.removeprefix("---\n").partition("\n---\n")[0])


@pytest.fixture(scope="module")
def bundle(shipped):
    return shipped.bundle


def test_the_page_is_what_the_command_prints():
    done = CliRunner().invoke(main, ["describe", "--card"])
    assert done.exit_code == 0, done.output
    assert read("docs/model_card.md") == done.output, "make docs renews it"


@pytest.mark.parametrize(
    ("licence", "expected"),
    [
        ("CC-BY-4.0", {"license": "cc-by-4.0"}),
        ("Ask: me\n---", {"license": "other", "license_name": "Ask: me ---"}),
    ],
)
def test_header_names_the_licence_as_hugging_face_knows_it(bundle, licence, expected):
    named = header(card(bundle, licence=licence))
    assert {key: named[key] for key in named if key.startswith("license")} == expected


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


def test_limits_follow_from_the_errors(bundle):
    worse = "the noisy stamp itself has the smaller error"
    assert f"At S/N 1101 {worse}" in card(bundle)
    better = [row for row in bundle.info.metrics if row["mse"] < row["mse_noisy"]]
    assert worse not in card(bundle, metrics=better)
    bare = [{"snr": 5.0, "mse": 1e-5}]
    assert "How often its uncertainties hold." in card(bundle, metrics=bare)
    assert "The file has none." in card(bundle, metrics=[])
    rough = model_card(replace(bundle, scale68=None, scale95=None, flux_error_scale=None))
    assert "hold where flux, sky and noise are given" in rough


def test_a_model_of_an_image_names_the_image_and_what_is_assumed(training):
    bundle = training.model.bundle
    text = " ".join(card(bundle).split())
    assert "bright stars of `image.fits`" in text and "held out of the training" in text
    assert "simulated telescope" not in text and "MIT" not in text
    config = bundle.info.config
    stars = {"telescope": {"assumed": True}, "adapted": {"from": "0" * 64, "stars": 10}}
    config = config | {"stars": config["stars"] | stars}
    text = " ".join(card(bundle, config=config).split())
    assert "The pixel scale was assumed" in text and "adapted" in text


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
