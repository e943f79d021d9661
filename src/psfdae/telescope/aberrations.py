"""Settings of the static aberrations of a telescope.

They are given as Seidel terms, as Zernike terms over the field, or by a ray trace of the surfaces
of a prescription. All are OPDs in waves of the telescope's wavelength; lengths of a prescription
are in metres. `psfdae.telescope.field` converts them to coefficients at the field angles of stars.

A ValueError of a check becomes a line of a ConfigError that names the key.
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from psfdae.base.settings import Finite, Group, Name, Positive
from psfdae.optics.wavefronts import SEIDEL_TERMS

HIGHEST_NOLL = 45
"""Highest Noll index of a term, the last one of radial order 8."""


def check_not_zero(value: float) -> float:
    """Return a radius of curvature, or raise ValueError if it is 0; flat mirrors are left out."""
    if value == 0:
        raise ValueError("must not be 0")
    return value


# Types of settings: a radius in metres, two numbers along x and y, waves of scatter, and the three
# terms of Sellmeier's equation.
Radius = Annotated[Finite, AfterValidator(check_not_zero)]
Pair = tuple[Finite, Finite]
Jitter = Annotated[float, Field(ge=0, le=100)]
Resonances = Annotated[list[Finite], Field(min_length=3, max_length=3)]


class OmitsLateKeys(Group):
    """Group with keys that were added after its first products.

    These keys are left out of products while they have their default, so that products of
    telescopes that do not use them keep their bytes.
    """

    late_keys: ClassVar[tuple[str, ...]] = ()

    @model_serializer(mode="wrap")
    def omit_late_defaults(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the group as a tree, without late keys that have their default."""
        # Readers assume the default of a key that is absent.
        fields = type(self).model_fields
        return {
            key: value
            for key, value in dump(self).items()
            if key not in self.late_keys or getattr(self, key) != fields[key].default
        }


class Mirror(Group):
    """Conic mirror, z = r²/R / (1 + √(1 − (1 + k) r²/R²)) above its vertex.

    R is the radius of curvature and k the conic constant: −1 is a paraboloid.
    """

    radius_m: Radius
    """Radius of curvature, > 0: centre above the vertex."""
    conic: Finite
    """Conic constant."""
    vertex_m: Finite
    """Coordinate z of the vertex."""


class Secondary(Mirror):
    """Secondary mirror, the one that may be misaligned.

    Its misalignment is a decentre and a tilt about its vertex (`Raytraced`).
    """

    clear_radius_m: Positive
    """Rays beyond this radius are vignetted."""


class Lens(Group):
    """Lens with two spherical surfaces; light meets the front first.

    It is centred on the axis, in the vacuum, and of the prescription's glass.
    """

    front_radius_m: Radius
    """Radius of the front, > 0: centre above vertex."""
    back_radius_m: Radius
    """Radius of the back, > 0: centre above vertex."""
    front_vertex_m: Finite
    """Coordinate z of the front vertex."""
    back_vertex_m: Finite
    """Coordinate z of the back vertex, below the front."""
    clear_radius_m: Positive
    """Rays beyond this radius are vignetted."""

    @model_validator(mode="after")
    def check_thickness(self) -> Lens:
        """Raise ValueError if the back of a lens is not below its front."""
        # z points to the sky, and light comes down: it meets the front above the back.
        thickness = self.front_vertex_m - self.back_vertex_m
        if not thickness > 0:
            raise ValueError(
                f"thickness = {thickness:.6g} m (front_vertex_m − back_vertex_m): "
                "must be greater than 0"
            )
        return self


class Glass(Group):
    """Glass by Sellmeier's equation, n² − 1 = Σ b λ² / (λ² − c)."""

    sellmeier_b: Resonances
    """Strengths of the three resonances."""
    sellmeier_c_um2: Resonances
    """Squared wavelengths of the resonances, µm²."""


