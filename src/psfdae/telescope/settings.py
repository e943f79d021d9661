"""Settings of a telescope: aperture, band and detector; for a user's telescope also its optics.

A user's telescope has a field, static aberrations with a prior, and seeing. `read_telescope` reads
its YAML file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from psfdae.base.arguments import check_arguments
from psfdae.base.reading import read_yaml
from psfdae.base.settings import ConfigError, Fraction, Group, Name, Positive, parse_settings
from psfdae.optics.pupil import pixel_width
from psfdae.optics.seeing import Profile
from psfdae.telescope.aberrations import Jitter, OmitsLateKeys, Raytraced, Seidel, Zernike


class Telescope(Group):
    """Telescope by its aperture, band and detector.

    The pupil is an annulus; the image is monochromatic.
    """

    name: Name
    """Name in titles, files and messages."""
    diameter_m: Positive
    """Outer diameter of the aperture."""
    obscuration: Fraction
    """Linear central obscuration."""
    wavelength_m: Annotated[float, Field(gt=1e-8, lt=1e-3)]
    """Monochromatic wavelength."""
    pixel_scale_arcsec: Positive
    """Width of a pixel on the sky."""

    @property
    def pixel(self) -> float:
        """Pixel width in units of λ/D."""
        return pixel_width(self.pixel_scale_arcsec, self.diameter_m, self.wavelength_m)


class Seeing(Group):
    """Long-exposure blur by the atmosphere, the same for all stars.

    The image is the telescope's, convolved with a round profile (`psfdae.optics.seeing.Profile`).
    """

    kind: Literal["gaussian", "moffat"]
    """Profile."""
    fwhm_arcsec: Positive
    """Full width at half maximum of the seeing alone."""
    beta: Annotated[float, Field(ge=1.5, le=20)] | None = None
    """Exponent of the Moffat profile (1 + r²/a²)^−β."""

    @model_validator(mode="after")
    def check_beta(self) -> Seeing:
        """Raise ValueError if a Moffat profile has no exponent, or a Gaussian has one."""
        # Wings fall as r^−2β: a Gaussian has none.
        if (self.kind == "moffat") != (self.beta is not None):
            raise ValueError(
                f"beta = {self.beta}: must be between 1.5 and 20 for kind = moffat, "
                "and must be absent for kind = gaussian"
            )
        return self


class Prior(Group):
    """Prior of `psfdae wavefront`: how far a telescope may differ from its file."""

    fraction: Annotated[float, Field(ge=0, le=10)] = 0.1
    """Relative standard deviation of every term."""
    waves: Jitter | None = None
    """Standard deviation in waves, added in quadrature; null: jitter_waves."""
    defocus_m: Positive = 1e-4
    """Standard deviation of the detector's defocus (ray trace)."""
    decentre_m: Positive = 1e-3
    """Standard deviation of the secondary's decentre, x and y."""
    tilt_deg: Positive = 0.1
    """Standard deviation of the secondary's tilt about x and y."""
    seeing: Annotated[float, Field(ge=0, le=0.3)] = 0.0
    """Relative σ of the seeing's FWHM in a joint fit; 0: as given."""


def aberrations_by_kind(tree: Any) -> Any:
    """Check aberrations by the class of their `kind`.

    The class is chosen first, so that messages of pydantic do not name members of a union.
    """
    # A value that is not a mapping is left to pydantic; a wrong kind is an error with all kinds.
    classes: dict[str, type[Group]]
    classes = {"seidel": Seidel, "zernike": Zernike, "raytraced": Raytraced}
    if not isinstance(tree, Mapping):
        return tree
    kind = tree.get("kind")
    if not isinstance(kind, str) or kind not in classes:
        raise ValueError(f"kind = {kind!r}: must be {', '.join(classes)}")
    return classes[kind].model_validate(tree)


