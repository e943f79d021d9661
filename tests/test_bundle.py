"""The file format of model bundles: what is written is read, all else is refused in one line."""

from __future__ import annotations

import json
import os
import pickle
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save_file

from psfdae.bundle_info import Architecture, BundleInfo
from psfdae.cli import main
from psfdae.mixture_law import MixtureLaw
from psfdae.model import packing
from psfdae.model.bundle import (
    Bundle,
    BundleError,
    creation_date,
    estimator,
    read_bundle,
    write_bundle,
)
from psfdae.model.photometry import FluxModel, robust_flux
from psfdae.model.psf_model import PsfModel
from psfdae.networks.dae import build_dae, predict

SHAPE = Architecture(kernels=(5, 3, 5), widths=(4, 4))
INFO = {
    "psfdae_version": "0.1.0",
    "name": "handmade",
    "licence": "MIT",
    "created": "2026-01-31",
    "stamp_px": 16,
    "pixel_scale_arcsec": 1.5,
    "pixel_lambda_d": None,
    "image_scale": 256.0,
    "jitter_px": 1,
    "subpixel": True,
    "noise_min": 1e-3,
    "noise_max": 1e-2,
    "snr_min": 10.0,
    "snr_max": 100.0,
    "noise_equivalent_px": 100.0,
    "components": packing.COMPONENTS,
    "training_sha256": 64 * "0",
    "training_stars": 300,
    "source": "stars",
    "dae": SHAPE,
    "config": {"seed": 3, "stars": {"telescope": {"pixel_scale_arcsec": 1.5}}},
    "metrics": [{"noise_level": 1e-3, "mse": 1e-6, "mse_noisy": 1e-5}],
}


@pytest.fixture(scope="module")
def model():
    return build_dae(SHAPE.kernels, SHAPE.widths, "he", torch.Generator().manual_seed(1))


@pytest.fixture(scope="module")
def handmade(model, gaussian_stars):
    """A bundle of a network with random weights."""
    rng = np.random.default_rng(2)
    return Bundle(
        info=BundleInfo(**INFO),
        weights={name: value.numpy() for name, value in model.state_dict().items()},
        flux_model=packing.leading(FluxModel.fit(gaussian_stars), packing.COMPONENTS),
        noise_nodes=np.geomspace(1e-3, 1e-2, 3),
        error68=rng.random((3, 16, 16), np.float32),
        rms=rng.random((3, 16, 16), np.float32),
        distance_limit=9.5,
        ratio95=np.full(3, 1.9),
    )


@pytest.fixture(scope="module")
def file(handmade, tmp_path_factory):
    """The bundle as a file."""
    path = tmp_path_factory.mktemp("bundle") / "handmade.psf.safetensors"
    write_bundle(handmade, path)
    return path


def refused(path):
    """The one line with which a file is refused."""
    with pytest.raises(BundleError) as caught:
        read_bundle(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def header_of(raw):
    """Length and parsed header of a safetensors file."""
    (length,) = struct.unpack("<Q", raw[:8])
    return length, json.loads(raw[8 : 8 + length])


def with_text(raw, change):
    """The same file with a changed description."""
    length, header = header_of(raw)
    text = json.loads(header["__metadata__"]["bundle"])
    change(text)
    header["__metadata__"]["bundle"] = json.dumps(text, sort_keys=True)
    new = json.dumps(header).encode()
    return struct.pack("<Q", len(new)) + new + raw[8 + length :]


def test_what_was_written_is_read(handmade, file):
    again = read_bundle(file)
    assert again.info == handmade.info
    assert again.sha256 == handmade.sha256
    assert again.distance_limit == handmade.distance_limit
    for name, values in handmade.weights.items():
        assert (again.weights[name] == values).all()
    for name in ("noise_nodes", "error68", "rms"):
        assert (getattr(again, name) == getattr(handmade, name)).all()


def test_what_was_read_is_written_with_the_same_bytes(file, tmp_path):
    path = tmp_path / "again.psf.safetensors"
    for _ in range(8):
        write_bundle(read_bundle(file), path)
        assert path.read_bytes() == file.read_bytes()


def test_others_may_read_a_bundle(handmade, tmp_path):
    path = tmp_path / "x.psf.safetensors"
    write_bundle(handmade, path)
    mask = os.umask(0)
    os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~mask


@pytest.mark.parametrize("content", [b"", b"\x00" * 8, b"\xff" * 40, b"{}", b"SIMPLE  =" * 50])
def test_no_bundle_at_all_is_named(tmp_path, content):
    path = tmp_path / "x.psf.safetensors"
    path.write_bytes(content)
    refused(path)


def test_missing_file_and_folder_are_named(tmp_path):
    assert refused(tmp_path / "none.psf.safetensors").endswith(": no such file")
    refused(tmp_path)


def test_reading_executes_nothing(tmp_path):
    class Attack:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "executed",))

    path = tmp_path / "x.psf.safetensors"
    path.write_bytes(pickle.dumps(Attack()))
    refused(path)
    torch.save({"x": Attack()}, path)
    refused(path)
    assert not (tmp_path / "executed").exists()


def test_newer_format_is_refused_with_both_versions(file, tmp_path):
    raw = file.read_bytes()
    path = tmp_path / "new.psf.safetensors"
    path.write_bytes(with_text(raw, lambda text: text.update(format_version=7, info="other")))
    assert "format 7, but psfdae 0.1.0 reads up to format 3" in refused(path)
    result = CliRunner().invoke(main, ["describe", str(path)])
    assert result.exit_code == 2
    assert result.output.startswith(f"psfdae: {path}: format 7")


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text["info"].update(pixel_scale_arcsec=0.2),
        lambda text: text["info"].pop("stamp_px"),
        lambda text: text.update(info=None),
        lambda text: text.update(kind="another"),
        lambda text: text.update(format_version=0),
        lambda text: text.update(format_version=1),
        lambda text: text.update(format_version="3"),
        lambda text: text["info"].update(created="soon"),
    ],
)
def test_changed_description_is_refused(file, tmp_path, change):
    path = tmp_path / "x.psf.safetensors"
    path.write_bytes(with_text(file.read_bytes(), change))
    refused(path)


