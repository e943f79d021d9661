"""Products that do not belong together: one line with both values, and nothing is written."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

import prediction
import trainings
from psfdae.belonging import STARS, STATIC, require
from psfdae.cli import Careful, as_click, main, stage
from psfdae.files import Column, ProductError, write_product
from psfdae.model.bundle import read_bundle, shipped_path
from psfdae_paper.configuration.compose import load, load_stage
from psfdae_paper.stages.alignment import read_model
from psfdae_paper.stages.alignment_results import require_one_test

SIZES = ("preset=smoke", "grid.points=3", "stars.count=60", "parts.train_stars=40")
SIZES += ("parts.test_stars=20", "optics.threads=1", "train.epochs=1", "bounds.threads=1")
SMALL = ("telescope.pixel_scale_arcsec=0.15", *SIZES)


def psfdae(*words):
    """Run a command of ours, or one of a program, which begins with its function."""
    first, *rest = words
    group = Careful(commands=[as_click(first)]) if callable(first) else main
    name = first.stage.name if callable(first) else first
    return CliRunner().invoke(group, [name, *map(str, rest)])


def done(*words):
    result = psfdae(*words)
    assert result.exit_code == 0, result.output


def refused(folder, *words, file, key, values):
    """The command ends in one line that names file, key and both values, and writes nothing."""
    before = sorted(folder.rglob("*"))
    result = psfdae(*words)
    assert result.exit_code == 2, result.output
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    assert f"{file}: {key} = {values[0]}, but " in result.stderr, result.stderr
    assert result.stderr.rstrip().endswith(f" has {values[1]}"), result.stderr
    assert sorted(folder.rglob("*")) == before


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Templates, stars and models of scene 1; t2, s2 have other pixels, fresh other draws."""
    at = tmp_path_factory.mktemp("made")
    for name, sizes in (("", SIZES), ("2", SMALL)):
        done("templates", "--out", at / f"t{name}.h5", *sizes)
        stars = ("stars", "--templates", at / f"t{name}.h5", "--out", at / f"s{name}.h5")
        done(*stars, "stars=seidel_10pct", *sizes)
    done("stars", "--templates", at / "t.h5", "--out", at / "fresh.h5", *SIZES, "stars.name=fresh")
    done("baseline", "--stars", at / "s.h5", "--out", at / "pca_som.h5", *SIZES)
    done("train", "--stars", at / "s.h5", "--out", at / "dae", *SIZES)
    return at


@pytest.fixture
def at(made, tmp_path):
    """A folder of a test with those products, so that whatever is written is seen."""
    shutil.copytree(made, tmp_path / "at")
    return tmp_path / "at"


@pytest.mark.parametrize(
    ("override", "key", "values"),
    [
        ("telescope.pixel_scale_arcsec=0.2", "telescope.pixel_scale_arcsec", (0.1, 0.2)),
        ("telescope=wfsat_literal", "telescope.pixel_scale_arcsec", (0.1, 0.01)),
        ("telescope.diameter_m=1.2", "telescope.diameter_m", (1.0, 1.2)),
        ("telescope.obscuration=0.1", "telescope.obscuration", (0.3, 0.1)),
        ("telescope.wavelength_m=6e-7", "telescope.wavelength_m", (5.5e-7, 6e-7)),
        ("grid.points=5", "grid.points", (3, 5)),
        ("grid.spacing_deg=0.5", "grid.spacing_deg", (1.1, 0.5)),
        ("framing.stamp_px=24", "framing.stamp_px", (16, 24)),
        ("framing.jitter_px=2", "framing.jitter_px", (1, 2)),
        ("wavefront.coma=5.0", "wavefront.coma", (4.0, 5.0)),
        ("stars=turbulence", "scene.name", ("seidel", "turbulence")),
    ],
)
def test_stars_need_templates_of_their_own_scene(at, override, key, values):
    words = ("stars", "--templates", at / "t.h5", "--out", at / "out.h5", *SIZES, override)
    refused(at, *words, file=at / "t.h5", key=key, values=values)


