"""The real configuration tree: every dataset and preset composes, every mistake is named."""

from __future__ import annotations

import os
import re
import shutil
import sys

import numpy as np
import pytest
import yaml

from psfdae.base.settings import ConfigError, as_overrides, dump_deciding, leaves
from psfdae.methods import list_groups
from psfdae.methods.networks.training import fingerprint
from psfdae_paper.configuration import compose
from psfdae_paper.configuration.compose import config_dir, load, load_stage
from psfdae_paper.configuration.consistency import SIMULATION, compare_simulations
from psfdae_paper.workflow.datasets import stars_choice
from workflow_runs import captured

DATASETS = sorted({p.stem for p in config_dir().glob("dataset/[!_]*.yaml")} - {"alignment"})


def settings_of(dataset):
    """A dataset in the default preset, composed once for all tests of this file."""
    return load((f"dataset={dataset}",))


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("telescope=ideal_1m", "telescope.name"),
        ("telescope.obscuration=0.2", "telescope.obscuration"),
        ("grid.points=7", "grid.points"),
        ("wavefront.coma=3", "wavefront.coma"),
        ("framing.jitter_px=0", "framing.jitter_px"),
        ("optics.pupil_samples=[256]", "optics.pupil_samples"),
        ("stars.aberration_fraction=0.3", "stars.aberration_fraction"),
        ("seed=5", "seed"),
    ],
)
def test_a_dataset_with_another_simulation_than_its_stars_is_named(override, key):
    """Datasets share the stars of a file: a change in a dataset alone would have no effect."""
    changes = compare_simulations(
        compose.compose(("dataset=dataset3", override)), compose.compose(("dataset=dataset1",))
    )
    assert key in [name for name, *_ in changes]
    assert all(name.startswith(key.split(".")[0]) for name, *_ in changes)


@pytest.mark.parametrize("dataset", sorted({*DATASETS} - {"from_stars"}))
def test_datasets_have_the_simulation_of_their_stars(dataset):
    tree = compose.compose((f"dataset={dataset}",))
    first = compose.compose((stars_choice(tree["stars"]["name"]),))
    assert not compare_simulations(tree, first)


@pytest.mark.parametrize("dataset", DATASETS)
def test_every_dataset_composes_as_its_file(dataset):
    config = settings_of(dataset)
    assert config.dataset.name == dataset


def files_of_a_dataset(dataset):
    """The files that a dataset is composed of, weakest first, and the text of each."""
    own = config_dir() / f"dataset/{dataset}.yaml"
    defaults = yaml.safe_load(own.read_text(encoding="utf-8"))["defaults"]
    groups = [entry for entry in defaults if isinstance(entry, dict)]
    named = [
        config_dir() / f"{k.strip('/')}/{v}.yaml" for group in groups for k, v in group.items()
    ]
    return [config_dir() / "config.yaml", *named, own]


