"""Stage `compare`: finished networks or tables of errors side by side, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from psfdae.errors import Error
from psfdae.files import ProductError, write_text
from psfdae.method import CONFIG, HISTORY
from psfdae.methods import method
from psfdae.options import File, Folder
from psfdae.reading import read_csv, read_table, read_yaml
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.methods import registered
from psfdae_paper.tracking import flatten

if TYPE_CHECKING:
    import pandas as pd


TABLE = "tables/psf_metrics.csv"
"""Mean errors of all methods, in a folder of results and in the run of record."""


class ComparisonError(Error, ValueError):
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
    are settings that differ, the trainings, and errors with their significance. Where a folder has
    tables alone, such as results/reference, the mean errors are compared: which are equal, and
    which differ by more than seeds do.
    """
    if len(runs) < 2:
        raise ComparisonError("name at least two runs to compare")
    if all(map(_tables, runs)) and not all(map(_networks, runs)):
        first, *others = runs
        blocks = [describe_tables(first, other) for other in others]
    else:
        groups = ([read_run(*found) for found in group] for group in _groups(runs))
        blocks = [describe(first, other) for first, *others in groups for other in others]
    text = "\n\n".join(blocks) + "\n"
    if out is not None:
        write_text(out, text)
    print(text, end="")


def _networks(folder: Path) -> set[Path]:
    """Folders of trained networks below a folder of results."""
    kinds = (kind.name for kind in registered() if kind.storage and CONFIG in kind.storage.files)
    paths = (path for name in kinds for path in folder.glob(f"{name}/*/*/{CONFIG}"))
    return {path.parent.relative_to(folder) for path in paths}


def _tables(folder: Path) -> list[Path]:
    """Tables of mean errors: of each evaluation of a run, or the joined one of a record."""
    joined = [path for path in [folder / TABLE] if path.is_file()]
    return sorted(folder.glob("evaluation/*/*.csv")) or joined


def _groups(folders: Sequence[Path]) -> list[list[tuple[Path, Path]]]:
    """(Folder of the network, table of its errors) of the runs that belong together."""
    if all((folder / CONFIG).is_file() for folder in folders):
        return [[(folder, errors_of(folder)) for folder in folders]]
    places = []
    for folder in folders:
        if not (found := _networks(folder)):
            raise ComparisonError(
                f"{folder}: no {CONFIG}, no METHOD/DATASET/RUN/{CONFIG} and no {TABLE} in it, "
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
    from psfdae_paper.evaluation.comparison import (
        SIGNIFICANT,
        compare_errors,
        config_differences,
        same_noisy_stars,
        seed_scatter,
        training_summary,
    )

    curves = [training_summary(run.history) for run in (first, second)]
    errors = compare_errors(first.errors, second.errors, seed_scatter())
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
            "times both together make B better or worse. Where the second was not measured "
            "(`snakemake seeds`), it is missing, and the first alone decides.",
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
    of_seeds = "" if row.seed_stderr != row.seed_stderr else f" ± {row.seed_stderr:.2g}"
    return f"{row.difference:+.3g} ± {row.stderr:.2g}{of_seeds}"


def read_errors(folder: Path) -> pd.DataFrame:
    """Mean errors of all methods in a folder of results; raises ProductError."""
    import pandas as pd

    from psfdae_paper.evaluation.comparison import CELL

    wanted = [*CELL, "method", "metric", "value", "stderr"]
    parts = {path: read_table(path) for path in _tables(folder)}
    for path, part in parts.items():
        if lacking := [name for name in wanted if name not in part]:
            raise ProductError(f"{path}: column {lacking[0]!r} is missing")
    return pd.concat([part[wanted] for part in parts.values()], ignore_index=True)


def describe_tables(first: Path, second: Path) -> str:
    """Markdown: which mean errors of two runs are equal, and which differ by more than seeds do."""
    from psfdae_paper.evaluation.comparison import (
        NEGLIGIBLE,
        PAPER_ORDER,
        SIGNIFICANT,
        compare_tables,
        seed_scatter,
    )

    both = read_errors(first), read_errors(second)
    rows, order = compare_tables(*both, seed_scatter())
    looks = [method(name).look for name in PAPER_ORDER]
    names = " < ".join(look.paper[1] for look in looks if look.paper)
    said = {
        "equal": "are equal to the last digit",
        "rounding": f"differ by less than {NEGLIGIBLE:g} of the standard error of the test stars, "
        "as by the rounding of another kind of processor",
        "within": f"differ within the scatter between seeds ({SIGNIFICANT:g} standard deviations "
        "of the difference of two fits)",
        "beyond": "differ by more",
        "not measured": "differ, but their scatter between seeds was not measured",
    }
    lines = [f"# {first} (A) and {second} (B)", ""]
    lines += [f"{len(rows)} mean errors are in both (A has {len(both[0])}, B {len(both[1])})."]
    for verdict, text in said.items():
        found = rows[rows.verdict == verdict]
        lines += [f"- {len(found)} {text}"]
        lines += [f"  - {name}" for name in _named(found)] * (verdict in ("beyond", "not measured"))
    lines += [
        f"- The paper's order by MSE, {names}, holds in {order['first'].sum()} of {len(order)} "
        f"columns of A and in {order['second'].sum()} of B; {order.exchanged.sum()} have two of "
        "them exchanged, beyond the scatter"
    ]
    lines += [f"  - {_cell(key)}" for key in order.index[order.exchanged]]
    return "\n".join(lines)


def _named(rows: pd.DataFrame) -> list[str]:
    """Rows of a table of errors by dataset, split and reference, in words."""
    lines = []
    for key, cell in rows.groupby(["dataset", "split", "reference"], sort=False):
        metrics: dict[str, list[str]] = {}
        for (name, metric), part in cell.groupby(["method", "metric"], sort=False):
            levels = ", ".join(f"{level:g}" for level in part.noise_level)
            metrics.setdefault(f"{name} at λ = {levels}", []).append(str(metric))
        found = (f"{name} ({', '.join(of)})" for name, of in metrics.items())
        lines.append(f"{_cell(key)}: {'; '.join(found)}")
    return lines


def _cell(key: Sequence[Any]) -> str:
    """Dataset, split, reference and, if given, noise level in words."""
    return ", ".join([*key[:3], *(f"λ = {level:g}" for level in key[3:])])


def _table(rows: Sequence[Sequence[object]], headers: Sequence[str]) -> str:
    from tabulate import tabulate

    if not rows:
        return "None."
    return tabulate(rows, headers, tablefmt="github", floatfmt=".4g", disable_numparse=[0])
