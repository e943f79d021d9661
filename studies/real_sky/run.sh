#!/bin/sh
# usage: run.sh IMAGE LIST.csv [SPLITS]
# All that compare.py needs, in the current folder; what is there stays. SPLITS, "0 1" for instance,
# leaves the others to another process.
set -eu

here=$(dirname "$(realpath "$0")")
for split in ${3:-0 1 2 3 4}; do
    ours=ours$split
    [ -f $ours/report.csv ] || python "$here/ours.py" $split "$1" --catalogue "$2" \
        --pixel-scale 5.21 --saturate 4000 --method field --out $ours framing.stamp_px=10 \
        calibration_stars.misfit=1e6 calibration_stars.neighbour_ratio=1e6 "methods=[field]"
    "$PEERS" "$here/faint.py" "$1" $ours/selection.csv faint$split.npz
    for setting in "epsf 0.5 0" "epsf 1 0" \
        "psfex 0.5 1" "psfex 0.5 2" "psfex 0.5 3" "psfex 1 1" "psfex 1 2" "psfex 1 3" \
        "piff 0.5 1" "piff 0.5 2" "piff 0.5 3" "piff 1 1" "piff 1 2" "piff 1 3"; do
        file=$(echo $setting | tr ' ' -)-$split.npz
        # shellcheck disable=SC2086
        [ -f "$file" ] || "$PEERS" "$here/peers.py" $setting "$1" \
            $ours/selection.csv faint$split.npz "$file"
    done
done
