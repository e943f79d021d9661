"""The telescope: aperture, band, detector, and the aberrations of a telescope of one's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from psfdae.optics.pupil import pixel_width
from psfdae.optics.seeing import Profile
from psfdae.settings import Fraction, Group, Name, Positive
from psfdae.telescope.aberrations import Raytraced, Seidel, Zernike

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


class Seeing(Group):
    """Long-exposure blur by the atmosphere, the same for all stars."""

    kind: Literal["gaussian", "moffat"] = Field(description="Profile")
    fwhm_arcsec: Positive = Field(description="Full width at half maximum of the seeing alone")
    beta: Annotated[float, Field(ge=1.5, le=20)] | None = Field(
        default=None, description="Exponent of the Moffat profile (1 + r²/a²)^−β"
    )

    @model_validator(mode="after")
    def _beta(self) -> Seeing:
        if (self.kind == "moffat") != (self.beta is not None):
            raise ValueError(
                f"beta = {self.beta}: must be between 1.5 and 20 for kind = moffat, "
                "and is no key of kind = gaussian"
            )
        return self


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
    seeing: Seeing | None = Field(default=None, description="Null: a telescope above the air")

    @property
    def blur(self) -> Profile | None:
        """Profile of the seeing, in λ/D."""
        if self.seeing is None:
            return None
        fwhm = pixel_width(self.seeing.fwhm_arcsec, self.diameter_m, self.wavelength_m)
        return Profile(fwhm, self.seeing.beta)

    @model_serializer(mode="wrap")
    def _as_before(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Products of telescopes without seeing keep the bytes that they had before it.
        return {k: v for k, v in dump(self).items() if k != "seeing" or v is not None}


def has_own_aberrations(tree: Any) -> bool:
    """Whether a telescope, checked or not yet, brings aberrations of its own."""
    own = {"aberrations", "field_edge_deg", "seeing"}
    return isinstance(tree, OwnTelescope) or (isinstance(tree, Mapping) and bool(own & set(tree)))


def _telescope(tree: Any) -> Any:
    if not isinstance(tree, Mapping):
        return tree
    return (OwnTelescope if has_own_aberrations(tree) else Telescope).model_validate(tree)


AnyTelescope = Annotated[Telescope | OwnTelescope, BeforeValidator(_telescope)]
