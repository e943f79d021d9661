import atexit
import hashlib
import os
import shlex
import sys
from contextlib import contextmanager
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from inspect import getdoc

from snakemake.report.common import data_uri_from_file
from snakemake.utils import validate

from psfdae.base.errors import did_you_mean
from psfdae.base.files import ProductError, as_yaml, write_text
from psfdae.base.reading import read_yaml
from psfdae.base.settings import ConfigError
from psfdae.commands.cli import stage
from psfdae.methods import fit_files, method
from psfdae.methods.interface import HISTORY
from psfdae_paper.configuration.base import config_dir
from psfdae_paper.configuration.compose import (
    compose,
    dataset_names,
    load,
    overrides_for,
    part,
    write_settings,
)
from psfdae_paper.configuration.consistency import simulation_changes
from psfdae_paper.configuration.methods import registered
from psfdae_paper.source import SOURCES, source_hash
from psfdae_paper.sweeps.points import SweepError


@contextmanager
def one_line():
    """A mistake in the configuration ends in its message; Snakemake adds a traceback."""
    try:
        yield
    except (ConfigError, ProductError, SweepError) as error:
        sys.exit(f"psfdae: {error}")


@one_line()
def finished_run(folder):
    """Preset and overrides of the run that was finished in a folder; empty if there is none."""
    record = Path(folder, "run.yaml")
    if record.is_file():
        return read_yaml(record)
    # A whole run of a version that wrote no record.
    return {"set": ""} if Path(folder, "runtime.csv").is_file() else {}


# What the command does not say is as in the folder that it names: further targets of a run.
CHOSEN_FOLDER = config.get("results")
config = {
    **(finished_run(CHOSEN_FOLDER) if CHOSEN_FOLDER else {}),
    **{key: value for key, value in config.items() if value},
}
schema = read_yaml(Path(workflow.source_path("../schemas/command_line.schema.yaml")))
for word in set(config) - set(schema["properties"]):
    hint = did_you_mean(word, schema["properties"])
    sys.exit(
        f"psfdae: --config {word}: there are {', '.join(schema['properties'])}{hint}"
    )
validate(config, "../schemas/command_line.schema.yaml")

PRESET = config["preset"]
try:
    GIVEN = (f"preset={PRESET}", *shlex.split(config["set"]))
except ValueError as error:
    sys.exit(f"psfdae: set = {config['set']!r}: {error}")
RESULTS = config["results"] or ("results" if PRESET == "fast" else f"results/{PRESET}")


def keep_finished_run():
    """Stop before a run with other overrides is replaced in a folder that was not named."""
    run = finished_run(RESULTS)
    # Points of sweeps are named by their content, and replace none; a night has its own folder.
    if CHOSEN_FOLDER or config["sweep"] or config["images"] or not run:
        return
    finished_words, words = shlex.split(run.get("set") or ""), GIVEN[1:]
    lost = " ".join(word for word in finished_words if word not in words)
    added = " ".join(word for word in words if word not in finished_words)
    if lost or added:
        difference = " and ".join(
            [f"with {lost}"] * bool(lost) + [f"without {added}"] * bool(added)
        )
        purpose = "to replace it" if words else "to go on with it"
        sys.exit(
            f"psfdae: {RESULTS} holds a finished run {difference}; name a folder for this one, "
            f"RESULTS={RESULTS}/NAME, or RESULTS={RESULTS} {purpose} (snakemake: --config results=…)"
        )


def record_finished_run():
    """Write preset and overrides of a run into its folder."""
    if not (config["sweep"] or config["images"]):
        record = {"preset": PRESET, "set": shlex.join(GIVEN[1:])}
        write_text(Path(RESULTS, "run.yaml"), as_yaml(record))


@one_line()
def composed(*choice, more=()):
    """Configuration of a choice, with those of the given overrides that concern it."""
    return compose((*choice, *overrides_for(GIVEN, choice), *more))


def options(group):
    """Options of a config group that can be chosen by name."""
    return sorted(path.stem for path in config_dir().glob(f"{group}/[!_]*.yaml"))


BENCHMARKS = os.path.relpath(SOURCES.parent / "workflow/benchmarks")
sys.path.append(os.path.abspath(BENCHMARKS))


def program(name):
    """Param with program and command; it asks for threads, lest another folder repeat the job."""
    file, command = name.split(".")
    return lambda w, threads: f"{BENCHMARKS}/{file}.py {command}"


def program_code(name, stages):
    """Hash of a command of a program, and of the stages that it runs."""
    return source_hash(f"workflow/benchmarks/{name.partition('.')[0]}.py", *stages)


