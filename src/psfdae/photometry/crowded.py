"""Photometry of all stars of an image, those that overlap together, with a model of its field.

All stars are fitted at once (`psfdae.photometry.joint_fit`). Stars that are fainter, or in the
light of brighter ones, are then found where the models are subtracted
(`psfdae.photometry.matched_filter`), and all are fitted again, on a sky without the light of stars,
until no more are found, five times at most. Stars that were found there with a flux below 3 σ,
which includes the errors of their neighbours' PSFs, are dropped. Stars of a list are where it has
them, as accurately as its bright stars are (`locate_listed_stars`). The light
that a star has beyond its stamp is measured with them (`psfdae.psf.wings`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from psfdae.base.progress import steps
from psfdae.base.types import Table
from psfdae.denoise.denoiser import MAX_CHI2
from psfdae.denoise.flux_model import is_faint
from psfdae.image.image import Image
from psfdae.image.stamps import StarFlag, raise_flag
from psfdae.image.trails import find_saturated_cores
from psfdae.photometry.joint_fit import JointFit, chains, fit_stars, pairs_within
from psfdae.photometry.matched_filter import find_stars
from psfdae.photometry.photon_noise import pixel_error
from psfdae.photometry.wings_fit import StarFluxes, add_model_errors, around_stars
from psfdae.psf.grid import PsfGrid
from psfdae.psf.interface import FieldPsfs, aperture_correction
from psfdae.psf.wings import Wings, choose_wings
from psfdae.stars.moments import robust_scatter

MAX_CHI2_RATIO = 2.5
"""Ratio of the median χ² of an image's bright stars to the training's, above which all stars are
flagged UNLIKE_TRAINING."""

RESIDUAL_SNR = 4.0
"""Minimum S/N of a star in the residuals; noise alone has some 25 higher peaks in 10⁶ pixels."""


@dataclass(frozen=True)
class CrowdedPhotometry:
    """Stars of an image, and what is left of the image without them.

    Attributes
    ----------
    model : FieldPsfs
        Model with which the stars were fitted.
    stars : Table
        A row for each: `id`, `x`, `y` (0-based pixels), `x_error`, `y_error`, `flux` (counts,
        wings included), `flux_error`, `flux_model` (without the wings), `group`, `group_size`
        (stars in a chain of neighbours), `chi2` (reduced, of the pixels of the fit), `flags`
        (`StarFlag`s), `photutils_flags`. Stars of a list have its `id` and come in its order.
        Errors are √χ² times the errors by noise where χ² > 1; the flux error includes the
        model's error (`FieldPsfs.flux_error`).
    residual, light : ndarray, shape (h, w)
        Image without sky and stars, and light of all stars, counts.
    wings : Wings or None
        Wings in the fluxes: of the image, or of the model if no star is bright enough to show
        any.
    image_wings : Wings or None
        Wings of the image, which faint stars hardly show; the model's if no star fits its PSF.
    chi2_ratio : float
        Median of the χ² of bright stars divided by the χ² that training stars of their S/N would
        have; NaN if not known.
    """

    model: FieldPsfs
    stars: Table
    residual: np.ndarray
    light: np.ndarray
    wings: Wings | None
    image_wings: Wings | None
    chi2_ratio: float = np.nan

    def times(self, factor: float) -> CrowdedPhotometry:
        """Return the same in a unit in which the numbers of all light are larger by a factor."""
        stars = self.stars.copy()
        for name in ("flux", "flux_error", "flux_model"):
            stars[name] *= factor
        return replace(
            self, stars=stars, residual=factor * self.residual, light=factor * self.light
        )

    @property
    def radius_px(self) -> float:
        """Radius within which a flux is the light of its star; half a stamp without wings."""
        half = self.model.stamp_px / 2
        return half if self.wings is None else float(self.wings.radius_px[-1])

    def compute_model_share(self) -> tuple[float, float]:
        """Return the fraction of a typical star's flux in the model, and its standard error.

        The rest are the wings, which reach into the stamp, too.
        """
        # 1/(1 + L), with the error σ_L/(1 + L)².
        light, error = (0.0, 0.0) if self.wings is None else self.wings.light()
        return 1.0 / (1.0 + light), error / (1.0 + light) ** 2

    def aperture_correction(self, x: float, y: float, radius_px: float) -> float:
        """Return the ratio of the flux of a star to the light in an aperture.

        See `psfdae.psf.interface.aperture_correction`.
        """
        return aperture_correction(self.model, self.wings, x, y, radius_px)


def photometry(
    model: FieldPsfs,
    observation: Image,
    threshold: float = RESIDUAL_SNR,
    turns: int = 5,
    with_wings: bool = True,
) -> CrowdedPhotometry:
    """Fit positions and fluxes of all stars of an image.

    Parameters
    ----------
    model : FieldPsfs
        Model that knows the PSF at every position in this image.
    observation : Image
        The image with its stars. If they come from a list, no others are searched for.
    threshold : float
        Minimum S/N of stars that are found where the models of others are subtracted.
    turns : int
        Maximum number of joint fits, at least 2; stars are looked for after all but the last two,
        and after the first of two.
    with_wings : bool
        Measure the wings of the stars and the halos of saturated ones, which takes as long as the
        rest. Otherwise, the wings of the model are used, if it has any.

    Raises
    ------
    PredictionError
        If the model does not know the PSF at a position.
    ObservationError
        If the sky cannot be measured.
    """
    from scipy.ndimage import map_coordinates

    unit, (gain, saturate) = observation.unit_factor, observation.camera_in_sky_unit()
    # PSFs of the field, and lengths that follow from the PSF in its middle.
    psfs = PsfGrid.sample(model, by_magnitude=True).times(unit)
    fwhm, side = model.fwhm_px(), model.stamp_px
    # Side of the pixels that are fitted to a star, odd, about 1.6 FWHM.
    box_px = 2 * int(np.ceil(1.6 * fwhm / 2)) + 1
    x, y = np.rint(np.mean(model.field_range(), axis=0))
    middle_psf = model.psf_at(float(x), float(y), 1)
    area_px = float(1.0 / np.square(middle_psf).sum())  # noise-equivalent
    # The image with its sky; saturated pixels are not fitted.
    sky = observation.take_sky()
    image = sky.signal + sky.level
    is_saturated = image >= saturate
    bad, cores = sky.bad | is_saturated, find_saturated_cores(is_saturated)
    sky = replace(sky, bad=bad)
    # Stars start where the list or the detection has them, with the wings of the model. `origin` is
    # where a star was first expected, `position` where it was fitted last.
    origin, flux = np.array(observation.positions, dtype=np.float64), None
    position = origin
    wings, wing_light = model.wings, np.zeros_like(image)
    # The first errors are from the pixels themselves, light of neighbours included.
    error = pixel_error(sky.noise, sky.signal, gain)
    # Positions of all stars that were found in residuals, each of which is tried once, and of the
    # stars that the last search has found.
    peaks, new = np.empty((0, 2)), np.empty((0, 2))
    # Positions by the list, and their error, as soon as its bright stars have shown it.
    is_listed, position_prior = observation.detections is None, None
    for turn in steps("photometry", range(turns)):
        # Centres move by at most a FWHM from where stars were expected.
        without_wings = image - sky.level - wing_light
        fit = fit_stars(
            psfs, without_wings, error, bad, position, flux, box_px, fwhm, origin, position_prior
        )
        del without_wings, wing_light  # of a large image, each map takes much memory
        position, flux = np.where(np.isfinite(fit.position), fit.position, position), fit.flux
        position_prior = locate_listed_stars(fit, origin, fwhm) if is_listed else None
        # Sky and light beyond the stamps, from the image without the light of stars.
        earlier_level = sky.level
        fluxes = StarFluxes(position, flux, psfs.outer_shares(position, flux, side))
        # The first fluxes are off by the light of unknown wings: it is enough to know these to
        # their standard error, and to a tenth of it afterwards.
        sky, wing_light, wings, halo_error = around_stars(
            image,
            sky,
            error,
            fit.light,
            fluxes,
            side,
            wings,
            0.1 if turn else 1.0,
            cores,
            with_wings,
        )
        # Noise in the weights would make fluxes too small: from now on they are of the models.
        error = pixel_error(sky.noise, fit.light + wing_light, gain)
        # Two fits at least; one more with halos, since the first fluxes contain their light, and
        # with the list of a crowd, if the sky of the first fit contained light of stars.
        is_changed = halo_error.any() or (
            position_prior is not None
            and area_px * abs(np.mean(sky.level - earlier_level))
            > 0.2 * np.nanmedian(fit.flux_error)
        )
        may_be_last = turn > (1 if is_changed else 0)
        if turn == turns - 1 or (may_be_last and is_listed):
            break
        # Stars that were found in residuals are dropped if they are none.
        doubt = _psf_doubt(position, flux, side, area_px)
        is_real = find_real(position, fit, doubt, observation.count, threshold, 0.5 * fwhm)
        changed_positions = np.concatenate([new, position[~is_real]])
        position, flux, origin = position[is_real], flux[is_real], origin[is_real]
        # More stars in the residuals, whose σ has the errors of the models. The last two fits drop
        # stars and find none; of two fits, none drops any. From the third search on, sky and errors
        # stay as they are if few stars change: only these can show others.
        if not is_listed and turn < max(turns - 2, 1):
            sigma = np.where(bad, np.inf, add_model_errors(error, fit.light, wing_light))
            new, new_flux = find_stars(
                psfs,
                sky.signal,
                sigma,
                np.concatenate([position, peaks]),
                threshold,
                fwhm,
                changed_positions
                if turn > 1 and len(changed_positions) < 0.05 * len(position)
                else None,
            )
            position, origin, peaks = (np.concatenate([p, new]) for p in (position, origin, peaks))
            flux = np.append(flux, new_flux)
        if may_be_last and is_real.all() and len(position) == len(is_real):
            break
    wings_used = choose_wings(wings, model.wings)
    # A halo that is off by δ in all pixels of a star changes its flux by δ Σ P / Σ P², which is δ
    # times the noise-equivalent area 1 / Σ P², as Σ P = 1.
    light_error = area_px * map_coordinates(
        halo_error, np.nan_to_num(fit.position[:, ::-1]).T, order=1, mode="nearest"
    )
    stars = tabulate_stars(model, psfs, observation, fit, origin, wings_used, fwhm, light_error)
    stars["flags"] |= star_flags(stars, bad & ~is_saturated, is_saturated, box_px, fwhm)
    # Fluxes of all stars are wrong if the PSF does not fit, also of those too faint to show it.
    chi2_ratio = flag_misfit(fit, stars["flags"], area_px * model.residual_variance(box_px))
    # In the unit of the image.
    return CrowdedPhotometry(
        model, stars, sky.signal, fit.light + wing_light, wings_used, wings, chi2_ratio
    ).times(1.0 / unit)


def locate_listed_stars(
    fit: JointFit, origin: np.ndarray, fwhm: float
) -> tuple[np.ndarray, float] | None:
    """Return where a list expects stars in this image, (n, 2), and the error of that, px.

    A faint star in a crowd moves to a peak of the noise, or of its neighbours' light, if nothing
    but the pixels decides; where the list has it is better known from the bright stars. None if
    there are fewer than ten of these, or if the list is not better than the range of the fit.

    Parameters
    ----------
    fit : JointFit
        All stars of the list.
    origin : ndarray, shape (n, 2)
        Positions by the list, x and y in pixels.
    fwhm : float
        FWHM of the PSF in pixels.
    """
    # Bright stars without a near neighbour, which would move the centre.
    is_bright = (fit.flux > 20.0 * fit.flux_error) & (fit.flags == 0)
    is_bright[np.unique(pairs_within(fit.position, fwhm))] = False
    offset = (fit.position - origin)[is_bright]
    if len(offset) < 10:
        return None
    # Lists are less accurate for faint stars: at least the error that an image of the same depth
    # has at S/N 2.4, where √2 · FWHM/2.355 divided by S/N is a quarter of the FWHM. A smaller
    # one would make fluxes of faint stars of noisy lists too small.
    error_px = max(0.25 * fwhm, float(robust_scatter(offset).max()))
    if error_px > fwhm / np.sqrt(3.0):
        return None
    return origin + np.median(offset, axis=0), error_px


def find_real(
    position: np.ndarray,
    fit: JointFit,
    doubt: np.ndarray,
    listed_count: int,
    threshold: float,
    distance_px: float,
) -> np.ndarray:
    """Return which stars are kept (n,).

    A star found in residuals is dropped if it is faint, if it may be what the PSF of another star
    lacks, or if it has moved to another star. All `listed_count` stars of the list are kept.

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        Positions x and y, the stars of the list first.
    fit : JointFit
        These stars, as they were fitted.
    doubt : ndarray, shape (n,)
        Fluxes that errors of other stars' PSFs may make.
    listed_count : int
        Number of stars of the list.
    threshold : float
        Minimum S/N of stars that are found in residuals.
    distance_px : float
        Distance within which two stars are one.
    """
    real = np.asarray(fit.flux > min(threshold, 3.0) * np.hypot(fit.flux_error, doubt))
    real[find_duplicates(position, fit.flux, listed_count, distance_px)] = False
    real[:listed_count] = True
    return real


def find_duplicates(
    position: np.ndarray, flux: np.ndarray, listed_count: int, distance_px: float
) -> np.ndarray:
    """Return the indices of stars that have moved onto another star, which is kept.

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        Positions x and y; stars of the list, or of the first detection, come first.
    flux : ndarray, shape (n,)
        Of two stars that both were found in residuals, the fainter one is the duplicate.
    listed_count : int
        Number of these, which come before stars found in residuals.
    distance_px : float
        Distance within which two stars are one.
    """
    first, second = pairs_within(position, distance_px).T
    # Of a pair, the star that comes later is the duplicate, or the fainter one if both were found.
    is_first = (first >= listed_count) & (flux[first] < flux[second])
    return np.asarray(np.where(is_first | (second < first), first, second))


def tabulate_stars(
    model: FieldPsfs,
    psfs: PsfGrid,
    observation: Image,
    fit: JointFit,
    origin: np.ndarray,
    wings: Wings | None,
    fwhm: float,
    light_error: np.ndarray,
) -> Table:
    """Return a row for each star with all its light, all errors, and flags that need no pixels.

    Parameters
    ----------
    model : FieldPsfs
        Model of the PSFs, with their errors.
    psfs : PsfGrid
        Its PSFs, for fluxes in the unit of the fit.
    observation : Image
        The image with its stars.
    fit : JointFit
        All stars, with their fluxes in the stamps.
    origin : ndarray, shape (n, 2)
        Expected positions of the stars, x and y in pixels.
    wings : Wings or None
        Light that the model lacks; None adds none to the fluxes.
    fwhm : float
        FWHM of the PSF in pixels, which groups stars.
    light_error : ndarray, shape (n,)
        Standard errors of the fluxes due to light that was subtracted as halos of other stars.
    """
    from astropy.table import Table

    # Ratio of all light of a star to its light in the model, also of a star whose flux came out
    # negative: its PSF is known from its position.
    total_ratio, ratio_error = np.ones(len(fit.flux)), np.zeros(len(fit.flux))
    if wings is not None:
        shares = psfs.outer_shares(fit.position, fit.flux, model.stamp_px)
        total_ratio, ratio_error = wings.total_over_flux(shares)
    is_detected = observation.detections is not None
    # A centre that follows noise makes a detected star too bright (`JointFit.flux_bias`). With a
    # list, the errors of stars that overlap are larger than this bias, and of either sign.
    flux = fit.flux - fit.flux_bias if is_detected else fit.flux
    # Light that no model explains, of the PSF's own errors or of undetected stars, is as much
    # in the fluxes as in the residuals.
    excess = np.sqrt(np.fmax(fit.chi2, 1.0))
    # The errors of the PSF and of the wings are not noise, but the same fraction of each flux,
    # whatever its χ²: σ² = max(χ², 1) σ_noise² + σ_halo² + (e_model F)² + (e_wings F)², with the
    # relative errors e, for the flux F in the model; all light has the same relative error.
    relative_error = np.hypot(model.flux_error(fit.position), ratio_error / total_ratio)
    # Stars of a list keep its numbers and flags.
    stars = Table({"id": np.arange(1, len(flux) + 1) if is_detected else observation.stars.id})
    stars["x"], stars["y"] = fit.position.T
    stars["x_error"], stars["y_error"] = excess * fit.position_error.T
    stars["flux"] = total_ratio * flux
    fit_error = np.hypot(excess * fit.flux_error, light_error)
    stars["flux_error"] = total_ratio * np.hypot(fit_error, relative_error * flux)
    stars["flux_model"] = flux
    # Chains of neighbours, numbered from 1.
    group = chains(fit.position, 2.4 * fwhm)
    stars["group"], stars["group_size"] = group + 1, np.bincount(group)[group]
    stars["chi2"], stars["photutils_flags"] = fit.chi2, fit.flags
    stars["flags"] = np.zeros(len(stars), np.uint16) if is_detected else observation.stars.flags
    # Noise has some peaks of up to 5 σ in an image of a million pixels: a detected source below
    # that may be no star.
    faint = is_faint(np.array(stars["flux"]), np.array(stars["flux_error"]), 5.0)
    raise_flag(stars["flags"], StarFlag.FAINT, faint & is_detected)
    # Farther from where it was expected than noise explains, a star may be another one.
    distance_px = np.hypot(*(fit.position - origin).T)
    sigma_px = np.hypot(stars["x_error"], stars["y_error"])
    is_far = distance_px > np.maximum(0.5 * fwhm, 3.0 * sigma_px)
    raise_flag(stars["flags"], StarFlag.OFF_CENTRE, is_far)
    return stars


def flag_misfit(fit: JointFit, flags: np.ndarray, variance: float) -> float:
    """Return the median ratio of bright stars' χ² to that of training stars of their S/N.

    All stars are flagged UNLIKE_TRAINING if it is above `MAX_CHI2_RATIO`.

    Parameters
    ----------
    fit : JointFit
        All stars of the image, with their χ².
    flags : ndarray, shape (n,)
        Changed here; bright stars have a S/N above 20 and no flag other than POOR_FIT.
    variance : float
        Variance v of the training stars about their PSF, summed over the noise-equivalent area.

    Returns
    -------
    float
        NaN if the variance is not known, or with fewer than three bright stars.
    """
    # χ² = 1 + (F/σ_F)² v: noise, and residuals of variance v F².
    snr = fit.flux / fit.flux_error
    is_bright = (flags & ~np.uint16(StarFlag.POOR_FIT) == 0) & (snr > 20.0)
    ratio = (fit.chi2 / (1.0 + snr**2 * variance))[is_bright]
    median_ratio = float(np.median(ratio)) if len(ratio) >= 3 else np.nan
    raise_flag(flags, StarFlag.UNLIKE_TRAINING, np.full(len(flags), median_ratio > MAX_CHI2_RATIO))
    return median_ratio


def star_flags(
    stars: Table, bad: np.ndarray, is_saturated: np.ndarray, box_px: int, fwhm: float
) -> np.ndarray:
    """Return the flags (n,), uint16, of stars that were fitted in boxes of `box_px` pixels.

    Parameters
    ----------
    stars : Table
        As in `CrowdedPhotometry`.
    bad, is_saturated : ndarray of bool, shape (h, w)
        Pixels that were not fitted.
    box_px : int
        Side of the boxes, odd.
    fwhm : float
        FWHM of the PSF in pixels, within which neighbours are blended.
    """
    from scipy.ndimage import maximum_filter

    position = np.stack([stars["x"], stars["y"]], axis=1)
    is_located = np.isfinite(position).all(axis=1)
    flags, photutils = np.zeros(len(stars), np.uint16), np.array(stars["photutils_flags"])
    # Pixels of the box about each star; a star without a position is put off the image.
    height, width = bad.shape
    column, row = np.rint(np.where(is_located[:, None], position, -box_px)).astype(int).T
    half = box_px // 2
    edge = (column < half) | (row < half) | (column >= width - half) | (row >= height - half)
    at = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
    for pixels, flag in ((bad, StarFlag.MASKED), (is_saturated, StarFlag.SATURATED)):
        raise_flag(flags, flag, is_located & maximum_filter(pixels, box_px, mode="constant")[at])
    raise_flag(flags, StarFlag.TRUNCATED, edge & is_located)
    # Flux, fit and neighbours.
    flux, error = np.array(stars["flux"]), np.array(stars["flux_error"])
    raise_flag(flags, StarFlag.NO_FLUX, ~np.isfinite(flux))
    raise_flag(flags, StarFlag.FAINT, is_faint(flux, error))
    # Flags of photutils: 8, the fit did not converge; 32, a position is at its bound.
    raise_flag(flags, StarFlag.POOR_FIT, (np.array(stars["chi2"]) > MAX_CHI2) | (photutils & 8 > 0))
    raise_flag(flags, StarFlag.OFF_CENTRE, photutils & 32 > 0)
    raise_flag(flags, StarFlag.BLENDED, np.unique(pairs_within(position, fwhm)))
    return flags


def _psf_doubt(position: np.ndarray, flux: np.ndarray, side: int, area_px: float) -> np.ndarray:
    """Return the flux (n,) that errors of the PSFs of other stars may cause at each star (n, 2).

    A PSF may lack 1.5 % of its light in and about its stamp of `side` pixels, of which a star gets
    what falls on its noise-equivalent area.
    """
    # Squares of the fluxes of all stars near enough to each star; both stars have light.
    has_light = (flux > 0)[:, None]
    pairs = pairs_within(np.where(has_light, position, np.nan), 0.75 * side)
    square = np.zeros(len(position))
    for star, other in ((0, 1), (1, 0)):
        np.add.at(square, pairs[:, star], np.square(flux[pairs[:, other]]))
    return np.asarray(0.015 * area_px / side**2 * np.sqrt(square))
