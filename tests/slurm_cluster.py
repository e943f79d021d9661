"""A real SLURM cluster on one machine: munged, slurmctld and two slurmd of one CPU each."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

CONF = Path("/etc/slurm/slurm.conf")
"""Where Snakemake's job steps look; they drop SLURM_CONF from their environment."""
PACKAGES = ("slurmctld", "slurmd", "slurm-client", "munge")
MARK = "# Test cluster of psfdae; its process is"
MUNGE_SOCKET = Path("/run/munge/munge.socket.2")
NODES = ("n1", "n2")

TEMPLATE = """\
{mark} {pid}
ClusterName=psfdae
SlurmctldHost=localhost
SlurmctldPort=17000
AuthType=auth/munge
CredType=cred/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=batch_sched_delay=0,sched_interval=1,sched_min_interval=0,bf_interval=1
ReturnToService=2
MinJobAge=3600
SlurmdParameters=config_overrides
NodeName=n[1-2] NodeHostname=localhost NodeAddr=127.0.0.1 Port=[17001-17002] CPUs=1 RealMemory=4000
PartitionName=main Nodes=n[1-2] Default=YES MaxTime=INFINITE State=UP
"""


def obstacle() -> str:
    """Why the cluster cannot be started here; empty if it can."""
    if os.geteuid() != 0:
        return "slurmctld and slurmd need root"
    # Debian's clients bring plugstack.conf; anything else is somebody's cluster.
    found = [path for path in CONF.parent.glob("*") if not path.name.startswith("plugstack")]
    if found and not (found == [CONF] and _left_behind()):
        return f"{found[0]} exists: this machine has a cluster of its own"
    if not all(shutil.which(program) for program in ("slurmctld", "slurmd", "sbatch", "munged")):
        return _install()
    return ""


def _left_behind() -> bool:
    """Whether slurm.conf is that of a test that was killed."""
    first = CONF.read_text(encoding="utf-8").partition("\n")[0]
    return first.startswith(MARK) and not Path(f"/proc/{first.removeprefix(MARK).strip()}").exists()


def _install() -> str:
    """Install the packages; the reason if that fails."""
    if shutil.which("apt-get") is None:
        return "no slurmctld, and no apt-get to install it"
    command = ["apt-get", "install", "-y", "--no-install-recommends", *PACKAGES]
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for step in (["apt-get", "update"], command):
        done = subprocess.run(step, env=environment, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else f"apt-get: {done.stderr.strip().splitlines()[-1]}"


@contextmanager
def cluster(folder: Path) -> Iterator[None]:
    """Run the cluster with its state below a folder; stop it and remove its conf, always."""
    with ExitStack() as stack:
        for name in ("state", *(f"spool-{node}" for node in NODES)):
            (folder / name).mkdir(parents=True)
        CONF.parent.mkdir(exist_ok=True)
        stack.callback(CONF.unlink, missing_ok=True)
        text = TEMPLATE.format(mark=MARK, pid=os.getpid(), folder=folder)
        CONF.write_text(text, encoding="utf-8")
        if not _munge_answers():
            stack.enter_context(_daemon(_munged(), folder / "munged.log"))
            wait_for(_munge_answers, 10, "munged")
        stack.enter_context(_daemon(["slurmctld", "-D"], folder / "slurmctld.log"))
        for node in NODES:
            stack.enter_context(_daemon(["slurmd", "-D", "-N", node], folder / f"{node}.log"))
        # Before the nodes stop: the steps of a job outlive their slurmd.
        stack.callback(_cancel_everything)
        wait_for(lambda: states() == dict.fromkeys(NODES, "idle"), 30, "the nodes")
        yield


def _munge_answers() -> bool:
    """Whether somebody listens at the socket; it outlives a daemon that was killed."""
    with socket.socket(socket.AF_UNIX) as client:
        return client.connect_ex(str(MUNGE_SOCKET)) == 0


def _munged() -> list[str]:
    for folder in ("/run/munge", "/var/log/munge", "/var/lib/munge"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        shutil.chown(folder, "munge", "munge")
    user = ["setpriv", "--reuid=munge", "--regid=munge", "--clear-groups"]
    return [*user, "munged", "--foreground"]


@contextmanager
def _daemon(command: list[str], log: Path) -> Iterator[None]:
    """Run a daemon in the foreground of a process that we own."""
    with log.open("w") as out:
        process = subprocess.Popen(command, stdout=out, stderr=out, start_new_session=True)
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _cancel_everything() -> None:
    subprocess.run(["scancel", f"--user={os.getuid()}"], capture_output=True, check=False)
    wait_for(lambda: not ask("squeue", "--noheader"), 30, "the jobs to end")


def ask(*command: str) -> str:
    """Output of a SLURM command; empty where it fails."""
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def states() -> dict[str, str]:
    """State of every node."""
    lines = ask("sinfo", "--Node", "--noheader", "--format=%N %t").splitlines()
    return dict(line.split() for line in lines)


def wait_for(condition, seconds: float, what: str) -> None:
    """Wait until a condition holds; fail by name after some seconds."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited {seconds:g} s for {what}")
        time.sleep(0.1)
