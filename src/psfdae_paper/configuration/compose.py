"""From a Hydra command line to a checked configuration, and back to stage overrides."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import create_model

from psfdae.files import ProductError, write_text
from psfdae.reading import parse_yaml
from psfdae.settings import NEUTRAL, ConfigError, Group, validate
from psfdae_paper.configuration import alignment
from psfdae_paper.configuration.base import config_dir
from psfdae_paper.configuration.consistency import stage_model, with_derived
from psfdae_paper.configuration.methods import all_groups, methods_in
from psfdae_paper.configuration.outline import filled, outline_of
from psfdae_paper.configuration.schema import Config, whole_config

ROOT = "config.yaml"


def compose(overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Resolved configuration tree of a list of Hydra overrides, not yet checked.

    Raises
    ------
    ConfigError
        If Hydra refuses an override (unknown key or group option, bad syntax).
    """
    return _composed(tuple(overrides))


def forget() -> None:
    """Compose everything anew, for example after a change of the config folder."""
    _composed.cache_clear()
    _kept.cache_clear()
    methods_in.cache_clear()


def keep_in(folder: Path) -> None:
    """Keep compositions, of which each takes Hydra some 0.15 s, for the next process.

    A file's name is the hash of all that its composition is made of, so that none is out of
    date; one that is damaged is composed anew. None is kept where the configuration asks a
    resolver, which may look at the environment or the time.
    """
    KEPT.append(folder)


KEPT: list[Path] = []


@cache
def _composed(overrides: tuple[str, ...]) -> dict[str, Any]:
    chosen = [word for word in overrides if re.fullmatch(r"dataset=\w+", word)]
    if len(chosen) == 1:
        found = outline_of(config_dir() / f"dataset/{chosen[0].removeprefix('dataset=')}.yaml")
        if found:
            words = tuple(f"dataset={OUTLINE}" if word in chosen else word for word in overrides)
            with suppress(ConfigError, KeyError):  # composed as it is, it says what is wrong
                return dict(filled(_kept(words, json.dumps(found[0])), found[1]))
    return _kept(overrides)


OUTLINE = "_outline"
"""Option of the group dataset that stands for all files of one outline."""


@cache
def _kept(overrides: tuple[str, ...], outline: str = "") -> dict[str, Any]:
    """A composition from the folder where they are kept, or by Hydra, then kept there."""
    name = _made_of(overrides, outline) if KEPT or outline else ""
    if outline and not name:
        raise ConfigError("a resolver may look at values that an outline does not have")
    if not (name and KEPT):
        return _by_hydra(overrides, outline)
    path = Path(KEPT[-1], name)
    digest, _, text = path.read_bytes().partition(b"\n") if path.is_file() else (b"", b"", b"")
    if digest.decode("latin1") == hashlib.sha256(text).hexdigest():
        kept: dict[str, Any] = json.loads(text)
        return kept
    tree = _by_hydra(overrides, outline)
    written = json.dumps(tree)
    # Somebody may have edited the configuration meanwhile.
    if json.loads(written) == tree and _made_of(overrides, outline) == name:
        write_text(path, f"{hashlib.sha256(written.encode()).hexdigest()}\n{written}")
    return tree


def _made_of(overrides: tuple[str, ...], outline: str) -> str:
    """Hash of all that a composition is made of, "" if a resolver may add more."""
    folder = config_dir()
    versions = version("hydra-core"), version("omegaconf")
    words = (overrides, outline, all_groups(), _class_defaults(), *versions)
    parts = [repr(words).encode(), Path(__file__).read_bytes()]
    for path in sorted(folder.rglob("*.yaml")):
        parts += [str(path.relative_to(folder)).encode(), path.read_bytes()]
    resolves = any(re.search(rb"\$\{[\w.]+:", part) for part in parts)
    return "" if resolves else hashlib.sha256(b"\0".join(parts)).hexdigest()


def _by_hydra(overrides: tuple[str, ...], outline: str = "") -> dict[str, Any]:
    import hydra
    from hydra.core.config_store import ConfigStore
    from hydra.core.global_hydra import GlobalHydra
    from omegaconf import OmegaConf

    folder = config_dir()
    GlobalHydra.instance().clear()
    if outline:
        ConfigStore.instance().store(OUTLINE, json.loads(outline), "dataset", "_global_")
    try:
        with hydra.initialize_config_dir(str(folder), version_base="1.3"):
            tree = hydra.compose(_primary(folder), overrides=list(overrides))
        resolved: Any = OmegaConf.to_container(tree, resolve=True, throw_on_missing=True)
    except Exception as error:  # what a broken file leads to inside Hydra is beyond listing
        raise ConfigError(_reason(error, folder)) from error
    if not isinstance(resolved, dict):
        raise ConfigError(f"{folder / ROOT}: must be a mapping")
    return resolved


