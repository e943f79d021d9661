"""The real configuration tree: every dataset and preset composes, every mistake is named."""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import yaml

from psfdae.base.files import read_product, write_text
from psfdae.base.settings import ConfigError, NoiseLaw, as_overrides, dump_deciding, leaves
from psfdae.methods import list_groups
from psfdae.methods.networks.training import fingerprint
from psfdae.stars.noise import LAWS
from psfdae.training.settings import from_words
from psfdae_paper.configuration import compose
from psfdae_paper.configuration.compose import config_dir, load, load_settings, load_stage
from psfdae_paper.configuration.consistency import SIMULATION, STATIC
from psfdae_paper.configuration.experiment import load_experiment
from psfdae_paper.stages.stars import stars, templates
from psfdae_paper.workflow import bounds, datasets, experiments
from psfdae_paper.workflow.run import (
    load_dataset_config,
    read_run,
    record_run,
    require_same_run,
    settings,
)
from workflow_runs import captured

DATASETS = sorted({p.stem for p in config_dir().glob("dataset/[!_]*.yaml")} - {"alignment"})


def settings_of(dataset):
    """A dataset in the default preset, composed once for all tests of this file."""
    return load((f"dataset={dataset}",))


# A dataset and its simulation

TINY = "stars.count=40 parts.train_stars=30 parts.test_stars=10 grid.points=3 gmm.components=[1]"


def write_dataset9(folder, text, base="dataset3"):
    """A dataset that changes another one, and the run in which it is built."""
    *choices, values = text.split("---\n")
    defaults = f"# @package _global_\ndefaults:\n  - {base}\n{''.join(choices)}  - _self_\n"
    write_text(folder / "dataset/dataset9.yaml", f"{defaults}{values}\n")
    return read_run({"preset": "smoke", "results": str(folder.parent / "out"), "set": TINY})


@pytest.mark.parametrize(
    ("text", "base", "key", "value", "has_own_static"),
    [
        ("seed: 5", "dataset3", "seed", 5, False),
        ("telescope: {obscuration: 0.1}", "dataset3", "telescope.obscuration", 0.1, True),
        (
            "  - override /telescope: ideal_1m\n---\n",
            "dataset3",
            "telescope.name",
            "ideal_1m",
            True,
        ),
        ("grid: {spacing_deg: 1.0}", "dataset3", "grid.spacing_deg", 1.0, True),
        ("wavefront: {coma: 3.0}", "dataset3", "wavefront.coma", 3.0, True),
        ("wavefront: {r0_m: 0.3}", "dataset7", "wavefront.r0_m", 0.3, True),
        ("framing: {stamp_px: 12}", "dataset3", "framing.stamp_px", 12, True),
        ("optics: {precision: complex128}", "dataset3", "optics.precision", "complex128", True),
        ("stars: {aberration_fraction: 0.3}", "dataset3", "stars.aberration_fraction", 0.3, False),
        (
            "  - override /scene: turbulence\n---\nstars: {aberration_fraction: 0}",
            *("dataset3", "wavefront.kind", "von_karman", True),
        ),
    ],
)
def test_a_group_of_the_simulation_takes_effect_in_a_dataset_s_file(
    config_folder, text, base, key, value, has_own_static
):
    """The products themselves have the value; static PSFs without a change are shared."""
    run = write_dataset9(config_folder, text, base)
    names = [
        (datasets.templates_file(run, d), datasets.stars_file(run, d)) for d in (base, "dataset9")
    ]
    assert names[0][1] != names[1][1]
    assert (names[0][0] != names[1][0]) == has_own_static
    # The settings that the rules give, found by the names of the files.
    file = Path(names[1][1])
    choices = (datasets.scene_choice(run, file.parent.name), datasets.stars_choice(run, file.stem))
    reads = {"templates": STATIC, "stars": SIMULATION}
    static, full = (
        load_settings(Path(settings(run, stage, choice)), reads[stage])
        for stage, choice in zip(reads, choices, strict=True)
    )
    templates(static, config_folder / "t.h5")
    stars(full, config_folder / "t.h5", config_folder / "s.h5")
    for product in ("templates", "stars") if has_own_static else ("stars",):
        config = read_product(config_folder / f"{product[0]}.h5", product).config
        assert dict(leaves(config)).get(key, value) == value
    assert dict(leaves(config))[key] == value
    # The other dataset's files are found as before.
    assert datasets.stars_choice(run, Path(names[0][1]).stem) != "dataset=dataset9"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scene: {name: turbulence}", "scene.name = turbulence: wavefront.kind must be von_karman"),
        ("  - override /scene: turbulence\n---\n", "stars.aberration_fraction = 0.1: must be 0"),
        ("noise: {law: detector}", "law = detector: needs read_noise_e or gain_e above 0"),
        ("noise: {shift_px: 0.5}", "shift_px = 0.5: law poisson does not have it, law correlated"),
        ("noise: {law: detector, gain_e: 300}", "gain_e = 300: must be at most 200"),
        (
            "noise: {law: gaussian}\nmethods: [noisy, wavefront]",
            "methods: wavefront is for Poisson noise only, not for noise.law = gaussian",
        ),
    ],
)
def test_a_group_that_cannot_have_a_value_is_named_in_one_line(config_folder, text, message):
    run = write_dataset9(config_folder, text)
    with pytest.raises(SystemExit) as stop:
        datasets.stars_file(run, "dataset9")
    (line,) = str(stop.value).splitlines()
    assert line.startswith("psfdae: dataset=dataset9: ") and message in line


