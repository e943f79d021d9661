"""The optical prescription of a two-mirror telescope with a lens corrector."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from psfdae.configuration.base import Finite, Group, Name, Positive


def _not_zero(value: float) -> float:
    if value == 0:
        raise ValueError("must not be 0")
    return value


Radius = Annotated[Finite, AfterValidator(_not_zero)]


class Mirror(Group):
    """A conic mirror."""

    radius_m: Radius = Field(description="Radius of curvature, > 0: centre above the vertex")
    conic: Finite = Field(description="Conic constant")
    vertex_m: Finite = Field(description="z of the vertex")


class Secondary(Mirror):
    """The mirror that is misaligned."""

    clear_radius_m: Positive = Field(description="Rays beyond this radius are vignetted")


class Lens(Group):
    """A lens with two spherical surfaces; light meets the front first."""

    front_radius_m: Radius = Field(description="Radius of curvature, > 0: centre above vertex")
    back_radius_m: Radius = Field(description="As front_radius_m")
    front_vertex_m: Finite = Field(description="z of the front vertex")
    back_vertex_m: Finite = Field(description="z of the back vertex, below the front")
    clear_radius_m: Positive = Field(description="Rays beyond this radius are vignetted")

    @model_validator(mode="after")
    def _thick(self) -> Lens:
        thickness = self.front_vertex_m - self.back_vertex_m
        if not thickness > 0:
            raise ValueError(
                f"thickness = {thickness:.6g} m (front_vertex_m − back_vertex_m): "
                "must be greater than 0"
            )
        return self


class Glass(Group):
    """Sellmeier's equation, n² − 1 = Σ b λ² / (λ² − c)."""

    sellmeier_b: Annotated[list[Finite], Field(min_length=3, max_length=3)] = Field(
        description="Strengths of the three resonances"
    )
    sellmeier_c_um2: Annotated[list[Finite], Field(min_length=3, max_length=3)] = Field(
        description="In square micrometres"
    )


class Prescription(Group):
    """A two-mirror telescope with a lens corrector; z up, light along −z."""

    name: Name = Field(description="For titles and messages")
    entrance_pupil_m: Finite = Field(description="z of the plane that holds the pupil")
    launch_distance_m: Positive = Field(description="Start of the rays above that plane")
    reference_sphere_m: Positive = Field(description="Radius of the wavefront's reference")
    primary: Mirror
    secondary: Secondary
    lenses: Annotated[dict[Name, Lens], Field(min_length=1)] = Field(
        description="Lenses of the corrector, by name"
    )
    glass: Glass
    best_focus_m: Finite = Field(description="z of the detector in focus")

    @property
    def ordered_lenses(self) -> list[tuple[str, Lens]]:
        """Name and lens in the order in which light meets them."""
        return sorted(self.lenses.items(), key=lambda item: -item[1].front_vertex_m)

    @model_validator(mode="after")
    def _in_order(self) -> Prescription:
        along = [("secondary", self.secondary.vertex_m)]
        for name, lens in self.ordered_lenses:
            along += [(f"front of {name}", lens.front_vertex_m)]
            along += [(f"back of {name}", lens.back_vertex_m)]
        along += [("best focus", self.best_focus_m)]
        for (above, z_above), (below, z_below) in pairwise(along):
            if not z_above > z_below:
                raise ValueError(
                    f"distance from {above} to {below} = {z_above - z_below:.6g} m: "
                    "must be greater than 0"
                )
        if not self.secondary.vertex_m > self.primary.vertex_m:
            raise ValueError(
                f"distance from primary to secondary = "
                f"{self.secondary.vertex_m - self.primary.vertex_m:.6g} m: must be greater than 0"
            )
        return self
