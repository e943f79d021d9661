"""The real DAG: products of a tiny run, jobs that an edit repeats, refusals before any job."""

from __future__ import annotations

import json
import re
from functools import partial

import h5py
import numpy as np
import pandas as pd
import pytest
import yaml
from skimage.metrics import mean_squared_error, structural_similarity

from docs_pages import read
from psfdae.base.files import read_product, write_text
from psfdae.denoise.bundle import read_bundle
from psfdae.methods import method
from psfdae.training.star_sets import noisy_test_images, read_stars, split_stars
from psfdae_paper.configuration.compose import load
from psfdae_paper.configuration.estimators import list_estimators
from psfdae_paper.evaluation.comparison import read_seed_scatter
from workflow_runs import captured, command, copy_of_sources, environment, planned, snakemake

pytestmark = pytest.mark.workflow
nightly = partial(pytest.param, marks=pytest.mark.slow)

COLUMNS = ["dataset", "split", "reference", "method", "noise_level", "metric"]
COLUMNS += ["value", "stderr", "seed_stderr", "n"]


def test_smoke_builds_everything(smoke):
    metrics = pd.read_csv(smoke / "results/tables/psf_metrics.csv")
    assert list(metrics.columns) == COLUMNS
    assert set(metrics.method) == {"noisy", "pca_som", "lmmse", "dae", "gmm", "gmm_position"}
    errors = {"mse", "ssim", "ssim_unit", "ssim_peak"}
    sure = metrics.method.str.startswith("gmm")
    assert set(metrics.metric[~sure]) == errors
    assert set(metrics.metric[sure]) == errors | {"coverage68", "evidence"}
    assert metrics.drop(columns="seed_stderr").notna().all().all()
    fits = zip(metrics.dataset, metrics.reference, metrics.method, strict=True)
    scattered = metrics.metric.isin(errors) & np.array([fit in read_seed_scatter() for fit in fits])
    assert (metrics.seed_stderr.notna() == scattered).all()


def test_original_noise_rows_are_the_noise_that_was_added(smoke):
    metrics = pd.read_csv(smoke / "results/tables/psf_metrics.csv")
    rows = metrics.query("metric == 'mse' and method == 'noisy' and reference == 'realisation'")
    expected = (4.98 * rows.noise_level) ** 2 + 4.98 * rows.noise_level / 100 / 256
    assert (rows.value / expected).to_numpy() == pytest.approx(1, abs=0.05)


def test_errors_of_single_stars_are_scikit_image_s(smoke):
    """Every test star of one column of the tables, its noise drawn again."""
    config = load(["dataset=dataset3", "preset=smoke"])
    stars = read_stars(smoke / "results/data/seidel/seidel_10pct.h5", "realisation")
    test = split_stars(stars, "random", config).test
    truth = stars["realisation"][test].astype(float)
    noisy = noisy_test_images(config, stars, test, 0.003).astype(float)
    table = pd.read_parquet(smoke / "results/evaluation/dataset3/random-realisation.parquet")
    table = table.query("method == 'noisy' and noise_level == 0.003")
    assert table.star.to_list() == test.tolist()
    ranges = {"ssim": config.evaluation.data_range, "ssim_unit": 1.0}
    for image, true_image, row in zip(noisy, truth, table.to_dict("records"), strict=True):
        expected = mean_squared_error(image, true_image)
        assert row["mse"] == pytest.approx(expected, rel=1e-6)
        for metric, data_range in {**ranges, "ssim_peak": np.ptp(true_image)}.items():
            expected = structural_similarity(image, true_image, data_range=data_range)
            assert row[metric] == pytest.approx(expected, abs=1e-6)


def test_figures_show_stars_that_the_tables_measure(smoke):
    """Images of every method whose errors are those of stars in the table, level by level."""
    place = smoke / "results/evaluation/dataset3/random-template"
    shown, table = (
        read_product(place.with_suffix(".h5"), "restored"),
        pd.read_parquet(f"{place}.parquet"),
    )
    for level, images_of_methods in zip(shown["levels"], shown["restored"], strict=True):
        for name, images in zip(shown.config["methods"], images_of_methods, strict=True):
            rows = table[(table.method == name) & np.isclose(table.noise_level, level)]
            errors = np.square(images - shown["truth"].astype(float)).mean(axis=(1, 2))
            assert np.isclose(errors[:, None], rows.mse.to_numpy(), rtol=1e-5).any(axis=1).all()


