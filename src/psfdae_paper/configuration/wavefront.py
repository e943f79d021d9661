"""Settings of a scene's wavefront: atmospheric turbulence, or the telescope's aberrations.

Those of scene 1, Seidel terms, are in `psfdae.telescope.aberrations`, as telescopes have them, too.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from psfdae.base.settings import Group, Positive


class VonKarman(Group):
    """Static atmospheric turbulence in layers: scene 2 looks through it in every exposure alike.

    Each layer has the von Kármán spectrum with the outer scale L0; its Fried parameter follows from
    its fraction s of the turbulence, r0_l = r0 s^(−3/5). Lengths are in metres.
    """

    kind: Literal["von_karman"]
    """Decides which keys follow."""
    # The turbulence is static: one realisation for all stars.
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    """Seed of the turbulence."""
    r0_m: Positive
    """Fried parameter of all layers at the telescope's band."""
    outer_scale_m: Positive
    """Outer scale L0."""
    # A layer at height h is seen from the field angle θ displaced by h θ.
    layer_heights_m: Annotated[list[Annotated[float, Field(ge=0)]], Field(min_length=1)]
    """Heights of the layers above the telescope."""
    layer_strengths: Annotated[list[Positive], Field(min_length=1)]
    """Fraction of the turbulence in each layer."""
    # A layer is a sum of plane waves with random phases.
    waves: Annotated[int, Field(ge=16, multiple_of=8)]
    """Plane waves per layer."""
    remove_tilt: bool
    """Remove tip and tilt over the lit pupil."""

    @model_validator(mode="after")
    def check_layers(self) -> VonKarman:
        """Require one strength for each layer, which add up to 1.

        Raises
        ------
        ValueError
            With the strengths, and their required number or sum.
        """
        # Layers are two lists of equal length in the file.
        if len(self.layer_heights_m) != len(self.layer_strengths):
            raise ValueError(
                f"layer_strengths = {self.layer_strengths}: one for each of the "
                f"{len(self.layer_heights_m)} layer_heights_m"
            )
        # Fractions of the whole turbulence; rounding of typed decimals is allowed.
        if abs(sum(self.layer_strengths) - 1.0) > 1e-6:
            raise ValueError(f"layer_strengths = {self.layer_strengths}: must add up to 1")
        return self


class OfTelescope(Group):
    """Aberrations that are settings of the group telescope."""

    kind: Literal["telescope"]
    """Decides which keys follow."""
