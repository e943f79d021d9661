"""Wavefronts of a misaligned telescope by ray tracing.

batoid (https://github.com/jmeyers314/batoid) traces the rays of a telescope that is
built from its settings.

Coordinates: z from the primary to the sky, light along −z. A field angle (x, y)
is that of the direction in which light travels, so that a star at +x is imaged
at +x on the detector. Zernike coefficients are Noll's over the unit circle,
fitted to the lit annulus, positive where the wavefront runs ahead: an optical
path difference, which counts the delay, is their negative.

A misalignment moves the secondary by a decentre (x, y) and turns it about its
vertex by the rotation vector (tilt x, tilt y, 0).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from psfdae.errors import Error
from psfdae.optics.wavefronts import FIRST_NOLL, noll_to_nm, zernike_basis

if TYPE_CHECKING:
    from batoid import CompoundOptic

    from psfdae.telescope.aberrations import Lens, Mirror, Prescription
    from psfdae.telescope.settings import Telescope

DEGREES_OF_FREEDOM = ("decenter_x", "decenter_y", "tilt_x", "tilt_y")
"""Order of the four numbers of a state of misalignment."""

RIM = 0.998
"""Relative radius of the rays that look for vignetting at the pupil's rim."""

RIM_RAYS = 36

RANGE_ROUNDING = 1e-9
"""A state may exceed the range by this much of it: the ends of a grid are rounded."""


class RayTracingError(Error, ValueError):
    """A state of misalignment or a field that the telescope cannot serve."""


def misaligned(optic: CompoundOptic, misalignment: np.ndarray) -> CompoundOptic:
    """The telescope with its item M2, the secondary, displaced; `optic` stays as it is.

    `misalignment` is a decentre x, y in metres and a tilt about x, y in radians; 0 is the
    only one of a telescope without secondary.
    """
    if not np.any(misalignment):
        return optic
    x, y, tilt_x, tilt_y = (float(value) for value in misalignment)
    # One turn about an axis in the mirror's plane: neither tilt comes before the other.
    turn = Rotation.from_rotvec([tilt_x, tilt_y, 0.0]).as_matrix()
    return optic.withLocallyShiftedOptic("M2", [x, y, 0.0]).withLocallyRotatedOptic("M2", turn)


def check_states(states: np.ndarray, unit: np.ndarray) -> None:
    """Refuse states (n, 4), in units of the range `unit`, outside of it.

    Raises
    ------
    RayTracingError
        Names the state, its degree of freedom and its value.
    """
    outside = ~(np.abs(states) <= 1.0 + RANGE_ROUNDING)
    if outside.any():
        state, axis = np.argwhere(outside)[0]
        value = states[state, axis]
        in_units = [f"{value * unit[axis] * 1e3:.6g} mm", f"{np.rad2deg(value * unit[axis]):.6g}°"]
        raise RayTracingError(
            f"state {state}: {DEGREES_OF_FREEDOM[axis]} = {value:.6g} of the range "
            f"({in_units[axis // 2]}): must be between -1 and 1"
        )


