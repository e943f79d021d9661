"""What `snakemake` runs in this folder. Another project takes workflow/Snakefile as a module."""

import atexit
import sys

from psfdae_paper.workflow.run import close_target


include: "workflow/Snakefile"


# An included file has no say in this.
workflow.default_target = "all"


# The last line of a failed command names the target that a mistyped one resembles.
if hint := close_target(sys.argv[1:], [rule.name for rule in workflow.rules]):
    atexit.register(print, hint, file=sys.stderr)
