"""The file format of model bundles: what is written is read, all else is refused in one line."""

from __future__ import annotations

import json
import os
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.numpy import save

import command_line
from psfdae.denoise.bundle import (
    BundleError,
    creation_date,
    estimator,
    read_bundle,
    write_bundle,
)
from psfdae.denoise.flux_model import FluxModel, robust_flux
from psfdae.methods.bundle_info import FORMAT_VERSION
from psfdae.methods.networks.dae import build_dae, run_network
from psfdae.training import packing


@pytest.fixture(scope="module")
def handmade(network):
    """A bundle of a network with random weights."""
    return network.bundle


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


def with_text(raw, change):
    """The same file with a changed description."""
    (length,) = struct.unpack("<Q", raw[:8])
    header = json.loads(raw[8 : 8 + length])
    text = json.loads(header["__metadata__"]["bundle"])
    change(text)
    header["__metadata__"]["bundle"] = json.dumps(text, sort_keys=True)
    new = json.dumps(header).encode()
    return struct.pack("<Q", len(new)) + new + raw[8 + length :]


def test_what_was_written_is_read_and_written_again_with_the_same_bytes(handmade, file, tmp_path):
    copy = read_bundle(file)
    assert copy.info == handmade.info
    assert copy.sha256 == handmade.sha256
    assert copy.errors.distance_limit == handmade.errors.distance_limit
    for name, values in handmade.weights.items():
        assert (copy.weights[name] == values).all()
    tables = handmade.errors.arrays()
    assert all((table == tables[name]).all() for name, table in copy.errors.arrays().items())
    path, mask = tmp_path / "again.psf.safetensors", os.umask(0)
    os.umask(mask)
    write_bundle(copy, path)
    assert path.read_bytes() == file.read_bytes()
    assert path.stat().st_mode & 0o777 == 0o666 & ~mask  # others may read it


@pytest.mark.parametrize(
    "content",
    [
        lambda whole: b"",
        lambda whole: save({"a": np.zeros(3)}),
        lambda whole: whole[:-9],
        lambda whole: whole[:-1] + bytes([whole[-1] ^ 1]),
    ],
)
def test_what_is_no_whole_bundle_is_refused(file, tmp_path, content):
    path = tmp_path / "x.psf.safetensors"
    path.write_bytes(content(file.read_bytes()))
    refused(path)
    path.unlink()
    refused(path)


def test_newer_format_is_refused_with_both_versions(file, tmp_path):
    path = tmp_path / "new.psf.safetensors"
    newer = with_text(file.read_bytes(), lambda text: text.update(format_version=7, info="other"))
    path.write_bytes(newer)
    line = command_line.refused("describe", path)
    assert f"{path}: format 7" in line and f"format {FORMAT_VERSION}" in line


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text["info"].update(pixel_scale_arcsec=0.2),
        lambda text: text["info"].pop("stamp_px"),
        lambda text: text.update(kind="another"),
    ],
)
def test_changed_description_is_refused(file, tmp_path, change):
    path = tmp_path / "x.psf.safetensors"
    path.write_bytes(with_text(file.read_bytes(), change))
    refused(path)


@pytest.mark.parametrize(
    "change",
    [
        {"half_width68": np.zeros((2, 16, 16))},
        {"noise": np.arange(8.0, 0.0, -1.0)},
        {"distance_limit": np.nan},
    ],
)
def test_arrays_that_do_not_fit_are_not_written(handmade, tmp_path, change):
    path = tmp_path / "x.psf.safetensors"
    with pytest.raises(BundleError, match=r"x\.psf\.safetensors: "):
        write_bundle(replace(handmade, errors=replace(handmade.errors, **change)), path)
    assert list(tmp_path.iterdir()) == []


def test_date_is_in_the_file_but_not_in_the_checksum(handmade, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert creation_date() == "1970-01-02"
    dated = replace(handmade, info=handmade.info.model_copy(update={"created": creation_date()}))
    assert dated.sha256 == handmade.sha256
    named = replace(handmade, info=handmade.info.model_copy(update={"name": "another"}))
    assert named.sha256 != handmade.sha256
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    with pytest.raises(BundleError, match="SOURCE_DATE_EPOCH = 'yesterday'"):
        creation_date()


def test_network_of_a_bundle_is_the_one_that_was_packed(file, handmade, gaussian_stars):
    shape = handmade.info.dae
    model = build_dae(shape.kernels, shape.widths, "he", torch.Generator().manual_seed(1))
    estimate = estimator(read_bundle(file)).predict(gaussian_stars)
    assert (estimate == run_network(model, gaussian_stars, 256.0)).all()


def test_completed_covariance_measures_fluxes_as_the_whole_one(gaussian_stars):
    full_basis = FluxModel.fit(gaussian_stars)
    model = packing.leading(full_basis, 48)
    assert model.variance.sum() == pytest.approx(full_basis.variance.sum(), rel=1e-9)
    np.testing.assert_allclose(model.basis.T @ model.basis, np.eye(256), atol=1e-6)
    noisy = 1e4 * gaussian_stars + np.random.default_rng(10).normal(0, 50, gaussian_stars.shape)
    first, second = (robust_flux(noisy, m).flux for m in (full_basis, model))
    assert second == pytest.approx(first, rel=1e-4)
