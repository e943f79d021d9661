"""A night of a telescope: the simulated example, and the tables and pages made of many images."""

import csv
import itertools
import os
import signal
import subprocess
import time
from contextlib import suppress
from html import escape
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from astropy.io import fits
from astropy.table import Table

from psfdae import api
from psfdae.base.files import write_csv, write_text
from psfdae.base.reading import read_table
from psfdae_paper.evaluation.night import LIMITS, add_verdicts, night_page, read_night
from psfdae_paper.stages import night as night_stage
from psfdae_paper.stages.night import (
    TABLE_COLUMNS,
    NightError,
    bright_stars,
    fit_telescope,
    list_images,
    night_count,
    night_images,
    night_table,
    write_night_page,
)
from psfdae_paper.stages.simulate import example_night
from psfdae_paper.stars.nights import PLACES
from psfdae_paper.tracking import read_night_runs
from workflow_runs import QUIET, captured, copy_of_sources, environment


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Twelve exposures of a night, bad ones among them."""
    out = tmp_path_factory.mktemp("night")
    example_night(out, seed=3, exposures=12)
    return out


@pytest.fixture(scope="module")
def truth(folder):
    """Defects of the exposures, and their true shapes."""
    return read_table(folder / "truth.csv", "image", "fault", "true_fwhm_px_centre")


@pytest.fixture(scope="module")
def similar_exposures(truth):
    """The two good exposures whose PSFs have most nearly the same sizes."""
    intact = truth[truth.fault.isna()]
    sizes = np.log(intact.filter(like="true_fwhm_px"))
    # Least over all pairs of the largest difference at any place.
    pairs = map(list, combinations(intact.index, 2))
    return intact.loc[min(pairs, key=lambda pair: np.ptp(sizes.loc[pair], axis=0).max())]


@pytest.fixture(scope="module")
def rows(folder, truth, similar_exposures):
    """A list of good and bad images of two cameras, one twice, one that is missing."""
    bad = truth[truth.fault.isin(["no stars", "truncated file"])]
    first_image, second_image = similar_exposures.image
    other = folder / "other" / Path(first_image).name
    other.parent.mkdir()
    with fits.open(second_image) as hdus:
        hdus[0].header["INSTRUME"] = "other camera"
        hdus.writeto(other)
    listed = pd.concat([similar_exposures, bad]).assign(observer="Anna", time="dusk")
    further = [{"image": path} for path in (first_image, other, folder / "none.fits")]
    path, out = folder / "list.csv", folder / "rows.csv"
    pd.concat([listed, pd.DataFrame(further)]).to_csv(path, index=False)
    pd.DataFrame(list_images(str(path))).to_csv(out, index=False)
    return out


@pytest.fixture(scope="module")
def night(rows, folder):
    """The table of the night: three models, which take 40 s."""
    night_images(rows, folder / "images", folder / "part.csv")
    night_table((folder / "part.csv",), folder / "night.csv")
    return read_table(folder / "night.csv", "name", "verdict", "reason").set_index("name")


def test_same_seed_gives_the_same_night(folder, tmp_path):
    example_night(tmp_path, seed=3, exposures=12)
    for path in sorted(tmp_path.glob("*.fits")):
        assert (folder / path.name).read_bytes() == path.read_bytes()


def test_truth_of_a_night_names_what_is_wrong(truth):
    """The seeing grows with the airmass, and each of five faults is that of one image."""
    faults = ["clouds", "clouds", "no stars", "trailed", "truncated file"]
    assert sorted(truth.fault.dropna()) == faults
    # The aberrations of the example grow towards the corners.
    assert (truth.true_fwhm_px_lower_left > truth.true_fwhm_px_centre).all()
    headers = [fits.getheader(path) for path in truth[truth.fault.isna()].image]
    assert np.ptp([header["AIRMASS"] for header in headers]) > 0.3
    assert len({header["DATE-OBS"] for header in headers}) == len(headers)


def test_what_cannot_be_used_is_a_row_with_its_reason(truth, tmp_path):
    by_fault = truth.set_index("fault").image
    images = [by_fault["no stars"], by_fault["truncated file"], by_fault["no stars"], "none.fits"]
    path, part = tmp_path / "list.csv", tmp_path / "part.csv"
    pd.DataFrame({"image": images}).to_csv(path, index=False)
    pd.DataFrame(list_images(str(path))).to_csv(path, index=False)
    night_images(path, tmp_path / "images", part)
    night_table((part,), tmp_path / "night.csv")
    night = read_table(tmp_path / "night.csv", "verdict", "reason")
    assert (night.verdict == "failed").all()
    assert "no star" in night.reason[0] and "truncated" in night.reason[1]
    assert [*night.reason[2:]] == ["listed twice", "no such file"]


@pytest.mark.slow
def test_exposures_of_one_camera_share_a_start(night):
    """An image of another camera is fitted by itself."""
    good = night[night.verdict == "good"]
    assert len(night) == 7 and len(good) == 3
    first, second, other = good.start.astype(object).fillna("")
    assert {first, second} == {"", good.index[0] if not first else good.index[1]}
    assert other == ""


@pytest.mark.slow
def test_columns_of_the_list_are_kept_beside_those_of_the_table(night, truth):
    list_columns = night.loc[night.verdict == "good", ["observer", "time_list"]].iloc[0]
    assert [*list_columns] == ["Anna", "dusk"]
    columns = {"name", *night.columns} - {*truth.columns, *list_columns.index}
    assert columns == TABLE_COLUMNS


@pytest.mark.slow
def test_shapes_are_those_of_the_truth(night):
    """FWHM within 2 % at all places, ellipticity within 0.015, and the zero point of the stars."""
    good = night[night.verdict == "good"].dropna(subset="true_fwhm_px_centre")
    assert len(good) == 2
    for place in PLACES:
        ratio = good[f"fwhm_px_{place}"] / good[f"true_fwhm_px_{place}"]
        assert ratio.to_numpy() == pytest.approx(1.0, abs=0.02)
        ellipticity = good[f"ellipticity_{place}"].to_numpy()
        assert ellipticity == pytest.approx(good[f"true_ellipticity_{place}"].to_numpy(), abs=0.015)
    # A curved field has order 4, so that corners are not too round.
    assert (good.order == 4).all()
    # A count is of magnitude 25 at airmass 1, and 0.15 mag are lost for each airmass more.
    expected = 25.0 - 0.15 * (good.airmass - 1.0)
    assert good.zero_point.to_numpy() == pytest.approx(expected.to_numpy(), abs=0.01)
    assert (good.zero_point_scatter < 0.02).all()


@pytest.mark.slow
def test_files_of_an_image(night, folder):
    """A page for each image, which needs no other file; the night's page links it."""
    images = folder / "images"
    names = {path.name.partition(".")[0] for path in images.iterdir()}
    assert names == {*night.index[night.verdict != "failed"]}
    # A poor image is named in the figures as well.
    table = night.reset_index()
    table.loc[table.index[table.verdict == "good"][0], "verdict"] = "poor"
    table.to_csv(folder / "poor.csv", index=False)
    write_night_page(folder / "poor.csv", images, folder / "night.html")
    page = (folder / "night.html").read_text(encoding="utf-8")
    assert "listed twice" in page and "http" not in page
    for name in names:
        assert f'href="images/{name}.html"' in page and (images / f"{name}.html").is_file()


