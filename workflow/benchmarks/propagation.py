"""Time against error of the optics: kernel, peers, cheapest setting, and what is left out."""

from dataclasses import replace
from typing import Annotated, Any

import click

from choice import choose, guard_or_budget, take_sample
from measure import alone, machine, write
from propagators import (
    compare,
    configured_setting,
    finish,
    in_processes,
    kernel_settings,
    kernel_times,
    peers_of,
    time_settings,
)
from psfdae.cli import program
from psfdae.options import Folder
from psfdae.reading import read_table
from psfdae.threads import limit_threads
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.schema import Config
from savings import PACKAGES, finer_than_needed, imports, timed_savings
from scenes import READS, Scene, build_cases

TABLES = ("propagation", "convergence", "choice", "guard", "skipping", "machine")
"""Tables of one scene, `<name>.csv` in its folder; joined as `benchmark_<name>.csv`."""

AS_TEXT: dict[str, Any] = {"machine": str, "choice": {"ladder": str}}
"""Columns that must not turn into numbers, by table."""

DIGITS = 5


@command("measure", reads=READS)
def measure(
    config: Config,
    out: Annotated[Folder, "Folder for the tables of the scene."],
    datasets: Annotated[int, click.IntRange(min=1), "Datasets that share the stars."] = 1,
) -> None:
    """Time the optics of a scene against its error; needs a quiet machine."""
    described, benchmark = machine(), config.benchmark
    limit_threads(1)  # batches run side by side
    scene = Scene.of(config)
    cases, convergence = build_cases(scene)
    table = time_everything(config, cases)
    work = (timed_savings, config.model_dump(), scene, cases, datasets)
    savings = alone(benchmark.threads, *work)
    times = kernel_times(table, config.optics, benchmark)
    sample = take_sample(scene, max(2, benchmark.stamps // 2), benchmark.peers)
    described |= {"threads": str(benchmark.threads)}
    rows = {
        "propagation": table,
        "convergence": convergence,
        "choice": choose(scene, sample, times),
        "guard": guard_or_budget(scene, sample),
        "skipping": in_scene(scene.name, [*savings, *finer_than_needed(scene, sample, times)]),
        "machine": [
            {"scene": scene.name, "item": item, "value": value} for item, value in described.items()
        ],
    }
    for name in TABLES:
        write(out / f"{name}.csv", rows[name], DIGITS)


def in_scene(name, rows):
    """Rows of savings, whose second column is the scene."""
    return [{"item": row["item"], "scene": name, **row} for row in rows]


def time_everything(config, cases):
    """Both backends and the peers as one table.

    Every backend and number of threads is timed in a process of its own, the peers in that of
    numpy, so that ratios hold; then as many processes as threads, side by side.
    """
    optics, benchmark = config.optics, config.benchmark
    peers = [(case, peer) for case in cases for peer in peers_of(case, benchmark)]
    rows = []
    for backend in ("numpy", "torch"):
        pairs = [
            (case, setting)
            for case in cases
            for setting in kernel_settings(optics, benchmark, case.samples, backend)
        ]
        for threads in sorted({setting.threads for _, setting in pairs}):
            chosen = [pair for pair in pairs if pair[1].threads == threads]
            if (backend, threads) == ("numpy", benchmark.threads):
                chosen += peers
                beside = [(case, replace(setting, threads=1)) for case, setting in chosen]
            work = (time_settings, chosen, benchmark.repeats, benchmark.stamps)
            rows += alone(threads, *work)
    if benchmark.threads > 1:
        rows += in_processes(beside, benchmark.repeats, benchmark.stamps, benchmark.threads)
    used = {case.aberration: configured_setting(optics, benchmark, case.samples) for case in cases}
    return finish(rows, used)


@command("tables", reads=("benchmark",))
def tables(
    config: Config,
    out: Annotated[Folder, "Folder for the joined tables."],
    scenes: Annotated[tuple[Folder, ...], {"flag": "--scene"}, "Folder of a scene's tables."],
) -> None:
    """Join the tables of the scenes, compare with other packages, and time imports."""
    import pandas as pd

    for name in TABLES:
        kept: dict[str, Any] = {"dtype": AS_TEXT.get(name), "keep_default_na": name != "skipping"}
        parts = [read_table(folder / f"{name}.csv", **kept) for folder in scenes]
        if name == "skipping":
            # The others take seconds each to import.
            packages = PACKAGES if config.benchmark.peers else PACKAGES[:1]
            rows = imports(config.benchmark.repeats, packages)
            parts.append(pd.DataFrame(in_scene("all", rows)))
        joined = pd.concat(parts, ignore_index=True)
        write(out / f"benchmark_{name}.csv", joined, DIGITS)
        if name == "propagation":
            write(out / "benchmark_peers.csv", compare(joined), DIGITS)


if __name__ == "__main__":
    program(measure, tables)
