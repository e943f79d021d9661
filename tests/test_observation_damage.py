"""Whatever is wrong with a file: it reads, or one line says what and where. Nothing else."""

from __future__ import annotations

import contextlib
import threading
import warnings

import numpy as np
import pytest
from astropy import log
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fits_inputs import GOOD, open_observation, write_cube, write_good
from psfdae.image.errors import ObservationError, reading

D = 16
HEADERS = 8640  # bytes at the start of the files here that hold their headers and some data


def examples(count):
    return settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Cubes, images and catalogues of every kind, all of them good."""
    folder = tmp_path_factory.mktemp("good")
    write_good(folder)
    return folder


FILES = [(kind, name) for kind in ("cube", "image", "catalogue") for name in GOOD[kind]]


def attempt(path, **options):
    """Read a file as a user would; whether it could be read."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            found = open_observation(path, D, **options)
            chunks = list(found.chunks(7))
        except ObservationError as error:
            text = str(error)
            assert "\n" not in text and text.isprintable() and len(text) < 2000
            named = (path, options.get("catalogue"), options.get("mask"))
            assert any(name is not None and text.startswith(f"{name}: ") for name in named)
            return False
    assert sum(len(chunk) for chunk in chunks) == found.count
    for chunk in chunks:
        assert chunk.data.dtype == np.float32 and np.isfinite(chunk.data).all()
        assert chunk.data.shape == chunk.bad.shape == chunk.saturated.shape
        assert chunk.id.shape == chunk.x.shape == chunk.y.shape == chunk.flags.shape
    return True


def attempt_all(folder, data, kind):
    """The bytes as a cube, as an image or as a catalogue."""
    path = folder / f"bad_{kind}"
    path.write_bytes(data)
    if kind == "cube":
        return attempt(path)
    if kind == "image":
        return attempt(path, catalogue=folder / ("sky.csv", "s.csv")[len(data) % 2], margin=1)
    return attempt(folder / "image.fits", catalogue=path)


def test_the_good_files_are_read(folder):
    for kind, name in FILES:
        good = attempt_all(folder, (folder / name).read_bytes(), kind)
        assert good or name.startswith("GZIP"), name  # no WCS for the sky coordinates


card_bytes = st.sampled_from(list(b"0123456789 'TFABX-.E/=,"))
damages = st.one_of(
    st.tuples(st.just("nothing of it"), st.sampled_from([b"", b"SIMPLE  =", b"# %ECSV 1.0\n"])),
    st.tuples(st.just("truncated"), st.floats(0, 1)),
    st.tuples(
        st.just("headers"), st.lists(st.tuples(st.floats(0, 1), card_bytes), min_size=1, max_size=6)
    ),
    st.tuples(st.just("replaced"), st.tuples(st.floats(0, 1), st.integers(0, 200))),
)


@examples(500)
@given(
    file=st.sampled_from(FILES),
    damage=damages,
    more=st.binary(max_size=99),
)
def test_any_damage_is_silent_and_one_line_at_most(folder, capfd, file, damage, more):
    (what, how), data = damage, bytearray((folder / file[1]).read_bytes())
    if what == "nothing of it":
        data = how + more
    elif what == "truncated":
        data = data[: int(how * len(data))]
    elif what == "headers":
        for place, byte in how:
            data[int(place * (min(HEADERS, len(data)) - 1))] = byte
    else:
        start = int(how[0] * len(data))
        data = data[:start] + more + data[start + how[1] :]
    read = attempt_all(folder, bytes(data), file[0])
    assert not (read and what == "nothing of it")
    assert capfd.readouterr() == ("", "")


cells = st.one_of(
    st.floats().map(repr),
    st.integers().map(str),
    st.sampled_from(["", "nan", "1e999", "10:20:30", "1h", '"', "'", "🔭", "1;2", "--", "#"]),
    st.text(max_size=8),
)
headers = st.sampled_from(
    ["X_IMAGE,Y_IMAGE", "ra,dec", "x,y", "X_IMAGE;Y_IMAGE", "# X_IMAGE Y_IMAGE", "a,b", "x,X", ""]
)


