"""Commands of the library: each reads files, calls the functions of Python, and writes files."""

SECTIONS = {
    "Your images": (
        "train",
        "validate",
        "detect",
        "predict",
        "photometry",
        "residual",
        "adapt",
        "psf",
        "describe",
        "example",
    ),
    "Telescopes": ("wavefront",),
}
"""Headings of `psfdae --help` with the commands below each."""

GROUPS = {"paper": "Stages of the reproduction of the paper, which the workflow runs."}
"""Help of the first words of commands of several words."""

FORMER_NAMES = {
    "from-stars": "train",
    "exposure": "adapt",
    "example-field": "example field",
    "example-night": "example night",
}
"""New names of commands by their former ones, which work for one version more."""
