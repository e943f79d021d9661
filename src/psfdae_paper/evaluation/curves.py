"""Figures of curves: the training of networks, and errors against the noise level.

In go histories of trainings or the table of the stage `evaluate`; out come matplotlib figures.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from psfdae.base.figures import SERIES_COLORS, new_figure, styled
from psfdae_paper.evaluation import drawing
from psfdae_paper.evaluation.drawing import Style
from psfdae_paper.evaluation.paper import paper_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def training_curves(histories: Mapping[str, pd.DataFrame], title: str) -> Figure:
    """Draw training and validation error of each network of a dataset.

    Parameters
    ----------
    histories : mapping
        Table of each network by its label in the legend, with the columns step, train_mse and
        validation_mse (NaN where it was not measured); errors are per pixel of stamps with sum 1.
    title : str
    """
    # One panel; errors of all networks of the dataset are on the same scale.
    figure = new_figure(4.6, layout="constrained")
    axes = figure.add_subplot()
    entries = []
    # Dotted training error, solid validation error with markers, in one colour per network.
    for i, (label, history) in enumerate(histories.items()):
        color = SERIES_COLORS[i % len(SERIES_COLORS)]
        axes.plot(history["step"], history["train_mse"], color=color, lw=1.0, ls=":")
        # The validation error is measured at few steps.
        validated = history.dropna(subset=["validation_mse"])
        step, mse = validated["step"], validated["validation_mse"]
        axes.plot(step, mse, color=color, lw=1.6, marker="o", ms=3.5)
        # The network of the smallest validation error is the result of the training.
        lowest = mse.argmin()
        kept_marker: Style = {"marker": "*", "ms": 13, "mfc": color, "mec": "black", "ls": ""}
        axes.plot(step.iloc[lowest], mse.iloc[lowest], **kept_marker)
        entries.append(drawing.legend_entry(label, color=color, lw=1.6))
    # Below the networks the legend explains lines and markers.
    entries += [
        drawing.legend_entry("training stars", lw=1.0, ls=":"),
        drawing.legend_entry("validation stars", lw=1.6, marker="o", ms=3.5),
        drawing.legend_entry("kept network", marker="*", ms=11, ls=""),
    ]
    # Errors fall by decades while the network learns.
    axes.set_yscale("log")
    drawing.readable_log_axis(axes)
    axes.set_xlabel("optimiser step")
    axes.set_ylabel(drawing.METRIC_LABELS["mse"])
    axes.set_title(title)
    axes.grid(True, which="major")
    axes.legend(handles=entries, ncols=2)
    return figure


@styled
def error_against_noise(
    metrics: pd.DataFrame, paper: pd.DataFrame, dataset: str, metric: str
) -> Figure:
    """Draw a metric of every method against the noise level.

    There is one panel per reference, realisation or template.

    Parameters
    ----------
    metrics : DataFrame
        Rows of the stage `evaluate`, with the columns dataset, split, reference, method,
        noise_level, metric, value and stderr. Other datasets are not drawn.
    paper : DataFrame
        `psfdae_paper.evaluation.paper.published("psf")`, drawn where it has the dataset.
    dataset : str
    metric : "mse" or "ssim"
    """
    # Measured and published values; the paper's rows get our names of its methods.
    measured = metrics[(metrics.dataset == dataset) & (metrics.metric == metric)]
    published = paper[(paper.dataset == dataset) & (paper.metric == metric)]
    published = published.assign(method=published["method"].map(paper_rows()))
    # Test stars of all field positions, and of those that have no training star.
    split_lines = {"random": "-", "held_out": "--"}
    figure, panels = drawing.reference_panels(measured)
    levels = np.unique(measured["noise_level"])
    for axes, _, reference_rows in panels:
        # Lines with standard errors, dashed for held-out field positions; the paper's values as
        # markers.
        for method_class, rows in drawing.by_method(reference_rows):
            for split, part in rows.groupby("split"):
                line = part.sort_values("noise_level")
                style = {
                    **drawing.method_line(method_class),
                    "ls": split_lines[str(split)],
                    "capsize": 3,
                }
                axes.errorbar(line["noise_level"], line["value"], yerr=line["stderr"], **style)
        for method_class, rows in drawing.by_method(published):
            axes.plot(rows["noise_level"], rows["value"], **drawing.paper_marker(method_class))
        drawing.noise_axis(axes, levels)
    # Methods in the legend, and what solid and dashed lines mean if both are drawn.
    handles = drawing.method_entries(set(measured["method"]), set(published["method"]))
    if "held_out" in set(measured["split"]):
        split_labels = {"random": "random test stars", "held_out": "stars of held-out fields"}
        handles += [
            drawing.legend_entry(split_labels[split], ls=line, lw=1.4)
            for split, line in split_lines.items()
        ]
    title = f"{metric.upper()} of {dataset} against the noise level"
    label = drawing.METRIC_LABELS[metric]
    # An MSE spans decades over the noise levels; an SSIM does not, and has a linear axis.
    is_mse = metric == "mse"
    drawing.finish_panels(
        figure, panels, title, handles, columns=4, label=label, logarithmic=is_mse
    )
    return figure
