"""Every column of every output has a truth, and the test of it would notice a wrong column.

A check of a column is a function of its values. It has to hold for the column, and to fail for the
column times 1.2 and over 1.2, with the other sign, and for every other column of the table.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from pandas import DataFrame
from scipy.stats import norm

import known_field as known
from command_line import printed
from image_training import few_draws
from known_wavefronts import SKY, field_of, imaged, sensed, three_terms
from psfdae import StarFlag, load_model
from psfdae.base.files import write_csv
from psfdae.stars.moments import measure_shapes
from psfdae.telescope.field import build_terms
from psfdae.telescope.settings import Prior
from psfdae_paper.evaluation.night import TABLE_COLUMNS, read_night
from psfdae_paper.stages import night
from psfdae_paper.stars.nights import PLACES, measure_places

STAMP, ZERO_POINT = 14, 25.0
WRONG = {"20 % more": 1.2, "20 % less": 1 / 1.2, "of the other sign": -1.0}


def ratio(truth, limit, where=True, spread=0.25):
    """The median of values over the truth is 1 within `limit`; half of them are within `spread`."""

    def check(values):
        values, where_all = np.array(values, float), np.broadcast_to(where, len(values))
        parts = (values / truth)[where_all]
        middle = np.median(parts)
        is_narrow = np.median(np.abs(parts - middle)) < spread
        # A column of equal values is another one, such as the size of a group.
        return abs(middle - 1) < limit and is_narrow and np.ptp(values[where_all]) > 0

    return check


def near(truth, limit, where=True):
    """All values are the truth within `limit`."""

    def check(values):
        off = np.abs(np.array(values, float) - truth)
        return off[np.broadcast_to(where, off.shape)].max() <= limit

    return check


def equal(truth):
    """All values are the truth."""

    def check(values):
        values = np.array(values)
        # FITS has texts as bytes.
        values = values.astype(str) if values.dtype.kind == "S" else values
        return np.array_equal(values, np.array(truth))

    return check


def texts(numbers):
    """Identifiers of a list that a number would change."""
    return np.array([f"{number:05d}" for number in numbers])


def along(truth, where, limit=0.3):
    """Values off by a common offset of at most half a pixel, the rest within `limit`."""

    def check(values):
        off = (np.array(values, float) - truth)[where]
        return abs(np.median(off)) < 0.5 and np.abs(off - np.median(off)).max() < limit

    return check


def wrong_columns(table, checks, alike=()):
    """Columns of a table that are wrong, or whose checks are; none in the best case.

    Parameters
    ----------
    checks : mapping
        Check of each column, by its name; of several words, a column that is 0 by its nature.
    alike : iterable of sets
        Columns that need not be told apart.
    """
    wrong = [f"{name} has no check" for name in table.colnames if name not in checks]
    wrong += [f"{name} is not there" for name in checks if name not in table.colnames]
    for name in set(checks) & set(table.colnames):
        check, values = checks[name], np.array(table[name])
        if not check(values):
            wrong.append(f"{name} is wrong")
        if values.dtype.kind in "fiu" and name not in ZERO:
            changed = {why: values * factor for why, factor in WRONG.items()}
            wrong += [f"{name} may be {why}" for why, v in changed.items() if check(v)]
        others = {n for n in table.colnames if n != name and not any({n, name} <= a for a in alike)}
        for other in others:
            other_values = np.array(table[other])
            comparable = other_values.dtype.kind in "fiu" and values.dtype.kind in "fiu"
            if comparable and name not in ZERO and check(other_values):
                wrong.append(f"{name} may be {other}")
    return sorted(wrong)


CORRELATIONS = {f"corr_{a}_{b}" for a in ("flux", "background") for b in "xy"}
ZERO = {"order", *CORRELATIONS}
"""Columns that are 0 here: the order of a constant field; sums of a PSF times its slope."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An image for training and a model, another image and its list, and the tables of both."""
    out = tmp_path_factory.mktemp("columns")
    for name, stars, seed in (
        ("train", known.stars(11), 1),
        ("image", known.stars(12, 2.9, special=True), 2),
    ):
        counts = known.expose(stars, seed).astype(np.float32)
        is_masked = stars["kind"] == "masked"
        for x, y in stars["x", "y"][is_masked].iterrows():
            counts[int(y) : int(y) + 2, int(x) + 1] = np.nan
        fits.writeto(out / f"{name}.fits", counts, known.header())
        listed = Table({"id": texts(stars["id"]), "x": stars["x0"], "y": stars["y0"]})
        listed.write(out / f"{name}.csv")
        stars.write(out / f"{name}_truth.ecsv")
    words = ("--catalogue", out / "train.csv", "--origin", 0, "--method", "field")
    settings = (f"framing.stamp_px={STAMP}", "field.orders=[0]", "field.modes=10")
    with few_draws():
        printed("train", out / "train.fits", *words, *settings, "--out", out / "model")
    words = (out / "image.fits", "--catalogue", out / "image.csv", "--origin", 0)
    words += ("--model", bundle(out))
    printed("predict", *words, "--out", out / "predict.fits")
    zero_point = ("--zero-point", ZERO_POINT)
    output = printed("photometry", *words, "--out", out / "photometry.fits", *zero_point)
    assert "no magnitudes" not in output
    return out


