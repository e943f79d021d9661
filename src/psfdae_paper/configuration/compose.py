"""Composition and check of settings: Hydra composes files of `config/`, pydantic checks them.

The input is a list of overrides such as `dataset=dataset3 preset=smoke noise.levels=[0.002]`, the
output a configuration in three forms, each computed from the previous one:

1. `compose`: a tree of plain values, defaults of the settings' classes included;
2. `load` (a whole dataset) and `load_stage` (the groups that a stage reads): checked models;
3. `write_settings`: a YAML file of these groups for a job, which `load_settings` reads again.

`select_overrides` selects the overrides of a workflow that concern one dataset.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

from psfdae.base.errors import did_you_mean
from psfdae.base.files import ProductError, write_text
from psfdae.base.reading import parse_yaml
from psfdae.base.settings import ConfigError, Group, dump_deciding, leaves, parse_settings
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.base import config_dir
from psfdae_paper.configuration.consistency import build_stage_class, fill_derived_values
from psfdae_paper.configuration.estimators import list_trained_networks
from psfdae_paper.configuration.methods import list_method_groups, methods_in
from psfdae_paper.configuration.schema import Config, build_config_class


def compose(overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Resolve a list of Hydra overrides to a configuration tree, not yet checked.

    Hydra takes about 0.25 s for each list; the same list is composed once in a process.

    Parameters
    ----------
    overrides : sequence of str
        Such as `dataset=dataset3`, `preset=smoke` or `noise.levels=[0.002]`.

    Returns
    -------
    dict
        Values by group and key. It is shared by all callers: do not change it.

    Raises
    ------
    ConfigError
        If Hydra rejects an override (unknown key or group option, bad syntax).
    """
    return _compose_with_hydra(tuple(overrides))


def clear_caches() -> None:
    """Compose everything anew, for example after a change of the config folder."""
    _compose_with_hydra.cache_clear()
    methods_in.cache_clear()


@cache
def _compose_with_hydra(overrides: tuple[str, ...]) -> dict[str, Any]:
    """Compose with Hydra, and resolve all references between keys."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from omegaconf import OmegaConf

    folder = config_dir()
    # Hydra has one global state, which an earlier composition leaves behind.
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(folder), version_base="1.3"):
            tree = hydra.compose(_primary(folder), overrides=list(overrides))
        # Plain values, with ${…} replaced by the keys that they name.
        values: Any = OmegaConf.to_container(tree, resolve=True, throw_on_missing=True)
    except Exception as error:  # a broken file can raise nearly any error inside Hydra
        raise ConfigError(_reason(error, folder)) from error
    # A root file that is a list or a number.
    if not isinstance(values, dict):
        raise ConfigError(f"{folder / 'config.yaml'}: must be a mapping")
    return values


def _primary(folder: Path) -> str:
    """Return the name of a root file that begins with the defaults of the settings' classes.

    Files of the groups hold only values that differ from these. The settings of every method are
    included, even if the root's list of defaults does not have them.
    """
    from hydra.core.config_store import ConfigStore

    # Fields without a default must be in the files; excluded ones are inputs of derived values.
    class_defaults = {
        name: {
            key: field.get_default(call_default_factory=True)
            for key, field in group_class.model_fields.items()
            if not (field.is_required() or field.exclude)
        }
        for name, group_class in _group_classes().items()
    }
    class_defaults = {name: values for name, values in class_defaults.items() if values}
    tree = parse_yaml(folder / "config.yaml")
    defaults = tree.get("defaults", [])
    # The root file has settings of our own methods. Methods of other packages have their own files,
    # which come before its list: datasets and presets may change them.
    method_defaults = [
        {f"optional {group}": "default"} for group in sorted({*list_method_groups()} - tree.keys())
    ]
    # From the weakest to the strongest.
    all_defaults = ["class_defaults", *method_defaults, *defaults]
    # Hydra composes in the order of the list; a later entry replaces values of an earlier one.
    store = ConfigStore.instance()
    store.store("class_defaults", class_defaults, package="_global_")
    store.store("with_class_defaults", {**tree, "defaults": all_defaults})
    return "with_class_defaults"


def _group_classes() -> dict[str, type[Group]]:
    """Return the classes of the configuration's groups by name."""
    return {
        name: field.annotation
        for name, field in build_config_class().model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, Group)
    }