class ZernikeTracer:
    """Zernike coefficients of the wavefront at a set of fields, by ray tracing.

    The rays start on Gauss–Legendre rings in the entrance pupil: their weighted
    least-squares fit is that over the whole lit annulus, exact for wavefronts of
    the fitted order. The reference is the sphere about the mean landing point,
    the mean path is 0 (batoid's reference "mean" in the limit of many rays).

    Parameters
    ----------
    optic : batoid.CompoundOptic
        The aligned telescope; its pupil's size and obscuration and its reference
        sphere are those of the wavefront.
    wavelength : float
        In metres.
    fields : ndarray, shape (F, 2)
        Field angles (x, y) in radians.
    unit : ndarray, shape (4,)
        Range of the misalignment in metres, metres, radians, radians.
    highest : int
        Highest Noll index.
    """

    def __init__(
        self,
        optic: CompoundOptic,
        wavelength: float,
        fields: np.ndarray,
        unit: np.ndarray,
        highest: int,
    ) -> None:
        import batoid

        self.optic, self.wavelength = optic, wavelength
        self.fields = np.asarray(fields, float)
        self.unit = np.asarray(unit, float)
        x, y, self._weights = annulus_points(highest, optic.pupilObscuration)
        root = np.sqrt(self._weights)
        self._fit = np.linalg.pinv((zernike_basis(highest, x, y) * root).T) * root
        angle = 2.0 * np.pi * np.arange(RIM_RAYS) / RIM_RAYS
        start = np.stack([np.append(x, RIM * np.cos(angle)), np.append(y, RIM * np.sin(angle))])
        start *= 0.5 * optic.pupilSize
        # Rays of all fields, one field after the other, from the entrance pupil.
        self._rays = batoid.concatenateRayVectors(
            [
                batoid.RayVector.fromStop(
                    *start, optic=optic, wavelength=wavelength, theta_x=float(x), theta_y=float(y)
                )
                for x, y in self.fields
            ]
        )

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """Zernike coefficients of states of misalignment.

        Parameters
        ----------
        states : ndarray, shape (n, 4)
            In units of the range, order of `DEGREES_OF_FREEDOM`.

        Returns
        -------
        ndarray, shape (n, F, J)
            From Noll index `FIRST_NOLL` to the highest, in waves.

        Raises
        ------
        RayTracingError
            If a state lies outside the range or a field is vignetted.
        """
        states = np.atleast_2d(np.asarray(states, float))
        check_states(states, self.unit)
        return np.stack([self._trace(number, state) for number, state in enumerate(states)])

    def _trace(self, number: int, state: np.ndarray) -> np.ndarray:
        rays = self._rays.copy()
        misaligned(self.optic, state * self.unit).trace(rays)
        lost = (rays.vignetted | rays.failed).reshape(len(self.fields), -1)
        if lost.any():
            vignetted = lost.any(axis=1)
            field = int(vignetted.argmax())
            x, y = np.rad2deg(self.fields[field])
            raise RayTracingError(
                f"state {number}, field ({x:.6g}, {y:.6g})°: {int(lost[field].sum())} of "
                f"{lost.shape[1]} rays are vignetted; {int(vignetted.sum())} of "
                f"{len(lost)} fields are"
            )
        pupil = slice(0, self._weights.size)
        landing, velocity = (a.reshape(*lost.shape, 3)[:, pupil] for a in (rays.r, rays.v))
        lead = self._lead(landing, velocity, rays.t.reshape(lost.shape)[:, pupil])
        return np.asarray((lead @ self._fit.T)[:, FIRST_NOLL - 1 :])

    def _lead(self, landing: np.ndarray, velocity: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Lead of every ray on the mean of its field at the reference sphere, in waves."""
        direction = velocity / np.linalg.norm(velocity, axis=-1, keepdims=True)
        centre = np.einsum("n,fnk->fk", self._weights, landing)
        offset = landing - centre[:, None]
        along = (offset * direction).sum(-1)
        # Back along the ray to the sphere, |offset + s·direction| = radius with s < 0.
        beyond = (offset**2).sum(-1) - self.optic.sphereRadius**2
        path = path - along - np.sqrt(along**2 - beyond)
        return np.asarray((path @ self._weights[:, None] - path) / self.wavelength)


def annulus_points(highest: int, obscuration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points and weights that integrate products of Zernike polynomials over an annulus.

    Gauss–Legendre in r², and at least as many spokes as the highest product
    needs; a multiple of 8, so that mirror symmetries hold to rounding.

    Parameters
    ----------
    highest : int
        Highest Noll index.
    obscuration : float
        Linear central obscuration.

    Returns
    -------
    x, y, weights : ndarray, shape (n,)
        In pupil radii; the weights sum to 1.
    """
    order = noll_to_nm(highest)[0]
    nodes, weights = np.polynomial.legendre.leggauss(order)
    spokes = 8 * -(-(2 * order + 1) // 8)
    inner = obscuration**2
    radius = np.sqrt(inner + (1.0 - inner) * 0.5 * (nodes + 1.0))
    angle = 2.0 * np.pi * np.arange(spokes) / spokes
    x, y = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    return x.ravel(), y.ravel(), np.repeat(0.5 * weights / spokes, spokes)


def build_optic(
    prescription: Prescription, telescope: Telescope, defocus: float = 0.0
) -> CompoundOptic:
    """The aligned telescope, a batoid.CompoundOptic with items M1, D, and M2 and lenses if any.

    `defocus` is the distance of the detector beyond best focus, in metres. batoid is
    imported only here and where rays are launched: no other scene depends on it.
    """
    import batoid

    def at(z: float) -> Any:
        return batoid.CoordSys().shiftLocal([0.0, 0.0, z])

    def clear(radius: float) -> Any:
        return batoid.ObscNegation(batoid.ObscCircle(radius))

    radius, p = 0.5 * telescope.diameter_m, prescription
    annulus = batoid.ObscNegation(batoid.ObscAnnulus(telescope.obscuration * radius, radius))
    vacuum = batoid.ConstMedium(1.0)
    glass = p.glass and batoid.SellmeierMedium(*p.glass.sellmeier_b, *p.glass.sellmeier_c_um2)

    def conic(mirror: Mirror) -> Any:
        if mirror.conic == -1.0:  # of which Quadric finds no point on the axis
            return batoid.Paraboloid(mirror.radius_m)
        return batoid.Quadric(mirror.radius_m, mirror.conic)

    def built(name: str, lens: Lens) -> Any:
        front = (lens.front_radius_m, lens.front_vertex_m, vacuum, glass)
        back = (lens.back_radius_m, lens.back_vertex_m, glass, vacuum)
        sides = [
            batoid.RefractiveInterface(
                batoid.Sphere(radius),
                name=f"{name} {side}",
                coordSys=at(vertex),
                obscuration=clear(lens.clear_radius_m),
                inMedium=before,
                outMedium=after,
            )
            for side, (radius, vertex, before, after) in (("front", front), ("back", back))
        ]
        return batoid.Lens(sides, name=name, medium=glass)

    items = [
        batoid.Mirror(
            conic(p.primary),
            name="M1",
            coordSys=at(p.primary.vertex_m),
            obscuration=annulus if telescope.obscuration else clear(radius),
        ),
    ]
    beyond = 1.0  # a single mirror sends the light up
    if p.secondary:
        beyond = -1.0
        items.append(
            batoid.Mirror(
                conic(p.secondary),
                name="M2",
                coordSys=at(p.secondary.vertex_m),
                obscuration=clear(p.secondary.clear_radius_m),
            )
        )
    items += [built(*item) for item in p.ordered_lenses]
    detector = at(p.best_focus_m + beyond * defocus)
    items.append(batoid.Detector(batoid.Plane(), name="D", coordSys=detector, obscuration=None))
    return batoid.CompoundOptic(
        items,
        name=p.name,
        backDist=p.launch_distance_m,
        sphereRadius=p.reference_sphere_m,
        pupilSize=telescope.diameter_m,
        pupilObscuration=telescope.obscuration,
        stopSurface=batoid.Interface(
            batoid.Plane(), name="entrance pupil", coordSys=at(p.entrance_pupil_m)
        ),
    )
