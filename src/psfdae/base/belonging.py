"""Checks that products belong together, by the settings that their files carry.

A product carries the configuration that made it. A network or a fitted baseline has the
configuration of its training stars in a file next to it. Settings that only one side has are not
compared, nor are settings that change no result (names, threads, batches).

Inputs: two configurations and the keys to compare. A difference raises a `ProductError` that names
the first key that differs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from psfdae.base.files import Product, ProductError, as_yaml, write_text
from psfdae.base.reading import read_yaml

STATIC = (
    *("scene.name", "telescope", "framing.stamp_px", "framing.jitter_px", "framing.tie"),
    *("grid", "wavefront"),
)
"""Configuration keys that decide the static PSFs of a scene."""

STARS = (
    *(*STATIC, "framing.subpixel"),
    # How large the random aberrations of the stars are, and how many stars have them.
    *("telescope.aberrations.jitter_waves", "stars.aberration_fraction"),
)
"""Configuration keys that decide the kind of stars; sets of one kind differ by seed and name."""

SAME_STARS = ("seed", "stars.name", "stars.count")
"""Configuration keys that distinguish two star sets of the same kind."""

SAME_IMAGE = ("image", "calibration_stars", "parts")
"""Keys that distinguish star sets of images, which are not simulated."""

TRAINED_ON = "trained_on.yaml"
"""Name of the file with the configuration of the stars or states that a model was trained on."""


def require(
    path: Path,
    config: Mapping[str, Any],
    keys: Sequence[str],
    expected_config: Mapping[str, Any] | BaseModel,
    expected_from: object = "the configuration",
) -> None:
    """Raise an error if the settings of an input differ from a stage's or another input's.

    Parameters
    ----------
    path : Path
        The input.
    config : mapping
        The configuration that it carries.
    keys : sequence of str
        Dotted keys, or groups of keys, that must agree where both sides have them.
    expected_config : mapping or pydantic model
        Configuration of the stage, or of another input.
    expected_from : object
        Name of the other side in the message, such as the path of another input.

    Raises
    ------
    ProductError
        For the first key that differs, with both values.
    """
    tree = expected_config if isinstance(expected_config, Mapping) else expected_config.model_dump()
    # The first difference is the message: the others often follow from it.
    for key in keys:
        difference = _difference(key, _look_up(config, key), _look_up(tree, key), is_partial=True)
        if difference is not None:
            name, value, expected_value = difference
            raise ProductError(
                f"{path}: {name} = {value}, but {expected_from} has {expected_value}"
            )


def _look_up(tree: Any, key: str) -> Any:
    """Return the value of a dotted key of a tree; None if it is not there."""
    # One level of the tree after the other.
    for name in key.split("."):
        tree = tree.get(name) if isinstance(tree, Mapping) else None
    return tree


def _difference(
    name: str, first: Any, second: Any, is_partial: bool = False
) -> tuple[str, Any, Any] | None:
    """Return the first key in which two values differ, with its two values; None if they agree.

    Parameters
    ----------
    name : str
        Dotted key of the values.
    first, second : object
        Groups, which are compared key by key, or values of other types.
    is_partial : bool
        Whether a side may leave out the value, or some of the keys of a group.
    """
    # A value that one side does not have is not compared.
    if is_partial and (first is None or second is None):
        return None
    if not (isinstance(first, Mapping) and isinstance(second, Mapping)):
        return None if first == second else (name, first, second)
    # Two groups: a key that a side lacks is "nothing" there.
    keys, required_parts = [*{**first, **second}], set()
    if is_partial:
        # If both sides have one part of a group, such as aberrations, they have all of its parts:
        # then a part that one side lacks is a difference.
        parts = [{k for k, v in side.items() if isinstance(v, Mapping)} for side in (first, second)]
        required_parts = parts[0] | parts[1] if parts[0] & parts[1] else set()
        keys = sorted({*first} & {*second} | required_parts)
    for key in keys:
        # Titles do not change the bytes. Static PSFs have no random aberrations; the size of these
        # is compared by its own key in `STARS`.
        if key not in ("name", "jitter_waves"):
            absent = {} if key in required_parts else "nothing"
            values = first.get(key, absent), second.get(key, absent)
            is_optional = is_partial and key not in required_parts
            if (difference := _difference(f"{name}.{key}", *values, is_optional)) is not None:
                return difference
    return None


def write_origin(model: Path, stars: Product) -> None:
    """Write the configuration of the stars on which a model (a folder or a file) was trained."""
    write_text(origin_path(model), as_yaml(stars.config))


def origin_path(model: Path) -> Path:
    """Return the path of the file that `write_origin` writes for a model."""
    return model / TRAINED_ON if model.is_dir() else model.with_name(f"{model.stem}.{TRAINED_ON}")


def require_origin(model: Path, keys: Sequence[str], product: Product) -> dict[str, Any]:
    """Raise an error if a model was not trained on the stars or states of a product.

    Returns
    -------
    dict
        Configuration of the stars or states that it was trained on; empty without that file.

    Raises
    ------
    ProductError
        For the first of `keys` that differs, or if the file of the origin is damaged.
    """
    # A model that was copied without this file has no origin to compare.
    path = origin_path(model)
    origin = read_yaml(path) if path.is_file() else {}
    require(path, origin, keys, product.config, product.path)
    return origin


def require_training(
    model: Path,
    fit_config: Mapping[str, Any],
    stars: Product,
    config: Mapping[str, Any] | BaseModel,
    **options: str,
) -> None:
    """Raise an error if a fit must not be tested on a product of stars.

    Training and test stars must be of the same kind, and the options must agree. If they are the
    same stars, the test stars of the random split must not have been in the training: seed and
    number of training stars must agree.

    Parameters
    ----------
    model : Path
        Folder or file of the fit.
    fit_config : mapping
        Its configuration.
    stars : Product
        The stars of the test.
    config : mapping or pydantic model
        Configuration of the test.
    **options : str
        Split and reference of the test.

    Raises
    ------
    ProductError
        For the first key that differs, with both values.
    """
    # Stars of the same kind, and the same split and reference.
    origin = require_origin(model, STARS, stars)
    path = model if model.is_file() else model / "config.yaml"
    require(path, fit_config, tuple(options), options, "the command")
    # Stars of the same draw: no test star may have been a training star.
    identities = [(_look_up(origin, key), _look_up(stars.config, key)) for key in SAME_STARS]
    same_stars = all(first == second and first is not None for first, second in identities)
    if options["split"] == "random" and same_stars:
        require(path, fit_config, ("seed", "parts.train_stars"), config)
