"""Star catalogues: formats, names of columns, identifiers, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from fits_inputs import open_observation, write_field
from psfdae.own_stars.catalogue import CONVENTIONS, read_catalogue
from psfdae.own_stars.errors import ObservationError

D = 8
X, Y = [12.0, 20.25, 33.5], [9.0, 15.0, 21.75]


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    path = tmp_path_factory.mktemp("image") / "image.fits"
    none = np.zeros((0, D, D)), np.zeros(0), np.zeros(0)
    write_field(path, path.with_suffix(".csv"), *none, shape=(30, 40))
    return path


def rows(table):
    return Table({"NUMBER": [5, 7, 9], "X_IMAGE": X, "Y_IMAGE": Y, "FLUX": table})


def write_ldac(table, path):
    head = fits.BinTableHDU.from_columns([fits.Column("H", "8A", array=["x"])], name="LDAC_IMHEAD")
    stars = fits.BinTableHDU(table, name="LDAC_OBJECTS")
    fits.HDUList([fits.PrimaryHDU(), head, stars]).writeto(path)


def write_sextractor(table, path):
    header = [
        f"#   {k + 1} {name}   text about it   [pixel]" for k, name in enumerate(table.colnames)
    ]
    lines = [" ".join(str(v) for v in row) for row in table]
    path.write_text("\n".join([*header, *lines]) + "\n")


def write_with_comments(table, path):
    table.write(path, format="ascii.csv")
    path.write_text("# made by hand\n\n" + path.read_text() + "# end\n", encoding="utf-8-sig")


FORMATS = {
    "FITS": lambda table, path: table.write(path, format="fits"),
    "FITS_LDAC": write_ldac,
    "CSV": lambda table, path: table.write(path, format="ascii.csv"),
    "CSV with comments": write_with_comments,
    "semicolons": lambda table, path: table.write(path, format="ascii.csv", delimiter=";"),
    "tabs": lambda table, path: table.write(path, format="ascii.tab"),
    "blanks": lambda table, path: table.write(path, format="ascii.basic"),
    "commented header": lambda table, path: table.write(path, format="ascii.commented_header"),
    "ECSV": lambda table, path: table.write(path, format="ascii.ecsv"),
    "SExtractor": write_sextractor,
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_stars(tmp_path, image, name):
    path = tmp_path / "stars.cat"
    FORMATS[name](rows([1e3, 2e3, 3e3]), path)
    found = open_observation(image, stamp_px=D, catalogue=path, flux_column="flux")
    np.testing.assert_allclose(found.positions, np.stack([X, Y], axis=1) - 1)
    (chunk,) = found.chunks(10)
    np.testing.assert_array_equal(chunk.id, [5, 7, 9])
    np.testing.assert_array_equal(chunk.flux, [1e3, 2e3, 3e3])


@pytest.mark.parametrize("convention", CONVENTIONS, ids=lambda c: c.pairs[0][0])
@pytest.mark.parametrize("change", [str.lower, str.upper])
def test_every_alias_in_any_case(tmp_path, image, convention, change):
    for pair in convention.pairs:
        values = ([150.0], [2.0]) if convention.sky else ([12.0], [9.0])
        Table(values, names=[change(name) for name in pair]).write(
            tmp_path / "a.csv", format="ascii.csv", overwrite=True
        )
        unstated = convention.origin is None and not convention.sky
        origin = 0 if unstated else None
        found = open_observation(image, stamp_px=D, catalogue=tmp_path / "a.csv", origin=origin)
        expected = (19.5, 14.5) if convention.sky else np.array([12, 9]) - (convention.origin or 0)
        np.testing.assert_allclose(found.positions[0], expected, atol=1e-6)


def test_the_best_columns_of_a_program_and_pixels_before_sky(tmp_path, image):
    table = Table({"X_IMAGE": [1.0], "Y_IMAGE": [1.0], "XWIN_IMAGE": [5.0], "YWIN_IMAGE": [6.0]})
    table["ALPHA_J2000"], table["DELTA_J2000"] = [0.0], [0.0]
    table.write(tmp_path / "a.csv")
    found = open_observation(image, stamp_px=D, catalogue=tmp_path / "a.csv")
    np.testing.assert_array_equal(found.positions, [[4, 5]])


def test_units_and_sexagesimal_coordinates(tmp_path):
    (tmp_path / "a.csv").write_text("ra,dec\n10:00:00.0,+02:00:00\n10:00:04.0,-00:30:00\n")
    Table({"ra": np.deg2rad([150.0]), "dec": np.deg2rad([2.0])}, units=["rad", "rad"]).write(
        tmp_path / "b.fits"
    )
    for name, expected in (
        ("a.csv", ([150.0, 150 + 1 / 60], [2.0, -0.5])),
        ("b.fits", ([150.0], [2.0])),
    ):
        table = read_catalogue(tmp_path / name)
        np.testing.assert_allclose(table.sky(table.positions()), expected)
    Table({"ra": [1.0], "dec": [2.0]}, units=["m", "deg"]).write(tmp_path / "c.fits")
    table = read_catalogue(tmp_path / "c.fits")
    with pytest.raises(ObservationError, match="column 'ra' has the unit 'm', expected an angle"):
        table.sky(table.positions())


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        (("source_id", [2**62 + 1, 3]), np.array([2**62 + 1, 3])),
        (("ID", [1.0, 2.0]), np.array([1, 2])),
        (("name", ["a b", "c"]), np.array(["a b", "c"])),
        (("other", [8, 9]), np.array([0, 1])),
    ],
)
def test_identifiers(tmp_path, column, expected):
    table = Table({"x": [1.0, 2.0], "y": [1.0, 2.0], column[0]: column[1]})
    for name in ("a.fits", "a.csv"):
        table.write(tmp_path / name)
        found = read_catalogue(tmp_path / name).identifiers()
        np.testing.assert_array_equal(found, expected)
        assert found.dtype.kind == expected.dtype.kind


def test_values_that_are_missing_are_nan_where_they_may_be(tmp_path, image):
    (tmp_path / "a.csv").write_text("X_IMAGE,Y_IMAGE,flux,word\n12,9,,a\n13,9,5.5,b\n")
    options = {"stamp_px": D, "catalogue": tmp_path / "a.csv"}
    (chunk,) = open_observation(image, **options, background_column="FLUX").chunks(9)
    np.testing.assert_array_equal(chunk.background, [np.nan, 5.5])
    for column, message in (
        ("word", "holds 'a' in row 1, expected a number"),
        ("mag", r"no column 'mag'; found X_IMAGE, .*word"),
    ):
        with pytest.raises(ObservationError, match=message):
            open_observation(image, **options, flux_column=column)


# What is refused: content of the catalogue, and words of the message.
REFUSED = {
    "empty file": ("", "catalogue is empty"),
    "blank lines": ("\n \n", "catalogue is empty"),
    "header only": ("X_IMAGE,Y_IMAGE\n", "no stars"),
    "comments only": ("# a\n# b\n", "no stars"),
    "no positions": ("id,mag\n1,12\n", "no position columns; found id, mag; accepted XWIN_IMAGE"),
    "half a pair": ("X_IMAGE,mag\n1,12\n", "no position columns"),
    "no header": ("1.5,2.5\n3.5,4.5\n", "no position columns; found 1.5, 2.5"),
    "two programs": (
        "X_IMAGE,Y_IMAGE,xcentroid,ycentroid\n1,1,0,0\n",
        "ambiguous position columns X_IMAGE,Y_IMAGE or xcentroid,ycentroid",
    ),
    "two skies": ("ra,dec,RAJ2000,DEJ2000\n1,1,1,1\n", "ambiguous position columns ra,dec or"),
    "case only": ("x,X,y\n1,1,1\n", "x and X differ in their case only"),
    "text": ("X_IMAGE,Y_IMAGE\n12,9\nfoo,9\n", "'foo' in row 2"),
    "nan": (
        "X_IMAGE,Y_IMAGE\n12,9\n12,nan\n",
        "no finite number in 1 of 2 rows.*row 2",
    ),
    "gap": ("X_IMAGE,Y_IMAGE\n,9\n12,9\n", "column 'X_IMAGE' has no finite number.*row 1"),
    "infinite": ("X_IMAGE,Y_IMAGE\ninf,9\n", "no finite number"),
    "declination": ("ra,dec\n10,95\n", "95° in row 1, expected -90 … 90"),
    "sexagesimal": ("ra,dec\n10:99:00,1:2:3\n", "stars.csv: "),
    "ragged": ("X_IMAGE,Y_IMAGE\n1,2,3\n", "stars.csv: "),
    "twice": ("x,x,y\n1,1,1\n", "stars.csv: "),
    "all off": ("X_IMAGE,Y_IMAGE\n500,9\n600,9\n", "none of the 2 stars.*x 499 … 599, y 8 … 8"),
    "crowd": ("X_IMAGE,Y_IMAGE\n" + 20_000 * "12,9\n", "20000 stars are on .* than it has pixels"),
    "all off sky": ("ra,dec\n10,-60\n", "none of the 1 stars"),
    "binary": ("\x00\x01\x02", "neither a FITS table nor text"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_catalogues_are_refused_in_one_line(tmp_path, image, case):
    content, message = REFUSED[case]
    path = tmp_path / "stars.csv"
    path.write_text(content)
    with pytest.raises(ObservationError, match=message) as error:
        open_observation(image, stamp_px=D, catalogue=path)
    assert "\n" not in str(error.value) and "stars.csv" in str(error.value)


def test_tables_that_cannot_be_chosen_or_hold_no_numbers(tmp_path, image):
    one = fits.BinTableHDU(Table({"X_IMAGE": [1.0], "Y_IMAGE": [1.0]}), name="A")
    vector = fits.BinTableHDU(Table({"X_IMAGE": [[1.0, 2.0]], "Y_IMAGE": [1.0]}), name="B")
    truth = fits.BinTableHDU(Table({"X_IMAGE": [True], "Y_IMAGE": [1.0]}), name="C")
    none = fits.BinTableHDU(Table({"X_IMAGE": np.zeros(0), "Y_IMAGE": np.zeros(0)}))
    for tables, message in (
        ([one, vector], "expected one table of stars, found A, B"),
        ([vector], "holds arrays"),
        ([truth], "does not hold numbers"),
        ([none], "no stars"),
        ([], "expected one table of stars, found none"),
    ):
        path = tmp_path / "t.fits"
        fits.HDUList([fits.PrimaryHDU(), *tables]).writeto(path, overwrite=True)
        with pytest.raises(ObservationError, match=message):
            open_observation(image, stamp_px=D, catalogue=path)
