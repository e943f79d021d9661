"""Two runs side by side: what differs, and whether it is more than chance."""

from __future__ import annotations

import re
import shutil
from fnmatch import fnmatch
from itertools import combinations, product

import numpy as np
import pandas as pd
import pytest

from command_line import printed, psfdae, refused
from docs_pages import ROOT
from psfdae.base.files import write_text
from psfdae_paper.evaluation import comparison, record_tables
from psfdae_paper.evaluation.comparison import (
    compare_evaluations,
    measure_held_out_ratios,
)

FIELDS, STARS = 20, 400
RECORD = ROOT / "results/reference"
MEASURED = {("d", "realisation", "dae"): 0.03, ("d", "realisation", "pca_som"): 0.01}
"""Scatter of a dataset d; that of its noisy images is not measured."""


def errors(seed, dae, noise_seed=1):
    """Errors per star of the untouched image and of a network with mean error `dae`."""
    noisy = np.random.default_rng(noise_seed).gamma(4.0, 0.25, STARS) * 1e-4
    dae_errors = np.random.default_rng(seed).gamma(4.0, 0.25, STARS) * dae
    tables = []
    for method, mse in (("noisy", noisy), ("dae", dae_errors)):
        table = pd.DataFrame({"method": method, "noise_level": 1e-3, "star": range(STARS)})
        tables.append(
            table.assign(field=table.star % FIELDS, mse=mse, ssim=1 - 1e3 * mse, dataset="d")
        )
    return pd.concat(tables, ignore_index=True).assign(reference="realisation")


def of_network(table):
    """The row of the network's MSE."""
    return table.query("method == 'dae' & metric == 'mse'").iloc[0]


def scaled(table, factor):
    """The same stars with another error of the network."""
    return table.assign(mse=table.mse.where(table.method != "dae", factor * table.mse))


def test_equal_networks_are_the_same_and_a_better_one_is_better():
    verdicts = []
    for seed in range(20):
        table = compare_evaluations(errors(100 + seed, 1e-5), errors(200 + seed, 1e-5), {})
        verdicts += list(table[table.method == "dae"].verdict)
    assert verdicts.count("same") >= 0.9 * len(verdicts)
    table = compare_evaluations(errors(1, 1e-5), errors(2, 0.8e-5), {})
    assert set(table[table.method == "dae"].verdict) == {"better"}
    assert set(table[table.method == "noisy"].verdict) == {"same"}
    assert of_network(table).difference == pytest.approx(-2e-6, rel=0.2)


def test_pairs_of_stars_show_what_independent_samples_hide():
    """A gain of 2 % of every star's error, far below the scatter between stars."""
    first = errors(1, 1e-5)
    second = scaled(first, 0.98)
    assert of_network(compare_evaluations(first, second, {})).verdict == "better"
    noisy = second.method == "noisy"
    second.loc[noisy, "mse"] = errors(1, 1e-5, noise_seed=9)[noisy].mse
    assert of_network(compare_evaluations(first, second, {})).verdict == "same"


def test_seeds_count_beside_the_stars():
    """Five trainings of one setting are the same; without their scatter few of them are."""
    first = errors(1, 1e-5)
    trained = [scaled(first, f) for f in np.random.default_rng(4).normal(1.0, 0.03, 5)]

    def different(scatter):
        rows = [of_network(compare_evaluations(a, b, scatter)) for a, b in combinations(trained, 2)]
        return sum(row.verdict != "same" for row in rows)

    assert different(MEASURED) <= 1 and different({}) > 5
    # A training that errs by 6 % more; without a measured scatter the stars alone decide.
    for place, verdict in (
        ({"dataset": "d", "reference": "realisation"}, "same"),
        ({"dataset": "d", "reference": "template"}, "worse"),
        ({"dataset": "e", "reference": "realisation"}, "worse"),
    ):
        single_seed = first.assign(**place)
        row = of_network(compare_evaluations(single_seed, scaled(single_seed, 1.06), MEASURED))
        assert row.verdict == verdict
    row = of_network(compare_evaluations(first, scaled(first, 0.5), MEASURED))
    assert row.verdict == "better"
    assert row.seed_stderr == pytest.approx(0.03 * np.hypot(row["first"], row.second))


