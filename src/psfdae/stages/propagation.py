"""Stages `propagation` and `propagation-tables`: time against error of the optics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from psfdae.benchmark import choice, peers, propagation, skipping, timing, wavefronts
from psfdae.benchmark.cases import Case, Scene, build_cases, error_budget
from psfdae.files import ProductError, write_text
from psfdae.reading import read_table
from psfdae.rng import stream
from psfdae.stages.common import limit_threads, star_wavefronts, template_wavefronts
from psfdae.stars.fields import assign_fields

TABLES = ("propagation", "convergence", "choice", "guard", "skipping", "machine")
"""Tables of one scene, `<name>.csv` in its folder; joined as `benchmark_<name>.csv`."""

PEERS = "benchmark_peers.csv"


def run(config: Any, datasets: int, out: Path) -> None:
    """Time the kernel and its peers, find the cheapest setting, and what skipping saves.

    Every backend and number of threads is timed in a process of its own, the peers
    in that of numpy, so that ratios hold. The machine should do nothing else meanwhile.

    Parameters
    ----------
    config : stage config (seed, scene … optics, noise, benchmark)
    datasets : datasets that share the stars
    out : folder that receives a CSV for each of `TABLES`
    """
    import pandas as pd

    described = timing.machine()
    limit_threads(1)  # batches run side by side
    scene = scene_of(config)
    cases, convergence = build_cases(scene)
    table = _time_everything(config, cases)
    threads, jobs = config.benchmark.threads, _savings(config, scene, cases, datasets)
    savings = timing.in_fresh_process(threads, timing.call_all, jobs)
    times = kernel_times(table, config)
    per_rung = max(2, config.benchmark.stamps // 2)
    sample = choice.take_sample(scene, per_rung, config.benchmark.peers)
    rows = [row for part in savings for row in (part if isinstance(part, list) else [part])]
    rows += skipping.finer_than_needed(scene, sample, times)
    described |= {"threads": str(threads)}
    machine = [(scene.name, item, value) for item, value in described.items()]
    frames = {
        "propagation": table,
        "convergence": pd.DataFrame(convergence),
        "choice": choice.choose(scene, sample, times),
        "guard": choice.guard_or_budget(scene, sample),
        "skipping": pd.DataFrame(rows, columns=list(skipping.COLUMNS)),
        "machine": pd.DataFrame(machine, columns=["scene", "item", "value"]),
    }
    for name in TABLES:
        write_text(out / f"{name}.csv", _csv(frames[name]))


def scene_of(config: Any) -> Scene:
    """The scene of a stage config, with the wavefronts that its stages would use."""
    templates = template_wavefronts(config)
    stars, search_px = templates, config.framing.search_px
    if config.stars.aberration_fraction > 0:
        rng = stream(config.seed, "field", config.stars.name)
        stars = star_wavefronts(config, assign_fields(config.stars.count, len(templates), rng))
        search_px = config.stars.search_px
    return Scene(
        config.scene.name,
        config.telescope,
        config.optics,
        config.framing,
        templates,
        stars,
        search_px,
        error_budget(config.noise.kappa, config.noise.levels),
    )


def _time_everything(config: Any, cases: Sequence[Case]):  # type: ignore[no-untyped-def]
    """Rows of both backends and of the peers as one table."""
    optics, benchmark = config.optics, config.benchmark
    load = (benchmark.repeats, benchmark.stamps)
    rows = []
    for backend in ("numpy", "torch"):
        settings = [
            propagation.kernel_settings(optics, benchmark, case.samples, backend) for case in cases
        ]
        for threads in sorted({s.threads for some in settings for s in some}):
            chosen = [[s for s in some if s.threads == threads] for some in settings]
            beside: list[list[peers.Peer]] = [[] for _ in cases]
            if (backend, threads) == ("numpy", benchmark.threads):
                beside = [peers.peers_of(case, benchmark.peers) for case in cases]
            work = (cases, chosen, beside, threads, *load)
            rows += timing.in_fresh_process(threads, peers.time_methods, *work)
    used = {
        case.aberration: propagation.configured_setting(optics, benchmark, case.samples)
        for case in cases
    }
    return propagation.finish(rows, used)


def kernel_times(table: Any, config: Any) -> dict[tuple[int, int, str], float]:
    """Time of a stamp in ms by (samples, nodes, precision), mean over the cases.

    Parameters
    ----------
    table : DataFrame
        Result of `psfdae.benchmark.propagation.finish`.
    config : stage config; backend and batch are its own, threads the benchmark's
    """
    wanted = table[
        (table["method"] == "kernel")
        & (table["backend"] == config.optics.backend)
        & (table["threads"] == config.benchmark.threads)
        & (table["batch"] == propagation.batch_of(config.optics, config.benchmark))
    ]
    means = wanted.groupby(["samples", "nodes", "precision"])["time_ms"].mean()
    return {(int(n), int(q), str(p)): float(t) for (n, q, p), t in means.items()}


def _savings(config: Any, scene: Scene, cases: Sequence[Case], datasets: int) -> list[Any]:
    """Functions with arguments that make the rows of the savings which need a clock."""
    benchmark, strong = config.benchmark, cases[-1]
    levels = len(config.noise.levels)
    jobs: list[Any] = [
        (skipping.superfluous_optics, (scene, cases, benchmark)),
        (skipping.repeated_work, (scene, benchmark, config.stars.count, levels, datasets)),
    ]
    if config.wavefront.kind == "seidel":
        monomials = scene.stars.coefficients[strong.source.index[0]]  # type: ignore[attr-defined]
        undistorted = _other_templates(config, distortion=0.0)
        return [
            *jobs,
            (wavefronts.superfluous_seidel_terms, (scene, strong, monomials, benchmark)),
            (wavefronts.dropped_distortion, (scene, strong, monomials, undistorted, benchmark)),
        ]
    tilted = _other_templates(config, remove_tilt=False)
    doubled = _other_templates(config, waves=2 * config.wavefront.waves)
    return [
        *jobs,
        (wavefronts.removed_tilt, (scene, strong, tilted, benchmark)),
        (wavefronts.doubled_waves, (scene, strong, doubled, config.wavefront, benchmark)),
    ]


def _other_templates(config: Any, **wavefront: Any) -> Any:
    """The scene's static wavefronts with changed keys of the group `wavefront`."""
    changed = config.wavefront.model_copy(update=wavefront)
    return template_wavefronts(config.model_copy(update={"wavefront": changed}))


