"""Whether products belong together: what files say of themselves, key by key.

A product carries the configuration that made it. A network or a fitted baseline says
in a file beside it of which stars it was trained, because its own configuration does
not know them. Compared are the keys that decide what an input is; what only one side
states, and what changes no result (names, threads, batches), is not.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from psfdae.files import Product, ProductError, write_text
from psfdae.reading import read_yaml

STATIC = (
    "scene.name",
    "telescope",
    "framing.stamp_px",
    "framing.jitter_px",
    "framing.tie",
    "grid",
    "wavefront",
)
"""What decides the static PSFs of a scene."""

STARS = (
    *STATIC,
    "framing.subpixel",
    "telescope.aberrations.jitter_waves",
    "stars.aberration_fraction",
)
"""What decides of which kind stars are; others of the same kind have another seed or name."""

SAME_STARS = ("seed", "stars.name", "stars.count")
"""What tells sets of stars of one kind apart."""

SAME_IMAGE = ("image", "calibration_stars", "parts")
"""What tells sets of stars of images apart, which are not simulated."""

TRAINING_PART = ("seed", "parts.train_stars")
"""What decides which stars of a set a training has seen."""

STATES = (
    "telescope.diameter_m",
    "telescope.obscuration",
    "telescope.wavelength_m",
    "prescription",
    "alignment.decenter_range_m",
    "alignment.tilt_range_deg",
    "alignment.defocus_m",
    "alignment.field_radius_deg",
    "alignment.field_points",
    "alignment.highest_zernike",
)
"""What decides the wavefront of a state of scene 3."""

STATE_STAMPS = (*STATES, "telescope.pixel_scale_arcsec", "alignment.stamp_px")
"""What decides the stamps of a state of scene 3."""

ONLY_IF_NAMED = ("name", "jitter_waves")
"""Last part of keys that a group does not bring along: titles, and what static PSFs lack."""

WHOLE = {
    "wavefront": "wavefront",
    "telescope.aberrations": "telescope.aberrations",
    "telescope.seeing": "telescope.aberrations",
    "prescription": "prescription",
}
"""Groups whose missing terms are not there, if the configuration has the other group at all."""

TRAINED_ON = "trained_on.yaml"
"""Configuration of the stars or states that a network was trained on, in its folder."""

OURS = "the configuration"


def require(
    path: Path,
    said: Mapping[str, Any],
    keys: Sequence[str],
    wanted: Any,
    whose: object = OURS,
) -> None:
    """Refuse an input that is not what a stage takes it for.

    Parameters
    ----------
    path : Path
        Of the input.
    said : mapping
        The configuration that it carries.
    keys : sequence of str
        Dotted keys and groups that must agree.
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
    ours, theirs = dict(_leaves(said)), dict(_leaves(tree))
    for key in _selected(keys, {*ours, *theirs}):
        here, there = _value(ours, key), _value(theirs, key)
        if here is not None and there is not None and here != there:
            raise ProductError(f"{path}: {key} = {here}, but {whose} has {there}")


def agree(keys: Sequence[str], said: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two configurations state all of some keys, and the same values."""
    ours, theirs = dict(_leaves(said)), dict(_leaves(other))
    return all(key in ours and ours[key] == theirs.get(key) for key in keys)


def write_origin(model: Path, product: Product) -> None:
    """Note beside a model, which is written already, of which product it was trained.

    Parameters
    ----------
    model : folder of a network, or path of a fitted baseline
    product : Product
    """
    import yaml

    write_text(origin_path(model), yaml.safe_dump(product.config, sort_keys=True))


def origin_path(model: Path) -> Path:
    """The file that says what a model was trained on; see `write_origin`."""
    return model / TRAINED_ON if model.is_dir() else model.with_name(f"{model.stem}.{TRAINED_ON}")


def require_origin(model: Path, keys: Sequence[str], product: Product) -> dict[str, Any]:
    """Refuse a model that was trained on other stars or states than those of a product.

    Parameters
    ----------
    model : folder of a network, or path of a fitted baseline
    keys, product : as in `require`

    Returns
    -------
    dict
        What the model was trained on; empty if nobody has noted it.

    Raises
    ------
    ProductError
        As `require`, or if the note is damaged.
    """
    path = origin_path(model)
    if not path.is_file():
        return {}
    found = read_yaml(path)
    require(path, found, keys, product.config, product.path)
    return found


def require_training(
    model: Path, said: Mapping[str, Any], stars: Product, config: Any, **options: str
) -> None:
    """Refuse a network or baseline that was not trained for a test on some stars.

    It must be of stars of the same kind and, where they are the very same stars, must
    not have been trained on those that are tested.

    Parameters
    ----------
    model : folder of a network, or path of a fitted baseline
    said : mapping
        The configuration of the training.
    stars : product "stars" that it is tested on
    config : stage config (seed, parts)
    options : split, and reference of a network
    """
    origin = require_origin(model, STARS, stars)
    path = model if model.is_file() else model / "config.yaml"
    require(path, said, tuple(options), options, "the command")
    if agree(SAME_STARS, origin, stars.config) and options["split"] == "random":
        require(path, said, TRAINING_PART, config)


def _selected(keys: Sequence[str], known: set[str]) -> Iterator[str]:
    """The leaves that keys and groups stand for, in the order of `keys`."""
    for key in keys:
        if key in known:
            yield key
        inside = [leaf for leaf in known if leaf.startswith(f"{key}.")]
        inside = [leaf for leaf in inside if leaf.rsplit(".", 1)[1] not in ONLY_IF_NAMED]
        # The kind of a group explains why all else in it differs.
        yield from sorted(inside, key=lambda leaf: (not leaf.endswith(".kind"), leaf))


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _value(leaves: Mapping[str, Any], key: str) -> Any:
    """Value of a key; None if nothing is stated."""
    if key in leaves:
        return leaves[key]
    group = next((WHOLE[group] for group in WHOLE if key.startswith(f"{group}.")), None)
    if group is None or not any(leaf.startswith(f"{group}.") for leaf in leaves):
        return None
    return 0.0 if ".terms." in key else "nothing"
