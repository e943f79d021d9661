"""Runs that are killed, starved, locked out or damaged end, once repeated, in the same files.

Every case breaks a `make reproduce` of one dataset's network, baseline and evaluation, then
types the same again. What comes out is compared byte by byte with an undisturbed run; the
time of the recovery goes into the report of the tests.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import time

import psutil
import pytest

from workflow_runs import KERNELS, NO_CLUSTER, PATH, QUIET, captured, clone, job_counts, wait_until

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

TARGET = "results/smoke/evaluation/dataset3/random-realisation.csv"
WEIGHTS = "results/smoke/dae/dataset3/random-realisation/dae.safetensors"
STARS = "results/smoke/data/seidel/seidel_10pct.h5"
CHECKPOINT = "results/smoke/checkpoints/dae/dataset3/random-realisation.pt"
LOG = "results/smoke/logs/train/dataset3/random-realisation.log"
# Long enough for a signal to arrive in mid-training, which then resumes.
SLOW = "train.epochs=80 train.checkpoint_seconds=0 train.batch=8"
TOO_LARGE = 150_000
"""Bytes that a file may have on the full disk: less than the stars need."""


def reproduce(folder):
    """What a user types, with the environment active and nothing else set, for `subprocess`."""
    own = {"HOME": str(folder), "PATH": PATH, "PYTHONPATH": str(folder / "src")}
    own |= NO_CLUSTER | KERNELS
    line = ["make", "reproduce", "PRESET=smoke", f"TARGETS={TARGET}", f"SET={SLOW}"]
    return {"args": line, "cwd": folder, "env": own}


def with_stars(smoke, folder):
    """A house with the stars and their digests, but without network and evaluation."""
    clone(folder)
    for name in ("data", ".digests/data"):
        shutil.copytree(smoke / "results" / name, folder / "results/smoke" / name)
    return folder


@pytest.fixture(scope="module")
def undisturbed(smoke, tmp_path_factory):
    """The run that nothing happens to."""
    folder = with_stars(smoke, tmp_path_factory.mktemp("undisturbed") / "house")
    subprocess.run(**reproduce(folder), check=True, **QUIET)
    return folder


@pytest.fixture
def half_done(smoke, tmp_path):
    return with_stars(smoke, tmp_path / "house")


@pytest.fixture
def recovers(undisturbed, record_property):
    """Repeats the run of a folder and compares its files with those of the undisturbed one."""

    def repeat(folder, **more):
        start = time.monotonic()
        run = captured(**{**reproduce(folder), **more})
        assert run.returncode == 0, run.stdout + run.stderr
        seconds = round(time.monotonic() - start, 1)
        record_property("recovery_s", seconds)
        print(f"recovered in {seconds} s")
        products = [
            path.relative_to(undisturbed)
            for path in (undisturbed / "results/smoke").rglob("*")
            if path.suffix in (".h5", ".safetensors", ".csv", ".parquet")
            and path.name != "history.csv"
        ]
        assert len(products) >= 6
        for path in products:
            assert (folder / path).read_bytes() == (undisturbed / path).read_bytes(), path
        assert not list((folder / "results/smoke").rglob("*.tmp"))
        assert not (folder / CHECKPOINT).exists()
        return run.stdout + run.stderr

    return repeat


def started(folder, **more):
    """A run that has reached the middle of its training."""
    run = subprocess.Popen(**{**reproduce(folder), **more}, **QUIET)
    wait_until((folder / CHECKPOINT).exists, 90, "the training left no checkpoint")
    return run


def ended(run, folder):
    """Wait for a broken run; nothing in it may look finished."""
    assert run.wait(60) != 0
    assert not (folder / TARGET).exists()


def test_killed_worker(half_done, recovers):
    written = (half_done / STARS).stat().st_mtime_ns
    run = started(half_done)
    for child in psutil.Process(run.pid).children(recursive=True):
        if "fit" in child.cmdline() and "--checkpoint" in child.cmdline():
            child.kill()
    ended(run, half_done)
    assert (half_done / CHECKPOINT).exists()
    assert not (half_done / WEIGHTS).exists()
    recovers(half_done)
    log = (half_done / LOG).read_text()
    assert "resuming after epoch" in log
    assert "epoch 80/80" in log
    assert (half_done / STARS).stat().st_mtime_ns == written


def test_killed_snakemake(half_done, recovers):
    """Its jobs run on and its lock stays; the wrapper of make deals with both."""
    run = started(half_done)
    everyone = psutil.Process(run.pid).children(recursive=True)
    snakemake = next(p for p in everyone if any("bin/snakemake" in w for w in p.cmdline()[:2]))
    orphans = snakemake.children(recursive=True)
    snakemake.kill()
    assert run.wait() != 0
    assert any(child.is_running() for child in orphans)
    assert "waiting for it to end" in recovers(half_done)


def test_terminated_snakemake(half_done, recovers):
    run = started(half_done)
    run.send_signal(signal.SIGTERM)
    ended(run, half_done)
    recovers(half_done)


def test_interrupted_from_the_keyboard(half_done, recovers):
    def heed():
        # Tests that run in the background of a shell have inherited that SIGINT is ignored.
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    run = started(half_done, start_new_session=True, preexec_fn=heed)
    os.killpg(run.pid, signal.SIGINT)
    ended(run, half_done)
    recovers(half_done)


def test_full_disk(half_done, recovers):
    """A limit on the size of files: the stars do not fit, nothing half-written stays."""
    (half_done / STARS).unlink()

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (TOO_LARGE, resource.RLIM_INFINITY))

    run = captured(**reproduce(half_done), preexec_fn=limit)
    assert run.returncode != 0
    assert not (half_done / STARS).exists()
    log = (half_done / "results/smoke/logs/stars/seidel/seidel_10pct.log").read_text()
    assert log.startswith("psfdae: "), log
    assert "File too large" in log
    recovers(half_done)


def test_read_only_results(half_done, recovers):
    """Refused with a message, nothing changed; goes on once the folder can be written."""
    inside = [half_done / "results/smoke", *(half_done / "results/smoke").rglob("*")]
    for path in inside:
        path.chmod(0o555 if path.is_dir() else 0o444)
    arguments = reproduce(half_done)
    if os.geteuid() == 0:
        # Root may write anywhere, unless it gives up that capability.
        arguments["args"] = ["setpriv", "--bounding-set=-dac_override", *arguments["args"]]
    run = captured(**arguments)
    assert run.returncode != 0
    assert "Permission denied" in run.stdout + run.stderr
    assert not (half_done / WEIGHTS).exists()
    for path in inside:
        path.chmod(0o755 if path.is_dir() else 0o644)
    recovers(half_done)


@pytest.mark.parametrize("damage", ["truncated", "flipped"])
@pytest.mark.parametrize("product", [STARS, WEIGHTS])
def test_damaged_file(undisturbed, tmp_path, recovers, product, damage):
    """Named, set aside, and built again with everything that depends on it."""
    tmp_path /= "house"
    shutil.copytree(undisturbed, tmp_path, symlinks=True)
    path = tmp_path / product
    whole = path.read_bytes()
    times = path.stat()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
    path.write_bytes(whole[:middle] if damage == "truncated" else flipped)
    # As a failing disk does it: nothing tells by its date.
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    said = recovers(tmp_path)
    assert f"{product}: " in said
    assert "set aside" in said
    jobs = job_counts(said)
    assert jobs["train"] == 1
    assert ("stars" in jobs) == (product == STARS)
    assert "templates" not in jobs


def test_two_runs_in_one_folder(half_done, recovers):
    """The second waits, then finds nothing left to do."""
    first = started(half_done)
    second = recovers(half_done)
    assert first.wait(60) == 0
    assert "waiting for it to end" in second
    assert not job_counts(second).get("train")