SCALE = {"key": "telescope.pixel_scale_arcsec", "values": (0.1, 0.15)}


METHODS = "methods=[noisy,pca_som,lmmse,dae]"


def evaluate(at, stars="s.h5", dae="dae"):
    models = ("--pca-som", at / "pca_som.h5", "--dae", at / dae)
    out = ("--per-star", at / "out.parquet", "--out", at / "out.csv")
    return ("evaluate", "--dataset", "d", "--stars", at / stars, *models, *out, *SIZES, METHODS)


@pytest.mark.parametrize(
    ("stage", "file"),
    [
        (evaluate, "pca_som.trained_on.yaml"),
        (lambda at, s: ("bundle", "--stars", at / s, "--dae", at / "dae", *SIZES), "dae"),
        (lambda at, s: (trainings.knee_table, "--stars", at / s, f"--point=a={at / 'dae'}"), "dae"),
        (
            lambda at, s: (
                *("figure", "strip", "--dataset", "d", "--stars", at / s, "--level=1e-3"),
                *("--pca-som", at / "pca_som.h5", "--dae", at / "dae", METHODS),
            ),
            "pca_som.trained_on.yaml",
        ),
        (
            lambda at, s: (
                *("figure", "headline", "--dataset", "d", "--stars", at / s, "--level=1e-3"),
                *("--pca-som", at / "pca_som.h5", "--dae", at / "dae", METHODS),
                *("--bounds", at / "b.csv", "--efficiency", at / "e.csv"),
            ),
            "pca_som.trained_on.yaml",
        ),
    ],
    ids=["evaluate", "bundle", "knee", "strip", "headline"],
)
def test_models_need_stars_of_their_own_kind(at, stage, file):
    file = at / file if file.endswith(".yaml") else at / file / "trained_on.yaml"
    words = [*stage(at, "s2.h5"), *SIZES]
    if "--out" not in words:
        words += ["--out", at / "out"]
    if words[0] is trainings.knee_table:
        words += ["--stopping", at / "stopping.csv"]
    refused(at, *words, file=file, **SCALE)


def test_network_of_other_stars_is_refused_where_the_baseline_belongs(at):
    done("baseline", "--stars", at / "s2.h5", "--out", at / "pca_som.h5", *SIZES)
    refused(at, *evaluate(at, "s2.h5"), file=at / "dae/trained_on.yaml", **SCALE)


@pytest.mark.parametrize(
    ("words", "file", "key", "values"),
    [
        (["--split", "held_out"], "pca_som.h5", "split", ("random", "held_out")),
        (["--reference", "template"], "dae/config.yaml", "reference", ("realisation", "template")),
        (["seed=1"], "pca_som.h5", "seed", (20200611, 1)),
        (["parts.train_stars=30"], "pca_som.h5", "parts.train_stars", (40, 30)),
    ],
)
def test_stars_of_the_training_are_no_test(at, words, file, key, values):
    refused(at, *evaluate(at), *words, file=at / file, key=key, values=values)


def test_templates_go_on_from_the_realisations_of_the_same_training_part(at):
    words = ("fit", "dae", "--stars", at / "s.h5", "--start", at / "dae", "--out", at / "on")
    sizes = (*SIZES, "train.epochs=4", "train.continued_epochs=0.5")
    parts = {"file": at / "dae/config.yaml", "key": "parts.train_stars", "values": (40, 30)}
    refused(at, *words, "--reference=template", *sizes, "parts.train_stars=30", **parts)
    assert "--start" in psfdae(*words, *sizes).stderr
    anew = psfdae(*words, "--reference=template", *SIZES, "train.continued_epochs=0")
    assert anew.exit_code == 2 and "--start" in anew.stderr
    for change in (f"dae.widths={[3] * 9}", "dae.scale=none"):
        other = psfdae(*words, "--reference=template", *sizes, change)
        assert other.exit_code == 2 and change.partition("=")[0] in other.stderr
    done(*words, "--reference=template", *sizes)
    assert len((at / "on/history.csv").read_text().splitlines()) == 1 + 2


