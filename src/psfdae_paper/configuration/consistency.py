"""What groups of the configuration owe each other: derived values and contradictions."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from pydantic import ValidationError, create_model, model_validator

from psfdae.settings import Group
from psfdae.telescope.settings import Telescope, has_own_aberrations
from psfdae_paper.configuration.base import SEARCH

SIMULATION = ("seed", "scene", "telescope", "grid", "wavefront", "stars", "framing", "optics")
"""Groups that decide the noise-free stars."""

STATIC = ("scene", "telescope", "grid", "wavefront", "framing", "optics")
"""Groups that decide the static PSFs."""

OWN_SCENE = "telescope"
"""The scene of a telescope that brings its own aberrations."""

SEARCH_PX = (4, 256)
"""Least and largest distance in pixels that follows from one in λ/D."""


class Consistent(Group):
    """Base of models that hold several groups.

    Some values may be null in the files, because they follow from other groups:
    edge and spacing of the field points, and the search distances of brightest
    pixels, which have the telescope's pixels.
    """

    @model_validator(mode="before")
    @classmethod
    def _derive(cls, tree: object) -> object:
        if not isinstance(tree, Mapping):
            return tree
        _check_scene(tree)
        return with_derived(tree)

    @model_validator(mode="after")
    def _jitter_is_drawn(self) -> Consistent:
        telescope, stars = getattr(self, "telescope", None), getattr(self, "stars", None)
        jitter = getattr(getattr(telescope, "aberrations", None), "jitter_waves", 0.0)
        if stars is None or not jitter:
            return self
        if stars.aberration_fraction == 0:
            raise ValueError(
                f"telescope.aberrations.jitter_waves = {jitter}: "
                "stars.aberration_fraction must be above 0, stars without random aberrations "
                "are their templates"
            )
        return self

    @model_validator(mode="after")
    def _suits_the_scene(self) -> Consistent:
        prescription, optics = (getattr(self, name, None) for name in ("prescription", "optics"))
        if getattr(self, "scene", None) is None:  # scene 3, or part of a dataset without both
            if prescription is not None and prescription.secondary is None:
                raise ValueError("prescription: secondary: missing, nothing else can be misaligned")
        elif optics is not None and not hasattr(optics, "backend"):
            raise ValueError("optics.backend: missing")
        return self


def with_derived(tree: Mapping[str, Any]) -> dict[str, Any]:
    """A whole configuration with values in place of those nulls that follow from other groups."""
    filled = {name: _filled(group, _derived_values(name, tree)) for name, group in tree.items()}
    if isinstance(filled.get("grid"), dict):
        _space(filled["grid"])
    return filled


def _check_scene(tree: Mapping[str, Any]) -> None:
    scene, telescope = tree.get("scene"), tree.get("telescope")
    if scene is None and "alignment" in tree:
        scene = {"name": "alignment"}
    if not isinstance(scene, Mapping) or not isinstance(telescope, Mapping):
        return
    name, own = telescope.get("name"), has_own_aberrations(telescope)
    if own and scene.get("name") != OWN_SCENE:
        raise ValueError(
            f"telescope = {name}: brings its own aberrations, but scene = {scene.get('name')} has "
            "others; choose a dataset made for it (dataset=_telescope, or one that starts from it)"
        )
    if not own and scene.get("name") == OWN_SCENE:
        raise ValueError(
            f"telescope = {name}: has no aberrations; scene = {OWN_SCENE} needs a telescope with "
            "the keys field_edge_deg and aberrations, such as example_zernike"
        )


def _filled(group: Any, values: Mapping[str, Any]) -> Any:
    """A group with values in place of those keys that are null."""
    if not isinstance(group, Mapping):
        return group
    return {
        key: values.get(key) if value is None and key in values else value
        for key, value in group.items()
    }


def _derived_values(name: str, tree: Mapping[str, Any]) -> dict[str, Any]:
    """What null means for the keys of a group."""
    telescope = tree.get("telescope")
    if not isinstance(telescope, Mapping):
        return {}
    if name == "grid":
        return {"edge_deg": telescope.get("field_edge_deg")}
    if name in ("framing", "stars"):
        return {"search_px": _search(tree[name], _pixel(telescope))}
    return {}


def _search(group: object, pixel: float | None) -> int:
    """Search distance in pixels; any number for a group that will be refused in a moment."""
    reach = group.get("search_lambda_d", SEARCH) if isinstance(group, Mapping) else SEARCH
    if isinstance(reach, bool) or not isinstance(reach, int | float) or not reach > 0:
        reach = SEARCH
    return int(np.clip(np.ceil(reach / (pixel or 1.0)), *SEARCH_PX))


def _pixel(telescope: Mapping[str, Any]) -> float | None:
    """Pixel width in λ/D; None for a telescope that will be refused in a moment."""
    keys = [key for key in Telescope.model_fields if key in telescope]
    try:
        return Telescope.model_validate({key: telescope[key] for key in keys}).pixel
    except ValidationError:
        return None


def _space(grid: dict[str, Any]) -> None:
    """Put the outermost field points at the edge of the field, if no spacing is given."""
    edge, points = grid.get("edge_deg"), grid.get("points")
    if grid.get("spacing_deg", 0) is None and isinstance(edge, int | float):
        # One point has no neighbour; any distance will do.
        grid["spacing_deg"] = 2.0 * edge / max(points - 1, 1) if isinstance(points, int) else edge


@cache
def stage_model(keys: tuple[str, ...], whole: type[Group]) -> type[Consistent]:
    """Some groups of a whole configuration as a model of their own."""
    fields: dict[str, Any] = {
        key: (whole.model_fields[key].rebuild_annotation(), ...) for key in keys
    }
    return create_model("Settings", __base__=Consistent, **fields)
