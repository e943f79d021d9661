"""Comparison of the settings of an experiment: table, its Markdown, and figure.

Input: evaluations of datasets with several settings and seeds. Outputs: means over seeds with their
standard errors, and their ratios to the first setting.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from psfdae.base.figures import SERIES_COLORS, apply_style, new_figure
from psfdae.base.types import Axes, Figure
from psfdae.methods import method
from psfdae_paper.configuration.experiment import Variant
from psfdae_paper.evaluation.drawing import METRIC_LABELS, set_noise_axis

ROW = ["dataset", "split", "reference", "method", "noise_level", "metric"]
"""Columns that identify a number which settings are compared by."""
NUMBERS = ["seeds", "value", "stderr", "stderr_stars", "ratio", "ratio_stderr", "stars"]


def compare_settings(evaluations: pd.DataFrame, variants: Sequence[Variant]) -> pd.DataFrame:
    """Return means over seeds of all settings, and their ratios to the first setting.

    Parameters
    ----------
    evaluations : DataFrame
        Rows of `MeasuredStars.columns`, in which `dataset` is the name of a variant.
    variants : sequence of Variant
        All variants of the experiment.

    Returns
    -------
    DataFrame
        A row for each dataset, split, reference, method, noise level, metric and setting: number of
        seeds, mean and its standard error from the scatter between seeds, standard error by the
        scatter between stars, mean ratio to the first setting of the same seeds with its standard
        error (NaN without such a value), and number of test stars of all seeds. Standard errors
        from the scatter between seeds are NaN for one seed.
    """
    # The name of a variant stands for its dataset, setting and seed.
    names = pd.DataFrame([(v.name, v.dataset, v.setting, v.seed) for v in variants])
    names = names.set_axis(["variant", "dataset", "setting", "seed"], axis=1).set_index("variant")
    table = evaluations.rename(columns={"dataset": "variant"}).join(names, on="variant")
    # The same number of the first setting with the same seed: stars and noise are mostly the same.
    settings = list(dict.fromkeys(names.setting))
    first = table[table.setting == settings[0]].set_index([*ROW, "seed"]).value
    keys = pd.MultiIndex.from_frame(table[[*ROW, "seed"]])
    table["ratio"] = table.value.to_numpy() / first.reindex(keys).to_numpy()
    # Settings in the order of the file, everything else in the order of the evaluations.
    groups = table.groupby([*ROW, "setting"], sort=False)
    means = groups[["value", "ratio"]].mean()
    errors = groups[["value", "ratio"]].sem()
    result = pd.DataFrame(
        {
            "seeds": groups.seed.nunique(),
            "value": means.value,
            "stderr": errors.value,
            # Test stars of different seeds are independent.
            "stderr_stars": np.sqrt(groups.stderr.agg(lambda s: np.square(s).sum()))
            / groups.size(),
            "ratio": means.ratio,
            "ratio_stderr": errors.ratio,
            "stars": groups.n.sum(),
        }
    ).reset_index()
    order = {name: [*dict.fromkeys(table[name])] for name in ROW if name != "noise_level"}
    for name, values in {**order, "setting": settings}.items():
        result[name] = pd.Categorical(result[name], values)
    return result.sort_values([*ROW, "setting"]).reset_index(drop=True)[[*ROW, "setting", *NUMBERS]]


def list_settings(rows: pd.DataFrame) -> list[str]:
    """Return the settings of a table, the one that the others are divided by first."""
    # Its ratios are 1. The first row may have another one: settings may differ in noise levels.
    names = dict.fromkeys(rows.setting)
    return sorted(names, key=lambda name: not (rows.ratio[rows.setting == name] == 1.0).all())


def format_settings(table: pd.DataFrame, name: str) -> str:
    """Return the MSE of all settings side by side as Markdown.

    Parameters
    ----------
    table : DataFrame
        Result of `compare_settings`.
    name : str
        Name of the experiment.
    """
    rows = table[table.metric == "mse"]
    settings = list_settings(rows)
    keys = [key for key in ROW if key != "metric"]
    lines = [
        f"Experiment {name}: MSE × 10⁶, mean and standard error over {rows.seeds.max()} seeds",
        "",
        f"| {' | '.join(['dataset', 'split', 'reference', 'method', 'λ', *settings])} |",
        "|---" * (len(keys) + len(settings)) + "|",
    ]
    for key, group in rows.groupby(keys, sort=False, observed=True):
        *names, level = map(str, key)
        values = dict(group.set_index("setting").iterrows())
        cells = [_format_cell(values[s]) if s in values else "" for s in settings]
        lines.append(f"| {' | '.join([*names, f'{float(level):g}', *cells])} |")
    return "\n".join(lines) + "\n"


def _format_cell(row: pd.Series) -> str:
    """Return a value × 10⁶ with its standard error over seeds, if there are several."""
    value = f"{1e6 * row['value']:.3g}"
    return value if np.isnan(row["stderr"]) else f"{value} ± {1e6 * row['stderr']:.2g}"


@apply_style
def draw_experiment(table: pd.DataFrame, name: str) -> Figure:
    """Draw the MSE of all settings over the first one's, a panel for each dataset and method.

    Errors themselves are drawn if a setting has no noise level in common with the first one.

    Parameters
    ----------
    table : DataFrame
        Result of `compare_settings`.
    name : str
        Name of the experiment.
    """
    rows = table[table.metric == "mse"]
    settings, methods = list_settings(rows), [*dict.fromkeys(rows.method)]
    has_ratios = all(rows.ratio[rows.setting == setting].notna().any() for setting in settings)
    columns = ("ratio", "ratio_stderr") if has_ratios else ("value", "stderr")
    label = f"MSE / MSE of {settings[0]}" if has_ratios else METRIC_LABELS["mse"]
    # A row of panels for each dataset, split and reference; its panels share both axes.
    parts = list(rows.groupby(["dataset", "split", "reference"], sort=False, observed=True))
    figure = new_figure(1.2 + 1.9 * len(parts), layout="constrained")
    panels = figure.subplots(len(parts), len(methods), squeeze=False, sharey="row", sharex="row")
    for panel_row, (part, part_rows) in zip(panels, parts, strict=True):
        for panel, kind in zip(panel_row, methods, strict=True):
            _draw_panel(panel, part_rows[part_rows.method == kind], settings, *columns)
            panel.set_yscale("linear" if has_ratios else "log")
            # All methods share the axis, also those that this dataset does not have.
            set_noise_axis(panel, np.unique(part_rows.noise_level))
        panel_row[0].set_ylabel("\n".join(map(str, part)), fontsize=8)
    for panel, kind in zip(panels[0], methods, strict=True):
        panel.set_title(method(kind).look.label.replace(" (", "\n("), fontsize=8)
    figure.supylabel(label, fontsize=9)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4))
    seeds, stars = rows.seeds.max(), rows.stars.max() // max(rows.seeds.max(), 1)
    bars = "bars: standard error over seeds" if seeds > 1 else "one seed, without error bars"
    figure.suptitle(f"Experiment {name}: {seeds} seeds of {stars} test stars; {bars}")
    return figure


def _draw_panel(
    panel: Axes, rows: pd.DataFrame, settings: Sequence[str], column: str, error_column: str
) -> None:
    """Draw a line with error bars for each setting against the noise level."""
    for i, setting in enumerate(settings):
        line = rows[rows.setting == setting]
        # Bars of different settings stand side by side, 1.5 % apart.
        panel.errorbar(
            line.noise_level * 1.015 ** (i - 0.5 * (len(settings) - 1)),
            line[column],
            yerr=line[error_column].fillna(0.0),
            color=SERIES_COLORS[i % len(SERIES_COLORS)],
            # Colours repeat after the sixth setting, with another marker.
            marker="osD^v"[i // len(SERIES_COLORS) % 5],
            markersize=3,
            linewidth=1,
            capsize=2,
            label=setting,
        )
    panel.grid(visible=True, which="major")
