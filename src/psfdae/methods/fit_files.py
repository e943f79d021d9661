"""Files of fitted methods: their names, additional files, and checks of their origin.

The fits are fits of methods to stars; FITS images are in `psfdae.image`. Functions take the class
of a method, whose `Storage` lists the files of a fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from glob import escape
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from psfdae.base.belonging import TRAINED_ON, require_training, write_origin
from psfdae.base.files import Product, as_csv, write_text
from psfdae.methods.interface import Method, Storage


def get_storage(method: type[Method]) -> Storage:
    """Return the storage of the fits of a method, which must have files."""
    assert method.storage is not None, f"{method.name} leaves no file"
    return method.storage


def get_rule_name(method: type[Method]) -> str:
    """Return the name of the rule that fits a method."""
    return get_storage(method).rule or f"fit_{method.name}"


def get_bundle_suffix(method: type[Method]) -> str:
    """Return the ending of the names of a method's bundles."""
    assert method.packing is not None, f"{method.name} is part of no bundle"
    return f"-{method.name}" if method.packing.suffix is None else method.packing.suffix


def stem(method: type[Method], dataset: str, split: str, reference: str) -> str:
    """Return the part of a path that distinguishes the fits of a method."""
    return f"{dataset}/{split}" + (f"-{reference}" if get_storage(method).per_reference else "")


def get_fit_path(method: type[Method], dataset: str, split: str, reference: str) -> str:
    """Return the folder or file of a fit, below the folder of results."""
    return f"{method.name}/{add_suffix(method, stem(method, dataset, split, reference))}"


def add_suffix(method: type[Method], text: str) -> str:
    """Return the name of a fit: unchanged for a folder, with the ending ".h5" for a file."""
    return text if get_storage(method).files else f"{text}.h5"


def own_files(method: type[Method], path: str | Path) -> list[Path]:
    """Return the files of a fit that the method itself reads."""
    return [Path(path, name) for name in get_storage(method).files] or [Path(path)]


def path_beside(method: type[Method], path: str | Path, name: str) -> Path:
    """Return the path of an additional file of a fit: in its folder, or next to its product."""
    path = Path(path)
    return path / name if get_storage(method).files else path.with_name(f"{path.stem}.{name}")


def outputs(method: type[Method], path: str | Path) -> list[Path]:
    """Return the paths of all files of a fit."""
    further_names = (TRAINED_ON, *get_storage(method).diagnostics)
    return own_files(method, path) + [path_beside(method, path, name) for name in further_names]


def store(fit: Method, path: Path, config: Mapping[str, Any], stars: Product) -> None:
    """Write all files of a fit to stars, with its resolved configuration."""
    fit.save(path, config)
    write_origin(path, stars)
    for name in get_storage(type(fit)).diagnostics:
        write_text(path_beside(type(fit), path, name), as_csv(fit.diagnostic_rows[name]))


def delete_checkpoints(checkpoint: Path) -> None:
    """Delete the checkpoint of a fit that is written, and of its further trainings.

    These have names such as fit.NAME.pt beside fit.pt.
    """
    further_checkpoints = checkpoint.parent.glob(f"{escape(checkpoint.stem)}.*.pt")
    for path in (checkpoint, *further_checkpoints):
        path.unlink(missing_ok=True)


def describe_fit(
    method: type[Method], tree: Mapping[str, Any], split: str, reference: str
) -> dict[str, Any]:
    """Return the configuration that is written with a fit.

    It has the settings `tree`, the split of the stars, and the reference, if the method has a fit
    for each reference.
    """
    has_reference = get_storage(method).per_reference
    return {**tree, "split": split, **({"reference": reference} if has_reference else {})}


def get_training_reference(method: type[Method], reference: str) -> str:
    """Return the reference to which a method is fitted in order to restore `reference`.

    A method with one fit for both references is fitted to templates.
    """
    fits_each = method.storage is None or method.storage.per_reference
    return reference if fits_each else "template"


def require_fit(
    method: type[Method], path: Path, stars: Product, config: BaseModel, split: str, reference: str
) -> None:
    """Raise an error if a fit does not belong to test stars.

    Parameters
    ----------
    method : type of Method
        Class of the method.
    path : Path
        Folder or file of the fit.
    stars : Product
        Stars of the test, a product "stars".
    config : pydantic model
        Configuration of the test, with seed and parts.
    split : "random" or "held_out"
        Kind of the split into training and test stars.
    reference : "realisation" or "template"
        Images to which the method is fitted.

    Raises
    ------
    ProductError
        For the first setting that differs, with both values.
    """
    options = describe_fit(method, {}, split, reference)
    require_training(path, method.read_config(path), stars, config, **options)
