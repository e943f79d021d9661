"""Fits of the methods: their files, resources, bundles, and the options of commands for them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import product
from typing import Any

from psfdae.methods import fit_files, method
from psfdae.methods.interface import HISTORY, Method
from psfdae_paper.configuration.methods import list_methods
from psfdae_paper.source import source_hash
from psfdae_paper.workflow.run import (
    BUNDLE_SUFFIX,
    Run,
    Wildcards,
    hash_code,
    load_dataset_config,
    remove_module_name,
    settings,
)

WILDCARDS = ("{dataset}", "{split}", "{reference}")


def method_names(run: Run, dataset: str) -> list[str]:
    """Return the names of a dataset's methods, in the order of tables."""
    return list(load_dataset_config(run, dataset).methods)


def list_stored_methods(run: Run, dataset: str) -> list[type[Method]]:
    """Return the methods of a dataset whose fit writes files."""
    return [m for m in map(method, method_names(run, dataset)) if m.storage]


def locate_fit(run: Run, name: str, dataset: str, split_name: str, reference: str) -> str:
    """Return the path of a fit, a folder or a file."""
    return f"{run.results}/{fit_files.get_fit_path(method(name), dataset, split_name, reference)}"


def fit_outputs(run: Run, name: str, *key: str) -> list[str]:
    """Return all files of a fit of a dataset, split and reference; by default with wildcards."""
    # With wildcards, these are the outputs of a rule; with a key, the inputs of a job.
    path = locate_fit(run, name, *(key or WILDCARDS))
    return [str(file) for file in fit_files.outputs(method(name), path)]


def fit_option(run: Run, name: str, *key: str) -> str:
    """Return the option that gives a command the fit of a dataset, split and reference."""
    return f"--{name.replace('_', '-')}={locate_fit(run, name, *key)}"


def list_fit_files(run: Run, *key: str) -> list[str]:
    """Return the files of all fits of a dataset, split and reference."""
    return [p for m in list_stored_methods(run, key[0]) for p in fit_outputs(run, m.name, *key)]


def fit_options(run: Run, *key: str) -> list[str]:
    """Return the options that give a command all fits of a dataset, split and reference."""
    return [fit_option(run, m.name, *key) for m in list_stored_methods(run, key[0])]


def start_files(run: Run, name: str) -> Callable[[Wildcards], dict[str, list[str]]]:
    """Return an input function: the fit to realisations from which the fit to templates starts.

    Its result is empty for fits to the realisations, and where fits start from scratch.
    """

    def start(wildcards: Wildcards) -> dict[str, list[str]]:
        # Rules of fits that do not depend on the reference lack this wildcard.
        if wildcards.get("reference") != "template":
            return {}
        if not method(name).continues(load_dataset_config(run, wildcards.dataset)):
            return {}
        key = (wildcards.dataset, wildcards.split, "realisation")
        return {"start": fit_outputs(run, name, *key)}

    return start


def fit_log(name: str) -> str:
    """Return the path of the log of a fit, relative to the folder of logs, without suffix."""
    fit_method = method(name)
    stem = fit_files.stem(fit_method, *WILDCARDS)
    return f"{fit_files.get_rule_name(fit_method)}/{stem}"


def fit_params(run: Run, name: str) -> dict[str, Any]:
    """Return the parameters of a rule that fits a method.

    Parameters
    ----------
    run : Run
        Run of the job.
    name : str
        Name of the method.
    """
    # The checkpoint is named like the fit: fits that run at the same time do not share one.
    stem = fit_files.stem(method(name), *WILDCARDS)

    # Functions: settings are composed when the job is planned, not when rules are read.
    def config(wildcards: Wildcards) -> str:
        return settings(run, "fit", f"dataset={wildcards.dataset}", name=name)

    def options(wildcards: Wildcards, input: Any) -> list[str]:
        reference = wildcards.get("reference")
        words = [f"--reference={reference}"] if reference else []
        # `start_files` gives this input to fits to templates only.
        if input.get("start"):
            key = (wildcards.dataset, wildcards.split, "realisation")
            words.append(f"--start={locate_fit(run, name, *key)}")
        return words

    return {
        "config": config,
        "source": hash_code("fit", method(name).__module__),
        "method": name,
        "more": options,
        "path": locate_fit(run, name, *WILDCARDS),
        # Not an output: Snakemake would delete it with the outputs of a job that fails.
        "checkpoint": f"{run.results}/checkpoints/{name}/{stem}.pt",
    }