def _reason(error: Exception, folder: Path) -> str:
    """Return one line on why a composition failed, with the damaged file if there is one.

    Hydra's own errors name the key or option. Any other error comes from a damaged file, which
    Hydra does not name: the files are read one by one until one of them fails.

    Parameters
    ----------
    error : Exception
        Error of Hydra, or of a library below it.
    folder : Path
        Folder of the configuration.
    """
    from hydra.errors import HydraException, MissingConfigException, OverrideParseException
    from omegaconf.errors import OmegaConfBaseException

    # An unknown option of a group: the message lists the options that exist.
    if isinstance(error, MissingConfigException) and error.options:
        group, _, option = str(error.missing_cfg_file).partition("/")
        options = [name for name in error.options if not name.startswith("_")]
        hint = did_you_mean(option, options)
        return f"{group}={option}: no such option; there are {', '.join(options)}{hint}"
    if isinstance(error, OverrideParseException):
        # Lines of Hydra's message without its heading and the address of its manual.
        lines = re.sub("^(Error parsing override|See) .*", "", str(error), flags=re.M).split("\n")
        problem = " ".join(filter(None, lines))
        return f"{error.override}: expected key=value as Hydra reads it ({problem})"
    # An unknown key: Hydra's advice is to add it, which the check would reject.
    if unknown := re.match("Could not override '(.+?)'", str(error)):
        keys = [*_group_classes(), *(key for key, _ in leaves(compose()))]
        return f"{unknown[1]}: unknown key{did_you_mean(unknown[1], keys)}"
    # A damaged file: the first that cannot be read is named.
    if not isinstance(error, HydraException | OmegaConfBaseException):
        for path in sorted(folder.rglob("*.yaml")):
            try:
                tree = parse_yaml(path)
            except ProductError as damage:
                return str(damage)
            if not isinstance(tree, dict | None):
                return f"{path}: must be a mapping, not {type(tree).__name__}"
    return f"config: {_first_lines(error)}"


def load(overrides: Sequence[str] = ()) -> Config:
    """Compose and check the whole configuration of a dataset, or all that scene 3 reads of it.

    Parameters
    ----------
    overrides : sequence of str
        As of `compose`.

    Raises
    ------
    ConfigError
        Names each wrong key with its value and the allowed range.
    """
    return validate_tree(compose(overrides))


def validate_tree(tree: Mapping[str, Any]) -> Config:
    """Check a composed configuration; raises ConfigError like `load`.

    Parameters
    ----------
    tree : mapping
        Groups by name, as `compose` returns them.

    Returns
    -------
    Config
        Lengths in metres, angles in the unit that their key names.
    """
    # A dataset has all groups; scene 3 reads only some, without the groups of stars.
    if not _is_alignment(tree):
        return parse_settings(build_config_class(), tree)
    _require_known_groups(tree)
    # Likelihoods and bounds of scene 3 are of Poisson noise.
    part(("noise",), tree).noise.require_poisson("scene 3 is")
    reads = (
        *("seed", "telescope", "prescription", "alignment", "optics", "noise", "dae", "dae_train"),
        *("cnn", "perceptron", *(f"train_{name}" for name in list_trained_networks())),
        *("evaluation", "fit"),
    )
    return part(reads, tree)


def _is_alignment(tree: Mapping[str, Any]) -> bool:
    """Return True for the configuration of scene 3."""
    # A damaged group is rejected later, by the check of all groups.
    dataset = tree.get("dataset")
    name = dataset.get("name") if isinstance(dataset, Mapping) else None
    return "scene" not in tree and name == "alignment"


def _require_known_groups(tree: Mapping[str, Any]) -> None:
    """Raise ConfigError if a tree has a group that the configuration does not have."""
    # Groups that a user adds by mistake would be ignored otherwise.
    names = build_config_class().model_fields
    if unknown := sorted(set(tree) - set(names)):
        raise ConfigError(f"{unknown[0]}: unknown key{did_you_mean(unknown[0], names)}")


Model = TypeVar("Model", bound=Group)