@examples(120)
@given(header=headers, rows=st.lists(st.lists(cells, max_size=3), max_size=5))
def test_catalogues_of_any_content(folder, capfd, header, rows):
    text = "\n".join([header, *(",".join(row) for row in rows)])
    path = folder / "bad.csv"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    attempt(folder / "image.fits", catalogue=path, origin=0)
    assert capfd.readouterr() == ("", "")


# Damage and misuse that have their own words.


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("nowhere.fits", None, "no such file"),
        ("empty.fits", b"", "the file is empty"),
        ("text.fits", b"hello", "not a FITS file"),
        ("", None, "a folder, not a file"),
    ],
)
def test_what_is_not_there_or_not_fits(tmp_path, folder, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ObservationError, match=f": {message}$"):
        open_observation(tmp_path / name, D)
    if not name.startswith("text"):
        message = "the catalogue is empty" if content == b"" else message
        with pytest.raises(ObservationError, match=f": {message}$"):
            open_observation(folder / "image.fits", D, catalogue=tmp_path / name)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((4, 7, 7), "stamps of 7×7 pixels, expected 8×8 pixels or larger"),
        ((4, 8, 9), "stamps of 8×9 pixels, expected 8×8 pixels"),
        ((30, 40), "an image of 30×40 pixels needs a star catalogue"),
        ((2, 3, 8, 8), "an image of 4 dimensions, expected 2 or 3"),
        ((64,), "an image of 1 dimensions, expected 2 or 3"),
        ((0, 8, 8), "no image"),
    ],
)
def test_wrong_dimensions_name_both_numbers(tmp_path, shape, message):
    fits.PrimaryHDU(np.zeros(shape, dtype=np.float32)).writeto(tmp_path / "a.fits")
    with pytest.raises(ObservationError, match=message):
        open_observation(tmp_path / "a.fits", 8)


def test_a_truncated_cube_is_refused_before_any_pixel(tmp_path, folder):
    data = (folder / "cube.fits").read_bytes()
    end = 2880 + 4 * 12 * D * D
    (tmp_path / "a.fits").write_bytes(data[: end - 10])
    with pytest.raises(ObservationError, match="truncated: the last 10 bytes are missing"):
        open_observation(tmp_path / "a.fits", D)
    (tmp_path / "b.fits").write_bytes(data[:end])  # only the padding of the last block is missing
    assert attempt(tmp_path / "b.fits")


def test_a_file_that_changes_after_opening_is_noticed(tmp_path, folder):
    path = tmp_path / "a.fits"
    path.write_bytes((folder / "cube.fits").read_bytes())
    found = open_observation(path, D)
    write_cube(path, np.zeros((3, D, D)))
    with pytest.raises(ObservationError, match="has changed"):
        list(found.chunks(10))
    path.unlink()
    with pytest.raises(ObservationError, match="no such file"):
        list(found.chunks(10))


@pytest.mark.parametrize(
    "option",
    [
        {"stamp_px": 0},
        {"margin": -1},
        {"origin": 2},
        {"pixel_scale_arcsec": 0.0},
        {"gain": float("nan")},
        {"saturate": -5.0},
    ],
)
def test_options_out_of_range(folder, option):
    with pytest.raises(ObservationError, match=r"cube\.fits: .*expected"):
        open_observation(folder / "cube.fits", **({"stamp_px": D} | option))


def test_threads_leave_warnings_and_log_as_they_were(tmp_path):
    before, level = list(warnings.filters), log.level
    inside = threading.Barrier(2, timeout=0.2)

    def read():
        # Never both inside: one would restore the other's filters.
        with reading(tmp_path), contextlib.suppress(threading.BrokenBarrierError):
            inside.wait()

    threads = [threading.Thread(target=read) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert inside.broken
    assert (list(warnings.filters), log.level) == (before, level)
