"""Time against error of the optics: our kernel and other packages."""

from dataclasses import replace
from typing import Annotated, Any

from measure import isolate, machine, write
from propagators import (
    compare,
    configured_setting,
    kernel_settings,
    list_peers,
    mark_pareto_fronts,
    time_in_processes,
    time_settings,
)
from psfdae.base.options import Folder
from psfdae.base.reading import read_table
from psfdae.base.threads import limit_threads
from psfdae.commands.cli import program
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.schema import Config
from scenes import READS, Scene, build_cases

TABLES = ("propagation", "convergence", "machine")
"""Tables of one scene, `<name>.csv` in its folder; joined as `benchmark_<name>.csv`."""

AS_TEXT: dict[str, Any] = {"machine": str}
"""Columns that must not turn into numbers, by table."""

DIGITS = 5


@command("measure", reads=READS)
def measure(
    config: Config,
    out: Annotated[Folder, "Folder for the tables of the scene."],
) -> None:
    """Time the optics of a scene against its error; needs a quiet machine."""
    described, benchmark = machine(), config.benchmark
    limit_threads(1)  # batches run side by side
    scene = Scene.of(config)
    cases, convergence = build_cases(scene)
    table = time_everything(config, cases)
    described |= {"threads": str(benchmark.threads)}
    rows = {
        "propagation": table,
        "convergence": convergence,
        "machine": [
            {"scene": scene.name, "item": item, "value": value} for item, value in described.items()
        ],
    }
    for name in TABLES:
        write(out / f"{name}.csv", rows[name], DIGITS)


def time_everything(config, cases):
    """Both backends and the peers as one table.

    Every backend and number of threads is timed in a process of its own, the peers in that of
    numpy, so that ratios hold; then as many processes as threads, side by side.
    """
    optics, benchmark = config.optics, config.benchmark
    peers = [(case, peer) for case in cases for peer in list_peers(case, benchmark)]
    rows = []
    for backend in ("numpy", "torch"):
        pairs = [
            (case, setting)
            for case in cases
            for setting in kernel_settings(optics, benchmark, case.samples, backend)
        ]
        for threads in sorted({setting.threads for _, setting in pairs}):
            timed = [pair for pair in pairs if pair[1].threads == threads]
            if (backend, threads) == ("numpy", benchmark.threads):
                timed += peers
                parallel = [(case, replace(setting, threads=1)) for case, setting in timed]
            work = (time_settings, timed, benchmark.repeats, benchmark.stamps)
            rows += isolate(threads, *work)
    if benchmark.threads > 1:
        rows += time_in_processes(parallel, benchmark.repeats, benchmark.stamps, benchmark.threads)
    used = {case.aberration: configured_setting(optics, benchmark, case.samples) for case in cases}
    return mark_pareto_fronts(rows, used)


@command("tables")
def tables(
    out: Annotated[Folder, "Folder for the joined tables."],
    scenes: Annotated[tuple[Folder, ...], {"flag": "--scene"}, "Folder of a scene's tables."],
) -> None:
    """Join the tables of the scenes, and compare with other packages."""
    import pandas as pd

    for name in TABLES:
        parts = [read_table(folder / f"{name}.csv", dtype=AS_TEXT.get(name)) for folder in scenes]
        joined = pd.concat(parts, ignore_index=True)
        write(out / f"benchmark_{name}.csv", joined, DIGITS)
        if name == "propagation":
            write(out / "benchmark_peers.csv", compare(joined), DIGITS)


if __name__ == "__main__":
    program(measure, tables)
