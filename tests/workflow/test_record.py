"""Run costs and the run of record."""

from __future__ import annotations

import errno
import io
import json
import os
import tarfile
from datetime import date

import pandas as pd
import pytest

from docs_pages import ROOT
from psfdae.base.files import ProductError
from psfdae_paper import source
from psfdae_paper.stages import record
from psfdae_paper.stages.archive import ArchiveError, archive, fetch, manifest

REFERENCE = ROOT / "results/reference"
SLOW = "paper/tables/psf_metrics.csv"
"""A table that takes long: it may stay from the record before."""


def written(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.fixture
def results(tmp_path):
    """A finished run with two jobs, one on request, and one table."""
    folder = tmp_path / "results"
    header = "s\th:m:s\tmax_rss\n"
    for job, seconds, memory in (
        ("benchmarks/train/dataset3/random-template", 12.5, "812.5"),
        ("benchmarks/runtime/all", 0.4, "-"),
        ("benchmarks_on_request/stability/stability", 100.0, "1"),
    ):
        written(folder / f"{job}.tsv", f"{header}{seconds}\t0:00:12\t{memory}\n")
        log = f"said\n0m0.002s 0m0.001s\n0m{seconds:.3f}s 1m0.250s\n"
        written(folder / "logs" / f"{job.partition('/')[2]}.log", log)
    written(folder / "tables/t.csv", "a\n1\n")
    written(folder / "runtime.csv", "rule\n")
    return folder


def plan(results, **status):
    """The words of `snakemake --summary`; files that are not named are up to date."""
    rows = {"runtime.csv": "no update", "data/stars.h5": "update pending"} | status
    lines = [f"{results / name}\t{due}\n" for name, due in rows.items()]
    return written(results.parent / "plan.tsv", "".join(["output_file\tplan\n", *lines]))


@pytest.fixture
def history(tmp_path, monkeypatch):
    """Git in the folder of the test, as if the package lay there; commits what is in it."""
    monkeypatch.setattr(source, "SOURCES", tmp_path / "src")
    # The size of the whole environment takes long to measure; there is none here.
    monkeypatch.setattr(record.sys, "prefix", str(tmp_path))
    written(tmp_path / "src/psfdae/a.py", "")
    for name in ("AUTHOR_NAME", "AUTHOR_EMAIL", "COMMITTER_NAME", "COMMITTER_EMAIL"):
        monkeypatch.setenv(f"GIT_{name}", "nobody")
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
    job = table.set_index("rule").loc["train"].to_list()
    assert job == ["dataset3/random-template", 12.5, 72.75, 812.5]


@pytest.mark.workflow
def test_every_job_of_a_run_has_its_cpu_time(smoke):
    """Snakemake itself samples it after 15 s for the first time."""
    jobs = pd.read_csv(smoke / "results/runtime.csv")
    assert len(jobs) >= 70
    assert jobs.cpu_s.notna().all()


def test_record_holds_the_run_its_commit_and_its_costs(results, history, tmp_path):
    out = tmp_path / "reference"
    written(out / "tables/old.csv", "stale")
    commit = history()
    record.reference(results, out, [plan(results, **{"tables/t.csv": "no update"})])
    files = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert files == {"tables/t.csv", "runtime.csv", "provenance.json"}
    provenance = recorded(out)
    assert (provenance["commit"], provenance["other_runs"]) == (commit, {})
    assert provenance["peak_mb"] == 812.5
    assert provenance["cpu_s"] == pytest.approx(133.4)
    assert provenance["on_request_s"] == {"stability": 100.0}


def test_a_cost_that_a_job_lacks_is_not_recorded(results, history, tmp_path):
    """A sum without it would be too small."""
    written(results / "logs/runtime/all.log", "killed\n")
    history()
    record.reference(results, tmp_path / "reference", [plan(results)])
    assert recorded(tmp_path / "reference")["cpu_s"] is None


def test_record_keeps_tables_that_take_long_with_their_commit(results, history, tmp_path):
    out, first = tmp_path / "reference", history()
    written(results / SLOW, "b\n2\n")
    record.reference(results, out, [plan(results, **{SLOW: "no update"})])
    assert recorded(out)["other_runs"] == {}
    day = recorded(out)["date"]
    written(results / SLOW, "b\n3\n")
    for pending in ({SLOW: "update pending"}, {}):
        commit = history()
        record.reference(results, out, [plan(results, **pending)])
        assert (out / SLOW).read_text() == "b\n2\n"
        assert recorded(out)["other_runs"] == {SLOW: {"commit": first, "date": day}}
        assert recorded(out)["commit"] == commit != first


def test_a_later_run_completes_the_record_of_its_commit(results, history, tmp_path):
    """Files of the record stay with its costs; the new table has the day of its own run."""
    out, later = tmp_path / "reference", tmp_path / "later/results"
    commit = history()
    record.reference(results, out, [plan(results, **{"tables/t.csv": "no update"})])
    before = recorded(out)
    written(later / SLOW, "b\n2\n")
    pending = {"runtime.csv": "update pending", "tables/t.csv": "update pending"}
    record.reference(later, out, [plan(later, **pending, **{SLOW: "no update"})])
    assert (out / SLOW).read_text() == "b\n2\n"
    assert (out / "tables/t.csv").read_text() == "a\n1\n"
    new_run = {"commit": commit, "date": date.today().isoformat(), "cpu": record.cpu_model()}
    assert recorded(out) == before | {"other_runs": {SLOW: new_run}}
    # Of another commit, only tables that take long are added; the costs of images name their own.
    second = history()
    written(later / "tables/t.csv", "a\n2\n")
    written(later / record.IMAGE_COSTS[0], f"image,commit,date\ni,{commit},2026-01-02\n")
    current = {"tables/t.csv": "no update", SLOW: "no update"}
    record.reference(later, out, [plan(later, **pending | current)])
    assert (out / "tables/t.csv").read_text() == "a\n1\n"
    runs = {SLOW: new_run | {"commit": second}}
    runs[record.IMAGE_COSTS[0]] = {"commit": commit, "date": "2026-01-02"}
    assert recorded(out) == before | {"other_runs": runs}


@pytest.mark.parametrize(
    ("file", "status", "refusal"),
    [
        ("results/notes", {"tables/t.csv": "update pending"}, r"tables/t\.csv"),
        ("src/psfdae/a.py", {}, "src/psfdae/a.py: differs from commit"),
        ("workflow/new.smk", {}, "workflow/: differs from commit"),
    ],
)
def test_record_of_another_code_is_refused(results, history, tmp_path, file, status, refusal):
    out = tmp_path / "reference"
    written(out / "tables/t.csv", "before")
    history()
    written(tmp_path / file, "new = 1\n")
    with pytest.raises(ProductError, match=refusal):
        record.reference(results, out, [plan(results, **status)])
    assert (out / "tables/t.csv").read_text() == "before"


def test_record_is_of_commits_in_the_history():
    record = recorded(REFERENCE)
    commits = {record["commit"], *(of["commit"] for of in record["other_runs"].values())}
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
    # A row for each number that may break.
    assert len(table) > 60
    assert (table.verdict == "pass").all()


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


# A run as one file


@pytest.fixture
def archived(results, tmp_path):
    """A finished run with a model, its report and its checksums, and the archive of it."""
    written(results / "run.yaml", "preset: smoke\nset: ''\n")
    written(results / "report.html", "<html></html>\n")
    (results / "dae").mkdir()
    (results / "dae/dae.safetensors").write_bytes(bytes(range(256)) * 40)
    os.utime(results / "tables/t.csv", (1e9, 1e9))
    manifest(results)
    out = tmp_path / "run.tar"
    archive(results, out)
    return out


def files_of(folder):
    return {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}


def test_a_fetched_run_has_the_files_of_the_archived_one(archived, results, tmp_path):
    fetch(archived, tmp_path / "fetched")
    files = files_of(tmp_path / "fetched")
    assert set(files) == {
        *("run.yaml", "runtime.csv", "report.html", "CITATION.cff", "SHA256SUMS"),
        *("tables/t.csv", "dae/dae.safetensors"),
    }
    for name in set(files) - {"CITATION.cff", "SHA256SUMS"}:
        assert files[name].read_bytes() == (results / name).read_bytes()
    assert files["CITATION.cff"].read_bytes() == (ROOT / "CITATION.cff").read_bytes()
    # Snakemake compares times.
    assert files["tables/t.csv"].stat().st_mtime == 1e9
    # The same run gives the same bytes.
    archive(results, tmp_path / "again.tar")
    assert (tmp_path / "again.tar").read_bytes() == archived.read_bytes()
    # Links are archived as the files that they lead to.
    (results / "tables/t.csv").rename(results / "elsewhere.csv")
    (results / "tables/t.csv").symlink_to(results / "elsewhere.csv")
    archive(results, tmp_path / "links.tar")
    assert (tmp_path / "links.tar").read_bytes() == archived.read_bytes()
    # A run that is there stays.
    with pytest.raises(ArchiveError, match="exists; name a folder"):
        fetch(archived, tmp_path / "fetched")


def test_a_flipped_byte_is_named(archived, tmp_path):
    content = bytearray(archived.read_bytes())
    content[content.index(bytes(range(256))) + 7] ^= 1
    archived.write_bytes(content)
    with pytest.raises(ArchiveError, match=r"run\.tar: dae/dae\.safetensors: damaged"):
        fetch(archived, tmp_path / "fetched")
    assert not [*tmp_path.glob("*fetch*")]


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.8, 0.95])
def test_a_truncated_archive_leaves_nothing(archived, tmp_path, share):
    content = archived.read_bytes().rstrip(b"\0")
    archived.write_bytes(content[: int(share * len(content))])
    before = {*tmp_path.iterdir()}
    with pytest.raises(ArchiveError, match=r"run\.tar: "):
        fetch(archived, tmp_path / "fetched")
    assert {*tmp_path.iterdir()} == before


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_machine_errors_are_no_damage(archived, tmp_path, monkeypatch, number):
    def fail(*args, **kwargs):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(tarfile.TarFile, "extract", fail)
    with pytest.raises(ArchiveError, match=os.strerror(number)) as error:
        fetch(archived, tmp_path / "fetched")
    assert "cannot be unpacked" in str(error.value) and "damaged" not in str(error.value)
    assert not [*tmp_path.glob("*fetch*")]


