"""The telescope: aperture, band, detector, and the aberrations of a telescope of one's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from psfdae.configuration.base import Fraction, Group, Name, Positive
from psfdae.configuration.wavefront import Raytraced, Seidel, Zernike
from psfdae.optics.pupil import pixel_width

ABERRATIONS: dict[str, type[Group]] = {
    "seidel": Seidel,
    "zernike": Zernike,
    "raytraced": Raytraced,
}
"""Kinds of aberrations that a telescope can bring."""


class Telescope(Group):
    """Aperture, band and detector."""

    name: Name = Field(description="For titles, files and messages")
    diameter_m: Positive = Field(description="Outer diameter of the aperture")
    obscuration: Fraction = Field(description="Linear central obscuration")
    wavelength_m: Annotated[float, Field(gt=1e-8, lt=1e-3)] = Field(
        description="Monochromatic wavelength"
    )
    pixel_scale_arcsec: Positive = Field(description="Width of a pixel on the sky")

    @property
    def pixel(self) -> float:
        """Pixel width in units of λ/D."""
        return pixel_width(self.pixel_scale_arcsec, self.diameter_m, self.wavelength_m)


def _aberrations(tree: Any) -> Any:
    if not isinstance(tree, Mapping):
        return tree
    kind = tree.get("kind")
    if kind not in ABERRATIONS:
        raise ValueError(f"kind = {kind!r}: must be {', '.join(ABERRATIONS)}")
    return ABERRATIONS[kind].model_validate(tree)


class OwnTelescope(Telescope):
    """A telescope with its field and aberrations (config/dataset/_telescope.yaml)."""

    field_edge_deg: Annotated[float, Field(gt=0, le=45)] = Field(
        description="Field angle of the outermost field on an axis, where the relative field is 1"
    )
    # The class is chosen by `kind` beforehand: messages then name no member of a union.
    aberrations: Annotated[Seidel | Zernike | Raytraced, BeforeValidator(_aberrations)] = Field(
        description="Static aberrations over the field"
    )


def has_own_aberrations(tree: Any) -> bool:
    """Whether a telescope, checked or not yet, brings aberrations of its own."""
    own = {"aberrations", "field_edge_deg"}
    return isinstance(tree, OwnTelescope) or (isinstance(tree, Mapping) and bool(own & set(tree)))


def _telescope(tree: Any) -> Any:
    if not isinstance(tree, Mapping):
        return tree
    return (OwnTelescope if has_own_aberrations(tree) else Telescope).model_validate(tree)


AnyTelescope = Annotated[Telescope | OwnTelescope, BeforeValidator(_telescope)]