def bundle(folder):
    return folder / "model/train.psf.safetensors"


@pytest.fixture(scope="module")
def stars(folder):
    return Table.read(folder / "image_truth.ecsv")


@pytest.fixture(scope="module")
def model(folder):
    return load_model(bundle(folder))


@pytest.fixture(scope="module")
def true(folder, stars, model):
    """True values of the stars, and masks of isolated, bright and fainter ones."""
    radius = float(model.wings.radius_px[-1])
    box = 2 * math.ceil(0.8 * known.gaussian_shape()[0]) + 1
    values = known.truth(stars, radius, STAMP, box)
    alone = np.array(stars["kind"] == "alone")
    # Where noise alone makes the errors, and where it is small.
    values["middling"] = alone & (values["snr"] > 40) & (values["snr"] < 250)
    values["bright"] = alone & (values["snr"] > 100)
    values["faint"] = alone & (values["snr"] < 250)
    values["alone"], values["box"] = alone, box
    return values


def bits(stars, mask, by_kind):
    """Some bits of whole numbers: those of the kind of a star, and no others of the mask."""
    truth = np.array([sum(by_kind.get(kind, [])) for kind in stars["kind"]])

    def check(values):
        values = np.array(values)
        return (values == np.rint(values)).all() and ((values.astype(int) & mask) == truth).all()

    return check


def labels(truth):
    """Whole numbers from 1 that are equal where the truth is, and nowhere else."""

    def check(values):
        pairs = {*zip(np.array(values).tolist(), truth, strict=True)}
        names = {value for value, _ in pairs}
        return names == {*range(1, len({*truth}) + 1)} and len(pairs) == len(names)

    return check


EDGES = ("right edge", "left edge", "upper edge", "lower edge")
MASK = sum(
    (StarFlag.TRUNCATED, StarFlag.MASKED, StarFlag.SATURATED, StarFlag.FAINT, StarFlag.NO_FLUX)
) + sum((StarFlag.OFF_CENTRE, StarFlag.BLENDED))
"""Flags that follow from what is special of a star; others say how unlike a star it looks."""