def fit_resources(name: str) -> dict[str, int]:
    """Return memory in MB and time in minutes of a fit."""
    # The scheduler of a cluster reserves these, and kills jobs that exceed them.
    needs = method(name).needs
    return {"mem_mb": needs.memory_mb, "runtime": needs.minutes}


def fit_threads(run: Run, name: str) -> Callable[[Wildcards], int]:
    """Return the number of threads of a fit, as a function of wildcards."""
    return lambda wildcards: method(name).threads(load_dataset_config(run, wildcards.dataset))


def most_threads(run: Run, dataset: str) -> int:
    """Return the largest number of threads of the fits of a dataset's methods."""
    # For a job that fits all methods, one after the other.
    config = load_dataset_config(run, dataset)
    return max([m.threads(config) for m in list_stored_methods(run, dataset)], default=1)


def list_new_rules(names: Iterable[str]) -> dict[str, str]:
    """Return rules and names of the methods that store a fit and whose rule is not in `names`.

    These are methods of other packages: rules of our own methods are written out. In the workflow
    of another project, all names begin with the name of its module and an underscore.
    """
    own_rules = remove_module_name(names, "baseline")
    methods_by_rule = {fit_files.get_rule_name(m): m.name for m in list_methods() if m.storage}
    return {rule: name for rule, name in methods_by_rule.items() if rule not in own_rules}


# Bundles.


def bundle_suffixes() -> dict[str, str]:
    """Return the names of the methods that can be saved as bundles, by the suffix of these."""
    return {
        fit_files.get_bundle_suffix(m): m.name for m in list_methods() if m.storage and m.packing
    }


def bundle_file(run: Run, dataset: str, split_name: str, reference: str, suffix: str) -> str:
    """Return the bundle of a fit; each method has its own suffix."""
    return f"{run.results}/bundles/{dataset}-{split_name}-{reference}{suffix}{BUNDLE_SUFFIX}"


def bundle_files(run: Run, dataset: str, pairs: Iterable[tuple[str, str]]) -> list[str]:
    """Return the bundles of a dataset's methods for some pairs of split and reference."""
    return [
        bundle_file(run, dataset, split_name, reference, fit_files.get_bundle_suffix(m))
        for m in list_stored_methods(run, dataset)
        if m.packing
        for split_name, reference in pairs
    ]


def bundle_memory(suffix: str) -> int:
    """Return the memory in MB for a bundle: of its fit, at least 1500 for errors of many stars."""
    return max(1500, fit_resources(bundle_suffixes()[suffix])["mem_mb"])


def identify_fit(wildcards: Wildcards) -> tuple[str, str, str, str]:
    """Return method, dataset, split and reference of the fit from which a bundle is written."""
    # The suffix of a bundle names its method.
    name = bundle_suffixes()[wildcards.suffix]
    return name, wildcards.dataset, wildcards.split, wildcards.reference


def seed_fits(run: Run, wildcards: Wildcards) -> list[str]:
    """Return the files of a method's fits with the default seed; empty if it stores no fit."""
    if method(wildcards.method).storage is None:
        return []
    # Other seeds are compared with the default seed on the random split only.
    references = load_dataset_config(run, wildcards.dataset).dataset.references
    return [
        file
        for reference in references
        for file in fit_outputs(run, wildcards.method, wildcards.dataset, "random", reference)
    ]


# Code of commands, and histories of trainings.


def estimators_code(run: Run, command: str, dataset: str) -> str:
    """Return the hash of the code of a command that applies the methods of a dataset."""
    return methods_code(command, method_names(run, dataset))


def methods_code(command: str, names: Iterable[str]) -> str:
    """Return the hash of the code of a command that applies some methods."""
    return source_hash(command, *(method(name).__module__ for name in names))


def histories(run: Run, dataset: str) -> dict[str, str]:
    """Return the tables with the histories of a dataset's trainings, each with its label."""
    # Not every method writes a table with the history of its training.
    group = load_dataset_config(run, dataset).dataset
    methods = list_stored_methods(run, dataset)
    trainings = [m for m in methods if HISTORY in fit_files.get_storage(m).diagnostics]
    labels = {}
    for m, *key in product(trainings, group.splits, group.references):
        path = locate_fit(run, m.name, dataset, *key)
        # The method's label distinguishes histories of several methods.
        words = [dataset, *key, *([m.look.label] if len(trainings) > 1 else [])]
        labels[str(fit_files.path_beside(m, path, HISTORY))] = ", ".join(words)
    return labels
