"""Star lists as programs and people write them: each gives the same stars, or one line says why."""

from __future__ import annotations

import gzip

import numpy as np
import pandas as pd
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, Table

from command_line import printed
from image_training import few_draws
from psfdae import Error, StarFlag, Stars, fit
from psfdae.image.catalogue import as_catalogue, read_catalogue
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from small_field import CAMERA, TANGENT, field, header, stetson, table, write


@pytest.fixture(scope="module")
def image():
    return field()[0]


@pytest.fixture(scope="module")
def place():
    return field()[1]


@pytest.fixture(scope="module")
def path(tmp_path_factory, image):
    name = tmp_path_factory.mktemp("field") / "image.fits"
    fits.writeto(name, image, header() + TANGENT.to_header())
    return name


def positions(image, catalogue, **stated):
    return open_observation(ImageInput(image, catalogue=catalogue, **stated), 16).positions


# Lists in Python.


def test_pairs_and_masked_positions_are_positions_from_0(image, place):
    np.testing.assert_array_equal(positions(image, place * u.pix), place)
    masked = np.ma.MaskedArray(place, np.arange(len(place))[:, None] == [3, 3])
    masked_xy = positions(image, masked)
    assert np.isnan(masked_xy[3]).all() and np.isfinite(np.delete(masked_xy, 3, axis=0)).all()


def test_sky_coordinates_of_astropy(path, place):
    sky = TANGENT.pixel_to_world(*place.T)
    tables = (
        sky,
        sky.galactic,
        QTable({"ra": sky.ra, "dec": sky.dec.to(u.rad)}),
        Table({"RAJ2000": sky.ra.hourangle * u.hourangle, "DEJ2000": sky.dec.deg}),
    )
    for listed in tables:
        np.testing.assert_allclose(positions(path, listed), place, atol=1e-5)
    for listed in (sky.ra, place * u.deg, [1, 2, 3], [], "no"):
        with pytest.raises(Error):
            positions(path, listed)


def test_columns_with_units(image, place):
    frame = pd.DataFrame({"x": place[:, 0], "y": place[:, 1]})
    np.testing.assert_array_equal(positions(image, frame, origin=0), place)
    with pytest.raises(Error, match="'arcsec', expected pixels"):
        positions(image, QTable({"x_fit": place[:, 0] * u.arcsec, "y_fit": place[:, 1]}))


@pytest.mark.parametrize("missing", [None, np.nan, pd.NA])
@pytest.mark.parametrize("kind", [dict, pd.DataFrame])
def test_none_and_na_objects_are_missing_values(kind, missing):
    columns = {"x": [1.0, 2.0], "y": [3.0, 4.0], "mag": [5.0, missing], "id": ["None", missing]}
    objects = {name: np.array(values, dtype=object) for name, values in columns.items()}
    catalogue = as_catalogue(kind(objects))
    np.testing.assert_array_equal(catalogue.numbers("mag"), [5.0, np.nan])
    assert catalogue.identifiers().tolist() == ["None", ""]


# Files.


def vizier(listed, name):
    """Star list as asu-tsv writes it: comments, names, units, dashes."""
    rows = "\n".join(f"{k}\t{ra:.7f}\t{dec:.7f}" for k, (ra, dec) in enumerate(listed))
    head = "#\n#   VizieR Astronomical Server\n#Column\tRAJ2000\t(F10.6)\tRight ascension\n\n"
    name.write_text(f"{head}\nrecno\tRAJ2000\tDEJ2000\n\tdeg\tdeg\n--------\t---\t----\n{rows}\n")


def daophot(listed, name):
    """A list of IRAF's allstar."""
    lines = ["#K IRAF       = NOAO/IRAFV2.12EXPORT    version    %-23s"]
    lines += ["#", "#N ID    XCENTER   YCENTER   MAG         MERR    \\"]
    lines += ["#U ##    pixels    pixels    magnitudes  magnitudes \\"]
    lines += ["#F %-9d  %-10.3f   %-10.3f   %-12.3f     %-14.3f", "#"]
    lines += [f"{k:<9d}{x:<10.3f}{y:<10.3f}{15.0:<12.3f}{0.01:<14.3f}" for k, x, y in listed]
    name.write_text("\n".join(lines) + "\n")