def checks_of_predict(stars, true, model, table):
    fwhm, ellipticity, angle = known.gaussian_shape()
    ra, dec = known.on_sky(np.array(table["x_fit"]), np.array(table["y_fit"]))
    alone, bright, middling = true["alone"], true["bright"], true["middling"]
    # What the documentation says of a total flux and its error, by the flux in the stamp.
    total = np.array(table["flux_total"] / table["flux"])
    wings_error = model.wings.light()[1] * np.array(table["flux"])
    total_error = np.hypot(total * table["flux_error"], wings_error)
    flags = {kind: [StarFlag.TRUNCATED, StarFlag.MASKED] for kind in EDGES}
    flags |= {"masked": [StarFlag.MASKED], "faint": [StarFlag.FAINT]}
    flags |= {"saturated": [StarFlag.SATURATED, StarFlag.MASKED]}
    # Stars far from their place in the list, and those whose neighbour is brighter.
    off_centre = ("lost", "far", "pair too", "group too")
    flags |= {kind: [StarFlag.OFF_CENTRE] for kind in off_centre}
    return {
        "id": equal(texts(stars["id"])),
        "x": near(stars["x0"], 1e-3),
        "y": near(stars["y0"], 1e-3),
        "ra": near(ra, 1e-7, alone),
        "dec": near(dec, 1e-7, alone),
        "flux": ratio(true["stamp"], 0.025, bright, 0.02),
        "flux_error": ratio(true["flux_error_stamp"], 0.1, middling),
        "flux_total": ratio(true["total"], 0.025, bright, 0.02),
        "flux_total_error": ratio(total_error, 0.01, bright, 0.02),
        # Light of wings that is even in the stamp, 20 counts of bright stars, is no sky.
        "background": near(known.SKY, 8, bright),
        "noise": ratio(known.NOISE, 0.08, middling),
        "snr": ratio(true["snr"], 0.1, middling),
        "chi2": ratio(1.0, 0.12, middling),
        "distance": ratio(math.sqrt(model.bundle.info.components), 0.12, true["faint"]),
        "fwhm_px": ratio(fwhm, 0.04, bright, 0.02),
        "ellipticity": ratio(ellipticity, 0.08, bright, 0.05),
        "position_angle_deg": near(angle, 3, bright),
        "x_fit": along(stars["x"], bright),
        "y_fit": along(stars["y"], bright),
        "x_error": ratio(true["x_error_stamp"], 0.12, middling),
        "y_error": ratio(true["y_error_stamp"], 0.12, middling),
        "background_error": ratio(true["background_error_stamp"], 0.1, middling),
        "corr_flux_background": ratio(true["corr_flux_background_stamp"], 0.12, middling),
        "corr_y_x": ratio(true["corr_y_x_stamp"], 0.16, middling),
        **{name: near(0.0, 0.25, bright) for name in CORRELATIONS},
        "shift_x": equal([-2 if kind == "moved" else 0 for kind in stars["kind"]]),
        "shift_y": equal([+2 if kind == "moved" else 0 for kind in stars["kind"]]),
        "flags": bits(stars, MASK, flags),
    }


def test_columns_of_predict(folder, stars, true, model):
    table = Table.read(folder / "predict.fits", hdu="STARS")
    checks = checks_of_predict(stars, true, model, table)
    loose = {"outlier_score", "ratio95", "ratio95_bright"}
    table.remove_columns(loose)
    assert wrong_columns(table, checks, [{"corr_y_x", "ellipticity"}]) == []


def test_columns_that_have_no_formula(folder, true):
    """Quantiles of 16 held-out stars, which `test_bundle_stage` counts; squares of distances."""
    table = Table.read(folder / "predict.fits", hdu="STARS")
    with fits.open(folder / "predict.fits") as file:
        width = np.abs(file["UNCERT"].data)
    assert (width[true["alone"]] > 0).all()
    for name in ("ratio95", "ratio95_bright"):
        assert table[name][true["alone"]].min() > 1.0 and table[name].max() < 12.0
    # Stars at another place than that of the list are unlike all others.
    score = table["outlier_score"]
    assert 5.0 < np.median(score[true["faint"]]) < 25.0
    assert score[table["distance"] > 50].min() > 10 * np.median(score[true["faint"]])


def test_half_widths_hold_the_errors_of_psfs_above_the_ring_around_their_stamps(
    folder, stars, true
):
    """Light of wings in the ring passes for sky, as the page says; with it, errors are larger."""
    table = Table.read(folder / "predict.fits", hdu="STARS")
    with fits.open(folder / "predict.fits") as file:
        psf, half_width = file["PSF"].data, file["UNCERT"].data
    ring = np.ones((STAMP + 16, STAMP + 16), bool)
    ring[8:-8, 8:-8] = False
    parts = []
    for star in np.flatnonzero(true["alone"] & (true["snr"] > 10) & (true["snr"] < 60)):
        shift = table["shift_x"][star], table["shift_y"][star]
        about = known.pixel(stars["x0"][star] + shift[0], stars["y0"][star] + shift[1])
        light = stars["flux"][star] * known.light(*stars["x", "y"][star], about)
        whole = known.middle(light, STAMP)
        even_light = np.median(known.middle(light, STAMP + 16)[ring])
        errors = [np.abs(psf[star] - whole + even) for even in (even_light, 0.0)]
        parts.append([(error < half_width[star]).mean() for error in errors])
    above_ring, whole = np.mean(parts, axis=0)
    assert len(parts) > 10 and 0.6 < above_ring < 0.8 and whole < above_ring - 0.05