def test_the_twin_is_nearest_in_focus_as_its_caption_says(smoke):
    twins = pd.read_csv(smoke / "results/tables/alignment_twin.csv").query("position == -1")
    own_defocus_mm = 1e3 * load(["dataset=alignment"]).alignment.defocus_m
    assert twins.noise_level.nunique() > 1
    for _, rows in twins.groupby("noise_level"):
        assert rows.defocus_mm[rows.chi2.idxmin()] == 0
        assert rows.defocus_mm.max() == pytest.approx(2 * own_defocus_mm)
        assert own_defocus_mm in rows.defocus_mm.round(9).to_list()


def test_the_page_of_the_scenes_describes_their_files(smoke):
    """Arrays, their types, units and meanings; the page adds words in brackets."""
    tables = re.split(r"^`(\w+)` \(", read("docs/scenes.md"), flags=re.M)[1:]
    card = {
        (kind, name): (dtype, unit, about.partition(" (in scene")[0])
        for kind, text in zip(tables[::2], tables[1::2], strict=True)
        for name, _, dtype, unit, about in re.findall(
            r"^\| `(\w+)` \| (.+?) \| (\w+) \| (.+?) \| (.+) \|$", text, re.M
        )
    }
    described = {kind for kind, _ in card}
    arrays = set()
    for path in sorted((smoke / "results/data").rglob("*.h5")):
        assert f"{path.parent.name}/{path.name}" in read("docs/scenes.md")
        with h5py.File(path) as file:
            kind = file.attrs["kind"]
            for name, array in file.items() if kind in described else ():
                dtype, unit, about = card[kind, name]
                assert (str(array.dtype), array.attrs["unit"]) == (dtype, unit), (path, name)
                static = {"static PSF, sum 1"} if name == "realisation" else set()
                assert array.attrs["about"] in {about, *static}, (path, name)
                arrays.add((kind, name))
    assert arrays == card.keys()


@pytest.mark.slow
def test_the_report_opens_with_its_main_pictures_and_all_methods(smoke, tmp_path):
    report = tmp_path / "report.html"
    snakemake(smoke, "--report", str(report), "all")
    first = json.loads(re.search(r"var workflow_desc = (\".*\");\n", report.read_text())[1])
    assert len(re.findall(r'<img [^>]*src="data:image/png', first)) == 3
    assert "'results/figures/dataset3/strip_realisation.png'" in first
    words = " ".join(re.sub("<[^>]+>", " ", first).split())
    # Which run it is, and that it is not the paper's, stand before the pictures; the errors of the
    # paper and of the run are side by side.
    screen = words.partition("Wide-field")[0]
    record = yaml.safe_load((smoke / "results/run.yaml").read_text())
    assert f"preset smoke overrides none commit {record['commit']}" in screen
    assert record["date"] in screen and record["machine"] in screen
    for name in ("dataset3", "dataset7", "scene 3"):
        assert f"{name}: Not the paper's data: " in screen
    table = pd.read_csv(smoke / "results/tables/dataset3_mse.csv").set_index("source")
    for source, value in table["0.003"].items():
        assert f"{1e6 * value:.4g}" in words.partition(source)[2]
    for name in ("dataset3", "alignment", "methods"):
        page = (smoke / f"results/pages/{name}.html").read_text()
        assert page.count("<table") >= 2 and "Not the paper&#x27;s data" in page
    config = load(["dataset=dataset7", "preset=smoke"])
    for label in (
        *(method(name).look.label for name in config.methods),
        list_estimators("estimates")[0].look.label,
    ):
        assert label in words


# Jobs that an edit repeats


@pytest.fixture
def tree(tmp_path):
    return copy_of_sources(tmp_path)


@pytest.fixture
def jobs(smoke, tree):
    """Jobs that the smoke run would repeat with a text at the end of a file of the copy."""

    def repeated(path, text, *targets, **options):
        with (tree / path).open("r+") as file:
            assert file.read()
            file.write(text)
        return planned(smoke, *targets, root=tree, **options)

    return repeated


@pytest.mark.slow
def test_another_place_comments_formats_and_checkpoints_repeat_nothing(jobs, tree):
    overrides = ["train.lr=0.0060", "noise.kappa=4.980"]
    for group in ("train", "dae_train", "train_original", "train_dae_retrained"):
        overrides.append(f"{group}.checkpoint_seconds=1.5")
    with (tree / "config/dataset/dataset3.yaml").open("a") as file:
        file.write("# A thought.\n")
    module = "src/psfdae/optics/propagation.py"
    assert jobs(module, "# Another.\n", overrides=" ".join(overrides)) == {}


