"""Damage to files of the configuration and to that of a trained network: one line, no traceback."""

from __future__ import annotations

import os
import shutil
import time

import numpy as np
import pytest

from command_line import psfdae
from psfdae.files import ProductError
from psfdae.reading import read_csv, read_json, read_table, read_yaml
from psfdae.settings import ConfigError
from psfdae_paper.configuration import compose
from psfdae_paper.configuration.compose import config_dir, forget, load
from psfdae_paper.sweeps.points import SweepError, plan_sweep
from trainings import load_knee

DATASET = ["config"]
SCENE3 = ["alignment", "config", "preset=smoke"]
SHOWN = {
    "config.yaml": DATASET,
    "dataset/dataset3.yaml": DATASET,
    "dataset/_scene1.yaml": DATASET,
    "stars/seidel_10pct.yaml": DATASET,
    "scene/seidel.yaml": DATASET,
    "telescope/wfsat.yaml": DATASET,
    "wavefront/seidel.yaml": DATASET,
    "framing/stamp16.yaml": DATASET,
    "noise/noise3.yaml": DATASET,
    "dae/width16.yaml": DATASET,
    "train/onecycle.yaml": [*DATASET, "--stage", "train"],
    "preset/smoke.yaml": [*DATASET, "preset=smoke"],
    "telescope/example_zernike.yaml": [*DATASET, "dataset=_telescope"],
    "dataset/alignment.yaml": SCENE3,
    "prescription/rc15.yaml": SCENE3,
    "network_train/denoised.yaml": SCENE3,
}
"""Files, and the command that reads each."""

MOST_SECONDS = 20
"""CPU time of a command, which no other load lengthens."""


INSERTED = (
    *(b"\t", b" ", b"  ", b"\n", b":", b": ", b"- ", b"#", b"'", b'"', b"[", b"]", b"{", b"}"),
    *(b"&a ", b"*a ", b"!!python/object:os.system ", b"!!binary ", b"!!int ", b"%", b"@", b"|"),
    *(b"\x00", b"\xff", b"\xc3", b"\xe2\x80\x8b", b"\xef\xbb\xbf", b"\r", b"---\n", b"...\n"),
    *(b"null", b"~", b"1e999", b"-1", b"2024-02-30", b"${seed}", b"${", b"???", b"\xc2\xb2"),
    *(b"[" * 3000, b"9" * 400, b"{a: " * 2000, b"<<: *a\n"),
)
"""What is written somewhere: signs of YAML and OmegaConf, bytes that are no UTF-8, depth."""


def mutants(text: bytes, count: int, seed: int):
    """Yield `count` damaged copies of a file, each damaged once or a few times."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        damaged = text
        for _ in range(rng.integers(1, 4)):
            damaged = _damage(damaged, rng)
        yield damaged


def _damage(text: bytes, rng: np.random.Generator) -> bytes:
    lines = text.split(b"\n")
    place, line = (int(rng.integers(n + 1)) for n in (len(text), len(lines) - 1))
    kind = rng.integers(8)
    if kind <= 2:
        piece = INSERTED[rng.integers(len(INSERTED))]
        return text[:place] + piece + text[place:]
    if kind == 3:
        return text[:place] + text[place + int(rng.integers(1, 20)) :]
    if kind == 4:
        return text[:place]
    if kind == 5:
        return b"\n".join([*lines[:line], lines[line], *lines[line:]])
    if kind == 6:
        indent = [b"\t", b" ", b"    "][rng.integers(3)]
        return b"\n".join([*lines[:line], indent + lines[line], *lines[line + 1 :]])
    flipped = bytearray(text or b"\n")
    flipped[place % len(flipped)] ^= 1 << int(rng.integers(8))
    return bytes(flipped)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A copy of the configuration that commands take instead."""
    shutil.copytree(config_dir(), tmp_path / "config")
    monkeypatch.setenv("PSFDAE_CONFIG", str(tmp_path / "config"))
    forget()
    yield tmp_path / "config"
    forget()


