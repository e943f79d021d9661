"""Star catalogues: formats, names of columns, identifiers, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from fits_inputs import open_observation, write_field
from psfdae.image.catalogue import read_catalogue
from psfdae.image.errors import ObservationError
from psfdae.image.position_columns import CONVENTIONS
from psfdae.image.stamps import StarFlag
from psfdae.image.tables import SUFFIXES, star_table, write_table

D = 8
X, Y = [12.0, 20.25, 33.5], [9.0, 15.0, 21.75]


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    path = tmp_path_factory.mktemp("image") / "image.fits"
    write_field(path, path.with_suffix(".csv"), np.zeros((0, D, D)), *np.zeros((2, 0)), (30, 40))
    return path


def write_ldac(table, path):
    head = fits.BinTableHDU.from_columns([fits.Column("H", "8A", array=["x"])], name="LDAC_IMHEAD")
    stars = fits.BinTableHDU(table, name="LDAC_OBJECTS")
    fits.HDUList([fits.PrimaryHDU(), head, stars]).writeto(path)


def write_sextractor(table, path):
    lines = [f"#   {k + 1} {name}   about it   [pixel]" for k, name in enumerate(table.colnames)]
    lines += [" ".join(str(v) for v in row) for row in table]
    path.write_text("\n".join(lines) + "\n")


def write_with_comments(table, path):
    table.write(path, format="ascii.csv")
    path.write_text("# made by hand\n\n" + path.read_text() + "# end\n", encoding="utf-8-sig")


FORMATS = {
    "FITS_LDAC": write_ldac,
    "CSV with comments": write_with_comments,
    "semicolons": lambda table, path: table.write(path, format="ascii.csv", delimiter=";"),
    "SExtractor": write_sextractor,
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_stars(tmp_path, image, name):
    path = tmp_path / "stars.cat"
    table = Table({"NUMBER": [5, 7, 9], "X_IMAGE": X, "Y_IMAGE": Y, "FLUX": [1e3, 2e3, 3e3]})
    table["G_R"] = [0.5, 0.25, -0.25]
    FORMATS[name](table, path)
    observation = open_observation(
        image, D, catalogue=path, flux_column="flux", colour_column="g_r"
    )
    np.testing.assert_allclose(observation.positions, np.stack([X, Y], axis=1) - 1)
    (chunk,) = observation.chunks(10)
    np.testing.assert_array_equal(chunk.id, [5, 7, 9])
    np.testing.assert_array_equal(chunk.flux, [1e3, 2e3, 3e3])
    np.testing.assert_array_equal(chunk.colour, [0.5, 0.25, -0.25])


@pytest.mark.parametrize("pairs", CONVENTIONS, ids=lambda pairs: pairs[0].first)
def test_every_alias_in_any_case(tmp_path, image, pairs):
    # In capitals xcenter is IRAF's, which counts from 1, and else photutils', from 0.
    of_case = pairs[0].first.lower() == "xcenter"
    cases = (str,) if of_case else (str.lower, str.upper) * 9
    for columns, change in zip(2 * pairs, cases, strict=False):
        values = ([150.0], [2.0]) if columns.sky else ([12.0], [9.0])
        table = Table(values, names=[change(columns.first), change(columns.second)])
        table.write(tmp_path / "a.csv", format="ascii.csv", overwrite=True)
        origin = 0 if columns.origin is None and not columns.sky else None
        observation = open_observation(image, D, catalogue=tmp_path / "a.csv", origin=origin)
        expected = (19.5, 14.5) if columns.sky else np.array([12, 9]) - (columns.origin or 0)
        np.testing.assert_allclose(observation.positions[0], expected, atol=1e-6)


def test_the_best_columns_of_a_program_and_pixels_before_sky(tmp_path, image):
    names = ("X_IMAGE", "Y_IMAGE", "XWIN_IMAGE", "YWIN_IMAGE", "ALPHA_J2000", "DELTA_J2000")
    Table(np.array([[1.0, 1.0, 5.0, 6.0, 0.0, 0.0]]), names=names).write(tmp_path / "a.csv")
    observation = open_observation(image, D, catalogue=tmp_path / "a.csv")
    np.testing.assert_array_equal(observation.positions, [[4, 5]])


def test_units_and_sexagesimal_coordinates(tmp_path):
    (tmp_path / "a.csv").write_text("ra,dec\n10:00:00.0,+02:00:00\n10:00:04.0,-00:30:00\n")
    (tmp_path / "d.csv").write_text("ra,dec\n7:30:00,+02:00:00\n150:06:00,-00:30:00\n")
    radians = {"ra": np.deg2rad([150.0]), "dec": np.deg2rad([2.0])}
    Table(radians, units=["rad", "rad"]).write(tmp_path / "b.fits")
    Table({"ra": [1.0], "dec": [2.0]}, units=["m", "deg"]).write(tmp_path / "c.fits")
    tables = {
        name: read_catalogue(tmp_path / name) for name in ("a.csv", "b.fits", "c.fits", "d.csv")
    }
    expected = {"a.csv": ([150.0, 150 + 1 / 60], [2.0, -0.5]), "b.fits": ([150.0], [2.0])}
    expected["d.csv"] = ([7.5, 150.1], [2.0, -0.5])  # 150 are no hours
    for name, angles in expected.items():
        np.testing.assert_allclose(tables[name].sky(tables[name].positions()), angles)
    with pytest.raises(ObservationError, match="column 'ra' has the unit 'm', expected an angle"):
        tables["c.fits"].sky(tables["c.fits"].positions())


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("source_id", [2**62 + 1, 3], np.array([2**62 + 1, 3])),
        ("name", ["a b", "c"], np.array(["a b", "c"])),
        ("other", [8, 9], np.array([0, 1])),
    ],
)
@pytest.mark.parametrize("file", ["a.fits", "a.csv"])
def test_identifiers(tmp_path, name, values, expected, file):
    Table({"x": [1.0, 2.0], "y": [1.0, 2.0], name: values}).write(tmp_path / file)
    identifiers = read_catalogue(tmp_path / file).identifiers()
    np.testing.assert_array_equal(identifiers, expected)
    assert identifiers.dtype.kind == expected.dtype.kind


VOTABLE = (
    '<VOTABLE version="1.3"><RESOURCE><TABLE><FIELD name="id" datatype="char" arraysize="*"/>'
    '<FIELD name="x_fit" datatype="double"/><FIELD name="y_fit" datatype="double"/>'
    "<DATA><TABLEDATA><TR><TD>001</TD><TD>1</TD><TD>2</TD></TR>"
    "<TR><TD>1e5</TD><TD>3</TD><TD>4</TD></TR></TABLEDATA></DATA></TABLE></RESOURCE></VOTABLE>"
)
SEXTRACTOR = "#   1 NUMBER  Running\n#   2 X_IMAGE  x  [pixel]\n#   3 Y_IMAGE  y  [pixel]\n"
LISTS = {
    "commas": "id,x_fit,y_fit\n001,1,2\n1e5,3,4\n",
    "quotes": 'id,x_fit,y_fit\n"001",1,2\n"1e5",3,4\n',
    "blanks": "  ID  x_fit y_fit\n 001  1 2\n 1e5  3 4\n",
    "semicolons": "Number;x_fit;y_fit\n001 ;1;2\n 1e5;3;4\n",
    "tabs": "id\tx_fit\ty_fit\n001\t1\t2\n1e5\t3\t4\n",
    "a first column without a name": "\tid\tx_fit\ty_fit\n0\t001\t1\t2\n1\t1e5\t3\t4\n",
    "two columns of one name": "id,id,x_fit,y_fit\n001,5,1,2\n1e5,6,3,4\n",
    "names in a comment": "# id x_fit y_fit\n001 1 2\n1e5 3 4\n",
    "a comment below the names": "# id x_fit y_fit\n# as I saw them\n001 1 2\n1e5 3 4\n",
    "VizieR": "id;x_fit;y_fit\n ;pix;pix\n---;---;---\n001;1;2\n1e5;3;4\n",
    "SExtractor": f"{SEXTRACTOR}  001 2 3\n  1e5 4 5\n",
    "DAOPHOT": " NL NX NY LOWBAD\n 1 99 99 0\n\n 001 2.0 3.0 9.\n 1e5 4.0 5.0 9.\n",
    "IPAC": "|id  |x_fit|y_fit|\n 001   1.0   2.0  \n 1e5   3.0   4.0  \n",
    "IPAC with types": "|id  |x_fit|y_fit|\n|char|real |real |\n 001   1.0   2.0  \n"
    " 1e5   3.0   4.0  \n",
    "DS9": "# Region file\nimage\ncircle(2,3,1) # text={001}\ncircle(4,5,1) # text={1e5}\n",
    "VOTable": VOTABLE,
}


@pytest.mark.parametrize("kind", LISTS)
def test_identifiers_are_the_texts_of_the_list(tmp_path, kind):
    """Neither 001 is 1 nor 1e5 a number, and the positions are those of the same rows."""
    (tmp_path / "stars").write_text(LISTS[kind])
    stars = read_catalogue(tmp_path / "stars")
    assert stars.identifiers().tolist() == ["001", "1e5"]
    pair = stars.positions()
    position = np.stack([stars.pixels(pair.first), stars.pixels(pair.second)], axis=1)
    np.testing.assert_array_equal(position - pair.origin, [[1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["7", "-12"], [7, -12]),
        (["7", "07"], ["7", "07"]),
        (["12.0", "13.0"], ["12.0", "13.0"]),
        (["7", ""], ["7", ""]),
        (["-0", "+1"], ["-0", "+1"]),
        (["NA", "nan"], ["NA", "nan"]),
        (["True", "False"], ["True", "False"]),
        (["9" * 25, "1"], ["9" * 25, "1"]),
    ],
)
def test_identifiers_are_numbers_only_if_their_texts_are_the_same(tmp_path, cells, expected):
    (tmp_path / "a.csv").write_text("id,x,y\n" + "".join(f"{cell},1,2\n" for cell in cells))
    assert read_catalogue(tmp_path / "a.csv").identifiers().tolist() == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# stars of field 3\n10 20\n30 40\n", "no names of columns: its first row is '10 20'"),
        ("# 10 20 30\n10 20\n30 40\n", "no names of columns"),
        ("# one\n# two of them\n10,20\n", "no names of columns"),
        ("# my stars\n10 20\n30 40\n", "no position columns; found my, stars"),
    ],
)
def test_a_comment_above_a_list_without_names_is_not_the_names(tmp_path, text, message):
    (tmp_path / "a.coo").write_text(text)
    with pytest.raises(ObservationError, match=message):
        stars = read_catalogue(tmp_path / "a.coo")
        stars.positions()


def test_tables_have_the_texts_of_identifiers(tmp_path):
    """In every format of an output table."""
    identifiers = np.array(["001", "1e5"])
    for suffix in SUFFIXES:
        path = tmp_path / f"out{suffix}"
        write_table(path, star_table({"id": identifiers, "x": np.ones(2), "y": np.ones(2)}))
        assert read_catalogue(path).identifiers().tolist() == ["001", "1e5"]


def test_values_that_are_missing_are_nan_where_they_may_be(tmp_path):
    (tmp_path / "a.csv").write_text("X_IMAGE,Y_IMAGE,flux,word\n12,9,,a\n13,9,5.5,b\n")
    stars = read_catalogue(tmp_path / "a.csv")
    np.testing.assert_array_equal(stars.numbers("FLUX"), [np.nan, 5.5])
    with pytest.raises(ObservationError, match="holds 'a' in row 1, expected a number"):
        stars.numbers("word")
    with pytest.raises(ObservationError, match=r"no column 'mag'; found X_IMAGE, .*word"):
        stars.numbers("mag")


@pytest.mark.parametrize(
    "content",
    [
        "X_IMAGE,Y_IMAGE\n12,9\n,9\n12,inf\nfoo,9\n13,9\n",
        "ALPHA_J2000,DELTA_J2000\n150,2\n,2\n150,95\nfoo,2\n150,2.0001\n",
        "ra,dec\n10:00:00,2:00:00\n,2:00:00\n10:00:00,99:00:00\n,\n10:00:01,2:00:00\n",
    ],
)
def test_a_row_without_a_position_is_kept_flagged_and_named(tmp_path, image, content):
    path = tmp_path / "stars.csv"
    path.write_text(content)
    observation = open_observation(image, D, catalogue=path)
    has_no_position = [False, True, True, True, False]
    assert observation.lacks_position().tolist() == has_no_position
    assert f"{path}: no position in row 2, 3, 4: flagged" in observation.summary()
    stamps = next(observation.chunks(5))
    assert (
        (stamps.flags & StarFlag.TRUNCATED) > 0
    ).tolist() == observation.lacks_position().tolist()
    assert stamps.bad[1:4].all()


def test_sextractor_says_what_is_wrong_with_a_star(tmp_path, image):
    blended, saturated, truncated = StarFlag.BLENDED, StarFlag.SATURATED, StarFlag.TRUNCATED
    meaning = [0, 0, blended, blended | saturated, truncated]
    for names, flags in ((("X_IMAGE", "Y_IMAGE"), meaning), (("x_fit", "y_fit"), [0] * 5)):
        columns = [20.0 + 0.2 * np.arange(5), 15.0 + 0.2 * np.arange(5), [0, 1, 2, 7, 24]]
        path = tmp_path / f"{names[0]}.csv"
        Table(columns, names=[*names, "FLAGS"]).write(path)
        observation = open_observation(image, D, catalogue=path)
        assert next(observation.chunks(5)).flags.tolist() == flags


REFUSED = {
    "no positions": ("id,mag\n1,12\n", "no position columns; .* accepted XWIN_IMAGE"),
    "two programs": ("X_IMAGE,Y_IMAGE,xcentroid,ycentroid\n1,1,0,0\n", "ambiguous"),
    "text": ("X_IMAGE,Y_IMAGE\nbar,9\nfoo,9\n", "'X_IMAGE'"),
    "declination": ("ra,dec\n10,95\n", "95° in row 1"),
    "ragged": ("X_IMAGE,Y_IMAGE\n1,2,3\n", "columns"),
    "all off": ("X_IMAGE,Y_IMAGE\n500,9\n600,9\n", "x 499 … 599, y 8 … 8"),
    "crowd": ("X_IMAGE,Y_IMAGE\n" + 1300 * "12,9\n", "1300 stars"),
    "binary": ("\x00\x01\x02", "neither a FITS table nor text"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_catalogues_are_refused_in_one_line(tmp_path, image, case):
    content, words = REFUSED[case]
    path = tmp_path / "stars.csv"
    path.write_text(content)
    with pytest.raises(ObservationError, match=rf"^\S+/stars\.csv: .*{words}") as refusal:
        open_observation(image, D, catalogue=path)
    assert "\n" not in str(refusal.value)
