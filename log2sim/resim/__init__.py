"""The recorded world, seen by its LiDARs from where the ego drives now."""

from __future__ import annotations

from log2sim.resim.simulate import Simulation, resimulate, seeing, simulate, with_sensors

__all__ = ["Simulation", "resimulate", "seeing", "simulate", "with_sensors"]