def table_of(count, **columns):
    """Rows of a quiet night, in which some values are replaced."""
    values = {"fwhm_px_centre": 3.0, "ellipticity_centre": 0.02, "mag_20th": -12.0}
    noise = np.random.default_rng(1).normal(0.0, 0.005, (len(LIMITS), count))
    night = pd.DataFrame({name: values[name] + n for name, n in zip(LIMITS, noise, strict=True)})
    night["reason"] = ""
    for name, (row, value) in columns.items():
        night.loc[row, name] = value
    return night


def test_verdicts_name_what_is_unlike_the_neighbours_in_time():
    night = add_verdicts(
        table_of(40, fwhm_px_centre=(5, 4.5), ellipticity_centre=(12, 0.5), mag_20th=(30, -9.0))
    )
    poor = night[night.verdict == "poor"].reason
    assert [*poor.index] == [5, 12, 30]
    assert "4.50 px" in poor[5] and "trailed" in poor[12] and "3.0 mag" in poor[30]


def test_a_slow_change_of_the_focus_makes_no_image_poor():
    night = table_of(40)
    night["fwhm_px_centre"] += np.linspace(0.0, 4.0, 40)
    assert (add_verdicts(night).verdict == "good").all()


def test_a_night_without_any_model_is_refused(tmp_path, capsys):
    """It has a table and a page nevertheless, which say why."""
    night = add_verdicts(pd.DataFrame({"image": ["a.fits"], "name": ["a"], "reason": ["empty"]}))
    assert [*night.verdict] == ["failed"]
    assert "empty" in night_page(night, {}, "images")
    night.to_csv(tmp_path / "night.csv")
    with pytest.raises(NightError, match="0 good, 0 poor, 1 failed"):
        night_count(tmp_path / "night.csv")


