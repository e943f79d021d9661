"""Data of scene 3: the quadratic model, the products of the stages, configuration, commands."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

import psfdae.cli.alignment  # noqa: F401  registers the commands
from psfdae.alignment.telescope import (
    ModelError,
    design_states,
    fit_quadratic,
    uniform_states,
    verify,
)
from psfdae.cli import main
from psfdae.configuration.compose import (
    ConfigError,
    as_overrides,
    compose,
    config_dir,
    load,
    load_stage,
    overrides_for,
    stage_tree,
)
from psfdae.files import read_product
from psfdae.stages import alignment as stage


def test_quadratic_model_reproduces_ray_tracing(model, grid, tracer):
    """25 states of the fit, 600 others of the grid, uniform ones: 5e-4 waves RMS at most."""
    states, zernikes = grid
    assert states.shape == (625, 4)
    assert verify(model, states, zernikes, 5e-4).shape == (625, 9)
    uniform = uniform_states(100, np.random.default_rng(1))
    residual = verify(model, uniform, tracer(uniform), 5e-4)
    assert np.sqrt((residual**2).mean()) < 2e-4


def test_linear_terms_alone_do_not(model, grid):
    states, zernikes = grid
    coefficients = model.coefficients.copy()
    coefficients[:, 5:] = 0
    message = r"quadratic model: 0\.\d+ waves RMS .*\(at most 0\.0005\)"
    with pytest.raises(ModelError, match=message):
        verify(type(model)(coefficients), states, zernikes, 5e-4)


def test_too_few_states_do_not_determine_the_model(tracer):
    states = design_states()[:9]
    with pytest.raises(ModelError, match=r"9 states determine 9 of the 15 quadratic terms"):
        fit_quadratic(states, tracer(states))


def test_jacobian_of_the_model_is_that_of_the_rays(model, tracer):
    states = uniform_states(3, np.random.default_rng(2)) * 0.9
    jacobian = model.jacobian(states)
    assert jacobian.shape == (3, 9, 4, 19)
    for axis, step in enumerate(0.05 * np.eye(4)):
        plus, minus = (tracer(states + s * step) for s in (1, -1))
        assert jacobian[:, :, axis] == pytest.approx((plus - minus) / 0.1, abs=1e-3)


@pytest.fixture(scope="module")
def products(tmp_path_factory):
    """All data of the preset smoke, by the command line."""
    folder = tmp_path_factory.mktemp("alignment")
    smoke = "alignment_preset=smoke"
    model = ["--model", str(folder / "model.h5")]
    sets = ["--grid", str(folder / "grid.h5"), "--uniform", str(folder / "uniform.h5")]
    runs = {
        "model.h5": ["model"],
        "grid.h5": ["states", "--set", "grid"],
        "uniform.h5": ["states", "--set", "uniform"],
        "train.h5": ["states", "--set", "train", *model],
        "telescope.csv": ["telescope", *model, *sets],
    }
    for name, command in runs.items():
        arguments = ["alignment", *command, "--out", str(folder / name), smoke]
        result = CliRunner().invoke(main, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
    return folder


def test_sets_of_states(products):
    grid, uniform, train = (
        read_product(products / f"{name}.h5", "alignment_states")
        for name in ("grid", "uniform", "train")
    )
    assert grid["stamps"].shape == (81, 9, 16, 16)
    assert sorted(set(grid["states"].ravel())) == [-1, 0, 1]
    assert uniform["stamps"].shape == (12, 9, 16, 16)
    assert train["stamps"].shape == (40, 9, 16, 16)
    assert train["zernikes"].shape == (40, 9, 19)
    assert np.abs(train["states"]).max() <= 1
    assert not np.isin(uniform["states"], train["states"]).any()
    for product in (grid, uniform, train):
        assert product["stamps"].dtype == np.float32
        assert product["stamps"].sum(axis=(2, 3)) == pytest.approx(1, abs=1e-5)
        assert product["unit"] == pytest.approx([1e-3, 1e-3, *np.deg2rad([0.1, 0.1])])
        assert product["noll"].tolist() == list(range(4, 23))
        assert product.config["seed"] == 20200611


def test_model_and_rays_give_the_same_training_stamps(products, tmp_path):
    config = load_stage("alignment_states", ["alignment_preset=smoke"])
    stage.states(config, "train", None, tmp_path / "traced.h5")
    traced, modelled = (
        read_product(path, "alignment_states")
        for path in (tmp_path / "traced.h5", products / "train.h5")
    )
    assert (traced["states"] == modelled["states"]).all()
    assert np.abs(traced["zernikes"] - modelled["zernikes"]).max() < 5e-4
    assert modelled["stamps"] == pytest.approx(traced["stamps"], abs=1e-3)


def test_key_figures(products):
    import pandas as pd

    table = pd.read_csv(products / "telescope.csv").set_index("quantity")
    assert list(table.columns) == ["value", "unit"]
    value = table["value"]
    assert value["pixel"] == pytest.approx(7.27, abs=0.01)
    assert value["lambda_over_d"] == pytest.approx(0.0825, abs=1e-4)
    assert value["sensitivity_condition"] == pytest.approx(3.05, abs=0.02)
    assert value["defocus_centre"] == pytest.approx(0.32, abs=0.01)
    assert value["defocus_edge"] == pytest.approx(0.36, abs=0.01)
    assert value["model_rms_greatest"] < 5e-4
    assert value["energy_least_uniform"] > 0.99


def test_same_configuration_gives_the_same_bytes(products, tmp_path):
    config = load_stage("alignment_states", ["alignment_preset=smoke", "optics.threads=1"])
    stage.states(config, "uniform", None, tmp_path / "again.h5")
    one, two = (
        read_product(path, "alignment_states")
        for path in (tmp_path / "again.h5", products / "uniform.h5")
    )
    assert all((one[name] == two[name]).all() for name in one.arrays)
    config = load_stage("alignment_states", ["alignment_preset=smoke", "seed=1"])
    stage.states(config, "uniform", None, tmp_path / "other.h5")
    other = read_product(tmp_path / "other.h5", "alignment_states")
    assert not np.isin(other["states"], one["states"]).any()


@pytest.mark.parametrize("preset", [p.stem for p in config_dir().glob("preset/*.yaml")])
def test_every_preset_of_the_datasets_has_one_here(preset):
    chosen = overrides_for("alignment", [f"preset={preset}"])
    assert load(chosen, "alignment").alignment.field_points == 8


def test_stage_overrides_reproduce_the_stage_s_configuration():
    for name in ("alignment_model", "alignment_states", "alignment_telescope"):
        tree = stage_tree(name, compose(("alignment_preset=smoke",), "alignment"))
        assert load_stage(name, as_overrides(tree)) == load_stage(name, ["alignment_preset=smoke"])


def test_overrides_reach_the_roots_that_know_them():
    given = ["preset=smoke", "noise.kappa=5", "train.lr=1e-3", "alignment.test_states=9"]
    given += ["telescope=wfsat_literal", "trian.lr=1"]
    assert overrides_for("alignment", given) == (
        *("alignment_preset=smoke", "noise.kappa=5", "alignment.test_states=9", "trian.lr=1"),
    )
    assert overrides_for("config", given) == (
        *("preset=smoke", "noise.kappa=5", "train.lr=1e-3", "telescope=wfsat_literal"),
        "trian.lr=1",
    )
    with pytest.raises(ConfigError, match=r"trian\.lr"):
        load(["trian.lr=1"], "alignment")


def test_command_line_names_what_is_wrong(tmp_path):
    arguments = ["alignment", "model", "--out", str(tmp_path / "x.h5")]
    result = CliRunner().invoke(main, [*arguments, "alignment.field_radius_deg=0.8"])
    assert result.exit_code == 2
    assert "field (0.8, 0)°" in result.output
    assert not (tmp_path / "x.h5").exists()
