"""Which groups of the configuration each stage reads."""

from __future__ import annotations

from functools import cache

from pydantic import create_model

from psfdae.configuration.consistency import Consistent
from psfdae.configuration.schema import Group

SIMULATION = ("seed", "scene", "telescope", "grid", "wavefront", "stars", "framing", "optics")
"""Groups that decide the noise-free stars."""

STATIC = ("scene", "telescope", "grid", "wavefront", "framing", "optics")
"""Groups that decide the static PSFs."""

STAGE_KEYS: dict[str, tuple[str, ...]] = {
    "templates": STATIC,
    "stars": SIMULATION,
    "baseline": ("seed", "noise", "parts", "baseline"),
    "train": ("seed", "noise", "parts", "dae", "train"),
    "evaluate": ("seed", "noise", "parts", "evaluation", "methods"),
}
"""The groups that each stage reads; nothing else can influence its result."""


@cache
def stage_model(keys: tuple[str, ...], root: type[Group]) -> type[Group]:
    """Some config groups of a root as a model of their own."""
    fields = {key: (root.model_fields[key].rebuild_annotation(), ...) for key in keys}
    base = Consistent if issubclass(root, Consistent) else Group
    return create_model("Settings", __base__=base, **fields)  # type: ignore[call-overload]
