"""A night of a telescope: the simulated example, and the tables and pages made of many images."""

import numpy as np
import pytest
from astropy.io import fits

from psfdae.base.reading import read_table
from psfdae_paper.stages.simulate import example_night


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Twelve exposures of a night, bad ones among them."""
    out = tmp_path_factory.mktemp("night")
    example_night(out, seed=3, exposures=12)
    return out


def test_same_seed_gives_the_same_night(folder, tmp_path):
    example_night(tmp_path, seed=3, exposures=12)
    for path in sorted(folder.glob("*.fits")):
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()


def test_truth_of_a_night_names_what_is_wrong(folder):
    """The seeing grows with the airmass, and each of five faults is that of one image."""
    truth = read_table(folder / "truth.csv", "image", "fault", "true_fwhm_px_centre")
    assert sorted(truth.fault.dropna()) == [
        *("clouds", "clouds", "no stars", "trailed", "truncated file")
    ]
    # The aberrations of the example grow towards the corners.
    assert (truth.true_fwhm_px_lower_left > truth.true_fwhm_px_centre).all()
    intact = truth[truth.fault.isna()].image
    headers = [fits.getheader(path) for path in intact]
    assert np.ptp([header["AIRMASS"] for header in headers]) > 0.3
    assert len({header["DATE-OBS"] for header in headers}) == len(headers)
    with pytest.raises(TypeError, match=r"truncated|buffer"):
        fits.getdata(truth[truth.fault == "truncated file"].image.iloc[0])
