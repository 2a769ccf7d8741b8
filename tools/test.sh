#!/usr/bin/env bash
# Makes .venv with the test extra and runs the whole test suite. Safe to run again; arguments go to pytest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ -x .venv/bin/python ] || python3 -m venv .venv
echo "installing into .venv (about a minute the first time)"
.venv/bin/python -m pip install -qq --disable-pip-version-check --editable '.[coco,test]'
export OPENBLAS_NUM_THREADS=1
exec .venv/bin/python -m pytest -m 'not peers' --numprocesses auto --dist loadfile "$@"
