"""Registry of methods: modules of `psfdae.methods`, and of packages that add methods.

Another distribution adds methods by an entry point of the group `psfdae.methods`, whose value is
the name of a package of such modules.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Annotated

from pydantic import AfterValidator, Field

from psfdae.base.entry_points import find_entry_points
from psfdae.base.errors import did_you_mean
from psfdae.base.files import ProductError
from psfdae.methods.interface import Method


def method(name: str) -> type[Method]:
    """Return the class of the method with a name.

    Raises
    ------
    ProductError
        If no method has this name.
    """
    # Methods of this package first: other packages cannot replace them.
    method_class = _find_method(f"{__name__}.{name}") or _find_external_methods().get(name)
    if method_class is None:
        raise ProductError(_unknown(name))
    return method_class


@cache
def all_methods() -> tuple[type[Method], ...]:
    """Return all methods, those in this package first."""
    # Modules without a method are skipped.
    classes = [_find_method(f"{__name__}.{name}") for name in _modules(__name__)]
    return (*filter(None, classes), *_find_external_methods().values())


@cache
def _find_external_methods() -> dict[str, type[Method]]:
    packages = [point.value for point in find_entry_points("methods")]
    classes = [
        _find_method(f"{package}.{name}") for package in packages for name in _modules(package)
    ]
    return {method_class.name: method_class for method_class in classes if method_class}


def _modules(package: str) -> list[str]:
    return sorted(module.name for module in iter_modules(import_module(package).__path__))


def _find_method(module: str) -> type[Method] | None:
    """Return the method that a module defines; None if it defines none, or is absent."""
    if not (module.rpartition(".")[2].isidentifier() and find_spec(module)):
        return None
    # Subclasses of `Method` that the module defines; imported classes belong to other modules.
    classes = [value for value in vars(import_module(module)).values() if isinstance(value, type)]
    classes = [c for c in classes if issubclass(c, Method) and c is not Method]
    methods = [c for c in classes if c.__module__ == module]
    return methods[0] if methods else None


def list_groups(name: str, **options: object) -> tuple[str, ...]:
    """Return the groups of settings that determine a fit of a method."""
    return ("seed", "noise", "parts", *method(name).groups)


def _is_known(name: str) -> str:
    if name not in {method_class.name for method_class in all_methods()}:
        raise ValueError(_unknown(name))
    return name


def _unknown(name: str) -> str:
    """Return the message for a name that no method has."""
    names = [method_class.name for method_class in all_methods()]
    return f"no method {name!r}; there are {', '.join(names)}{did_you_mean(name, names)}"


MethodName = Annotated[str, AfterValidator(_is_known)]
MethodNames = Annotated[list[MethodName], Field(min_length=1)]