def regions(listed, name):
    shapes = [f"circle({x:.3f},{y:.3f},5) # text={{{k}}} color=red" for k, x, y in listed]
    shapes[1] = shapes[1].replace("circle", "point").replace(",5)", ")")
    shapes.insert(3, "-circle(100,100,20)")
    head = ["# Region file format: DS9 version 4.1", 'global color=green font="helvetica 10"']
    name.write_text("\n".join([*head, "image", *shapes]) + "\n")


def test_a_votable_has_positions_and_numbers(tmp_path, image, place):
    listed = table(place, 1, ("XWIN_IMAGE", "YWIN_IMAGE"))
    listed["NUMBER"] = np.arange(len(place)) + 100
    listed.write(tmp_path / "s.vot", format="votable")
    observation = open_observation(ImageInput(image, catalogue=tmp_path / "s.vot"), 16)
    np.testing.assert_allclose(observation.positions, place)
    assert next(observation.chunks(100)).id[0] == 100


@pytest.mark.parametrize("form", [daophot, stetson, regions])
def test_lists_that_count_from_1(tmp_path, image, place, form):
    listed = [(k + 5, x + 1, y + 1) for k, (x, y) in enumerate(place)]
    form(listed, tmp_path / "s.als")
    observation = open_observation(ImageInput(image, catalogue=tmp_path / "s.als"), 16)
    np.testing.assert_allclose(observation.positions, place, atol=1e-3)
    assert [int(k) for k in next(observation.chunks(100)).id] == [k for k, _, _ in listed]


def test_regions_on_the_sky(tmp_path, path, place):
    sky = TANGENT.pixel_to_world(*place.T)
    name = tmp_path / "s.reg"
    for words in (
        sky.to_string("decimal", precision=8),
        sky.to_string("hmsdms", sep=":", precision=6),
    ):
        name.write_text("".join(f'fk5;circle({w.replace(" ", ",")},3")\n' for w in words))
        np.testing.assert_allclose(positions(path, name), place, atol=1e-3)
    name.write_text("physical\ncircle(1,2,3)\n")
    with pytest.raises(Error, match="physical"):
        read_catalogue(name)


def test_vizier(tmp_path, path, place):
    sky = TANGENT.pixel_to_world(*place.T)
    vizier(zip(sky.ra.deg, sky.dec.deg, strict=True), tmp_path / "s.tsv")
    np.testing.assert_allclose(positions(path, tmp_path / "s.tsv"), place, atol=2e-3)


# Lists of other programs: the same stars, or a line that names the format.


def siril(place, name):
    """Siril's list: its first comment begins with a number, as SExtractor's do."""
    head = f"# {len(place)} stars found using the following parameters:\n# sigma=1.00 radius=10\n"
    names = '# star#\tlayer\tB\tA\tX\tY\tFWHMx [px]\tFWHMx ["]\tmag\tProfile\n'
    rows = [f"{k}\t0\t0.004\t0.5\t{x:9.3f}\t{y:9.3f}\t3\t3\t-8\tMoffat\n" for k, (x, y) in place]
    name.write_text(head + names + "".join(rows))


def image_j(place, name):
    """AstroImageJ's measurements, whose first name is blank; x and y of the FITS image from 1."""
    rows = [f"{k}\timage.fits\t{x:.3f}\t{y:.3f}\n" for k, (x, y) in place]
    name.write_text(" \tLabel\tX(FITS)\tY(FITS)\n" + "".join(rows))


def columns(x_name, y_name, shift=0.0):
    def write_csv(place, name):
        rows = [f"{k},{x + shift:.3f},{y + shift:.3f}\n" for k, (x, y) in place]
        name.write_text(f"id,{x_name},{y_name}\n" + "".join(rows))

    return write_csv


def parquet(place, name):
    xy = np.array([xy for _, xy in place])
    frame = pd.DataFrame({"id": [f"s{k}" for k, _ in place], "x": xy[:, 0], "y": xy[:, 1]})
    frame.to_parquet(name, index=False)


def in_utf16(place, name):
    columns("x", "y")(place, name)
    name.write_bytes(name.read_text().encode("utf-16"))


def in_gzip(place, name):
    columns("x", "y")(place, name)
    name.write_bytes(gzip.compress(name.read_bytes()))