def refused(arguments):
    """Message of a command, empty if it succeeds; the test fails on a traceback or on waiting."""
    started = time.process_time()
    result = psfdae(*arguments)
    assert time.process_time() - started < MOST_SECONDS
    assert result.exit_code in (0, 2), result.output
    return result.output if result.exit_code else ""


@pytest.mark.parametrize(
    ("damage", "place", "message"),
    [
        (b"\n\tlr: 3", "line 4, column 1", "character '\\t'"),
        (b"\nlr : : 3", "line 4, column 6", "mapping values are not allowed here"),
        (b"\nlr: 0.1\nlr: 0.2", "line 5, column 1", "'lr'"),
        (b"\nlr: \xff", "line 4, column 5", "byte 0xff is not UTF-8"),
        (b"\n\xc2\xb2: \x00", "line 4, column 4", "character #x0000"),
        (b"\nlr: [1", "line 5, column 1", "expected ',' or ']'"),
    ],
)
def test_a_mistake_has_file_line_and_column(folder, damage, place, message):
    path = folder / "train/onecycle.yaml"
    path.write_bytes(b"# One.\nepochs: 12\nbatch: 32" + damage + b"\n")
    for arguments in (
        ["config"],
        ["config", "--stage", "train"],
        ["train", "--stars=x", "--out=y"],
    ):
        (line,) = refused(arguments).splitlines()
        assert line.startswith(f"psfdae: {path}: {place}")
        assert message in line


def test_deep_nesting_is_one_line(folder):
    (folder / "train/onecycle.yaml").write_bytes(b"epochs: " + b"[" * 5_000)
    (line,) = refused(["config"]).splitlines()
    assert line == f"psfdae: {folder / 'train/onecycle.yaml'}: nested too deeply"


def test_a_list_is_no_group(folder):
    (folder / "gmm/default.yaml").write_text("- stars\n")
    assert refused(["config"]).startswith("psfdae: config: In 'gmm/default': ")


@pytest.mark.parametrize(
    "count", [2, pytest.param(25, marks=pytest.mark.slow)], ids=["some", "many"]
)
@pytest.mark.parametrize("name", SHOWN)
def test_no_damage_to_the_configuration_is_a_traceback(folder, name, count):
    """400 mutants in all, with the slow ones."""
    path = folder / name
    for damaged in mutants(path.read_bytes(), count, seed=sum(name.encode())):
        path.write_bytes(damaged)
        forget()
        message = refused(SHOWN[name])
        assert message == "" or message.startswith("psfdae: ")


