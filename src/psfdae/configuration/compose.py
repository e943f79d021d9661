"""From a Hydra command line to a checked configuration, and back to stage overrides."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from psfdae.configuration.schema import STAGE_KEYS, Config, stage_model


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


@cache
def compose(overrides: tuple[str, ...] = ()) -> dict[str, Any]:
    """Resolved configuration tree of a list of Hydra overrides, not yet checked.

    Raises
    ------
    ConfigError
        If Hydra refuses an override (unknown key or group option, bad syntax).
    """
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
            tree = hydra.compose("config", overrides=list(overrides))
        resolved = OmegaConf.to_container(tree, resolve=True, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(f"config: {_first_lines(error)}") from error
    assert isinstance(resolved, dict)
    return resolved


def load(overrides: Sequence[str] = ()) -> Config:
    """Compose and check the whole configuration of one dataset.

    Raises
    ------
    ConfigError
        Names each wrong key with its value and the allowed range.
    """
    return validate(Config, compose(tuple(overrides)))


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
    pydantic model with the groups of `STAGE_KEYS[stage]` as attributes

    Raises
    ------
    ConfigError
        As `load`; an unknown group at the top is refused, too.
    """
    tree = compose(tuple(overrides))
    unknown = sorted(set(tree) - set(Config.model_fields))
    if unknown:
        raise ConfigError(f"{unknown[0]}: unknown key")
    return validate(stage_model(stage), stage_tree(stage, tree))


def stage_tree(stage: str, tree: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a configuration tree that a stage reads."""
    return {key: tree[key] for key in STAGE_KEYS[stage]}


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
