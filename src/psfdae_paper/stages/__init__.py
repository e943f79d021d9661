"""Stages of the reproduction: each reads files, calls the science and writes files."""

GROUPS = {
    "alignment": "Scene 3: alignment of a secondary mirror (config/dataset/alignment.yaml).",
    "alignment figure": "Draw a figure of scene 3 as PNG.",
    "figure": "Draw a figure as PNG from finished products.",
    "night": "Model the images of a night of a telescope, and tell which are good.",
    "sweep": "Train many variants of a model and compare them (config/sweep).",
}
"""Help of the first words of commands of two and three words."""

SECTIONS = {
    "Your images": ("example-field", "example-night"),
    "Telescopes": ("simulate",),
}
"""Headings of `psfdae --help` with the commands below each; all others are "The paper's stages"."""

REQUIRED = {"example-night": "pandas", "simulate": "hydra", "*": "hydra"}
"""Modules of an extra without which a command, or any other command (*), is not listed."""
