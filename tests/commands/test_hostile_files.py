"""Unusable and hostile files: exit code 2, one line that names the file, nothing executed."""

from __future__ import annotations

import gc
import gzip
import http.server
import io
import itertools
import os
import pickle
import shutil
import signal
import struct
import subprocess
import sys
import threading
import warnings
from contextlib import suppress
from functools import partial
from pathlib import Path

import astropy.io.votable
import numpy as np
import psutil
import pytest
from astropy.io import fits
from astropy.table import Table

from command_line import psfdae, refused
from fits_inputs import PACK, open_observation, write_cube, write_field
from prediction_stars import with_network
from psfdae import Error, load_model
from psfdae.base.files import read_product, temporary_name
from psfdae.base.reading import read_table, read_yaml
from psfdae.denoise import bundle as bundles
from psfdae.denoise.bundle import locate_shipped_model, read_bundle
from psfdae.image import fits_file as images
from psfdae.image import list_formats
from psfdae.image.catalogue import read_catalogue
from psfdae.image.errors import ObservationError
from psfdae.methods.networks.weights import load_weights

SIDE = 16
CUBE, TILES, LIST, TABLE, MODEL = (
    *("cube.fits", "image.fz", "stars.csv", "stars.fits"),
    "model.psf.safetensors",
)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A cube of stamps, an image in tiles, two star lists and a model."""
    folder = tmp_path_factory.mktemp("good")
    grid = np.arange(SIDE) - SIDE // 2
    star = np.exp(-(grid[:, None] ** 2 + grid**2) / 8.0)
    stamps = np.random.default_rng(1).poisson(100 + 400 * star, (12, SIDE, SIDE)).astype(float)
    write_cube(folder / CUBE, stamps, PIXSCALE=0.1)
    x, y = np.random.default_rng(2).uniform(0, [[60], [40]], (2, 12))
    options = {"shape": (40, 60), "pixel_scale_arcsec": 0.1, "compress": True}
    write_field(folder / TILES, folder / LIST, stamps, x, y, **options)
    Table.read(folder / LIST).write(folder / TABLE)
    shutil.copy(locate_shipped_model(), folder / MODEL)
    return folder


def command(good, path):
    """The command that reads a file of this name in the place of the good one."""
    out = path.with_name("out.fits")
    words = {
        CUBE: [path],
        TILES: [path, "--catalogue", good / LIST],
        MODEL: [good / CUBE, "--model", path],
    }.get(path.name, [good / TILES, "--catalogue", path])
    return ["predict", *words, "--pixel-scale", 0.1, "--out", out, "--quiet", "--overwrite"]


class Touch:
    """A pickle of it makes a file where it is read."""

    def __reduce__(self):
        return Path.touch, (Path("executed"),)


def cut(share):
    return lambda raw: raw[: int(share * len(raw))]


def with_card(card):
    """The file with a card of its header replaced by one of the same key."""

    def change(raw):
        place = raw.index(card.split("=")[0].ljust(8).encode() + b"=")
        return raw[:place] + card.ljust(80).encode() + raw[place + 80 :]

    return change


def pixels(*shape):
    def change(_):
        hdu = fits.PrimaryHDU(np.zeros(shape, np.float32))
        return b"".join((hdu.header.tostring().encode(), bytes(-(-hdu.size // 2880) * 2880)))

    return change


def model_with(name, change):
    """The shipped model, or a network, with an array changed and signed anew."""

    def changed(_):
        bundle = read_bundle()
        bundle = with_network(bundle) if name.startswith(("dae/", "flux/")) else bundle
        arrays = bundles.bundle_arrays(bundle)
        arrays[name] = np.asarray(change(arrays[name]))
        return bundles.bundle_bytes(bundle.info, arrays)

    return changed


CASES = [
    *((name, lambda _: pickle.dumps(Touch()), name) for name in (CUBE, TILES, LIST, MODEL)),
    (CUBE, lambda _: b"", "not a FITS file"),
    *((name, cut(0.6), name) for name in (CUBE, TILES, TABLE, MODEL)),
    (CUBE, with_card("NAXIS3  = 99999999"), "truncated"),
    (TILES, with_card("ZNAXIS2 = 9999"), "damaged"),
    (TABLE, with_card("NAXIS2  = 99999999"), "larger than the file"),
    (CUBE, with_card("NAXIS   = 99999999999"), "NAXIS = 99999999999, expected 0 … 999"),
    (TILES, with_card("ZNAXIS  = 99999999999"), "ZNAXIS = 99999999999, expected 0 … 999"),
    (TABLE, with_card("TFIELDS = 99999999999"), "TFIELDS = 99999999999, expected 0 … 999"),
    (MODEL, lambda raw: struct.pack("<Q", 2**60) + raw[8:], MODEL),
    (CUBE, pixels(4, 7, 7), "7×7"),
    (CUBE, pixels(30, 40), "needs --catalogue"),
    (MODEL, model_with("flux/mean", lambda a: a[1:]), "'flux/mean' has shape"),
    (MODEL, model_with("flux/mean", lambda a: 0 * a), "'flux/mean' must have a sum of 1"),
    (MODEL, model_with("gmm/axes", lambda a: 2 * a), "'axes' must have orthonormal"),
]


@pytest.mark.parametrize(("name", "change", "words"), CASES)
def test_a_bad_file_is_one_line_and_no_code(good, tmp_path, monkeypatch, name, change, words):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / name
    path.write_bytes(change((good / name).read_bytes()))
    line = refused(*command(good, path))
    assert words in " ".join(line.split()) and line.rstrip("\n").isprintable()
    assert list(tmp_path.iterdir()) == [path]


# What is read of files that are packed or change.


@pytest.mark.parametrize("pack", PACK)
def test_packed_files_are_read_like_plain_ones_and_their_copies_deleted(
    tmp_path, monkeypatch, pack
):
    room, path = tmp_path / "room", tmp_path / "packed"
    room.mkdir()
    monkeypatch.setattr(images.tempfile, "tempdir", str(room))
    stamps = np.random.default_rng(1).normal(9, 2, (5, 8, 8)).astype(np.float32)
    write_cube(tmp_path / "a.fits", stamps)
    path.write_bytes(PACK[pack]((tmp_path / "a.fits").read_bytes()))
    np.testing.assert_array_equal(next(open_observation(path, 8).chunks(9)).data, stamps)
    gc.collect()  # a copy lives as long as what was read from it
    assert list(room.iterdir()) == []


def test_a_file_that_changes_after_opening_is_noticed(good, tmp_path):
    path = tmp_path / CUBE
    shutil.copy(good / CUBE, path)
    observation = open_observation(path, SIDE)
    write_cube(path, np.zeros((3, SIDE, SIDE)))
    with pytest.raises(ObservationError, match="has changed"):
        list(observation.chunks(10))


def test_columns_of_fits_tables_that_hold_arrays_are_no_numbers(tmp_path):
    lists = fits.Column("many", "PB()", array=np.array([np.zeros(9, np.uint8)] * 4, dtype=object))
    gap = Table({"x": np.ma.array([1, 2, 3, 4], mask=[0, 1, 0, 0]), "y": np.zeros(4)})
    columns = fits.table_to_hdu(gap).columns + lists
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "s.fits")
    catalogue = read_catalogue(tmp_path / "s.fits")
    np.testing.assert_array_equal(catalogue.numbers("x"), [1, np.nan, 3, 4])
    assert catalogue.columns(np.arange(4)).colnames == []
    with pytest.raises(ObservationError, match="'many' holds"):
        catalogue.numbers("many")


def test_predictions_do_not_depend_on_who_completes_the_basis(monkeypatch, shipped):
    """Large stamps' way, on small ones: the same predictions but for rounding."""
    lean_basis = partial(bundles.build_flux_model, full_basis_max_px=0)
    monkeypatch.setattr(bundles, "build_flux_model", lean_basis)
    lean = load_model()
    flux_model, rng = lean.bundle.flux_model, np.random.default_rng(3)
    assert flux_model.basis.shape[1] == lean.info.components < 256
    scores = rng.normal(0, np.sqrt(flux_model.variance), (20, lean.info.components))
    psf = (flux_model.mean + scores @ flux_model.basis.T).reshape(20, SIDE, SIDE)
    stamps = rng.poisson(np.maximum(2e4 * psf + 100, 0)).astype(np.float32)
    stamps[::3, 4, 5] = np.nan
    stamps[::5, 9, 9] = 1e7
    for given_values in ({}, {"background": 100.0}):
        full_basis, lean_prediction = (
            model.predict(stamps, **given_values) for model in (shipped, lean)
        )
        assert (full_basis.flags == lean_prediction.flags).all()
        for name in ("psf", "flux", "flux_error", "background", "noise", "chi2", "distance"):
            a, b = getattr(full_basis, name), getattr(lean_prediction, name)
            np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6 * np.nanmax(np.abs(a)))


