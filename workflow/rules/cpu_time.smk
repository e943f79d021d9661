# A job's log ends with the CPU time of all its processes, to the millisecond. Snakemake's own
# column is a sample, taken 15, 45, 75 s … after the start.
shell.prefix(
    "set -euo pipefail; "
    'psfdae() {{ command psfdae "$@" && code=0 || code=$?; times; return $code; }}; '
)
