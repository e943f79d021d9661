#!/bin/sh
# All of table.csv for one seed, in an empty folder:  sh run.sh SEED [SRC_OF_ANOTHER_COMMIT NAME]
set -eu
here=$(cd "$(dirname "$0")" && pwd)
stem=crowded_$1
sky() { python "$here/crowded_sky.py" "$@"; }
model() {  # name
    psfdae train "$stem.fits" --catalogue "$stem.csv" --origin 0 --method field --out "$stem-$1" --overwrite
    psfdae psf "$stem-$1/$stem.psf.safetensors" --grid 7x7 --out "$stem-$1.fits" --overwrite
}
sky image "$1" "$stem"
model psfdae
set -- "$1" "${2:-}" "${3:-}" "true=true" "psfdae=$stem-psfdae.fits"
if [ -n "$2" ]; then
    (export PYTHONPATH="$2"; model other)
    set -- "$@" "$3=$stem-other.fits"
fi
if command -v psfex >/dev/null; then
    source-extractor "$stem.fits" -c /dev/null -PARAMETERS_NAME "$here/psfex.param" -CATALOG_NAME "$stem.cat" \
        -CATALOG_TYPE FITS_LDAC -FILTER N -DETECT_THRESH 5 -ANALYSIS_THRESH 5 -PHOT_APERTURES 12 \
        -GAIN 1 -PIXEL_SCALE 0.5 -SATUR_LEVEL 60000 -BACK_SIZE 128 -VERBOSE_TYPE QUIET \
        -STARNNW_NAME /usr/share/source-extractor/default.nnw
    for degree in 2 3; do
        psfex "$stem.cat" -c /dev/null -PSFVAR_DEGREES $degree -PSF_SIZE 35,35 -PSF_SAMPLING 0.5 -SAMPLE_MINSN 100 \
            -CHECKPLOT_TYPE NONE -CHECKIMAGE_TYPE NONE -WRITE_XML N -PSF_SUFFIX ".$degree.psf" -VERBOSE_TYPE QUIET
        set -- "$@" "PSFEx, degree $degree=$stem.$degree.psf"
    done
fi
shift 3
for psf in "$@"; do sky photometry "$stem" table.csv "$psf"; done
psfdae photometry "$stem.fits" --detect --model "$stem-psfdae/$stem.psf.safetensors" --out "$stem-psfdae.ecsv" --overwrite
sky with_truth "$stem" "$stem-truth.ecsv"
sky pipeline "$stem" "$stem-photutils.ecsv" true
for name in psfdae truth photutils; do sky completeness "$stem" found.csv "$name=$stem-$name.ecsv"; done
sky apertures "$stem" apertures.csv "$stem-psfdae/$stem.psf.safetensors"
