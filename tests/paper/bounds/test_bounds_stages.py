"""Stages of the target bounds on tiny products, and its figures."""

from __future__ import annotations

import h5py
import numpy as np
import pandas as pd
import pytest

from psfdae.base.files import ProductError, read_product
from psfdae.methods import method
from psfdae.methods.interface import Needs
from psfdae.training.star_sets import noisy_test_images, split_stars
from psfdae_paper.bounds.estimates import read_test_stars
from psfdae_paper.bounds.tables import POSTERIOR_MEANS
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.configuration.consistency import SIMULATION, STATIC
from psfdae_paper.stages import bounds, figures, stars

LEVELS = (0.001, 0.01, 0.1)
STARS, BANK, POSITIONS = 12, 64, 36
SIZES = ("preset=smoke", "grid.points=3", "stars.count=36", "parts.train_stars=16")
SIZES += ("parts.test_stars=20", f"bounds.bank_stars={BANK}", f"bounds.test_stars={STARS}")
SIZES += (f"bounds.position_stars={POSITIONS}", "bounds.star_draws=60")
SIZES += (f"noise.levels={list(LEVELS)}", "bounds.threads=1", "optics.threads=1")


def settings(stage, dataset, *words):
    reads = stage if isinstance(stage, tuple) else stage.stage.settings.reads
    return load_stage(reads, (f"dataset={dataset}", *SIZES, *words))


def build(folder, dataset):
    """Products and tables of a dataset's bounds, made by the stages."""
    stars.templates(settings(STATIC, dataset), folder / "templates.h5")
    stars.stars(settings(SIMULATION, dataset), folder / "templates.h5", folder / "stars.h5")
    config = settings(bounds.bounds, dataset)
    bank = folder / "bank.h5" if config.stars.aberration_fraction else None
    if bank:
        bounds.bank(config, bank)
    products = (folder / "stars.h5", folder / "templates.h5")
    tables = [folder / name for name in ("growth.csv", "bounds.parquet", "bounds.csv")]
    bounds.bounds(config, dataset, *products, *tables, bank)
    return folder


@pytest.fixture(scope="module")
def scene_1(tmp_path_factory):
    return build(tmp_path_factory.mktemp("scene1"), "dataset6")


@pytest.fixture(scope="module")
def scene_2(tmp_path_factory):
    return build(tmp_path_factory.mktemp("scene2"), "dataset8")


def evaluated(folder, dataset, factor, mean="bayes"):
    """Per-star errors of a made-up method, `factor` times those of a posterior mean."""
    rows = pd.read_parquet(folder / "bounds.parquet")
    rows = rows[rows.method == mean].assign(method="lmmse", dataset=dataset)
    rows["mse"] *= factor
    # The stage evaluate knows all test stars, in its own order, and other splits.
    extra = rows.assign(star=rows.star + 1000, mse=1.0)
    held_out = rows.assign(split="held_out", mse=0.0)
    path = folder / f"evaluation_{factor}.parquet"
    pd.concat([extra, rows[::-1], held_out]).to_parquet(path)
    return path


def compared(folder, dataset, factor, mean="bayes"):
    inputs = ([folder / "bounds.csv"], [folder / "bounds.parquet"])
    made_up = evaluated(folder, dataset, factor, mean)
    bounds.efficiency(*inputs, folder / "efficiency.csv", [made_up])
    return pd.read_csv(folder / "efficiency.csv")


def test_bank_holds_none_of_the_stars(scene_1):
    bank = read_product(scene_1 / "bank.h5", "bank")
    seidel = read_product(scene_1 / "stars.h5", "stars", ("seidel",))["seidel"]
    count = BANK + POSITIONS
    assert bank["seidel"].shape == (count, 5)
    assert len(np.unique(bank["seidel"], axis=0)) == count
    assert not np.isin(bank["seidel"], seidel).any()
    assert np.bincount(bank["field_index"][:BANK]).tolist() == [8] + 8 * [7]
    assert bank["framed"].shape == (count, 20, 20)
    central = bank["framed"][:, 2:-2, 2:-2].reshape(count, -1)
    # Of pixels that are equally bright, within `framing.tie`, the first is in the middle.
    assert (central[:, 8 * 16 + 8] > (1 - 1.1e-4) * central.max(axis=1)).all()