def hostile_member(name, kind=tarfile.REGTYPE, target=""):
    member = tarfile.TarInfo(name)
    member.type, member.linkname = kind, target
    return member


@pytest.mark.parametrize(
    ("member", "message"),
    [
        (hostile_member("/tmp/evil"), "wrong line"),
        (hostile_member("../evil"), "wrong line"),
        (hostile_member("tables/../../evil"), "wrong line"),
        (hostile_member("evil", tarfile.SYMTYPE, "/etc/passwd"), "evil: not a plain file"),
        (hostile_member("evil", tarfile.LNKTYPE, "SHA256SUMS"), "evil: not a plain file"),
        (hostile_member("evil", tarfile.FIFOTYPE), "evil: not a plain file"),
        (hostile_member("tables", tarfile.DIRTYPE), "tables: not a plain file"),
        (hostile_member("SHA256SUMS"), "SHA256SUMS: has no checksum"),
    ],
)
def test_a_hostile_archive_is_rejected(tmp_path, member, message):
    """Every member has its checksum, but the last one of them."""
    digest = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    listed = member.name if member.name != "SHA256SUMS" else "other"
    sums = f"{digest}  {listed}\n".encode()
    with tarfile.open(tmp_path / "run.tar", "w") as tar:
        first = tarfile.TarInfo("SHA256SUMS")
        first.size = len(sums)
        tar.addfile(first, io.BytesIO(sums))
        tar.addfile(member)
    with pytest.raises(ArchiveError, match=message):
        fetch(tmp_path / "run.tar", tmp_path / "fetched")
    assert [path.name for path in tmp_path.iterdir()] == ["run.tar"]


def test_only_a_complete_and_undamaged_run_is_archived(archived, results, tmp_path):
    (results / "dae/dae.safetensors").write_bytes(b"other")
    with pytest.raises(ProductError, match=r"dae\.safetensors: differs from its checksum"):
        archive(results, tmp_path / "other.tar")
    (results / "report.html").unlink()
    with pytest.raises(ProductError, match=r"report\.html: missing"):
        archive(results, tmp_path / "other.tar")
    assert not (tmp_path / "other.tar").exists()
