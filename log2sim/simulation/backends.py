"""The simulators that `--simulator` can name."""

from __future__ import annotations

from pathlib import Path

from log2sim.errors import ConfigError
from log2sim.files.plugins import nearest
from log2sim.simulation.simulators import ExternalSimulator

SIMULATORS = ("own", "carla")


def external_simulator(name: str, address: str | None, port: int | None, map: str | None) -> ExternalSimulator | None:
    """Return the simulator of a name, with an address, port and world (town or OpenDRIVE file); None for the embedded one.

    Raises `ConfigError` for an unknown name, options that it does not use, or a missing file.
    """
    if name not in SIMULATORS:
        raise ConfigError(
            f"unknown simulator '{name}'{nearest(name, list(SIMULATORS))}; known: {', '.join(SIMULATORS)}"
        )
    if name == "own":
        if address is not None or port is not None or map is not None:
            raise ConfigError("--host, --port and --map are for --simulator carla; add it, or leave them out")
        return None
    from log2sim.simulation.carla.simulator import CarlaServer, CarlaSimulator

    opendrive = Path(map) if map is not None and map.endswith(".xodr") else None
    if opendrive is not None and not opendrive.is_file():
        raise ConfigError(f"--map: {opendrive}: no such file")
    own = CarlaServer()
    return CarlaSimulator(
        CarlaServer(address or own.host, port or own.port, town=None if opendrive else map, opendrive=opendrive)
    )
