#!/bin/sh
# Run snakemake alone in this folder, and never beside jobs of a run that was killed: those
# carry PSFDAE_RUN in their environment. When none is left, Snakemake's own lock is stale.
set -eu

jobs_left() {
    grep -lsxzF "PSFDAE_RUN=$PWD" /proc/[0-9]*/environ 2>/dev/null | grep -q .
}

if command -v flock >/dev/null 2>&1; then
    mkdir -p .snakemake
    exec 9>.snakemake/psfdae.lock
    if ! flock --nonblock 9 || jobs_left; then
        echo "Another run is active in this folder; waiting for it to end." >&2
        flock 9
        while jobs_left; do sleep 1; done
    fi
    program=$1
    shift
    [ -z "$(ls .snakemake/locks 2>/dev/null)" ] || "$program" --unlock "$@" >/dev/null 2>&1 || true
    set -- "$program" "$@"
fi
export PSFDAE_RUN="$PWD"
exec "$@"