def test_columns_of_photometry(folder, stars, true, model):
    table = Table.read(folder / "photometry.fits")
    alone, bright, middling = true["alone"], true["bright"], true["middling"]
    ra, dec = known.on_sky(np.array(table["x"]), np.array(table["y"]))
    noise_error, flux_error = errors_of_photometry(table, true, model)
    flags = {kind: [StarFlag.TRUNCATED] for kind in EDGES}
    flags |= {"masked": [StarFlag.MASKED], "saturated": [StarFlag.SATURATED]}
    flags |= {kind: [StarFlag.OFF_CENTRE] for kind in ("lost", "far", "moved")}
    flags["faint"] = [StarFlag.FAINT]
    flags |= {kind: [StarFlag.BLENDED] for kind in ("pair", "pair too")}
    incomplete = {kind: [1] for kind in (*EDGES, "saturated", "masked")}
    groups = [kind.removesuffix(" too") for kind in stars["kind"]]
    groups = [number if kind == "alone" else kind for number, kind in enumerate(groups)]
    checks = {
        "id": equal(texts(stars["id"])),
        "x": along(stars["x"], bright),
        "y": along(stars["y"], bright),
        "ra": near(ra, 1e-7, alone),
        "dec": near(dec, 1e-7, alone),
        "flux": ratio(true["total"], 0.025, bright, 0.02),
        "flux_error": ratio(flux_error, 0.05, alone, 0.1),
        "flux_model": ratio(true["stamp"], 0.025, bright, 0.02),
        "x_error": ratio(true["x_error_box"], 0.1, middling),
        "y_error": ratio(true["y_error_box"], 0.1, middling),
        "mag": near(ZERO_POINT - 2.5 * np.log10(true["total"]), 0.1, bright),
        "mag_error": ratio(1.0857 * flux_error / true["total"], 0.06, alone, 0.1),
        "group": labels(groups),
        "group_size": equal([groups.count(group) for group in groups]),
        "chi2": ratio(1.0, 0.1, alone),
        "photutils_flags": bits(stars, 1 + 32, {**incomplete, "lost": [32]}),
        "flags": bits(stars, MASK, flags),
    }
    assert wrong_columns(table, checks) == []
    # Errors of bright stars are those of the model, too.
    assert not ratio(noise_error, 0.05, bright, 0.1)(table["flux_error"])


def errors_of_photometry(table, true, model):
    """Errors of the noise, √χ² times as large where the fit is bad; with the model and the wings.

    The wings of the training are those of the same image.
    """
    place = np.stack([table["x"], table["y"]], axis=1)
    excess, total = np.sqrt(np.maximum(table["chi2"], 1)), table["flux"] / table["flux_model"]
    noise_error = np.array(true["flux_error_box"] * excess * total)
    light, light_error = model.wings.light()
    relative_error = np.hypot(model.flux_error(place), light_error / (1.0 + light))
    return noise_error, np.hypot(noise_error, relative_error * table["flux"])


def test_errors_of_photometry_grow_with_chi2(folder, stars, true, model):
    """A gain that is four times too large: χ² is the ratio of the variances, errors are √χ²."""
    out, gain = folder / "gain.fits", 4 * known.GAIN
    words = ("--catalogue", folder / "image.csv", "--origin", 0, "--gain", gain)
    output = printed(
        "photometry", folder / "image.fits", *words, "--model", bundle(folder), "--out", out
    )
    table, bright = Table.read(out), true["bright"]
    assert "mag" not in table.colnames and "no magnitudes: --zero-point" in output
    wrong = known.truth(stars, 30.0, STAMP, true["box"], gain)
    assert np.median(wrong["chi2"][bright]) > 1.8
    assert ratio(wrong["chi2"], 0.15, bright)(table["chi2"])
    excess = np.sqrt(table["chi2"])
    for name in "xy":
        error = wrong[f"{name}_error_box"]
        assert ratio(error * excess, 0.12, bright)(table[f"{name}_error"])
        assert not ratio(error, 0.2, bright)(table[f"{name}_error"])
    _, flux_error = errors_of_photometry(table, wrong, model)
    assert ratio(flux_error, 0.05, bright, 0.1)(table["flux_error"])


