"""Targets `bundles` and `shipped` of the workflow."""

from __future__ import annotations

import pytest

from psfdae.model.bundle import read_bundle
from workflow_runs import planned, snakemake

pytestmark = [pytest.mark.workflow, pytest.mark.slow]


def test_bundles_are_those_of_the_paper_s_datasets(tmp_path):
    jobs = planned(tmp_path, "bundles")
    fits = dict.fromkeys(("train", "bundle", "fit_gmm", "bundle_gmm"), 2)
    assert jobs == {"templates": 2, "stars": 2, **fits}


def test_default_target_packs_nothing_and_trains_no_other_dataset(tmp_path):
    out = snakemake(tmp_path, "--dry-run")
    assert "bundle" not in out
    assert "seidel_field" not in out


def test_shipped_bundle_is_trained_on_its_own_stars_and_written_where_it_is_read(tmp_path):
    fits = dict.fromkeys(("train", "bundle", "fit_gmm", "bundle_gmm"), 1)
    assert planned(tmp_path, "shipped") == {"templates": 1, "stars": 1, **fits}
    snakemake(tmp_path, "shipped")
    bundle = read_bundle(tmp_path / "src/psfdae/bundles/wfsat.psf.safetensors")
    assert (bundle.info.name, bundle.info.subpixel) == ("wfsat", True)
    assert bundle.info.config["train"]["noise"]["name"] == "field"
    assert planned(tmp_path, "shipped") == {}
