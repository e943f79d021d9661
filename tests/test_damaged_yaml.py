"""Damage to files of the configuration: one line, no traceback."""

from __future__ import annotations

import pytest

from command_line import refused as refusal
from psfdae.base.files import ProductError
from psfdae.base.reading import read_yaml

GOOD = b"# One.\nepochs: 12\nbatch: 32"
TRAIN = "train/onecycle.yaml"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        (TRAIN, GOOD + b"\n\tlr: 3", ("line 4, column 1", "'\\t'")),
        (TRAIN, GOOD + b"\nlr: 0.1\nlr: 0.2", ("line 5, column 1", "'lr'")),
        (TRAIN, GOOD + b"\nlr: \xff", ("line 4, column 5", "0xff")),
        (TRAIN, b"epochs: " + b"[" * 1000, (TRAIN, "nested too deeply")),
        (TRAIN, b"epochs: " + b"x" * 10_000, ("train.epochs",)),
        ("gmm/default.yaml", b"- stars\n", ("gmm/default",)),
    ],
)
def test_a_mistake_is_one_short_line_with_its_place(config_folder, name, content, words):
    (config_folder / name).write_bytes(content)
    line = refusal("config")
    assert all(word in line for word in words), line
    assert len(line) < 500
    if name == TRAIN:
        assert refusal("fit", "dae", "--stars=x", "--out=y") == line


def test_a_configuration_runs_no_code(tmp_path):
    (tmp_path / "config.yaml").write_text("!!python/object/apply:os.getpid []")
    with pytest.raises(ProductError, match=r"config\.yaml: line 1, .*python"):
        read_yaml(tmp_path / "config.yaml")