def test_a_noise_law_reaches_all_stages_and_hides_no_other_law(config_folder, capsys):
    run = write_dataset9(config_folder, "noise: {law: correlated, shift_px: 0.25}")
    assert datasets.stars_file(run, "dataset9") == datasets.stars_file(run, "dataset3")
    warning = capsys.readouterr().err
    assert (
        "dataset=dataset9: noise.law = correlated: gmm, gmm_position assume independent" in warning
    )
    for stage, options in (("evaluate", {}), ("fit", {"name": "dae"})):
        path = settings(run, stage, "dataset=dataset9", **options)
        assert yaml.safe_load(Path(path).read_text())["noise"]["shift_px"] == 0.25
        paper = yaml.safe_load(
            Path(settings(run, stage, "dataset=dataset3", **options)).read_text()
        )
        assert set(paper["noise"]) == {"name", "levels", "kappa", "background_photons"}
    with pytest.raises(ConfigError, match="bounds hold for Poisson noise only, not for"):
        load_stage(("noise",), ["noise.law=gaussian"]).noise.require_poisson("bounds hold")
    assert get_args(NoiseLaw) == tuple(LAWS)


def test_bounds_and_models_of_images_stop_before_any_job_with_another_noise_law():
    run = read_run({"preset": "smoke", "set": "noise.law=gaussian"})
    keys = ("name=a", "levels=[0.01]", "kappa=1", "background_photons=10000", "law=gaussian")
    words = [f"noise.{key}" for key in keys]
    with pytest.raises(SystemExit, match="dataset=dataset3: bounds hold for Poisson noise only"):
        bounds.dataset_files(run, ".csv")
    with pytest.raises(SystemExit, match="dataset=alignment: scene 3 is for Poisson noise only"):
        load_dataset_config(run, "alignment")
    with pytest.raises(ConfigError, match="noise: stars of an image have errors for Poisson noise"):
        from_words(words)


@pytest.mark.parametrize("dataset", sorted({*DATASETS} - {"from_stars"}))
def test_the_paper_s_datasets_share_their_simulation(dataset):
    run = read_run({})
    path = Path(datasets.stars_file(run, dataset))
    config = settings_of(dataset)
    assert path == Path("results/data", config.scene.name, f"{config.stars.name}.h5")
    assert datasets.templates_file(run, dataset) == str(path.with_name("templates.h5"))


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
        if path.parent.name not in ("preset", "sweep", "experiment")
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
    config = load_stage(list_groups("dae"))
    indecisive = {*as_overrides(config.model_dump())} - {*as_overrides(dump_deciding(config))}
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