class Prescription(Group):
    """Optical design: one or two mirrors, and lenses behind the second; z up, light along −z.

    Without a secondary the light is focused above the primary. A flat mirror that folds the beam,
    as in a Newtonian, is left out: it only obscures the pupil.
    """

    name: Name
    """Name in titles and messages."""
    entrance_pupil_m: Finite
    """Coordinate z of the plane that holds the pupil."""
    launch_distance_m: Positive
    """Start of the rays above that plane."""
    reference_sphere_m: Positive
    """Radius of the wavefront's reference."""
    primary: Mirror
    secondary: Secondary | None = None
    """Null: none, or a flat one."""
    lenses: dict[Name, Lens] = Field(default_factory=dict)
    """Lenses of the corrector, by name."""
    glass: Glass | None = None
    """Glass of all lenses."""
    best_focus_m: Finite
    """Coordinate z of the detector in focus."""

    @property
    def ordered_lenses(self) -> list[tuple[str, Lens]]:
        """Names and lenses in the order in which light meets them, from the highest down.

        The order of a mapping in a file, or of overrides, does not matter.
        """
        # Light comes down from the secondary: the highest front is met first.
        return sorted(self.lenses.items(), key=lambda item: -item[1].front_vertex_m)

    @model_validator(mode="after")
    def check_path(self) -> Prescription:
        """Raise ValueError for lenses without secondary or glass, or a wrong order of surfaces."""
        # Lenses need a secondary in front of them, and a glass.
        if self.lenses and self.secondary is None:
            raise ValueError(f"lenses = {list(self.lenses)}: must lie behind a secondary")
        if bool(self.lenses) != (self.glass is not None):
            raise ValueError("glass: must be given for lenses, and for nothing else")
        # Surfaces on the way up from the primary, and down from the secondary.
        primary = ("primary", self.primary.vertex_m)
        focus = ("best focus", self.best_focus_m)
        upwards, downwards = [primary, focus], []
        if self.secondary is not None:
            secondary = ("secondary", self.secondary.vertex_m)
            upwards, downwards = [primary, secondary], [secondary]
            for name, lens in self.ordered_lenses:
                downwards.append((f"front of {name}", lens.front_vertex_m))
                downwards.append((f"back of {name}", lens.back_vertex_m))
            downwards.append(focus)
        # Each surface follows the one before in the direction of the light.
        for sign, path in ((1, upwards), (-1, downwards)):
            for (start, z_start), (end, z_end) in pairwise(path):
                distance = sign * (z_end - z_start)
                if not distance > 0:
                    raise ValueError(
                        f"distance from {start} to {end} = {distance:.6g} m: must be greater than 0"
                    )
        return self


class Seidel(Group):
    """Static third-order aberrations in waves at H = 1, the edge of the field on an axis.

    The wavefront is a polynomial of pupil and field (`psfdae.optics.wavefronts`).
    """

    kind: Literal["seidel"]
    """Kind of aberrations; decides the other keys."""
    spherical: Finite
    """W040, waves."""
    coma: Finite
    """W131, waves."""
    astigmatism: Finite
    """W222, waves."""
    field_curvature: Finite
    """W220, waves."""
    distortion: Finite
    """W311, waves."""

    @property
    def coefficients(self) -> np.ndarray:
        """Coefficients in waves, in the order of `SEIDEL_TERMS`, shape (5,)."""
        # Settings by name, as an array in the order of all wavefronts.
        return np.array([getattr(self, term) for term in SEIDEL_TERMS])


def as_polynomial(term: Any) -> Any:
    """Return a plain number as a term that is constant over the field."""
    return {"constant": term} if isinstance(term, int | float) else term


def check_powers(term: dict[str, float]) -> dict[str, float]:
    """Return a term if its keys are products of x and y, in this order, up to the sixth degree.

    Raises
    ------
    ValueError
        For another key; `constant` is the product of no factors.
    """
    # x*y* alone would match the empty text, hence the look-ahead.
    for name in term:
        if name != "constant" and not re.fullmatch(r"(?=.)x*y*", name):
            raise ValueError(f"{name!r}: must be constant or a product such as x, yy or xxy")
        if name != "constant" and len(name) > 6:
            raise ValueError(f"{name!r}: must be of degree 6 or less")
    return term


