"""What rules ask the package: the run of a command line, files of jobs, and their parameters."""

from __future__ import annotations

import re
from types import SimpleNamespace

import pytest

from psfdae.base.files import write_text
from psfdae_paper.configuration.experiment import list_experiments, load_experiment
from psfdae_paper.source import git_commit
from psfdae_paper.workflow import alignment, datasets, fits, night, report, run, sweeps
from psfdae_paper.workflow.run import (
    as_options,
    close_target,
    read_run,
    record_run,
    require_own_package,
    require_same_run,
)
from workflow_runs import ROOT

RUN = read_run({"preset": "smoke", "results": "out"})


def wildcards(**names):
    """Wildcards of a job, which Snakemake also gives by `get`."""
    return SimpleNamespace(**names, get=names.get, keys=names.keys)


# The run of a command line


@pytest.mark.parametrize(
    ("words", "folder"),
    [({}, "results"), ({"preset": "paper"}, "results/paper"), ({"results": "a/b"}, "a/b")],
)
def test_results_have_the_folder_of_the_preset_or_of_the_command_line(words, folder):
    assert read_run(words).results == folder


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"presett": "fast"}, "--config presett: there are preset,"),
        ({"preset": "a/b"}, "preset = 'a/b'"),
        ({"results": "$(touch x)"}, "results = "),
        ({"results": "--force"}, "results = "),
        ({"set": "train.lr='2e-3"}, "No closing quotation"),
    ],
)
def test_a_wrong_word_ends_in_one_line(words, message):
    with pytest.raises(SystemExit) as stop:
        read_run(words)
    assert str(stop.value).startswith("psfdae: ")
    assert message in str(stop.value)