@pytest.mark.parametrize(
    ("form", "origin"),
    [
        (siril, None),
        (image_j, 1),
        (columns("pixel_centroid_x", "pixel_centroid_y", 1), 1),
        (columns("slot_Centroid_x", "slot_Centroid_y"), 0),
        (columns("base_SdssCentroid_x", "base_SdssCentroid_y"), 0),
        (parquet, None),
        (in_utf16, None),
        (in_gzip, None),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_lists_of_other_programs(tmp_path, image, place, form, origin):
    written = place + 1 if form is image_j else place
    form([*enumerate(written.tolist())], tmp_path / "list")
    assert read_catalogue(tmp_path / "list").positions().origin == origin
    stated = {"origin": 0} if origin is None else {}
    np.testing.assert_allclose(
        positions(image, tmp_path / "list", **stated), place, atol=1e-3, rtol=0
    )


@pytest.mark.parametrize("unit", ["rad", "deg", None, "degrees without a unit"])
def test_sky_coordinates_of_lsst_are_radians_without_a_unit(tmp_path, path, place, unit):
    sky = TANGENT.pixel_to_world(*place.T)
    angles = [angle.rad if unit in ("rad", None) else angle.deg for angle in (sky.ra, sky.dec)]
    units = [unit, unit] if unit in ("rad", "deg") else None
    table = Table(angles, names=("coord_ra", "coord_dec"), units=units)
    table.write(tmp_path / "list.fits")
    np.testing.assert_allclose(positions(path, tmp_path / "list.fits"), place, atol=1e-5)


@pytest.mark.parametrize(
    "head",
    [
        "|  ra     | dec     |\n| double  | double  |\n| deg     | deg     |\n",
        "\\catalog = 2MASS\n|  RA     | DEC     |\n| double  | double  |\n| deg     | deg     |\n",
        "Title: stars\n====\nByte-by-byte Description of file: list.txt\n"
        + f"{'-' * 40}\n   Bytes Format Units Label Explanations\n{'-' * 40}\n"
        + "   2- 10 F9.5  deg   RAdeg Right ascension\n  12- 20 F9.5  deg   DEdeg Declination\n"
        + f"{'-' * 40}\n",
    ],
    ids=["IPAC", "IPAC with keys", "CDS"],
)
def test_tables_of_archives(tmp_path, path, place, head):
    sky = TANGENT.pixel_to_world(*place.T)
    rows = [f" {ra:9.5f} {dec:9.5f}\n" for ra, dec in zip(sky.ra.deg, sky.dec.deg, strict=True)]
    (tmp_path / "list.tbl").write_text(head + "".join(rows))
    np.testing.assert_allclose(positions(path, tmp_path / "list.tbl"), place, atol=0.1)


NO_NAMES = "no names of columns"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b" 12.5  14.25\n 33.1  8.0\n", NO_NAMES),  # IRAF's .coo
        (b"12.5,14.25\n33.1,8.0\n", NO_NAMES),
        (b"star1 12.5 14.25\nstar2 33.1 8.0\n", NO_NAMES),
        (b"0 1 12.50 14.25 1.02 150.3 -0.01 0.02 92 1e-3 1\n", NO_NAMES),  # DOLPHOT
        (b"10:00:12 +20:30:00\n", NO_NAMES),
        (b" \tLabel\tslice\tX(FITS)_T1\tY(FITS)_T1\n1\ta.fits\t1\t2.5\t3.5\n", "AstroImageJ"),
        (b'[{"Position": {"X": 1.5, "Y": 2.5}, "HFR": 2.1}]', "JSON"),
        (b'{\n  "stars": [\n    {"x": 1.5}\n  ]\n}\n', "JSON"),
        (b"x;y\n12,5;14,25\n", "'x' holds '12,5' in row 1.*decimal point"),
        (b"x\ty\n12\t14,25\n", "'y' holds '14,25' in row 1.*decimal point"),
        (b"x y\n12.5 14.25\n1 14,25\n", "'y' holds '14,25' in row 2.*decimal point"),
        (b"ra;dec\n12,5;14,25\n", "'ra' holds '12,5' in row 1.*decimal point"),
        (b"\x89HDF\r\n\x1a\n" + bytes(40), "HDF5"),
        (b"\x93NUMPY\x01\0" + bytes(40), "npy"),
        (b"ARROW1\0\0" + bytes(40), "Feather"),
        ("x,y,größe\n1,2,3\n".encode("latin-1"), "UTF-8"),
    ],
)
def test_other_formats_are_named_or_ask_for_names(tmp_path, image, content, message):
    (tmp_path / "list").write_bytes(content)
    with pytest.raises(Error, match=message):
        positions(image, tmp_path / "list", origin=0)


