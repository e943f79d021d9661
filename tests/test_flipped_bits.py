"""One flipped bit in each kind of file below the results: noticed and rebuilt, or harmless."""

from __future__ import annotations

import os
import random
import shutil

import pytest

from psfdae.files import write_text
from workflow_runs import VARYING, captured, locked

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

HARMLESS = {
    "logs": "for people; nothing reads them",
    "benchmarks": "costs of jobs, which differ from run to run; runtime.csv alone is made of them, "
    "and leaves out what is no number",
    "mlflow.db": "a view of the results; deleted, it is imported anew",
    "mlartifacts": "copies for the view",
}
"""What may change unnoticed, and why."""

OWN = "of_my_own.txt"


def kind_of(path, results):
    """Folder and suffix: files of a kind have one writer and one reader."""
    inside = path.relative_to(results).parts
    depth = 2 if inside[0] in (".digests", "alignment", "data") else 1
    return (*inside[: min(depth, len(inside) - 1)], path.suffix)


def one_of_each(results):
    """A file of every kind that has a bit to flip, drawn by a seed."""
    draw = random.Random(4)
    kinds = {}
    for path in sorted(results.rglob("*")):
        # A damaged database would end the run with the advice to delete it.
        if path.is_file() and path.stat().st_size and path.name != "mlflow.db":
            kinds.setdefault(kind_of(path, results), []).append(path)
    return {kind: draw.choice(paths) for kind, paths in sorted(kinds.items())}


def flip(path, rng):
    content = bytearray(path.read_bytes())
    place = rng.randrange(8 * len(content))
    content[place // 8] ^= 1 << place % 8
    times = path.stat()
    path.write_bytes(content)
    # As a failing disk does it: nothing tells by its date.
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


@pytest.fixture(scope="module")
def flipped(smoke, tmp_path_factory):
    """The folder of a run that was damaged and repeated, what was flipped, and what was said."""
    folder = tmp_path_factory.mktemp("flipped")
    shutil.copytree(smoke, folder, dirs_exist_ok=True, symlinks=True)
    # The database says where its files are: that of a copy is deleted, and filled again.
    (folder / "results/mlflow.db").unlink()
    shutil.rmtree(folder / "results/mlartifacts")
    # A user's own, which no job can build again.
    write_text(folder / "results" / OWN, "1\n")
    chosen = one_of_each(folder / "results") | {("own",): folder / "results" / OWN}
    rng = random.Random(4)
    for path in chosen.values():
        flip(path, rng)
    run = captured(**locked(folder))
    assert run.returncode == 0, run.stdout + run.stderr
    return folder, chosen, run.stderr


def guarded(path, results):
    """What is set aside where a file has changed: itself, but for digests."""
    inside = path.relative_to(results).parts
    if inside[0] == ".digests":
        return results.joinpath(*inside[1:]).with_suffix("")
    return path


def test_every_kind_is_noticed_or_harmless(flipped):
    folder, chosen, said = flipped
    assert len(chosen) > 30
    for kind, path in chosen.items():
        if kind[0] not in (*HARMLESS, ".settings"):  # which every start writes if it differs
            product = guarded(path, folder / "results").relative_to(folder)
            assert f"{product}: " in said, (kind, path)


def test_everything_is_what_it_was(smoke, flipped):
    folder, *_ = flipped
    whole = [path for path in (smoke / "results").rglob("*") if path.is_file()]
    compared = 0
    for path in whole:
        name = path.relative_to(smoke)
        if name.parts[1] in (*HARMLESS, "mlflow", ".digests"):
            continue
        assert (folder / name).is_file(), name
        if not name.name.endswith(VARYING):
            assert (folder / name).read_bytes() == path.read_bytes(), name
            compared += 1
    assert compared > 150


def test_nothing_is_left_to_find(flipped):
    folder, *_ = flipped
    verify = {**locked(folder), "args": ["psfdae", "verify", "results"]}
    done = captured(**verify)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"results/{OWN}\n", "")
