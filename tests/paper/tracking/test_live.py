"""Trainings that log the ends of their epochs to MLflow."""

from __future__ import annotations

import pytest

from psfdae.methods.networks.training import listener
from tracked_results import ALL, HISTORY


@pytest.mark.parametrize(
    "place",
    ["dae/dataset3/random-template.pt", "dae/dataset3/random-template.wavefront.pt", "knee-1.pt"],
)
def test_epochs_appear_as_they_are_trained_and_the_finished_run_replaces_them(
    site, monkeypatch, place
):
    monkeypatch.setenv("PSFDAE_EPOCHS", "psfdae_paper.stages.track:logger")
    monkeypatch.setenv("PSFDAE_RESULTS", str(site.results))
    monkeypatch.setenv("PRESET", "smoke")
    names = ("epoch", "train_mse", "validation_mse", "seconds")
    # A training that starts anew has its first epoch once.
    for count in (3, 1, 3):
        log_epoch = listener(site.results / "checkpoints" / place)
        for row in HISTORY[:count]:
            log_epoch(dict(zip(names, map(float, row), strict=True)))
        if place.startswith("dae"):
            (run,) = site.runs(experiment="live")
            assert run.info.status == "RUNNING"
            points = [(p.step, p.value / 1e6) for p in site.history(run, "epoch/train_mse_1e-6")]
            assert points == [pytest.approx((row[0], row[1])) for row in HISTORY[:count]]
    assert site.track() == dict.fromkeys(ALL, "created")
    if place.startswith("dae"):
        assert site.runs(experiment="live") == []