# Experiments

EXPERIMENT = """
preset: smoke
datasets: [dataset3, dataset7]
overrides: {dataset.splits: [random], train.epochs: 2}
settings:
  paper:
  read_noise: {noise.law: gaussian}
  long: {train.epochs: 3}
seeds: [1, 2]
"""


def test_variants_of_an_experiment_are_datasets_with_overrides(config_folder, tmp_path):
    write_text(config_folder / "experiment/mine.yaml", EXPERIMENT)
    run = read_run({"name": "mine", "results": str(tmp_path / "out")})
    assert (run.preset, len(run.variants)) == ("smoke", 3 * 2 * 2)
    assert read_run({"name": "mine", "preset": "fast"}).overrides == ("preset=fast",)
    variant = run.variants[-1]
    assert (variant.dataset, variant.setting, variant.seed) == ("dataset7", "long", 2)
    config = load_dataset_config(run, variant.name)
    assert (config.train.epochs, config.seed, config.wavefront.seed) == (3, 2, 2)
    assert config.dataset.splits == ["random"]
    # Noise and training have no part in the stars, a seed has.
    stars_files = {v: datasets.stars_file(run, v.name) for v in run.variants}
    of_dataset3 = {v.seed: file for v, file in stars_files.items() if v.dataset == "dataset3"}
    assert {(v.seed, file) for v, file in stars_files.items() if v.dataset == "dataset3"} == set(
        of_dataset3.items()
    )
    assert len({*stars_files.values()}) == 4
    # Static PSFs of scene 1 do not depend on the seed, PSFs of scene 2 do.
    folders = {Path(file).parent.name for file in stars_files.values()}
    assert "seidel" in folders and len(folders) == 3
    # 2 references of dataset 3 and one of dataset 7.
    assert len(experiments.experiment_evaluations(run)) == 3 * 2 * (2 + 1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("dataset7]", "dataset77]", "datasets: dataset77: must be one of dataset1, "),
        ("dataset7]", "alignment]", "datasets: alignment: must be one of dataset1, "),
        ("dataset7]", "dataset3]", "must differ"),
        ("[1, 2]", "[1, 1]", "must differ"),
        (
            "long: {train.epochs: 3}",
            "long: {train.epochs: 2}",
            "settings.long: is the same as paper",
        ),
        ("train.epochs: 3", "seed: 3", "seed: is a key of the experiment itself"),
        ("seeds", "seds", "seds: unknown key"),
    ],
)
def test_mistakes_of_an_experiment_are_named_with_its_file(config_folder, old, new, message):
    path = config_folder / "experiment/mine.yaml"
    write_text(path, EXPERIMENT.replace(old, new))
    with pytest.raises(ConfigError) as error:
        load_experiment("mine")
    assert all(line.startswith(str(path)) for line in str(error.value).splitlines())
    assert message in str(error.value)


def test_an_experiment_leaves_the_run_of_its_folder_alone(config_folder, tmp_path):
    write_text(config_folder / "experiment/mine.yaml", EXPERIMENT)
    for record, words, message in (
        ("preset: smoke\nset: seed=3\n", {"set": "seed=4"}, "with seed=3 and without seed=4"),
        ("preset: fast\nset: ''\n", {}, "with preset=fast and without preset=smoke"),
        ("preset: smoke\nset: seed=3\n", {}, ""),
    ):
        write_text(tmp_path / "out/run.yaml", record)
        run = read_run({"name": "mine", "results": str(tmp_path / "out"), **words})
        if message:
            with pytest.raises(SystemExit, match=message):
                require_same_run(run)
        else:
            require_same_run(run)
            record_run(run)
            assert (tmp_path / "out/run.yaml").read_text() == record
    with pytest.raises(SystemExit, match="which experiment"):
        experiments.experiment_products(read_run({}))
    with pytest.raises(SystemExit, match=r"name = 'min': must be one of .*; did you mean mine"):
        read_run({"name": "min"})


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
