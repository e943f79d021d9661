"""The run that a command line of snakemake describes, and the settings and code of its jobs."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Protocol

from pydantic import Field

from psfdae.base.errors import Error, did_you_mean
from psfdae.base.files import as_yaml, write_text
from psfdae.base.reading import read_yaml
from psfdae.base.settings import ConfigError, Group, Name, parse_settings
from psfdae.commands.cli import stage
from psfdae_paper.configuration.compose import compose, load, part, select_overrides, write_settings
from psfdae_paper.configuration.experiment import Variant, load_experiment
from psfdae_paper.configuration.methods import list_noise_warnings
from psfdae_paper.configuration.schema import Config
from psfdae_paper.source import SOURCES, describe_machine, git_commit, source_hash

BENCHMARKS = os.path.relpath(SOURCES.parent / "workflow/benchmarks")
"""Folder of the programs that measure times, relative to the working directory."""
STRESS_TESTS = SOURCES.parent / "tests/stress"
BUNDLE_SUFFIX = ".psf.safetensors"
SCENE3 = "alignment"
"""The dataset with states of misalignment in place of stars."""

ShellWord = Annotated[str, Field(pattern=r"^([A-Za-z0-9_./+=@%:,][A-Za-z0-9_./+=@%:,-]*)?$")]
"""One word of a shell, and no option: commands of rules take it unquoted."""


class CommandLine(Group):
    """Words of snakemake's --config; all other settings are in the folder config."""

    preset: Name = "fast"
    """Option of the group config/preset."""
    set: str = ""
    """Hydra overrides for every dataset, separated by spaces."""
    sweep: Annotated[str, Field(pattern=r"^[A-Za-z0-9_]*$")] = ""
    """Sweep of a file of config/sweep, for the target sweep."""
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_]*$")] = ""
    """File of config/experiment, for the target experiment."""
    images: str = ""
    """Images of a night, as night/*.fits or a CSV list, for the target night."""
    telescope: str = ""
    """YAML file of the telescope that took the images of a night."""
    results: ShellWord = ""
    """Folder of the results; results for the preset fast, else results/PRESET. A finished run in it
    gives preset and set where the command has none."""


class Wildcards(Protocol):
    """Wildcards of a job, whose attributes depend on its rule."""

    def __getattr__(self, name: str) -> str: ...

    def get(self, name: str, default: str = "") -> str:
        """Return a wildcard, or a default where the rule lacks this name."""
        ...


@dataclass(frozen=True)
class Run:
    """A run of the workflow.

    Attributes
    ----------
    preset : str
        Option of the group config/preset.
    overrides : tuple of str
        Hydra overrides of every dataset; the first chooses the preset.
    results : str
        Folder of the results.
    is_folder_named : bool
        The command line names this folder, so that its run may be replaced.
    sweep, images, telescope : str
        As of `CommandLine`; empty if they are not given.
    experiment : str
        Name of the experiment; empty if there is none.
    variants : tuple of Variant
        Datasets with the overrides of the experiment.
    is_dry : callable
        Returns True if no file is to be written. Snakemake knows it after it has read all rules.
    """

    preset: str
    overrides: tuple[str, ...]
    results: str
    is_folder_named: bool = False
    sweep: str = ""
    images: str = ""
    telescope: str = ""
    is_dry: Callable[[], bool] = bool
    experiment: str = ""
    variants: tuple[Variant, ...] = ()


@contextmanager
def exit_in_one_line(prefix: str = "") -> Iterator[None]:
    """End the program with the message of an error of the package, without a traceback.

    Parameters
    ----------
    prefix : str
        Begins the message, for example with the dataset that was chosen.
    """
    try:
        yield
    except Error as error:
        sys.exit(f"psfdae: {prefix}{error}")


@exit_in_one_line()
def require_own_package(workflow_folder: str | Path) -> None:
    """End the program if package and rules belong to different clones.

    An environment is linked to the clone that made it. In a second clone, code and configuration
    of the first one would run.

    Parameters
    ----------
    workflow_folder : str or Path
        Folder of the Snakefile.
    """
    root, folder = SOURCES.parent, Path(workflow_folder).resolve()
    # An installed package comes without the rules.
    if (root / "workflow/Snakefile").is_file() and (root / "workflow").resolve() != folder:
        raise ConfigError(
            f"rules of {folder.parent}, but the package of {root}: run `make env` in "
            f"{folder.parent}, or set PYTHONPATH={folder.parent / 'src'}"
        )