def test_the_package_has_the_table_of_the_record():
    table = RECORD / "tables/seed_scatter.csv"
    if not table.is_file():
        pytest.skip("the record was made before this table")
    assert (
        table.read_bytes() == (ROOT / "src/psfdae_paper/evaluation/seed_scatter.csv").read_bytes()
    )


def mean_errors(n=500, **scale):
    """Mean errors of n stars of dataset d and three methods, whose MSE the keywords multiply."""
    methods = {"noisy": 4.0, "pca_som": 2.0, "dae": 1.0}
    keys = product(["d"], ["random"], ["realisation"], methods, (1e-3, 2e-3), ("mse", "ssim"))
    names = "dataset split reference method noise_level metric"
    table = pd.DataFrame(keys, columns=names.split())
    mse = np.array([methods[name] * scale.get(name, 1.0) for name in table.method])
    is_mse = table.metric == "mse"
    # The standard error is half a per cent of what is lost.
    loss = np.where(is_mse, 1e-6 * mse, 1e-2 * mse)
    return table.assign(value=np.where(is_mse, loss, 1 - loss), stderr=0.005 * loss, n=n)


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """A run of evaluations alone, and a record of tables; a function that writes the run."""
    monkeypatch.setattr(comparison, "read_seed_scatter", lambda: MEASURED)
    table = tmp_path / "record/tables/psf_metrics.csv"
    foreign = mean_errors().assign(dataset="not in the run")
    write_text(table, pd.concat([mean_errors(), foreign]).to_csv(index=False))

    def write_run(**scale):
        path = tmp_path / "run/evaluation/d/random-realisation.csv"
        write_text(path, mean_errors(**scale).to_csv(index=False))
        return psfdae("paper", "compare", tmp_path / "run", tmp_path / "record")

    return write_run


@pytest.mark.parametrize(
    ("scale", "lines"),
    [
        ({"n": 50}, ["NOT COMPARABLE", "test stars 50 (A), 500 (B)"]),
        ({}, ["- 12 are equal", "in 2 of 2 columns of A and in 2 of B; 0 have"]),
        # 3 standard deviations of the difference of two such fits are 13 % of the MSE, and 28 % of
        # 1 − SSIM.
        ({"dae": 1.12}, ["- 8 are equal", "- 4 differ within", "- 0 differ by more"]),
        (
            {"dae": 1.14, "noisy": 1.001},
            [
                "- 2 differ by more\n  - d, random, realisation: dae at λ = 0.001, 0.002",
                "- 2 differ within",
                "- 4 differ, but their scatter",
                "  - d, random, realisation: noisy at λ = 0.001, 0.002",
            ],
        ),
        ({"dae": 1.4}, ["- 4 differ by more"]),
        ({"dae": 2.5}, ["in 0 of 2 columns of A and in 2 of B; 2 have", "realisation, λ = 0.001"]),
    ],
)
def test_tables_of_a_run_and_of_the_record_are_compared(recorded, scale, lines):
    result = recorded(**scale)
    assert result.exit_code == 0, result.output
    assert "12 mean errors are in both (A has 12, B 24)" in result.output
    assert all(line in result.output for line in lines)
    assert ("NOT COMPARABLE" in result.output) == ("n" in scale)


NO_VALUES = {
    *("runtime.csv", "sweeps/dae_crop/cost.csv", "sweeps/network_epochs/cost.csv"),
    *("tables/benchmark_inference.csv", "tables/benchmark_machine.csv"),
    *("tables/benchmark_images.csv", "tables/predict_throughput.csv"),
}
"""Tables of the record that hold nothing but times, memory, and verdicts on them."""


def spoil(folder, factor):
    """Write all tables of the record with all values, but not their keys, times a factor."""
    for name in record_tables.list_tables(RECORD):
        table = pd.read_csv(RECORD / name, dtype=str, keep_default_na=False)
        keys, _ = record_tables.find_rule(name, table)
        for column in table.columns.difference(keys):
            numbers = factor * pd.to_numeric(table[column], errors="coerce")
            table[column] = table[column].mask(numbers.notna(), numbers.map("{:.9g}".format))
        write_text(folder / name, table.to_csv(index=False))


def list_differing(run):
    """The tables that a comparison with the record names, and its output."""
    output = printed("paper", "compare", run, RECORD)
    return {line.split("**")[1] for line in output.splitlines() if "- **" in line}, output