# What is packed.


def leftovers(room):
    gc.collect()
    return list(room.iterdir())


@pytest.fixture
def room(tmp_path, monkeypatch):
    """The folder for temporary files, empty."""
    folder = tmp_path / "room"
    folder.mkdir()
    monkeypatch.setattr(images.tempfile, "tempdir", str(folder))
    return folder


@pytest.mark.parametrize("spoil", [cut(0.6), cut(0.02), lambda raw: raw[:-9] + bytes(9)])
@pytest.mark.parametrize("pack", PACK)
def test_a_damaged_packed_file_leaves_no_copy(good, tmp_path, room, pack, spoil):
    path = tmp_path / CUBE
    path.write_bytes(spoil(PACK[pack]((good / CUBE).read_bytes())))
    with pytest.raises(ObservationError, match=CUBE):
        open_observation(path, SIDE)
    assert leftovers(room) == []


@pytest.mark.parametrize("pack", PACK)
def test_no_more_is_unpacked_than_a_file_may_hold(tmp_path, room, monkeypatch, pack):
    """A file that unpacks to the limit is read; one byte more, and nothing is left of it."""
    monkeypatch.setattr(images, "compute_unpacked_max", lambda packed_bytes: 2**21)
    path = tmp_path / "packed"
    for size in (2**21, 2**21 + 1):
        path.write_bytes(PACK[pack](bytes(size)))
        if size == 2**21:
            assert images.unpack_file(path)[0].path.stat().st_size == size
            continue
        with pytest.raises(ObservationError, match="unpacks to more than 2 MB"):
            images.unpack_file(path)
    assert leftovers(room) == []