@exit_in_one_line()
def read_run(words: Mapping[str, Any], is_dry: Callable[[], bool] = bool) -> Run:
    """Return the run that a command line describes; end the program if a word is wrong.

    Preset and overrides that are not given are taken from the finished run in the folder, so that
    the folder's name is enough for a further target of this run.

    Parameters
    ----------
    words : mapping
        Snakemake's `config`.
    is_dry : callable
        See `Run`.
    """
    # An empty word, such as sweep=, means the default.
    options = {key: value for key, value in words.items() if value}
    option_names = list(CommandLine.model_fields)
    for word in set(options) - set(option_names):
        hint = did_you_mean(word, option_names)
        raise ConfigError(f"--config {word}: there are {', '.join(option_names)}{hint}")
    earlier_run = read_finished_run(str(options["results"])) if "results" in options else {}
    # An experiment has a preset of its own.
    experiment = load_experiment(str(options["name"])) if "name" in options else None
    own_preset = {"preset": experiment.preset} if experiment else {}
    line = parse_settings(CommandLine, {**earlier_run, **own_preset, **options})
    # As in a shell, so that an override may contain quoted spaces.
    try:
        overrides = (f"preset={line.preset}", *shlex.split(line.set))
    except ValueError as error:
        raise ConfigError(f"set = {line.set!r}: {error}") from None
    # Presets have separate folders, so that a quick run never replaces a long one.
    default_folder = "results" if line.preset == "fast" else f"results/{line.preset}"
    return Run(
        line.preset,
        overrides,
        line.results or default_folder,
        bool(line.results),
        line.sweep,
        line.images,
        line.telescope,
        is_dry,
        line.name,
        experiment.variants if experiment else (),
    )


def read_finished_run(folder: str) -> dict[str, str]:
    """Return preset and overrides (`set`) of the finished run in a folder; empty without one.

    Raises
    ------
    ConfigError, ProductError
        If the record `run.yaml` is damaged.
    """
    record = Path(folder, "run.yaml")
    if record.is_file():
        tree = read_yaml(record)
        if not isinstance(tree, dict):
            raise ConfigError(f"{record}: must be a mapping")
        return {key: tree[key] for key in ("preset", "set") if key in tree}
    # Complete runs of earlier versions lack the record.
    return {"set": ""} if Path(folder, "runtime.csv").is_file() else {}


@exit_in_one_line()
def require_same_run(run: Run) -> None:
    """End the program before a run with other overrides is replaced in an unnamed folder.

    Points of sweeps are named by their content, and replace none; a night has its own folder.

    Parameters
    ----------
    run : Run
        Run that is about to start.
    """
    earlier_run = read_finished_run(run.results)
    if (run.is_folder_named and not run.experiment) or run.sweep or run.images or not earlier_run:
        return
    # The preset decides the default folder already; an experiment may be in a folder with a name.
    earlier_words, words = shlex.split(earlier_run.get("set") or ""), run.overrides[1:]
    if run.experiment and earlier_run.get("preset", run.preset) != run.preset:
        earlier_words, words = [f"preset={earlier_run['preset']}", *earlier_words], run.overrides
    missing = " ".join(word for word in earlier_words if word not in words)
    additional = " ".join(word for word in words if word not in earlier_words)
    texts = {"with": missing, "without": additional}
    if differences := [f"{word} {text}" for word, text in texts.items() if text]:
        purpose = "to replace it" if words else "to go on with it"
        raise ConfigError(
            f"{run.results} holds a finished run {' and '.join(differences)}; name a folder for "
            f"this one, RESULTS={run.results}/NAME, or RESULTS={run.results} {purpose} "
            "(snakemake: --config results=…)"
        )


def record_run(run: Run) -> None:
    """Write preset and overrides of a finished run into its folder, with commit, date and machine.

    The commit is the one with which the files of the run's target are up to date.
    """
    # Sweeps, experiments and nights add to a folder without changing the run in it.
    if not (run.sweep or run.images or run.experiment):
        record = {
            "preset": run.preset,
            "set": shlex.join(run.overrides[1:]),
            "commit": git_commit(),
            "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
            "machine": describe_machine(),
        }
        write_text(Path(run.results, "run.yaml"), as_yaml(record))


def close_target(words: Sequence[str], targets: Sequence[str]) -> str:
    """Return a line that names the target which a mistyped word resembles; empty if none does.

    Snakemake treats a mistyped target as a file without a rule. Values of options, such as
    mtime, resemble no target as much as a typing error does.

    Parameters
    ----------
    words : sequence of str
        Words of the command line.
    targets : sequence of str
        Names of all rules.
    """
    for word in words:
        # Paths and options are not identifiers; a file of this name is a valid target.
        if word.isidentifier() and word not in targets and not Path(word).exists():
            for name in get_close_matches(word, targets, n=1, cutoff=0.8):
                return f"psfdae: no target {word}; did you mean {name}?"
    return ""


# Configuration.


