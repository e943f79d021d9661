"""The methods that `config.yaml` lists, in the order of tables.

The input is the list `methods` of names, the output the classes of the methods and the groups of
the configuration with their settings. For a method of another package, its name there is enough.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

from psfdae.base.files import ProductError
from psfdae.base.reading import parse_yaml
from psfdae.base.settings import Config, ConfigError
from psfdae.methods import all_methods, method
from psfdae.methods.interface import Method
from psfdae.stars.noise import LAWS
from psfdae_paper.configuration.base import config_dir


def list_methods() -> tuple[type[Method], ...]:
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

    Raises ConfigError as `list_methods` does.

    Parameters
    ----------
    path : Path
        File `config.yaml` with the list `methods`.

    Returns
    -------
    tuple of type of Method
        Each class once.
    """
    try:
        tree = parse_yaml(path)
        # Names of different methods; each must be registered, in the library or by a plug-in.
        names = tree.get("methods") if isinstance(tree, dict) else None
        if not isinstance(names, list) or len({*map(str, names)}) < len(names):
            raise ProductError("methods: must be a list of different names")
        methods = tuple(method(str(name)) for name in names)
    except ProductError as error:
        # Errors of the file name it already; errors of a method do not.
        text = str(error)
        raise ConfigError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    # Registered methods that are not listed may still be asked for by name.
    return (*methods, *(kind for kind in all_methods() if kind not in methods))


def list_method_groups() -> tuple[str, ...]:
    """Return the groups of the configuration that are settings of methods, each once.

    Methods may share a group, such as both Gaussian mixtures.
    """
    return tuple(dict.fromkeys(group for kind in list_methods() for group in kind.groups))


def list_noise_warnings(config: Config) -> list[str]:
    """Return a line if methods of a dataset assume independent pixels, but its noise has not.

    Parameters
    ----------
    config : Config
        Configuration with the groups noise and methods.
    """
    names = [name for name in config.methods if method(name).assumes_independent_pixels]
    if not names or LAWS[config.noise.law].has_independent_pixels:
        return []
    return [
        f"noise.law = {config.noise.law}: {', '.join(names)} assume independent pixels; "
        "other estimates are better, and their standard deviations do not hold"
    ]


def sort_oracles_last(names: Iterable[str]) -> list[type[Method]]:
    """Return the methods with these names in the order of legends: methods that are given λ last.

    Within both kinds they have the order of the configuration.

    Parameters
    ----------
    names : iterable of str
        Names of methods; names that are not registered are skipped.

    Returns
    -------
    list of type of Method
        Methods that know the noise level have an advantage in comparisons, and come last.
    """
    # `sorted` keeps the order of equals.
    kinds = [kind for kind in list_methods() if kind.name in set(names)]
    return sorted(kinds, key=lambda kind: kind.needs.level)
