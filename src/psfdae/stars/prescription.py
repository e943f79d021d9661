"""A two-mirror telescope with a lens corrector, as batoid traces it."""

from __future__ import annotations

from typing import Any

from psfdae.configuration.prescription import Lens, Prescription
from psfdae.configuration.telescope import Telescope


def build_optic(prescription: Prescription, telescope: Telescope, defocus: float = 0.0) -> Any:
    """The aligned telescope with items M1, M2, the lenses and D, a batoid.CompoundOptic.

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
    silica = batoid.SellmeierMedium(*p.glass.sellmeier_b, *p.glass.sellmeier_c_um2)

    def built(name: str, lens: Lens) -> Any:
        front = (lens.front_radius_m, lens.front_vertex_m, vacuum, silica)
        back = (lens.back_radius_m, lens.back_vertex_m, silica, vacuum)
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
        return batoid.Lens(sides, name=name, medium=silica)

    items = [
        batoid.Mirror(
            batoid.Quadric(p.primary.radius_m, p.primary.conic),
            name="M1",
            coordSys=at(p.primary.vertex_m),
            obscuration=annulus if telescope.obscuration else clear(radius),
        ),
        batoid.Mirror(
            batoid.Quadric(p.secondary.radius_m, p.secondary.conic),
            name="M2",
            coordSys=at(p.secondary.vertex_m),
            obscuration=clear(p.secondary.clear_radius_m),
        ),
        *(built(*item) for item in p.ordered_lenses),
        batoid.Detector(
            batoid.Plane(), name="D", coordSys=at(p.best_focus_m - defocus), obscuration=None
        ),
    ]
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
