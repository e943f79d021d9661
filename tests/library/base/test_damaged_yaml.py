"""Damage to files of the configuration: one line, no traceback."""

from __future__ import annotations

import pytest

from command_line import refused as refusal
from psfdae.base.files import ProductError
from psfdae.base.reading import read_yaml

GOOD = b"# @package _global_\ntrain:\n  epochs: 12"
PRESET = "preset/fast.yaml"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        (PRESET, GOOD + b"\n\tlr: 3", ("line 4, column 1", "'\\t'")),
        (PRESET, GOOD + b"\n  lr: 0.1\n  lr: 0.2", ("line 5, column 3", "'lr'")),
        (PRESET, GOOD + b"\n  lr: \xff", ("line 4, column 7", "0xff")),
        (PRESET, b"train:\n  epochs: " + b"[" * 1000, (PRESET, "nested too deeply")),
        (PRESET, GOOD.replace(b"12", b"x" * 10_000), ("train.epochs",)),
        (PRESET, b"- stars\n", ("preset: unknown key",)),
    ],
)
def test_a_mistake_is_one_short_line_with_its_place(config_folder, name, content, words):
    (config_folder / name).write_bytes(content)
    line = refusal("config")
    assert all(word in line for word in words), line
    assert len(line) < 500
    if name == PRESET:
        assert refusal("fit", "dae", "--stars=x", "--out=y") == line


def test_a_configuration_runs_no_code(tmp_path):
    (tmp_path / "config.yaml").write_text("!!python/object/apply:os.getpid []")
    with pytest.raises(ProductError, match=r"config\.yaml: line 1, .*python"):
        read_yaml(tmp_path / "config.yaml")