def test_learning_rate_of_one_dataset_repeats_what_follows_from_it(jobs):
    """Its four trainings and evaluations, its tables and figures, its import; no more."""
    path = "config/dataset/dataset3.yaml"  # ends with train
    assert jobs(path, "  lr: 0.002\n", "dataset3", "dataset7", "tables") == {
        "train": 4,
        "evaluate": 4,
        "paper_tables": 1,
        "psf_metrics": 1,
        "methods_table": 1,
        "held_out": 1,
        "figure_curves": 1,
        "figure_errors": 1,
        "figure_strip": 2,
        "track": 1,
    }


SIMULATED = {"templates": 2, "stars": 2}
FITTED = {"baseline": 3, "train": 5}


@pytest.mark.parametrize(
    ("module", "repeated", "unchanged"),
    [
        ("psfdae/optics/propagation", {**SIMULATED, **FITTED, "evaluate": 5}, {}),
        ("psfdae_paper/evaluation/curves", {"figure_curves": 2}, {**SIMULATED, "evaluate": 5}),
    ],
)
def test_code_repeats_what_is_made_with_it_and_nothing_before(jobs, module, repeated, unchanged):
    plan = jobs(f"src/{module}.py", "\nCHANGED = 1\n", "dataset3", "dataset7")
    assert plan == {**plan, **repeated}
    assert "track" in plan
    assert not unchanged.keys() & plan.keys()


@pytest.mark.slow
def test_keys_of_one_scene_leave_the_others_alone(smoke):
    jobs = planned(smoke, "scene1", "scene2", overrides="wavefront.r0_m=0.15")
    assert (jobs["templates"], jobs["stars"]) == (1, 1)


@pytest.mark.parametrize(
    ("target", "included", "excluded"),
    [
        ("dataset3", "dataset3", "dataset[1245678]|50pct|turbulence"),
        nightly("scene3", "alignment_network", "dataset[1-8]|seidel|turbulence"),
    ],
)
def test_a_target_lists_no_job_of_another(tmp_path, target, included, excluded):
    out = snakemake(tmp_path, "--dry-run", target)
    assert included in out
    assert not re.search(excluded, out)


# A dataset with a scene of its own

DATASET9 = """# @package _global_
defaults:
  - dataset3
  - _self_
dataset: {name: dataset9}
telescope: {diameter_m: 0.8, obscuration: 0.2, pixel_scale_arcsec: 0.14}
wavefront: {coma: 2.5, astigmatism: 3.0}
noise: {law: detector, read_noise_e: 50.0, gain_e: 20.0}
"""


@pytest.mark.slow
def test_a_dataset_with_its_own_telescope_noise_and_aberrations(tree, tmp_path):
    """From the target to its tables; its static PSFs are POPPY's within the budget."""
    write_text(tree / "config/dataset/dataset9.yaml", DATASET9)
    snakemake(tmp_path, "dataset9", "--cores", "1", root=tree)
    results = tmp_path / "results"
    table = pd.read_csv(results / "tables/dataset9_mse.csv")
    assert len(table) >= 3
    (folder,) = (results / "data").iterdir()
    assert re.fullmatch("seidel_[0-9a-f]{8}", folder.name)
    (stars,) = folder.glob("seidel_10pct_*.h5")
    for path, kind in ((folder / "templates.h5", "templates"), (stars, "stars")):
        config = read_product(path, kind).config
        assert config["telescope"]["diameter_m"] == 0.8
        assert config["wavefront"]["coma"] == 2.5
    # Noise of the tables: the noise law's, by the unchanged images.
    metrics = pd.read_csv(results / "evaluation/dataset9/random-realisation.csv")
    noisy = metrics[(metrics.method == "noisy") & (metrics.metric == "mse")]
    # Photons of the star, F = √(B + r² + g²/12) / κλ, are added to (κλ)² for a stamp of sum 1.
    sky = (4.98 * noisy.noise_level) ** 2
    photons = 4.98 * noisy.noise_level / np.sqrt(1e4 + 50.0**2 + 20.0**2 / 12) / 256
    assert (noisy.value / (sky + photons)).to_numpy() == pytest.approx(1, abs=0.05)
    # 1 % of the smallest noise variance of the scene's datasets.
    budget = 0.01 * (4.98 * 3e-5) ** 2
    errors = poppy_errors(read_product(folder / "templates.h5", "templates"))
    assert errors.size == 3 and errors.max() < budget