def imports(config: Any, out: Path) -> None:
    """Time the import of packages that no stage of scenes 1 and 2 loads.

    Parameters
    ----------
    config : stage config of `propagation`
    out : CSV with the columns of the savings
    """
    import pandas as pd

    # The others take seconds each to import.
    packages = skipping.PACKAGES if config.benchmark.peers else skipping.PACKAGES[:1]
    rows = skipping.imports(config.benchmark.repeats, packages)
    write_text(out, _csv(pd.DataFrame(rows, columns=list(skipping.COLUMNS))))


def tables(scenes: Sequence[Path], extra: Sequence[Path], out: Path) -> None:
    """Join the tables of the scenes and compare with the peers.

    Parameters
    ----------
    scenes : folders of the stage `propagation`
    extra : CSV files with more rows of savings
    out : folder that receives `benchmark_<name>.csv` for each of `TABLES`, and `PEERS`

    Raises
    ------
    ProductError
        If a file of savings has other columns.
    """
    import pandas as pd

    for name in TABLES:
        parts = [read_table(folder / f"{name}.csv", dtype=_TEXT.get(name)) for folder in scenes]
        if name == "skipping":
            parts += [_read_savings(path) for path in extra]
        joined = pd.concat(parts, ignore_index=True)
        write_text(out / f"benchmark_{name}.csv", _csv(joined))
        if name == "propagation":
            write_text(out / PEERS, _csv(peers.compare(joined)))


_TEXT: dict[str, Any] = {"machine": str, "choice": {"ladder": str}}
"""Columns that must not turn into numbers, by table."""


def _read_savings(path: Path):  # type: ignore[no-untyped-def]

    table = read_table(path, keep_default_na=False)
    if tuple(table.columns) != skipping.COLUMNS:
        raise ProductError(
            f"{path}: columns {list(table.columns)}, expected {list(skipping.COLUMNS)}"
        )
    return table


def _csv(table: Any) -> str:
    text: str = table.to_csv(index=False, float_format="%.5g")
    return text


def figure_propagation(table: Path, scene: str, out: Path) -> None:
    """Draw error against time of every method of a scene.

    Parameters
    ----------
    table : `benchmark_propagation.csv`
    scene : name of the scene
    out : path of the PNG

    Raises
    ------
    ProductError
        If the table has no rows of the scene.
    """

    from psfdae.evaluation.benchmark_figures import propagation_front
    from psfdae.stages.figures import write_png

    rows = read_table(table)
    rows = rows[rows["scene"] == scene]
    if rows.empty:
        raise ProductError(f"{table}: no rows of scene {scene}")
    write_png(propagation_front(rows, scene), out)


def figure_skipping(table: Path, out: Path) -> None:
    """Draw the time with and without what the scenes skip.

    Parameters
    ----------
    table : `benchmark_skipping.csv`
    out : path of the PNG
    """

    from psfdae.evaluation.benchmark_figures import savings
    from psfdae.stages.figures import write_png

    write_png(savings(read_table(table, keep_default_na=False)), out)
