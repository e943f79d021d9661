"""Figures of the benchmarks and of the stress tests, each from its table."""

from typing import Annotated, Literal

import numpy as np

from costs import load_points, method_class
from measure import pareto
from psfdae.base.figures import SERIES_COLORS, apply_style, new_figure, write_png
from psfdae.base.files import ProductError
from psfdae.base.options import File
from psfdae.base.reading import read_table
from psfdae.commands.cli import program
from psfdae_paper.configuration.command import command
from psfdae_paper.evaluation.drawing import label_log_axis

WAYS = {
    "kernel numpy": ("our kernel, numpy", "#0072b2", "o"),
    "kernel torch": ("our kernel, torch", "#56b4e9", "D"),
    "hcipy numpy": ("HCIPy, matrix DFT", "#009e73", "^"),
    "fft_pruned numpy": ("FFT, pruned", "#e69f00", "v"),
    "fft numpy": ("FFT, zero-padded", "#d55e00", "s"),
    "poppy_mft numpy": ("POPPY, matrix DFT", "#cc79a7", "P"),
    "poppy_fresnel numpy": ("POPPY, Fresnel", "#4d4d4d", "X"),
}
"""Label, colour and marker of every method and backend."""

SCENES = {"seidel": "scene 1", "turbulence": "scene 2"}
COLORS = {"simulation": SERIES_COLORS[0], "inference": SERIES_COLORS[1]}
COSTS = {"time_s": "time (s)", "peak_mb": "peak memory (MiB)", "disk_mb": "disk (MiB)"}
LOGS = {"xscale": "log", "yscale": "log"}
USED = {"marker": "*", "ms": 15, "mfc": "#f0e442", "mec": "black", "ls": "", "zorder": 5}
RING = {"ls": "", "mfc": "none", "mec": "black", "zorder": 5}
MARKS = {
    "paper": (
        "the paper's training",
        {"ls": "", "marker": "x", "ms": 9, "mew": 2, "mec": "#0072b2"},
    ),
    "knee": ("knee of the DAE's training", {**RING, "marker": "o", "ms": 17}),
    "used": ("training of the preset", {**RING, "marker": "s", "ms": 13}),
}
MSE, FLUX = "largest MSE of normalised stamps", "relative error of the flux, RMS"
HOT = "excess of the pixel over the star's flux"
# Title, x and y axes.
STRESS = (
    ("Stronger wavefronts", "factor on the aberrations, or on 1/r0", MSE),
    ("Other pixel scales (scene 1)", "pixel scale (arcsec)", MSE),
    ("Flux of noisy stars", "noise level λ", FLUX),
    ("Flux of stars with a hot pixel (scene 1)", HOT, FLUX),
)
# By panel of the stress tests: case, label, whether its bound is shown.
SERIES = (
    (0, "aberrations", "aberrations", True),
    (0, "aberrations, guard ignored", "aberrations, guard ignored", False),
    (0, "turbulence", "turbulence", True),
    (1, "pixel scale", "pixel scale", True),
    (2, "seidel, noisy sum", "scene 1, sum (eq. 8)", True),
    (2, "seidel, robust flux", "scene 1, robust", False),
    (2, "turbulence, noisy sum", "scene 2, sum (eq. 8)", True),
    (2, "turbulence, robust flux", "scene 2, robust", False),
    (3, "hot pixel, noisy sum", "sum (eq. 8)", False),
    (3, "hot pixel, robust flux", "robust", True),
)


@command("draw")
def draw(
    kind: Literal[*("propagation", "costs", "inference", "scaling", "image_growth", "graded")],
    table: Annotated[File, "Table of that benchmark."],
    out: Annotated[File, "PNG."],
    scene: Annotated[str | None, "Scene whose rows are drawn."] = None,
) -> None:
    """Draw what a benchmark has measured."""
    rows = read_table(table)
    if scene is not None:
        rows = rows[rows["scene"] == scene]
        if rows.empty:
            raise ProductError(f"{table}: no rows of scene {scene}")
    write_png(apply_style(globals()[kind])(rows), out)


def label_point(axes, x, y, text, shift=3, **style):
    """A small text beside a point."""
    place = {"xytext": (shift, 4), "textcoords": "offset points", "fontsize": 7}
    axes.annotate(text, (x, y), **place, **style)