@pytest.mark.parametrize("dataset", [*DATASETS, "alignment", "_telescope"])
def test_the_value_of_a_key_is_in_the_dataset_s_file_one_that_it_names_or_the_root(dataset):
    """Whoever looks for a value opens two files, and finds the key with the value that is used."""
    written = {}
    for path in files_of_a_dataset(dataset):
        tree = yaml.load(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
        tree.pop("defaults", None)
        written |= dict(leaves({"telescope": tree} if path.parent.name == "telescope" else tree))
    composed = dict(leaves(compose.compose((f"dataset={dataset}",))))
    # Groups that scene 3 does not read have the defaults of their classes.
    unread = ("framing", "parts", "dataset") if dataset == "alignment" else ()
    missing = [k for k in composed.keys() - written.keys() if k.partition(".")[0] not in unread]
    assert not missing
    for key, value in written.items():
        if not str(value).startswith("${"):
            assert composed[key] == value or composed[key] == float(value), key


@pytest.mark.parametrize(
    "path",
    [
        path.relative_to(config_dir()).as_posix()
        for path in sorted(config_dir().rglob("*.yaml"))
        if path.parent.name not in ("preset", "sweep")
    ],
)
def test_every_key_has_a_comment(path):
    """On its line, above it, or above the group of numbers that it is one of."""
    lines = (config_dir() / path).read_text(encoding="utf-8").splitlines()
    bare = [
        line
        for before, line in zip(["", *lines], lines, strict=False)
        if re.match(r" *\w+: *[^ #]", line)
        and "#" not in line
        and not before.lstrip().startswith("#")
    ]
    assert not bare


def test_the_folder_has_few_files_and_a_short_page():
    assert len([*config_dir().rglob("*.yaml")]) <= 30
    assert len((config_dir() / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_settings_of_the_paper():
    bands = {1: [3e-5, 5e-5, 7e-5, 9e-5], 2: [3e-4, 5e-4, 7e-4, 9e-4], 3: [1e-3, 2e-3, 3e-3, 5e-3]}
    for number in range(1, 7):
        config = settings_of(f"dataset{number}")
        assert config.noise.levels == bands[(number - 1) % 3 + 1]
        assert config.stars.aberration_fraction == (0.1 if number <= 3 else 0.5)
        assert config.stars.count == 8405
    config = load(["preset=paper"])
    assert (config.train.epochs, config.train.batch, config.train.lr) == (100, 125, 5e-5)
    assert config.dae.kernels == [9, 7, 5, 3, 1, 1, 3, 5, 7, 9]
    assert config.baseline.epochs == 200


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("noise.levels=[0.001,0]", r"noise\.levels\.1 = 0: .*greater than 0"),
        ("parts.train_stars=9000", r"= 10681: must be at most stars\.count = 8405"),
        ("train.lr=fast", r"train\.lr = 'fast': .*valid number"),
        ("dae.widths=[8,8]", r"dae: widths = \[8, 8\]: 10 kernels need 9 widths"),
        ("+train.momentum=0.9", r"train\.momentum: unknown key"),
        ("train.lrr=1", r"^train\.lrr: unknown key; did you mean train\.lr\?$"),
        ("snr_min=20", r"^snr_min: unknown key; did you mean calibration_stars\.snr_min\?$"),
        ("preset=fsat", "^preset=fsat: no such option; .*smoke.*; did you mean fast"),
        ("trian=onecycle", r"^trian: unknown key; did you mean train\?$"),
        ("train.lr", "^train.lr: expected key=value"),
        ("trian.lr=0.1", r"trian\.lr"),
        ("noise.levels=[0.1", r"no viable alternative at input"),
    ],
)
def test_every_mistake_is_named(override, message):
    with pytest.raises(ConfigError, match=message):
        load([override])


def test_a_stage_refuses_an_unknown_group_and_a_folder_without_a_root(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="colour: unknown key"):
        load_stage(list_groups("dae"), ["+colour=blue"])
    monkeypatch.setenv("PSFDAE_CONFIG", str(tmp_path))
    with pytest.raises(ConfigError, match=r"no config\.yaml"):
        config_dir()


def test_search_distances_follow_from_the_telescope():
    """21, 38, 42 and 56 λ/D are what the stars need; whole pixels of the default telescopes."""
    expected_px = {f"dataset{n}": 24 for n in (1, 2, 3, 7, 8)}
    expected_px |= {"dataset4": 64, "dataset5": 64, "dataset6": 64, "field": 48}
    for dataset, px in expected_px.items():
        config = settings_of(dataset)
        assert (config.framing.search_px, config.stars.search_px) == (24, px)
        assert "search_lambda_d" not in config.model_dump()["stars"]
    stated = load(
        ["telescope.pixel_scale_arcsec=0.01", "framing.search_px=100", "stars.search_lambda_d=5"]
    )
    assert (stated.framing.search_px, stated.stars.search_px) == (100, 57)


def test_settings_that_cannot_change_a_result_are_set_apart():
    tree = compose.select_stage_groups(list_groups("dae"), compose.compose())
    indecisive = {*as_overrides(tree)} - {*as_overrides(compose.drop_neutral_settings(tree))}
    assert [text.split(".", 1)[1] for text in indecisive] == ["checkpoint_seconds=20.0"]

    def checkpoint(*overrides):
        return fingerprint(dump_deciding(load(overrides).train), np.zeros(3))

    assert checkpoint("train.checkpoint_seconds=3") == checkpoint() != checkpoint("train.lr=0.003")


def test_a_file_of_settings_is_named_by_what_decides_a_result(tmp_path):
    reads = ("seed", "noise", "parts", "dae", "train")

    def written(*overrides):
        tree = compose.compose(("preset=smoke", *overrides))
        return compose.write_settings(tmp_path, "fit", reads, tree)

    path = written()
    assert written("train.checkpoint_seconds=1.5") == path
    given = ("preset=smoke", "train.checkpoint_seconds=1.5")
    assert compose.load_settings(path, reads) == load_stage(reads, given)
    assert written("train.lr=1e-3") != path


def test_overrides_reach_the_datasets_that_know_them():
    overrides = ["wavefront.coma=3", "++wavefront.r0_m=0.1", "wavefront.colour=1"]
    common = ["wavefront.colour=1"]
    for dataset, scene_override in (
        ("dataset3", "wavefront.coma=3"),
        ("dataset8", "++wavefront.r0_m=0.1"),
    ):
        dataset_overrides = compose.select_overrides(overrides, [f"dataset={dataset}"])
        assert dataset_overrides == (scene_override, *common)
    # Another telescope decides which keys there are.
    overrides = ["telescope=example_zernike", "telescope.aberrations.jitter_waves=0.1"]
    assert compose.select_overrides(overrides, ["dataset=dataset8"]) == tuple(overrides)


def test_stage_overrides_reproduce_the_stage_s_configuration():
    """Words that the workflow puts on a command line mean what the dataset meant."""
    # Options that differ in their keys are chosen by name, then every key is pinned.
    own_telescope = ("dataset=_telescope", "telescope=example_raytraced")
    for names, overrides in (
        ((), ("dataset=dataset5", "preset=smoke")),
        (own_telescope, own_telescope),
    ):
        tree = compose.select_stage_groups(SIMULATION, compose.compose(overrides))
        pinned = [*names, *as_overrides(tree)]
        assert load_stage(SIMULATION, pinned) == load_stage(SIMULATION, overrides)


DATASET = (
    "# @package _global_\ndefaults:\n  - {base}\n  - _self_\nseed: {seed}\n"
    "dataset:\n  name: mine{seed}\nnoise:\n  levels: [{seed}.0e-4, 2e-3]\n"
)


def test_a_dataset_is_one_small_file(config_folder):
    for seed in (1, 2):
        text = DATASET.format(base=f"dataset{3 + seed % 2}", seed=seed)
        (config_folder / f"dataset/mine{seed}.yaml").write_text(text)
        config = load([f"dataset=mine{seed}", "preset=fast"])
        assert (config.seed, config.dataset.name) == (seed, f"mine{seed}")
        assert config.noise.levels == [float(f"{seed}e-4"), 2e-3]
        assert config.stars.name == ("seidel_50pct" if seed % 2 else "seidel_10pct")


@pytest.mark.slow
def test_an_installed_wheel_finds_its_configuration(tmp_path):
    """Somebody else's Hydra project beside it is not ours."""
    root, site = config_dir().parent, tmp_path / "site"
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    assert captured(build, cwd=root).returncode == 0
    shutil.unpack_archive(*tmp_path.glob("*.whl"), site, format="zip")
    (site / "config").mkdir()
    (site / "config/config.yaml").write_text("colour: blue\n")
    environment = {key: value for key, value in os.environ.items() if key != "PSFDAE_CONFIG"}
    for words in (("config", "--stage", "fit"), ("config", "dataset=alignment")):
        line = [sys.executable, "-m", "psfdae", *words]
        installed, source = (
            captured(line, cwd=tmp_path, env={**environment, "PYTHONPATH": str(path)})
            for path in (site, root / "src")
        )
        assert installed.stdout == source.stdout
        assert "checkpoint_seconds: 20.0" in source.stdout
