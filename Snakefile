"""What `snakemake` runs in this folder. Another project takes workflow/Snakefile as a module."""


include: "workflow/Snakefile"