def test_a_bundle_holds_the_very_stars_of_the_training(at):
    words = ("bundle", "--stars", at / "fresh.h5", "--dae", at / "dae", "--out", at / "out")
    values = ("seidel_10pct", "fresh")
    refused(at, *words, *SIZES, file=at / "dae/trained_on.yaml", key="stars.name", values=values)


@pytest.mark.parametrize(
    ("words", "file", "key", "values"),
    [
        (
            ["s.h5", "t.h5", "telescope.obscuration=0.1"],
            "s.h5",
            "telescope.obscuration",
            (0.3, 0.1),
        ),
        (["s.h5", "t2.h5"], "t2.h5", "telescope.pixel_scale_arcsec", (0.15, 0.1)),
        (["s.h5", "t.h5", "stars=seidel_50pct"], "s.h5", "stars.aberration_fraction", (0.1, 0.5)),
    ],
)
def test_bounds_need_stars_and_templates_of_one_scene(at, words, file, key, values):
    stars, templates, *overrides = words
    inputs = ("--dataset", "d", "--stars", at / stars, "--templates", at / templates)
    out = ("--growth", at / "g.csv", "--per-star", at / "p.parquet", "--out", at / "out.csv")
    words = ("bounds", *inputs, *out, *SIZES, *overrides)
    refused(at, *words, file=at / file, key=key, values=values)


def test_calibration_needs_one_telescope_for_the_stars_of_a_scene(at):
    stars = ("--stars", "dataset3", at / "s.h5", "--stars", "dataset5", at / "s2.h5")
    words = ("calibrate", "--scan", at / "scan.csv", *stars, "--out", at / "out")
    values = SCALE["values"][::-1]
    refused(at, *words, file=at / "s2.h5", key=SCALE["key"], values=values)


@pytest.mark.parametrize(
    "words",
    [
        [trainings.baseline, "--stars", "s2.h5"],
        [prediction.throughput, "--stars", "s2.h5", "--bundle", "none", "--mixture", "none"],
    ],
    ids=["baseline", "throughput"],
)
def test_measurements_need_the_stars_of_their_configuration(at, words):
    words = [at / word if isinstance(word, str) and "." in word else word for word in words]
    values = SCALE["values"][::-1]
    options = {"file": at / "s2.h5", "key": SCALE["key"], "values": values}
    refused(at, *words, "--out", at / "out.csv", *SIZES, **options)


@pytest.mark.parametrize(
    ("words", "key", "values"),
    [
        (
            [prediction.throughput, "--stars", "s.h5", "--mixture", "none"],
            "framing.subpixel",
            (True, False),
        ),
        (
            [prediction.poppy, "telescope.diameter_m=2"],
            "telescope.diameter_m",
            (1.0, 2.0),
        ),
    ],
    ids=["throughput", "poppy"],
)
def test_predictions_are_measured_with_the_bundle_of_their_scene(at, words, key, values):
    trained_on = read_bundle().info.config["stars"]
    sizes = [*SIZES, f"grid.points={trained_on['grid']['points']}"]
    if "--stars" in words:
        done("templates", "--out", at / "t.h5", *sizes)
        done("stars", "--templates", at / "t.h5", "--out", at / "s.h5", *sizes)
    words = [at / word if str(word).endswith((".h5", ".csv")) else word for word in words]
    words += ["--bundle", shipped_path(), "--out", at / "out.csv", *sizes]
    refused(at, *words, file=shipped_path(), key=key, values=values)