def check_noll(terms: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return terms if their names are Zernike polynomials, z2 to the highest.

    Raises
    ------
    ValueError
        For another name; z1 is piston, which does not change an image.
    """
    for name in terms:
        # One or two digits, without a leading zero: a term has one name only.
        number = re.fullmatch(r"z([1-9]\d?)", name)
        if number is None or not 2 <= int(number[1]) <= HIGHEST_NOLL:
            raise ValueError(f"{name!r}: must be between z2 and z{HIGHEST_NOLL} (Noll's order)")
    return terms


FieldPolynomial = Annotated[
    dict[str, Finite],
    Field(min_length=1),
    BeforeValidator(as_polynomial),
    AfterValidator(check_powers),
]


class Zernike(Group):
    """Static Zernike terms whose coefficients are polynomials of the field.

    Noll's order and normalisation: a coefficient is the RMS of its term over the unit
    disc. The field vector (x, y) has length 1 at `field_edge_deg`.
    """

    kind: Literal["zernike"]
    """Kind of aberrations; decides the other keys."""
    terms: Annotated[dict[str, FieldPolynomial], Field(min_length=1), AfterValidator(check_noll)]
    """Waves RMS by Noll index and power of the field: z8: {constant: 0.1, x: 0.3, xyy: 0.02}."""
    jitter_waves: Jitter = 0.0
    """Standard deviation of a random addition to every term of each star."""

    @property
    def noll(self) -> tuple[int, ...]:
        """Noll indices of the terms, ascending."""
        return tuple(sorted(int(name[1:]) for name in self.terms))

    @property
    def polynomials(self) -> list[dict[tuple[int, int], float]]:
        """Coefficient in waves by powers (of x, of y) of the field, in the order of `noll`."""
        # The key xxy is x²y: powers (2, 1). `constant` has neither letter.
        return [
            {(name.count("x"), name.count("y")): waves for name, waves in term.items()}
            for term in (self.terms[f"z{noll}"] for noll in self.noll)
        ]


class Raytraced(OmitsLateKeys):
    """Aberrations of a telescope that a ray trace computes (batoid).

    The telescope may be out of focus, and its secondary misaligned. `psfdae.telescope.raytracing`
    traces the rays.
    """

    late_keys = ("decentre_m", "tilt_deg")
    kind: Literal["raytraced"]
    """Kind of aberrations; decides the other keys."""
    prescription: Prescription
    defocus_m: Annotated[float, Field(ge=-0.01, le=0.01)] = 0.0
    """Distance of the detector beyond best focus."""
    decentre_m: Pair = (0.0, 0.0)
    """Decentre of the secondary, x and y."""
    tilt_deg: Pair = (0.0, 0.0)
    """Tilt of the secondary about its vertex, about x and y."""
    highest_zernike: Annotated[int, Field(ge=11, le=HIGHEST_NOLL)] = 22
    """Highest Noll index of the wavefront."""
    jitter_waves: Jitter = 0.0
    """Standard deviation of a random addition to every term of each star."""

    @property
    def misalignment(self) -> np.ndarray:
        """Decentre x, y in metres and tilt about x, y in radians of the secondary, shape (4,)."""
        # Settings are in degrees, optics in radians.
        return np.array([*self.decentre_m, *np.deg2rad(self.tilt_deg)])

    @model_validator(mode="after")
    def check_secondary(self) -> Raytraced:
        """Raise ValueError for a misalignment without a secondary."""
        # The primary, with the detector, is the frame of all coordinates: it cannot move.
        if self.prescription.secondary is None and self.misalignment.any():
            raise ValueError(
                f"decentre_m = {list(self.decentre_m)}, tilt_deg = {list(self.tilt_deg)}: "
                "must be 0, because the prescription has no secondary"
            )
        return self