def test_a_gain_that_the_pixels_contradict_is_not_used(folder, true):
    """Less noise than the photons of the sky would have; the errors are those of the true gain."""
    path, out = folder / "contradiction.fits", folder / "contradiction_stars.fits"
    with fits.open(folder / "image.fits") as file:
        file[0].header["GAIN"] = known.GAIN / 10
        file.writeto(path)
    words = ("--catalogue", folder / "image.csv", "--origin", 0, "--model", bundle(folder))
    said = printed("photometry", path, *words, "--out", out)
    assert "GAIN" in said and "gain" in said
    table, middling = Table.read(out), true["middling"]
    for name in ("x_error", "y_error"):
        assert ratio(true[f"{name}_box"], 0.15, middling)(table[name])


@pytest.mark.parametrize("suffix", [".fits", ".stdpsf.fits"])
def test_output_of_psf(folder, suffix):
    """Places, y before x in one format; size and angle of each PSF; its light."""
    out, is_grid = folder / f"psf{suffix}", suffix == ".stdpsf.fits"
    places = ("--grid", "3x2") if is_grid else ("--at", "300,50.5", "--at", "40,200")
    printed("psf", bundle(folder), *places, "--out", out)
    with fits.open(out) as file:
        header, cube = file[0].header, file[0].data
    if is_grid:
        # Knots over the places of the training stars, counted from 1.
        listed = Table.read(folder / "train.csv")
        assert (header["NXPSFS"], header["NYPSFS"], len(cube)) == (3, 2, 6)
        for axis, first, last in (("IPSFX", 1, 3), ("JPSFY", 1, 2)):
            column = listed["x" if axis == "IPSFX" else "y"]
            assert header[f"{axis}{first:02d}"] == pytest.approx(column.min() + 1, abs=6)
            assert header[f"{axis}{last:02d}"] == pytest.approx(column.max() + 1, abs=6)
    else:
        text = [header["DET_YX0"], header["DET_YX1"]]
        y_x = [[float(part) for part in place.strip("()").split(",")] for place in text]
        assert y_x == [[50.5, 300.0], [200.0, 40.0]] and header["OVERSAMP"] == 4
    # Values per pixel of the detector, at 4 × 4 points in each.
    assert cube.sum(axis=(1, 2)) == pytest.approx(16.0, rel=0.02)
    fwhm, ellipticity, angle = known.gaussian_shape()
    shapes = measure_shapes(cube)
    # The pixel of the detector is in the size, as in that of a star.
    assert shapes.fwhm_px / 4 == pytest.approx(fwhm, rel=0.05)
    assert shapes.ellipticity == pytest.approx(ellipticity, rel=0.12)
    assert shapes.position_angle_deg == pytest.approx(angle, abs=4.0)


