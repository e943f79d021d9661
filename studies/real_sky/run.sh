#!/bin/sh
# usage: run.sh IMAGE LIST.csv "SPLITS" [WORDS...]
# All that compare.py needs, in the current folder; what is there stays. SPLITS are of 0 to 4, and
# "0 1" for instance leaves the others to another process; WORDS go to psfdae train. The
# variable SETTINGS, "psfex-0.5-2 epsf-1-0" for instance, leaves out other settings.
set -eu

here=$(dirname "$(realpath "$0")")
image=$1 list=$2 splits=$3
shift 3
settings=${SETTINGS:-"epsf-0.5-0 epsf-1-0
    psfex-0.5-1 psfex-0.5-2 psfex-0.5-3 psfex-1-1 psfex-1-2 psfex-1-3
    piff-0.5-1 piff-0.5-2 piff-0.5-3 piff-1-1 piff-1-2 piff-1-3"}
for split in $splits; do
    ours=ours$split
    [ -f $ours/report.csv ] || python "$here/ours.py" $split "$image" --catalogue "$list" \
        --method field --out $ours framing.stamp_px=10 "methods=[field]" "$@"
    "$PEERS" "$here/faint.py" "$image" $ours/selection.csv faint$split.npz
    for setting in $settings; do
        # shellcheck disable=SC2046
        [ -f $setting-$split.npz ] || "$PEERS" "$here/peers.py" $(echo $setting | tr - ' ') \
            "$image" $ours/selection.csv faint$split.npz $setting-$split.npz
    done
done