def test_bounds_of_scene_1(scene_1):
    table = pd.read_csv(scene_1 / "bounds.csv")
    assert list(table.columns) == [*bounds.tables.Tables.summary_columns]
    assert set(table.n) == {STARS}
    assert set(table.metric) == {"mse"}
    assert sorted(set(zip(table.reference, table.method, strict=True))) == [
        ("realisation", "bayes"),
        ("realisation", "bayes_position"),
        ("realisation", "floor"),
        ("template", "bayes"),
        ("template", "bayes_position"),
    ]
    rows = table.set_index(["reference", "method", "noise_level"])
    cells = rows.value
    for level in LEVELS:
        # Both are expected errors, without the scatter of a few stars; the floor, a linear
        # approximation, may be undercut by 15 %.
        variance = rows.variance["realisation", "bayes", level]
        assert cells["realisation", "floor", level] < 1.15 * variance
        noisy = (4.98 * level) ** 2
        assert cells["realisation", "bayes", level] < noisy
    # Where the bank is dense enough, to be told the field helps.
    for reference in ("realisation", "template"):
        assert cells[reference, "bayes_position", 0.1] < cells[reference, "bayes", 0.1]
    assert (table.ci_low < table.value).all()
    assert (table.ci_high > table.value).all()


def test_a_posterior_mean_rests_on_the_bank_or_on_samples(scene_1):
    growth = pd.read_csv(scene_1 / "growth.csv")
    assert list(growth.columns) == [*bounds.tables.Tables.growth_columns]
    table = pd.read_csv(scene_1 / "bounds.csv")
    keys = ["reference", "method", "noise_level"]
    means = table[table.method != "floor"].set_index(keys)
    for key, sizes in growth.groupby(keys):
        row = means.loc[key]
        assert row.draws == (60 if row.found == "samples" else sizes.draws.max())
        assert row.sampled == {"bank": 0, "samples": STARS}.get(row.found, row.sampled)
        if row.found == "bank":
            assert row.value == pytest.approx(sizes.mse.iloc[-1])
        # At the lowest noise the nearest star of a small bank is far away.
        if key[0] == "realisation" and key[2] == 0.001:
            assert (row.found, sizes.limit.isna().all()) == ("samples", True)
            assert row.value < sizes.mse.iloc[-1]
    # Bank and positions are doubled from the least; a quarter where the bank is hopelessly thin.
    assert set(growth[growth.method == "bayes"].draws) == {4, 8, 16, 32, BANK}
    assert growth[growth.method == "bayes_position"].draws.max() == BANK + POSITIONS
    assert set(means.found) >= {"bank", "samples"}
    assert set(means.tight) == {"yes", "no"}


def test_bounded_stars_are_the_first_test_stars_with_their_noise(scene_1):
    config = settings(bounds.bounds, "dataset6")
    product = read_product(scene_1 / "stars.h5", "stars")
    test = split_stars(product, "random", config).test
    rows = pd.read_parquet(scene_1 / "bounds.parquet")
    for _, column in rows.groupby(["reference", "method", "noise_level"]):
        assert column.star.tolist() == test[:STARS].tolist()
        assert column.field.tolist() == product["field_index"][test[:STARS]].tolist()
    noisy = read_test_stars(config, product).noisy
    assert list(noisy) == list(LEVELS)
    for level in LEVELS:
        assert (noisy[level] == noisy_test_images(config, product, test, level)[:STARS]).all()


def test_a_bank_of_other_stars_is_refused(scene_1, tmp_path):
    outputs = [tmp_path / name for name in ("a.csv", "b.csv", "c.parquet")]
    products = (scene_1 / "stars.h5", scene_1 / "templates.h5")
    dataset3_bank, small_bank = tmp_path / "other.h5", tmp_path / "few.h5"
    bounds.bank(settings(bounds.bounds, "dataset3", "bounds.bank_stars=9"), dataset3_bank)
    bounds.bank(settings(bounds.bounds, "dataset6", "bounds.bank_stars=8"), small_bank)
    config = settings(bounds.bounds, "dataset6")
    for message, *bank in (
        (r"other\.h5: stars\.aberration_fraction = 0\.1", dataset3_bank),
        ("a bank is needed",),
        (r"few\.h5: bounds\.bank_stars = 8", small_bank),
    ):
        with pytest.raises(ProductError, match=message):
            bounds.bounds(config, "dataset6", *products, *outputs, *bank)
    assert not list(tmp_path.glob("*.csv"))


