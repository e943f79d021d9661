"""Products that do not belong together: one line with both values, and nothing is written."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import yaml

from command_line import printed, psfdae, refused
from psfdae.base.belonging import STARS, STATIC, require
from psfdae.base.files import Column, ProductError, write_product
from psfdae.commands.cli import stage
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import load, load_stage
from psfdae_paper.stages.alignment_results import read_products

SIZES = ("preset=smoke", "grid.points=3", "stars.count=60", "parts.train_stars=40")
SIZES += ("parts.test_stars=20", "optics.threads=1", "train.epochs=1")
METHODS = "methods=[noisy,pca_som,lmmse,dae]"


def done(*words):
    printed(*words)


def differs(folder, *words, file, key, values):
    """The command ends in one line that names file, key and both values, and writes nothing."""
    files_before = sorted(folder.rglob("*"))
    line = refused(*words)
    assert f"{file}: {key} = {values[0]}, but " in line, line
    assert line.rstrip().endswith(f" has {values[1]}"), line
    assert sorted(folder.rglob("*")) == files_before


@pytest.fixture(scope="module")
def at(tmp_path_factory):
    """Templates, stars and models of scene 1; t2, s2 have other pixels, fresh other draws."""
    at = tmp_path_factory.mktemp("made")
    for name, overrides in (("", ()), ("2", ("telescope.pixel_scale_arcsec=0.15",))):
        done("templates", "--out", at / f"t{name}.h5", *SIZES, *overrides)
        stars = ("stars", "--templates", at / f"t{name}.h5", "--out", at / f"s{name}.h5")
        done(*stars, "dataset=dataset3", *SIZES, *overrides)
    done("stars", "--templates", at / "t.h5", "--out", at / "fresh.h5", *SIZES, "stars.name=fresh")
    done("fit", "pca_som", "--stars", at / "s.h5", "--out", at / "pca_som.h5", *SIZES)
    done("fit", "dae", "--stars", at / "s.h5", "--out", at / "dae", *SIZES)
    return at


def evaluate(at, stars="s.h5", dae="dae"):
    models = ("--pca-som", at / "pca_som.h5", "--dae", at / dae)
    out = ("--per-star", at / "out.parquet", "--restored", at / "out.h5", "--out", at / "out.csv")
    return ("evaluate", "--dataset", "d", "--stars", at / stars, *models, *out, *SIZES, METHODS)


@pytest.mark.parametrize(
    ("override", "key", "values"),
    [
        ("telescope.pixel_scale_arcsec=0.2", "telescope.pixel_scale_arcsec", (0.1, 0.2)),
        ("wavefront.coma=5.0", "wavefront.coma", (4.0, 5.0)),
        ("dataset=dataset7", "scene.name", ("seidel", "turbulence")),
    ],
)
def test_stars_need_templates_of_their_own_scene(at, override, key, values):
    words = ("stars", "--templates", at / "t.h5", "--out", at / "out.h5", *SIZES, override)
    differs(at, *words, file=at / "t.h5", key=key, values=values)


@pytest.mark.parametrize(
    ("stars", "words", "file", "key", "values"),
    [
        ("s2.h5", [], "pca_som.trained_on.yaml", "telescope.pixel_scale_arcsec", (0.1, 0.15)),
        ("s.h5", ["--split=held_out"], "pca_som.h5", "split", ("random", "held_out")),
        (
            *("s.h5", ["--reference=template"], "dae/config.yaml"),
            *("reference", ("realisation", "template")),
        ),
        ("s.h5", ["parts.train_stars=30"], "pca_som.h5", "parts.train_stars", (40, 30)),
    ],
)
def test_models_are_tested_on_stars_of_their_kind_that_they_have_not_seen(
    at, stars, words, file, key, values
):
    differs(at, *evaluate(at, stars), *words, file=at / file, key=key, values=values)


def test_templates_go_on_from_the_realisations_of_the_same_training_part(at, tmp_path):
    words = ("fit", "dae", "--stars", at / "s.h5", "--start", at / "dae", "--out", tmp_path / "on")
    sizes = (*SIZES, "train.epochs=4", "train.continued_epochs=0.5")
    parts = {"file": at / "dae/config.yaml", "key": "parts.train_stars", "values": (40, 30)}
    differs(at, *words, "--reference=template", *sizes, "parts.train_stars=30", **parts)
    assert "--start" in psfdae(*words, *sizes).stderr
    assert "dae.scale" in refused(*words, "--reference=template", *sizes, "dae.scale=none")
    done(*words, "--reference=template", *sizes)
    assert len((tmp_path / "on/history.csv").read_text().splitlines()) == 1 + 2


def test_a_bundle_holds_the_very_stars_of_the_training(at):
    words = ("bundle", "--stars", at / "fresh.h5", "--dae", at / "dae", "--out", at / "out")
    values = ("seidel_10pct", "fresh")
    differs(at, *words, *SIZES, file=at / "dae/trained_on.yaml", key="stars.name", values=values)


def test_bounds_need_stars_of_the_scene_of_their_templates(at):
    inputs = ("--dataset", "d", "--stars", at / "s.h5", "--templates", at / "t.h5")
    out = ("--growth", at / "g.csv", "--per-star", at / "p.parquet", "--out", at / "out.csv")
    key, override = "stars.aberration_fraction", "dataset=dataset5"
    differs(
        at, "bounds", *inputs, *out, *SIZES, override, file=at / "s.h5", key=key, values=(0.1, 0.5)
    )


def test_runs_are_tracked_with_their_own_stars(at, tmp_path):
    shutil.copytree(at / "dae", tmp_path / "dae/dataset3/random-realisation")
    (tmp_path / "evaluation/dataset3").mkdir(parents=True)
    rows = "method,noise_level,metric,value,stderr\ndae,0.003,mse,1e-5,1e-7\n"
    (tmp_path / "evaluation/dataset3/random-realisation.csv").write_text(rows)
    words = ("track", "--results", tmp_path, "--preset=smoke", "--stars", "dataset3", at / "s2.h5")
    out = ("--database", tmp_path / "mlflow.db", "--out", tmp_path / "out.csv")
    file = tmp_path / "dae/dataset3/random-realisation/trained_on.yaml"
    key = "telescope.pixel_scale_arcsec"
    differs(tmp_path, *words, *out, file=file, key=key, values=(0.1, 0.15))


def test_what_changes_no_result_may_differ(at, tmp_path):
    overrides = [
        "stars.name=other",
        "seed=3",
        "optics.threads=2",
        "optics.batch=3",
        "telescope.name=x",
    ]
    overrides += ["framing.search_px=30", "stars.search_px=30"]
    done("stars", "--templates", at / "t.h5", "--out", tmp_path / "out.h5", *SIZES, *overrides)
    done(*evaluate(at), "noise.levels=[2e-3]", "noise.kappa=3", "parts.test_stars=10")


def test_a_model_that_does_not_say_its_stars_is_used_and_a_damaged_note_is_one_line(at, tmp_path):
    shutil.copytree(at, tmp_path, dirs_exist_ok=True)
    (tmp_path / "pca_som.trained_on.yaml").unlink()
    (tmp_path / "dae/trained_on.yaml").unlink()
    done(*evaluate(tmp_path, "s2.h5"))
    (tmp_path / "dae/trained_on.yaml").write_text("telescope: [", encoding="utf-8")
    assert f"{tmp_path / 'dae/trained_on.yaml'}: line 1" in refused(*evaluate(tmp_path))


def test_a_missing_aberration_is_none_and_what_is_not_stated_is_unknown(tmp_path):
    telescope = load(["dataset=_telescope"]).model_dump()
    aberrations = telescope["telescope"]["aberrations"]
    terms = {name: term for name, term in aberrations["terms"].items() if name != "z9"}

    def with_(**changes):
        return {"telescope": {**telescope["telescope"], "aberrations": {**aberrations, **changes}}}

    with_jitter = with_(jitter_waves=0.5)
    require(tmp_path, telescope, STARS, telescope)
    with pytest.raises(ProductError, match=r"terms\.z9 = nothing, but the configuration has "):
        require(tmp_path, with_(terms=terms), STATIC, telescope)
    # Static PSFs do not know what is drawn for every star.
    require(tmp_path, with_jitter, STATIC, telescope)
    with pytest.raises(ProductError, match=r"jitter_waves = 0\.5, .* has 0\.03"):
        require(tmp_path, with_jitter, STARS, telescope)
    require(tmp_path, {"telescope": {"pixel_scale_arcsec": 0.8}}, STARS, telescope)


# Scene 3, of which the headers are enough to be refused


def tree_of(name, *overrides):
    reads = stage(f"alignment {name}").stage.settings.reads
    return load_stage(reads, (*Alignment.choice, "preset=smoke", *overrides)).model_dump()


def write(path, kind, config, **arrays):
    columns = {name: Column(np.asarray(value), "1", name) for name, value in arrays.items()}
    write_product(path, kind, columns, config)


def test_products_of_scene_3_are_of_one_telescope(tmp_path):
    stamps = np.full((4, 9, 16, 16), 1 / 256, np.float32)
    arrays = {"states": np.zeros((4, 4)), "stamps": stamps, "noll": np.arange(4, 23)}
    states, override = tmp_path / "states.h5", "telescope.pixel_scale_arcsec=0.4"
    write(states, "alignment_states", tree_of("states"), **arrays, unit=np.ones(4))
    (tmp_path / "dae").mkdir()
    (tmp_path / "dae/config.yaml").write_text("{}", encoding="utf-8")
    (tmp_path / "dae/trained_on.yaml").write_text(yaml.safe_dump(tree_of("states", override)))
    words = ("alignment", "train-network", "--kind=dae_retrained", "--states", states)
    words += ("--dae", tmp_path / "dae", "--checkpoint", tmp_path / "c.pt")
    difference = {"key": "telescope.pixel_scale_arcsec", "values": (0.4, 0.6)}
    out = ("--out", tmp_path / "out", "preset=smoke")
    differs(tmp_path, *words, *out, file=tmp_path / "dae/trained_on.yaml", **difference)


def test_tables_of_scene_3_are_of_one_test(tmp_path):
    states = np.linspace(-1, 1, 12).reshape(3, 4)

    def written(name, kind, states, *overrides):
        config = {**tree_of(kind, *overrides), "test_set": "uniform"}
        kind = "estimates" if kind == "estimate" else kind
        write(tmp_path / f"{name}.h5", f"alignment_{kind}", config, states=states)
        return [tmp_path / f"{name}.h5"]

    estimates, fit = written("e", "estimate", states), written("f", "fit", states)
    read_products(estimates, fit, written("b", "bound", states))
    bound = written("o", "bound", states, "telescope.diameter_m=2")
    with pytest.raises(ProductError, match=r"o\.h5: telescope\.diameter_m = 2\.0, but .* 1\.5"):
        read_products(estimates, fit, bound)
    for message, file, *override in (
        (r"o\.h5: seed = 2, but .*e\.h5 has 20200611", states, "seed=2"),
        (r"o\.h5: state 0 = \[1\.0, .*e\.h5 has \[-1\.0, ", -states),
        (r"number of states = 2, but .*e\.h5 has 3", states[:2]),
    ):
        with pytest.raises(ProductError, match=message):
            read_products(estimates, written("o", "fit", file, *override), [])