def poppy_errors(product, samples=512, fine=12):
    """MSE of three static PSFs of sum 1 to POPPY's, whose image is turned by 180°."""
    import astropy.units as u
    import poppy

    telescope, terms = product.config["telescope"], product.config["wavefront"]
    wavelength, side, errors = telescope["wavelength_m"], product["psf"].shape[-1], []
    axis = (np.arange(samples) - (samples - 1) / 2) * 2 / samples
    x, y = np.meshgrid(axis, axis)
    rho = np.hypot(x, y)
    # Transmission of a sample: its part inside the annulus, by its distance from both edges.
    edges = np.array([1.0, telescope["obscuration"]])[:, None, None]
    outer, inner = np.clip((edges - rho) * samples / 2 + 0.5, 0, 1)
    lit = outer - inner
    for field in (0, 7, 12):
        psf, (row, column) = product["psf"][field], product["peak"][field]
        # Seidel's terms at the relative field (h_x, h_y).
        h = np.rad2deg(product["field"][field]) / product.config["grid"]["edge_deg"]
        along, height = x * h[0] + y * h[1], h @ h
        waves = (
            terms["spherical"] * rho**4
            + terms["coma"] * rho**2 * along
            + terms["astigmatism"] * along**2
            + terms["field_curvature"] * height * rho**2
            + terms["distortion"] * height * along
        )
        diameter = telescope["diameter_m"] * u.m
        element = poppy.ArrayOpticalElement(
            transmission=lit,
            opd=waves * wavelength,
            pixelscale=diameter / samples / u.pixel,
        )
        system = poppy.OpticalSystem(npix=samples, oversample=fine, pupil_diameter=diameter)
        system.add_pupil(element)
        half = max(abs(row), abs(column)) + side
        system.add_detector(telescope["pixel_scale_arcsec"], fov_pixels=2 * half, oversample=fine)
        image = system.calc_psf(wavelength=wavelength)[0].data[::-1, ::-1]
        image = image.reshape(2 * half, fine, 2 * half, fine).sum((1, 3))
        first_row, first_column = half + row - side // 2, half + column - side // 2
        stamp = image[first_row : first_row + side, first_column : first_column + side]
        errors.append(np.square(stamp / stamp.sum() - psf / psf.sum()).mean())
    return np.array(errors)


# Refusals


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"overrides": "framing.stamp_px=6"}, "framing.stamp_px = 6"),
        nightly({"overrides": "train.lr='2e-3"}, "set = "),
        # Sizes have to fit together where a dataset is built.
        nightly(
            {"overrides": "stars.count=9000", "preset": "fast"},
            "parts.train_stars + parts.test_stars = 10000",
        ),
    ],
)
def test_wrong_config_stops_before_any_job(tmp_path, options, key):
    out = snakemake(tmp_path, check=False, **options)
    (line,) = [line for line in out.splitlines() if key in line]
    assert line.startswith("psfdae: ")
    assert "Traceback" not in out
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"overrides": "seed=3"}, "run with framing.stamp_px=6 and without seed=3; name a folder"),
        # A folder that is named gives its overrides.
        nightly({"results": "results/smoke"}, "framing.stamp_px = 6"),
    ],
)
def test_a_finished_run_is_replaced_only_where_its_folder_is_named(tmp_path, options, message):
    record = tmp_path / "results/smoke/run.yaml"
    write_text(record, "preset: smoke\nset: framing.stamp_px=6\n")
    target = "results/smoke/data/seidel/templates.h5"
    assert message in snakemake(tmp_path, target, check=False, **{"results": "", **options})
    assert not (record.parent / "data").exists()


@pytest.mark.parametrize(
    "word", ["results=$(touch pwned)", nightly("presett=fast"), nightly("preset=a/b")]
)
def test_an_unknown_or_no_plain_word_is_refused(tmp_path, word):
    """Results and preset become words of a shell."""
    run = captured([*command(tmp_path), word], env=environment())
    assert run.returncode != 0
    assert word.partition("=")[0] in run.stdout + run.stderr
    assert {path.name for path in tmp_path.iterdir()} <= {".snakemake"}


# Whole runs


@pytest.mark.slow
def test_shipped_bundle_is_trained_on_its_stars_and_written_where_it_is_read(tmp_path):
    jobs = planned(tmp_path, "bundles")
    fits = {"train": 2, "fit_gmm": 2, "bundle": 4}
    assert jobs == {"templates": 2, "stars": 2, **fits}
    snakemake(tmp_path, "shipped")
    bundle = read_bundle(tmp_path / "src/psfdae/denoise/bundles/wfsat.psf.safetensors")
    assert (bundle.info.name, bundle.info.subpixel) == ("wfsat", True)
    assert bundle.info.config["train"]["noise"]["name"] == "field"
    assert planned(tmp_path, "shipped") == {}
