#!/usr/bin/env bash
# Sets up the software of others that the tests marked `peers` ask about our exports, each in its own environment, since
# their versions of numpy differ. A line: name of the environment, then its packages.
# Usage: bash tools/peers.sh [NAME ...] && pytest -m peers
# The folder is $LOG2SIM_PEERS, by default .peers beside this checkout's files. An environment that is complete stays as it is.
# esmini is no Python package: name its binary in $LOG2SIM_ESMINI.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
folder=${LOG2SIM_PEERS:-.peers}
environments=(
    "qc asam-qc-openscenarioxml==1.0.0 asam-qc-opendrive==1.0.0 numpy<2"
    "carla carla>=0.9.16 numpy"
    "sumo eclipse-sumo>=1.20"
    "scenariogeneration scenariogeneration>=0.16"
    "metadrive metadrive-simulator==0.4.3"
    "commonroad commonroad-io==2024.3 commonroad-drivability-checker==2025.4.0" # which needs modules that later releases moved
    "omega_prime omega-prime==0.3.7"
    "lanelet2 lanelet2==1.2.3"
    "openlabel vcd==6.0.3 jsonschema" # whose schema of OpenLABEL 1.0.0 is that of ASAM
    "rerun --editable .[rerun]"
)
# MetaDrive needs its models and textures for rendering only; without these two files it would download all at the start.
stub_assets() {
    local assets
    assets="$("$1/bin/python" -c 'from importlib.util import find_spec as f; print(f("metadrive").submodule_search_locations[0])')/assets"
    mkdir -p "$assets/textures/grass1"
    echo 0.4.3 >"$assets/version.txt"
    : >"$assets/textures/grass1/GroundGrassGreen002_COL_1K.jpg"
}
for line in "${environments[@]}"; do
    read -r name packages <<<"$line"
    if [[ $# -gt 0 && " $* " != *" $name "* ]]; then continue; fi
    if [[ "$(cat "$folder/$name/packages.txt" 2>/dev/null)" == "$packages" ]]; then
        echo "$folder/$name: is complete"
        continue
    fi
    python3 -m venv --clear "$folder/$name"
    read -ra list <<<"$packages"
    "$folder/$name/bin/pip" install --quiet --disable-pip-version-check "${list[@]}"
    if [[ $name == metadrive ]]; then stub_assets "$folder/$name"; fi
    echo "$packages" >"$folder/$name/packages.txt"
    echo "$folder/$name: made"
done
