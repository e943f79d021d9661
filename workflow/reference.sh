#!/bin/sh
# Make the finished run in results the run of record. Snakemake says which files are up to date
# with the commit checked out; psfdae refuses to take others.
set -eu

plans=$(mktemp -d)
trap 'rm -rf "$plans"' EXIT

plan() {
    name=$1
    shift
    echo "Is it up to date? $*" >&2
    snakemake --summary "$@" >"$plans/$name"
}

plan main -- reference
for sweep in dae_crop network_epochs; do
    [ ! -d "results/sweeps/$sweep" ] || plan "$sweep" --config "sweep=$sweep" -- sweep
done
[ ! -f results/tables/posterior_network.csv ] || plan network -- posterior_network
[ ! -d results/paper ] || plan paper --config preset=paper -- psf_metrics

for file in "$plans"/*; do set -- "$@" --plan "$file"; done
psfdae paper reference --results results --out results/reference "$@"