@pytest.mark.parametrize(
    "change",
    [
        {"error68": np.zeros((2, 16, 16))},
        {"noise_nodes": np.arange(3.0)},
        {"noise_nodes": np.arange(3.0, 0.0, -1.0)},
        {"distance_limit": np.nan},
        {"weights": {}},
    ],
)
def test_arrays_that_do_not_fit_are_not_written(handmade, tmp_path, change):
    path = tmp_path / "x.psf.safetensors"
    with pytest.raises(BundleError, match=r"x\.psf\.safetensors: "):
        write_bundle(replace(handmade, **change), path)
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=500, deadline=None)
@given(data=st.data())
def test_any_damage_is_a_line_that_names_the_file(file, handmade, data):
    """Flipped, lost or inserted bytes: refused, or nothing but the date has changed."""
    raw = file.read_bytes()
    length, _ = header_of(raw)
    # Half of the damage in the header, which is a small part of the file.
    place = data.draw(st.integers(0, length + 8) | st.integers(0, len(raw) - 1))
    kind = data.draw(st.sampled_from(["flip", "cut", "lose", "insert"]))
    some = data.draw(st.binary(min_size=1, max_size=12))
    damaged = {
        "flip": raw[:place] + bytes([raw[place] ^ (some[0] or 1)]) + raw[place + 1 :],
        "cut": raw[:place],
        "lose": raw[:place] + raw[place + len(some) :],
        "insert": raw[:place] + some + raw[place:],
    }[kind]
    path = file.parent / "damaged.psf.safetensors"
    path.write_bytes(damaged)
    try:
        found = read_bundle(path)
    except BundleError as error:
        assert str(error).startswith(f"{path}: ")
        assert "\n" not in str(error)
    else:
        assert found.sha256 == handmade.sha256
        assert found.info == handmade.info.model_copy(update={"created": found.info.created})


def test_date_is_in_the_file_but_not_in_the_checksum(handmade, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert creation_date() == "1970-01-02"
    dated = replace(handmade, info=handmade.info.model_copy(update={"created": creation_date()}))
    assert dated.sha256 == handmade.sha256
    named = replace(handmade, info=handmade.info.model_copy(update={"name": "another"}))
    assert named.sha256 != handmade.sha256


def test_a_wrong_source_date_epoch_is_named(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    with pytest.raises(BundleError, match="SOURCE_DATE_EPOCH = 'yesterday'"):
        creation_date()


def test_network_of_a_bundle_is_the_one_that_was_packed(file, model, gaussian_stars):
    found = estimator(read_bundle(file)).predict(gaussian_stars)
    assert (found == predict(model, gaussian_stars, 256.0)).all()


def test_completed_covariance_measures_fluxes_as_the_whole_one(file, gaussian_stars):
    whole, model = FluxModel.fit(gaussian_stars), read_bundle(file).flux_model
    assert model.variance.sum() == pytest.approx(whole.variance.sum(), rel=1e-9)
    assert model.basis.T @ model.basis == pytest.approx(np.eye(256), abs=1e-6)
    noisy = 1e4 * gaussian_stars + np.random.default_rng(10).normal(0, 50, gaussian_stars.shape)
    first, second = (robust_flux(noisy, m).flux for m in (whole, model))
    assert second == pytest.approx(first, rel=1e-4)


def test_a_bundle_of_format_2_predicts_as_it_did(monkeypatch):
    """It and its predictions were written by the code that made it, which rounded the noise.

    Without rounding, PSFs change by far less than they are uncertain.
    """
    folder = Path(__file__).parent / "data"
    model, before = (
        PsfModel(read_bundle(folder / "format2.psf.safetensors")),
        np.load(folder / "format2.npz"),
    )
    assert model.info.format_version == 2 and model.bundle.widening is not None
    sky, known = {"background": 100.0}, {"flux": 1e4, "background": 100.0, "noise": 40.0}
    cases, parts = {"free": {}, "sky": sky, "known": known}, MixtureLaw._parts
    for case, told in cases.items():
        off = model.predict(before["stamps"], **told).psf - before[f"{case}_psf"]
        assert np.nanmean(np.square(off / before[f"{case}_uncertainty"])) < 0.02

    def rounded(*given):
        for part, seen in parts(*given):
            s = seen.node[:, None].astype(np.float32)
            yield part, seen._replace(s=s, least=float(seen.node.min()))

    monkeypatch.setattr(MixtureLaw, "_parts", rounded)
    monkeypatch.setattr("psfdae.mixture_law.NOISE_BIN", 1e-6)
    monkeypatch.setattr("psfdae.mixture_law.LEAST_VARIANCE", 0.0)
    for case, told in cases.items():
        found = model.predict(before["stamps"], **told)
        for name in ("psf", "uncertainty", "ratio95", "flux", "flux_error"):
            expected = before[f"{case}_{name}"]
            np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-4, atol=1e-2)
        np.testing.assert_array_equal(found.ratio95_bright, found.ratio95)


def test_arrays_of_another_program_are_no_bundle(tmp_path):
    path = tmp_path / "weights.safetensors"
    save_file({"a": np.zeros(3)}, path)
    assert "not a psfdae model bundle" in refused(path)
