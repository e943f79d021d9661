"""Whether products belong together, by what their files say of their upstream settings.

A product carries the configuration that made it. A network or a fitted baseline has the
configuration of its training stars in a file beside it. Settings that only one side states are
not compared, nor are those that change no result (names, threads, batches).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfdae.files import Product, ProductError, write_text
from psfdae.reading import read_yaml

if TYPE_CHECKING:
    from pydantic import BaseModel

FRAMING = ("framing.stamp_px", "framing.jitter_px", "framing.tie")
STATIC = ("scene.name", "telescope", *FRAMING, "grid", "wavefront")
"""Configuration keys that decide the static PSFs of a scene."""

DRAWN = ("framing.subpixel", "telescope.aberrations.jitter_waves", "stars.aberration_fraction")
STARS = (*STATIC, *DRAWN)
"""Configuration keys that decide the kind of stars; sets of one kind differ by seed and name."""

SAME_STARS = ("seed", "stars.name", "stars.count")
"""Configuration keys that distinguish two star sets of the same kind."""

SAME_IMAGE = ("image", "calibration_stars", "parts")
"""Keys that distinguish star sets of images, which are not simulated."""

NO_PART = {"name", "jitter_waves"}
"""Keys that a group does not bring along: titles, and what static PSFs lack."""

TRAINED_ON = "trained_on.yaml"
"""Configuration of the stars or states that a network was trained on, in its folder."""


def require(
    path: Path,
    said: Mapping[str, Any],
    keys: Sequence[str],
    wanted: Mapping[str, Any] | BaseModel,
    whose: object = "the configuration",
) -> None:
    """Refuse an input of other settings than those of a stage, or of another input.

    Parameters
    ----------
    path : Path
        Of the input.
    said : mapping
        The configuration that it carries.
    keys : sequence of str
        Dotted keys, and groups of them, that must agree where both sides state them.
    wanted : mapping or pydantic model
        Configuration of the stage, or of another input.
    whose : object
        The other side in the message: the path of another input.

    Raises
    ------
    ProductError
        For the first key that differs, with both values.
    """
    tree = wanted if isinstance(wanted, Mapping) else wanted.model_dump()
    for key in keys:
        here, there = _at(said, key), _at(tree, key)
        names, parts = [key], set()
        if isinstance(here, Mapping) and isinstance(there, Mapping):
            one, other = ({k for k in s if isinstance(s[k], Mapping)} for s in (here, there))
            # Who states one part of a group by itself, such as aberrations, states all of them.
            parts = one | other if one & other else set()
            names = [f"{key}.{name}" for name in sorted(({*here} & {*there} | parts) - NO_PART)]
        for name in names:
            one, other = _at(said, name), _at(tree, name)
            if (one is None or other is None) and name.rpartition(".")[2] not in parts:
                continue
            found = _difference(name, one, other)
            if found is not None:
                raise ProductError(f"{path}: {found[0]} = {found[1]}, but {whose} has {found[2]}")


def _at(tree: Any, key: str) -> Any:
    """The value of a dotted key; None if it is not there."""
    for name in key.split("."):
        tree = tree.get(name) if isinstance(tree, Mapping) else None
    return tree


def _difference(name: str, one: Any, other: Any) -> tuple[str, Any, Any] | None:
    """The first key in which two values differ, and what each has there."""
    one, other = (
        {} if side is None and isinstance(beside, Mapping) else side
        for side, beside in ((one, other), (other, one))
    )
    if not (isinstance(one, Mapping) and isinstance(other, Mapping)):
        return None if one == other else (name, one, other)
    inner = ((key, *(s.get(key, "nothing") for s in (one, other))) for key in {**one, **other})
    parts = (_difference(f"{name}.{key}", *both) for key, *both in inner if key not in NO_PART)
    return next(filter(None, parts), None)


def write_origin(model: Path, stars: Product) -> None:
    """Note beside a model, a folder or a file, of which product it was trained."""
    import yaml

    write_text(origin_path(model), yaml.safe_dump(stars.config, sort_keys=True))


def origin_path(model: Path) -> Path:
    """The file that says what a model was trained on; see `write_origin`."""
    return model / TRAINED_ON if model.is_dir() else model.with_name(f"{model.stem}.{TRAINED_ON}")


def require_origin(model: Path, keys: Sequence[str], product: Product) -> dict[str, Any]:
    """Refuse a model that was trained on other stars or states than those of a product.

    Returns what it was trained on, empty if no file says it; raises as `require`, and if that
    file is damaged.
    """
    path = origin_path(model)
    found = read_yaml(path) if path.is_file() else {}
    require(path, found, keys, product.config, product.path)
    return found


def require_training(
    model: Path,
    said: Mapping[str, Any],
    stars: Product,
    config: Mapping[str, Any] | BaseModel,
    **options: str,
) -> None:
    """Refuse a fit, whose configuration is `said`, that is no test on a product of stars.

    It must be of stars of the same kind and have the same `options`, split and reference. Where
    they are the very same stars, those of the random split's test must not have trained it.
    """
    origin = require_origin(model, STARS, stars)
    path = model if model.is_file() else model / "config.yaml"
    require(path, said, tuple(options), options, "the command")
    known = [(_at(origin, key), _at(stars.config, key)) for key in SAME_STARS]
    if options["split"] == "random" and all(one == two and one is not None for one, two in known):
        require(path, said, ("seed", "parts.train_stars"), config)
