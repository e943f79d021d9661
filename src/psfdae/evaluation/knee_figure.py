"""Figure of test error against training time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfdae.evaluation.figure_style import SERIES_COLORS, new_figure, styled

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@styled
def training_knee(table: pd.DataFrame) -> Figure:
    """Test MSE of trainings against their CPU time, with Pareto front and knee.

    Parameters
    ----------
    table : DataFrame
        Columns point, cpu_s, mse, pareto, knee, used (`psfdae.stages.knee`).
    """
    color = SERIES_COLORS[0]
    figure = new_figure(5.2, layout="constrained")
    axes = figure.add_subplot()
    front = table[table["pareto"] == "yes"].sort_values("cpu_s")
    axes.plot(front["cpu_s"], front["mse"], color=color, lw=1.2, label="Pareto front")
    axes.plot(table["cpu_s"], table["mse"], ls="", marker="o", ms=5, color=color, alpha=0.7)
    for column, marker, size, label in (
        ("knee", "*", 17, "knee"),
        ("used", "s", 13, "used by the preset"),
    ):
        rows = table[table[column] == "yes"]
        axes.plot(
            rows["cpu_s"], rows["mse"], ls="", marker=marker, ms=size, mfc="none", mec="black",
            label=label,
        )  # fmt: skip
    for row in table.itertuples():
        axes.annotate(
            row.point, (row.cpu_s, row.mse), xytext=(6, 3), textcoords="offset points", fontsize=6.5
        )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="CPU time of the training's one thread (s)",
        ylabel="test MSE, geometric mean over λ",
        title="Training on dataset 3: error against time",
    )
    axes.margins(x=0.12)
    axes.grid(True, which="both")
    axes.legend(loc="upper right")
    return figure
