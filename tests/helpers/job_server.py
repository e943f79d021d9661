"""Runs `psfdae` in forks of one process, in which the packages are imported once for all jobs.

A job of the smallest sizes is mostly the start of an interpreter with torch, hydra and
scikit-learn. What it computes, its files, output and exit code are those of a process of its own.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

CLIENT = """\
#!{python} -SE
import json, os, socket, sys
server = socket.socket(socket.AF_UNIX)
server.connect({address!r})
job = json.dumps([sys.argv[1:], os.getcwd(), dict(os.environ)]).encode()
socket.send_fds(server, [len(job).to_bytes(4, "big")], [0, 1, 2])
server.sendall(job)
sys.exit(int(server.recv(8) or 1))
"""
"""The program `psfdae` of the jobs: its words, folder, environment and files go to the server."""


@contextmanager
def job_server():
    """Serve the jobs of a run; gives the folder with the program `psfdae`, for their PATH."""
    with TemporaryDirectory() as folder:
        address, program = f"{folder}/jobs", Path(folder) / "psfdae"
        program.write_text(CLIENT.format(python=sys.executable, address=address))
        program.chmod(0o755)
        words = [sys.executable, __file__, address]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
            try:
                assert server.stdout.readline() == "ready\n"
                yield folder
            finally:
                server.kill()


def import_stages() -> None:
    """Import what the stages need, and what their first call imports."""
    from psfdae.commands.cli import command_modules

    for module, _ in command_modules().values():
        import_module(module)
    for late in ("matplotlib.pyplot", "sklearn.cluster", "sklearn.mixture", "skimage.metrics"):
        import_module(late)
    import torch

    torch.optim.Adam([torch.zeros(1)])


def run_job(connection: socket.socket) -> None:
    """Run one job in this fork, with the files, folder and environment of who asks for it."""
    from psfdae.commands.cli import main

    size, files, _, _ = socket.recv_fds(connection, 4, 3)
    text = b""
    while len(text) < int.from_bytes(size, "big"):
        text += connection.recv(1 << 16)
    words, place, variables = json.loads(text)
    for number, file in enumerate(files):
        os.dup2(file, number)
    os.chdir(place)
    os.environ.clear()
    os.environ.update(variables)
    code = 1
    try:
        main(words, prog_name="psfdae")
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        connection.sendall(str(code).encode())
        os._exit(0)


def serve(address: str) -> None:
    """Fork for every connection, until this process is ended."""
    import signal

    import_stages()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(address)
        server.listen(16)
        print("ready", flush=True)
        while True:
            connection, _ = server.accept()
            if os.fork() == 0:
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                run_job(connection)
            connection.close()


if __name__ == "__main__":
    serve(sys.argv[1])
