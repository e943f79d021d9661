"""A disk without space: one line and exit code 2, nothing corrupt, nothing left behind.

Run as a program with a small tmpfs as the folder, this file tries every writer of the
package, each in a process of its own, and prints a line of JSON per attempt.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure

from fits_inputs import write_cube
from psfdae import files
from psfdae.figures import write_png
from psfdae.files import Column, Empty, as_yaml
from psfdae.networks.weights import load_checkpoint, load_weights, save_checkpoint, save_weights

pytestmark = pytest.mark.slow

OWN_MOUNTS = ("unshare", "--user", "--map-root-user", "--mount")
MOUNTED = 'mount -t tmpfs -o size=4m tmpfs "$1" && shift && exec "$@"'
FREE_KB = (0, 4, 8, 16, 40, 80, 128, 224, 320, 512, 1024, 3000)
RNG = np.random.default_rng(0)
VALUES = RNG.random((100, 16, 16))
TABLE = pd.DataFrame(RNG.random((4000, 5)), columns=list("abcde"))
STATE = {"w": torch.from_numpy(VALUES.astype(np.float32))}


def _stream(path):
    columns = {"a": Empty(VALUES.shape, np.float64, "1", "a"), "b": Column(np.arange(9), "1", "b")}
    with files.stream_product(path, "p", columns, {"seed": 1}) as data:
        for i in range(0, 100, 10):
            data["a"][i : i + 10] = VALUES[i : i + 10]


def _parquet(path):
    with files.atomic_path(path) as temporary:
        TABLE.to_parquet(temporary, index=False, write_page_checksum=True)


def _png(path):
    figure = Figure()
    figure.subplots().imshow(VALUES[0])
    write_png(figure, path)


def _product(path):
    files.write_product(path, "p", {"a": Column(VALUES, "1", "a")}, {"seed": 1})


def _read_product(path):
    assert (files.read_product(path, "p")["a"] == VALUES).all()


def _same(path):
    assert path.read_text().endswith("end\n")


def _image(path):
    from PIL import Image

    Image.open(path).load()


def _cube(path):
    from astropy.io import fits

    fits.getdata(path).sum()


# What writes a file, and what finds out whether it is whole.
WRITERS = {
    "product.h5": (_product, _read_product),
    "stream.h5": (_stream, _read_product),
    "table.parquet": (_parquet, pd.read_parquet),
    "w.safetensors": (lambda path: save_weights(path, STATE, {"lr": 1}), load_weights),
    "checkpoint.pt": (
        lambda path: save_checkpoint(path, "f", {**STATE, "history": []}),
        lambda path: load_checkpoint(path, "f")["w"],
    ),
    "table.csv": (
        lambda path: files.write_text(path, TABLE.to_csv(index=False) + "end\n"),
        _same,
    ),
    "config.yaml": (
        lambda path: files.write_text(path, as_yaml({f"k{i}": 1 for i in range(9999)}) + "end\n"),
        _same,
    ),
    "figure.png": (_png, _image),
    "cube.fits": (lambda path: write_cube(path, VALUES), _cube),
}


def attempt(main, folder, name, free_kb):
    """Write a file while so much is free; what came of it."""
    path = folder / "data" / name
    path.parent.mkdir(exist_ok=True)
    with (folder / "ballast").open("wb") as ballast:
        disk = os.statvfs(folder)
        os.posix_fallocate(
            ballast.fileno(), 0, max(1, disk.f_bavail * disk.f_frsize - 1024 * free_kb)
        )
    with tempfile.TemporaryFile() as said:
        child = os.fork()
        if child == 0:
            os.dup2(said.fileno(), 2)
            try:
                main(["write-it", str(path)])
            except SystemExit as end:
                # HDF5 crashes, if it does, when the process ends; all others may end at once.
                if path.suffix != ".h5":
                    sys.stderr.flush()
                    os._exit(end.code)
                raise
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        said.seek(0)
        stderr = said.read().decode()
    if path.exists():
        WRITERS[name][1](path)
    left = sorted(p.name for p in folder.rglob("*") if p.is_file() and p.name != "ballast")
    for stale in folder.rglob(f"*{name}*"):
        stale.unlink()
    return {"name": name, "free_kb": free_kb, "status": status, "stderr": stderr, "left": left}


def on_small_disk(folder, *command):
    """A command that sees a tmpfs of 4 MB in a folder; skipped where that is not allowed."""
    if not shutil.which("unshare"):
        pytest.skip("no command unshare (util-linux)")
    for mounts in (OWN_MOUNTS, ("unshare", "--mount")):
        wrapped = [*mounts, "sh", "-c", MOUNTED, "sh", str(folder)]
        tried = subprocess.run([*wrapped, "true"], capture_output=True, text=True, check=False)
        if tried.returncode == 0:
            return [*wrapped, *command]
    pytest.skip(f"may not mount: {tried.stderr.strip()}")


@pytest.fixture(scope="module")
def attempts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("disk")
    line = on_small_disk(folder, sys.executable, __file__, str(folder))
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(row) for row in done.stdout.splitlines() if row.startswith("{")]


@pytest.mark.parametrize("name", WRITERS)
def test_every_writer_on_a_full_disk(attempts, name):
    rows = [row for row in attempts if row["name"] == name]
    assert {row["status"] for row in rows} == {0, 2}, rows
    for row in rows:
        if row["status"] == 2:
            assert row["left"] == [], row
            assert row["stderr"].count("\n") == 1, row
            assert row["stderr"].startswith("psfdae: "), row
            assert "No space left on device" in row["stderr"], row
            assert name in row["stderr"], row
        else:
            digests = [] if name == "checkpoint.pt" else [f"{name}.sha256"]
            assert row["left"] == [name, *digests], row


def try_all(folder):
    """All attempts, by a command of the package's own that writes the file."""
    import click

    from psfdae.cli import Careful

    @click.command()
    @click.argument("path", type=click.Path(path_type=Path))
    def write_it(path):
        """Write the file."""
        WRITERS[path.name][0](path)

    main = Careful(commands={"write-it": write_it})
    (folder / ".digests").mkdir()
    for name in WRITERS:
        for free_kb in FREE_KB:
            print(json.dumps(attempt(main, folder, name, free_kb)), flush=True)


if __name__ == "__main__":
    try_all(Path(sys.argv[1]))