@pytest.mark.parametrize(
    ("text", "message"), [("*.fits", "no image"), ("list.csv", "'image' is missing")]
)
def test_list_without_images_is_refused(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "list.csv").write_text("file\na.fits\n")
    with pytest.raises(Exception, match=message):
        list_images(text)


def test_images_of_one_name_have_files_of_different_names(tmp_path):
    (tmp_path / "list.csv").write_text("image\na/x.fits\nb/x.fits\nx_2.fits\na/x.fits\n")
    rows = list_images(str(tmp_path / "list.csv"))
    assert [row["name"] for row in rows] == ["x", "x_2", "x_2_2", "x_3"]
    assert [row["reason"] for row in rows] == ["", "", "", "listed twice"]


def test_wrong_statement_is_the_reason(tmp_path):
    """A cell that is no value of its column names the column."""
    rows = tmp_path / "rows.csv"
    rows.write_text("image,gain,name,reason\na.fits,much,a,\n")
    night_images(rows, tmp_path / "images", tmp_path / "part.csv")
    assert "gain = much" in read_table(tmp_path / "part.csv", "reason").reason[0]


def test_a_wrong_telescope_makes_no_image_bad(folder, similar_exposures, tmp_path):
    """The page says why the state of the telescope is not known, and draws it where it is."""
    coarse_camera, text = tmp_path / "coarse.yaml", (folder / "telescope.yaml").read_text()
    coarse_camera.write_text(text.replace("pixel_scale_arcsec: 1.2", "pixel_scale_arcsec: 2.4"))
    stars = bright_stars({"image": similar_exposures.image.iloc[0]})
    rows = [fit_telescope(stars, path) for path in (coarse_camera, tmp_path / "none.yaml")]
    assert "pixels of 1.2 arcsec" in rows[0]["telescope_reason"]
    assert "none.yaml" in rows[1]["telescope_reason"]
    measured = {"telescope_z4_wave": 0.1, "telescope_z4_wave_error": 0.01, "time": ""}
    shapes = {f"{quantity}_{p}": 2.0 for p in PLACES for quantity in ("fwhm_px", "ellipticity")}
    names = {"name": "a", "reason": "", "mag_20th": -9.0, "bright_stars": 9, **shapes}
    night = add_verdicts(pd.DataFrame([{**names, **rows[0]}, {**names, **measured}]))
    page = night_page(night, {}, "images")
    assert page.count("<img") == 1 and "pixels of 1.2 arcsec" in page


NAMES = ["001", "1e5", "NA", "nan", "True", "0x10", "-x", "=2+3", "+1", "@a", "a$b$c", "$", "<b>"]


