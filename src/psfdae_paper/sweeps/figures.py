"""Figures of a sweep, as Optuna draws its study."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.base.figures import WIDTH_IN, apply_style
from psfdae.base.types import Figure

if TYPE_CHECKING:
    from optuna import Study

ALL_AXES = ("parallel", "response")
"""Figures of every sweep."""
TWO_AXES = ("contours", "importance")
"""Figures of sweeps with two axes or more."""

LABELS = {
    "validation_mse": "MSE × 10⁶",
    "validation_ssim": "SSIM",
    "validation_mae": "error / range",
}
"""Labels of metrics, which are means over noise levels."""


@apply_style
def draw_sweep(study: Study, kind: str) -> Figure:
    """Draw the metric by which the points of a sweep are compared.

    Parameters
    ----------
    study : Study
        Study of the sweep, with at least one point that has the metric.
    kind : str
        parallel: a line for each point over all axes; response: the metric against each axis;
        contours: the metric over each pair of axes; importance: share of each axis in the variance
        of the logarithm of the error (the metric, or 1 − SSIM) that single axes explain, by
        functional analysis of variance (fANOVA; Hutter et al. 2014, *An efficient approach for
        assessing hyperparameter importance*).
    """
    import matplotlib.pyplot as plt
    from matplotlib.text import Text
    from optuna import visualization
    from optuna.importance import FanovaImportanceEvaluator
    from optuna.trial import TrialState

    plots, metric = visualization.matplotlib, study.user_attrs["metric"]
    label, is_ssim = LABELS[metric], metric == "validation_ssim"
    # Mean squared errors in 1e-6.
    unit = 1e6 if metric == "validation_mse" else 1.0
    values: dict[str, Any] = {"target": lambda trial: unit * trial.value, "target_name": label}
    draw: dict[str, Callable[..., Any]] = {
        "parallel": plots.plot_parallel_coordinate,
        "response": plots.plot_slice,
        "contours": plots.plot_contour,
        "importance": plots.plot_param_importances,
    }
    if kind == "importance":
        # Relative changes of errors count, as in the geometric mean over noise levels.
        values["target"] = lambda trial: math.log(1.0 - trial.value if is_ssim else trial.value)
        values["evaluator"] = FanovaImportanceEvaluator(seed=0)
        # Equal metrics have no variance: no bar is drawn.
        if len({trial.value for trial in study.trials} - {None}) < 2:
            values["params"] = []
    # No window is opened.
    plt.switch_backend("agg")
    plt.rcParams["figure.constrained_layout.use"] = True
    # Optuna warns that its figures are experimental, and of axes with a single value.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        panels = np.atleast_1d(draw[kind](study, **values))
    figure: Figure = panels.flat[0].figure
    plt.close(figure)
    figure.set_size_inches(WIDTH_IN, 6.0 if kind == "contours" and len(panels) > 2 else 4.4)
    # Optuna sets titles of its own, and larger text; lists and small numbers are long labels.
    for text in figure.findobj(Text):
        text.set_fontsize(8)
    for panel in panels.flat:
        for position in ("left", "center"):
            panel.set_title("", loc=position)
        panel.set_facecolor("white")
        panel.grid(color="#d9d9d9")
        panel.set_axisbelow(True)
        panel.tick_params(which="both", labelsize=8)
        if kind != "importance":
            panel.tick_params("x", which="both", labelrotation=30)
            panel.label_outer()
    if kind == "importance":
        error = f"1 − {label}" if is_ssim else label
        panels[0].set(
            xlabel=f"share of the variance of ln({error}) explained by single axes", ylabel=""
        )
        panels[0].get_legend().remove()
    failed_count = len(study.get_trials(deepcopy=False, states=[TrialState.FAIL]))
    count = f"{len(study.trials)} points" + f", {failed_count} failed" * bool(failed_count)
    figure.suptitle(f"Sweep {study.study_name}: validation {label}, {count}")
    return figure
