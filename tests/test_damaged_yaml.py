"""Damage to files of the configuration: one line, no traceback."""

from __future__ import annotations

import contextlib
import os
import shutil

import numpy as np
import pytest

from command_line import refused as refusal
from psfdae.files import ProductError
from psfdae.reading import read_csv, read_json, read_table, read_yaml
from psfdae.settings import ConfigError
from psfdae_paper.configuration import compose
from psfdae_paper.configuration.compose import config_dir, forget, load
from psfdae_paper.sweeps.points import SweepError, plan_sweep
from trainings import load_knee

SCENE3 = ["dataset=alignment", "preset=smoke"]
READERS = {
    "config.yaml": load,
    "dataset/dataset3.yaml": load,
    "preset/smoke.yaml": lambda: load(["preset=smoke"]),
    "prescription/rc15.yaml": lambda: load(SCENE3),
    "sweep/dae_width.yaml": lambda: plan_sweep("dae_width").points,
    "knee/points.yaml": load_knee,
}
"""Files of the configuration, and what reads each."""

INSERTED = (
    *(b"\t", b"\n", b": ", b"- ", b"'", b"[", b"{", b"<<: *a\n", b"!!python/object:os.system "),
    *(b"\x00", b"\xff", b"\xef\xbb\xbf", b"---\n", b"1e999", b"2024-02-30", b"${", b"9" * 400),
)
"""Signs of YAML and OmegaConf, and bytes that are no UTF-8."""


def damaged_copies(text, count, seed):
    """Yield copies of a file with a piece inserted, and those with a few bytes lost."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        place = int(rng.integers(len(text)))
        yield text[:place] + INSERTED[rng.integers(len(INSERTED))] + text[place:]
        yield text[:place] + text[place + int(rng.integers(1, 20)) :]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A copy of the configuration that commands take instead."""
    shutil.copytree(config_dir(), tmp_path / "config")
    monkeypatch.setenv("PSFDAE_CONFIG", str(tmp_path / "config"))
    forget()
    yield tmp_path / "config"
    forget()


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
def test_a_mistake_is_one_short_line_with_its_place(folder, name, content, words):
    (folder / name).write_bytes(content)
    line = refusal("config")
    assert all(word in line for word in words), line
    assert len(line) < 500
    if name == TRAIN:
        assert refusal("train", "--stars=x", "--out=y") == line


@pytest.mark.parametrize("count", [1, pytest.param(12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", READERS)
def test_no_damage_to_the_configuration_is_another_error(folder, name, count):
    path = folder / name
    for damaged in damaged_copies(path.read_bytes(), count, seed=sum(name.encode())):
        path.write_bytes(damaged)
        forget()
        with contextlib.suppress(ConfigError, SweepError):
            READERS[name]()


ALIASES = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("3: x", "key 3"),
        ("- x", "no mapping"),
        ("a: 2024-01-02", "neither text"),
        ("!!python/object/apply:os.getpid []", "python"),
        ("\n".join(["a0: &a0 x", *ALIASES]), "more than"),
    ],
)
def test_a_network_s_configuration_is_texts_and_numbers(tmp_path, text, words):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ProductError, match=rf"config\.yaml: .*{words}"):
        read_yaml(tmp_path / "config.yaml")


@pytest.mark.parametrize("read", [read_yaml, read_json, read_csv, read_table])
def test_every_reader_names_its_file(tmp_path, read):
    with pytest.raises(ProductError, match=r"none: no such file"):
        read(tmp_path / "none")
    for data in (b"\xff\xfe", b"[" * 1200, b'"', b"", os.urandom(3000)):
        (tmp_path / "file").write_bytes(data)
        try:
            read(tmp_path / "file")
        except ProductError as error:
            assert str(error).startswith(str(tmp_path / "file"))


def test_a_kept_composition_is_whole_and_up_to_date(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(compose, "KEPT", [tmp_path / "kept"])
    first = load()
    (kept,) = (tmp_path / "kept").iterdir()
    forget()
    with monkeypatch.context() as patch:
        patch.setattr(compose, "_by_hydra", None)
        assert load() == first
    kept.write_bytes(kept.read_bytes().replace(b"0", b"1", 1))
    forget()
    assert load() == first
    path = folder / "config.yaml"
    path.write_text(path.read_text().replace(f"seed: {first.seed}", "seed: 7"))
    forget()
    assert load().seed == 7
