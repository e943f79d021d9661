"""What `snakemake` runs in this folder. Another project takes workflow/Snakefile as a module."""


include: "workflow/Snakefile"


# An included file has no say in this.
workflow.default_target = "all"
