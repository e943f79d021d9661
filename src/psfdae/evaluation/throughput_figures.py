"""Figures of the benchmarks of baseline, inference and scaling."""

from __future__ import annotations

from typing import TYPE_CHECKING

from psfdae.evaluation.figure_style import SERIES_COLORS, new_figure, styled

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ENGINES = {"torch": ("o", "-"), "onnxruntime": ("s", "--")}
WHAT_COLORS = {"simulation": SERIES_COLORS[0], "inference": SERIES_COLORS[1]}
COSTS = {"time_s": "time (s)", "peak_mb": "peak memory (MB)", "disk_mb": "disk (MB)"}
SIZES = {"components": "components K", "rows": "side of the map", "epochs": "epochs"}


@styled
def baseline_figure(table: pd.DataFrame) -> Figure:
    """Test error of PCA+SOM against the time of its fit, one panel per reference.

    Parameters
    ----------
    table : DataFrame
        As written by `psfdae.stages.timing.baseline`.
    """
    figure = new_figure(4.0, layout="constrained")
    panels = figure.subplots(1, 2, sharex=True)
    used = table[table["used"] == "yes"].iloc[0]
    for axes, reference in zip(panels, ("realisation", "template"), strict=True):
        column = f"mse_{reference}"
        drawn = {used.name}
        for (size, label), color in zip(SIZES.items(), SERIES_COLORS, strict=False):
            others = [name for name in SIZES if name != size]
            line = table[(table[others] == used[others]).all(axis=1)].sort_values(size)
            drawn |= set(line.index)
            axes.plot(line["fit_s"], line[column], marker="o", ms=4, lw=1.2, color=color)
            axes.plot([], [], marker="o", ms=4, lw=1.2, color=color, label=f"{label} varied")
            for row in line[line.index != used.name].itertuples():
                _label(axes, row.fit_s, getattr(row, column), str(getattr(row, size)), color)
        rest = table.drop(index=list(drawn))
        axes.plot(rest["fit_s"], rest[column], ls="", marker="x", color="#4d4d4d")
        for row in rest.itertuples():
            text = f"K {row.components}, {row.rows}×{row.columns}, {row.epochs}"
            _label(axes, row.fit_s, getattr(row, column), text, "#4d4d4d")
        axes.plot(used["fit_s"], used[column], marker="*", ms=13, ls="", mec="black",
                  mfc=SERIES_COLORS[-1], label="in use")  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="time of the fit (s)")
        axes.set_title(f"against the {reference}")
        axes.margins(0.16)
        axes.grid(True)
        _plain_ticks(axes)
    panels[0].set_ylabel("MSE per pixel, mean over the noise levels")
    panels[0].legend()
    figure.suptitle("PCA+SOM: test error against the time of the fit")
    return figure


def _label(axes: Axes, x: float, y: float, text: str, color: str) -> None:
    # Slow fits stand at the right edge: long texts go to their left.
    shift, side = (-4, "right") if len(text) > 4 and x > 2.0 else (3, "left")
    axes.annotate(
        text, (x, y), (shift, 4), textcoords="offset points", fontsize=7, color=color, ha=side
    )


def _plain_ticks(axes: Axes) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:.1e}")
    axes.yaxis.set_minor_formatter(NullFormatter())