@pytest.mark.parametrize("count", [10, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["sweep/dae_width.yaml", "knee/points.yaml"])
def test_nor_is_damage_to_a_sweep_or_the_knee(folder, name, count):
    path = folder / name
    outcomes = set()
    for damaged in mutants(path.read_bytes(), count, seed=5):
        path.write_bytes(damaged)
        forget()
        try:
            load_knee() if name.startswith("knee") else plan_sweep("dae_width").points
            outcomes.add("read")
        except (ConfigError, SweepError) as error:
            assert str(path) in str(error)
            outcomes.add("refused")
    assert "refused" in outcomes


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A network trained for an epoch, evaluated; and the command lines that read it."""
    folder = tmp_path_factory.mktemp("trained")
    tiny = ["preset=smoke", "grid.points=3", "stars.count=60", "train.epochs=1"]
    tiny += ["parts.train_stars=40", "parts.test_stars=20"]
    t, s, b, dae, other = (str(folder / n) for n in ("t.h5", "s.h5", "b.h5", "dae", "other"))
    out = [f"--out={folder}/e.csv", f"--per-star={dae}/evaluation.parquet"]
    evaluate = ["evaluate", "--dataset=d", f"--stars={s}", f"--pca-som={b}", *out, *tiny]
    evaluate += ["methods=[noisy,pca_som,lmmse,dae]"]
    for step in (
        ["templates", f"--out={t}", *tiny],
        ["stars", f"--templates={t}", f"--out={s}", *tiny],
        ["train", f"--stars={s}", f"--out={dae}", *tiny],
        ["baseline", f"--stars={s}", f"--out={b}", *tiny],
        [*evaluate, f"--dae={dae}"],
    ):
        result = psfdae(*step)
        assert result.exit_code == 0, result.output
    shutil.copytree(dae, other)
    bundle = [
        "bundle",
        f"--stars={s}",
        f"--dae={other}",
        f"--out={folder}/x.psf.safetensors",
        *tiny,
    ]
    return folder / "other", {
        "compare": ["compare", dae, other],
        "evaluate": [*evaluate, f"--dae={other}"],
        "bundle": bundle,
    }


@pytest.mark.parametrize("name", ["compare", "evaluate", "bundle"])
def test_damage_to_a_network_s_configuration_is_one_line(trained, name):
    """Every reader names file, line and column; a tab, the commonest mistake."""
    other, commands = trained
    whole = (other / "config.yaml").read_bytes()
    (other / "config.yaml").write_bytes(whole.replace(b"\n  scale", b"\n\tscale"))
    try:
        (line,) = refused(commands[name]).splitlines()
    finally:
        (other / "config.yaml").write_bytes(whole)
    assert line.startswith(f"psfdae: {other / 'config.yaml'}: line 15, column 1")


def test_a_network_of_other_sizes_is_refused_before_it_is_made(trained):
    other, commands = trained
    whole = (other / "config.yaml").read_text()
    for wrong in ("  - 5\n", "  - 900000000\n"):
        (other / "config.yaml").write_text(whole.replace("  - 4\n", wrong))
        message = refused(commands["evaluate"])
        assert "layers.0.bias" in message or "describes no network" in message
    (other / "config.yaml").write_text(whole)


@pytest.mark.parametrize("count", [15, pytest.param(250, marks=pytest.mark.slow)])
def test_no_damage_to_a_network_s_configuration_is_a_traceback(trained, count):
    other, commands = trained
    whole = (other / "config.yaml").read_bytes()
    seen = []
    for number, damaged in enumerate(mutants(whole, count, seed=3)):
        (other / "config.yaml").write_bytes(damaged)
        for name in ("compare", "evaluate" if number % 5 == 0 else "compare"):
            message = refused(commands[name])
            assert message == "" or message.startswith("psfdae: ")
            seen.append(message)
    (other / "config.yaml").write_bytes(whole)
    assert sum("config.yaml: line" in message for message in seen) > len(seen) // 4


def test_aliases_do_not_multiply(tmp_path):
    lines = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    path = tmp_path / "config.yaml"
    path.write_text("\n".join(["a0: &a0 x", *lines]))
    with pytest.raises(ProductError, match="more than"):
        read_yaml(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [("3: x", "key 3 is no text"), ("- x", "no mapping"), ("a: 2024-01-02", "neither text")],
)
def test_a_network_s_configuration_is_texts_and_numbers(tmp_path, text, message):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ProductError, match=message):
        read_yaml(tmp_path / "config.yaml")


@pytest.mark.parametrize("read", [read_yaml, read_json, read_csv, read_table])
def test_every_reader_names_its_file(tmp_path, read):
    with pytest.raises(ProductError, match=r"none: no such file"):
        read(tmp_path / "none")
    for data in (b"\xff\xfe", b"[" * 5_000, b'"', b"", os.urandom(3000)):
        (tmp_path / "file").write_bytes(data)
        try:
            read(tmp_path / "file")
        except ProductError as error:
            assert str(error).startswith(str(tmp_path / "file"))


def test_a_wrong_value_is_repeated_only_in_part(folder):
    (folder / "train/onecycle.yaml").write_text(f"epochs: {'x' * 10_000}\n")
    with pytest.raises(ConfigError) as refusal:
        load()
    assert len(str(refusal.value).splitlines()[0]) < 400


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
