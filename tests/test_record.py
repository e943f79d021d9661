"""Run costs and the run of record."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest

from psfdae.files import ProductError
from psfdae_paper import source
from psfdae_paper.configuration.compose import load
from psfdae_paper.stages import record
from workflow_runs import PATH, captured, environment

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "results/reference"


@pytest.fixture
def results(tmp_path):
    """A finished run with two jobs, one table and what Snakemake says of them."""
    header = "s\th:m:s\tmax_rss\tmax_vms\tmax_uss\tmax_pss\tio_in\tio_out\tmean_load\tcpu_time\n"
    for name, seconds in (("train/dataset3/random-template", 12.5), ("runtime/all", 0.4)):
        path = tmp_path / "results/benchmarks" / f"{name}.tsv"
        path.parent.mkdir(parents=True)
        memory = "-" if seconds < 1 else "812.5"
        row = f"{seconds}\t0:00:12\t{memory}\t1\t1\t1\t0\t0\t99\t0.3\n"
        path.write_text(header + row)
        log = tmp_path / "results/logs" / f"{name}.log"
        log.parent.mkdir(parents=True)
        log.write_text(f"said\n0m0.002s 0m0.001s\n0m{seconds:.3f}s 1m0.250s\n")
    written(tmp_path / "results/tables/t.csv", "a\n1\n")
    written(tmp_path / "results/runtime.csv", "rule\n")
    return tmp_path / "results"


def written(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def plan(results, **status):
    """What `snakemake --summary` would say; files that are not named are up to date."""
    rows = {"runtime.csv": "no update", "data/stars.h5": "update pending"} | status
    lines = [f"{results / name}\t-\trule\t-\tok\t{said}\n" for name, said in rows.items()]
    head = "output_file\tdate\trule\tlog-file(s)\tstatus\tplan\n"
    return written(results.parent / "plan.tsv", head + "".join(lines))


@pytest.fixture
def history(tmp_path, monkeypatch):
    """Git in the folder of the test, as if the package lay there; commits what is in it."""
    monkeypatch.setattr(source, "SOURCES", tmp_path / "src")
    written(tmp_path / "src/psfdae/a.py", "")
    for name in ("name", "email"):
        for who in ("AUTHOR", "COMMITTER"):
            monkeypatch.setenv(f"GIT_{who}_{name.upper()}", "nobody")
    source.git("init", "--quiet")

    def commit():
        source.git("add", "src")
        source.git("commit", "--quiet", "--allow-empty", "--message", "some")
        return source.git("rev-parse", "HEAD")

    return commit


def recorded(out):
    return json.loads((out / "provenance.json").read_text())


def test_runtime_lists_every_job(results, tmp_path):
    record.runtime(results, tmp_path / "runtime.csv")
    table = pd.read_csv(tmp_path / "runtime.csv")
    assert list(table.columns) == ["rule", "wildcards", "wall_s", "cpu_s", "peak_mb"]
    row = table.set_index("rule").loc["train"]
    assert (row.wildcards, row.wall_s, row.cpu_s) == ("dataset3/random-template", 12.5, 72.75)
    assert row.peak_mb == 812.5


BURNER = """#!{python}
import subprocess, sys, time
while time.process_time() < 0.5:
    pass
if len(sys.argv) == 1:
    subprocess.run([sys.executable, __file__, "child"])
"""
ONE_JOB = """include: "{rules}/cpu_time.smk"
rule:
    output: "made"
    log: "logs/burn/all.log"
    benchmark: "benchmarks/burn/all.tsv"
    shell: "psfdae > {{log}} 2>&1; touch {{output}}"
