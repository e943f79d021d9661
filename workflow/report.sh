#!/bin/sh
# Gather the figures of a finished run, with the snakemake command that is given, in report.html of its
# folder. Targets on request are in the report where they have been built.
set -feu

if [ -z "$TARGETS" ]; then
    TARGETS=all
    add() { [ ! -e "$PSFDAE_RESULTS/$1" ] || TARGETS="$TARGETS $2"; }
    add figures/benchmark/inference.png benchmark
    add .stability_passed stability
    add tables/psf_efficiency.csv bounds
    add figures/own_stars/strip.png from_stars_example
fi
mkdir -p .snakemake
export PYTHONWARNINGS='ignore:coroutine:RuntimeWarning'
[ -z "$(command -v flock)" ] || set -- flock .snakemake/psfdae.lock "$@"
"$@" --report "$PSFDAE_RESULTS/.report.html" -- $TARGETS
mv "$PSFDAE_RESULTS/.report.html" "$PSFDAE_RESULTS/report.html"