def test_runs_are_tracked_with_their_own_stars(at):
    shutil.copytree(at / "dae", at / "dae/dataset3/random-realisation")
    (at / "evaluation/dataset3").mkdir(parents=True)
    (at / "evaluation/dataset3/random-realisation.csv").write_text("method\ndae\n")
    (at / "pca_som/dataset3").mkdir(parents=True)
    shutil.copy(at / "pca_som.h5", at / "pca_som/dataset3/random.h5")
    words = ("track", "--results", at, "--preset", "smoke", "--database", at / "mlflow.db")
    stars = ("--stars", "dataset3", at / "s2.h5")
    file = at / "dae/dataset3/random-realisation/trained_on.yaml"
    refused(at, *words, *stars, "--out", at / "out.csv", file=file, **SCALE)


# What belongs together


@pytest.mark.parametrize(
    "overrides",
    [
        ["stars.count=7", "seed=3", "optics.threads=2", "optics.batch=3"],
        ["framing.search_px=30", "stars.search_px=30", "telescope.name=other"],
        ["stars=seidel_field", "stars.count=7"],
        ["stars=seidel_50pct", "stars.count=7"],
    ],
    ids=["sizes", "search", "field", "50pct"],
)
def test_stars_of_every_kind_share_the_templates_of_a_scene(at, overrides):
    sizes = [size for size in SIZES if not size.startswith("stars.count")]
    done(
        *("stars", "--templates", at / "t.h5", "--out", at / "out.h5", *sizes),
        *("parts.train_stars=5", "parts.test_stars=2", *overrides),
    )


def test_an_evaluation_has_noise_and_test_stars_of_its_own(at):
    done(*evaluate(at), "noise.levels=[2e-3]", "noise.kappa=3", "parts.test_stars=10")


def test_a_network_of_fresh_stars_is_tested_on_others(at):
    """As in the knee of the training: all stars but one train, and other ones test."""
    parts = ("parts.train_stars=59", "parts.test_stars=1")
    done("train", "--stars", at / "fresh.h5", "--out", at / "other", *SIZES, *parts)
    done(*evaluate(at, dae="other"))


def test_a_model_without_a_note_is_used_as_before(at):
    (at / "dae/trained_on.yaml").unlink()
    (at / "pca_som.trained_on.yaml").unlink()
    done(*evaluate(at, "s2.h5"))


def test_a_damaged_note_is_one_line(at):
    (at / "dae/trained_on.yaml").write_text("telescope: [", encoding="utf-8")
    result = psfdae(*evaluate(at))
    assert result.exit_code == 2
    assert f"psfdae: {at / 'dae/trained_on.yaml'}: line 1, column 13" in result.stderr


# Keys


def test_a_missing_aberration_is_none_and_what_is_not_stated_is_unknown(tmp_path):
    telescope = load(["dataset=_telescope"]).model_dump()
    terms = telescope["telescope"]["aberrations"]["terms"]
    less = {**terms, "z5": {"xy": 0.0}}
    del less["z9"]
    changed = {**telescope, "telescope": {**telescope["telescope"]}}
    changed["telescope"]["aberrations"] = {
        **telescope["telescope"]["aberrations"],
        "terms": less,
        "jitter_waves": 0.5,
    }
    require(tmp_path, telescope, STARS, telescope)
    with pytest.raises(ProductError, match=r"terms\.z5\.xy = 0\.0, but the configuration has 0\.6"):
        require(tmp_path, changed, STATIC, telescope)
    less["z5"] = terms["z5"]
    with pytest.raises(ProductError, match=r"z9\.constant = 0\.0, but the configuration has 0\.03"):
        require(tmp_path, changed, STATIC, telescope)
    less["z9"] = terms["z9"]
    # Static PSFs do not know what is drawn for every star.
    require(tmp_path, changed, STATIC, telescope)
    with pytest.raises(ProductError, match=r"jitter_waves = 0\.5, .* has 0\.03"):
        require(tmp_path, changed, STARS, telescope)
    own = {"telescope": {"pixel_scale_arcsec": 0.8}, "framing": telescope["framing"]}
    require(tmp_path, own, STARS, telescope)


