"""Stage `verify`: files of a run that are not what was written are set aside, to be built anew."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import click

from psfdae.files import DIGESTS, atomic_path, digest_line, sweep_stale
from psfdae.options import File, Folder
from psfdae_paper.configuration.command import command

ASIDE = ".damaged"
"""Suffix that a damaged file gets; it is overwritten by the next one of its name."""


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

    Products are compared with the digest that their writer has left. A damaged digest looks like
    a damaged product. Files are written under another name and renamed, hence an interrupted run
    leaves nothing to find here: damage comes from the disk, or from a program that is not ours.
    Temporary files of killed writers are removed.
    """
    found = list(damaged(results))
    for path, _ in found:
        aside = path.with_name(path.name + ASIDE)
        if aside.is_dir() and not aside.is_symlink():
            shutil.rmtree(aside)
        else:
            aside.unlink(missing_ok=True)
        path.replace(aside)
    return found


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
    """Damaged products of a folder of results, sorted by path, with the reason."""
    digests = sorted((results / DIGESTS).rglob("*.sha256"))
    paths = [results / digest.relative_to(results / DIGESTS).with_suffix("") for digest in digests]
    for folder, _, _ in os.walk(results):
        sweep_stale(Path(folder), ".")
    for path, digest in zip(paths, digests, strict=True):
        if os.path.lexists(path) and (reason := _damage(path, digest)):
            yield path, reason


def _damage(path: Path, digest: Path) -> str:
    """Return the damage of a product; empty if there is none."""
    if not path.is_file():  # such as a pipe, which would be read for ever
        return "a folder" if path.is_dir() else "no file"
    same = digest.is_file() and digest.read_bytes() == digest_line(path, digest).encode()
    return "" if same else "not what was written (wrong checksum)"