@styled
def inference_figure(table: pd.DataFrame) -> Figure:
    """Stars per second against the batch: columns are stamps, rows numbers of threads.

    Parameters
    ----------
    table : DataFrame
        As written by `psfdae.stages.timing.inference`.
    """
    from matplotlib.lines import Line2D

    stamps, threads = sorted(table["stamp_px"].unique()), sorted(table["threads"].unique())
    widths = sorted(table["width"].unique())
    colors = dict(zip(widths, SERIES_COLORS, strict=False))
    figure = new_figure(1.0 + 2.6 * len(threads), layout="constrained")
    panels = figure.subplots(len(threads), len(stamps), sharex=True, sharey=True, squeeze=False)
    for line, count in zip(panels, threads, strict=True):
        for axes, stamp_px in zip(line, stamps, strict=True):
            part = table[(table["threads"] == count) & (table["stamp_px"] == stamp_px)]
            part = part.sort_values("batch")
            for (engine, width), curve in part.groupby(["engine", "width"]):
                marker, style = ENGINES[engine]
                axes.fill_between(curve["batch"], curve["stars_per_s_low"],
                                  curve["stars_per_s_high"], color=colors[width], alpha=0.15,
                                  lw=0)  # fmt: skip
                axes.plot(curve["batch"], curve["stars_per_s"], marker=marker, ms=4, ls=style,
                          lw=1.3, color=colors[width])  # fmt: skip
            axes.set(xscale="log", yscale="log")
            axes.set_title(f"{stamp_px} × {stamp_px} px, {count} thread{'s' if count > 1 else ''}")
            axes.grid(True)
    for axes in panels[-1]:
        axes.set_xlabel("stars per batch")
        axes.set_xticks(sorted(table["batch"].unique()), sorted(table["batch"].unique()))
        axes.minorticks_off()
    for axes in panels[:, 0]:
        axes.set_ylabel("stars per second")
    entries = [Line2D([], [], color=colors[w], lw=2, label=f"width {w}") for w in widths]
    entries += [
        Line2D([], [], color="black", marker=marker, ls=style, ms=4, label=engine)
        for engine, (marker, style) in ENGINES.items()
    ]
    figure.legend(handles=entries, loc="outside lower center", ncols=len(entries))
    figure.suptitle("Speed of the network (median, band: all repeats)")
    return figure


@styled
def scaling_figure(table: pd.DataFrame) -> Figure:
    """Time, memory and disk against the stars, and time per star against the stamp's side.

    Parameters
    ----------
    table : DataFrame
        As written by `psfdae.stages.timing.scaling`.
    """
    figure = new_figure(6.0, layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    over_stars = table[table["against"] == "stars"]
    for axes, (cost, label) in zip(panels, COSTS.items(), strict=False):
        for what, part in over_stars.groupby("what", sort=False):
            color = WHAT_COLORS[what]
            measured = part[part["measured"] == "yes"]
            predicted = part[part["measured"] != "yes"]
            name = what
            if cost == "time_s":
                name += f": exponent {part['exponent'].iloc[0]:.2f}"
            axes.plot(measured["stars"], measured[cost], marker="o", lw=1.4, color=color,
                      label=name)  # fmt: skip
            join = [measured.iloc[-1], *(row for _, row in predicted.iterrows())]
            axes.plot([r["stars"] for r in join], [r[cost] for r in join], ls=":", color=color)
            axes.plot(predicted["stars"], predicted[cost], marker="o", mfc="white", ls="",
                      color=color)  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="stars", ylabel=label)
        axes.grid(True)
        axes.legend()
    # Memory hardly changes: a range of two decades shows that rather than its noise.
    low, high = panels[1].get_ylim()
    middle = (low * high) ** 0.5
    panels[1].set_ylim(min(low, middle / 10), max(high, middle * 10))
    _per_star(panels[3], table[table["against"] == "stamp_px"])
    figure.suptitle("Growth of the costs (open: extrapolated)")
    return figure


def _per_star(axes: Axes, table: pd.DataFrame) -> None:
    for what, part in table.groupby("what", sort=False):
        label = f"{what}: exponent {part['exponent'].iloc[0]:.2f}"
        per_star = 1e3 * part["time_s"] / part["stars"]
        axes.plot(part["stamp_px"], per_star, marker="o", lw=1.4, color=WHAT_COLORS[what],
                  label=label)  # fmt: skip
    from matplotlib.ticker import NullLocator

    sides = sorted(table["stamp_px"].unique())
    axes.set(xscale="log", yscale="log", xlabel="side of the stamp (px)", ylabel="ms per star")
    axes.set_xticks(sides, sides)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(True)
    axes.legend()
