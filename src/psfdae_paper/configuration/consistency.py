"""Relations between groups of the configuration: derived values and contradictions."""

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

TELESCOPE_SCENE = "telescope"
"""Name of the scene whose aberrations are settings of the telescope."""


class Consistent(Group):
    """Base of models that hold several groups.

    Some values may be null in the files, because they follow from other groups:
    edge and spacing of the field points, and the search distances of brightest
    pixels, which have the telescope's pixels.
    """

    @model_validator(mode="before")
    @classmethod
    def _derive(cls, tree: object) -> object:
        """Fill in derived values before the groups are checked."""
        if not isinstance(tree, Mapping):
            return tree
        _check_scene(tree)
        return with_derived_values(tree)

    @model_validator(mode="after")
    def _check_jitter(self) -> Consistent:
        """Refuse a jitter of aberrations for stars that have no random aberrations."""
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
    def _check_scene_groups(self) -> Consistent:
        """Require a secondary mirror in scene 3, and a backend of the propagation elsewhere."""
        prescription, optics = (getattr(self, name, None) for name in ("prescription", "optics"))
        if getattr(self, "scene", None) is None:  # scene 3, or part of a dataset without both
            if prescription is not None and prescription.secondary is None:
                raise ValueError("prescription: secondary: missing, it is what is misaligned")
        elif optics is not None and not hasattr(optics, "backend"):
            raise ValueError("optics.backend: missing")
        return self


def with_derived_values(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration with values for those nulls that follow from other groups."""
    derived = {name: _without_nulls(group, _derived(name, tree)) for name, group in tree.items()}
    grid = derived.get("grid")
    if isinstance(grid, dict) and grid.get("spacing_deg", 0) is None:
        # The outermost field points are at the edge of the field. One point has no neighbour, for
        # which any distance is right; `points` that are no integer are refused by the next check.
        edge, points = grid.get("edge_deg"), grid.get("points")
        if isinstance(edge, int | float):
            intervals = max(points - 1, 1) if isinstance(points, int) else 2
            grid["spacing_deg"] = 2.0 * edge / intervals
    return derived


def _check_scene(tree: Mapping[str, Any]) -> None:
    """Raise ValueError if scene and telescope do not have the same source of aberrations."""
    scene, telescope = tree.get("scene"), tree.get("telescope")
    if scene is None and "alignment" in tree:
        scene = {"name": "alignment"}
    if not isinstance(scene, Mapping) or not isinstance(telescope, Mapping):
        return
    name, has_aberrations = telescope.get("name"), has_own_aberrations(telescope)
    if has_aberrations and scene.get("name") != TELESCOPE_SCENE:
        raise ValueError(
            f"telescope = {name}: brings its own aberrations, but scene = {scene.get('name')} has "
            "others; choose a dataset made for it (dataset=_telescope, or one that starts from it)"
        )
    if not has_aberrations and scene.get("name") == TELESCOPE_SCENE:
        raise ValueError(
            f"telescope = {name}: has no aberrations; scene = {TELESCOPE_SCENE} needs a telescope "
            "with the keys field_edge_deg and aberrations, such as example_zernike"
        )


def _without_nulls(group: Any, values: Mapping[str, Any]) -> Any:
    """Return a group with values in place of those keys that are null."""
    if not isinstance(group, Mapping):
        return group
    return {
        key: values.get(key) if value is None and key in values else value
        for key, value in group.items()
    }


def _derived(name: str, tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that replace null in the keys of a group."""
    telescope = tree.get("telescope")
    if not isinstance(telescope, Mapping):
        return {}
    if name == "grid":
        return {"edge_deg": telescope.get("field_edge_deg")}
    if name in ("framing", "stars"):
        return {"search_px": _search_px(tree[name], _pixel(telescope))}
    return {}


def _search_px(group: object, pixel: float | None) -> int:
    """Return a search distance in pixels from one in λ/D, between 4 and 256.

    `pixel` is its width in λ/D. For settings that the next check refuses, any number is right.
    """
    distance = group.get("search_lambda_d", SEARCH) if isinstance(group, Mapping) else SEARCH
    if isinstance(distance, bool) or not isinstance(distance, int | float) or not distance > 0:
        distance = SEARCH
    return int(np.clip(np.ceil(distance / (pixel or 1.0)), 4, 256))


def _pixel(telescope: Mapping[str, Any]) -> float | None:
    """Return the pixel width in λ/D; None for a telescope that the next check refuses."""
    keys = [key for key in Telescope.model_fields if key in telescope]
    try:
        return Telescope.model_validate({key: telescope[key] for key in keys}).pixel
    except ValidationError:
        return None


@cache
def stage_model(keys: tuple[str, ...], whole_model: type[Group]) -> type[Consistent]:
    """Return a model of some groups of a whole configuration."""
    fields: dict[str, Any] = {
        key: (whole_model.model_fields[key].rebuild_annotation(), ...) for key in keys
    }
    return create_model("Settings", __base__=Consistent, **fields)