# Stars of an image are not simulated: own_stars.smk.
OWN_STARS = "from_stars"
# Scene 3 has states of misalignment in the place of stars: alignment.smk.
SCENE3 = "alignment"
ALL_DATASETS = [name for name in dataset_names() if name not in (OWN_STARS, SCENE3)]
# Data of telescopes that bring their own aberrations; they bear the dataset's name.
OWN_TELESCOPES = f"{RESULTS}/data/telescope"
SCENE_HEADINGS = {
    "scene1": "Scene 1: field-dependent aberrations",
    "scene2": "Scene 2: static turbulence",
    "own_telescope": "Own telescopes",
}
METRICS = ("ssim", "mse")
# The datasets that the paper tabulates; calibration compares with their rows.
TABULATED = ["dataset3", "dataset5", "dataset8"]


wildcard_constraints:
    dataset="|".join(ALL_DATASETS),
    split="random|held_out",
    reference="realisation|template",
    scene="|".join(options("scene")),
    stars="|".join(options("stars")),


@cache
def dataset_config(dataset):
    """Checked configuration of a dataset that is built; a wrong key stops before any job."""
    choice = f"dataset={dataset}"
    try:
        return load((choice, *overrides_for(GIVEN, (choice,))))
    except ConfigError as error:
        sys.exit(f"psfdae: {choice}: {error}")


@cache
@one_line()
def settings(name, /, *choice, more=(), **options):
    """File with the settings that a stage reads, where a choice is made (dataset=…).

    The name is that of a command, or module and function of a program of `BENCHMARKS`.
    Its name follows from those that can change a result: another name repeats a job.
    Options are those of the command on which it depends what is read.
    """
    program, _, function = name.rpartition(".")
    stage_of = getattr(import_module(program), function) if program else stage(name)
    spec = stage_of.stage.settings
    reads = spec.names(options)
    tree = composed(*spec.choice, *choice, more=more)
    folder = Path(RESULTS, ".settings")
    # As text: Snakemake does not remember params that are paths.
    return str(write_settings(folder, name, reads, tree, dry=workflow.dryrun))


@cache
@one_line()
def default_datasets():
    """What is built if no dataset is asked for.

    Sizes that fit together in one dataset may not in another: that counts where one is built.
    """
    names = part(("workflow",), composed()).workflow.datasets
    if SCENE3 in names:
        raise ConfigError(f"workflow.datasets: {SCENE3} is built by the target scene3")
    return names


def templates_of(stars):
    tree = composed(f"stars={stars}")
    return f"{RESULTS}/data/{tree['scene']['name']}/templates.h5"


@cache
@one_line()
def stars_of(dataset):
    """Stars of a dataset: those of a file of config/stars, or of its own telescope.

    A file of stars serves several datasets, and decides all that is simulated: a dataset that changes
    a group of it would get the stars of the others, and is refused.
    """
    tree = dataset_config(dataset)
    name = tree.stars.name
    # Datasets of own telescopes have stars of their own (own_telescope.smk).
    if tree.scene.name != "telescope":
        file = os.path.relpath(config_dir() / f"stars/{name}.yaml")
        advice = "other stars have a file there, NAME.yaml with stars.name: NAME"
        if name not in options("stars"):
            raise ConfigError(
                f"dataset={dataset}: stars.name = {name}: no {file}; {advice}"
            )
        changes = simulation_changes(
            composed(f"dataset={dataset}"), composed(f"stars={name}")
        )
        for key, value, simulated_value in changes:
            raise ConfigError(
                f"dataset={dataset}: {key} = {value}, but its stars are those of {file} with "
                f"{simulated_value}; {advice} and this setting, which a dataset chooses by "
                "'override /stars: NAME' among its defaults"
            )
    return f"{RESULTS}/data/{tree.scene.name}/{name}.h5"


def evaluations_of(dataset, splits=None, folder="evaluation"):
    """Evaluation CSVs of a dataset, of all its splits unless some are named."""
    settings = dataset_config(dataset).dataset
    return [
        f"{RESULTS}/{folder}/{dataset}/{split}-{reference}.csv"
        for split in settings.splits
        for reference in settings.references
        if splits is None or split in splits
    ]


def paper_tables_of(dataset):
    return [
        f"{RESULTS}/tables/{dataset}_{metric}.{suffix}"
        for metric in METRICS
        for suffix in ("csv", "md")
    ]


def by_metric(w, output):
    """Options of a command that makes a file of each metric."""
    return [f"--out {metric} {output[metric]}" for metric in METRICS]


