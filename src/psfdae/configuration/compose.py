"""From a Hydra command line to a checked configuration, and back to stage overrides."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

from psfdae.configuration.alignment import ALIGNMENT_STAGE_KEYS, AlignmentConfig
from psfdae.configuration.consistency import Consistent, with_derived
from psfdae.configuration.schema import Config, Group
from psfdae.configuration.stages import STAGE_KEYS, stage_model

Root = Literal["config", "alignment"]
"""Root files of the configuration: the datasets', and that of scene 3."""

ROOTS: dict[Root, tuple[type[Group], dict[str, tuple[str, ...]]]] = {
    "config": (Config, STAGE_KEYS),
    "alignment": (AlignmentConfig, ALIGNMENT_STAGE_KEYS),
}
"""The checked model of every root and the groups that its stages read."""


class ConfigError(ValueError):
    """The configuration is not usable; every line names a key, its value and the range."""


def config_dir() -> Path:
    """Folder of the configuration tree.

    `PSFDAE_CONFIG` names another one; otherwise it is `config/` of the source
    tree that the package was installed from.
    """
    chosen = os.environ.get("PSFDAE_CONFIG")
    folder = Path(chosen) if chosen else Path(__file__).resolve().parents[3] / "config"
    if not (folder / "config.yaml").is_file():
        raise ConfigError(f"{folder}: no config.yaml (set PSFDAE_CONFIG to the config folder)")
    return folder.resolve()


def compose(overrides: Sequence[str] = (), root: Root = "config") -> dict[str, Any]:
    """Resolved configuration tree of a root and a list of Hydra overrides, not yet checked.

    Raises
    ------
    ConfigError
        If Hydra refuses an override (unknown key or group option, bad syntax).
    """
    return _composed(tuple(overrides), root)


def forget() -> None:
    """Compose everything anew, for example after a change of the config folder."""
    _composed.cache_clear()


@cache
def _composed(overrides: tuple[str, ...], root: Root) -> dict[str, Any]:
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
            tree = hydra.compose(root, overrides=list(overrides))
        resolved = OmegaConf.to_container(tree, resolve=True, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(f"config: {_first_lines(error)}") from error
    assert isinstance(resolved, dict)
    return resolved


def load(overrides: Sequence[str] = (), root: Root = "config") -> Any:
    """Compose and check the whole configuration of one dataset, or of another root.

    Raises
    ------
    ConfigError
        Names each wrong key with its value and the allowed range.
    """
    return validate(ROOTS[root][0], compose(overrides, root))


def validate(model: type[Any], tree: Mapping[str, Any]) -> Any:
    """Check a configuration tree against a pydantic model.

    Raises
    ------
    ConfigError
        One line per finding: key = value: what is allowed.
    """
    from pydantic import ValidationError

    try:
        return model.model_validate(tree)
    except ValidationError as error:
        raise ConfigError("\n".join(_finding(e) for e in error.errors())) from None


def load_stage(stage: str, overrides: Sequence[str] = ()) -> Any:
    """Compose the configuration and check the groups that a stage reads.

    Returns
    -------
    pydantic model with the groups that the stage reads as attributes

    Raises
    ------
    ConfigError
        As `load`; an unknown group at the top is refused, too.
    """
    root = root_of(stage)
    model, keys = ROOTS[root]
    tree = compose(overrides, root)
    unknown = sorted(set(tree) - set(model.model_fields))
    if unknown:
        raise ConfigError(f"{unknown[0]}: unknown key")
    return validate(stage_model(stage, keys[stage], model), stage_tree(stage, tree))


def root_of(stage: str) -> Root:
    """The root whose groups a stage reads."""
    return next(root for root, (_, keys) in ROOTS.items() if stage in keys)


def stage_tree(stage: str, tree: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a configuration tree that a stage reads.

    What follows from groups that it does not read is filled in.

    Raises
    ------
    ConfigError
        If nothing can follow from them.
    """
    model, keys = ROOTS[root_of(stage)]
    if issubclass(model, Consistent):
        try:
            tree = with_derived(tree)
        except ValueError as error:
            raise ConfigError(str(error)) from None
    return {key: tree[key] for key in keys[stage]}


def overrides_for(root: Root, overrides: Sequence[str]) -> tuple[str, ...]:
    """Those of the workflow's overrides that concern a root.

    The workflow takes one list for everything. A key that only another root
    knows is left out; one that none knows stays and is refused by name. A shared
    value, such as noise.kappa=5, reaches every root, but the choice of an option
    of a shared group, such as telescope=wfsat_literal, is the datasets'. The
    preset is every root's own option of that name.
    """
    kept = []
    for override in overrides:
        key = re.split(r"[=@]", override.lstrip("+~"), maxsplit=1)[0]
        if key == "preset":
            kept.append(override if root == "config" else f"{root}_{override}")
            continue
        known = {name for name in ROOTS if _knows(compose((), name), key)}
        chooses = "config" in known and isinstance(compose((), "config").get(key), Mapping)
        if not known or root in ({"config"} if chooses else known):
            kept.append(override)
    return tuple(kept)


def _knows(tree: Mapping[str, Any], key: str) -> bool:
    """Whether a configuration tree has a dotted key."""
    node: Any = tree
    for part in key.split("."):
        if not isinstance(node, Mapping) or part not in node:
            return False
        node = node[part]
    return True


def as_overrides(tree: Mapping[str, Any]) -> list[str]:
    """Hydra overrides that pin every leaf of a tree, in a fixed order.

    The list is at once a command line, the trigger of a rerun (the same
    configuration gives the same text, comments and number formats do not count)
    and something that a person can paste.
    """
    return [f"++{key}={_literal(value)}" for key, value in sorted(_leaves(tree))]


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    leaves: list[tuple[str, Any]] = []
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves += _leaves(value, f"{prefix}{key}.")
        else:
            leaves.append((prefix + key, value))
    return leaves


def _literal(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ",".join(_literal(item) for item in value) + "]"
    return value if isinstance(value, str) else json.dumps(value)


def _finding(error: Mapping[str, Any]) -> str:
    key = ".".join(str(part) for part in error["loc"])
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] == "extra_forbidden":
        return f"{key}: unknown key"
    if error["type"] == "missing":
        return f"{key}: missing"
    if error["type"] == "value_error":
        return f"{key}: {message}" if key else message
    return f"{key} = {error['input']!r}: {message[0].lower()}{message[1:]}"


def _first_lines(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:2])