def test_each_table_spoilt_by_a_factor_is_named(tmp_path):
    names = record_tables.list_tables(RECORD)
    # Every CSV of the record is compared, each with keys of its own.
    assert names == {p.relative_to(RECORD).as_posix() for p in RECORD.rglob("*.csv")}
    assert not [
        name
        for name in names
        if not any(fnmatch(name, pattern) for pattern in record_tables.TABLES)
    ]
    spoil(tmp_path, 5.0)
    differing, output = list_differing(tmp_path)
    assert differing == names - NO_VALUES - {"tables/psf_metrics.csv"}
    # Mean errors have a section of their own.
    assert "- 0 are equal" in output and "dataset8, random, realisation: noisy at" in output
    assert "grid, 0, constant, decenter_x, m: mean_abs_error 0.003 (A), 0.0006 (B)" in output


def test_tables_within_their_scatter_are_not_named(tmp_path):
    shutil.copytree(RECORD, tmp_path / "run")
    run = tmp_path / "run"
    differing, output = list_differing(run)
    count = len(record_tables.list_tables(RECORD)) - 1
    assert f"{count} further tables are in both; {count} are equal" in output
    assert differing == set()
    # 2 % of scene 3 and of the bounds, whose standard errors are 4 and 5 %; then 40 %.
    for name, column in (("alignment_errors", "mean_abs_error"), ("psf_bounds_growth", "mse")):
        path = run / f"tables/{name}.csv"
        table = pd.read_csv(path)
        for factor, verdict in ((1.02, "within"), (1.4, "beyond")):
            table.assign(**{column: factor * table[column]}).to_csv(path, index=False)
            values = record_tables.compare_values(run, RECORD, f"tables/{name}.csv")
            assert set(values.verdict) == {"equal", verdict}
            assert set(values.column[values.verdict == verdict]) == {column}
        shutil.copy(RECORD / f"tables/{name}.csv", path)
    # Rows that only one of the runs has; a table that only the record has.
    path = run / "tables/alignment_errors.csv"
    pd.read_csv(path).iloc[3:].to_csv(path, index=False)
    (run / "tables/stability.csv").unlink()
    _, output = list_differing(run)
    assert "alignment_errors.csv**: 0 of 999 values" in output
    assert "3 rows are in one alone" in output and "Not in A: tables/stability.csv" in output


@pytest.mark.parametrize("name", ["dae_crop", "network_epochs"])
def test_points_of_a_sweep_are_compared_by_their_values(tmp_path, name):
    """Their names change with any setting, such as a new one that has its old value."""
    for file in ("summary", "cost"):
        path = f"sweeps/{name}/{file}.csv"
        table = pd.read_csv(RECORD / path)
        table = table.assign(point=[f"{row:012x}" for row in range(len(table))])
        write_text(tmp_path / path, table.to_csv(index=False))
        values = record_tables.compare_values(tmp_path, RECORD, path)
        assert set(values.verdict) == ({"equal"} if file == "summary" else set())
        assert values.row.nunique() == (len(table) if file == "summary" else 0)


def test_tables_that_lack_a_standard_error_are_compared(tmp_path):
    """Each column that an expression names; values without it scatter as of a fit."""
    lacking = []
    for name in record_tables.list_tables(RECORD):
        table = pd.read_csv(RECORD / name, dtype=str, keep_default_na=False)
        keys, scatter = record_tables.find_rule(name, table)
        expressions = " ".join(rule for rule in scatter.values() if isinstance(rule, str))
        for column in {*re.findall(r"[a-z]\w*", expressions)} & {*table.columns} - {*keys}:
            write_text(tmp_path / name, table.drop(columns=column).to_csv(index=False))
            values = record_tables.compare_values(tmp_path, RECORD, name)
            assert set(values.verdict) <= {"equal"} and column not in set(values.column)
            lacking.append(column)
    assert {"n", "variance", "stderr", "mse_stderr", "ci_low", "stars"} <= {*lacking}