def test_a_finished_run_gives_preset_and_overrides_that_the_command_line_lacks(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    record_run(read_run({"preset": "smoke", "set": "seed=3 noise.levels='[1e-3, 2e-3]'"}))
    again = read_run({"results": "results/smoke"})
    assert again.overrides == ("preset=smoke", "seed=3", "noise.levels=[1e-3, 2e-3]")
    assert read_run({"results": "results/smoke", "set": "seed=4"}).overrides[1:] == ("seed=4",)
    # A night and a sweep have folders of their own, and leave the record alone.
    record_run(read_run({"preset": "smoke", "sweep": "gmm"}))
    assert read_run({"results": "results/smoke"}).overrides[1] == "seed=3"


def test_the_report_says_which_run_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = read_run({"preset": "smoke", "set": "seed=3"})
    assert report.describe_run(run)["commit"].startswith("not recorded")
    record_run(run)
    told = report.describe_run(run)
    assert (told["preset"], told["overrides"]) == ("smoke", "seed=3")
    assert told["commit"] == git_commit() and "cores" in told["machine"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC", told["date"])


@pytest.mark.parametrize(
    ("words", "data", "training"),
    [
        ({"preset": "paper"}, [], []),
        ({"preset": "fast"}, [], ["train.epochs = 8 instead of 100"]),
        ({"preset": "smoke"}, ["parts.train_stars = 192 instead of 6724"], ["dae.init = "]),
        ({"preset": "paper", "set": "noise.kappa=5"}, ["noise.kappa = 5.0 instead of 4.98"], []),
        ({"preset": "paper", "set": "train.threads=2"}, [], ["train.threads = 2 instead of 1"]),
    ],
)
def test_differences_from_the_paper_are_named(words, data, training):
    run = read_run(words)
    differences = report.find_differences(run, "dataset3")
    for expected, texts in ((data, differences["data"]), (training, differences["training"])):
        assert bool(texts) == bool(expected)
        assert all(any(text.startswith(start) for text in texts) for start in expected)
    # Values are as in YAML, and no word stands for a key that the paper lacks.
    all_texts = "\n".join(text for texts in differences.values() for text in texts)
    assert not re.search(r"\bNone\b|instead of none|True|False", all_texts)
    line = report.describe_differences(run, "dataset3")
    assert ("ot the paper's data" in line) == bool(data)
    assert ("ot the paper's training" in line) == bool(training)
    warnings = [text for text in report.list_warnings(run) if "dataset3" in text.partition(":")[0]]
    assert [text.partition(": ")[2] for text in warnings] == ([line] if data or training else [])


@pytest.mark.parametrize("name", list_experiments())
def test_a_variant_differs_from_the_paper_by_its_setting(name):
    """A variant is compared with the paper's settings of its dataset."""
    experiment = load_experiment(name)
    run = read_run({"name": name})
    variants = [v for v in run.variants if v.dataset == experiment.datasets[0]]
    for variant in [v for v in variants if v.seed == experiment.seeds[-1]]:
        line = report.describe_differences(run, variant.name)
        texts = [*report.find_differences(run, variant.name)["data"]]
        keys = [*(experiment.settings[variant.setting] or {}), "seed"]
        assert {*keys} <= {text.partition(" = ")[0] for text in texts}
        assert line.startswith("Not the paper's data: ")
        # The differences by the preset, which the dataset has as well, are among them.
        base = report.find_differences(run, variant.dataset)
        assert {*base["data"]} <= {*texts}


def test_another_run_stops_in_a_folder_that_nobody_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_text(tmp_path / "results/run.yaml", "preset: fast\nset: framing.stamp_px=6\n")
    with pytest.raises(SystemExit, match=r"with framing.stamp_px=6 and without seed=3; name a"):
        require_same_run(read_run({"set": "seed=3"}))
    for words in (
        {"set": "framing.stamp_px=6"},
        {"set": "seed=3", "results": "results"},
        {"set": "seed=3", "sweep": "gmm"},
    ):
        require_same_run(read_run(words))


def test_rules_of_another_clone_than_the_package_stop(tmp_path):
    (tmp_path / "workflow").mkdir()
    require_own_package(ROOT / "workflow")
    with pytest.raises(SystemExit, match=r"^psfdae: rules of .*, but the package of .*make env"):
        require_own_package(tmp_path / "workflow")


def test_a_mistyped_target_is_answered_with_the_closest_one():
    targets = ["dataset3", "benchmark", "all"]
    assert close_target(["-n", "datset3"], targets).endswith("did you mean dataset3?")
    assert close_target(["benchmark", "--rerun-triggers", "mtime"], targets) == ""


# Files and parameters of jobs


def test_inputs_become_options_and_weights_the_folder_of_their_network():
    inputs = {
        "stars": "data/stars.h5",
        "dae": "alignment/dae/dae.safetensors",
        "bundle": ["a.psf.safetensors", "b.psf.safetensors"],
        "own_field": [],
    }
    expected = ["--stars=data/stars.h5", "--dae=alignment/dae"]
    expected += ["--bundle=a.psf.safetensors", "--bundle=b.psf.safetensors"]
    assert as_options(None, inputs) == expected


def test_only_a_fit_to_templates_starts_from_that_to_the_realisations():
    start = fits.start_files(RUN, "dae")
    key = {"dataset": "dataset3", "split": "random"}
    realisations = fits.fit_outputs(RUN, "dae", *key.values(), "realisation")
    assert start(wildcards(**key, reference="template")) == {"start": realisations}
    assert start(wildcards(**key, reference="realisation")) == {}
    assert fits.start_files(RUN, "gmm")(wildcards(**key, reference="template")) == {}


def test_files_of_a_fit_are_below_the_results_with_the_rule_s_wildcards():
    folder = "out/dae/{dataset}/{split}-{reference}"
    assert f"{folder}/dae.safetensors" in fits.fit_outputs(RUN, "dae")
    assert "out/pca_som/dataset3/random.h5" in fits.fit_outputs(
        RUN, "pca_som", "dataset3", "random", "template"
    )
    params = fits.fit_params(RUN, "pca_som")
    assert params["path"] == "out/pca_som/{dataset}/{split}.h5"
    assert params["more"](wildcards(dataset="dataset3", split="random"), {}) == []


def test_levels_that_a_band_lacks_are_not_shown():
    assert datasets.shown_levels(RUN, "dataset3") == [0.001, 0.003]
    other = read_run({"set": "noise.levels=[0.002,0.01]"})
    assert datasets.shown_levels(other, "dataset3") == [0.002, 0.01]


def test_datasets_without_random_aberrations_have_no_curves_of_other_scenes():
    figures = datasets.figures(RUN, "dataset7")
    assert "out/figures/turbulence/templates.png" in figures
    assert "out/figures/dataset7/strip_template.png" not in figures


def test_only_networks_trained_on_its_output_read_the_dae():
    assert alignment.network_dae(RUN, "original") == []
    assert alignment.network_dae(RUN, "dae_retrained") == ["out/alignment/dae/dae.safetensors"]
    levels = alignment.fit_files(RUN, "grid", ending="_times.csv")
    assert levels == [f"out/alignment/fits/grid_{level}_times.csv" for level in ("0.002", "0.005")]


def test_a_trial_waits_for_all_that_can_be_finished_before_it():
    plan = sweeps.sweep_plan(RUN, "dae_adaptive")
    names = list(plan.points)
    for slot, name in enumerate(names):
        known = sweeps.known_results(RUN, wildcards(sweep="dae_adaptive", point=name))
        before = names[: max(0, slot + 1 - plan.sweep.parallel)]
        assert known == [sweeps.result_file(RUN, "dae_adaptive", n) for n in before]


def test_figures_of_pairs_of_axes_need_two_axes():
    for name, count in (("noise_mix", 2), ("som", 4)):
        files = sweeps.sweep_figures(RUN, name)
        assert len(files) == count and all(f"sweeps/{name}/figures/" in file for file in files)


def test_an_unknown_point_or_no_sweep_ends_in_one_line():
    with pytest.raises(SystemExit, match="sweep gmm has no point abc"):
        sweeps.sweep_point(RUN, wildcards(sweep="gmm", point="abc"))
    with pytest.raises(SystemExit, match="which sweep"):
        sweeps.sweep_products(RUN)


def test_images_of_a_night_are_parts_of_ten_whose_rows_name_the_job(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for i in range(12):
        (tmp_path / f"image{i:02}.fits").touch()
    words = {"images": "*.fits", "results": "out"}
    dry = read_run(words, is_dry=lambda: True)
    assert [len(part) for part in night.split_night(dry)] == [10, 2]
    path = night.rows_file(dry, "1")
    assert not (tmp_path / "out").exists()
    assert night.rows_file(read_run(words), "1") == path
    assert "image11.fits" in (tmp_path / path).read_text()
    assert night.image_files(dry, "1") == ["image10.fits", "image11.fits"]


# The rules' files


def rule_files():
    return [ROOT / "Snakefile", ROOT / "workflow/Snakefile", *ROOT.glob("workflow/rules/*.smk")]


def test_rules_have_few_lines_of_python_beside_them():
    """Python is in the package, where it is checked; a block is all that is indented below it."""
    block = re.compile(
        r"^ *(use rule|rule|include:|report:|container:|wildcard_constraints:|on\w+:).*\n"
        r"(?:(?: +.*)?\n)*",
        re.MULTILINE,
    )
    python = 0
    for path in rule_files():
        text = re.sub(r'""".*?"""', "", path.read_text(encoding="utf-8"), flags=re.S)
        lines = block.sub("", text + "\n").splitlines()
        python += sum(bool(line.strip()) and not line.lstrip().startswith("#") for line in lines)
    assert 20 < python <= 80


def test_our_rules_are_found_by_their_names():
    """Names that are computed are left to methods of other packages and to further datasets."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in rule_files())
    written = set(re.findall(r"^rule (\w+):|^use rule \w+ as (\w+) with:", text, re.M))
    names = {name for pair in written for name in pair if name}
    assert len(re.findall(r"^ +rule:", text, re.M)) == 2
    assert not fits.list_new_rules(names)
    assert not datasets.list_datasets_except(names)


def test_rules_made_from_local_rules_are_local():
    """Snakemake inherits all of a rule but `localrule`: a cluster would get a job of seconds."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in rule_files())
    rules = re.compile(
        r"^rule (?P<name>\w+):\n(?P<body>(?:(?: +.*)?\n)*)"
        r"|^use rule (?P<origin>\w+) as (?P<copy>\w+) with:\n(?P<copy_body>(?:(?: +.*)?\n)*)",
        re.MULTILINE,
    )
    origins, local_rules = {}, set()
    for rule in rules.finditer(text):
        name = rule["name"] or rule["copy"]
        origins[name] = rule["origin"]
        if "    localrule: True\n" in (rule["body"] or rule["copy_body"]):
            local_rules.add(name)
    assert {origin for origin in origins.values() if origin} <= origins.keys()
    copies = [name for name, origin in origins.items() if origin in local_rules]
    assert len(copies) > 3 and [name for name in copies if name not in local_rules] == []


@pytest.mark.parametrize("prefix", ["", "psfdae_"])
def test_rules_of_a_module_are_known_by_their_own_names(prefix):
    """A dataset called as the end of another rule has no rule yet."""
    names = ["stars", *(f"{prefix}{name}" for name in ("baseline", "figure_errors", "dataset1"))]
    own_rules = run.remove_module_name(names, "dataset1")
    assert {"baseline", "figure_errors", "dataset1"} <= own_rules and "errors" not in own_rules
    assert "dataset1" not in datasets.list_datasets_except(names)
    assert "dataset2" in datasets.list_datasets_except(names)
    assert "baseline" not in fits.list_new_rules(names)