# Scene 3, of which the headers are enough to be refused


def settings_of(name, *overrides):
    reads = stage(f"alignment {name}").stage.settings.reads
    return load_stage(reads, ("alignment_preset=smoke", *overrides), "alignment")


def tree_of(name, *overrides):
    return settings_of(name, *overrides).model_dump()


def write(path, kind, config, **arrays):
    columns = {name: Column(np.asarray(value), "1", name) for name, value in arrays.items()}
    write_product(path, kind, columns, config)


def write_states(path, *overrides):
    stamps = np.full((4, 9, 16, 16), 1 / 256, np.float32)
    arrays = {"states": np.zeros((4, 4)), "stamps": stamps, "energy": np.ones((4, 9))}
    arrays |= {"noll": np.arange(4, 23), "unit": np.ones(4)}
    write(path, "alignment_states", tree_of("states", *overrides), **arrays)


def write_network(folder, *overrides, **config):
    folder.mkdir()
    (folder / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    trained_on = yaml.safe_dump(tree_of("states", *overrides))
    (folder / "trained_on.yaml").write_text(trained_on, encoding="utf-8")


OTHER = "telescope.pixel_scale_arcsec=0.4"
TRAINED = ("original", "noise_trained", "dae_retrained")


@pytest.fixture(scope="module")
def mirror(tmp_path_factory):
    """Products of scene 3; those called other have smaller pixels."""
    at = tmp_path_factory.mktemp("mirror")
    for name, more in (("", []), ("other_", [OTHER]), ("far_", ["alignment.defocus_m=1e-4"])):
        model = tree_of("model", *more)
        write(at / f"{name}model.h5", "alignment_model", model, coefficients=np.zeros((9, 15, 19)))
        write_states(at / f"{name}states.h5", *more)
        write_network(at / f"{name}dae", *more)
        for network in TRAINED:
            write_network(at / f"{name}{network}", *more, name=network, fields=9, stamp_px=16)
    write_network(at / "large", name="original", fields=9, stamp_px=24)
    return at


PIXELS = ("telescope.pixel_scale_arcsec", (0.4, 0.6))
DEFOCUS = ("alignment.defocus_m", (0.0001, 0.0002))


def estimate(**changed):
    used = {"dae": "dae", **{name: name for name in TRAINED}, **changed}
    networks = [f"--{role.replace('_', '-')}=@{folder}" for role, folder in used.items()]
    return ["estimate", "--set=uniform", "--states=@states.h5", *networks, "--times=@t.csv"]


FIT = ["fit", "--set=uniform", "--level=2e-3", "--times=@t.csv", "--network=@original"]
FIT += ["--train=@states.h5"]


@pytest.mark.parametrize(
    ("words", "file", "found"),
    [
        (["states", "--set=train", "--model=@far_model.h5"], "far_model.h5", DEFOCUS),
        (
            ["telescope", "--model=@model.h5", "--grid=@states.h5", "--uniform=@other_states.h5"],
            "other_states.h5",
            PIXELS,
        ),
        (
            ["train-dae", "--grid=@states.h5", "--train=@other_states.h5", "--checkpoint=@c.pt"],
            "other_states.h5",
            PIXELS,
        ),
        (
            [
                *("train-network", "--kind=dae_retrained", "--states=@states.h5"),
                *("--dae=@other_dae", "--checkpoint=@c.pt"),
            ],
            "other_dae/trained_on.yaml",
            PIXELS,
        ),
        (estimate(dae="other_dae"), "other_dae/trained_on.yaml", PIXELS),
        (estimate(noise_trained="far_noise_trained"), "far_noise_trained/trained_on.yaml", DEFOCUS),
        (estimate(original="large"), "large/config.yaml", ("stamp_px", (24, 16))),
        (
            estimate(original="dae_retrained"),
            "dae_retrained/config.yaml",
            ("name", ("dae_retrained", "original")),
        ),
        ([*FIT, "--states=@other_states.h5", "--model=@model.h5"], "other_states.h5", PIXELS),
        (
            [*FIT[:-1], "--train=@other_states.h5", "--states=@states.h5", "--model=@model.h5"],
            "other_states.h5",
            PIXELS,
        ),
        ([*FIT, "--states=@states.h5", "--model=@far_model.h5"], "far_model.h5", DEFOCUS),
        (
            ["bound", "--set=uniform", "--states=@states.h5", "--model=@far_model.h5"],
            "far_model.h5",
            DEFOCUS,
        ),
        (["figure", "stamps", "--states=@states.h5", "--dae=@other_dae"], "other_dae", PIXELS),
    ],
)
def test_products_of_scene_3_are_of_one_telescope(mirror, words, file, found):
    words = [word.replace("@", f"{mirror}/") for word in words]
    file = mirror / file if "." in file else mirror / file / "trained_on.yaml"
    words = ("alignment", *words, "--out", mirror / "out", "alignment_preset=smoke")
    if "telescope" in words:
        words = [word for word in words if "preset" not in str(word)]
    refused(mirror, *words, file=file, key=found[0], values=found[1])


def test_states_that_choose_between_networks_are_those_of_their_stamps(mirror):
    data = {"states": "states.h5", "validation": "states.h5", "test": "other_states.h5"}
    roles = [word for role, name in data.items() for word in ("--data", role, mirror / name)]
    words = ("sweep", "point", "--model=original", "--dataset=original", *roles, "--level=2e-3")
    out = ("--checkpoint", mirror / "c.pt", "--out", mirror / "out", "alignment_preset=smoke")
    file = mirror / "other_states.h5"
    refused(mirror, *words, *out, file=file, key=PIXELS[0], values=PIXELS[1])


def test_the_model_of_the_wavefront_serves_every_detector(mirror):
    config = settings_of("states", OTHER, "alignment.stamp_px=24", "seed=2")
    assert read_model(mirror / "model.h5", config).coefficients.shape == (9, 15, 19)


def write_test(path, kind, states, *overrides):
    config = tree_of(kind, *overrides)
    write(path, f"alignment_{kind}", {**config, "test_set": "uniform"}, states=states)


def test_tables_of_scene_3_are_of_one_test(tmp_path):
    states = np.linspace(-1, 1, 12).reshape(3, 4)
    estimates, fit, bound, other = (tmp_path / f"{name}.h5" for name in ("e", "f", "b", "o"))
    write(
        estimates,
        "alignment_estimates",
        {**tree_of("estimate"), "test_set": "uniform"},
        states=states,
    )
    write_test(fit, "fit", states)
    write_test(bound, "bound", states)
    require_one_test([estimates], [fit], [bound])
    for message, override in (
        (r"o\.h5: noise\.kappa = 3\.0, but .*e\.h5 has 4\.98", "noise.kappa=3"),
        (r"o\.h5: telescope\.diameter_m = 2\.0, but .*f\.h5 has 1\.5", "telescope.diameter_m=2"),
    ):
        write_test(other, "bound", states, override)
        with pytest.raises(ProductError, match=message):
            require_one_test([estimates], [fit], [other])
    write_test(other, "fit", states, "seed=2")
    with pytest.raises(ProductError, match=r"o\.h5: seed = 2, but .*e\.h5 has 20200611"):
        require_one_test([estimates], [other], [])
    write_test(other, "fit", -states)
    with pytest.raises(ProductError, match=r"o\.h5: state 0 = \[1\.0, .*e\.h5 has \[-1\.0, "):
        require_one_test([estimates], [other], [])
    write_test(other, "fit", states[:2])
    with pytest.raises(ProductError, match=r"number of states = 2, but .*e\.h5 has 3"):
        require_one_test([estimates], [other], [])
