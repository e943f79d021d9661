"""Choice of the bright stars of images: limits on S/N and neighbours, and stamps that fit them.

`choose_bright_stars` measures all stars of images that are exposures of one camera. Where few are
bright enough, it accepts fainter ones and such with neighbours; where the stars are too large for
their stamps, it takes larger stamps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from psfdae.base.errors import keyword
from psfdae.denoise.star_model import SCALE_TOLERANCE
from psfdae.image.camera import other_instruments
from psfdae.image.errors import ObservationError
from psfdae.image.image import Image
from psfdae.image.image_input import ImageInput
from psfdae.image.observation import Observation
from psfdae.image.selection import CalibrationStarsError, Candidates, Verdict, collect
from psfdae.image.source_size import SourceSize, measure_size
from psfdae.training.settings import Settings

ENOUGH_STARS = 20
"""Number of bright stars below which the limits on S/N and neighbours are relaxed."""

MIN_STARS_WITH_ERROR = 5
"""Number of bright stars below which neither errors of a model nor changes of it can be judged."""


def choose_bright_stars(
    observations: Sequence[Observation], settings: Settings
) -> tuple[Sequence[Observation], list[Candidates], Settings, list[str]]:
    """Measure the stars of images, and choose the bright ones among them.

    Parameters
    ----------
    observations : sequence of Observation
        Images of one camera; their stars count together.
    settings : Settings
        Limits of the choice, and sizes of the stamps.

    Returns
    -------
    observations : sequence of Observation
        The images with stamps that hold the stars.
    candidates : list of Candidates
        Measured stars of each image.
    settings : Settings
        Settings by which the stars were chosen.
    notes : list of str
        Lines on differences from the given settings.
    """
    notes = []
    # Choose stars in stamps of the given size, then in larger ones if these hold too little of
    # their light.
    relaxed_settings, candidates = collect_enough(observations, settings)
    if (enlarged_stamps := enlarge_stamps(observations, candidates, settings)) is not None:
        settings, note = enlarged_stamps
        notes.append(note)
        side, margin = settings.framing.stamp_px, settings.calibration_stars.margin_px
        observations = [
            replace(observation, stamp_px=side, margin=margin) for observation in observations
        ]
        relaxed_settings, candidates = collect_enough(observations, settings)
    # The user is warned that stars below the given S/N are used.
    least_snr, stated_snr = (
        s.calibration_stars.effective_snr_min for s in (relaxed_settings, settings)
    )
    if least_snr < stated_snr:
        notes.append(
            f"few stars: stars of S/N {least_snr:g} and above are used, because fewer than 20 have "
            f"S/N {stated_snr:g}; {keyword('snr_min')} sets another limit"
        )
    return observations, candidates, relaxed_settings, notes


def collect_enough(
    observations: Sequence[Observation], settings: Settings
) -> tuple[Settings, list[Candidates]]:
    """Choose stars from the brightest down, until there are enough.

    Where S/N 100 gives fewer than `ENOUGH_STARS`, the least S/N is lowered until there are three
    times as many, or to 20; and to 10 if even that gives too few. Where these are still too few
    because bright stars have neighbours, brighter and brighter neighbours are accepted, whose light
    is subtracted later.

    Parameters
    ----------
    observations : sequence of Observation
        Images of one camera; their stars count together.
    settings : Settings
        Limits of the choice, which are relaxed where stars are few.

    Returns
    -------
    settings : Settings
        Settings with the least S/N, and the brightness of accepted neighbours.
    candidates : list of Candidates
        Measured stars of each observation.
    """
    calibration = settings.calibration_stars

    def collect_all(by_core: bool = False, **limits: float) -> tuple[Settings, list[Candidates]]:
        """Choose stars with other limits."""
        relaxed_settings = calibration.model_copy(update=limits)
        # Only the stars of all images together must be enough, which is required later.
        image_limits = relaxed_settings.model_copy(update={"stars_min": 0})
        return settings.model_copy(update={"calibration_stars": relaxed_settings}), [
            collect(observation, image_limits, settings.framing, by_core=by_core)
            for observation in observations
        ]

    def bright_count(selection: tuple[Settings, list[Candidates]]) -> int:
        """Return the number of bright stars of a selection."""
        return sum(len(candidates.bright) for candidates in selection[1])

    selection = collect_all(snr_min=calibration.effective_snr_min)
    # In an image of galaxies, fainter stars cannot be distinguished from galaxies.
    verdicts = np.concatenate([image_candidates.verdict for image_candidates in selection[1]])
    has_galaxies = np.count_nonzero(verdicts == Verdict.EXTENDED) > max(9, bright_count(selection))
    if bright_count(selection) >= (MIN_STARS_WITH_ERROR if has_galaxies else ENOUGH_STARS):
        return selection
    # Fainter stars: three times as many as needed while their S/N is above 20. Of two selections
    # with as many stars, the first one stays.
    for snr in calibration.list_lower_snr():
        selection = max(selection, collect_all(snr_min=snr), key=bright_count)
        if bright_count(selection) >= (ENOUGH_STARS if snr <= 20.0 else 3 * ENOUGH_STARS):
            return selection
    crowded_count = sum(np.count_nonzero(c.verdict == Verdict.CROWDED) for c in selection[1])
    # Brighter neighbours; their brightness is taken from the cores, since the stamp of a faint star
    # has the light of a bright neighbour. The mean PSF is a median: of neighbours on all sides it
    # has little light.
    for ratio in (0.05, 0.1, 0.2, 0.4) if crowded_count >= ENOUGH_STARS else ():
        if bright_count(selection) < ENOUGH_STARS:
            limits = {"snr_min": calibration.effective_snr_min, "neighbour_ratio": ratio}
            selection = max(selection, collect_all(True, **limits), key=bright_count)
    return selection


def enlarge_stamps(
    observations: Sequence[Observation], candidates: Sequence[Candidates], settings: Settings
) -> tuple[Settings, str] | None:
    """Adapt the settings to stars that are too large for their stamps, or hollow.

    Margin, search distance, isolation and the sub-pixel steps follow the side of the stamps.

    Parameters
    ----------
    observations : sequence of Observation
        Images of one camera.
    candidates : sequence of Candidates
        Measured stars of each observation.
    settings : Settings
        Sizes of the stamps, and the fraction of the light that they must hold.

    Returns
    -------
    settings : Settings
        The adapted settings.
    note : str
        Size of the stars and of the stamps.
        None in place of both, if the stamps hold the light of the stars and these have their
        brightest pixels in their middle.

    Raises
    ------
    CalibrationStarsError
        If the largest stamps hold less than 80 % of the light: the sources are not stars.
    """
    calibration, framing = settings.calibration_stars, settings.framing
    # A given size of stamps and a given centring leave nothing to adapt.
    if not calibration.light_min and calibration.centring_px is not None:
        return None
    largest = _largest_size(observations, candidates, 0.8 if calibration.light_min else 0.0)
    if largest is None:
        return None
    # The side of stamps that hold the given part of the light, at least the side of the settings.
    side = framing.stamp_px
    if calibration.light_min:
        side = max(side, largest.side(calibration.light_min))
    is_larger = side > framing.stamp_px
    if not (is_larger or largest.is_hollow):
        return None
    # Lengths of the choice of stars grow with their stamps, up to what the settings allow. Stars
    # without a sharp peak are centred on their light smoothed by their own width.
    scale, centring = side / framing.stamp_px, calibration.centring_px
    if centring is None:
        centring = largest.fwhm_px if largest.is_hollow or largest.fwhm_px > 5.0 else 0.0
    lengths = {
        "centring_px": float(f"{centring:.3g}"),
        "margin_px": min(round(calibration.margin_px * scale), 64),
        "search_px": min(round(calibration.search_px * scale), 16),
        "isolation_px": calibration.isolation_px * scale,
    }
    groups: dict[str, Any] = {
        "calibration_stars": calibration.model_copy(update=lengths),
        "framing": framing.model_copy(update={"stamp_px": side}),
    }
    if is_larger and (field := getattr(settings, "field", None)) is not None:
        # Steps of the field's splines grow with the finest structure of the stars, in powers of 2.
        # The settings are made for stars of a FWHM of 2.8 px, whose finest structure is 1.5 px.
        factor = 2.0 ** max(np.floor(np.log2(largest.sharpness_px / 1.5)), 0.0)
        steps_px = {
            "spacing_px": min(2.0, field.spacing_px * factor),
            "step_px": min(1.0, field.step_px * factor),
        }
        groups["field"] = field.model_copy(update=steps_px)
    note = f"stars: half of the light is within a diameter of {largest.fwhm_px:.3g} px"
    if is_larger:
        old_part, new_part = (100 * largest.light_within(s) for s in (framing.stamp_px, side))
        note += (
            f"; stamps of {side} px, which hold {new_part:.1f} % of it, are used instead of "
            f"{framing.stamp_px} px ({old_part:.0f} %); {keyword('stamp_px')} sets another size"
        )
    # Seeing is at most about 6 arcsec; a pixel may be larger.
    scale_arcsec = (
        0.0 if observations[0].scale_assumed else observations[0].pixel_scale_arcsec or 0.0
    )
    if largest.fwhm_px * min(scale_arcsec, 1.0) > 6.0:
        note += "; this is more than seeing makes: they are out of focus, or no stars"
    if largest.is_hollow:
        note += "; the brightest pixel is off the middle: stars are centred on their smoothed light"
    return settings.model_copy(update=groups), note


def _largest_size(
    observations: Sequence[Observation], candidates: Sequence[Candidates], light_min: float
) -> SourceSize | None:
    """Return the size of stars in the image where it is largest; None for cubes of stamps.

    Parameters
    ----------
    observations : sequence of Observation
        Images of one camera, or cubes of stamps.
    candidates : sequence of Candidates
        Measured stars of each observation.
    light_min : float
        Least part of the light of a star in the largest stamps.

    Raises
    ------
    CalibrationStarsError
        If these hold less: they hold 98 % of a star of FWHM 23 px, and a small part of a nebula.
    """
    sizes = []
    for observation, image_candidates in zip(observations, candidates, strict=True):
        if isinstance(observation, Image):
            # Stars that are good in small stamps are not saturated; without such stars, all count
            # that are not wider than these.
            sky, position = observation.sky(), image_candidates.bright.position
            if len(position) < MIN_STARS_WITH_ERROR:
                position = image_candidates.position[image_candidates.verdict != Verdict.EXTENDED]
            size = measure_size(sky.signal, sky.bad, position)
            if size is not None and size.light_within(size.sides[-1]) < light_min:
                raise CalibrationStarsError(
                    f"{observation.path}: no star: half of the light of its sources is within "
                    f"{size.fwhm_px:.3g} px, and the largest stamps have {size.sides[-1]} px"
                )
            sizes.append(size)
    return max(filter(None, sizes), key=lambda size: size.fwhm_px, default=None)


def few_stars_notes(rows: np.ndarray, held_out: np.ndarray) -> list[str]:
    """Return notes on a model of few stars: an empty list, or one line.

    Errors of a model rest on the stars held out, a fifth of all: with fewer than 20 stars they are
    rough, with fewer than 5 not given.

    Parameters
    ----------
    rows : ndarray of int, shape (n,)
        Row of each bright star in its list.
    held_out : ndarray of bool, shape (n,)
        True for stars that no training sees.
    """
    count, test_count = len(rows), int(held_out.sum())
    if count >= ENOUGH_STARS:
        return []
    if len(np.unique(rows)) == 1:
        return ["one star: the PSF is this star, tested on itself; its error is not known"]
    training = count - test_count
    if count >= MIN_STARS_WITH_ERROR:
        return [
            f"few stars: {training} train the model, {test_count} test it; its errors are rough"
        ]
    note = (
        f"few stars: the PSF is the mean of {training} stars, tested on {test_count}; its error is "
    )
    return [note + "not known"]


def require_unique_names(sources: Sequence[ImageInput]) -> None:
    """Refuse images whose models would have the same name.

    Raises
    ------
    ObservationError
        If two files have the same name without suffix.
    """
    names = [source.name for source in sources]
    for number, name in enumerate(names):
        if (first := names.index(name)) < number:
            problem = (
                f"its model and the model of {sources[first].path} would both be called {name!r}"
            )
            raise ObservationError(sources[number].path, problem)


def require_one_camera(observations: Sequence[Observation]) -> None:
    """Refuse several images with pixels of several sizes, or several cameras or filters.

    Parameters
    ----------
    observations : sequence of Observation
        A single one is accepted, a cube of stamps as well.

    Raises
    ------
    ObservationError
        Names the first difference from the first image.
    """
    first = observations[0]
    for observation in observations if len(observations) > 1 else ():
        if not isinstance(observation, Image):
            raise ObservationError(observation.path, "a cube of stamps; expected an image")
        # The pixel scale, then telescope, camera and filter of the headers.
        images = (first, observation)
        scales = [image.pixel_scale_arcsec or image.assumed_scale_arcsec for image in images]
        differences = other_instruments(*(image.instrument for image in images))
        if abs(scales[1] / scales[0] - 1.0) > SCALE_TOLERANCE:
            name, (first_text, text) = (
                "the pixel scale",
                (f"{scale:.6g} arcsec" for scale in scales),
            )
        elif differences:
            name, first_text, text = (differences[0][0], *map(repr, differences[0][1:]))
        elif (parts := [image.detector_frames for image in images])[0] != parts[1]:
            # Positions of a star on different parts of the detector would be mixed.
            name, (first_text, text) = "the part of the detector", map(str, parts)
        else:
            continue
        problem = f"{name} is {text}, in {first.path} {first_text}; a model needs images of one"
        raise ObservationError(observation.path, problem)
