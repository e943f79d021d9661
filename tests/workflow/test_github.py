"""Jobs on GitHub: what they run can be run here, and nobody can exchange what they use."""

import re

import pytest
import yaml

from docs_pages import ROOT

WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_jobs_call_make_and_pinned_actions(path):
    """A job calls make and nothing else, or hands on what such jobs have made."""
    text = path.read_text()
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    jobs = yaml.safe_load(text)["jobs"]
    for name, job in jobs.items():
        runs = [step["run"].split() for step in job["steps"] if "run" in step]
        assert [words[0] for words in runs] == ["make"] * len(runs), name
        assert {words[1] for words in runs} <= targets, name
        assert runs or job["needs"], name
        assert job["timeout-minutes"], name
    # A tag of an action can be moved; a commit cannot. The comment says which version it is.
    actions = re.findall(r"uses: (.*)", text)
    assert actions
    for action in actions:
        assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action), action


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_only_jobs_that_publish_may_write(path):
    """All others read the sources; those that publish run no code of the sources."""
    workflow = yaml.safe_load(path.read_text())
    assert workflow["permissions"] == {"contents": "read"}
    for name, job in workflow["jobs"].items():
        if "permissions" in job:
            assert not any("run" in step for step in job["steps"]), name
            assert {"environment", "needs"} <= set(job), name
