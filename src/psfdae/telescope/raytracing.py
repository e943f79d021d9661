"""Wavefronts of a misaligned telescope by ray tracing.

batoid (https://github.com/jmeyers314/batoid) traces the rays of a telescope that is
built from its settings.

Coordinates: z from the primary to the sky, light along −z. A field angle (x, y)
is the direction in which light travels, so that a star at +x is imaged at +x on
the detector. Zernike coefficients are Noll's over the unit circle, fitted to the
lit annulus, positive where the wavefront leads: an optical path difference, which
is a delay, is their negative.

A misalignment moves the secondary by a decentre (x, y) and turns it about its
vertex by the rotation vector (tilt x, tilt y, 0).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from psfdae.base.errors import Error
from psfdae.base.types import CompoundOptic
from psfdae.optics.wavefronts import FIRST_NOLL, noll_to_nm, zernike_images
from psfdae.telescope.aberrations import Lens, Mirror, Prescription
from psfdae.telescope.settings import Telescope


class RayTracingError(Error, ValueError):
    """Error of a misalignment or a field angle whose rays cannot be traced."""


def misalign(optic: CompoundOptic, misalignment: np.ndarray) -> CompoundOptic:
    """Return the telescope with its item M2, the secondary, displaced; `optic` is not changed.

    `misalignment` is a decentre x, y in metres and a tilt about x, y in radians; it must be 0 for
    a telescope without secondary.
    """
    if not np.any(misalignment):
        return optic
    x, y, tilt_x, tilt_y = (float(value) for value in misalignment)
    # One rotation about an axis in the mirror's plane: the order of the tilts does not matter.
    turn = Rotation.from_rotvec([tilt_x, tilt_y, 0.0]).as_matrix()
    # Decentred first, then tilted about the displaced vertex.
    return optic.withLocallyShiftedOptic("M2", [x, y, 0.0]).withLocallyRotatedOptic("M2", turn)


class ZernikeTracer:
    """Ray trace of a telescope, for Zernike coefficients of its wavefront at given field angles.

    The rays start on Gauss–Legendre rings in the entrance pupil: their weighted
    least-squares fit equals a fit over the whole lit annulus, exactly for wavefronts
    up to the fitted order. The reference is the sphere about the mean landing point,
    and the mean path is 0 (batoid's reference "mean" in the limit of many rays).

    Parameters
    ----------
    optic : batoid.CompoundOptic
        The aligned telescope, with the size and obscuration of its pupil and its
        reference sphere.
    wavelength_m : float
        Wavelength in metres, the unit of the coefficients.
    field_rad : ndarray, shape (F, 2)
        Field angles (x, y) in radians.
    highest_noll : int
        Highest Noll index.
    """

    def __init__(
        self, optic: CompoundOptic, wavelength_m: float, field_rad: np.ndarray, highest_noll: int
    ) -> None:
        import batoid

        # Quantities of the trace that do not depend on the misalignment.
        self.optic = optic
        self.wavelength_m = wavelength_m
        self.field_rad = np.asarray(field_rad, float)
        # Weighted least squares of the wavefront on Z_1 … Z_J at the rays: coefficients are
        # (√w Z)⁺ √w times the lead. Weights of a quadrature make it the fit over the annulus.
        x, y, self._weights = annulus_points(highest_noll, optic.pupilObscuration)
        root = np.sqrt(self._weights)
        basis = zernike_images(range(1, highest_noll + 1), x, y)
        self._fit = np.linalg.pinv((basis * root).T) * root
        # 36 additional rays, just inside the rim of the pupil, detect vignetting.
        angle = 2.0 * np.pi * np.arange(36) / 36
        start = np.stack([np.append(x, 0.998 * np.cos(angle)), np.append(y, 0.998 * np.sin(angle))])
        start *= 0.5 * optic.pupilSize
        # Rays of all fields, one field after the other, from the entrance pupil.
        rays = [
            batoid.RayVector.fromStop(
                *start, optic=optic, wavelength=wavelength_m, theta_x=float(x), theta_y=float(y)
            )
            for x, y in self.field_rad
        ]
        self._rays = batoid.concatenateRayVectors(rays)

    def __call__(self, misalignments: np.ndarray) -> np.ndarray:
        """Return the Zernike coefficients of misalignments of the secondary.

        Parameters
        ----------
        misalignments : ndarray, shape (n, 4)
            Decentre x, y in metres and tilt about x, y in radians, as in `misalign`.

        Returns
        -------
        ndarray, shape (n, F, J)
            From Noll index `FIRST_NOLL` to the highest, in waves.

        Raises
        ------
        RayTracingError
            If a field is vignetted; names the number of the misalignment.
        """
        return np.stack([self._trace(*state) for state in enumerate(misalignments)])

    def _trace(self, number: int, misalignment: np.ndarray) -> np.ndarray:
        """Return the coefficients (F, J) of one misalignment, whose number messages name."""
        # Trace all rays through the misaligned telescope; the trace changes them in place.
        rays = self._rays.copy()
        misalign(self.optic, misalignment).trace(rays)
        # A field angle that loses a ray is an error: its wavefront would be of another pupil.
        is_stopped = (rays.vignetted | rays.failed).reshape(len(self.field_rad), -1)
        if is_stopped.any():
            is_vignetted = is_stopped.any(axis=1)
            field = int(is_vignetted.argmax())
            x, y = np.rad2deg(self.field_rad[field])
            raise RayTracingError(
                f"state {number}, field ({x:.6g}, {y:.6g})°: {int(is_stopped[field].sum())} of "
                f"{is_stopped.shape[1]} rays are vignetted; {int(is_vignetted.sum())} of "
                f"{len(is_stopped)} fields are"
            )
        # Landing point, direction and path of the rays of the pupil, without the rays at its rim.
        pupil = slice(0, self._weights.size)
        landing, velocity = (a.reshape(*is_stopped.shape, 3)[:, pupil] for a in (rays.r, rays.v))
        path = rays.t.reshape(is_stopped.shape)[:, pupil]
        direction = velocity / np.linalg.norm(velocity, axis=-1, keepdims=True)
        # Back along the ray to the sphere about the mean landing point: |o + s d| = R with s < 0,
        # so s = −o·d − √((o·d)² − (|o|² − R²)), o the offset from the centre.
        centre = np.einsum("n,fnk->fk", self._weights, landing)
        offset = landing - centre[:, None]
        along = (offset * direction).sum(-1)
        excess = (offset**2).sum(-1) - self.optic.sphereRadius**2
        path = path - along - np.sqrt(along**2 - excess)
        # Lead of every ray over the mean of its field angle, in waves, positive for short paths.
        # The first coefficients of the fit, piston and tilts, are left out.
        lead = (path @ self._weights[:, None] - path) / self.wavelength_m
        return np.asarray((lead @ self._fit.T)[:, FIRST_NOLL - 1 :])


def annulus_points(
    highest_noll: int, obscuration: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points and weights that integrate products of Zernike polynomials over an annulus.

    Gauss–Legendre in r², and at least as many spokes as the highest product
    needs. Their number is a multiple of 8, so that mirror symmetries are exact up to rounding.

    Parameters
    ----------
    highest_noll : int
        Highest Noll index.
    obscuration : float
        Linear central obscuration.

    Returns
    -------
    x, y, weights : ndarray, shape (n,)
        Points in pupil radii, and weights of sum 1.
    """
    # A product of two polynomials of order n has the order 2n in r, n in r², and 2n cycles.
    order = noll_to_nm(highest_noll)[0]
    nodes, weights = np.polynomial.legendre.leggauss(order)
    spokes = 8 * -(-(2 * order + 1) // 8)
    # Nodes −1 … 1 become r² from ε² to 1.
    rim = obscuration**2
    radius = np.sqrt(rim + (1.0 - rim) * 0.5 * (nodes + 1.0))
    angle = 2.0 * np.pi * np.arange(spokes) / spokes
    x, y = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    return x.ravel(), y.ravel(), np.repeat(0.5 * weights / spokes, spokes)


def build_optic(
    prescription: Prescription, telescope: Telescope, defocus_m: float = 0.0
) -> CompoundOptic:
    """Build the aligned telescope, a batoid.CompoundOptic.

    Its items are M1, M2 and lenses if any, and the detector D, `defocus_m` behind best focus.
    batoid is imported only here and where rays are launched: other scenes do not need it.

    Parameters
    ----------
    prescription : Prescription
        Surfaces and glass.
    telescope : Telescope
        Telescope with the diameter and the linear central obscuration of the pupil.
    defocus_m : float
        Distance of the detector behind best focus along the light, in metres.
    """
    import batoid

    # Elements of batoid: a plane at a height, an aperture that blocks light outside of a radius,
    # and surfaces. All are centred on the axis.
    def frame_at(z: float) -> Any:
        return batoid.CoordSys().shiftLocal([0.0, 0.0, z])

    def clear(radius: float) -> Any:
        return batoid.ObscNegation(batoid.ObscCircle(radius))

    def mirror(settings: Mirror, name: str, aperture: Any) -> Any:
        # batoid's Quadric does not find the point of a paraboloid on the axis.
        if settings.conic == -1.0:
            surface = batoid.Paraboloid(settings.radius_m)
        else:
            surface = batoid.Quadric(settings.radius_m, settings.conic)
        frame = frame_at(settings.vertex_m)
        return batoid.Mirror(surface, name=name, coordSys=frame, obscuration=aperture)

    def lens(name: str, settings: Lens) -> Any:
        # Two spheres, from the vacuum into the glass and out of it.
        front = ("front", settings.front_radius_m, settings.front_vertex_m, vacuum, glass)
        back = ("back", settings.back_radius_m, settings.back_vertex_m, glass, vacuum)
        surfaces = [
            batoid.RefractiveInterface(
                batoid.Sphere(radius),
                name=f"{name} {side}",
                coordSys=frame_at(vertex),
                obscuration=clear(settings.clear_radius_m),
                inMedium=in_medium,
                outMedium=out_medium,
            )
            for side, radius, vertex, in_medium, out_medium in (front, back)
        ]
        return batoid.Lens(surfaces, name=name, medium=glass)

    # Media on both sides of the surfaces of lenses.
    vacuum = batoid.ConstMedium(1.0)
    glass = prescription.glass and batoid.SellmeierMedium(
        *prescription.glass.sellmeier_b, *prescription.glass.sellmeier_c_um2
    )
    # The primary, with the hole of the central obscuration.
    radius = 0.5 * telescope.diameter_m
    aperture = clear(radius)
    if telescope.obscuration:
        annulus = batoid.ObscAnnulus(telescope.obscuration * radius, radius)
        aperture = batoid.ObscNegation(annulus)
    items = [mirror(prescription.primary, "M1", aperture)]
    # A single mirror reflects the light up, a second one down: the detector moves along it.
    light_direction = 1.0
    if prescription.secondary:
        light_direction = -1.0
        aperture = clear(prescription.secondary.clear_radius_m)
        items.append(mirror(prescription.secondary, "M2", aperture))
    items += [lens(*item) for item in prescription.ordered_lenses]
    # Detector and entrance pupil, planes across the axis.
    detector = frame_at(prescription.best_focus_m + light_direction * defocus_m)
    items.append(batoid.Detector(batoid.Plane(), name="D", coordSys=detector, obscuration=None))
    entrance_pupil = batoid.Interface(
        batoid.Plane(), name="entrance pupil", coordSys=frame_at(prescription.entrance_pupil_m)
    )
    return batoid.CompoundOptic(
        items,
        name=prescription.name,
        backDist=prescription.launch_distance_m,
        sphereRadius=prescription.reference_sphere_m,
        pupilSize=telescope.diameter_m,
        pupilObscuration=telescope.obscuration,
        stopSurface=entrance_pupil,
    )