class OwnTelescope(OmitsLateKeys, Telescope):
    """Telescope of a user, with its field and aberrations (config/dataset/_telescope.yaml)."""

    late_keys = ("seeing", "prior")
    field_edge_deg: Annotated[float, Field(gt=0, le=45)]
    """Field angle of the outermost field on an axis, where the relative field is 1."""
    aberrations: Annotated[Seidel | Zernike | Raytraced, BeforeValidator(aberrations_by_kind)]
    """Static aberrations over the field."""
    seeing: Seeing | None = None
    """Null: a telescope above the atmosphere."""
    prior: Prior = Prior()
    """Prior of the telescope's state."""

    @property
    def blur(self) -> Profile | None:
        """Profile of the seeing, in λ/D."""
        if self.seeing is None:
            return None
        # Angle on the sky in units of λ/D, as for pixels.
        fwhm = pixel_width(self.seeing.fwhm_arcsec, self.diameter_m, self.wavelength_m)
        return Profile(fwhm, self.seeing.beta)


def has_own_aberrations(tree: object) -> bool:
    """Return True if a telescope, checked or not yet, has aberrations of its own."""
    # One of these keys is enough: an error then names the missing ones.
    keys = {"aberrations", "field_edge_deg", "seeing", "prior"}
    return isinstance(tree, OwnTelescope) or (isinstance(tree, Mapping) and bool(keys & set(tree)))


def telescope_by_keys(tree: Any) -> Any:
    """Check a telescope by its class: with aberrations of its own, or without.

    As for aberrations, the class is chosen first for the sake of the messages.
    """
    # A value that is not a mapping is left to pydantic.
    if not isinstance(tree, Mapping):
        return tree
    return (OwnTelescope if has_own_aberrations(tree) else Telescope).model_validate(tree)


AnyTelescope = Annotated[Telescope | OwnTelescope, BeforeValidator(telescope_by_keys)]


@check_arguments
def read_telescope(path: str | Path) -> OwnTelescope:
    """Read a user's telescope from its YAML file.

    Its list `defaults` may name other files, as in `config/telescope`: NAME is a file of the same
    folder, `/GROUP@KEY: NAME` a file of the sibling folder GROUP, whose content becomes KEY.

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
    # Errors in included files name these files.
    return parse_settings(OwnTelescope, compose_tree(Path(path)), path)


def compose_tree(path: Path, including: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return the content of a file, merged with the files of its list `defaults` as in Hydra.

    Parameters
    ----------
    path : Path
        The YAML file.
    including : tuple of Path
        Chain of files that includes this one, the outermost first.

    Raises
    ------
    ConfigError
        If an entry of the list is not a name, or names a file that includes this one.
    ProductError
        If a file is missing or damaged.
    """
    if path.resolve() in including:
        raise ConfigError(f"{path}: defaults: it names itself")
    # Content of the file without its list of included files.
    tree = read_yaml(path)
    entries = tree.pop("defaults", [])
    if not isinstance(entries, list):
        raise ConfigError(f"{path}: defaults = {entries!r}: must be a list")
    # As in Hydra, later entries override earlier ones; `_self_`, the file's own content, is the
    # last entry unless the list contains it.
    content: dict[str, Any] = {}
    for entry in [*entries, *([] if "_self_" in entries else ["_self_"])]:
        text = "".join(f"{k}: {v}" for k, v in entry.items()) if isinstance(entry, dict) else entry
        pattern = r"(?:/(?P<group>\w+)(?:@(?P<key>[\w.]+))?: )?(?P<name>\w+)"
        match = re.fullmatch(pattern, str(text))
        if match is None:
            raise ConfigError(f"{path}: defaults: {entry!r}: must be NAME or /GROUP@KEY: NAME")
        # Content of the entry: the file itself, or another file, under its key if it has one.
        part = tree
        if text != "_self_":
            # Groups are sibling folders.
            folder = path.parent / ".." / match["group"] if match["group"] else path.parent
            part = compose_tree(folder / f"{match['name']}.yaml", (*including, path.resolve()))
            for key in reversed(match["key"].split(".") if match["key"] else []):
                part = {key: part}
        content = merge_trees(content, part)
    return content


def merge_trees(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Merge two trees key by key; values of the second one override values of the first one.

    Lists are values: they are not concatenated. Neither tree is changed.
    """
    # Groups that both trees have are merged recursively.
    subtrees = {
        key: merge_trees(first[key], value)
        for key, value in second.items()
        if isinstance(value, Mapping) and isinstance(first.get(key), Mapping)
    }
    return {**first, **second, **subtrees}
