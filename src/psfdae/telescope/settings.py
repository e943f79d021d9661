"""The telescope: aperture, band, detector, and the aberrations of a telescope of one's own."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
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
from psfdae.reading import read_yaml
from psfdae.settings import ConfigError, Fraction, Group, Name, Positive, validate
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


class Prior(Group):
    """How far a telescope may be from what its file says, as `psfdae wavefront` assumes."""

    fraction: Annotated[float, Field(ge=0, le=10)] = Field(
        default=0.1, description="Relative standard deviation of every term"
    )
    waves: Annotated[float, Field(ge=0, le=100)] | None = Field(
        default=None, description="Standard deviation in waves besides; null: jitter_waves"
    )
    defocus_m: Positive = Field(
        default=1e-4, description="Of a ray trace: standard deviation of the detector's place"
    )
    decentre_m: Positive = Field(
        default=1e-3, description="Likewise of the secondary's decentre along x and y"
    )
    tilt_deg: Positive = Field(default=0.1, description="Likewise of its tilt about x and y")
    seeing: Annotated[float, Field(ge=0, le=0.3)] = Field(
        default=0.0,
        description="Relative standard deviation of the seeing's FWHM, found with all stars "
        "together; 0: as given",
    )


def _aberrations(tree: Any) -> Any:
    if not isinstance(tree, Mapping):
        return tree
    kind = tree.get("kind")
    if not isinstance(kind, str) or kind not in ABERRATIONS:
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
    prior: Prior = Field(default=Prior(), description="Of the state of the telescope")

    @property
    def blur(self) -> Profile | None:
        """Profile of the seeing, in λ/D."""
        if self.seeing is None:
            return None
        fwhm = pixel_width(self.seeing.fwhm_arcsec, self.diameter_m, self.wavelength_m)
        return Profile(fwhm, self.seeing.beta)

    @model_serializer(mode="wrap")
    def _as_before(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Products of telescopes without these keep the bytes that they had before them.
        later = {"seeing": None, "prior": Prior()}
        return {
            k: v for k, v in dump(self).items() if k not in later or getattr(self, k) != later[k]
        }


def has_own_aberrations(tree: object) -> bool:
    """Whether a telescope, checked or not yet, brings aberrations of its own."""
    own = {"aberrations", "field_edge_deg", "seeing", "prior"}
    return isinstance(tree, OwnTelescope) or (isinstance(tree, Mapping) and bool(own & set(tree)))


def _telescope(tree: Any) -> Any:
    if not isinstance(tree, Mapping):
        return tree
    return (OwnTelescope if has_own_aberrations(tree) else Telescope).model_validate(tree)


AnyTelescope = Annotated[Telescope | OwnTelescope, BeforeValidator(_telescope)]


DEFAULT = re.compile(r"(?:/(?P<group>\w+)(?:@(?P<place>[\w.]+))?: )?(?P<name>\w+)")
"""An entry of the list `defaults`: a file of the same folder, or of another one."""


def read_telescope(path: str | Path) -> OwnTelescope:
    """A telescope of one's own from its YAML file.

    Its list `defaults` may name other files, as those in `config/telescope` do: NAME is one of the
    same folder, `/GROUP@KEY: NAME` one of the folder GROUP beside it, whose content becomes KEY.

    Raises
    ------
    ConfigError
        Names the file and each wrong key with its value and the allowed range.

    Examples
    --------
    >>> telescope = psfdae.read_telescope("telescope.yaml")
    >>> f"{telescope.name}: a pixel is {telescope.pixel:.2f} λ/D wide"
    'refractor: a pixel is 1.76 λ/D wide'
    """
    try:
        return validate(OwnTelescope, _composed(Path(path).absolute()))
    except ConfigError as error:
        whole = f"{Path(path).absolute()}: "
        lines = [line.removeprefix(whole) for line in str(error).splitlines()]
        raise ConfigError("\n".join(f"{path}: {line}" for line in lines)) from None


def _composed(path: Path, within: tuple[Path, ...] = ()) -> dict[str, Any]:
    """The tree of a file with those that it names; `within` are those that name it."""
    if path in within:
        raise ConfigError(f"{path}: defaults: it names itself")
    tree = read_yaml(path)
    entries = tree.pop("defaults", [])
    whole: dict[str, Any] = {}
    if not isinstance(entries, list):
        raise ConfigError(f"{path}: defaults = {entries!r}: must be a list")
    for entry in [*entries, *([] if "_self_" in entries else ["_self_"])]:
        text = "".join(f"{k}: {v}" for k, v in entry.items()) if isinstance(entry, dict) else entry
        found = DEFAULT.fullmatch(str(text))
        if found is None:
            raise ConfigError(f"{path}: defaults: {entry!r}: must be NAME or /GROUP@KEY: NAME")
        if text == "_self_":
            whole = _merged(whole, tree)
            continue
        folder = path.parent.parent / found["group"] if found["group"] else path.parent
        part = _composed(folder / f"{found['name']}.yaml", (*within, path))
        for key in reversed(found["place"].split(".") if found["place"] else []):
            part = {key: part}
        whole = _merged(whole, part)
    return whole


def _merged(first: dict[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Two trees, of which the second one decides."""
    merged = dict(first)
    for key, value in second.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merged(merged[key], value) if both else value
    return merged
