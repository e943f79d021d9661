"""Trainings that are shown in MLflow while they run."""

from __future__ import annotations

import pytest

from psfdae_paper.registry import forget
from psfdae_paper.stages.watch import Watcher
from psfdae_paper.tracking import runs_under_way
from test_track import HISTORY, site, write_history  # noqa: F401


@pytest.fixture
def live(site):  # noqa: F811
    """A site with a watcher, and the file that a training writes meanwhile."""
    course = site.results / "checkpoints/dae/dataset3/random-template.csv"
    course.parent.mkdir(parents=True)
    watcher = Watcher("smoke", site.database)
    return site, course, lambda: watcher.look(runs_under_way(site.results, "smoke")), watcher.end


def contents(site, run):  # noqa: F811
    """All that a run says, but for its id."""
    points = {
        name: [(p.step, p.value, p.timestamp) for p in site.history(run, name)]
        for name in run.data.metrics
    }
    info = (run.info.run_name, run.info.status, run.info.start_time, run.info.end_time)
    return info, run.data.params, run.data.tags, points


def test_epochs_appear_as_they_are_trained_and_the_finished_run_is_as_ever(live):
    site, course, look, end = live  # noqa: F811
    site.track()
    (usual,) = (contents(site, run) for run in site.runs())
    for run in site.runs("dae") + site.runs("baseline"):
        forget(site.client, run.info.run_id)
    # A training that starts anew has its first epoch once.
    for epochs in (3, 1, 3):
        write_history(course, HISTORY[:epochs])
        look()
        look()
        (run,) = site.runs()
        assert run.info.status == "RUNNING"
        points = [(p.step, p.value) for p in site.history(run, "train_mse")]
        assert points == [(row[0], row[1]) for row in HISTORY[:epochs]]
    course.unlink()
    assert site.track() == {"dae": "created", "baseline": "created"}
    end()
    (finished,) = site.runs()
    assert contents(site, finished) == usual
    assert site.track() == {"dae": "unchanged", "baseline": "unchanged"}
