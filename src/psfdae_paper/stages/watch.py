"""Stages `watch` and `page`: what runs beside the workflow and beside MLflow's page."""

from __future__ import annotations

import os
import sqlite3
import sys
import time
import urllib.request
import webbrowser
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import click

from psfdae.options import File, Folder
from psfdae_paper.configuration.command import command
from psfdae_paper.runs_page import ALL, VIEW, address
from psfdae_paper.stages.track import (
    LIVE,
    alone,
    client_of,
    experiment_of,
    first_line,
    log_metrics,
    ours_to_explain,
    prepared,
    tags_of,
)
from psfdae_paper.tracking import Run, runs_under_way

if TYPE_CHECKING:
    from mlflow import MlflowClient

EVERY_S = 2.0
"""Between looks at trainings, or at a server that is starting."""


@command("watch")
def watch(
    results: Annotated[Folder, "Folder that the workflow writes to."],
    preset: Annotated[str, "Goes into the tags."],
    database: Annotated[File, "As of `psfdae track`."],
) -> None:
    """Show trainings under way in MLflow, as long as the program runs that started this one.

    Their histories are read from the files beside their checkpoints. `psfdae track`
    replaces such a run by the finished one.
    """
    starter, watcher = os.getppid(), Watcher(preset, database)
    try:
        while os.getppid() == starter:
            watcher.look(runs_under_way(results, preset))
            time.sleep(EVERY_S)
        watcher.end()
    except Exception as error:
        if not ours_to_explain(error):
            raise
        print(f"trainings are not shown in MLflow any more: {first_line(error)}")


class Shown(NamedTuple):
    """A run that follows a training: its id, its start in ms since 1970, the epochs that it has."""

    run_id: str
    start_ms: int
    epochs: int


class Watcher:
    """Runs of MLflow that follow trainings."""

    def __init__(self, preset: str, database: Path) -> None:
        self.preset, self.database, self.uri = preset, database, prepared()
        self._shown: dict[str, Shown] = {}

    def look(self, records: Sequence[Run]) -> None:
        """Log the epochs that are new."""
        known = {source: shown.epochs for source, shown in self._shown.items()}
        fresh = [r for r in records if len(r.epochs) != known.get(r.source)]
        if not fresh:
            return
        with alone(self.database):
            client = client_of(self.uri, self.database)
            for record in fresh:
                self._follow(client, record)

    def _follow(self, client: MlflowClient, record: Run) -> None:
        from mlflow.entities import Metric

        shown = self._shown.get(record.source)
        if shown and len(record.epochs) < shown.epochs:  # it has started anew
            client.delete_run(shown.run_id)
            shown = None
        if shown is None:
            artifacts = self.database.parent / "mlartifacts"
            experiment = experiment_of(client, record.experiment, self.uri, artifacts)
            tags = {**tags_of(record), "preset": self.preset, "config_hash": LIVE}
            created = client.create_run(experiment, record.start_ms, tags, record.name)
            shown = Shown(created.info.run_id, record.start_ms, 0)
        # A file's time is later than its last epoch by this or that.
        shift = shown.start_ms - record.start_ms
        metrics = [
            Metric(p.name, p.value, p.time_ms + shift, p.epoch)
            for p in record.points
            if p.epoch > shown.epochs
        ]
        log_metrics(client, shown.run_id, metrics)
        self._shown[record.source] = shown._replace(epochs=len(record.epochs))

    def end(self) -> None:
        """Runs that no import has replaced were given up, or their import comes later."""
        if self._shown:
            with alone(self.database):
                client = client_of(self.uri, self.database)
                for shown in self._shown.values():
                    if client.get_run(shown.run_id).info.lifecycle_stage == "active":
                        client.set_terminated(shown.run_id, "KILLED")


@command("page")
def page(
    database: Annotated[File, "As of `psfdae track`."],
    port: Annotated[int, click.IntRange(1, 65535), "Of MLflow's page on this machine."],
) -> None:
    """Say where MLflow's page has which runs, once it answers; a browser opens the first.

    Without a screen no browser opens. It ends with the program that started it.
    """
    starter, base = os.getppid(), f"http://127.0.0.1:{port}/"
    while not _answers(base):
        time.sleep(EVERY_S)
        if os.getppid() != starter:
            return
    found = views_in(database)
    for name, place in found:
        print(f"{name:<24} {base}{place}", flush=True)
    if found and ({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ) or sys.platform == "darwin"):
        webbrowser.open(base + found[0][1])


def views_in(database: Path) -> list[tuple[str, str]]:
    """Names and addresses of the views of a database: of each experiment all runs come first."""
    query = (
        "select experiment_id, name, substr(key, ?) from experiments"
        " join experiment_tags using (experiment_id)"
        " where lifecycle_stage = 'active' and substr(key, 1, ?) = ?"
    )
    with closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True)) as opened:
        rows = opened.execute(query, (len(VIEW) + 1, len(VIEW), VIEW)).fetchall()
    rows.sort(key=lambda row: (row[1], row[2] != ALL, row[2]))
    return [
        (f"{name}, all runs" if view == ALL else f"  {view}", address(str(experiment), view))
        for experiment, name, view in rows
    ]


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=EVERY_S):
            return True
    except OSError:
        return False
