#!/bin/sh
# Run snakemake alone in this folder. Children inherit the lock, so it is free only when
# no job of an earlier run is left; then Snakemake's own lock, if any, is stale.
set -eu
if command -v flock >/dev/null 2>&1; then
    mkdir -p .snakemake
    exec 9>.snakemake/psfdae.lock
    if ! flock --nonblock 9; then
        echo "Another run is active in this folder; waiting for it to end." >&2
        flock 9
    fi
    program=$1
    shift
    "$program" --unlock "$@" >/dev/null 2>&1 || true
    set -- "$program" "$@"
fi
exec "$@"
