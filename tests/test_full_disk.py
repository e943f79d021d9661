"""A disk without space: one line and exit code 2, nothing corrupt, nothing left behind."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

OWN_MOUNTS = ("unshare", "--user", "--map-root-user", "--mount")
MOUNTED = 'mount -t tmpfs -o size=4m tmpfs "$1" && shift && exec "$@"'


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
    script = Path(__file__).with_name("full_disk.py")
    folder = tmp_path_factory.mktemp("disk")
    line = on_small_disk(folder, sys.executable, str(script), str(folder))
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(row) for row in done.stdout.splitlines() if row.startswith("{")]


@pytest.mark.parametrize(
    "name",
    [
        *("product.h5", "stream.h5", "table.parquet", "w.safetensors", "checkpoint.pt"),
        *("table.csv", "config.yaml", "figure.png", "cube.fits"),
    ],
)
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
