"""Metrics and tables."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.stats import pearsonr
from skimage.metrics import mean_squared_error, structural_similarity

from psfdae.methods.metrics import (
    all_metrics,
    cluster_mean,
    cluster_ratio,
    mse,
    ssim,
)
from psfdae_paper.configuration.experiment import Variant
from psfdae_paper.evaluation import readable
from psfdae_paper.evaluation.alignment_tables import correlate_errors
from psfdae_paper.evaluation.experiments import (
    NUMBERS,
    ROW,
    compare_settings,
    draw_experiment,
    format_settings,
)
from psfdae_paper.evaluation.paper import format_paper_table, paper_table, read_published


@pytest.fixture(scope="module")
def pair(gaussian_stars):
    rng = np.random.default_rng(0)
    return gaussian_stars + rng.normal(size=gaussian_stars.shape) * 0.01, gaussian_stars


@pytest.mark.parametrize("data_range", [0.0, -1.0])
def test_ssim_needs_a_range_above_0(pair, data_range):
    with pytest.raises(ValueError, match="must be positive"):
        ssim(*pair, 1.0, data_range)


def test_ssim_is_scikit_image_s_with_one_range_and_with_one_of_each_star(pair):
    noisy, clean = (a[:20].astype(np.float64) for a in pair)
    peak = clean.max(axis=(1, 2)) - clean.min(axis=(1, 2))
    metrics = all_metrics(noisy, clean, 0.66)
    for name, ranges in (("ssim", np.full(20, 0.66)), ("ssim_peak", peak)):
        stars = zip(noisy, clean, ranges, strict=True)
        skimage_ssim = [structural_similarity(x, y, data_range=r) for x, y, r in stars]
        assert metrics[name] == pytest.approx(skimage_ssim, abs=1e-10)


def test_mse_is_scikit_image_s(pair):
    noisy, clean = (a[:20] for a in pair)
    star_mse = [
        mean_squared_error(x.astype(float), y.astype(float))
        for x, y in zip(noisy, clean, strict=True)
    ]
    assert mse(noisy, clean) == pytest.approx(star_mse, rel=1e-6)


def test_ssim_refuses_what_it_cannot_measure(gaussian_stars):
    with pytest.raises(ValueError, match="window"):
        ssim(gaussian_stars[:, :6, :6], gaussian_stars[:, :6, :6], 1.0)
    with pytest.raises(ValueError, match="positive"):
        ssim(gaussian_stars, gaussian_stars, 0.0)


@pytest.mark.parametrize("stars", [1, 50])
def test_clustered_error_counts_fields_where_stars_repeat(stars):
    """50 equal stars per field are 20 measurements, not 1000; of one field nothing is known."""
    fields = np.random.default_rng(1).normal(size=20)
    mean, stderr = cluster_mean(np.repeat(fields, stars), np.repeat(np.arange(20), stars))
    assert mean == pytest.approx(fields.mean())
    assert stderr == pytest.approx(fields.std(ddof=1) / np.sqrt(20), rel=1e-9)
    assert np.isnan(cluster_mean(np.ones(5), np.zeros(5, dtype=int))[1])


def test_error_of_a_paired_ratio_is_its_scatter():
    """Stars of a field share a factor; the stars' own scatter cancels in the ratio."""
    rng = np.random.default_rng(2)
    field = np.repeat(np.arange(40), 10)
    ratios = []
    for _ in range(300):
        stars = rng.gamma(1.0, 1.0, field.size)
        larger_errors = 1.1 * stars * rng.normal(1, 0.1, 40)[field]
        ratios.append(cluster_ratio(larger_errors, stars, field))
    ratio, stderr = np.transpose(ratios)
    assert ratio.mean() == pytest.approx(1.1, abs=0.005)
    assert stderr.mean() == pytest.approx(ratio.std(), rel=0.15)


def test_paper_table_puts_ours_beside_the_paper_s():
    rows = [
        ("dataset3", "random", reference, method, level, "mse", 1e-5, 1e-7, 10)
        for reference in ("realisation", "template")
        for method in ("noisy", "pca_som", "lmmse", "dae")
        for level in (1e-3, 2e-3, 3e-3, 5e-3)
    ]
    columns = [*("dataset", "split", "reference", "method"), *("noise_level", "metric")]
    columns += ["value", "stderr", "n"]
    table = paper_table(pd.DataFrame(rows, columns=columns), "dataset3", "mse")
    assert list(table.columns[3:]) == ["0.001", "0.002", "0.003", "0.005"]
    assert set(table.source) == {"paper", "psfdae"}
    assert (format_paper_table(table, "mse") == "2.7568e-05").any(axis=None)