def test_names_of_images_are_texts_whatever_they_look_like(tmp_path, monkeypatch):
    """Names from the table of a part to the page and the tracked runs; no cell is a formula."""
    shapes = {f"{quantity}_{p}": 2.0 for p in PLACES for quantity in ("fwhm_px", "ellipticity")}
    measurements = {**shapes, "mag_20th": -9.0, "bright_stars": 9, "time": "", "start": "1e5"}
    of_list = {"filter": "NA", "serial": "007", "chip": "1e2", "@note": "=1+1", "celsius": "-3.5"}
    rows = [
        {"image": f"{name}.fits", "name": name, "reason": "", **measurements, **of_list}
        for name in NAMES
    ]
    # Sizes differ, so that the best, the median and the worst image are not the same ones.
    for number, row in enumerate(rows):
        row["fwhm_px_centre"] += 0.01 * (5 * number % len(NAMES))
        row["ellipticity_centre"] -= 0.01
    parts = [tmp_path / "1.csv", tmp_path / "2.csv"]
    write_csv(parts[0], pd.DataFrame(rows[:4]))
    write_csv(parts[1], pd.DataFrame(rows[4:]))
    out = tmp_path / "night/night.csv"
    night_table(tuple(parts), out)
    night = read_night(out)
    assert [*night.name] == NAMES and [*night.image] == [row["image"] for row in rows]
    assert [*Table.read(out.with_suffix(".ecsv"))["name"]] == NAMES
    for column, value in {**of_list, "celsius": -3.5, "start": "1e5", "reason": ""}.items():
        assert (night[column] == value).all(), column
    with out.open(newline="") as file:
        cells = {cell for row in csv.reader(file) for cell in row}
    assert "'=2+3" in cells and "'@note" in cells
    assert {c for c in cells if c.startswith(("=", "+", "-", "@"))} <= {"+1", "-3.5", "-9"}
    # The page opens the models of the best, the median and the worst image by their names.
    opened = []

    def load(path):
        opened.append(path.name.removesuffix(".psf.safetensors"))
        return SimpleNamespace(image_px=(300, 200), draw_on_pixels=lambda _: np.ones((5, 8, 8)))

    monkeypatch.setattr(api, "load_model", load)
    write_night_page(out, tmp_path / "images", tmp_path / "night.html")
    by_size = sorted(rows, key=lambda row: row["fwhm_px_centre"])
    middle = by_size[len(rows) // 2]
    assert opened == [by_size[0]["name"], middle["name"], by_size[-1]["name"]]
    page = (tmp_path / "night.html").read_text()
    assert all(f'{escape(name)}.html">{escape(name)}</a>' in page for name in NAMES)
    for name in NAMES:
        write_text(tmp_path / f"night/images/{name}.psf.safetensors", "")
    assert [run.name for run in read_night_runs(tmp_path)] == NAMES


@pytest.mark.parametrize("name", ["a$b$c", "$x^$", "one $", r"\$\frac$", "$$", "100 %", "_^{"])
def test_names_are_drawn_as_they_are(name):
    """Dollars would be formulae to matplotlib, and wrong ones would end the page."""
    night = table_of(12, fwhm_px_centre=(5, 9.0))
    shapes = {f"{quantity}_{p}": night.fwhm_px_centre for p in PLACES for quantity in ("fwhm_px",)}
    shapes |= {f"ellipticity_{p}": night.ellipticity_centre for p in PLACES}
    night = add_verdicts(night.assign(**shapes, name=name, bright_stars=9, time=""))
    night["telescope_a$_wave"] = night["telescope_a$_wave_error"] = 0.1
    psfs = dict.fromkeys([f"best\n{name}", f"worst\n{name}"], np.ones((5, 8, 8)))
    assert night_page(night, psfs, "images").count("<img") == 3


class FewStars(list):
    """Stars of an image, as far as the stage looks at them."""

    def __init__(self, width_px):
        axis = np.arange(16) - 8
        star = np.exp(-(axis[:, None] ** 2 + axis**2) / (2 * width_px**2))
        super().__init__([star] * 9)
        self.mean_psf, self.source = star / star.sum(), None
        self.settings = SimpleNamespace(framing=SimpleNamespace(stamp_px=16))
        self.observation = SimpleNamespace(instrument={}, shape=(40, 60), header_cards=[])


def test_a_night_killed_between_any_two_files_is_the_same_once_repeated(tmp_path, monkeypatch):
    """Two images, killed before each file is on the disk and before each has its name.

    The next run removes the temporary files that the killed one has left.
    """
    write_csv(
        tmp_path / "rows.csv",
        pd.DataFrame([{"image": f"{name}.fits", "name": name, "reason": ""} for name in "ab"]),
    )
    table = Table({"flux": np.arange(1.0, 31.0), "flags": np.zeros(30, int), "chi2": np.ones(30)})
    page = SimpleNamespace(save=lambda path: write_text(path, "page"))
    model = SimpleNamespace(
        info=SimpleNamespace(adapted=False),
        order=0,
        draw_on_pixels=lambda place: np.stack([FewStars(1.5).mean_psf] * len(place)),
        save=lambda path: write_text(path, "model"),
    )
    monkeypatch.setattr(night_stage, "bright_stars", lambda row: FewStars(1.5))
    monkeypatch.setattr(night_stage, "fit_image", lambda stars, start: model)
    monkeypatch.setattr(night_stage, "validate", lambda model, stars: page)
    photometry = SimpleNamespace(table=table)
    monkeypatch.setattr(night_stage, "measure_all_stars", lambda *a, **kw: photometry)

    def run(out):
        night_images(tmp_path / "rows.csv", out / "images", out / "part.csv")
        night_table((out / "part.csv",), out / "night.csv")

    def products(out):
        return {str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*") if p.is_file()}

    def run_and_kill(out, number):
        """Run in a process that is killed before a call; return whether it was."""
        if (process := os.fork()) == 0:
            calls = itertools.count()

            def before(function):
                def call(*arguments):
                    if next(calls) == number:
                        os.kill(os.getpid(), signal.SIGKILL)
                    return function(*arguments)

                return call

            os.fsync, Path.replace = before(os.fsync), before(Path.replace)
            with suppress(BaseException):
                run(out)
                os._exit(0)
            os._exit(1)
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        assert code in (0, -signal.SIGKILL)
        return code != 0

    run(tmp_path / "whole")
    expected = products(tmp_path / "whole")
    assert len(expected) == 9
    with_temporary_file = 0
    for number in itertools.count():
        out = tmp_path / str(number)
        if not run_and_kill(out, number):
            break
        with_temporary_file += any(name.endswith(".tmp") for name in products(out))
        run(out)
        assert products(out) == expected, number
    # A call for the content of each file, and one for its name.
    assert number == with_temporary_file == 2 * len(expected)


@pytest.mark.slow
@pytest.mark.workflow
def test_killed_and_typed_again_gives_the_same_files(folder, truth, tmp_path):
    """The start of an image depends on the list, not on what was finished before.

    Two jobs of two images; one image of each job tells the state of the telescope, whose focus runs
    away.
    """
    products, images = [], f"{folder}/exposure_00[0-3].fits"
    for is_killed in (False, True):
        place = copy_of_sources(tmp_path / str(is_killed))
        rules = place / "src/psfdae_paper/workflow/night.py"
        text = rules.read_text()
        assert text.count("IMAGES_PER_JOB = 10") == 1
        rules.write_text(text.replace("IMAGES_PER_JOB = 10", "IMAGES_PER_JOB = 2"))
        words = ["snakemake", "night", "--cores", "2", "--config", f"images={images}"]
        words += [f"telescope={folder}/telescope.yaml"]
        options = {
            "cwd": place,
            "env": environment(SOURCE_DATE_EPOCH="0", PYTHONPATH=f"{place}/src"),
        }
        if is_killed:
            run = subprocess.Popen(words, **options, **QUIET)
            while not [*place.glob("results/night/images/*.html")] and run.poll() is None:
                time.sleep(0.2)
            run.send_signal(signal.SIGTERM)
            assert run.wait(900) != 0  # jobs that run go on to their end
        run = captured(words, **options)
        assert run.returncode == 0, run.stdout + run.stderr
        assert "good, " in run.stdout + run.stderr
        files = sorted(p for p in (place / "results/night").rglob("*.*") if p.is_file())
        products.append({str(p.relative_to(place)): p.read_bytes() for p in files})
    assert products[0] == products[1]
    assert (tmp_path / "True/results/mlflow/night.csv").is_file()
    defocus = "telescope_z4.constant_wave"
    states = read_table(place / "results/night/night.csv", "image", defocus).dropna(subset=defocus)
    states = states.merge(truth, on="image")
    assert len(states) == 2
    pull = (states[defocus] - states[f"true_{defocus}"]) / states[f"{defocus}_error"]
    assert np.abs(pull).max() < 4.0
