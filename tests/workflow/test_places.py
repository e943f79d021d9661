"""A run in a folder of its own: from a source tree that nothing may write to, in a container."""

from __future__ import annotations

import os
import shutil

import pytest

from workflow_runs import NO_CLUSTER, PATH, captured, copy_of_sources, environment

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

TEMPLATES = "results/data/seidel/templates.h5"
READ_ONLY = 'mount --bind "$1" "$1"; mount -o remount,bind,ro "$1"; shift; exec "$@"'
"""For a namespace of mounts: makes a folder read-only, also for root, and runs a command."""
APPTAINER = """#!/bin/sh
[ "$1" != --version ] || { echo "apptainer version 1.3.0"; exit; }
echo "$*" >> calls.txt
while [ "$1" != bash ]; do shift; done
exec "$@"
"""
"""Stands in for apptainer: notes its arguments, and runs the command outside of any container."""


def test_a_read_only_source_tree_is_enough_and_jobs_run_in_the_image(tmp_path):
    source, run, programs = (tmp_path / name for name in ("source", "run", "programs"))
    for folder in (source, run, programs):
        folder.mkdir()
    copy_of_sources(source)
    for name in ("apptainer", "singularity"):
        (programs / name).write_text(APPTAINER)
        (programs / name).chmod(0o755)
    (run / "psfdae.sif").touch()
    inside = ["unshare", "--mount", "--map-root-user", "sh", "-ec", READ_ONLY, "sh", str(source)]
    if not shutil.which("unshare") or captured([*inside, "true"]).returncode:
        pytest.skip("no namespace of mounts here")
    assert captured([*inside, "touch", source / "config/new.yaml"]).returncode != 0
    words = ["--snakefile", source / "Snakefile", "--cores", "1", "--sdm", "apptainer"]
    words += ["--config", "preset=smoke", "results=results", "--", TEMPLATES]
    path = f"{programs}{os.pathsep}{PATH}"
    variables = environment(PATH=path, PYTHONPATH=str(source / "src"), **NO_CLUSTER)
    process = captured([*inside, "snakemake", *words], cwd=run, env=variables)
    assert process.returncode == 0, process.stderr
    assert (run / TEMPLATES).is_file()
    # The image comes before the command of the job.
    image, _, command = (run / "calls.txt").read_text().partition(" psfdae.sif bash ")
    assert image.startswith("exec ") and "psfdae paper templates" in command
