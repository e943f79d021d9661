"""How products are written, checked and set aside; what killed and hostile programs leave."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from psfdae import files
from psfdae.cli import main
from psfdae.files import Column, Empty, atomic_path, stream_product, write_product, write_text
from psfdae.networks.weights import load_checkpoint, save_checkpoint, save_weights
from psfdae_paper.stages import record


@pytest.fixture
def results(tmp_path):
    """A folder with digests, as the workflow makes it, and a product."""
    folder = tmp_path / "results"
    (folder / ".digests").mkdir(parents=True)
    write_text(folder / "tables/a.csv", "x,y\n1,2\n")
    return folder


def verify(results):
    """Files to build, and what was said of them."""
    done = CliRunner().invoke(main, ["verify", str(results)])
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
    said = subprocess.run(line, shell=True, cwd=results, check=True, capture_output=True, text=True)
    assert sorted(said.stdout.split()) == ["OK", "OK", "data/b.h5:", "tables/a.csv:"]


def test_each_folder_of_results_has_its_own_digests(results, tmp_path):
    (results / "paper/.digests").mkdir(parents=True)
    for name in ("paper/b.csv", "reference/c.csv", ".new/d.csv"):
        write_text(results / name, "1\n")
    write_text(tmp_path / "elsewhere.csv", "1\n")
    found = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.sha256")}
    assert found == {
        "results/.digests/tables/a.csv.sha256",
        "results/paper/.digests/b.csv.sha256",
    }
    flip(results / "paper/b.csv", 0)
    assert verify(results) == ([], "")
    assert verify(results / "paper")[0] == [str(results / "paper/b.csv")]


def test_a_flipped_bit_of_a_table_or_its_digest_is_noticed(results):
    table, digest = results / "tables/a.csv", results / ".digests/tables/a.csv.sha256"
    whole = table.read_text()
    for path in (table, digest):
        for place in range(0, 8 * path.stat().st_size, 13):
            flip(path, place // 8, place % 8)
            build, said = verify(results)
            assert build == [str(table)]
            assert said == f"{table}: not what was written (wrong checksum); " + (
                "set aside, it will be built again\n"
            )
            write_text(table, whole)
            assert verify(results) == ([], "")


def test_headers_of_data_and_weights_are_guarded(results):
    write_product(results / "data/b.h5", "b", {"b": Column(np.arange(3), "m", "b")}, {"seed": 7})
    save_weights(results / "dae/w.safetensors", {"w": torch.ones(2)}, {"lr": 0.5})
    for path, text in ((results / "data/b.h5", b'"seed"'), (results / "dae/w.safetensors", b"0.5")):
        flip(path, path.read_bytes().index(text) + 1)
        assert str(path) in verify(results)[0]
        assert not path.exists()


def test_a_digest_without_a_product_and_logs_are_no_damage(results):
    (results / "tables/a.csv").unlink()
    (results / "logs").mkdir()
    (results / "logs/a.log").write_text("anything")
    assert verify(results) == ([], "")


def test_files_that_the_workflow_does_not_know_are_built_with_their_job(results):
    point = results / "sweeps/width/points/0123456789ab"
    write_text(point / "cost.json", "{}")
    flip(point / "cost.json", 0)
    build, said = verify(results)
    assert build == [str(point / "result.json")]
    assert said.startswith(f"{point / 'cost.json'}: ")


def test_on_the_disk_before_it_has_its_name(results, monkeypatch):
    """Content, then the digest, then the name, then the folder."""
    events, fsync, replace = [], os.fsync, os.replace

    def synced(descriptor):
        events.append(("sync", os.fstat(descriptor).st_ino))
        fsync(descriptor)

    def renamed(source, target, **more):
        events.append(("name", Path(source).stat().st_ino, Path(target).name))
        replace(source, target, **more)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    monkeypatch.setattr(os, "rename", renamed)
    path = results / "tables/a.csv"
    write_text(path, "new")
    digest = results / ".digests/tables/a.csv.sha256"
    assert events == [
        ("sync", path.stat().st_ino),
        ("sync", digest.stat().st_ino),
        ("name", digest.stat().st_ino, digest.name),
        ("sync", digest.parent.stat().st_ino),
        ("name", path.stat().st_ino, path.name),
        ("sync", path.parent.stat().st_ino),
    ]


@pytest.mark.parametrize("kind", ["link", "file"])
def test_a_temporary_name_that_exists_is_not_written_through(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(files.secrets, "token_hex", lambda size: "00" * size)
    with atomic_path(tmp_path / "a.csv") as temporary:
        planted = temporary
    victim = tmp_path / "victim"
    victim.write_text("precious")
    if kind == "link":
        planted.symlink_to(victim)
    else:
        planted.write_text("theirs")
    with pytest.raises(FileExistsError):
        write_text(tmp_path / "a.csv", "ours")
    assert victim.read_text() == "precious"
    assert planted.read_text() == ("precious" if kind == "link" else "theirs")


@pytest.fixture
def killed(tmp_path):
    """Temporary file of a writer that was killed."""
    code = (
        "import sys, time; from psfdae.files import atomic_path\n"
        "with atomic_path(sys.argv[1]): print('in', flush=True); time.sleep(60)"
    )
    writer = subprocess.Popen(
        [sys.executable, "-c", code, tmp_path / "a.csv"], stdout=subprocess.PIPE
    )
    writer.stdout.readline()
    (left,) = tmp_path.glob(".a.csv*.tmp")
    yield writer, left
    writer.kill()
    writer.wait()
    writer.stdout.close()


def test_what_a_killed_writer_left_is_swept_by_the_next(tmp_path, killed):
    writer, left = killed
    write_text(tmp_path / "a.csv", "1")
    assert left.exists(), "its writer was alive"
    writer.send_signal(signal.SIGKILL)
    writer.wait()
    write_text(tmp_path / "b.csv", "1")
    assert left.exists(), "of another file"
    write_text(tmp_path / "a.csv", "2")
    assert not left.exists()


def test_verify_sweeps_only_what_is_certainly_stale(tmp_path, killed):
    writer, left = killed
    verify(tmp_path)
    assert left.exists()
    writer.kill()
    writer.wait()
    machine, pid, started, token = left.name.removesuffix(".tmp").rsplit(".", 1)[1].split("-")
    other = "0" * 12 if machine != "0" * 12 else "1" * 12
    elsewhere = tmp_path / f".a.csv.{other}-{pid}-{started}-{token}.tmp"
    reused = tmp_path / f".a.csv.{machine}-{os.getpid()}-1-{token}.tmp"
    foreign = tmp_path / ".a.csv.17.tmp"
    for path in (elsewhere, reused, foreign):
        path.touch()
    verify(tmp_path)
    assert elsewhere.exists()
    assert foreign.exists()
    assert not left.exists()
    assert not reused.exists()


def test_a_writer_that_is_hidden_is_not_taken_for_dead(tmp_path, killed, monkeypatch):
    _, left = killed

    def denied(pid, number):
        raise PermissionError

    monkeypatch.setattr(files, "_started", lambda pid: "")
    monkeypatch.setattr(os, "kill", denied)
    verify(tmp_path)
    assert left.exists()


def test_a_long_name_can_be_written(tmp_path):
    path = tmp_path / ("ü" * 120 + ".csv")
    write_text(path, "1")
    assert path.read_text() == "1"
    assert list(tmp_path.iterdir()) == [path]


STATE = {
    "attempt": 1,
    "history": [{"epoch": 1, "validation_mse": float("nan")}],
    "model": {"w": torch.arange(50.0)},
    "best_mse": 0.25,
}


def test_no_flipped_bit_of_a_checkpoint_is_trained_on(tmp_path, capsys):
    path = tmp_path / "c.pt"
    save_checkpoint(path, "same", STATE)
    assert load_checkpoint(path, "same")["best_mse"] == 0.25
    capsys.readouterr()
    draw = random.Random(1)
    bits = 8 * path.stat().st_size
    for bit in [*range(0, 8 * 100, 11), *(draw.randrange(bits) for _ in range(100)), bits - 1]:
        flip(path, bit // 8, bit % 8)
        assert load_checkpoint(path, "same") is None, bit
        assert capsys.readouterr().out == f"{path}: damaged checkpoint ignored (wrong checksum)\n"
        flip(path, bit // 8, bit % 8)
    assert load_checkpoint(path, "same") is not None


@pytest.mark.parametrize("content", [b"", b"\n", b"psfdae checkpoint, sha256 \n"])
def test_a_cut_checkpoint_is_ignored(tmp_path, capsys, content):
    path = tmp_path / "c.pt"
    path.write_bytes(content)
    assert load_checkpoint(path, "same") is None
    assert "damaged" in capsys.readouterr().out


def test_a_streamed_product_takes_no_more_than_it_needs(tmp_path):
    columns = {
        "a": Empty((1000, 16, 16), np.float32, "1", "a"),
        "b": Column(np.arange(7), "1", "b"),
    }
    with stream_product(tmp_path / "s.h5", "s", columns, {}) as data:
        data["a"][:] = 1.0
    assert (tmp_path / "s.h5").stat().st_size < 1.2 * 4 * 16 * 16 * 1000


@pytest.mark.parametrize("damage", ["", "s\n", "s\tmax_rss\n1\tx\n", "\xff"])
def test_a_damaged_benchmark_costs_its_numbers_only(tmp_path, capsys, damage):
    folder = tmp_path / "benchmarks/train"
    folder.mkdir(parents=True)
    (folder / "a.tsv").write_text("s\th:m:s\tmax_rss\tcpu_time\n1.5\t0:00:01\t-\t1.25\n")
    (folder / "b.tsv").write_bytes(damage.encode("latin1"))
    logs = tmp_path / "logs/train"
    logs.mkdir(parents=True)
    for name in "ab":
        (logs / f"{name}.log").write_text("0m0.002s 0m0.001s\n0m1.150s 0m0.100s\n")
    record.runtime(tmp_path, tmp_path / "runtime.csv")
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith(f"{folder / 'b.tsv'}: damaged")
    rows = (tmp_path / "runtime.csv").read_text().splitlines()
    assert rows[1:] == ["train,a,1.5,1.25,", "train,b,,1.25,"]


@pytest.mark.parametrize("log", [None, "", "killed\n", "0m1.150s\n", "\xff"])
def test_a_log_without_cpu_time_costs_that_number_only(tmp_path, capsys, log):
    (tmp_path / "benchmarks/train").mkdir(parents=True)
    (tmp_path / "benchmarks/train/a.tsv").write_text("s\tmax_rss\n1.5\t3\n")
    (tmp_path / "logs/train").mkdir(parents=True)
    path = tmp_path / "logs/train/a.log"
    if log is not None:
        path.write_bytes(log.encode("latin1"))
    record.runtime(tmp_path, tmp_path / "runtime.csv")
    assert capsys.readouterr().err.startswith(f"{path}: no CPU time")
    assert (tmp_path / "runtime.csv").read_text().splitlines()[1:] == ["train,a,1.5,,3"]
