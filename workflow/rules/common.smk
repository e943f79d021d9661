import shlex
from functools import cache

from snakemake.utils import validate

from psfdae.configuration.compose import ConfigError, as_overrides, config_dir
from psfdae.configuration.compose import compose, load, stage_tree
from psfdae.source import source_hash

validate(config, "../schemas/command_line.schema.yaml")

PRESET = config["preset"]
OVERRIDES = (f"preset={PRESET}", *shlex.split(config["set"] or ""))
RESULTS = config["results"] or ("results" if PRESET == "fast" else f"results/{PRESET}")


def options(group):
    """Options of a config group that can be chosen by name."""
    return sorted(path.stem for path in config_dir().glob(f"{group}/[!_]*.yaml"))


ALL_DATASETS = options("dataset")


wildcard_constraints:
    dataset="|".join(ALL_DATASETS),
    split="random|held_out",
    reference="realisation|template",
    scene="|".join(options("scene")),
    stars="|".join(options("stars")),
    metric="mse|ssim",


@cache
def dataset_config(dataset):
    """Checked configuration of a dataset; a wrong key stops before any job."""
    return load((f"dataset={dataset}", *OVERRIDES))


def stage_overrides(stage, choice):
    """The groups that a stage reads, as overrides: command line and rerun trigger in one."""
    chosen, option = choice.split("=")
    keep = [choice] if chosen in ("scene", "stars") else []
    tree = compose((choice, *OVERRIDES))
    return keep + as_overrides(stage_tree(stage, tree))


def default_datasets():
    return load(OVERRIDES).workflow.datasets


def templates_of(stars):
    tree = compose((f"stars={stars}", *OVERRIDES))
    return f"{RESULTS}/data/{tree['scene']['name']}/templates.h5"


def stars_of(dataset):
    tree = dataset_config(dataset)
    return f"{RESULTS}/data/{tree.scene.name}/{tree.stars.name}.h5"


def evaluations_of(dataset, splits=None):
    """Evaluation CSVs of a dataset, of all its splits unless some are named."""
    settings = dataset_config(dataset).dataset
    return [
        f"{RESULTS}/evaluation/{dataset}/{split}-{reference}.csv"
        for split in settings.splits
        for reference in settings.references
        if splits is None or split in splits
    ]


def paper_tables_of(dataset):
    return [
        f"{RESULTS}/tables/{dataset}_{metric}.{suffix}"
        for metric in ("ssim", "mse")
        for suffix in ("csv", "md")
    ]
