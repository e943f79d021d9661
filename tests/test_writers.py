"""How products are written, checked and set aside; what killed programs and full disks leave."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
import torch

from command_line import psfdae
from fits_inputs import write_cube
from psfdae import files
from psfdae.files import Column, Empty, stream_product, write_product, write_text
from psfdae.networks.weights import load_checkpoint, save_checkpoint, save_weights

VALUES = np.random.default_rng(0).random((100, 16, 16))
TABLE = pd.DataFrame(VALUES.reshape(-1, 256)[:, :9])
WEIGHTS = {"w": torch.from_numpy(VALUES.astype(np.float32))}


@pytest.fixture
def results(tmp_path):
    """A folder with digests, as the workflow makes it, and a product."""
    folder = tmp_path / "results"
    (folder / ".digests").mkdir(parents=True)
    write_text(folder / "tables/a.csv", "x,y\n1,2\n")
    return folder


def verify(results):
    """Files to build, and what was printed of them."""
    done = psfdae("verify", results)
    assert done.exit_code == 0, done.output
    return done.stdout.splitlines(), done.stderr


def flip(path, byte, bit=0):
    content = bytearray(path.read_bytes())
    content[byte] ^= 1 << bit
    times = path.stat()
    path.write_bytes(content)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def test_sha256sum_reads_all_digests_at_once(results):
    write_product(results / "data/b.h5", "b", {"b": Column(np.arange(3), "1", "b")}, {})
    line = "find .digests -name '*.sha256' -exec cat {} + | sha256sum --check --strict"
    lines = subprocess.check_output(line, shell=True, cwd=results, text=True)
    assert sorted(lines.split()) == ["OK", "OK", "data/b.h5:", "tables/a.csv:"]


def test_each_folder_of_results_has_its_own_digests(results, tmp_path):
    (results / "paper/.digests").mkdir(parents=True)
    for name in ("paper/b.csv", "reference/c.csv", ".new/d.csv", "../elsewhere.csv"):
        write_text(results / name, "1\n")
    digests = {str(path.relative_to(results)) for path in tmp_path.rglob("*.sha256")}
    assert digests == {".digests/tables/a.csv.sha256", "paper/.digests/b.csv.sha256"}
    flip(results / "paper/b.csv", 0)
    assert verify(results) == ([], "")
    assert verify(results / "paper")[0] == [str(results / "paper/b.csv")]


def test_a_flipped_bit_of_a_table_or_its_digest_is_noticed(results):
    table, digest = results / "tables/a.csv", results / ".digests/tables/a.csv.sha256"
    whole = table.read_text()
    for path in (table, digest):
        for place in range(0, 8 * path.stat().st_size, 31):
            flip(path, place // 8, place % 8)
            build, lines = verify(results)
            assert build == [str(table)]
            assert lines.startswith(f"{table}: ") and "set aside" in lines
            write_text(table, whole)
            assert verify(results) == ([], "")


def test_lost_products_and_logs_are_no_damage_and_other_files_are_built_with_their_job(results):
    (results / "tables/a.csv").unlink()
    (results / "logs").mkdir()
    (results / "logs/a.log").write_text("anything")
    assert verify(results) == ([], "")
    point = results / "sweeps/width/points/0123456789ab"
    write_text(point / "cost.json", "{}")
    flip(point / "cost.json", 0)
    build, lines = verify(results)
    assert build == [str(point / "result.json")]
    assert lines.startswith(f"{point / 'cost.json'}: ")


def test_what_a_killed_writer_left_is_swept_if_it_is_certainly_stale(tmp_path):
    code = (
        "import sys, time; from psfdae.files import atomic_path\n"
        "with atomic_path(sys.argv[1]): print('in', flush=True); time.sleep(60)"
    )
    line = [sys.executable, "-c", code, tmp_path / "a.csv"]
    with subprocess.Popen(line, stdout=subprocess.PIPE) as writer:
        writer.stdout.readline()
        (left,) = tmp_path.glob(".a.csv*.tmp")
        write_text(tmp_path / "a.csv", "1")
        verify(tmp_path)
        assert left.exists(), "its writer was alive"
        writer.send_signal(signal.SIGKILL)
    machine, pid, started, token = left.name.removesuffix(".tmp").rsplit(".", 1)[1].split("-")
    reused = tmp_path / f".a.csv.{machine}-{os.getpid()}-1-{token}.tmp"
    elsewhere = tmp_path / f".a.csv.{machine[::-1]}-{pid}-{started}-{token}.tmp"
    foreign = tmp_path / ".a.csv.17.tmp"
    for path in (reused, elsewhere, foreign):
        path.touch()
    write_text(tmp_path / "b.csv", "1")
    assert left.exists(), "of another file"
    content = left.read_bytes()
    write_text(tmp_path / "a.csv", "2")
    assert not left.exists()
    left.write_bytes(content)
    verify(tmp_path)
    assert [path.exists() for path in (left, reused, elsewhere, foreign)] == [0, 0, 1, 1]


def stream(path):
    columns = {"a": Empty(VALUES.shape, np.float64, "1", "a"), "b": Column(np.arange(9), "1", "b")}
    with stream_product(path, "p", columns, {"seed": 1}) as data:
        for i in range(0, 100, 10):
            data["a"][i : i + 10] = VALUES[i : i + 10]


WRITERS = {
    "stream.h5": stream,
    "table.parquet": lambda path: files.write_parquet(path, pd.concat([TABLE] * 40)),
    "w.safetensors": lambda path: save_weights(path, WEIGHTS, {"lr": 1}),
    "checkpoint.pt": lambda path: save_checkpoint(path, "f", {**WEIGHTS, "history": []}),
    "cube.fits": lambda path: write_cube(path, VALUES),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_writer_without_space_names_its_file_and_leaves_nothing(tmp_path, name):
    """A limit on the size of files stands for a disk that fills up, early or late."""
    path = tmp_path / name
    WRITERS[name](path)
    size = path.stat().st_size
    path.unlink()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for space in (1, size // 3, size - 1000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (space, before[1]))
        try:
            with pytest.raises(OSError, match="File too large") as refusal:
                WRITERS[name](path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert refusal.value.filename == str(path)
        assert list(tmp_path.iterdir()) == []


def test_a_streamed_product_takes_no_more_than_it_needs(tmp_path):
    stream(tmp_path / "s.h5")
    assert (tmp_path / "s.h5").stat().st_size < 1.2 * VALUES.nbytes


def test_a_damaged_checkpoint_is_not_trained_on(tmp_path, capsys):
    path = tmp_path / "c.pt"
    save_checkpoint(path, "same", {**WEIGHTS, "history": [], "best_mse": 0.25})
    assert load_checkpoint(path, "same")["best_mse"] == 0.25
    flip(path, path.stat().st_size // 2)
    assert load_checkpoint(path, "same") is None
    assert f"{path}: damaged checkpoint ignored" in capsys.readouterr().out
