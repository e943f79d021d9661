#!/bin/sh
# Run a command, the fast tests, with each of $PYTHONS that is on this machine, in an environment
# .venvs/PYTHON-RESOLUTION: the newest versions of every dependency (RESOLUTION=highest), or the
# lowest that pyproject.toml allows (lowest-direct). versions.txt in it says which these are.
set -eu
PYTHONS=${PYTHONS:-3.11 3.12 3.13 3.14}
RESOLUTION=${RESOLUTION:-highest}

passed='' failed='' missing=''
for python in $PYTHONS; do
    if ! uv python find --quiet --system --no-python-downloads "$python" >/dev/null 2>&1; then
        missing="$missing $python"
        continue
    fi
    venv=$PWD/.venvs/$python-$RESOLUTION
    uv venv --quiet --clear --system --no-python-downloads --python "$python" "$venv"
    uv pip install --quiet --python "$venv" --resolution "$RESOLUTION" --editable '.[paper,dev]'
    uv pip install --quiet --python "$venv" --requirement requirements/build.in
    uv pip freeze --quiet --python "$venv" >"$venv/versions.txt"
    echo "Python $python, $RESOLUTION versions of its dependencies:"
    if PATH="$venv/bin:$PATH" "$@"; then passed="$passed $python"; else failed="$failed $python"; fi
done
[ -z "$missing" ] || echo "Not on this machine, skipped: Python$missing"
[ -z "$failed" ] || echo "Failed: Python$failed"
echo "Passed: Python${passed:- of no version}"
[ -n "$passed" ] && [ -z "$failed" ]
