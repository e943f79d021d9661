"""Wavefront sensing: the aberrations of a telescope from the images of its stars."""