"""


@pytest.mark.workflow
def test_cpu_time_of_a_short_job_is_that_of_all_its_processes(tmp_path):
    """Snakemake samples after 15 s for the first time."""
    program = written(tmp_path / "bin/psfdae", BURNER.format(python=sys.executable))
    program.chmod(0o755)
    written(tmp_path / "Snakefile", ONE_JOB.format(rules=ROOT / "workflow/rules"))
    path = f"{program.parent}{os.pathsep}{PATH}"
    done = captured(["snakemake", "--cores", "1"], cwd=tmp_path, env=environment(PATH=path))
    assert done.returncode == 0, done.stderr
    record.runtime(tmp_path, tmp_path / "runtime.csv")
    (job,) = pd.read_csv(tmp_path / "runtime.csv").itertuples()
    assert 1.0 <= job.cpu_s < 1.3
    assert job.cpu_s <= 1.1 * job.wall_s


@pytest.mark.workflow
def test_every_job_of_a_run_has_its_cpu_time(smoke):
    jobs = pd.read_csv(smoke / "results/runtime.csv")
    assert len(jobs) >= 80
    assert (jobs.cpu_s > 0.1).all()
    assert (jobs.cpu_s < 2.2 * jobs.wall_s + 0.5).all()


def test_reference_keeps_the_layout_and_says_where_it_comes_from(results, history, tmp_path):
    out = tmp_path / "reference"
    written(out / "tables/old.csv", "stale")
    commit = history()
    record.reference(results, out, [plan(results, **{"tables/t.csv": "no update"})])
    assert (out / "tables/t.csv").read_text() == "a\n1\n"
    assert not (out / "tables/old.csv").exists()
    assert not (out / "data").exists()
    provenance = recorded(out)
    assert provenance["commit"] == commit
    assert provenance["kept"] == {}
    assert provenance["peak_mb"] == 812.5
    assert provenance["cpu_s"] == pytest.approx(133.4)
    assert provenance["wall_s"] >= 12.5
    assert provenance["matrix_product_gflops"] > 0
    assert provenance["versions"]["torch"].startswith("2.")


SLOW = "tables/benchmark_training.csv"


@pytest.mark.parametrize("pending", [{SLOW: "update pending"}, {}])
def test_record_keeps_what_takes_long_and_says_since_when(results, history, tmp_path, pending):
    out, first = tmp_path / "reference", history()
    written(results / SLOW, "b\n2\n")
    record.reference(results, out, [plan(results, **{SLOW: "no update"})])
    assert recorded(out)["kept"] == {}
    day = recorded(out)["date"]
    written(results / SLOW, "b\n3\n")
    for _ in range(2):
        commit = history()
        record.reference(results, out, [plan(results, **pending)])
        assert (out / SLOW).read_text() == "b\n2\n"
        assert recorded(out)["kept"] == {SLOW: {"commit": first, "date": day}}
        assert recorded(out)["commit"] == commit != first


def test_files_of_another_commit_are_refused(results, history, tmp_path):
    out, _ = tmp_path / "reference", history()
    written(out / "tables/t.csv", "before")
    with pytest.raises(ProductError, match=r"tables/t\.csv: missing, or not what this commit"):
        record.reference(results, out, [plan(results, **{"tables/t.csv": "update pending"})])
    assert (out / "tables/t.csv").read_text() == "before"


@pytest.mark.parametrize("where", ["src/psfdae/a.py", "workflow/new.smk", "config/b.yaml"])
def test_changes_that_are_not_committed_are_refused(results, history, tmp_path, where):
    history()
    written(tmp_path / where, "new = 1\n")
    with pytest.raises(ProductError, match="differs from commit"):
        record.reference(results, tmp_path / "reference", [plan(results)])
    assert not (tmp_path / "reference").exists()


def test_what_is_kept_is_of_a_commit_in_the_history(results, history, tmp_path):
    out, kept = tmp_path / "reference", {}
    history()
    source.git("checkout", "--quiet", "-b", "side")
    kept[SLOW] = {"commit": history(), "date": "2026-01-01"}
    source.git("checkout", "--quiet", "-")
    written(out / SLOW, "b\n")
    written(out / "provenance.json", json.dumps({"kept": kept}))
    for commit in (kept[SLOW]["commit"], "f" * 40):
        kept[SLOW]["commit"] = commit
        with pytest.raises(ProductError, match=r"benchmark_training\.csv: .* not in the history"):
            record.reference(results, out, [plan(results)])


def test_a_plan_of_something_else_is_no_record(results, history, tmp_path):
    history()
    other = written(tmp_path / "other.tsv", "output_file\tplan\n")
    with pytest.raises(ProductError, match=r"runtime\.csv"):
        record.reference(results, tmp_path / "reference", [other])


TOY = """rule reference:
    input: "results/runtime.csv", "results/tables/a.csv"
rule:
    output: "results/{name}"
    wildcard_constraints: name="(runtime|.*a).csv"
    params: source=HASH
    shell: "echo {params.source} > {output}"
"""


@pytest.mark.slow
@pytest.mark.workflow
def test_make_reference_refuses_a_run_of_two_commits(history, tmp_path):
    """With Snakemake's own word for it, in a workflow of three files."""
    for folder in ("config", "src"):
        shutil.copytree(ROOT / folder, tmp_path / folder, dirs_exist_ok=True)
    line = ["sh", str(ROOT / "workflow/reference.sh")]
    options = {"cwd": tmp_path, "env": environment(PYTHONPATH=str(tmp_path / "src"))}

    def renewed(code, *made):
        written(tmp_path / "Snakefile", TOY.replace("HASH", code))
        source.git("add", "config", "Snakefile")
        commit = history()
        for target in made:
            done = captured(["snakemake", "--cores", "1", target], **options)
            assert done.returncode == 0, done.stderr
        return commit, captured(line, **options)

    first, done = renewed("1", "reference")
    assert done.returncode == 0, done.stderr
    assert recorded(tmp_path / "results/reference")["commit"] == first
    _, done = renewed("2", "results/runtime.csv")
    assert (done.returncode, done.stderr.count("results/tables/a.csv: missing, or")) == (2, 1)
    second, done = renewed("2", "reference")
    assert done.returncode == 0, done.stderr
    found = recorded(tmp_path / "results/reference")
    assert found["commit"] == second
    assert found["kept"] == {}


