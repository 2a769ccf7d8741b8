#!/usr/bin/env bash
# Makes .venv with the test extra and runs the whole test suite. Safe to run again; arguments go to pytest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ -x .venv/bin/python ] || python3 -m venv .venv
# Python compiles what is imported, which is a small part of what is installed.
export PIP_COMPILE=0 PIP_DISABLE_PIP_VERSION_CHECK=1 OPENBLAS_NUM_THREADS=1
unset PYTHONDONTWRITEBYTECODE
if [ ! .venv/installed -nt pyproject.toml ]; then
    echo "installing into .venv (about a minute the first time)"
    .venv/bin/python -m pip install -qq --editable '.[coco,test]'
    touch .venv/installed
fi
# Packages that some tests can do without, such as torch; they are skipped where these cannot be installed.
for package in ${LOG2SIM_TEST_PACKAGES:-}; do
    timeout 600 .venv/bin/python -m pip install -qq "$package" || echo "no $package: its tests will be skipped"
done
exec .venv/bin/python -m pytest -m 'not peers' --numprocesses auto --dist loadfile --no-loadscope-reorder "$@"
