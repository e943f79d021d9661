#!/bin/sh
# Build $TARGETS, by default everything, with the snakemake command that is given; then the report, a
# comparison with the run of record, and a list of what to open. -f: a target is no pattern of files.
set -feu

case "$TRACK" in
    '') ;;
    live) export PSFDAE_EPOCHS=psfdae_paper.stages.track:logger ;;
    *) echo "TRACK=$TRACK: live, or nothing"; exit 2 ;;
esac
# The 24 × 24 trainings take longest; started last, one would run alone in the end.
first=''
[ -n "$TARGETS" ] || first='--prioritize scene2'
sh workflow/locked.sh "$@" $first -- $TARGETS
psfdae paper manifest "$PSFDAE_RESULTS"
sh workflow/report.sh "$@"
if [ "$PSFDAE_RESULTS" = results ] && [ -d results/evaluation ]; then
    psfdae paper compare results results/reference || true
fi

show() { [ ! -e "$1" ] || printf '  %-36s %s\n' "${3:-$1}" "$2"; }
mlflow='make mlflow'
[ "$PSFDAE_RESULTS" = results ] || mlflow="$mlflow RESULTS=$PSFDAE_RESULTS"
echo 'To open:'
show "$PSFDAE_RESULTS/report.html" 'all figures, with captions'
show "$PSFDAE_RESULTS/tables/psf_metrics.csv" 'mean errors of all methods'
show docs/results.md 'the run of record beside the paper'
show "$PSFDAE_RESULTS/mlflow.db" 'the runs side by side, in a browser' "$mlflow"