def test_the_limit_of_what_is_unpacked_grows_with_the_file():
    memory_bytes = psutil.virtual_memory().total
    assert images.compute_unpacked_max(14_000) == 2**26
    assert images.compute_unpacked_max(10**6) == min(1032 * 10**6, memory_bytes)
    assert abs(images.compute_unpacked_max(2**50) / memory_bytes - 1) < 0.01


@pytest.mark.parametrize(
    ("coding", "dtype"), [("RICE_1", "i2"), ("GZIP_1", "f4"), ("GZIP_2", "i4")]
)
def test_tiles_that_share_their_bytes_are_refused(tmp_path, coding, dtype):
    """A file of 64 kB whose 7500 tiles are one tile of 20000 pixels, 150 million in all."""
    row = fits.CompImageHDU(
        np.zeros((1, 20000), dtype), compression_type=coding, tile_shape=(1, 20000)
    )
    row.writeto(tmp_path / "row.fz")
    with fits.open(tmp_path / "row.fz", disable_image_compression=True) as hdus:
        header, start = hdus[1].header.copy(), hdus[1].fileinfo()["datLoc"]
    content = (tmp_path / "row.fz").read_bytes()[start:]
    width = header["NAXIS1"]
    header["NAXIS2"] = header["ZNAXIS2"] = 7500
    data = content[:width] * 7500 + content[width : width + header["PCOUNT"]]
    head = fits.PrimaryHDU().header.tostring() + header.tostring()
    path = tmp_path / "image.fz"
    path.write_bytes(head.encode() + data + bytes(-len(data) % 2880))
    with pytest.raises(ObservationError, match=r"damaged: \d+ bytes in tiles of"):
        images.find_image(path)
    assert images.find_image(tmp_path / "row.fz").shape == (1, 20000)