def test_optics_restore_the_bounded_stars(scene_1, tmp_path):
    """The squared error against both references is far below that of the noise."""
    products, out = (scene_1 / "stars.h5", scene_1 / "bank.h5"), tmp_path / "optics.csv"
    per_star = tmp_path / "optics.parquet"
    level = 0.01
    config = settings(bounds.optics, "dataset6", f"noise.levels=[{level}]")
    bounds.optics(config, "dataset6", *products, per_star, out)
    table = pd.read_csv(out)
    assert set(table.n) == {STARS}
    assert {"mse", "ssim", "coverage68", "explained"} <= set(table.metric)
    cells = table[table.metric == "mse"].set_index(["method", "reference"]).value
    assert len(cells) == 2 * 2
    for name in ("wavefront", "wavefront_position"):
        assert cells[name, "realisation"] < 0.2 * (4.98 * level) ** 2


def test_scene_2_is_exact(scene_2):
    table = pd.read_csv(scene_2 / "bounds.csv")
    assert set(table.method) == {"bayes", "bayes_position"}
    assert set(table.tight) == {"yes"}
    p_right = table[table.metric == "p_right"].sort_values("noise_level").value
    assert (np.diff(p_right) < 0).all()
    assert p_right.iloc[0] > 0.999
    errors = table[table.metric == "mse"].sort_values("noise_level").groupby("method").value
    unknown_field, known_field = (errors.get_group(name).to_numpy() for name in POSTERIOR_MEANS)
    assert unknown_field[0] == 0.0
    assert unknown_field[-1] > 1e-9
    assert (known_field <= unknown_field).all()
    assert known_field[-1] < unknown_field[-1]  # only its centring is left to find
    assert pd.read_csv(scene_2 / "growth.csv").empty


@pytest.mark.parametrize(("factor", "verdict"), [(1.5, "ok"), (1e-3, "beaten")])
@pytest.mark.parametrize(("knows_field", "mean"), [(False, "bayes"), (True, "bayes_position")])
def test_a_method_is_judged_by_the_mean_of_what_it_is_given(
    scene_1, monkeypatch, factor, verdict, knows_field, mean
):
    monkeypatch.setattr(method("lmmse"), "needs", Needs(level=True, position=knows_field))
    table = compared(scene_1, "dataset6", factor, mean)
    rows = table[table.method == "lmmse"]
    assert set(rows.bound) == {mean, "floor"}
    tight = rows[(rows.bound == mean) & (rows.tight == "yes")]
    assert len(tight)
    assert tight.efficiency.to_numpy() == pytest.approx(1 / factor, rel=1e-5)
    floor = rows[rows.bound == "floor"]
    assert floor.reference.tolist() == ["realisation"] * len(LEVELS)
    assert floor.efficiency.to_numpy() == pytest.approx(floor.mse_bound / floor.mse, rel=1e-5)
    # At low noise a few stars in doubtful fields have most of the error, and its uncertainty.
    assert set(tight[tight.noise_level > 0.005].verdict) == {verdict}
    assert knows_field or set(floor.verdict) == {verdict}
    thin = rows[(rows.bound == mean) & (rows.tight == "no")]
    assert knows_field or len(thin)
    assert thin[["verdict", "efficiency"]].isna().all(axis=None)
    # Posterior means respect the floor.
    means = table[table.method.isin(POSTERIOR_MEANS)]
    assert set(means.verdict) == {"ok"}


def test_methods_must_cover_the_bounded_stars(scene_1, tmp_path):
    rows = pd.read_parquet(evaluated(scene_1, "dataset6", 1.5))
    inputs = ([scene_1 / "bounds.csv"], [scene_1 / "bounds.parquet"])
    for message, table in {
        "lmmse lacks 1 of the bounded stars": rows[rows.star != rows.star.min()],
        r"star \d+ of lmmse lies in field \d": rows.assign(field=rows.field + 1),
        "no method was evaluated": rows.assign(dataset="dataset1"),
    }.items():
        table.to_parquet(tmp_path / "e.parquet")
        with pytest.raises(ProductError, match=message):
            bounds.efficiency(*inputs, tmp_path / "x.csv", [tmp_path / "e.parquet"])