def _primary(folder: Path) -> str:
    """Name of a root file that begins with the defaults of the classes of its settings.

    Files of the groups hold what differs from these. The settings of every method are there,
    whether the root's list of defaults has them or not.
    """
    from hydra.core.config_store import ConfigStore

    tree = parse_yaml(folder / ROOT)
    defaults = tree.get("defaults", [])
    groups = {*all_groups()} - {g for entry in defaults if isinstance(entry, dict) for g in entry}
    # Before all others, so that datasets and presets may change them.
    more = [{f"optional {group}": "default"} for group in sorted(groups)]
    store = ConfigStore.instance()
    store.store("class_defaults", _class_defaults(), package="_global_")
    store.store("with_class_defaults", {**tree, "defaults": ["class_defaults", *more, *defaults]})
    return "with_class_defaults"


def _class_defaults() -> dict[str, Any]:
    """Groups of a configuration with the values that their classes give, where they give some."""
    fields = whole_config().model_fields.items()
    kinds = {name: field.annotation for name, field in fields}
    groups = {
        name: {
            key: field.get_default(call_default_factory=True)
            for key, field in kind.model_fields.items()
            if not (field.is_required() or field.exclude)
        }
        for name, kind in kinds.items()
        if isinstance(kind, type) and issubclass(kind, Group)
    }
    return {name: values for name, values in groups.items() if values}


def _reason(error: Exception, folder: Path) -> str:
    """One line on why a composition failed: the file that is no YAML, if there is one."""
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

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

    Raises
    ------
    ConfigError
        Names each wrong key with its value and the allowed range.
    """
    return checked(compose(overrides))


def checked(tree: Mapping[str, Any]) -> Config:
    """As `load`, of a tree that is composed."""
    if not _aligns(tree):
        return validate(whole_config(), tree)
    _require_known(tree)
    return part(alignment.GROUPS, tree)


def _aligns(tree: Mapping[str, Any]) -> bool:
    """Whether a tree is that of scene 3."""
    dataset = tree.get("dataset")
    name = dataset.get("name") if isinstance(dataset, Mapping) else None
    return "scene" not in tree and name == alignment.NAME


def _require_known(tree: Mapping[str, Any]) -> None:
    unknown = sorted(set(tree) - set(whole_config().model_fields))
    if unknown:
        raise ConfigError(f"{unknown[0]}: unknown key")


def load_groups(overrides: Sequence[str] = ()) -> Config:
    """As `load`, with every group checked by itself, not what groups owe each other.

    Raises
    ------
    ConfigError
        As `load`.
    """
    return _settings(_groups_model(), _derived(compose(overrides)))


@cache
def _groups_model() -> type[Group]:
    fields: dict[str, Any] = {
        key: (field.rebuild_annotation(), ...) for key, field in whole_config().model_fields.items()
    }
    return create_model("Groups", __base__=Group, **fields)


def _settings(model: type[Group], tree: Mapping[str, Any]) -> Config:
    """Checked groups of the configuration, whose type for all that read them is the whole one."""
    return cast(Config, validate(model, tree))


Model = TypeVar("Model", bound=Group)
T = TypeVar("T")


def load_file(model: type[Model], path: Path) -> Model:
    """Read and check a file of the configuration that Hydra does not compose.

    Raises
    ------
    ConfigError
        One line per finding: file, key, what is allowed.
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
    return _named(path, lambda: validate(model, tree if isinstance(tree, dict) else {}))


def _named(path: Path, check: Callable[[], T]) -> T:
    """What a check gives; its refusals name the file."""
    try:
        return check()
    except ConfigError as error:
        lines = "\n".join(f"{path}: {line}" for line in str(error).splitlines())
        raise ConfigError(lines) from None


def load_stage(reads: tuple[str, ...], overrides: Sequence[str] = ()) -> Config:
    """Compose the configuration and check the groups that a stage reads.

    Returns
    -------
    Config
        With these groups alone.

    Raises
    ------
    ConfigError
        As `load`; an unknown group at the top is refused, too.
    """
    tree = compose(overrides)
    _require_known(tree)
    return part(reads, stage_tree(reads, tree))


def load_settings(path: Path, reads: tuple[str, ...]) -> Config:
    """The groups that a stage reads from a file that `write_settings` has written.

    Raises
    ------
    ConfigError, ProductError
        If the file is no YAML or holds something else; names file, key and range.
    """
    tree = parse_yaml(path)
    model = stage_model(reads, whole_config())
    return _named(path, lambda: _settings(model, tree if isinstance(tree, dict) else {}))