def test_methods_stand_side_by_side_with_their_errors_and_the_paper(tmp_path):
    rows = [
        ("dataset3", split, "template", method, 0.002, "mse", value, 3e-8, seed_stderr, 10)
        for split in ("random", "held_out")
        for method, value, seed_stderr in (("noisy", 1e-4, 0.0), ("dae", 2.5e-6, 4e-8))
    ]
    columns = [*("dataset", "split", "reference", "method"), *("noise_level", "metric")]
    columns += ["value", "stderr", "seed_stderr", "n"]
    table = readable.tabulate_methods(pd.DataFrame(rows, columns=columns), "mse")
    assert list(table.columns[:6]) == ["dataset", "split", "reference", "λ", "noisy", "DAE"]
    held_out, random = table.to_dict("records")
    # Errors of stars and seeds add in quadrature: 0.03 and 0.04 give 0.05 millionths.
    assert random["DAE"] == "2.500 ± 0.050" and random["noisy"] == "100.000 ± 0.030"
    published = read_published("psf")
    rows = published[(published.dataset == "dataset3") & (published.metric == "mse")]
    row = rows[(rows.method == "dae") & (rows.noise_level == 0.002)].iloc[0]
    assert float(random["DAE, paper"]) == pytest.approx(1e6 * row.value, rel=1e-3)
    # The paper has no held-out fields.
    assert held_out["DAE, paper"] == ""
    tables = {tmp_path / "t.csv": ("a < b", table)}
    readable.write_tables(tables, tmp_path / "t.html", "Not the paper's data")
    assert "**Not the paper's data**" in (tmp_path / "t.md").read_text()
    latex = (tmp_path / "t.tex").read_text()
    assert r"100.000 $\pm$ 0.030" in latex and r"held\_out" in latex and latex.isascii()
    page = (tmp_path / "t.html").read_text()
    assert page.count("<td>") == table.size and "a &lt; b" in page


def test_correlation_is_pearson_s_with_fisher_s_interval():
    rng = np.random.default_rng(0)
    errors = rng.standard_normal((40, 4)) @ rng.standard_normal((4, 4))
    matrix, low, high = correlate_errors(errors)
    assert matrix == pytest.approx(np.corrcoef(errors.T), abs=1e-12)
    expected = pearsonr(errors[:, 0], errors[:, 2]).confidence_interval(0.95)
    assert (low[0, 2], high[0, 2]) == pytest.approx((expected.low, expected.high), rel=1e-6)
    assert (low <= matrix).all()
    assert (matrix <= high).all()
    with pytest.raises(ValueError, match="finite"):
        correlate_errors(errors * np.nan)
    with pytest.raises(ValueError, match="at least one"):
        correlate_errors(errors[:0])


# Experiments

VARIANTS = [
    Variant("dataset3", setting, seed, (f"noise.law={setting}", f"seed={seed}"))
    for setting in ("paper", "b", "a")
    for seed in (1, 2, 3)
]
"""Settings whose order is not alphabetical."""


def evaluations_of_variants():
    """MSE and SSIM of one method at two levels, of which the setting a has only one."""
    key = {"split": "random", "reference": "realisation", "method": "dae", "n": 50}
    rows = []
    for variant in VARIANTS:
        for level in (1e-3, 2e-3) if variant.setting != "a" else (2e-3,):
            factor = {"paper": 1.0, "b": 2.0, "a": 3.0 + 0.1 * variant.seed}[variant.setting]
            mse = 1e-3 * factor * level * variant.seed
            row = {**key, "dataset": variant.name, "noise_level": level, "stderr": 0.1 * mse}
            rows += [{**row, "metric": "mse", "value": mse}]
            rows += [{**row, "metric": "ssim", "value": 1 - mse}]
    return pd.DataFrame(rows)


