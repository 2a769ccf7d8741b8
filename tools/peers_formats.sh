#!/usr/bin/env bash
# Makes the environments in which software of others reads our exports, in .peers or in $LOG2SIM_PEERS. Arguments choose
# some of: metadrive commonroad. The tests marked `peers` use those that are there and skip the others.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
where="${LOG2SIM_PEERS:-.peers}"

environment() { # NAME PACKAGES...
    [ -x "$where/$1/bin/python" ] || python3 -m venv "$where/$1"
    echo "installing into $where/$1"
    "$where/$1/bin/python" -m pip install -qq --disable-pip-version-check "${@:2}"
}

metadrive() {
    environment metadrive metadrive-simulator==0.4.3
    # Models and textures are needed for rendering only. Without these two files they would be downloaded at the start.
    local assets
    assets="$("$where/metadrive/bin/python" -c 'from importlib.util import find_spec; print(find_spec("metadrive").submodule_search_locations[0])')/assets"
    mkdir -p "$assets/textures/grass1"
    echo 0.4.3 >"$assets/version.txt"
    : >"$assets/textures/grass1/GroundGrassGreen002_COL_1K.jpg"
}

commonroad() {
    # This checker needs modules that later releases of commonroad-io have moved.
    environment commonroad commonroad-io==2024.3 commonroad-drivability-checker==2025.4.0
}

for name in "${@:-metadrive commonroad}"; do
    for one in $name; do "$one"; done
done
