#!/bin/sh
# Runs the tests of runtime and export on every Python from 3.11 to 3.13 that is found: make test-python. Each has an
# environment of its own, build/python-VERSION; one that has the version of .venv uses that.
# NO_TORCH=1 installs no torch, which takes several GB for each Python: then only the tests of runtime run, with models
# that a Python with torch exported before.
set -eu
cd "$(dirname "$0")/.."
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
MODSOFT_TEST_MODELS=$(mktemp -d)
export MODSOFT_TEST_MODELS
trap 'rm -rf "$MODSOFT_TEST_MODELS"' EXIT

without_torch="pytest pytest-timeout hypothesis h5py tqdm matplotlib onnx pyelastica"
failed=""
for version in 3.11 3.12 3.13; do
    interpreter=$(command -v "python$version" || true)
    for other in "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version".*/bin/python; do
        # a shim of pyenv exists for versions that are not active, too
        "${interpreter:-false}" -c '' 2>/dev/null || interpreter=$other
    done
    if ! "${interpreter:-false}" -c '' 2>/dev/null; then
        echo "Python $version: not found, not tested"
        continue
    fi
    python=.venv/bin/python
    if ! "$python" -c "import sys; sys.exit('%d.%d' % sys.version_info[:2] != '$version')" 2>/dev/null; then
        python=build/python-$version/bin/python
        [ -x "$python" ] || "$interpreter" -m venv "build/python-$version"
        install="$python -m pip install --quiet --disable-pip-version-check --use-pep517 -c constraints.txt"
        if [ "${NO_TORCH:-}" ]; then
            # shellcheck disable=SC2086 - lists of words
            $install -e '.[ndi]' $without_torch
        else
            $install -e '.[dev]'
        fi
    fi
    tests=tests/runtime
    if "$python" -c 'import torch' 2>/dev/null; then tests="$tests tests/export"; fi
    echo "Python $version: $tests"
    # shellcheck disable=SC2086 - a list of words
    "$python" -m pytest -q -m "not realtime" $tests || failed="$failed $version"
done
[ -z "$failed" ] || { echo "failed on Python$failed" >&2; exit 1; }
