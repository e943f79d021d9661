"""Fits as files: their names, what is beside them, and whether they belong to stars.

Functions take the class of a method, whose part `Storage` says what a fit leaves.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfdae.belonging import TRAINED_ON, require_training, write_origin
from psfdae.files import Product, as_csv, write_text
from psfdae.method import Method, Storage

if TYPE_CHECKING:
    from pydantic import BaseModel


def storage_of(kind: type[Method]) -> Storage:
    """Return how the fits of a method are stored; the method must leave files."""
    assert kind.storage is not None, f"{kind.name} leaves no file"
    return kind.storage


def rule_of(kind: type[Method]) -> str:
    """Return the name of the rule that fits a method."""
    return storage_of(kind).rule or f"fit_{kind.name}"


def suffix_of(kind: type[Method]) -> str:
    """Return the ending of the names of a method's bundles."""
    assert kind.packing is not None, f"{kind.name} is part of no bundle"
    return f"-{kind.name}" if kind.packing.suffix is None else kind.packing.suffix


def stem(kind: type[Method], dataset: str, split: str, reference: str) -> str:
    """Return the part of a path that distinguishes the fits of a method."""
    return f"{dataset}/{split}" + (f"-{reference}" if storage_of(kind).per_reference else "")


def place_of(kind: type[Method], dataset: str, split: str, reference: str) -> str:
    """Return the folder or file of a fit, below the folder of results."""
    return f"{kind.name}/{named(kind, stem(kind, dataset, split, reference))}"


def named(kind: type[Method], text: str) -> str:
    """Return the name of a fit: as it is for a folder, with the ending ".h5" for a file."""
    return text if storage_of(kind).files else f"{text}.h5"


def own_files(kind: type[Method], place: str | Path) -> list[Path]:
    """Return the files of a fit that the method itself reads."""
    return [Path(place, name) for name in storage_of(kind).files] or [Path(place)]


def beside(kind: type[Method], place: str | Path, name: str) -> Path:
    """Return the path of a further file of a fit: in its folder, or beside its product."""
    place = Path(place)
    return place / name if storage_of(kind).files else place.with_name(f"{place.stem}.{name}")


def outputs(kind: type[Method], place: str | Path) -> list[Path]:
    """All files of a fit."""
    more = (TRAINED_ON, *storage_of(kind).diagnostics)
    return own_files(kind, place) + [beside(kind, place, name) for name in more]


def store(fitted: Method, place: Path, described: Mapping[str, Any], stars: Product) -> None:
    """Write all files of a fit to stars, with its resolved configuration."""
    fitted.save(place, described)
    write_origin(place, stars)
    for name in storage_of(type(fitted)).diagnostics:
        write_text(beside(type(fitted), place, name), as_csv(fitted.diagnosed[name]))


def described_by(
    kind: type[Method], tree: Mapping[str, Any], split: str, reference: str
) -> dict[str, Any]:
    """The configuration that is written with a fit: its settings, and what it was fitted to."""
    own = {"reference": reference} if storage_of(kind).per_reference else {}
    return {**tree, "split": split, **own}


def learnt(kind: type[Method], reference: str) -> str:
    """Reference to which a fit that restores one is made: one that serves both has templates."""
    each = kind.storage is None or kind.storage.per_reference
    return reference if each else "template"


def require(
    kind: type[Method], place: Path, stars: Product, config: BaseModel, split: str, reference: str
) -> None:
    """Refuse a fit that does not belong to test stars.

    Parameters
    ----------
    kind : type of Method
    place : Path
    stars : product "stars" with its realisations
    config : stage config (seed, parts)
    split : "random" or "held_out"
    reference : "realisation" or "template"

    Raises
    ------
    ProductError
        With both values of what differs.
    """
    options = described_by(kind, {}, split, reference)
    require_training(place, kind.described(place), stars, config, **options)