@exit_in_one_line()
def compose_choice(run: Run, *choice: str, extra: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the configuration of a choice with the run's overrides that concern it, unchecked.

    Parameters
    ----------
    run : Run
        Its overrides are selected by `select_overrides`.
    *choice : str
        Such as dataset=dataset3. A variant of an experiment is its dataset with its overrides.
    extra : tuple of str
        Further overrides of one job.
    """
    return compose((*list_words(run, *choice), *extra))


def list_words(run: Run, *choice: str) -> tuple[str, ...]:
    """Return a choice, and the overrides of the run and of a variant that concern it.

    Raises
    ------
    ConfigError
        If an option does not exist.
    """
    words = run.overrides
    for variant in run.variants:
        if f"dataset={variant.name}" in choice:
            choice, words = (f"dataset={variant.dataset}",), (*words, *variant.overrides)
            break
    return (*choice, *select_overrides(words, choice))


@cache
def load_dataset_config(run: Run, dataset: str) -> Config:
    """Return the checked configuration of a dataset; a wrong key ends the program."""
    # The message begins with the dataset, as one command may build several.
    choice = f"dataset={dataset}"
    names = {v.name: f"{v.dataset}, setting {v.setting}" for v in run.variants}
    with exit_in_one_line(f"dataset={names.get(dataset, dataset)}: "):
        config = load(list_words(run, choice))
    for line in list_noise_warnings(config) if dataset != SCENE3 else ():
        print(f"psfdae: {choice}: {line}", file=sys.stderr)
    return config


@cache
@exit_in_one_line()
def list_default_datasets(run: Run) -> list[str]:
    """Return the datasets that are built if the command line names none.

    Sizes that fit together in one dataset may not in another: they are checked where one is built.
    """
    names: list[str] = part(("workflow",), compose_choice(run)).workflow.datasets
    if SCENE3 in names:
        raise ConfigError(f"workflow.datasets: {SCENE3} is built by the target scene3")
    return names


# Settings and code of jobs.


@cache
@exit_in_one_line()
def settings(
    run: Run, name: str, /, *choice: str, extra: tuple[str, ...] = (), **options: str
) -> str:
    """Return the file with the settings that a stage reads, and write it unless the run is dry.

    The file's name follows from the settings that can change a result: another name repeats a job.

    Parameters
    ----------
    run : Run
        Run of the job.
    name : str
        Command, or module and function of a program in `BENCHMARKS`, such as "costs.cost".
    *choice : str
        Such as dataset=dataset3.
    extra : tuple of str
        Further overrides.
    **options : str
        Options of the command on which its groups of settings depend.
    """
    # Programs of the benchmarks are not commands of the package, but declare settings alike.
    program, _, function = name.rpartition(".")
    command: Any = getattr(import_benchmark(program), function) if program else stage(name)
    reader = command.stage.settings
    tree = compose_choice(run, *reader.choice, *choice, extra=extra)
    return write_groups(run, name, reader.names(options), tree)


def write_groups(run: Run, name: str, groups: tuple[str, ...], tree: Mapping[str, Any]) -> str:
    """Write groups of a configuration for a job; return the file's name.

    Snakemake does not record parameters that are paths, hence a text.
    """
    # Hidden, as these files are inputs of jobs and not results.
    folder = Path(run.results, ".settings")
    return str(write_settings(folder, name, groups, tree, dry=run.is_dry()))


def import_benchmark(name: str) -> Any:
    """Return the module of a program in `BENCHMARKS`."""
    folder = os.path.abspath(BENCHMARKS)  # noqa: PTH100 (keeps symbolic links)
    # The programs are not part of the package; each may import the others.
    if folder not in sys.path:
        sys.path.append(folder)
    return import_module(name)


def hash_code(*names: str) -> Callable[[Wildcards], str]:
    """Return a parameter with the hash of some code, computed where a job needs it.

    Names are commands, modules, or programs such as workflow/benchmarks/costs.py.
    """
    return lambda wildcards: source_hash(*names)


def locate_program(name: str) -> Callable[[Wildcards, int], str]:
    """Return a parameter with the file and the command of a program, such as "costs.cost".

    It depends on threads because Snakemake does not record such parameters: a run in another
    folder, with another relative path, does not repeat the job.
    """
    file, command = name.split(".")
    return lambda wildcards, threads: f"{BENCHMARKS}/{file}.py {command}"


def stress_code() -> str:
    """Return the hash of the stress tests."""
    return source_hash(*(f"tests/stress/{path.name}" for path in STRESS_TESTS.glob("*.py")))


def as_options(wildcards: Wildcards, input: Any) -> list[str]:
    """Return named inputs as options of the same names.

    The weights of a network stand for its folder; bundles have the same ending, and are files.
    """
    # A named input is a path or a list of paths.
    options = []
    for name, files in input.items():
        for path in [files] if isinstance(files, str) else files:
            is_weights = path.endswith(".safetensors") and not path.endswith(BUNDLE_SUFFIX)
            value = Path(path).parent if is_weights else path
            options.append(f"--{name.replace('_', '-')}={value}")
    return options


def match_any(names: Sequence[str]) -> str:
    """Return the pattern of a wildcard that is one of these names; "none" for an empty list."""
    return "|".join(names) or "none"


def remove_module_name(names: Iterable[str], own_name: str) -> set[str]:
    """Return the names of our rules without the name of the module, if the workflow is one.

    Parameters
    ----------
    names : iterable of str
        Names of all rules so far, which may include rules of another project.
    own_name : str
        One of our rules, which shows what comes before all of their names.
    """
    all_names = list(names)
    own_full_name = next(name for name in all_names if name.endswith(own_name))
    prefix = own_full_name.removesuffix(own_name)
    return {name.removeprefix(prefix) for name in all_names if name.startswith(prefix)}
