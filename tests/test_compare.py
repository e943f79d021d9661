"""Two runs side by side: what differs, and whether it is more than chance."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from command_line import psfdae, refused
from psfdae.evaluation.comparison import (
    SEED_SCATTER,
    compare_errors,
    config_differences,
    held_out_ratios,
    training_summary,
)
from psfdae.files import write_text

FIELDS, STARS = 20, 400
RECORD = Path(__file__).resolve().parents[1] / "results/reference"


def errors(seed, dae, noise_seed=1):
    """Errors per star of the untouched image and of a network with mean error `dae`."""
    noisy = np.random.default_rng(noise_seed).gamma(4.0, 0.25, STARS) * 1e-4
    own = np.random.default_rng(seed).gamma(4.0, 0.25, STARS) * dae
    tables = []
    for method, mse in (("noisy", noisy), ("dae", own)):
        table = pd.DataFrame({"method": method, "noise_level": 1e-3, "star": range(STARS)})
        tables.append(
            table.assign(field=table.star % FIELDS, mse=mse, ssim=1 - 1e3 * mse, dataset="d")
        )
    return pd.concat(tables, ignore_index=True)


def test_equal_networks_are_the_same_and_a_better_one_is_better():
    verdicts = []
    for seed in range(40):
        table = compare_errors(errors(100 + seed, 1e-5), errors(200 + seed, 1e-5), {})
        verdicts += list(table[table.method == "dae"].verdict)
    assert verdicts.count("same") >= 0.9 * len(verdicts)
    table = compare_errors(errors(1, 1e-5), errors(2, 0.8e-5), {}).set_index(["method", "metric"])
    assert table.verdict["dae", "mse"] == "better"
    assert table.verdict["dae", "ssim"] == "better"
    assert table.verdict["noisy", "mse"] == "same"
    assert table.difference["dae", "mse"] == pytest.approx(-2e-6, rel=0.2)
    other_way = compare_errors(errors(2, 0.8e-5), errors(1, 1e-5), {})
    assert set(other_way[other_way.method == "dae"].verdict) == {"worse"}


def test_pairs_of_stars_show_what_independent_samples_hide():
    """A gain of 2 % of every star's error, far below the scatter between stars."""
    first = errors(1, 1e-5)
    second = first.copy()
    second.loc[second.method == "dae", "mse"] *= 0.98
    paired = compare_errors(first, second, {})
    assert paired[(paired.metric == "mse") & (paired.method == "dae")].verdict.item() == "better"
    noisy = second.method == "noisy"
    second.loc[noisy, "mse"] = errors(1, 1e-5, noise_seed=9)[noisy].mse
    unpaired = compare_errors(first, second, {})
    row = unpaired[(unpaired.metric == "mse") & (unpaired.method == "dae")]
    assert row.verdict.item() == "same"


def test_seeds_count_beside_the_stars():
    """Five trainings of one setting are the same; without their scatter few of them are."""
    draws = np.random.default_rng(4).normal(1.0, 0.03, 5)
    trained = []
    for factor in draws:
        table = errors(1, 1e-5)
        table.loc[table.method == "dae", "mse"] *= factor
        table.ssim = 1 - 1e3 * table.mse
        trained.append(table)

    def different(scatter):
        tables = [compare_errors(a, b, scatter) for a, b in combinations(trained, 2)]
        return [(t[t.method == "dae"].verdict != "same").sum() for t in tables]

    assert sum(different({"dae": 0.03})) <= 1 and sum(different({})) > 10
    half = trained[0].copy()
    half.loc[half.method == "dae", "mse"] *= 0.5
    row = compare_errors(trained[0], half, {"dae": 0.03}).query("method == 'dae' & metric == 'mse'")
    assert row.verdict.item() == "better"
    assert row.seed_stderr.item() == pytest.approx(0.03 * np.hypot(row["first"], row.second).item())


