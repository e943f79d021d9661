"""Figures of curves: the training of networks, and errors against the noise level.

Functions take histories of trainings, or the table of the stage `evaluate`, and return figures.
"""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill

import numpy as np
import pandas as pd

from psfdae.base.figures import SERIES_COLORS, apply_style, new_figure
from psfdae.base.types import Figure
from psfdae_paper.evaluation import drawing
from psfdae_paper.evaluation.drawing import Style
from psfdae_paper.evaluation.paper import read_paper_names

WHOLE_STAMPS: Style = {"lw": 1.2, "ls": "--", "marker": "s", "ms": 2.5}
"""Line of training errors that the validation can be compared with; it may be a single epoch."""


@apply_style
def draw_training_curves(histories: Mapping[str, pd.DataFrame], title: str) -> Figure:
    """Draw training and validation error of each network of a dataset.

    Both are mean squared errors without the weights of the loss, so that they can be compared.

    Parameters
    ----------
    histories : mapping
        Table of each network by its label in the legend, with the columns step, train_mse and
        validation_mse (NaN where it was not measured); errors are per pixel of stamps with sum 1.
        The column side_px is the side of the middle of the stamps that the epoch trains on; without
        it, all epochs train on whole stamps.
    title : str
        Title of the figure.
    """
    # One panel; errors of all networks of the dataset are on the same scale.
    figure = new_figure(4.9, layout="constrained")
    axes = figure.add_subplot()
    entries = []
    # Training errors without markers, validation errors with them, in one colour per network.
    for i, (label, history) in enumerate(histories.items()):
        color = SERIES_COLORS[i % len(SERIES_COLORS)]
        # The middle of a stamp has larger errors than a whole stamp: only epochs on whole stamps,
        # which are the last ones, are joined by a line that is compared with the validation.
        side_px = history.get("side_px", pd.Series(0, history.index))
        full_size = history[side_px == side_px.max()]
        axes.plot(history["step"], history["train_mse"], color=color, lw=0.8, ls=":", alpha=0.6)
        axes.plot(full_size["step"], full_size["train_mse"], color=color, **WHOLE_STAMPS)
        # The validation error is measured at few steps.
        validation_rows = history.dropna(subset=["validation_mse"])
        step, mse = validation_rows["step"], validation_rows["validation_mse"]
        axes.plot(step, mse, color=color, lw=1.6, marker="o", ms=3.5)
        # The network of the smallest validation error is the result of the training.
        lowest = mse.argmin()
        kept_marker: Style = {"marker": "*", "ms": 13, "mfc": color, "mec": "black", "ls": ""}
        axes.plot(step.iloc[lowest], mse.iloc[lowest], **kept_marker)
        entries.append(drawing.make_entry(label, color=color, lw=1.6))
    # Below the networks the legend explains lines and markers.
    entries += [
        drawing.make_entry("training stars, middle of the stamps", lw=0.8, ls=":"),
        drawing.make_entry("training stars, whole stamps", **WHOLE_STAMPS),
        drawing.make_entry("validation stars, whole stamps", lw=1.6, marker="o", ms=3.5),
        drawing.make_entry("kept network", marker="*", ms=11, ls=""),
    ]
    # Errors decrease by decades during the training.
    axes.set_yscale("log")
    drawing.label_log_axis(axes)
    axes.set(xlabel="optimiser step", title=title)
    axes.set_ylabel(f"{drawing.METRIC_LABELS['mse']}, mean over the noise levels", fontsize=8)
    axes.grid(True, which="major")
    figure.legend(handles=entries, ncols=2, loc="outside lower center")
    return figure


@apply_style
def draw_errors(
    metrics: pd.DataFrame, paper: pd.DataFrame, dataset: str, metric: str, note: str = ""
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
        Dataset whose rows are drawn.
    metric : str
        "mse", or "ssim", which is drawn as the dissimilarity 1 − SSIM; both on logarithmic axes.
    note : str
        Below the title: how the run differs from the paper's.
    """
    # Measured and published values; the paper's rows get our names of its methods.
    measured_rows = metrics[(metrics.dataset == dataset) & (metrics.metric == metric)]
    paper_points = paper[(paper.dataset == dataset) & (paper.metric == metric)]
    paper_points = paper_points.assign(method=paper_points["method"].map(read_paper_names()))
    # Values of SSIM crowd below 1: their differences from it span decades.
    if metric == "ssim":
        measured_rows, paper_points = (
            rows.assign(value=1.0 - rows["value"]) for rows in (measured_rows, paper_points)
        )
    # Test stars at all field positions, and at positions without training stars.
    split_lines = {"random": "-", "held_out": "--"}
    figure, panels = drawing.make_panels(measured_rows)
    levels = np.unique(measured_rows["noise_level"])
    for axes, _, reference_rows in panels:
        # Lines with standard errors, dashed for held-out field positions; the paper's values as
        # markers.
        for method_class, rows in drawing.group_by_method(reference_rows):
            for split_name, part in rows.groupby("split"):
                line = part.sort_values("noise_level")
                style = {**drawing.method_line(method_class), "capsize": 3}
                style["ls"] = split_lines[str(split_name)]
                axes.errorbar(line["noise_level"], line["value"], yerr=line["stderr"], **style)
        for method_class, rows in drawing.group_by_method(paper_points):
            axes.plot(rows["noise_level"], rows["value"], **drawing.paper_marker(method_class))
        drawing.set_noise_axis(axes, levels)
    # Methods in the legend, and the meaning of solid and dashed lines if both are drawn.
    handles = drawing.make_method_entries(set(measured_rows["method"]), set(paper_points["method"]))
    if "held_out" in set(measured_rows["split"]):
        split_labels = {"random": "random test stars", "held_out": "stars of held-out fields"}
        handles += [
            drawing.make_entry(split_labels[split_name], ls=line, lw=1.4)
            for split_name, line in split_lines.items()
        ]
    # Number of test stars of each split.
    counts = measured_rows.groupby("split", sort=False)["n"].max()
    stars = ", ".join(f"{count} {split_name}" for split_name, count in counts.items())
    name = {"mse": "MSE", "ssim": "1 − SSIM"}[metric]
    title = f"{name} of {dataset} at {levels.size} noise levels, test stars: {stars}"
    title, label = f"{title}\n{fill(note, 100)}".strip(), drawing.METRIC_LABELS[metric]
    drawing.finish_panels(figure, panels, title, handles, columns=4, label=label)
    return figure
