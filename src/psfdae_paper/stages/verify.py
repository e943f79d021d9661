"""Stage `verify`: files of a run that are not what was written are set aside, to be built anew."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import click

from psfdae.files import (
    DIGESTS,
    UNDIGESTED,
    ProductError,
    atomic_path,
    digest_line,
    digest_path,
    sweep_stale,
)
from psfdae.networks.weights import load_weights
from psfdae.options import File, Folder
from psfdae_paper import mlflow_view
from psfdae_paper.configuration.command import command

ASIDE = ".damaged"
"""Suffix that a damaged file gets; it is overwritten by the next one of its name."""

SKIPPED = {DIGESTS, *UNDIGESTED, mlflow_view.ARTIFACTS, mlflow_view.ARTIFACTS + ASIDE}
"""Folders that no rule's output lies in."""


@command("copy")
def copy(files: Annotated[tuple[File, ...], {"argument": True}]) -> None:
    """Copy files as products; FILES are pairs of a file and the name of its copy."""
    if len(files) % 2:
        raise click.UsageError(f"{files[-1]}: the name of its copy is missing")
    for path, out in zip(files[::2], files[1::2], strict=True):
        with path.open("rb") as source, atomic_path(out) as copied:
            copied.write_bytes(source.read())


@command("verify")
def verify(results: Annotated[Folder, {"argument": True}]) -> None:
    """Set damaged files of a run aside and list the files that have to be built again."""
    for path, reason in set_aside(results):
        print(f"{path}: {reason}; set aside, it will be built again", file=sys.stderr)
    for path in missing(results):
        print(path)


def set_aside(results: Path) -> list[tuple[Path, str]]:
    """Rename every damaged file, so that the workflow builds it again; say what was wrong.

    Products are compared with the digest that their writer has left; the data products,
    weights and tables per star of earlier versions, which have none, with the checksums
    inside them. A damaged digest looks like a damaged product. The database of MLflow and
    its files are compared with what was imported, and imported anew as a whole.

    Files are written under another name and renamed, hence an interrupted run leaves
    nothing to find here: damage comes from the disk, or from a program that is not ours.
    Temporary files of killed writers are removed.
    """
    found = list(damaged(results))
    for path, _ in found:
        _set_aside(path)
    if reason := mlflow_view.damage(results):
        for path in mlflow_view.files(results):
            _set_aside(path)
        found.append((results / mlflow_view.DATABASE, reason))
    return found


def _set_aside(path: Path) -> None:
    aside = path.with_name(path.name + ASIDE)
    if aside.is_dir() and not aside.is_symlink():
        shutil.rmtree(aside)
    else:
        aside.unlink(missing_ok=True)
    path.replace(aside)


def missing(results: Path) -> list[Path]:
    """Files to build that were set aside, now or earlier, and have not been built again, sorted."""
    whole = (path.with_name(path.name.removesuffix(ASIDE)) for path in results.rglob(f"*{ASIDE}"))
    return sorted({_output(path, results) for path in whole if not path.exists()})


def _output(path: Path, results: Path) -> Path:
    """The file that the workflow knows: some jobs leave more than that."""
    parts = path.relative_to(results).parts
    if parts[0] == "sweeps" and parts[2:3] == ("points",):
        return results.joinpath(*parts[:4], "result.json")
    if parts[0] == "own_stars" and parts[2:3] == ("model",):
        return results.joinpath(*parts[:3], "report.csv")
    return path


def damaged(results: Path) -> Iterator[tuple[Path, str]]:
    """Damaged products below a folder, sorted by path, with the reason."""
    for folder, folders, names in os.walk(results):
        here = Path(folder)
        # Another preset has results of its own.
        inner = sorted(
            name for name in folders if name not in SKIPPED and not (here / name / DIGESTS).is_dir()
        )
        # One in the place of a product is looked at as such.
        folders[:] = [name for name in inner if not _noted(here / name)]
        products = {*names, *inner} - {*folders}
        sweep_stale(here, ".")
        for path in (here / name for name in sorted(products) if not name.startswith(".")):
            if reason := _damage(path):
                yield path, reason


def _noted(path: Path) -> bool:
    """Whether there is a digest of a product, in whatever state."""
    digest = digest_path(path)
    return digest is not None and os.path.lexists(digest)


def _damage(path: Path) -> str:
    """What is wrong with a product; empty if nothing is known."""
    check = CHECKS.get("".join(path.suffixes[-2:]), CHECKS.get(path.suffix))
    if not (_noted(path) or check):
        return ""
    if path.exists() and not path.is_file():  # such as a pipe, which would be read for ever
        return "a folder" if path.is_dir() else "no file"
    try:
        if _noted(path):
            digest = digest_path(path)
            same = digest.is_file() and digest.read_bytes() == digest_line(path, path.name).encode()
            return "" if same else "not what was written (wrong checksum)"
        if check:
            check(path)
    except (ProductError, OSError, ValueError, RuntimeError, KeyError) as error:
        reason = " ".join(str(error).split()).removeprefix(f"{path}: ")
        return reason.removesuffix("; delete it and run again")
    return ""


def _check_product(path: Path) -> None:
    import h5py

    with h5py.File(path, "r") as file:
        for data in file.values():
            if data.chunks is None:
                data[()]
            else:
                for chunk in data.iter_chunks():
                    data[chunk]


def _check_table(path: Path) -> None:
    from pyarrow import parquet

    with parquet.ParquetFile(path, page_checksum_verification=True) as table:
        for _ in table.iter_batches():
            pass


def _check_bundle(path: Path) -> None:
    from psfdae.model.bundle import read_bundle

    read_bundle(path)


CHECKS: dict[str, Callable[[Path], object]] = {
    ".h5": _check_product,
    ".safetensors": load_weights,
    ".psf.safetensors": _check_bundle,
    ".parquet": _check_table,
}
"""What reads a file so thoroughly that damage shows, by one or two suffixes."""