def test_settings_are_compared_by_means_over_seeds_and_ratios_of_the_same_seed():
    table = compare_settings(evaluations_of_variants(), VARIANTS)
    assert list(table.columns) == [*ROW, "setting", *NUMBERS]
    mse = table[table.metric == "mse"].set_index(["noise_level", "setting"])
    assert list(mse.loc[2e-3].index) == ["paper", "b", "a"] and list(mse.loc[1e-3].index)[1:] == [
        "b"
    ]
    assert set(table.seeds) == {3} and set(table.stars) == {150}
    # Seeds 1, 2, 3 times 2e-6: the mean is 4e-6, the standard error 2e-6 / √3.
    paper, other = mse.loc[(2e-3, "paper")], mse.loc[(2e-3, "a")]
    assert paper.value == pytest.approx(4e-6)
    assert paper.stderr == pytest.approx(2e-6 / 3**0.5)
    assert paper.stderr_stars == pytest.approx(0.1 * 2e-6 * (1 + 4 + 9) ** 0.5 / 3)
    # Ratios of the same seed vary less than the values: 3.1, 3.2 and 3.3.
    assert (paper.ratio, paper.ratio_stderr) == (1, 0)
    assert other.ratio == pytest.approx(3.2)
    assert other.ratio_stderr == pytest.approx(0.1 / 3**0.5)
    # One seed has no scatter.
    evaluations = evaluations_of_variants()
    is_first = evaluations.dataset.isin([variant.name for variant in VARIANTS[::3]])
    single = compare_settings(evaluations[is_first], VARIANTS[::3])
    assert single.stderr.isna().all() and single.value.notna().all()


def test_the_table_and_the_figure_of_an_experiment_show_all_settings():
    table = compare_settings(evaluations_of_variants(), VARIANTS)
    lines = format_settings(table, "mine").splitlines()
    assert lines[2] == "| dataset | split | reference | method | λ | paper | b | a |"
    assert lines[4].endswith("| realisation | dae | 0.001 | 2 ± 0.58 | 4 ± 1.2 |  |")
    figure = draw_experiment(table, "mine")
    (panel,) = figure.axes
    assert [bars.get_label() for bars in panel.containers] == ["paper", "b", "a"]
    line, *_ = panel.containers[0]
    # Three settings stand side by side.
    expected = np.array([[1e-3 / 1.015, 1.0], [2e-3 / 1.015, 1.0]])
    assert line.get_xydata() == pytest.approx(expected)
    _, _, (bars,) = panel.containers[2]
    assert bars.get_segments()[0][:, 1] == pytest.approx(3.2 + np.array([-0.1, 0.1]) / 3**0.5)
    assert (panel.get_title(), panel.get_xlabel()) == ("DAE", "noise level λ (× 10⁻³)")
    assert figure.get_supylabel() == "MSE / MSE of paper"
    # The first setting need not have the first level.
    later = draw_experiment(table[(table.setting != "paper") | (table.noise_level > 1e-3)], "mine")
    assert [bars.get_label() for bars in later.axes[0].containers] == ["paper", "b", "a"]
    assert later.get_supylabel() == "MSE / MSE of paper"
    # Without a common level, the errors themselves.
    rows = table[
        (table.setting != "b") & ~((table.setting == "paper") & (table.noise_level > 1e-3))
    ]
    apart = draw_experiment(rows.assign(ratio=rows.ratio.where(rows.setting == "paper")), "mine")
    line, _, (bars,) = apart.axes[0].containers[0]
    assert line.get_xydata() == pytest.approx(np.array([[1e-3 / 1.015**0.5, 2e-6]]))
    assert bars.get_segments()[0][:, 1] == pytest.approx(2e-6 + np.array([-1, 1]) * 1e-6 / 3**0.5)
    assert "3 seeds of 50 test stars" in figure.get_suptitle()


def test_a_method_that_only_one_dataset_has_leaves_a_panel_empty():
    """Datasets may have other methods; their panels have the levels of the dataset."""
    variants = [Variant(name, "paper", 1, ("seed=1",)) for name in ("dataset3", "dataset5")]
    key = {"split": "random", "reference": "realisation", "n": 50, "stderr": 1e-7}
    rows = [
        {**key, "dataset": variant.name, "method": kind, "noise_level": level, "metric": "mse"}
        for variant, kind in ((variants[0], "dae"), (variants[1], "dae"), (variants[0], "gmm"))
        for level in ((1e-3, 2e-3) if variant.dataset == "dataset3" else (5e-4,))
    ]
    table = compare_settings(pd.DataFrame(rows).assign(value=1e-6), variants)
    figure = draw_experiment(table, "mine")
    ticks = [panel.get_xticks().tolist() for panel in figure.axes]
    assert ticks == [[1e-3, 2e-3]] * 2 + [[5e-4]] * 2
    assert np.isfinite(figure.axes[0].containers[0][0].get_xydata()).all()
    assert len(figure.axes[3].containers[0][0].get_xydata()) == 0