def category_of(w):
    """Heading of a figure in the report: the scene."""
    if "scene" in w.keys():
        experiment = composed(f"scene={w.scene}")["scene"]["experiment"]
    else:
        experiment = dataset_config(w.dataset).scene.experiment
    return SCENE_HEADINGS.get(experiment, experiment)


def networks_of(dataset):
    """Split and reference of each network of a dataset."""
    settings = dataset_config(dataset).dataset
    return [(s, r) for s in settings.splits for r in settings.references]


def shown_levels(dataset):
    """Noise levels of the figure of restored stars: those asked for that the band has."""
    settings = dataset_config(dataset)
    band = settings.noise.levels
    asked = [level for level in settings.dataset.shown_levels if level in band]
    return asked or sorted({min(band), max(band)})


def has_own_telescope(dataset):
    return dataset_config(dataset).scene.name == "telescope"


def figures_of(dataset):
    """Figures of a dataset and of its scene, or of its own telescope."""
    settings, folder = dataset_config(dataset), f"{RESULTS}/figures"
    if has_own_telescope(dataset):
        fields = [f"telescope/{settings.stars.name}"]
    else:
        fields = [f"{settings.scene.name}/{name}" for name in ("templates", "energy")]
    return [
        *(f"{folder}/{field}.png" for field in fields),
        *([f"{folder}/{dataset}/curves.png"] if histories_of(dataset) else []),
        *(f"{folder}/{dataset}/errors_{metric}.png" for metric in METRICS),
        *(f"{folder}/{dataset}/strip_{r}.png" for r in settings.dataset.references),
    ]


def products_of(dataset):
    """Everything that a dataset's target builds."""
    networks = networks_of(dataset)
    return [
        *(bundles_of(dataset, networks) if has_own_telescope(dataset) else []),
        *evaluations_of(dataset),
        *paper_tables_of(dataset),
        *figures_of(dataset),
        f"{RESULTS}/mlflow/{dataset}.csv",
    ]


def products_of_scene(experiment):
    """Everything that the target of a scene builds: its datasets of the default target."""
    return [
        file
        for dataset in default_datasets()
        if dataset_config(dataset).scene.experiment == experiment
        for file in products_of(dataset)
    ]


def model_of(method, dataset, split, reference):
    """Folder or file of a fit."""
    return f"{RESULTS}/{fit_files.get_fit_path(method, dataset, split, reference)}"


def names_of(dataset):
    """Names of a dataset's methods."""
    return dataset_config(dataset).methods


def methods_of(dataset):
    """Methods of a dataset that leave a model."""
    return [m for m in map(method, names_of(dataset)) if m.storage]


def files_of(method, dataset, split, reference):
    """All files of a fit."""
    return [
        str(p)
        for p in fit_files.outputs(method, model_of(method, dataset, split, reference))
    ]


def option_of(method, dataset, split, reference):
    """Option of a command that takes a fit."""
    place = model_of(method, dataset, split, reference)
    return f"--{method.name.replace('_', '-')}={place}"


def fitted(dataset, split, reference):
    """Files of all models that restore stars of a split."""
    models = methods_of(dataset)
    return [path for m in models for path in files_of(m, dataset, split, reference)]


def model_options(dataset, split, reference):
    """Options of a command that takes these models."""
    return [option_of(m, dataset, split, reference) for m in methods_of(dataset)]


def bundles_of(dataset, networks):
    """Bundles of a dataset's methods, of some splits and references."""
    return [
        f"{RESULTS}/bundles/{dataset}-{split}-{reference}{fit_files.get_bundle_suffix(m)}.psf.safetensors"
        for m in methods_of(dataset)
        if m.packing
        for split, reference in networks
    ]


def estimators_source(command, dataset):
    """Hash of a command that applies the methods of a dataset."""
    names = names_of(dataset)
    return source_hash(command, *(method(name).__module__ for name in names))


def fit_threads(dataset):
    """Threads of the fits of a dataset's methods."""
    config = dataset_config(dataset)
    return max([m.threads(config) for m in methods_of(dataset)], default=1)


def histories_of(dataset):
    """Courses of the trainings of a dataset, and a label of each."""
    trained = [m for m in methods_of(dataset) if HISTORY in m.storage.diagnostics]
    return {
        str(
            fit_files.path_beside(m, model_of(m, dataset, split, reference), HISTORY)
        ): ", ".join([dataset, split, reference] + [m.look.label] * (len(trained) > 1))
        for m in trained
        for split, reference in networks_of(dataset)
    }


def start_of(method, w):
    """Fit to the realisations from which that to the templates goes on, if one does."""
    if w.get("reference") != "template" or not method.continues(
        dataset_config(w.dataset)
    ):
        return {}
    return {"start": files_of(method, w.dataset, w.split, "realisation")}
