#!/bin/sh
# Make the locked environment in a folder, with the interpreter $PYTHON: hashed files only. What has no
# wheel is built with the pinned tools of build.lock; torch comes from the index $TORCH_INDEX.
set -eu
venv=$1
python=${PYTHON:-python3}
torch=$(sed -nE 's/^torch==//p' requirements/torch.in)
lock=torch

"$python" -c 'import sys; sys.version_info >= (3, 11) or sys.exit("psfdae needs Python 3.11 or newer")'
"$python" -m venv "$venv"
pip() { "$venv/bin/python" -m pip --disable-pip-version-check --no-input "$@"; }
hashed() {
    echo "pip install $*"
    pip install --quiet --require-hashes --no-build-isolation "$@"
}

hashed --no-deps --requirement requirements/build.lock
hashed --no-deps --requirement requirements.lock
set -- ${TORCH_INDEX:+--index-url "$TORCH_INDEX"}
! pip index versions torch "$@" | grep -F "$torch+cpu" >/dev/null || lock=torch-cpu
hashed "$@" --constraint requirements/$lock.lock "torch==$torch"
pip install --quiet --no-index --no-deps --no-build-isolation --editable .