def load_file(model: type[Model], path: Path, name: str | None = None) -> Model:
    """Read and check a file of the configuration that Hydra does not compose, or an entry of it.

    Parameters
    ----------
    model : type of Group
        Class with the keys of the file, such as `Sweep`.
    path : Path
        YAML file.
    name : str, optional
        Entry of the file; by default all of it.

    Raises
    ------
    ConfigError
        One line per wrong key: file, entry, key, allowed values.
    """
    from omegaconf import OmegaConf

    try:
        parse_yaml(path)
        # OmegaConf reads 4e-3 as a number; plain YAML takes it for text.
        tree: Any = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except ProductError as error:
        raise ConfigError(str(error)) from None
    except Exception as error:
        raise ConfigError(f"{path}: {_first_lines(error)}") from None
    tree = tree if isinstance(tree, dict) else {}
    if name is None:
        return parse_settings(model, tree, path)
    return parse_settings(model, tree[name], f"{path}: {name}")


def load_stage(reads: tuple[str, ...], overrides: Sequence[str] = ()) -> Config:
    """Compose the configuration and check the groups that a stage reads.

    Parameters
    ----------
    reads : tuple of str
        Names of the groups.
    overrides : sequence of str
        As of `compose`.

    Returns
    -------
    Config
        Only these groups.

    Raises
    ------
    ConfigError
        Names each wrong key with its value and the allowed range, and unknown groups.
    """
    # A misspelt group is rejected, even though the stage would not read it.
    tree = compose(overrides)
    _require_known_groups(tree)
    return part(reads, select_stage_groups(reads, tree))


def load_settings(path: Path, reads: tuple[str, ...]) -> Config:
    """Read the groups of a stage from a file that `write_settings` has written.

    Parameters
    ----------
    path : Path
        YAML file.
    reads : tuple of str
        Names of the groups that it must have, and no others.

    Raises
    ------
    ConfigError, ProductError
        If the file is not YAML or has other groups; names file, key and range.
    """
    tree = parse_yaml(path)
    # A file that is not a mapping lacks all groups.
    groups = tree if isinstance(tree, dict) else {}
    # All groups of the file are checked: one that the stage does not read is rejected.
    return _check_groups(reads, groups, path)


def write_settings(
    folder: Path, stage: str, reads: tuple[str, ...], tree: Mapping[str, Any], dry: bool = False
) -> Path:
    """Write the checked groups that a stage reads; the same settings have the same file name.

    Settings that cannot change a result are in the file, but do not change its name.

    Parameters
    ----------
    folder : Path
        Folder for the files of all stages.
    stage : str
        Name of the command.
    reads : tuple of str
        Groups that it reads.
    tree : mapping
        Composed configuration.
    dry : bool
        Name the file without writing it, in a dry run.

    Returns
    -------
    Path
        STAGE-HASH.yaml in `folder`.
    """
    import yaml

    # Checked values in the order of the classes.
    settings = part(reads, select_stage_groups(reads, tree))
    # Another name makes Snakemake repeat a job.
    path = folder / f"{stage.replace(' ', '-')}-{_hash_settings(settings)[:16]}.yaml"
    # A dry run writes nothing; jobs on other machines read the same file.
    if not dry:
        text = yaml.safe_dump(settings.model_dump(), sort_keys=True, allow_unicode=True)
        # A file that is damaged, or has other neutral settings, is written again.
        if not (path.is_file() and path.read_bytes() == text.encode()):
            write_text(path, text)
    return path


def hash_groups(reads: tuple[str, ...], tree: Mapping[str, Any]) -> str:
    """Return the hash of the settings of some groups that can change a result, 64 digits.

    Parameters
    ----------
    reads : tuple of str
        Names of the groups.
    tree : mapping
        Composed configuration.

    Raises
    ------
    ConfigError
        Names each wrong key with its value and the allowed range.
    """
    # Checked values: 1 and 1.0 are the same number.
    return _hash_settings(part(reads, select_stage_groups(reads, tree)))


def _hash_settings(settings: Group) -> str:
    """Return the SHA-256 of the settings that can change a result."""
    settings_text = json.dumps(dump_deciding(settings), sort_keys=True)
    return hashlib.sha256(settings_text.encode()).hexdigest()


def part(reads: tuple[str, ...], tree: Mapping[str, Any] | Group) -> Config:
    """Select and check some groups of a configuration, which is a tree or a model.

    Parameters
    ----------
    reads : tuple of str
        Names of the groups. Groups that the configuration lacks are missing in the result, which
        is rejected.
    tree : mapping or Group
        Composed configuration.

    Raises
    ------
    ConfigError
        Names each wrong key with its value and the allowed range.
    """
    # A model becomes a tree again, so that it is checked anew.
    tree = tree if isinstance(tree, Mapping) else tree.model_dump()
    groups = {key: tree[key] for key in reads if key in tree}
    return _check_groups(reads, groups)


