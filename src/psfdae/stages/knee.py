"""Stage `training_knee`: test error against training time on one dataset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.benchmark.training import knee, pareto, stopping_point
from psfdae.configuration.compose import decisive
from psfdae.estimators import CONFIG, HISTORY
from psfdae.estimators.dae import Dae
from psfdae.evaluation.metrics import mse
from psfdae.files import atomic_path, write_text
from psfdae.reading import read_table, read_yaml
from psfdae.stages.common import limit_threads, noisy_test_images, read_stars, split_stars

PATIENCE = 5
"""Validations without a better one after which a training has stopped improving."""


def run(config: Any, stars: Path, points: Mapping[str, Path], out: Path, stopping: Path) -> None:
    """Test every training on the same noisy stars and find the knee.

    The time is the CPU time of the training's one thread, which is its wall time
    on a quiet core; start-up and simulation are not in it.

    Parameters
    ----------
    config : stage config (seed, noise, parts, dae, train, evaluation)
    stars : product "stars" whose random test part is used
    points : folder of each training by name
    out : CSV, one row per point: settings, steps, cpu_s, wall_s, mse_<λ> at every
        level, mse (their geometric mean), n, pareto, knee, used (the configured one)
    stopping : CSV with what stopping early saves in the trainings of constant rate

    Raises
    ------
    ProductError
        If a training is damaged, or of stars of another kind.
    """
    import pandas as pd

    limit_threads(config.evaluation.threads)
    product = read_stars(stars)
    for folder in points.values():
        Dae.require(folder, product, config, "random", "realisation")
    images = product["realisation"][split_stars(product, "random", config).test]
    noisy = {level: noisy_test_images(config, images, level) for level in config.noise.levels}
    configured = decisive(config.model_dump(include={"dae", "train"}))
    rows = []
    for name, folder in points.items():
        network = Dae.load(folder, evaluation=config.evaluation)
        errors = [float(mse(network.predict(x), images).mean()) for level, x in noisy.items()]
        labels = [f"mse_{level:g}" for level in noisy]
        rows.append(
            {
                "point": name,
                **_settings(folder, configured),
                **_cost(folder),
                **dict(zip(labels, errors, strict=True)),
                "mse": float(np.exp(np.mean(np.log(errors)))),
                "n": len(images),
            }
        )
    table = pd.DataFrame(rows)
    time, error = table["cpu_s"].to_numpy(), table["mse"].to_numpy()
    # Other stars cost simulation time that is not in the column: shown, but not a candidate.
    same = np.flatnonzero(table["stars"] == "same")
    front, chosen = same[pareto(time[same], error[same])], same[knee(time[same], error[same])]
    table["pareto"] = np.where(np.isin(table.index, front), "yes", "no")
    table["knee"] = np.where(table.index == chosen, "yes", "no")
    write_text(out, table.to_csv(index=False, float_format="%.6g"))
    write_text(stopping, _stopping(points).to_csv(index=False, float_format="%.6g"))


def figure(table: Path, out: Path) -> None:
    """Draw the table of `run`."""

    from psfdae.evaluation.knee_figure import training_knee

    drawn = training_knee(read_table(table))
    with atomic_path(out) as temporary:
        drawn.savefig(temporary, format="png")


def _settings(folder: Path, configured: dict[str, Any]) -> dict[str, Any]:
    tree = decisive(read_yaml(folder / CONFIG))
    train = tree["train"]
    same = tree["parts"]["test_stars"] > 1
    return {
        "width": max(tree["dae"]["widths"]),
        **{key: train[key] for key in ("epochs", "batch", "lr", "schedule", "noise")},
        "stars": "same" if same else "fresh",
        "used": "yes" if same and all(tree[k] == configured[k] for k in configured) else "no",
    }


def _history(folder: Path):  # type: ignore[no-untyped-def]

    return read_table(folder / HISTORY)


def _cost(folder: Path) -> dict[str, float]:
    last = _history(folder).iloc[-1]
    return {"steps": int(last["step"]), "cpu_s": last["cpu_seconds"], "wall_s": last["seconds"]}


def _stopping(points: Mapping[str, Path]):  # type: ignore[no-untyped-def]
    import pandas as pd

    rows = []
    for name, folder in points.items():
        if read_yaml(folder / CONFIG)["train"]["schedule"] != "constant":
            continue
        history = _history(folder).dropna(subset=["validation_mse"])
        scores = history["validation_mse"].to_numpy()
        stop = stopping_point(scores, PATIENCE)
        with_s, without_s = history["cpu_seconds"].iloc[[-1, stop]]
        best = scores[: stop + 1].min()
        rows.append(
            {
                "item": f"training that has stopped improving ({name})",
                "scene": "seidel",
                "per": "training",
                "with_s": with_s,
                "without_s": without_s,
                "saving": with_s / without_s,
                "change": best / scores.min() - 1.0,
                "unit": "relative validation MSE",
                "skipped": "yes" if stop < scores.size - 1 else "no",
            }
        )
    return pd.DataFrame(rows)
