"""The comparison at the places of simulated stars: the image, packages' files and the fit."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from astropy.io import fits

import simulated_sky
from psfdae.model.bundle import shipped_path
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.configuration.consistency import SIMULATION

COUNT, SIDE, WIDTH = 9, 16, 1.6


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder with an image of scene 1, whose first six stars are held out."""
    folder = tmp_path_factory.mktemp("sky")
    config = load_stage(SIMULATION, ("dataset=field", "stars.aberration_fraction=0"))
    files = [folder / name for name in ("sky.fits", "sky.csv", "truth.npz")]
    simulated_sky.field(config, *files, stars=COUNT)
    listed = pd.read_csv(files[1])
    part = np.where(np.arange(COUNT) < 6, "held out", "training")
    rows = pd.DataFrame({"x": listed.X_IMAGE - 1, "y": listed.Y_IMAGE - 1, "part": part})
    rows.to_csv(folder / "selection.csv", index=False)
    return folder


def gaussian(centre, step=1.0, side=SIDE, width=WIDTH):
    """Images (n, d, d) with the star at `centre` (n, 2) (row, column) from pixel d//2."""
    axis = step * (np.arange(side) - side // 2)
    rows, columns = (np.exp(-0.5 * ((axis - c[:, None]) / width) ** 2) for c in centre.T)
    return rows[:, :, None] * columns[:, None, :]


def test_the_image_holds_the_stars_of_the_list(made):
    truth, listed = np.load(made / "truth.npz"), pd.read_csv(made / "selection.csv")
    image = fits.getdata(made / "sky.fits").astype(float)
    light = truth["psf"].sum(axis=(1, 2))
    assert (light > 0.5).all() and (light < 1.0).all()
    half = simulated_sky.SIDE // 2
    for psf, (x, y), (at_x, at_y) in zip(
        truth["psf"], truth["pixel"], listed[["x", "y"]].to_numpy(), strict=True
    ):
        stamp = image[y - half : y + half, x - half : x + half] - simulated_sky.SKY
        flux = (stamp * psf).sum() / np.square(psf).sum()
        left = (stamp - flux * psf) / np.sqrt(simulated_sky.SKY + flux * psf)
        assert left.std() == pytest.approx(1.0, abs=0.1)  # photon noise and no more
        row, column = np.unravel_index(psf.argmax(), psf.shape)
        assert np.hypot(x - half + column - at_x, y - half + row - at_y) < simulated_sky.NEAR_PX


def test_centre_flux_and_sky_of_any_star_are_found():
    rng = np.random.default_rng(1)
    centre = rng.uniform(-1.6, 1.6, (8, 2))
    stamps = 50.0 * gaussian(centre) + 7.0
    found = simulated_sky._fitted(gaussian, stamps)
    right = gaussian(centre) / gaussian(centre).sum(axis=(1, 2), keepdims=True)
    assert found == pytest.approx(right, abs=1e-6)


def test_other_packages_are_read_and_drawn(tmp_path):
    """Oversampled images, and a polynomial as PSFEx writes it: x varies fastest."""
    place, centre = np.array([[10.0, 30.0], [50.0, 20.0]]), np.array([[0.3, -0.4], [0.0, 0.6]])
    fine = gaussian(np.zeros((2, 2)), 0.25, 121)
    np.savez(tmp_path / "fine.npz", psf=fine, oversampling=4)
    drawn = simulated_sky._sampled(tmp_path / "fine.npz", place, SIDE)(centre)
    assert drawn == pytest.approx(gaussian(centre), abs=2e-3)

    x, y = ((place + 1.0 - 20.0) / 40.0).T
    terms = np.array([0.7, 0.2, 0.1, -0.3, 0.05, 0.4])  # 1, x, x², y, xy, y²
    masks = terms[:, None, None] * gaussian(np.zeros((1, 2)), 0.5, 61)
    column = fits.Column("PSF_MASK", f"{masks.size}E", dim="(61, 61, 6)", array=masks[None])
    table = fits.BinTableHDU.from_columns([column], name="PSF_DATA")
    cards = {f"POL{k}{i}": v for i in (1, 2) for k, v in (("ZERO", 20.0), ("SCAL", 40.0))}
    table.header.update(cards | {"POLDEG1": 2, "PSF_SAMP": 0.5})
    table.writeto(tmp_path / "two.psf")
    drawn = simulated_sky._sampled(tmp_path / "two.psf", place, SIDE)(centre)
    factor = np.stack([x**0, x, x**2, y, x * y, y**2], axis=1) @ terms
    assert drawn == pytest.approx(factor[:, None, None] * gaussian(centre), abs=2e-3)


def test_stars_are_compared_with_their_own_images(made, monkeypatch):
    """What is left of a star without its sky errs by its noise, and by what is added to it."""

    class Field:
        def terms(self, position):
            return position

        def images(self, terms, centre, side):
            return np.zeros((side, side))

    def fitted(draw, stamps):
        star = stamps - simulated_sky.SKY
        return star / star.sum(axis=(1, 2), keepdims=True) + draw(None)

    model = SimpleNamespace(
        info=SimpleNamespace(stamp_px=SIDE),
        engine=SimpleNamespace(estimator=SimpleNamespace(model=Field())),
    )
    monkeypatch.setattr("psfdae.model.psf_model.load_model", lambda path: model)
    monkeypatch.setattr(simulated_sky, "_fitted", fitted)
    monkeypatch.setattr(simulated_sky, "_sampled", lambda *args: lambda _: 0.01 * np.eye(SIDE))
    files = [made / name for name in ("sky.fits", "truth.npz", "selection.csv")]
    out = made / "table.csv"
    simulated_sky.places(*files, shipped_path(), ("wrong=wrong.npz",), out)
    table = pd.read_csv(out).set_index("package")
    assert table.stars.tolist() == [6, 6] and table.learnt.tolist() == [3, 3]
    assert table.mse["psfdae"] < 2e-6
    assert table.mse["wrong"] == pytest.approx(1e-4 / SIDE, rel=0.2)
    assert table.over["wrong"] == pytest.approx(table.mse["psfdae"] / table.mse["wrong"], rel=1e-4)
    assert table.over["psfdae"] == 1.0 and table.over_stderr["psfdae"] == 0.0