def test_targets_on_request_are_not_part_of_the_run(results):
    for name in ("stability/stability.tsv", "sweep/dae_width/one.tsv"):
        written(results / record.ON_REQUEST / name, "s\n100.0\n")
    described = record.provenance(results, load())
    assert described["on_request_s"] == {"stability": 100.0}
    assert described["wall_s"] < 20


def test_record_is_of_commits_in_the_history():
    found = recorded(REFERENCE)
    commits = {found["commit"], *(of["commit"] for of in found["kept"].values())}
    commits |= {*pd.read_csv(ROOT / "studies/real_sky/table.csv").commit}
    if (
        source.git_commit() == "unknown"
        or source.git("rev-parse", "--is-shallow-repository") == "true"
    ):
        pytest.skip("no history")
    for commit in commits:
        source.git("merge-base", "--is-ancestor", commit, "HEAD")


def test_run_of_record_reaches_the_numbers_that_it_must():
    """Bounds of dataset 3, 5 and 8 and the order of the methods, on the committed run."""
    metrics = pd.read_csv(REFERENCE / "tables/psf_metrics.csv")
    errors = metrics[metrics.metric == "mse"].pivot(
        index=["dataset", "split", "reference", "noise_level"], columns="method", values="value"
    )
    assert len(errors) == 4 * 19
    assert (errors.dae < errors.pca_som).all()
    bounds = {
        ("dataset3", "realisation"): [3.0e-6, 5.2e-6, 8.6e-6, 1.75e-5],
        ("dataset3", "template"): [1.5e-5, 1.8e-5, 2.2e-5, 3.1e-5],
        ("dataset5", "realisation"): [1.35e-6, 1.9e-6, 2.6e-6, 3.4e-6],
    }
    for (dataset, reference), bound in bounds.items():
        assert (errors.loc[dataset, "random", reference].dae <= bound).all()
    third = errors.loc["dataset3", "random"]
    assert (third.dae < third.lmmse).all()
    assert errors.loc["dataset8", "random", "realisation", 0.005].dae <= 7e-6
    held_out = errors.xs("held_out", level="split")
    loud = held_out[held_out.index.get_level_values("noise_level") >= 3e-4]
    assert (loud.dae < loud.noisy).all()


def test_original_noise_of_the_run_of_record():
    columns = pd.read_csv(REFERENCE / "calibration/columns.csv")
    assert (abs(columns.mse_ratio - 1) < 0.12).sum() >= 11
    assert (abs(columns.ssim_at_published_mse - columns.ssim_paper) < 0.03).sum() >= 11


def test_no_method_beats_a_bound():
    efficiency = pd.read_csv(REFERENCE / "tables/psf_efficiency.csv")
    judged = efficiency.verdict.dropna()
    assert len(judged) > 150
    assert (judged == "ok").all()
    bounds = pd.read_csv(REFERENCE / "tables/psf_bounds.csv")
    rows = bounds[(bounds.method == "bayes") & (bounds.metric == "mse")]
    third = rows[(rows.dataset == "dataset3") & (rows.noise_level >= 0.003)]
    assert len(third) == 4
    assert (third.tight == "yes").all()
    assert (rows[rows.dataset.isin(["dataset7", "dataset8"])].tight == "yes").all()


def test_every_stress_test_passes():
    table = pd.read_csv(REFERENCE / "tables/stability.csv")
    assert list(table.columns) == ["case", "quantity", "expected", "measured", "verdict"]
    assert len(table) > 250
    assert (table.verdict == "pass").all()


def test_training_in_use_is_the_knee():
    training = pd.read_csv(REFERENCE / "tables/benchmark_training.csv")
    assert (training[training.used == "yes"].knee == "yes").all()


def test_simulation_and_inference_stream():
    scaling = pd.read_csv(REFERENCE / "tables/benchmark_scaling.csv")
    measured = scaling[(scaling.against == "stars") & (scaling.measured == "yes")]
    for what, rows in measured.groupby("what"):
        peak = rows.set_index("stars").peak_mb
        assert peak[100_000] <= 1.5 * peak[10_000], what


def test_alignment_of_the_run_of_record():
    errors = pd.read_csv(REFERENCE / "tables/alignment_errors.csv")
    errors = errors[(errors.unit == "range") & (errors.test_set == "uniform")]
    table = errors.pivot(
        index="method", columns=["noise_level", "parameter"], values="mean_abs_error"
    )
    noisy = table[[0.002, 0.005]]
    assert (noisy.loc["dae"] < noisy.loc["original"]).all()
    mean = noisy.T.groupby(level="noise_level").mean().T
    learned = mean.loc[["original", "dae", "noise_trained", "dae_retrained"]].min()
    assert learned[0.002] <= 0.027
    assert learned[0.005] <= 0.06
    ratio = mean.loc["max_likelihood"] / mean.loc["cramer_rao"]
    assert 0.9 <= ratio[0.002] <= 1.15