def _check_groups(reads: tuple[str, ...], groups: Mapping[str, Any], source: object = "") -> Config:
    """Return checked groups of a file, annotated as a whole `Config` as in the stages."""
    # `build_stage_class` makes a class of these groups alone.
    stage_class = build_stage_class(reads, build_config_class())
    return cast(Config, parse_settings(stage_class, groups, source))


def select_stage_groups(reads: tuple[str, ...], tree: Mapping[str, Any]) -> dict[str, Any]:
    """Select the groups of a configuration tree that a stage reads.

    Values that follow from groups that it does not read are filled in.

    Parameters
    ----------
    reads : tuple of str
        Names of the groups.
    tree : mapping
        Composed configuration.

    Raises
    ------
    ConfigError
        If a group is missing, or groups contradict each other.
    """
    # Values that are null in the files because they follow from other groups.
    try:
        # Edge and spacing of fields, and search distances in pixels.
        tree = fill_derived_values(tree)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    # Scene 3 lacks stars, and other datasets lack states: a stage of the other kind fails.
    missing = [key for key in reads if key not in tree]
    if missing and _is_alignment(tree):
        raise ConfigError(
            "dataset = alignment: scene 3 has no simulated stars, which are needed here; "
            "its commands are `psfdae paper alignment …`, its target is scene3"
        )
    if missing:
        raise ConfigError(f"{missing[0]}: missing")
    return {key: tree[key] for key in reads}


def select_overrides(overrides: Sequence[str], choice: Sequence[str] = ()) -> tuple[str, ...]:
    """Select the overrides of a workflow that concern a dataset.

    The workflow takes one list for everything. A key that only other datasets have is left
    out; a key that is unknown to all datasets is kept, so that it is rejected by name. Options of a
    group, such as telescope=ideal_1m, apply to all datasets, but to scene 3 only presets.

    Parameters
    ----------
    overrides : sequence of str
        Hydra overrides of the workflow, such as noise.kappa=4.98.
    choice : sequence of str
        Override that chooses the dataset, such as dataset=dataset7.

    Returns
    -------
    tuple of str
        Overrides in the order in which they were given.

    Raises
    ------
    ConfigError
        If an option does not exist.
    """
    # Words such as preset=smoke choose a file of a group; scene 3 has its own telescope.
    options = [word for word in overrides if (config_dir() / _key(word)).is_dir()]
    applicable_options = options
    if tuple(choice) == Alignment.choice:
        applicable_options = [word for word in options if _key(word) == "preset"]

    def has_key(choice: Sequence[str], dotted_key: str) -> bool:
        """Return True if the configuration of a dataset has a key."""
        # The composition of the other dataset, with options that apply to it.
        node: Any = compose((*choice, *applicable_options))
        for name in dotted_key.split("."):
            if not isinstance(node, Mapping) or name not in node:
                return False
            node = node[name]
        return True

    def concerns(override: str) -> bool:
        """Return True if this dataset has the override's key, or if no dataset has it."""
        # `key=value` changes a key; `+group.key=value` adds a key to an existing group;
        # `++group.key=value` does either, hence the key decides first, then the group.
        key = _key(override)
        keys = [] if override.startswith("+") and not override.startswith("++") else [key]
        keys += [key.rpartition(".")[0]] if override.startswith("+") and "." in key else []
        # The first key that any dataset has decides.
        for key in keys:
            if has_key(choice, key):
                return True
            if any(has_key([f"dataset={name}"], key) for name in list_datasets()):
                return False
        return True

    return tuple(
        word
        for word in overrides
        if word in applicable_options or (word not in options and concerns(word))
    )


def list_datasets() -> list[str]:
    """Return the options of the group dataset, except files that are bases of others."""
    return sorted(path.stem for path in config_dir().glob("dataset/[!_]*.yaml"))


def _key(override: str) -> str:
    """Return the key of an override such as `+group.key=value` or `group@package=option`."""
    return re.split(r"[=@]", override.lstrip("+~"), maxsplit=1)[0]


def _first_lines(error: Exception) -> str:
    """Return the first two lines of an error's text as one line."""
    # Messages of Hydra and OmegaConf are long.
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:2])