def test_errors_of_scene_3_scatter_as_measured():
    """Of very many states, whose own scatter is 0; the largest of the networks' scatters."""
    rows = pd.read_csv(ROOT / "studies/seed_scatter/alignment.csv")
    groups = rows.groupby(["method", "test_set", "noise_level", "parameter"])
    assert (groups.seed.nunique() == 3).all()
    _, rule = record_tables.find_rule("tables/alignment_errors.csv", rows)
    values = {"mean_abs_error": 1.0, "variance": 1.0, "variance_abs": 1.0, "n": 1e12}
    scales = {"mean_abs_error": "mean_abs_error", "bias": "mean_abs_error", "variance": "variance"}
    for name, scale in scales.items():
        relative = groups[name].std() / groups[scale].mean()
        largest = (relative**2).groupby("method").mean().max() ** 0.5
        used = pd.DataFrame([values]).eval(rule[name]).item()
        assert used == pytest.approx(largest, abs=0.005)


def test_a_table_without_an_entry_is_compared_by_its_texts(tmp_path):
    for folder, error in (("a", 1.0), ("b", 3.0)):
        table = pd.DataFrame({"name": ["x", "y"], "error": [error, 1.0], "time_s": [error, 2.0]})
        write_text(tmp_path / folder / "tables/new.csv", table.to_csv(index=False))
    values = record_tables.compare_values(tmp_path / "a", tmp_path / "b", "tables/new.csv")
    assert values.query("verdict != 'equal'")[["row", "column"]].to_numpy().tolist() == [
        ["x", "error"]
    ]


def test_a_table_of_numbers_alone_is_compared_by_its_rows(tmp_path):
    for run, value in (("a", 2.0), ("b", 3.0)):
        write_text(tmp_path / run / "tables/new.csv", f"x,y\n1,5\n{value},5\n")
    values = record_tables.compare_values(tmp_path / "a", tmp_path / "b", "tables/new.csv")
    assert len(values) == 4


def test_held_out_fields_are_compared_on_the_stars_that_both_splits_test():
    """Each split has stars of its own besides: easy ones there, hard ones here."""
    all_errors = errors(1, 1e-5).assign(reference="realisation")
    random = all_errors[all_errors.star < 300].assign(split="random")
    unseen = all_errors[all_errors.star >= 100].assign(split="held_out")
    random.loc[random.star < 100, "mse"] = 1.0
    network = unseen.method == "dae"
    unseen.loc[network, "mse"] *= 1.25
    unseen.loc[unseen.star >= 300, "mse"] = 0.0
    single = random.assign(dataset="one split only")
    table = measure_held_out_ratios(pd.concat([random, unseen, single])).set_index("method")
    assert set(table.dataset) == {"d"}
    assert table.ratio.to_dict() == pytest.approx({"noisy": 1.0, "dae": 1.25})
    assert table.stderr.to_numpy() == pytest.approx([0, 0], abs=1e-12)
    assert set(table.n) == {200}
    assert measure_held_out_ratios(single).empty


@pytest.fixture
def results(tmp_path):
    """Two folders of results with one network in common."""
    for name, lr, n, dae, networks in (
        ("one", "0.004", 50, 1e-5, ("dataset3/random-realisation",)),
        ("two", "0.001", 400, 3e-5, ("dataset3/random-realisation", "dataset5/random-template")),
    ):
        for place in networks:
            folder = tmp_path / name / "dae" / place
            write_text(
                folder / "config.yaml",
                f"train.lr: {lr}\nparts.test_stars: {n}\nreference: realisation\n",
            )
            rows = "epoch,train_mse,validation_mse,seconds\n1,2e-5,1e-5,3\n"
            write_text(folder / "history.csv", rows)
            table = tmp_path / name / "evaluation" / f"{place}.parquet"
            table.parent.mkdir(parents=True)
            errors(1, dae).to_parquet(table)
    return tmp_path


def test_command_compares_networks_and_whole_results(results):
    runs = [str(results / name) for name in ("one", "two")]
    for arguments in (runs, [f"{run}/dae/dataset3/random-realisation" for run in runs]):
        out = results / "compare.md"
        output = printed("paper", "compare", *arguments, "--out", out)
        assert output == out.read_text()
        assert all(
            word in output for word in ("train.lr", "NOT COMPARABLE", "star by star", "worse")
        )
        assert "dataset5" not in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["one", "nothing"], "nothing: no config.yaml"),
        (["one/dae/dataset3/random-realisation", "two/dae/dataset5/random-template"], "damaged"),
    ],
)
def test_refusals_are_one_line(results, arguments, message):
    damaged = results / "two/evaluation/dataset5/random-template.parquet"
    damaged.write_bytes(damaged.read_bytes()[:100])
    assert message in refused("paper", "compare", *(results / a for a in arguments))
