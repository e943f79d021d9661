"""The methods of the configuration: those of the list in `config.yaml`, in the order of tables.

In goes the list `methods` of names; out come the classes of the methods and the groups of the
configuration that are their settings. A method that is plugged in needs nothing but its name there.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

from psfdae.base.files import ProductError
from psfdae.base.reading import parse_yaml
from psfdae.base.settings import ConfigError
from psfdae.methods import all_methods, method
from psfdae.methods.interface import Method
from psfdae_paper.configuration.base import config_dir


def registered() -> tuple[type[Method], ...]:
    """Return the methods that the configuration lists, in the order of tables; then all others.

    Raises
    ------
    ConfigError
        If the list is missing, or names something that is not a method.
    """
    return methods_in(config_dir() / "config.yaml")


@cache
def methods_in(path: Path) -> tuple[type[Method], ...]:
    """Return the methods that a file `config.yaml` lists, then all others.

    Raises ConfigError as `registered` does.
    """
    try:
        tree = parse_yaml(path)
        # Names of different methods; each must be registered, in the library or by a plug-in.
        names = tree.get("methods") if isinstance(tree, dict) else None
        if not isinstance(names, list) or len({*map(str, names)}) < len(names):
            raise ProductError("methods: must be a list of different names")
        listed = tuple(method(str(name)) for name in names)
    except ProductError as error:
        # Errors of the file name it already; those of a method do not.
        text = str(error)
        raise ConfigError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    # Registered methods that are not listed may still be asked for by name.
    return (*listed, *(kind for kind in all_methods() if kind not in listed))


def all_groups() -> tuple[str, ...]:
    """Return the groups of the configuration that are settings of methods, each once.

    Methods may share a group, such as both Gaussian mixtures.
    """
    return tuple(dict.fromkeys(group for kind in registered() for group in kind.groups))


def oracles_last(names: Iterable[str]) -> list[type[Method]]:
    """Return the methods of some names in the order of legends: those that are given λ last.

    Within both kinds the order is that of the configuration.
    """
    # `sorted` keeps the order of equals.
    kinds = [kind for kind in registered() if kind.name in set(names)]
    return sorted(kinds, key=lambda kind: kind.needs.level)