# Origin.


def test_the_stars_say_the_origin_of_plain_columns(tmp_path, image, place):
    for origin in (0, 1):
        observation = open_observation(ImageInput(image, catalogue=table(place, origin)), 16)
        np.testing.assert_allclose(observation.positions, place)
        assert f"count from {origin}" in observation.summary()


def test_where_they_do_not_the_origin_is_asked_for(image, place):
    for listed in (table(place + 0.5), table(place + np.array([0.0, 1.0])), table(place[:5])):
        with pytest.raises(Error, match="origin= sets it"):
            positions(image, listed)


@pytest.mark.parametrize("seed", range(3))
def test_a_list_off_by_one_pixel_is_refused_whatever_the_noise(seed):
    image, place = field(seed)
    cases = (
        ({"catalogue": place + 1}, 1),
        ({"catalogue": table(place + 1), "origin": 0}, 1),
        ({"catalogue": table(place, 0, ("X_IMAGE", "Y_IMAGE"))}, 0),
        ({"catalogue": table(place), "origin": 1}, 0),
    )
    for stated, is_accepted in cases[:: 1 if seed == 0 else 4]:
        with pytest.raises(Error, match=f"origin={is_accepted} sets this"):
            Stars.from_image(image, **stated, **CAMERA)
    accepted = Stars.from_image(image, catalogue=place + 1, accept_offset=True, **CAMERA)
    assert "x -1.00, y -1.00 px" in "".join(accepted.notes)


def test_iraf_counts_from_1_and_photutils_from_0(image, place):
    for origin, names in ((1, ("XCENTER", "YCENTER")), (0, ("xcenter", "ycenter"))):
        np.testing.assert_allclose(positions(image, table(place, origin, names)), place)


# Rows.


def test_of_two_rows_of_one_star_one_is_flagged_and_one_trained_on(image, place):
    twice = np.concatenate([place, place[5:8] + np.array([0.05, -0.05])])
    single_rows = Stars.from_image(image, catalogue=place, **CAMERA)
    stars = Stars.from_image(image, catalogue=twice, **CAMERA)
    flags = next(stars.observation.chunks(100)).flags
    assert np.flatnonzero(flags & StarFlag.BLENDED).tolist() == [70, 71, 72]
    assert (
        stars.candidates.verdict.tolist()
        == single_rows.candidates.verdict.tolist() + ["blended"] * 3
    )
    assert "3 rows are within 0.1 px of an earlier one (71, 72, 73)" in stars.notes[0]


@pytest.fixture(scope="module")
def model(tmp_path_factory, image, place):
    name = tmp_path_factory.mktemp("model") / "m.psf.safetensors"
    with few_draws():
        fit(Stars.from_image(image, catalogue=place, **CAMERA), "field", orders=[0]).save(name)
    return name


@pytest.mark.slow
def test_rows_without_position_and_twice_stay_in_every_result(tmp_path, image, place, model):
    write(tmp_path / "image.fits", image)
    listed_rows = np.concatenate([place, place[:1]])
    listed_rows[3, 0] = np.nan
    table(listed_rows).write(tmp_path / "s.csv")
    options = ["--catalogue", tmp_path / "s.csv", "--model", model]
    output = printed("photometry", tmp_path / "image.fits", *options, "--out", tmp_path / "p.ecsv")
    assert "row 4" in output and "1 row is within 0.1 px" in output
    photometry = Table.read(tmp_path / "p.ecsv")
    assert len(photometry) == len(listed_rows)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(photometry["flux"])), [3, 70])
    assert (photometry["flags"][[3, 70]] > 0).all()
    printed("predict", tmp_path / "image.fits", *options, "--out", tmp_path / "p.fits")
    rows = fits.getdata(tmp_path / "p.fits", "STARS")
    assert np.isnan(rows["flux"][3]) and rows["flags"][3] & StarFlag.NO_FLUX

    # Both results are star lists themselves, from 0.
    for name in ("p.ecsv", "p.fits"):
        catalogue_xy = as_catalogue(tmp_path / name).positions()
        assert (catalogue_xy.first, catalogue_xy.second, catalogue_xy.origin) == ("x", "y", 0)
        opened_xy = positions(tmp_path / "image.fits", tmp_path / name)
        np.testing.assert_allclose(
            np.delete(opened_xy, 3, 0), np.delete(listed_rows, 3, 0), atol=0.1
        )
