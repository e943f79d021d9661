"""Optics: pupil, wavefront and the propagation from pupil to pixels.

Conventions of the whole package: the pupil is the unit disc with coordinates
(x, y); arrays are indexed [y, x]; optical path differences (OPD) are in waves;
angles in the image are in units of λ/D; a wavefront tilt of a waves per pupil
radius along x moves the image by +2a λ/D along x.
"""