def test_same_config_gives_the_same_bytes(scene_1, tmp_path):
    bounds.bank(settings(bounds.bounds, "dataset6"), tmp_path / "bank.h5")
    with h5py.File(tmp_path / "bank.h5") as first, h5py.File(scene_1 / "bank.h5") as second:
        assert (first["framed"][()] == second["framed"][()]).all()


def test_figure_stages_write_png_and_name_what_is_missing(scene_1, tmp_path):
    compared(scene_1, "dataset6", 1.5)
    tables = (scene_1 / "bounds.csv", scene_1 / "efficiency.csv")
    figures.figure_bounds("dataset6", *tables, tmp_path / "e.png")
    figures.figure_efficiency("dataset6", tables[1], tmp_path / "f.png")
    figures.figure_bank_growth("dataset6", scene_1 / "growth.csv", tmp_path / "g.png")
    for name in "efg":
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ProductError, match="no rows of dataset1"):
        figures.figure_bank_growth("dataset1", scene_1 / "growth.csv", tmp_path / "h.png")


@pytest.mark.parametrize("table", ["bounds", "efficiency", "growth"])
def test_a_table_of_an_earlier_version_is_named_with_the_column_that_it_lacks(table, tmp_path):
    """Tables of the growth of a bank had no stderr and no n."""
    columns = {
        "bounds": figures.BOUND_COLUMNS,
        "efficiency": figures.EFFICIENCY_COLUMNS,
        "growth": figures.GROWTH_COLUMNS,
    }
    paths = {name: tmp_path / f"{name}.csv" for name in columns}
    for name, path in paths.items():
        row = [["dataset6"] * len(columns[name])]
        pd.DataFrame(row, columns=columns[name]).to_csv(path, index=False)
    complete = pd.read_csv(paths[table])
    for column in columns[table]:
        complete.drop(columns=column).to_csv(paths[table], index=False)
        with pytest.raises(ProductError, match=f"{table}.csv: column '{column}' is missing"):
            if table == "growth":
                figures.figure_bank_growth("dataset6", paths["growth"], tmp_path / "g.png")
            else:
                both = paths["bounds"], paths["efficiency"]
                figures.figure_bounds("dataset6", *both, tmp_path / "b.png")
    if table == "efficiency":
        with pytest.raises(ProductError, match="column 'n' is missing"):
            figures.figure_efficiency("dataset6", paths[table], tmp_path / "e.png")


@pytest.mark.parametrize(
    ("bound", "tight", "verdict"),
    [
        (0.0, "yes", "above"),
        (8.0e-7, "no", "above"),
        (8.5e-7, "no", "bound not tight"),
        (1.0e-6, "yes", "below what this scene allows"),
    ],
)
def test_a_row_of_the_paper_is_judged_by_a_tight_bound_alone(tmp_path, bound, tight, verdict):
    """The paper's DAE has 8.4012e-7 in this column."""
    column = {"dataset": "dataset8", "noise_level": 0.003}
    limit = {"method": "bayes", "metric": "mse", "value": bound, "stderr": 1e-8, "tight": tight}
    rows = [column | limit | {"reference": name} for name in ("realisation", "template")]
    rows += [rows[0] | {"metric": "p_right"}, rows[0] | {"method": "bayes_position"}]
    pd.DataFrame(rows).to_csv(tmp_path / "bounds.csv")
    row = column | {"reference": "realisation", "bound": "bayes", "method": "dae", "mse": 3e-6}
    ignored = [row | {"method": "lmmse"}, row | {"bound": "floor"}, row | {"dataset": "dataset7"}]
    pd.DataFrame([row, *ignored]).to_csv(tmp_path / "efficiency.csv")
    out = tmp_path / "paper.csv"
    bounds.paper_rows_table(tmp_path / "bounds.csv", tmp_path / "efficiency.csv", out)
    (row,) = pd.read_csv(out).to_dict("records")
    columns = ["dataset", "method", "noise_level", "mse_paper", "mse", "mse_bound", "stderr"]
    assert list(row) == [*columns, "tight", "paper_over_bound", "verdict"]
    assert (row["method"], row["mse_paper"], row["mse"]) == ("dae", 8.4012e-7, 3e-6)
    expected = 8.4012e-7 / bound if bound else np.nan
    assert row["paper_over_bound"] == pytest.approx(expected, rel=1e-6, nan_ok=True)
    assert row["verdict"] == verdict