def test_columns_of_the_night(folder, stars, true, model, monkeypatch):
    """The table of one image, whose reference list has a scatter of 0.05 mag."""
    out, bright = folder / "night", true["bright"]
    noise = 0.05 * norm.ppf((np.arange(bright.sum()) + 0.5) / bright.sum())
    noise = np.random.default_rng(3).permutation(noise)
    magnitude = 26.2 - 2.5 * np.log10(true["total"][bright]) + noise
    out.mkdir()
    place = known.on_sky(stars["x"][bright], stars["y"][bright])
    Table([*place, magnitude], names=("ra", "dec", "mag")).write(out / "reference.csv")
    with fits.open(folder / "image.fits") as file:
        file[0].header["DATE-OBS"], file[0].header["AIRMASS"] = "2026-01-15T20:00:00", 1.37
        file.writeto(out / "a.fits")
    # The list is that of the sky, as one list serves all images of a night.
    ra, dec = known.on_sky(stars["x0"], stars["y0"])
    Table([texts(stars["id"]), ra, dec], names=("id", "ra", "dec")).write(out / "stars.csv")
    row = {"image": str(out / "a.fits"), "name": "a", "reason": ""}
    row |= {"reference": str(out / "reference.csv"), "catalogue": str(out / "stars.csv")}
    write_csv(out / "rows.csv", DataFrame([row]))
    monkeypatch.setattr(night, "fit_image", lambda stars, start: model)
    report = SimpleNamespace(save=lambda path: path.write_text(""))
    monkeypatch.setattr(night, "validate", lambda model, stars: report)
    night.night_images(out / "rows.csv", out, out / "part.csv")
    night.night_table((out / "part.csv",), out / "night.csv")
    table = Table.from_pandas(read_night(out / "night.csv"))
    fwhm, ellipticity, _ = known.gaussian_shape()
    has_flag = np.array(Table.read(folder / "photometry.fits")["flags"]) > 0
    checks = {name: equal([text]) for name, text in row.items()}
    checks |= {
        "verdict": equal(["good"]),
        "start": equal([""]),
        "time": equal(["2026-01-15T20:00:00"]),
        "airmass": near(1.37, 1e-6),
        "order": equal([0]),
        "stars": equal([len(stars)]),
        "flagged": equal([has_flag.sum()]),
        # Those alone, and perhaps some of the seven special ones with an S/N over 100.
        "bright_stars": near(bright.sum() + 3, 3),
        "mag_20th": near(-2.5 * np.log10(np.sort(true["total"][~has_flag])[-20]), 0.04),
        "zero_point": near(26.2, 0.03),
        "zero_point_scatter": near(0.052, 0.005),
        "chi2": near(1.0, 0.1),
        **{f"fwhm_px_{place}": near(fwhm, 0.04 * fwhm) for place in PLACES},
        **{f"ellipticity_{place}": near(ellipticity, 0.08 * ellipticity) for place in PLACES},
    }
    assert {*checks} == {*TABLE_COLUMNS, *row}
    shapes = [{name for name in checks if name.startswith(start)} for start in ("fwhm", "ellip")]
    assert wrong_columns(table, checks, shapes) == []


def test_shapes_of_the_night_are_those_of_their_places():
    """Sizes grow with x, and ellipticities with y, in an image that is not square."""
    columns, rows = 400, 200
    row, column = np.indices((24, 24)) - 11.5

    def psf_at(positions):
        major = 2.0 + positions[:, 0] / columns
        minor = major * (1 - 0.5 * positions[:, 1] / rows)
        return np.exp(
            -0.5 * (column / major[:, None, None]) ** 2 - 0.5 * (row / minor[:, None, None]) ** 2
        )

    shapes = measure_places(psf_at, (columns, rows))
    for place, (x, y) in PLACES.items():
        ratio_of_axes = 1 - 0.5 * y
        assert shapes[f"ellipticity_{place}"] == pytest.approx(1 - ratio_of_axes, abs=0.01)
        fwhm = 2.3548 * (2.0 + x) * ratio_of_axes**0.5
        assert shapes[f"fwhm_px_{place}"] == pytest.approx(fwhm, rel=0.01)


# --- Wavefronts


def rms_nm(coefficients):
    """RMS of focus, astigmatism and coma (n, 3), Noll's waves, over an annulus, tilts left out."""
    y, x = np.indices((201, 201)) / 100 - 1
    lit = (np.hypot(x, y) <= 1) & (np.hypot(x, y) >= 0.4)
    x, y = x[lit], y[lit]
    square = x**2 + y**2
    z8 = 8**0.5 * (3 * square - 2) * x
    terms = np.stack([3**0.5 * (2 * square - 1), 6**0.5 * (x**2 - y**2), z8])
    plane = np.stack([np.ones_like(x), x, y])
    terms -= terms @ np.linalg.pinv(plane) @ plane
    return 600 * np.sqrt(((coefficients @ terms) ** 2).mean(axis=-1))


def slopes(function, at, step=1e-4):
    """Central differences of a function at a point, one for each of its numbers."""
    return np.array(
        [(function(at + s) - function(at - s)) / (2 * step) for s in step * np.eye(len(at))]
    )