def test_arrays_of_a_table_that_share_their_bytes_are_refused(tmp_path):
    """6000 rows, each of which claims all of the 24000 numbers that the file has."""
    lists = np.array([np.zeros(4, "f4")] * 6000, dtype=object)
    x = fits.Column("x", "D", array=np.arange(6000))
    table = fits.BinTableHDU.from_columns([x, fits.Column("many", "PE()", array=lists)])
    table.writeto(tmp_path / "s.fits")
    assert len(read_catalogue(tmp_path / "s.fits")) == 6000
    with fits.open(tmp_path / "s.fits") as hdus:
        start, width = hdus[1].fileinfo()["datLoc"], hdus[1].header["NAXIS1"]
    raw = bytearray((tmp_path / "s.fits").read_bytes())
    for row in range(6000):
        raw[start + row * width + 8 : start + (row + 1) * width] = struct.pack(">ii", 24000, 0)
    (tmp_path / "s.fits").write_bytes(raw)
    with pytest.raises(ObservationError, match="larger than the file"):
        read_catalogue(tmp_path / "s.fits")


def test_what_a_killed_process_has_unpacked_is_removed(good, tmp_path, room):
    """The next process that unpacks a file removes it; the copy of a running process stays."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    name = temporary_name("psfdae")
    dead, alive = (room / name.replace(f"-{os.getpid()}-", f"-{n}-") for n in (ended.pid, 1))
    for path in (dead, alive):
        path.touch()
    path = tmp_path / "cube.fits.gz"
    path.write_bytes(gzip.compress((good / CUBE).read_bytes()))
    observation = open_observation(path, SIDE)
    assert not dead.exists() and alive.exists()
    del observation
    assert leftovers(room) == [alive]


# Pipes and devices, which may never end.


@pytest.fixture(params=["pipe", "device"])
def endless(request, tmp_path):
    path = tmp_path / "endless"
    if request.param == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    signal.alarm(60)
    yield path
    signal.alarm(0)


@pytest.mark.parametrize(
    "words",
    [
        "predict {} --out out.fits",
        "predict {good}/cube.fits --mask {} --out out.fits",
        "predict {good}/image.fz --catalogue {} --out out.fits",
        "predict {good}/cube.fits --model {} --out out.fits",
        "train {good}/image.fz --catalogue {} --out m",
        "photometry {good}/image.fz --catalogue {good}/stars.csv --model {} --out out.csv",
        "psf {} --grid 3x3 --out out.fits",
        "describe {}",
        "wavefront {good}/cube.fits --telescope {} --out out.csv",
    ],
)
def test_a_pipe_or_a_device_is_refused(good, tmp_path, monkeypatch, endless, words):
    monkeypatch.chdir(tmp_path)
    line = refused(*words.format(endless, good=good).split())
    assert "a pipe or a device, expected a file" in " ".join(line.split())
    for read in (lambda path: read_product(path, "stars"), read_yaml, read_table, load_weights):
        with pytest.raises(Error, match="a pipe or a device"):
            read(endless)


# Addresses.

STREAMS = {
    "plain": "<STREAM href='{}'/>",
    "double quotes": '<STREAM encoding="base64" href="{}"></STREAM>',
    "prefix": "<v:STREAM href='{}'/>",
    "prefix with a hyphen": "<v-o.t:STREAM href='{}'/>",
    "prefix of other letters": "<ö:STREAM href='{}'/>",
    "greater than in an attribute": "<STREAM encoding='>' rights='/>' href='{}'/>",
    "lines": "<STREAM\n\trights='x'\r\n\n href\n=\n'{}'\n/>",
    "after a comment": "<!-- <STREAM> --><STREAM href='{}'/><!-- -->",
    "after CDATA": "<INFO name='a' value='b'><![CDATA[</STREAM>]]></INFO><STREAM href='{}'/>",
    "references": "<STREAM href='&#104;&#x74;tp{tail}'/>",
    "entity in the address": "<STREAM href='&address;'/>",
    "entity of the element": "&element;",
    "entity of the tag's content": "&outer;",
    "default attribute": "<STREAM/>",
}
DATA = ["<BINARY>{}</BINARY>", "<BINARY2>{}</BINARY2>", "<FITS>{}</FITS>", "<PARQUET>{}</PARQUET>"]
ENCODINGS = {"utf-8": b"", "utf-16-le": b"\xff\xfe", "utf-16-be": b"\xfe\xff", "iso-8859-1": b""}


@pytest.fixture(scope="module")
def server():
    """A server of this machine, and the list of the addresses that were asked for."""

    class Log(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            requests.append(self.path)
            self.send_error(404)

        def log_message(self, *words):
            pass

    requests = []
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Log) as listening:
        thread = threading.Thread(target=listening.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{listening.server_port}/", requests
        listening.shutdown()
        thread.join()


def votable_of(stream, data, encoding, address):
    entities = {
        "entity in the address": f"<!ENTITY address '{address}'>",
        "entity of the element": f"""<!ENTITY element "<STREAM href='{address}'/>">""",
        "entity of the tag's content": f"<!ENTITY inner '{address}'>"
        """<!ENTITY outer "<STREAM href='&#38;inner;'/>">""",
        "default attribute": f"<!ATTLIST STREAM href CDATA '{address}'>",
    }
    name = encoding[:6] if encoding.startswith("utf-16") else encoding
    head = f'<?xml version="1.0" encoding="{name}"?>'
    if stream in entities:
        head += f"<!DOCTYPE VOTABLE [{entities[stream]}]>"
    fields = "".join(f'<FIELD name="{axis}" datatype="double"/>' for axis in "xy")
    part = data.format(STREAMS[stream].format(address, tail=address.removeprefix("http")))
    body = f"<RESOURCE><TABLE>{fields}<DATA>{part}</DATA></TABLE></RESOURCE>"
    text = f'{head}<VOTABLE version="1.3">{body}</VOTABLE>'
    return ENCODINGS[encoding] + text.encode(encoding)


@pytest.mark.parametrize("stream", STREAMS)
def test_no_address_in_a_votable_is_opened(tmp_path, server, stream):
    """Whatever its spelling; astropy opens most of them, which shows that they are sound."""
    address, requests = server
    for data, encoding in itertools.product(DATA, ENCODINGS):
        path = tmp_path / "s.vot"
        path.write_bytes(votable_of(stream, data, encoding, address))
        with pytest.raises(Error, match=r"s\.vot: "):
            read_catalogue(path)
        path.write_bytes(gzip.compress(path.read_bytes()))
        with pytest.raises(Error, match=r"s\.vot: "):
            read_catalogue(path)
    assert requests == []
    content = votable_of(stream, DATA[0], "utf-8", address)
    with suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        astropy.io.votable.parse(io.BytesIO(content), verify="ignore")
    opened, requests[:] = list(requests), []
    assert opened == ["/"]


def test_no_address_that_a_file_names_is_opened(good, tmp_path, monkeypatch, server):
    """Addresses in texts, headers and names of lists, images and models, and as paths."""
    address, requests = server
    monkeypatch.chdir(tmp_path)
    dtd = f'<!DOCTYPE VOTABLE SYSTEM "{address}a.dtd" [<!ENTITY % p SYSTEM "{address}p"> %p;'
    dtd += f'<!ENTITY x SYSTEM "{address}x">]>'
    link = f'<RESOURCE><LINK href="{address}"/><TABLE><LINK href="{address}"/></TABLE></RESOURCE>'
    schema = f'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:schemaLocation="{address}"'
    include = f'<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="{address}"/>'
    texts = {
        "a.vot": f"{dtd}<VOTABLE {schema}>{link}{include}&x;</VOTABLE>",
        "b.vot": f'<?xml-stylesheet href="{address}"?><VOTABLE>{link}</VOTABLE>',
        "c.csv": f"{address}\n",
        "d.csv": f"x,y,name\n1,2,{address}\n",
        "e.ecsv": f"# %ECSV 1.0\n# ---\n# datatype:\n# - {{name: x, datatype: string}}\n"
        f"# meta: !!python/object/apply:urllib.request.urlopen ['{address}']\nx\n1\n",
        "f.reg": f"image\ncircle(1,2,3) # text={{{address}}}\n# {address}\n",
        "g.json": f'{{"href": "{address}"}}',
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        with suppress(Error):
            read_catalogue(tmp_path / name)
    cards = {"BPMASK": f"{address}m.fits", "INHERIT": True, "XTENSION": address[:60]}
    fits.writeto(tmp_path / "i.fits", fits.getdata(good / TILES), fits.Header(cards.items()))
    for words in (
        ["predict", address, "--out", "o.fits"],
        ["predict", tmp_path / "i.fits", "--catalogue", address, "--out", "o.fits"],
        ["predict", tmp_path / "i.fits", "--catalogue", good / LIST, "--mask", address],
        ["predict", good / CUBE, "--model", address, "--out", "o.fits"],
        ["psf", address, "--grid", "3x3", "--out", "o.fits"],
        ["describe", address],
        ["wavefront", good / CUBE, "--telescope", address, "--out", "o.csv"],
    ):
        psfdae(*words)
    psfdae("predict", tmp_path / "i.fits", "--catalogue", good / LIST, "--pixel-scale", 1)
    assert requests == []


# Time.

DS9 = "# Region file format: DS9\nimage\n"
XML = '<?xml version="1.0"?><VOTABLE version="1.3"><RESOURCE><TABLE>'
LONG = {
    "dashes": ("x y\na b\n{}x\n1 2\n", "-"),
    "blanks before a bracket": (DS9 + "circle{})\n", " "),
    "blanks and commas": (DS9 + "circle{})\n", " 1,"),
    "commas": (DS9 + "circle(1{})\n", ","),
    "open texts": (DS9 + "circle(1,2,3) # {}\n", "text={"),
    "open texts with blanks": (DS9 + "circle(1,2,3) # {}\n", "text = ' "),
    "tags without an end": (XML + "{}", "<STREAM "),
    "elements": (XML + "{}</TABLE></RESOURCE></VOTABLE>", "<STREAM a='>'/>"),
    "fields of one name": (XML + "{}", "<FIELD ID='x' name='x' datatype='int'/>"),
    "columns of one name": ("{}\n1\n", "x "),
    "columns of one name in IPAC": ("{}|\n{}|\n1\n", "|i"),
    "letters of a name": ("{}\n1\n", "x"),
    "digits of a name": ("# x y\n{}\n1\n", "1e"),
    "digits": ("ra,dec\n{}:00:00,+10:00:00\n", "1"),
    "comments": ("{}x y\n1 2\n", "# 1 \n"),
    "comments above rows": ("{}1 2\n", "# 1 2\n"),
    "rows": ("x y\n{}", "1 2\n"),
    "identifiers": ("id,x,y\n{}", "01,1,2\n"),
}


def count_steps(function):
    """Lines of Python that a function executes, those of libraries and of its loops included."""
    count = 0

    def trace(frame, event, argument):
        nonlocal count
        count += 1
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        function()
    finally:
        sys.settrace(before)
    return count


@pytest.mark.parametrize("kind", LONG)
def test_the_work_on_a_list_grows_with_its_length(tmp_path, kind):
    """Ten times the length takes ten times the steps, up to a factor of three; its square, 100.

    Steps within regular expressions are not counted: their repeated parts give nothing back, or the
    readers bound the length of their texts. The alarm only ends a test that hangs.
    """
    form, unit = LONG[kind]

    def work(size):
        path = tmp_path / "list"
        path.write_text(form.format(*[unit * (size // len(unit))] * form.count("{}")))
        path = path.rename(tmp_path / "list.reg") if form.startswith(DS9) else path
        with suppress(Error):
            catalogue = read_catalogue(path)
            places = catalogue.positions()
            catalogue.identifiers()
            catalogue.sky(places) if places.sky else catalogue.pixels(places.first)

    work(2_000)  # imports
    signal.alarm(600)
    try:
        steps = [count_steps(partial(work, size)) for size in (20_000, 200_000)]
    finally:
        signal.alarm(0)
    assert steps[0] > 50
    assert steps[1] < 30 * steps[0]


@pytest.mark.parametrize(
    ("table", "field"),
    [
        ("nrows='1000000000'", ""),
        ("", "<FIELD name='z' datatype='double' arraysize='100000000'/>"),
        ("nrows='100000'", "<FIELD name='z' datatype='int' arraysize='30x400'/>"),
        ("", "<FIELD name='z' datatype='char' arraysize='100000000*'/>"),
    ],
)
def test_a_votable_gets_no_more_memory_than_its_size_allows(tmp_path, table, field):
    head = XML.replace("<TABLE>", f"<TABLE {table}>")
    fields = "".join(f'<FIELD name="{axis}" datatype="double"/>' for axis in "xy") + field
    cells = "<TR><TD>1</TD><TD>2</TD></TR>" * 3
    data = f"<DATA><TABLEDATA>{cells}</TABLEDATA></DATA></TABLE></RESOURCE></VOTABLE>"
    (tmp_path / "s.vot").write_text(head + fields + data)
    with pytest.raises(ObservationError, match=r"damaged: \d columns, \d+ rows"):
        read_catalogue(tmp_path / "s.vot")


def test_rows_of_parquet_that_are_equal_get_no_more_memory_than_its_size_allows(
    tmp_path, monkeypatch
):
    Table({"x": np.ones(10**5), "y": np.ones(10**5)}).to_pandas().to_parquet(tmp_path / "s")
    assert len(read_catalogue(tmp_path / "s")) == 10**5
    monkeypatch.setattr(list_formats, "compute_unpacked_max", lambda packed_bytes: 10**6)
    with pytest.raises(ObservationError, match="unpacks to 1600000 bytes"):
        read_catalogue(tmp_path / "s")


# Pixels in tables.


def test_a_target_pixel_file_is_named(tmp_path):
    """The only image of Kepler's and TESS's files is the aperture; the star is in a table."""
    flux = fits.Column("FLUX", "20E", dim="(5, 4)", array=np.zeros((3, 4, 5), "f4"))
    pixels = fits.BinTableHDU.from_columns([flux], name="PIXELS")
    aperture = fits.ImageHDU(np.ones((4, 5), np.int32), name="APERTURE")
    path = tmp_path / "tpf.fits"
    fits.HDUList([fits.PrimaryHDU(), pixels, aperture]).writeto(path)
    assert "target pixel file" in refused("predict", path, "--out", tmp_path / "o.fits")
    assert images.find_image(path, "APERTURE").shape == (4, 5)


# Results.


def test_results_never_take_the_place_of_what_they_are_made_of(good, tmp_path):
    for name in (CUBE, LIST, MODEL):
        shutil.copy(good / name, tmp_path / name)
    cube, field, model = (tmp_path / name for name in (CUBE, LIST, MODEL))
    bytes_before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for words in (
        ["predict", cube, "--model", model, "--out", model, "--overwrite"],
        ["predict", cube, "--mask", cube, "--out", cube, "--overwrite"],
        ["train", cube, "--catalogue", field, "--pixel-scale", 1, "--report", field],
    ):
        out = [] if "--out" in words else ["--out", tmp_path / "model"]
        assert "is an input, too" in refused(*words, *out)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == bytes_before
