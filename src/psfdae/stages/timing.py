"""Stage `timing`: what baseline, inference and simulation cost, and how that grows.

Nothing else should run on the machine meanwhile. Every measurement runs in a
process of its own.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from psfdae.belonging import STARS, require
from psfdae.benchmark import throughput
from psfdae.benchmark.baseline import grid_around
from psfdae.benchmark.isolated import run_isolated
from psfdae.benchmark.scaling import fit_power_law
from psfdae.configuration.compose import stage_tree
from psfdae.files import read_product, write_text
from psfdae.reading import read_table
from psfdae.stages import timing_jobs

if TYPE_CHECKING:
    import pandas as pd

PREDICTED_STARS = 1_000_000
"""Number of stars for which time, memory and disk are extrapolated."""

LARGEST_BATCH_PER_STAMP = 16
"""Batches larger than this times `benchmark.stamps` are left out: small presets are fast."""

COSTS = ("time_s", "peak_mb", "disk_mb")


def baseline(config: Any, stars: Path, out: Path) -> None:
    """Time and error of PCA+SOM over components, map and epochs.

    Parameters
    ----------
    config : stage config `timing`
    stars : product "stars"
    out : CSV, columns components, rows, columns, epochs, used, fit_s,
        predict_stars_per_s, repeats, mse_realisation, mse_template (means over the
        test stars and the noise levels), n, threads
    """
    require(stars, read_product(stars, "stars", ()).config, STARS, config)
    used = config.baseline
    most = min(config.parts.train_stars, config.framing.stamp_px**2)
    points = grid_around(used.components, used.rows, used.columns, used.epochs, most)
    table = run_isolated(
        timing_jobs.baseline,
        used.threads,
        config=stage_tree("baseline", config.model_dump()),
        stars=str(stars.resolve()),
        points=points,
        repeats=config.benchmark.repeats,
    )
    for row in table:
        row["used"] = "yes" if row["used"] else "no"
    _write(out, [{**row, "threads": used.threads} for row in table])


def inference(config: Any, out: Path) -> None:
    """Stars per second over engine, threads, width, stamp and batch.

    Widths are half, once and twice the configured one; stamps are the two
    smallest of the config.

    Parameters
    ----------
    config : stage config `timing`
    out : CSV, columns engine, width, stamp_px, batch, threads, repeats,
        stars_per_s (median), stars_per_s_low, stars_per_s_high (of the repeats)
    """
    settings, width = config.benchmark, max(config.dae.widths)
    grid = {"widths": [width // 2, width, 2 * width], "stamps": settings.stamp_sizes[:2]}
    most = LARGEST_BATCH_PER_STAMP * settings.stamps
    batches = [batch for batch in throughput.BATCHES if batch <= most]
    network = {"kernels": config.dae.kernels, "scale": config.dae.scale}
    table: list[dict[str, Any]] = []
    with TemporaryDirectory() as folder:
        run_isolated(throughput.export_networks, 1, **network, **grid, folder=folder)
        grid |= {"batches": batches, "repeats": settings.repeats}
        for threads in sorted({1, settings.threads}):
            table += run_isolated(throughput.time_torch, threads, **network, **grid)
            table += run_isolated(throughput.time_onnxruntime, threads, folder=folder, **grid)
    _write(out, table)


def scaling(config: Any, out: Path) -> None:
    """Time, memory and disk of simulation and inference over stars and stamp side.

    Parameters
    ----------
    config : stage config `timing`
    out : CSV, columns what, against (stars or stamp_px), stars, stamp_px, time_s,
        peak_mb (above the interpreter with its imports), disk_mb, measured (yes or
        extrapolated), exponent and exponent_stderr (of time over `against`),
        peak_exponent, disk_exponent, threads
    """
    import pandas as pd

    counts, sides = config.benchmark.star_counts, config.benchmark.stamp_sizes
    own = config.framing.stamp_px
    with TemporaryDirectory() as folder:
        over_stars = [_chain(config, n, own, Path(folder)) for n in counts]
        over_sides = [_chain(config, counts[0], side, Path(folder)) for side in sides]
    frames = []
    for against, chains in (("stars", over_stars), ("stamp_px", over_sides)):
        table = pd.DataFrame([row for chain in chains for row in chain])
        for _, part in table.groupby("what", sort=False):
            frames.append(_with_exponents(part, against))
    _write(out, pd.concat(frames).assign(threads=config.benchmark.threads))


def _chain(config: Any, count: int, stamp_px: int, folder: Path) -> list[dict[str, Any]]:
    """Simulate stars, then predict their PSFs; one row each."""
    threads = config.benchmark.threads
    tree = config.model_dump()
    tree["stars"]["count"] = count
    tree["framing"]["stamp_px"] = stamp_px
    tree["optics"]["threads"] = threads
    templates, stars, psf = (str(folder / f"{name}.h5") for name in ("templates", "stars", "psf"))
    run_isolated(
        timing_jobs.make_templates, threads, config=stage_tree("templates", tree), out=templates
    )
    costs = {
        "simulation": run_isolated(
            timing_jobs.simulate,
            threads,
            config=stage_tree("stars", tree),
            templates=templates,
            out=stars,
        ),
        "inference": run_isolated(
            timing_jobs.infer,
            threads,
            kernels=config.dae.kernels,
            widths=config.dae.widths,
            scale=config.dae.scale,
            stars=stars,
            out=psf,
        ),
    }
    return [
        {"what": what, "stars": count, "stamp_px": stamp_px, **cost} for what, cost in costs.items()
    ]


def _with_exponents(part: pd.DataFrame, against: str) -> pd.DataFrame:
    """Measured rows with the exponents of their costs and, over stars, a predicted row.

    Time is predicted from the last measurement with the fitted exponent; memory and
    disk, which are a fixed part and so many bytes per star, by a straight line.
    """
    import numpy as np
    import pandas as pd

    x = part[against].to_numpy()
    laws = {cost: fit_power_law(x, part[cost].to_numpy()) for cost in COSTS}
    table = part.assign(measured="yes")
    if against == "stars":
        predicted = {
            cost: np.polynomial.Polynomial.fit(x, part[cost], 1)(PREDICTED_STARS)
            for cost in ("peak_mb", "disk_mb")
        }
        growth = (PREDICTED_STARS / x[-1]) ** laws["time_s"].exponent
        predicted["time_s"] = growth * part["time_s"].iloc[-1]
        row = {**part.iloc[0].to_dict(), "stars": PREDICTED_STARS, **predicted}
        table = pd.concat([table, pd.DataFrame([{**row, "measured": "extrapolated"}])])
    table.insert(1, "against", against)
    return table.assign(
        exponent=laws["time_s"].exponent,
        exponent_stderr=laws["time_s"].stderr,
        peak_exponent=laws["peak_mb"].exponent,
        disk_exponent=laws["disk_mb"].exponent,
    )


def _write(out: Path, table: Any) -> None:
    import pandas as pd

    write_text(out, pd.DataFrame(table).to_csv(index=False, float_format="%.6g"))


def figure(kind: str, table: Path, out: Path) -> None:
    """Draw a table of this stage.

    Parameters
    ----------
    kind : "baseline", "inference" or "scaling"
    table : CSV
    out : path of the PNG
    """

    from psfdae.evaluation import throughput_figures
    from psfdae.stages.figures import write_png

    draw = getattr(throughput_figures, f"{kind}_figure")
    write_png(draw(read_table(table)), out)
