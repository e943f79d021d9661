#!/bin/sh
# Renew the lock files from pyproject.toml and the files beside this one; the CPU builds of torch from
# the index $TORCH_INDEX, if it is given.
set -eu

compile() {
    uv pip compile --quiet --upgrade --universal --python-version 3.11 --generate-hashes \
        --no-header --no-annotate "$@"
}
[ -z "${TORCH_INDEX:-}" ] || compile --no-deps --default-index "$TORCH_INDEX" \
    requirements/torch.in --output-file requirements/torch-cpu.lock
compile --extra paper --extra dev --overrides requirements/no-torch.txt \
    pyproject.toml requirements/torch-runtime.in --output-file requirements.lock
compile --constraints requirements.lock requirements/build.in --output-file requirements/build.lock
compile --constraints requirements.lock requirements/torch.in --output-file requirements/torch.lock
