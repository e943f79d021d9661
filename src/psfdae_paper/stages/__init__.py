"""Stages of the reproduction: each reads files, calls the science and writes files."""

GROUPS = {
    "example": "Simulate an image of a star field, or a night of a telescope.",
    "paper alignment": "Scene 3: alignment of a secondary mirror (config/dataset/alignment.yaml).",
    "paper alignment figure": "Draw a figure of scene 3 as PNG.",
    "paper figure": "Draw a figure as PNG from finished products.",
    "paper night": "Model the images of a night of a telescope, and tell which are good.",
    "paper sweep": "Train many variants of a model and compare them (config/sweep).",
}
"""Help of the first words of commands of several words."""

SECTIONS = {"Telescopes": ("simulate",), "The paper": ("paper",)}
"""Headings of `psfdae --help` with the commands below each."""

REQUIRED = {"simulate": "hydra", "paper": "hydra"}
"""Modules of an extra without which a command is not listed."""
