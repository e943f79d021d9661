"""The comparison with other packages: faint copies of an image's stars, and errors on them."""

import numpy as np
import pandas as pd
import pytest
from astropy.io import fits

import real_sky
from psfdae.own_stars.bundle import shipped_path

SIDE, SIGMA, SKY = 10, 1.4, 300.0


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder with faint copies of twelve Gaussian stars whose places are known."""
    folder, rng = tmp_path_factory.mktemp("sky"), np.random.default_rng(2)
    x, y = np.meshgrid(np.arange(20.0, 120, 30), np.arange(25.0, 100, 30))
    x, y = (axis.ravel() + rng.uniform(-0.4, 0.4, axis.size) for axis in (x, y))
    rows, columns = np.mgrid[:110, :130]
    r2 = (rows - y[:, None, None]) ** 2 + (columns - x[:, None, None]) ** 2
    image = SKY + 1e5 * np.exp(-0.5 * r2 / SIGMA**2).sum(axis=0)
    fits.writeto(folder / "sky.fits", image + rng.normal(0, 3.0, image.shape))
    part = np.where(np.arange(x.size) < 8, "held out", "training")
    pd.DataFrame({"x": x, "y": y, "part": part}).to_csv(folder / "selection.csv", index=False)
    out = folder / "faint.npz"
    real_sky.faint(folder / "sky.fits", folder / "selection.csv", out, SIDE, 40, 1)
    return folder


def test_copies_have_the_snr_that_is_said(made):
    copies = np.load(made / "faint.npz")
    assert copies["truth"].sum(axis=(1, 2)) == pytest.approx(1.0)
    assert np.bincount(copies["idx"]).tolist() == [40] * 8
    width = np.sqrt(np.square(copies["truth"]).sum(axis=(1, 2)))
    for snr in real_sky.SNR:
        noise = copies[f"noisy{snr}"] / real_sky.FLUX - copies["truth"]
        # Of a matched filter, the star's own noise included.
        rms = np.hypot(noise.std(), copies["own"].mean())
        assert np.mean(width) / rms == pytest.approx(snr, rel=0.03)


def test_frames_are_moved_by_a_pixel_at_most(made):
    copies = np.load(made / "faint.npz")
    peak = copies["truth"].reshape(-1, SIDE**2).argmax(axis=1)
    off = np.stack(np.unravel_index(peak, (SIDE, SIDE)), axis=1) - SIDE // 2
    assert set(np.unique(off)) == {-1, 0, 1}


def test_errors_of_a_package_are_those_of_its_file(made, monkeypatch):
    copies = np.load(made / "faint.npz")
    fluxes = np.full(len(copies["idx"]), 1.02 * real_sky.FLUX)
    right = {f"est{s}": 3.0 * copies["truth"] for s in real_sky.SNR}
    wrong = {f"est{s}": copies["truth"] + 1e-3 * np.eye(SIDE) for s in real_sky.SNR}
    for name, psfs in (("right", right), ("wrong", wrong)):
        found = {f"flux{s}": fluxes for s in real_sky.SNR}
        np.savez(made / f"{name}.npz", **psfs, **found)

    class Bundle:
        def predict(self, stamps, position):
            psf = np.where(np.arange(len(stamps))[:, None, None] == 0, np.nan, copies["truth"])
            return type("Found", (), {"psf": psf, "flux": fluxes})()

    monkeypatch.setattr("psfdae.own_stars.model.load_model", lambda path: Bundle())
    others = tuple(f"{name}={made / name}.npz" for name in ("right", "wrong"))
    real_sky.compare(made / "faint.npz", shipped_path(), others, made / "table.csv")
    table = pd.read_csv(made / "table.csv").set_index(["package", "snr"]).sort_index()
    assert (table.loc["right"].mse < 1e-12).all() and (table.best == "right").all()
    psf = (copies["truth"] + 1e-3 * np.eye(SIDE)) / (1.0 + 1e-3 * SIDE)
    expected = np.square(psf - copies["truth"]).mean()
    assert table.loc[("wrong", 5), "mse"] == pytest.approx(expected, rel=1e-4)
    assert table.flux_bias.to_numpy() == pytest.approx(0.02)
    # A copy without a PSF counts as an image of 0, of 320.
    lost = np.square(copies["truth"][0]).mean() / 320
    assert table.loc[("psfdae", 50), "mse"] == pytest.approx(lost, rel=1e-3)
