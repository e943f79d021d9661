"""Commands of the library: each reads files, calls the functions of Python, and writes files."""

SECTIONS = {
    "Your images": ("from-stars", "predict", "photometry", "exposure", "psf"),
    "Models": ("describe",),
    "Telescopes": ("wavefront",),
}
"""Headings of `psfdae --help` with the commands below each."""
