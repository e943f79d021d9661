"""Data products, the command line, and what counts as a stage's code."""

from __future__ import annotations

import resource
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from psfdae.cli import main
from psfdae.files import Column, ProductError, atomic_path, read_product, write_product


def write(path, values=None):
    values = np.arange(6.0).reshape(2, 3) if values is None else values
    columns = {"a": Column(values, "m", "a length"), "b": Column(values, "m", "the same")}
    write_product(path, "lengths", columns, {"seed": 1})


def test_product_describes_itself(tmp_path):
    path = tmp_path / "p.h5"
    write(path)
    product = read_product(path, "lengths")
    assert (product["b"] == np.arange(6.0).reshape(2, 3)).all()
    assert product.config == {"seed": 1}
    with h5py.File(path) as file:
        assert file["a"].attrs["unit"] == "m"
        assert file.attrs["psfdae_version"]
        assert isinstance(file.get("b", getlink=True), h5py.SoftLink)


def test_same_config_gives_the_same_bytes(tmp_path):
    write(tmp_path / "one.h5")
    time.sleep(1.1)
    write(tmp_path / "two.h5")
    assert (tmp_path / "one.h5").read_bytes() == (tmp_path / "two.h5").read_bytes()


@pytest.mark.parametrize("damage", ["missing", "truncated", "flipped", "text", "kind", "array"])
def test_damaged_product_is_named(tmp_path, damage):
    path = tmp_path / "p.h5"
    write(path, np.random.default_rng(0).random((200, 30)))
    whole = path.read_bytes()
    kind, names = "lengths", None
    if damage == "missing":
        path.unlink()
    elif damage == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
    elif damage == "flipped":
        middle = len(whole) - 3000
        path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    elif damage == "text":
        path.write_text("hello")
    elif damage == "kind":
        kind = "stars"
    else:
        names = ("c",)
    with pytest.raises(ProductError, match=r"p\.h5: "):
        read_product(path, kind, names)


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_help_is_fast_and_imports_nothing_heavy():
    best = min(_seconds(["--help"]) for _ in range(3))
    assert best < 0.5
    code = (
        "import sys; from click.testing import CliRunner; from psfdae.cli import main;"
        "CliRunner().invoke(main, ['--help']);"
        "print([m for m in ('torch','mlflow','hydra','snakemake','numpy','pandas') "
        "if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def _seconds(arguments):
    """CPU time of a command, which a busy machine hardly changes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "psfdae", *arguments], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.parametrize("stage", ["stars", "fit", "evaluate"])
def test_stages_import_only_what_they_need(stage):
    code = (
        f"import sys, psfdae.stages.{stage};"
        "print([m for m in ('torch','mlflow','hydra','snakemake','poppy','batoid') "
        "if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_simulation_never_imports_torch(tmp_path):
    code = (
        "import sys; from pathlib import Path; from psfdae.configuration.compose import load_stage;"
        "from psfdae.stages.stars import templates;"
        "config = load_stage('templates', ['grid.points=3']);"
        f"templates(config, Path({str(tmp_path / 't.h5')!r}));"
        "print([m for m in ('torch','pandas','skimage','sklearn') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


RUN_TINY_STAGES = """
import importlib, pkgutil, sys
from pathlib import Path
import psfdae.stages
from psfdae.configuration.compose import load_stage

unwanted = ("poppy", "batoid", "mlflow", "hydra", "snakemake")
for module in pkgutil.iter_modules(psfdae.stages.__path__):
    importlib.import_module(f"psfdae.stages.{module.name}")
imported = [name for name in unwanted if name in sys.modules]

from psfdae.stages.evaluate import Models, evaluate
from psfdae.stages.fit import baseline, train
from psfdae.stages.stars import stars
from psfdae.stages.stars import templates
tiny = ["preset=smoke", "grid.points=3", "stars.count=60", "parts.train_stars=40",
        "parts.test_stars=12", "train.epochs=1", "dataset=dataset3", "baseline.epochs=1"]
config = {f: load_stage(f.stage.reads, tiny) for f in (templates, stars, baseline, train, evaluate)}
# Composing a configuration is what the command line does; the stages themselves must not.
for name in list(sys.modules):
    if name.partition(".")[0] in unwanted:
        del sys.modules[name]
made = {name: Path(sys.argv[1], name) for name in ("t", "s", "pca_som", "dae", "csv", "per_star")}
templates(config[templates], made["t"])
stars(config[stars], made["t"], made["s"])
baseline(config[baseline], made["s"], out=made["pca_som"])
train(config[train], made["s"], out=made["dae"])
evaluate(config[evaluate], "dataset3", made["s"],
         Models(pca_som=made["pca_som"], dae=made["dae"]),
         per_star=made["per_star"], out=made["csv"])
print(imported, [name for name in unwanted if name in sys.modules])
"""


def test_stages_never_load_heavy_packages(tmp_path):
    """Neither importing nor running the stages of scenes 1 and 2 loads what they do without."""
    command = [sys.executable, "-c", RUN_TINY_STAGES, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[] []"


def test_wrong_config_is_one_message_and_exit_code_2(tmp_path):
    out = str(tmp_path / "t.h5")
    result = CliRunner().invoke(main, ["templates", "--out", out, "telescope.wavelength_m=-1"])
    assert result.exit_code == 2
    assert result.output.startswith("psfdae: telescope.wavelength_m = -1: ")
    assert not (tmp_path / "t.h5").exists()


def test_missing_input_is_one_message_and_exit_code_2(tmp_path):
    arguments = ["stars", "--templates", "none.h5", "--out", str(tmp_path / "s.h5")]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2
    assert result.output == "psfdae: none.h5: no such file\n"


def test_config_command_prints_a_stage_s_groups():
    result = CliRunner().invoke(main, ["config", "--stage", "train", "train.lr=0.001"])
    assert result.exit_code == 0
    assert "lr: 0.001" in result.output
    assert "telescope" not in result.output
