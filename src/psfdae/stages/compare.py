"""Stage `compare`: finished networks side by side, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from psfdae.cli import File, Folder, command
from psfdae.estimators import CONFIG, HISTORY, registered
from psfdae.files import ProductError, write_text
from psfdae.reading import read_csv, read_yaml
from psfdae.tracking import flatten

if TYPE_CHECKING:
    import pandas as pd


class ComparisonError(ValueError):
    """What was named cannot be compared."""


@dataclass(frozen=True)
class Run:
    """A trained network and what was measured on it."""

    name: str
    config: dict[str, str]
    history: pd.DataFrame
    errors: pd.DataFrame


@command("compare")
def compare(
    runs: Annotated[tuple[Folder, ...], {"argument": True}],
    out: Annotated[File | None, "Write the Markdown to this file, too."] = None,
) -> None:
    """Compare the first of some RUNS with each of the others.

    A run is the folder of a trained network, such as results/dae/dataset3/random-realisation
    or a point of a sweep; two folders of results compare all networks that both hold. Shown
    are settings that differ, the trainings, and errors with their significance.
    """
    if len(runs) < 2:
        raise ComparisonError("name at least two runs to compare")
    blocks = []
    for group in _groups(runs):
        first, *others = (read_run(*found) for found in group)
        blocks += [describe(first, other) for other in others]
    text = "\n\n".join(blocks) + "\n"
    if out is not None:
        write_text(out, text)
    print(text, end="")


def _groups(folders: Sequence[Path]) -> list[list[tuple[Path, Path]]]:
    """(Folder of the network, table of its errors) of the runs that belong together."""
    if all((folder / CONFIG).is_file() for folder in folders):
        return [[(folder, errors_of(folder)) for folder in folders]]
    networks = [kind.name for kind in registered() if CONFIG in kind.files]
    places = []
    for folder in folders:
        paths = [path for name in networks for path in folder.glob(f"{name}/*/*/{CONFIG}")]
        found = {path.parent.relative_to(folder) for path in paths}
        if not found:
            raise ComparisonError(
                f"{folder}: no {CONFIG} and no {' or '.join(networks)}/DATASET/RUN/{CONFIG} in it, "
                "hence neither a trained network nor a folder of results"
            )
        places.append(found)
    common = sorted(set.intersection(*places))
    if not common:
        raise ComparisonError(f"{', '.join(map(str, folders))}: no network in common")
    return [[(folder / at, errors_of(folder / at)) for folder in folders] for at in common]


def errors_of(folder: Path) -> Path:
    """Table of errors per star: beside the network, or where the workflow puts it."""
    beside = folder / "evaluation.parquet"
    if beside.is_file():
        return beside
    whole = folder.resolve()
    if len(whole.parents) < 3:
        raise ComparisonError(f"{folder}: no evaluation.parquet in it")
    return whole.parents[2] / "evaluation" / whole.parent.name / f"{whole.name}.parquet"


def read_run(folder: Path, errors: Path) -> Run:
    """Read a network's settings, curve and errors per star; raises ProductError."""
    import pandas as pd

    config = read_yaml(folder / CONFIG)
    rows = read_csv(folder / HISTORY, "epoch", "train_mse", "validation_mse", "seconds")
    try:
        table = pd.read_parquet(errors, page_checksum_verification=True)
    except FileNotFoundError:
        raise ProductError(f"{errors}: no such file; evaluate the run first") from None
    except (OSError, ValueError) as error:
        raise ProductError(f"{errors}: damaged ({error}); delete it and run again") from error
    history = pd.DataFrame(rows).apply(pd.to_numeric, errors="coerce")
    return Run(str(folder), flatten(config), history, table)


def describe(first: Run, second: Run) -> str:
    """Markdown with the differences between two runs."""
    from psfdae.evaluation.comparison import (
        SEED_SCATTER,
        SIGNIFICANT,
        compare_errors,
        config_differences,
        same_noisy_stars,
        training_summary,
    )

    curves = [training_summary(run.history) for run in (first, second)]
    errors = compare_errors(first.errors, second.errors, SEED_SCATTER)
    paired = same_noisy_stars(first.errors, second.errors)
    references = {run.config.get("reference", "") for run in (first, second)}
    warning = "The runs have different references: not the same question.\n\n"
    how = "star by star on the same noisy images" if paired else "as independent samples"
    return "\n\n".join(
        [
            f"# {first.name} (A) and {second.name} (B)",
            "## Settings that differ",
            _table(config_differences(first.config, second.config), ["setting", "A", "B"]),
            "## Training",
            _table([(key, curves[0][key], curves[1][key]) for key in curves[0]], ["", "A", "B"]),
            f"## Errors, {how}",
            ("" if len(references) == 1 else warning)
            + f"B − A ± standard error clustered by field ± scatter between seeds; {SIGNIFICANT:g} "
            "times both together make B better or worse.",
            _table(
                [
                    (*row[:5], _change(row), row.sigmas, row.verdict)
                    for row in errors.itertuples(index=False)
                ],
                ["metric", "method", "λ", "A", "B", "B − A", "standard errors", "B is"],
            ),
        ]
    )


def _change(row: Any) -> str:
    return f"{row.difference:+.3g} ± {row.stderr:.2g} ± {row.seed_stderr:.2g}"


def _table(rows: Sequence[Sequence[Any]], headers: Sequence[str]) -> str:
    from tabulate import tabulate

    if not rows:
        return "None."
    return tabulate(rows, headers, tablefmt="github", floatfmt=".4g", disable_numparse=[0])