def test_scatter_between_seeds_is_what_the_record_has():
    tables = [pd.read_csv(path) for path in RECORD.glob("tables/seeds_*.csv")]
    cells = pd.concat(tables, keys=range(len(tables)), names=["dataset"])
    cells = cells.groupby(["dataset", "method", "noise_level"]).mse
    largest = (cells.std() / cells.mean()).groupby("method").max()
    for name, found in largest.items():
        assert found <= SEED_SCATTER.get(name, 0.0) <= 1.15 * found, name


def test_held_out_fields_are_compared_on_the_stars_that_both_splits_test():
    """Each split has stars of its own besides: easy ones there, hard ones here."""
    both = errors(1, 1e-5).assign(reference="realisation")
    seen = both[both.star < 300].assign(split="random")
    unseen = both[both.star >= 100].assign(split="held_out")
    seen.loc[seen.star < 100, "mse"] = 1.0
    network = unseen.method == "dae"
    unseen.loc[network, "mse"] *= 1.25
    unseen.loc[unseen.star >= 300, "mse"] = 0.0
    alone = seen.assign(dataset="one split only")
    table = held_out_ratios(pd.concat([seen, unseen, alone])).set_index("method")
    assert set(table.dataset) == {"d"}
    assert table.ratio.to_dict() == pytest.approx({"noisy": 1.0, "dae": 1.25})
    assert table.stderr.to_numpy() == pytest.approx([0, 0], abs=1e-12)
    assert set(table.n) == {200}
    assert set(table.fields) == {FIELDS}
    assert table.mse_held_out["dae"] == pytest.approx(1.25 * table.mse_random["dae"])
    assert held_out_ratios(alone).empty


def test_settings_and_curves():
    assert config_differences({"a": "1", "b": "2"}, {"b": "3", "c": "4"}) == [
        ("a", "1", "–"),
        ("b", "2", "3"),
        ("c", "–", "4"),
    ]
    history = pd.DataFrame(
        {
            "epoch": [1, 2, 3, 4],
            "train_mse": 1.0,
            "validation_mse": [np.nan, 4.0, 2.0, 3.0],
            "seconds": [1.0, 2.0, 3.0, 4.0],
        }
    )
    summary = training_summary(history)
    assert summary["best validation MSE"] == 2
    assert summary["at epoch"] == 3
    assert summary["validation MSE after 50%"] == 4
    assert summary["validation MSE after 100%"] == 3
    assert np.isnan(summary["validation MSE after 25%"])


@pytest.fixture
def results(tmp_path):
    """Two folders of results with one network in common."""
    for name, lr, dae, networks in (
        ("one", "0.004", 1e-5, ("dataset3/random-realisation",)),
        ("two", "0.001", 3e-5, ("dataset3/random-realisation", "dataset5/random-template")),
    ):
        for place in networks:
            folder = tmp_path / name / "dae" / place
            write_text(folder / "config.yaml", f"train:\n  lr: {lr}\nreference: realisation\n")
            rows = "epoch,train_mse,validation_mse,seconds\n1,2e-5,1e-5,3\n"
            write_text(folder / "history.csv", rows)
            table = tmp_path / name / "evaluation" / f"{place}.parquet"
            table.parent.mkdir(parents=True)
            errors(1, dae).to_parquet(table)
    return tmp_path


def test_command_compares_networks_and_whole_results(results):
    runs = [str(results / name) for name in ("one", "two")]
    inner = [f"{run}/dae/dataset3/random-realisation" for run in runs]
    for arguments in (runs, inner):
        out = results / "compare.md"
        done = psfdae("compare", *arguments, "--out", out)
        assert done.exit_code == 0, done.output
        assert done.output == out.read_text()
        assert done.output.count("# ") == 4
        assert "train.lr" in done.output
        assert "star by star" in done.output
        assert "worse" in done.output
        assert "dataset5" not in done.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["one"], "at least two"),
        (["one", "nothing"], "nothing: no config.yaml"),
        (["one/dae/dataset3/random-realisation", "two/dae/dataset5/random-template"], "damaged"),
    ],
)
def test_refusals_are_one_line(results, arguments, message):
    damaged = results / "two/evaluation/dataset5/random-template.parquet"
    damaged.write_bytes(damaged.read_bytes()[:100])
    assert message in refused("compare", *(results / a for a in arguments))