def entry(label, **style):
    """An entry of a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **style)


def propagation(table):
    """Numerical MSE of a stamp against its time, one panel per aberration."""
    figure = new_figure(5.2, layout="constrained")
    panels = figure.subplots(1, table["aberration"].nunique(), sharex=True, sharey=True)
    table = table.assign(way=table["method"] + " " + table["backend"])
    for axes, name in zip(np.atleast_1d(panels), sorted({*table["aberration"]}), strict=True):
        rows = table[table["aberration"] == name]
        for way, part in rows.groupby("way"):
            _, color, marker = WAYS[way]
            dots = {"color": color, "marker": marker, "ls": "", "ms": 5, "alpha": 0.75, "mew": 0}
            # Bars from the fastest to the slowest repeat.
            time = part["time_ms"]
            spread = [time - part["time_ms_low"], part["time_ms_high"] - time]
            axes.errorbar(time, part["mse"], xerr=spread, elinewidth=0.8, **dots)
        front = rows[rows["pareto"] == "yes"].sort_values("time_ms")
        axes.plot(front["time_ms"], front["mse"], color="black", lw=1.0)
        used = rows[rows["used"] == "yes"]
        axes.plot(used["time_ms"], used["mse"], **USED)
        axes.axhline(rows["budget"].iloc[0], color="black", lw=1.2, ls="--")
        axes.set(**LOGS, xlabel="time per stamp (ms)", title=f"{name} aberration")
        axes.grid(True)
    np.atleast_1d(panels)[0].set_ylabel("numerical MSE of the stamp (sum 1)")
    ways = [WAYS[way] for way in WAYS if way in set(table["way"])]
    handles = [entry(label, ls="", color=color, marker=marker) for label, color, marker in ways]
    handles += [entry("Pareto front", color="black", lw=1.0), entry("setting in use", **USED)]
    handles += [entry("budget", color="black", lw=1.2, ls="--")]
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    threads = "–".join(map(str, sorted({table["threads"].min(), table["threads"].max()})))
    name = table["scene"].iloc[0]
    title = f"{SCENES.get(name, name)}: error of a stamp against its time"
    repeats = f"median and range of {table['repeats'].max()} repeats"
    figure.suptitle(f"{title} ({repeats}; threads or processes: {threads})".capitalize())
    return figure


def costs(table):
    """Error over the least possible, against the CPU time of the fit (left) and of a star."""
    # Trials of single settings are in the table alone.
    trials = load_points().trials
    is_trial = [row.point in trials.get(row.method, {}) for row in table.itertuples()]
    table = table[~np.array(is_trial)].sort_values("fit_cpu_s")
    table = table.assign(star_ms=1e3 / table["stars_per_s"], used=table["point"] == "configured")
    figure = new_figure(1.2 + 2.7 * table["dataset"].nunique(), layout="constrained")
    panels = figure.subplots(
        table["dataset"].nunique(), 2, sharex="col", sharey=True, squeeze=False
    )
    for row, (dataset, measured) in zip(panels, table.groupby("dataset"), strict=True):
        for name, points in measured.groupby("method", sort=False):
            draw_method(*row, points, method_class(name).look)
        used = measured[measured["used"]]
        for axes, times in zip(row, (measured["fit_cpu_s"], used["star_ms"]), strict=True):
            # Settings that no other one beats in both time and error.
            time, error = times.to_numpy(), measured.loc[times.index, "over_least"].to_numpy()
            front = pareto(time, error)
            axes.plot(time[front], error[front], color="0.6", lw=3.0, zorder=0)
            axes.axhline(1.0, color="black", lw=1.0)
            axes.set(**LOGS)
            axes.grid(True, which="both")
            axes.margins(0.08)
        # The least possible error without the field is known well enough at some noise levels only.
        first = measured.iloc[0]
        levels = str(first["noise_levels"]).replace(" ", ", ")
        row[0].set_title(f"{dataset}: {first['stars']} stars, λ = {levels}", loc="left", fontsize=9)
        row[0].set_ylabel("MSE over the least possible")
    panels[-1, 0].set_xlabel("CPU time of the fit (s)")
    panels[-1, 1].set_xlabel("CPU time of a star (ms)")
    looks = [method_class(name).look for name in table["method"].unique()]
    handles = [entry(x.label, color=x.color, marker=x.marker, ls="", ms=8) for x in looks]
    handles += [entry(label, **{**style, "ms": 9}) for label, style in MARKS.values()]
    handles.append(entry("Pareto front", color="0.6", lw=3.0))
    handles.append(entry("least possible error", color="black", lw=1.0))
    if "no" in {*table["tight"]}:
        open_marker = {"color": "black", "mfc": "white", "marker": "o", "ls": "", "ms": 8}
        handles.append(entry("over an upper limit of it", **open_marker))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    figure.suptitle("Error against time: fit (left) and inference (right)")
    return figure


def draw_method(fit_axes, star_axes, points, look):
    """Draw a method's settings against the time of the fit, and that in use against a star's."""
    style = {"color": look.color, "marker": look.marker, "ms": 6, "lw": 1.2, "capsize": 2}
    # Open markers: the minimum error may be lower than the bound.
    if (points["tight"] == "no").any():
        style["mfc"] = "white"
    lengths = points[points["point"] != "paper"]
    for axes, rows, time in (
        (fit_axes, lengths, "fit_cpu_s"),
        (star_axes, points[points["used"]], "star_ms"),
    ):
        # Tables of earlier versions have no standard errors.
        deviation = rows.get("over_least_stderr")
        axes.errorbar(rows[time], rows["over_least"], yerr=deviation, **style)
    marked = {"paper": points["point"] == "paper", "knee": points["knee"] == "yes"}
    marked["used"] = points["used"] & (len(points) > 1)
    for name, rows in marked.items():
        fit_axes.plot(points["fit_cpu_s"][rows], points["over_least"][rows], **MARKS[name][1])
    for row in lengths[lengths["point"].str.startswith("epochs")].itertuples():
        epochs = row.point.removeprefix("epochs")
        label_point(fit_axes, row.fit_cpu_s, row.over_least, epochs, 6, color=look.color)


def inference(table):
    """Stars per second against the batch: columns are stamps, rows numbers of threads."""
    batches, widths = (sorted(table[name].unique()) for name in ("batch", "width"))
    colors = dict(zip(widths, SERIES_COLORS, strict=False))
    figure = new_figure(1.0 + 2.6 * table["threads"].nunique(), layout="constrained")
    shape = (table["threads"].nunique(), table["stamp_px"].nunique())
    panels = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
    groups = table.groupby(["threads", "stamp_px"])
    for axes, ((count, side), part) in zip(panels.flat, groups, strict=True):
        for width, rows in part.sort_values("batch").groupby("width"):
            low, high = rows["stars_per_s_low"], rows["stars_per_s_high"]
            axes.fill_between(rows["batch"], low, high, color=colors[width], alpha=0.15, lw=0)
            line = {"marker": "o", "ms": 4, "lw": 1.3, "color": colors[width]}
            axes.plot(rows["batch"], rows["stars_per_s"], **line)
        axes.set(**LOGS, title=f"{side} × {side} px, {count} thread{'s' if count > 1 else ''}")
        axes.set_xticks(batches, batches)
        axes.minorticks_off()
        axes.grid(True)
    for axes in panels[-1]:
        axes.set_xlabel("stars per batch")
    for axes in panels[:, 0]:
        axes.set_ylabel("stars per second")
    handles = [entry(f"width {width}", color=colors[width], lw=2) for width in widths]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    figure.suptitle("Speed of the network (median, band: all repeats)")
    return figure


def scaling(table):
    """Time, memory and disk against the stars, and time per star against the stamp's side.

    Memory is drawn where it was measured; time and disk are extrapolated as well.
    """
    figure = new_figure(6.0, layout="constrained")
    *panels, by_side = figure.subplots(2, 2).flat
    for (stage, against), part in table.groupby(["what", "against"], sort=False):
        style = {"color": COLORS[stage], "marker": "o", "lw": 1.4}
        exponent = f"{part['exponent'].iloc[0]:.2f} ± {part['exponent_stderr'].iloc[0]:.2f}"
        label = f"{stage}: exponent {exponent}"
        if against == "stamp_px":
            per_star = 1e3 * part["time_s"] / part["stars"]
            by_side.plot(part["stamp_px"], per_star, label=label, **style)
            continue
        measured = part[part["measured"] == "yes"]
        for axes, cost in zip(panels, COSTS, strict=True):
            if cost != "peak_mb":
                axes.plot(part["stars"], part[cost], **style | {"ls": ":", "mfc": "white"})
            name = label if cost == "time_s" else stage
            axes.plot(measured["stars"], measured[cost], label=name, **style)
            axes.set(xlabel="stars", ylabel=COSTS[cost])
    by_side.set(xlabel="side of the stamp (px)", ylabel="ms per star")
    for axes in (*panels, by_side):
        axes.set(**LOGS)
        axes.grid(True)
        axes.legend()
    sides = sorted(table["stamp_px"].unique())
    by_side.set_xticks(sides, sides)
    by_side.minorticks_off()
    # Axes of less than two decades need numbers between powers of ten, and room for two of them.
    low, high = by_side.get_ylim()
    by_side.set_ylim(low / 1.3, 1.3 * high)
    label_log_axis(by_side)
    # Memory hardly changes: a range of two decades shows that rather than its noise.
    low, high = panels[1].get_ylim()
    middle = (low * high) ** 0.5
    panels[1].set_ylim(min(low, middle / 10), max(high, middle * 10))
    panels[1].set_xlim(panels[0].get_xlim())
    figure.suptitle("Growth of the costs, one run each (open: extrapolated; memory is not)")
    return figure


def image_growth(table):
    """CPU time and memory of an image against its stars and its pixels, with slopes of the ends.

    Against the stars are drawn images of the most frequent number of pixels, and the reverse.
    """
    table = table[table["tool"] == "psfdae"].dropna(subset=["stars", "cpu_s"])
    figure = new_figure(6.0, layout="constrained")
    panels, sizes = figure.subplots(2, 2, sharex="col", sharey="row"), ("stars", "pixels")
    for column, against, fixed_size in zip(panels.T, sizes, sizes[::-1], strict=True):
        in_series = table[fixed_size] == table.groupby(fixed_size)[against].nunique().idxmax()
        steps = table[in_series].sort_values(against, kind="stable").groupby("step", sort=False)
        for (step, rows), color in zip(steps, SERIES_COLORS, strict=False):
            for axes, cost in zip(column, ("cpu_s", "peak_mb"), strict=True):
                # Slope between the two largest sizes, where constant terms count least.
                logs = np.log(rows[[against, cost]].to_numpy(float)[-2:])
                growth, increase = logs[-1] - logs[0]
                label = f"{step}, slope {increase / growth:.2f}" if growth else step
                axes.plot(rows[against], rows[cost], marker="o", color=color, label=label)
        column[0].set_title(f"{table[fixed_size][in_series].iloc[0]:,.0f} {fixed_size}")
        column[1].set_xlabel(against)
    for axes in panels.flat:
        axes.set(**LOGS)
        axes.grid(True)
        axes.legend()
    panels[0, 0].set_ylabel("CPU time (s)")
    panels[1, 0].set_ylabel("peak memory (MB)")
    figure.suptitle("Costs of an image, one run each (slopes between the two largest sizes)")
    return figure


def graded(table):
    """Error under growing stress with its bounds; lines mark the stress that is refused.

    A series has few cases, which no line joins. Refused is the input itself, which has no error.
    """
    figure = new_figure(8.0, layout="constrained")
    for number, axes in enumerate(figure.subplots(2, 2).flat):
        title, xlabel, ylabel = STRESS[number]
        axes.set(**LOGS, title=title, xlabel=xlabel, ylabel=ylabel)
        series = [fields for panel, *fields in SERIES if panel == number]
        for index, (case, label, bounded) in enumerate(series):
            color = SERIES_COLORS[index]
            rows = table[table["case"] == case].sort_values("stress")
            measured, refused = rows.dropna(subset=["error"]), rows[rows["error"].isna()]
            # Series of the same stress stand side by side.
            shift = 1.0 + 0.06 * (index - 0.5 * (len(series) - 1))
            style = {"color": color, "ls": "", "marker": "osv^"[index], "ms": 5}
            axes.plot(shift * measured["stress"], measured["error"], label=label, **style)
            if bounded:
                style = {"color": color, "ls": "", "marker": "_", "ms": 14, "mew": 1.6}
                axes.plot(shift * measured["stress"], measured["bound"], **style)
            for stress in refused["stress"]:
                axes.axvline(stress, color=color, ls=":", lw=1.4, label=f"{label}: refused")
        axes.plot([], [], color="0.4", ls="", marker="_", ms=14, mew=1.6, label="bound")
        axes.grid(True, which="major")
        axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    figure.suptitle("Error under growing stress, its bound, and what is refused")
    return figure


if __name__ == "__main__":
    program(draw)