def test_columns_of_wavefront():
    """Coefficients, places, fluxes; errors by the Fisher matrix; odds of twins by the prior."""
    telescope, rng = three_terms(), np.random.default_rng(4)
    telescope = telescope.model_copy(update={"prior": Prior(waves=0.2)})
    angle = field_of(telescope, 12, rng)
    terms = build_terms(telescope, angle)
    truth = terms.mean + 0.9 * terms.sd * rng.standard_normal((12, 3))
    place = rng.uniform(-0.5, 0.5, (12, 2))  # row, column
    counts, flux = imaged(telescope, angle, truth, place, 300.0, rng)
    table = sensed(counts, telescope, angle).table
    # The twin has focus and astigmatism of the other sign, and the same image: only the prior
    # tells it from the truth. Errors are those of seven numbers with this prior.
    twin = truth * [-1, -1, 1]
    log_prior = [-0.5 * (((c - terms.mean) / terms.sd) ** 2).sum(axis=1) for c in (truth, twin)]
    odds = 1 / (1 + np.exp(log_prior[1] - log_prior[0]))
    error, rms_error = np.empty((12, 7)), np.empty(12)
    for star in range(12):
        one = telescope, angle[[star]]

        def image(numbers, one=one):
            return imaged(*one, numbers[None, :3], numbers[None, 3:], 1.0)[0][0] - SKY

        numbers = np.concatenate([truth[star], place[star]])
        # Of a star of the S/N 1, hence of another flux in each image.
        shape = image(numbers) / image(numbers).sum()
        light = flux[star] * image(numbers) / imaged_flux(one, numbers)
        by_number = slopes(lambda at: image(at) / imaged_flux(one, at), numbers)  # noqa: B023
        design = [*flux[star] * by_number, light / flux[star], np.ones_like(shape)]
        design = np.array(design).reshape(7, -1)
        prior = np.diag([*1 / terms.sd[star] ** 2, 0, 0, 0, 0])
        covariance = np.linalg.inv(design / (light + SKY).ravel() @ design.T + prior)
        error[star] = np.sqrt(np.diag(covariance))
        slope = slopes(rms_nm, truth[star])
        rms_error[star] = np.sqrt(slope @ covariance[:3, :3] @ slope)
    # Rows of the table: stars, and of each the truth or its twin.
    mode = np.array(table["mode"])
    star = np.cumsum(mode == 0) - 1
    coefficients = np.stack([table[name] for name in ("z4", "z6", "z8")], axis=1)
    is_true = np.sign(coefficients[:, 0]) == np.sign(truth[star, 0])
    true_row = np.where(is_true[:, None], truth[star], twin[star])
    error, rms_error = error[star], rms_error[star]
    checks = {
        "id": equal(star),
        "mode": equal(np.where(is_true, odds[star] < 0.5, odds[star] >= 0.5).astype(int)),
        "probability": near(np.where(is_true, odds[star], 1 - odds[star]), 0.1),
        "explained": equal(np.ones(len(table), bool)),
        "chi2": ratio(1.0, 0.08),
        "snr": ratio(300.0, 0.05),
        "x_deg": near(angle[star, 0], 1e-9),
        "y_deg": near(angle[star, 1], 1e-9),
        "rms": ratio(rms_nm(true_row), 0.03),
        "rms_error": ratio(rms_error, 0.12, spread=0.15),
        "x": near(7.5 + place[star, 0], 0.08),
        "y": near(7.5 + place[star, 1], 0.08),
        "flux": ratio(flux[star], 0.03),
        "sky": near(SKY, 12),
    }
    for index, name in enumerate(("z4", "z6", "z8", "x", "y", "flux", "sky")):
        if index < 3:
            checks[name] = near(true_row[:, index], 0.03)
        checks[f"{name}_error"] = ratio(error[:, index], 0.1, spread=0.1)
    assert {*star} == {*range(12)}
    assert wrong_columns(table, checks) == []


def imaged_flux(one, numbers):
    """The flux of a star of the S/N 1."""
    return imaged(*one, numbers[None, :3], numbers[None, 3:], 1.0)[1][0]