def write_settings(
    folder: Path,
    stage: str,
    reads: tuple[str, ...],
    tree: Mapping[str, Any],
    dry: bool = False,
) -> Path:
    """Write the checked groups that a stage reads; the same settings have the same name.

    What cannot change a result is in the file, but not in its name.

    Returns
    -------
    Path
        Of the file in `folder`; it is only named if `dry`.
    """
    import yaml

    checked = part(reads, stage_tree(reads, tree)).model_dump()
    digest = hashlib.sha256(json.dumps(decisive(checked), sort_keys=True).encode()).hexdigest()
    path = folder / f"{stage.replace(' ', '-')}-{digest[:16]}.yaml"
    if not dry:
        text = yaml.safe_dump(checked, sort_keys=True, allow_unicode=True)
        # Damaged ones are written again: a view, which needs no digest.
        if not (path.is_file() and path.read_bytes() == text.encode()):
            write_text(path, text)
    return path


def part(reads: tuple[str, ...], tree: Mapping[str, Any] | Group) -> Config:
    """Some groups of a configuration, a tree or a model, checked.

    Raises
    ------
    ConfigError
        As `load`.
    """
    tree = tree if isinstance(tree, Mapping) else tree.model_dump()
    found = {key: tree[key] for key in reads if key in tree}
    return _settings(stage_model(reads, whole_config()), found)


def stage_tree(reads: tuple[str, ...], tree: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a configuration tree that a stage reads.

    What follows from groups that it does not read is filled in.

    Raises
    ------
    ConfigError
        If nothing can follow from them.
    """
    tree = _derived(tree)
    missing = [key for key in reads if key not in tree]
    if missing and _aligns(tree):
        raise ConfigError(
            f"dataset = {alignment.NAME}: scene 3 has no simulated stars, which are needed here; "
            "its commands are `psfdae alignment …`, its target is scene3"
        )
    if missing:
        raise ConfigError(f"{missing[0]}: missing")
    return {key: tree[key] for key in reads}


def _derived(tree: Mapping[str, Any]) -> dict[str, Any]:
    try:
        return with_derived(tree)
    except ValueError as error:
        raise ConfigError(str(error)) from None


def overrides_for(overrides: Sequence[str], choice: Sequence[str] = ()) -> tuple[str, ...]:
    """Those of the workflow's overrides that concern a dataset.

    The workflow takes one list for everything. A key that only other datasets have is left
    out; one that none has stays and is refused by name. The options of a group that all
    datasets take, scene 3 takes only of `alignment.OWN_OPTIONS`.

    Parameters
    ----------
    overrides : sequence of str
    choice : sequence of str
        What chooses the dataset, such as dataset=dataset7.

    Raises
    ------
    ConfigError
        If an option does not exist.
    """
    options = [word for word in overrides if (config_dir() / _key(word)).is_dir()]
    chosen = [
        word
        for word in options
        if tuple(choice) != alignment.CHOICE or _key(word) in alignment.OWN_OPTIONS
    ]

    def has(key: str, choice: Sequence[str]) -> bool:
        return _knows(compose((*choice, *chosen)), key)

    def concerns(override: str) -> bool:
        for key in _places(override):
            if has(key, choice):
                return True
            if any(has(key, [f"dataset={name}"]) for name in dataset_names()):
                return False
        return True

    return tuple(
        word for word in overrides if word in chosen or (word not in options and concerns(word))
    )


def dataset_names() -> list[str]:
    """Options of the group dataset, those for other files to start from left out."""
    return sorted(path.stem for path in config_dir().glob("dataset/[!_]*.yaml"))


def _key(override: str) -> str:
    return re.split(r"[=@]", override.lstrip("+~"), maxsplit=1)[0]


def _places(override: str) -> list[str]:
    """Keys that tell where an override belongs: its own, or the group to which it adds one."""
    key = _key(override)
    group = key.rpartition(".")[0]
    if not override.startswith("+"):
        return [key]
    return ([key] if override.startswith("++") else []) + ([group] if group else [])


def _knows(tree: Mapping[str, Any], key: str) -> bool:
    """Whether a configuration tree has a dotted key."""
    node: Any = tree
    for part in key.split("."):
        if not isinstance(node, Mapping) or part not in node:
            return False
        node = node[part]
    return True


@cache
def _neutral_keys() -> frozenset[tuple[str, str]]:
    """Group and name of the settings that cannot change a result."""
    return frozenset(
        (group, name)
        for group, field in whole_config().model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, Group)
        for name, inner in field.annotation.model_fields.items()
        if NEUTRAL in inner.metadata
    )


def decisive(tree: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration tree without the settings that cannot change a result."""
    return _part(tree, lambda place: place not in _neutral_keys())


def neutral(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Those settings of a configuration tree that cannot change a result."""
    return _part(tree, lambda place: place in _neutral_keys())


def _part(tree: Mapping[str, Any], wanted: Callable[[tuple[str, str]], bool]) -> dict[str, Any]:
    part: dict[str, Any] = {}
    for group, value in tree.items():
        if isinstance(value, Mapping):
            part[group] = {key: inner for key, inner in value.items() if wanted((group, key))}
        elif wanted((group, "")):
            part[group] = value
    return part


def _first_lines(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:2])
