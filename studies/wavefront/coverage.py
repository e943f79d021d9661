"""Whether the errors of `psfdae.wavefront` are right: stars that POPPY simulates, and joint fits.

    python studies/wavefront/coverage.py stars OUT.csv
    python studies/wavefront/coverage.py joint OUT.csv

`stars`: 500 stars of the telescope example_zernike with coefficients drawn from its prior, at S/N
20 to 200, propagated by POPPY; flux, sky and centre are found. `joint`: 50 fields of 100 stars of
S/N 50 with the telescope's numbers drawn from the prior, propagated on a finer pupil grid. One
thread.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd

import psfdae
from psfdae.base.threads import limit_threads
from psfdae.sensing import stars as engine
from psfdae.sensing.joint import TelescopePosterior
from psfdae.telescope.field import build_terms, model_telescope

TELESCOPE = Path(__file__).parents[2] / "config" / "telescope" / "example_zernike.yaml"
STAMP_PX, SKY = 16, 1000.0
SNR = (20.0, 200.0)
FINE = (222, 254, 318, 398)
SAMPLES, OVERSAMPLING = 512, 4


def poppy_stamps(telescope, noll, coefficients, place):
    """Stamps (n, d, d) of light 1 by POPPY, of Zernike coefficients in waves and places in px."""
    import astropy.units as u
    import poppy

    logging.getLogger("poppy").setLevel(logging.ERROR)
    poppy.conf.double_precision = True
    radius_m = 0.5 * telescope.diameter_m

    class Wavefront(poppy.AnalyticOpticalElement):
        waves, tilt = np.zeros(len(noll)), np.zeros(2)

        def get_opd(self, wave):
            y, x = (axis / radius_m for axis in self.get_coordinates(wave))
            rho, theta = np.hypot(x, y), np.arctan2(y, x)
            inside = np.minimum(rho, 1.0)
            opd = self.tilt[0] * x + self.tilt[1] * y
            for j, value in zip(noll, self.waves, strict=True):
                opd = opd + value * poppy.zernike.zernike1(j, rho=inside, theta=theta)
            return np.nan_to_num(opd) * telescope.wavelength_m

        def get_transmission(self, wave):
            return np.ones(wave.shape)

    element = Wavefront(name="wavefront", planetype=poppy.poppy_core.PlaneType.pupil)
    radius = radius_m * u.m
    pupil = [
        poppy.CircularAperture(radius=radius),
        poppy.SecondaryObscuration(secondary_radius=telescope.obscuration * radius, n_supports=0),
        element,
    ]
    system = poppy.OpticalSystem(npix=SAMPLES, pupil_diameter=2 * radius, verbose=False)
    system.add_pupil(poppy.CompoundAnalyticOptic(pupil))
    system.add_detector(
        pixelscale=telescope.pixel_scale_arcsec, fov_pixels=STAMP_PX, oversample=OVERSAMPLING
    )
    out = []
    for waves, (x, y) in zip(coefficients, place, strict=True):
        element.waves = waves
        element.tilt = 0.5 * telescope.pixel * np.array([x, y])
        fine = system.calc_psf(wavelength=telescope.wavelength_m)[0].data
        # POPPY counts the phase the other way, which turns the image by 180 degrees.
        size = (STAMP_PX, OVERSAMPLING, STAMP_PX, OVERSAMPLING)
        out.append(fine[::-1, ::-1].reshape(size).sum(axis=(1, 3)))
    return np.array(out)


def noisy(images, snr, rng):
    """Counts of stars of so much S/N on a sky of `SKY` photons."""
    flux = snr * np.sqrt(SKY / (images**2).sum(axis=(1, 2)))
    return rng.poisson(flux[:, None, None] * images + SKY).astype(float)


def stamped(table):
    """The table with the commit and the day."""
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    )
    return table.assign(date=date.today().isoformat(), commit=commit.stdout.strip())


def stars(out, count=500):
    """Coverage of the intervals, pooled and of every coefficient."""
    telescope, rng = psfdae.read_telescope(TELESCOPE), np.random.default_rng(29)
    angle = rng.uniform(-1.0, 1.0, (count, 2)) * telescope.field_edge_deg
    terms = build_terms(telescope, angle)
    truth = terms.mean + terms.sd * rng.standard_normal(terms.mean.shape)
    noll = [int(name[1:]) for name in terms.names]
    place, snr = rng.uniform(-0.5, 0.5, (count, 2)), np.exp(rng.uniform(*np.log(SNR), count))
    images = poppy_stamps(telescope, noll, truth, place)
    counts = noisy(images, snr, rng)
    started = time.process_time()
    result = psfdae.wavefront(counts, telescope, field_deg=angle, gain=1.0, noise=SKY**0.5)
    result.interval()  # the draws are made when they are needed
    took = time.process_time() - started
    rows = []
    for probability in (0.6827, 0.9545):
        low, high = np.moveaxis(result.interval(probability), -1, 0)
        inside = (truth >= low) & (truth <= high)
        rows.append(("pooled", probability, inside.mean()))
        rows += [(n, probability, h) for n, h in zip(terms.names, inside.mean(axis=0), strict=True)]
    table = pd.DataFrame(rows, columns=["coefficient", "interval", "held"])
    table["stars"], table["explained"] = count, result.explained.mean()
    table["ms_per_star"] = 1000 * took / count
    stamped(table).to_csv(out, index=False, float_format="%.4g")
    print(table.to_string())


def joint(out, fits=50, count=100, snr=50.0):
    """Pulls of joint fits, and their errors over the Cramér-Rao bound with the prior."""
    telescope, rows = psfdae.read_telescope(TELESCOPE), []
    for fit in range(fits):
        rng = np.random.default_rng([29, fit])
        angle = rng.uniform(-1.0, 1.0, (count, 2)) * telescope.field_edge_deg
        model = model_telescope(telescope, angle)
        t = rng.standard_normal(model.sd.size)
        truth = model.mean + model.sd * t
        terms = build_terms(telescope, angle)
        optics = engine.StarOptics(telescope, terms, STAMP_PX)
        place = rng.uniform(-0.5, 0.5, (count, 2))
        waves = np.einsum("mk,mkj->mj", model.coefficients(truth), terms.to_modes)
        coarse, engine.PUPIL_SIZES = engine.PUPIL_SIZES, FINE
        images = optics.propagation(STAMP_PX).stamps(np.concatenate([waves, place], axis=1))
        engine.PUPIL_SIZES = coarse
        images = images.astype(float)
        counts = noisy(images, snr, rng)
        started = time.process_time()
        result = psfdae.wavefront(
            counts, telescope, field_deg=angle, gain=1.0, noise=SKY**0.5, joint=True
        )
        took, state = time.process_time() - started, result.joint
        field = TelescopePosterior(result.search, model, state.star, result.search.optics)
        flux = snr * np.sqrt(SKY / (images**2).sum(axis=(1, 2)))[state.star]
        parameters = np.column_stack([place[state.star], flux / result.search.flux[state.star]])
        parameters = np.column_stack([parameters, np.zeros(len(parameters))])
        _, _, information = field.evaluate(np.zeros(1), np.append(t, parameters.ravel())[None])
        bound = model.sd * np.sqrt(np.diagonal(np.linalg.inv(information[0]))[: t.size])
        rows += [
            (fit, name, value, got, error, limit, state.probability, took)
            for name, value, got, error, limit in zip(
                model.names, truth, state.value, state.error, bound, strict=True
            )
        ]
        pull = (state.value - truth) / state.error
        print(fit, np.sqrt(np.mean(pull**2)), np.mean(state.error / bound), flush=True)
    names = ["fit", "number", "truth", "found", "error", "bound", "probability", "seconds"]
    table = pd.DataFrame(rows, columns=names)
    stamped(table).to_csv(out, index=False, float_format="%.5g")
    pull = (table.found - table.truth) / table.error
    print(
        "pulls scatter by",
        pull.std(),
        "; errors over the bound",
        (table.error / table.bound).mean(),
    )
    print(
        "RMS of errors over the bound",
        np.sqrt(np.mean(((table.found - table.truth) / table.bound) ** 2)),
    )


if __name__ == "__main__":
    limit_threads(1)
    {"stars": stars, "joint": joint}[sys.argv[1]](Path(sys.argv[2]))
