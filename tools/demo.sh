#!/usr/bin/env bash
# Makes .venv, installs log2sim, reconstructs samples/crossing, replays it and compares it with its truth. Safe to run again.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ -x .venv/bin/python ] || python3 -m venv .venv
echo "installing into .venv (about a minute the first time)"
.venv/bin/python -m pip install -qq --disable-pip-version-check --editable '.[coco]'
.venv/bin/python tools/demo.py
echo "to run log2sim yourself: cd $(printf %q "$PWD") && . .venv/bin/activate && log2sim --help"
