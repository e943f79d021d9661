"""Relations between groups of the configuration: derived values and contradictions.

The input is a composed tree of groups, in which some values are null because they follow from other
groups. The output is the same tree with these values, or an error if groups contradict each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from pydantic import ValidationError, create_model, model_validator

from psfdae.base.settings import Group
from psfdae.telescope.settings import Telescope, has_own_aberrations
from psfdae_paper.configuration.base import get_search_distance
from psfdae_paper.configuration.wavefront import VonKarman

SIMULATION = ("seed", "scene", "telescope", "grid", "wavefront", "stars", "framing", "optics")
"""Groups that decide the noise-free stars."""

STATIC = ("scene", "telescope", "grid", "wavefront", "framing", "optics")
"""Groups that decide the static PSFs."""

WAVEFRONT_KINDS = {"seidel": "seidel", "turbulence": "von_karman", "telescope": "telescope"}
"""Kind of the wavefronts of each scene."""


class Consistent(Group):
    """Base of models that hold several groups.

    Some values may be null in the files, because they follow from other groups:
    edge and spacing of the field points, and the search distances of brightest
    pixels, which have the telescope's pixels.
    """

    @model_validator(mode="before")
    @classmethod
    def derive_values(cls, tree: object) -> object:
        """Fill in derived values before the groups are checked.

        Parameters
        ----------
        tree : object
            Groups by name; anything else is left to the check of the types.

        Returns
        -------
        object
            The groups by `fill_derived_values`.
        """
        return fill_derived_values(tree) if isinstance(tree, Mapping) else tree

    @model_validator(mode="before")
    @classmethod
    def check_scene(cls, tree: object) -> object:
        """Require that exactly one of scene and telescope has aberrations.

        The aberrations are settings of either the scene or the telescope.

        Raises
        ------
        ValueError
            With the telescope, its scene, and a suitable dataset.
        """
        groups: Mapping[str, Any] = tree if isinstance(tree, Mapping) else {}
        # Scene 3 has no group `scene`; its misalignments are aberrations of its own.
        scene, telescope = groups.get("scene"), groups.get("telescope")
        if scene is None and "alignment" in groups:
            scene = {"name": "alignment"}
        # Groups that a stage does not read are absent; anything but mappings is rejected later.
        if not isinstance(scene, Mapping) or not isinstance(telescope, Mapping):
            return tree
        name, has_aberrations = telescope.get("name"), has_own_aberrations(telescope)
        if has_aberrations and scene.get("name") != "telescope":
            raise ValueError(
                f"telescope = {name}: brings its own aberrations, but scene = {scene.get('name')} "
                "has others; choose a dataset made for it (dataset=_telescope, or one that starts "
                "from it)"
            )
        if not has_aberrations and scene.get("name") == "telescope":
            raise ValueError(
                f"telescope = {name}: has no aberrations; scene = telescope needs a telescope "
                "with the keys field_edge_deg and aberrations, such as example_zernike"
            )
        # The kind of the wavefront decides which aberrations are simulated.
        wavefront = groups.get("wavefront")
        kind = wavefront.get("kind") if isinstance(wavefront, Mapping) else None
        expected_kind = WAVEFRONT_KINDS.get(str(scene.get("name")))
        if kind and expected_kind and kind != expected_kind:
            raise ValueError(
                f"scene.name = {scene.get('name')}: wavefront.kind must be {expected_kind}, "
                f"not {kind}; a dataset takes both from a file of config/scene"
            )
        return tree

    @model_validator(mode="after")
    def check_jitter(self) -> Consistent:
        """Reject random aberrations where there are none, and a jitter of those that are 0.

        Raises
        ------
        ValueError
            With the keys.
        """
        # Groups that a stage does not read are absent, and a telescope may lack aberrations.
        telescope, stars = getattr(self, "telescope", None), getattr(self, "stars", None)
        wavefront = getattr(self, "wavefront", None)
        if stars is not None and stars.aberration_fraction and isinstance(wavefront, VonKarman):
            raise ValueError(
                f"stars.aberration_fraction = {stars.aberration_fraction:g}: must be 0, stars of "
                "scene turbulence have no random aberrations"
            )
        # In waves RMS; own telescopes alone have it.
        jitter = getattr(getattr(telescope, "aberrations", None), "jitter_waves", 0.0)
        if jitter and stars is not None and stars.aberration_fraction == 0:
            raise ValueError(
                f"telescope.aberrations.jitter_waves = {jitter}: "
                "stars.aberration_fraction must be above 0, stars without random aberrations "
                "are their templates"
            )
        return self

    @model_validator(mode="after")
    def check_scene_groups(self) -> Consistent:
        """Require a secondary mirror in scene 3, and a backend of the propagation elsewhere.

        Raises
        ------
        ValueError
            With the key that is missing.
        """
        # Both groups have keys that only one kind of dataset needs.
        prescription, optics = (getattr(self, name, None) for name in ("prescription", "optics"))
        # Groups that a stage does not read are absent, and are not checked.
        if getattr(self, "scene", None) is None:  # scene 3, or part of a dataset without both
            if prescription is not None and prescription.secondary is None:
                raise ValueError("prescription: secondary: missing, it is what is misaligned")
        elif optics is not None and not hasattr(optics, "backend"):
            raise ValueError("optics.backend: missing")
        return self


def fill_derived_values(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration with values for those nulls that follow from other groups.

    The tree need not be valid: a value that cannot be derived from it is left to the next check.

    Parameters
    ----------
    tree : mapping
        Groups by name; it is not changed.

    Returns
    -------
    dict
        The same groups with `grid.edge_deg` and `grid.spacing_deg` in degrees, and
        `framing.search_px` and `stars.search_px` in pixels.
    """
    # Copies of the groups, in which nulls are replaced.
    groups = {
        name: dict(group) if isinstance(group, Mapping) else group for name, group in tree.items()
    }
    telescope, grid = groups.get("telescope"), groups.get("grid")
    if isinstance(telescope, dict):
        # Width of a pixel in λ/D, from the aperture, the wavelength and the pixel scale. For wrong
        # settings, which the next check rejects, any number is right.
        keys = [key for key in Telescope.model_fields if key in telescope]
        try:
            pixel = Telescope.model_validate({key: telescope[key] for key in keys}).pixel or 1.0
        except ValidationError:
            pixel = 1.0
        # Brightest pixels are searched within a distance in λ/D, whatever the telescope's pixels.
        for group in (groups.get("framing"), groups.get("stars")):
            if isinstance(group, dict) and group.get("search_px", 0) is None:
                distance = get_search_distance(group.get("search_lambda_d"))
                # Stamps between 4 and 256 pixels on either side of the chief ray.
                group["search_px"] = int(np.clip(np.ceil(distance / pixel), 4, 256))
        # The relative field H is 1 at the edge of the telescope's field.
        if isinstance(grid, dict) and grid.get("edge_deg", 0) is None:
            grid["edge_deg"] = telescope.get("field_edge_deg")
    if isinstance(grid, dict) and grid.get("spacing_deg", 0) is None:
        # The outermost field points are at the edge of the field. For a single point any distance
        # is right; `points` that are not an integer are rejected by the next check.
        edge, points = grid.get("edge_deg"), grid.get("points")
        if isinstance(edge, int | float):
            # n points have n − 1 intervals.
            intervals = max(points - 1, 1) if isinstance(points, int) else 2
            grid["spacing_deg"] = 2.0 * edge / intervals
    return groups


@cache
def build_stage_class(keys: tuple[str, ...], whole_model: type[Group]) -> type[Consistent]:
    """Return a model of some groups of a whole configuration.

    Parameters
    ----------
    keys : tuple of str
        Names of the groups.
    whole_model : type of Group
        Class that has them, such as the result of `schema.build_config_class`.

    Returns
    -------
    type of Consistent
        A class that rejects any other group, and checks relations between its groups.
    """
    # Fields keep their types, but all are required: a stage needs all groups that it names.
    fields: dict[str, Any] = {
        key: (whole_model.model_fields[key].rebuild_annotation(), ...) for key in keys
    }
    return create_model("Settings", __base__=Consistent, **fields)
