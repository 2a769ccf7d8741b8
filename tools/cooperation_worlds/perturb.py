"""Errors of the road's end: its pose is off, and its clock runs late."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cooperation_worlds.world import ROAD_LIDAR
from log2sim.datatypes import Log, Stream, Sweep
from log2sim.geometry import NS_PER_S, rotation_from_rpy, transform

MAX_OFFSET_M, MAX_TURN_DEG, MAX_DELAY_S = 0.5, 2.0, 0.3
LEANS_DEG = 0.3  # roll and pitch of a pole are leveled better than its yaw is known
SINKS_M = 0.1


@dataclass(frozen=True)
class RoadError:
    """What is wrong with the road's end.

    Attributes
    ----------
    offset_m : (float, float, float)
        Of its position in the map.
    turn_deg : (float, float, float)
        Roll, pitch and yaw, of its axes in the map.
    delay_s : float
        Its stamps are later than its records.
    """

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay_s: float = 0.0

    @property
    def horizontal_m(self) -> float:
        """Length of the offset in the plane."""
        return float(np.hypot(*self.offset_m[:2]))


def draw_error(seed: int, share: float = 1.0, *, delayed: bool = True) -> RoadError:
    """Draw an error up to a share of 0.5 m, 2 degrees and 0.3 s, uniform in its size and in its direction."""
    rng = np.random.default_rng([seed, 9])
    angle, size = rng.uniform(-np.pi, np.pi), share * MAX_OFFSET_M * rng.random()
    offset = (size * float(np.cos(angle)), size * float(np.sin(angle)), share * SINKS_M * float(rng.uniform(-1, 1)))
    lean = share * LEANS_DEG * rng.uniform(-1, 1, 2)
    turn = share * MAX_TURN_DEG * float(rng.uniform(-1, 1))
    delay = share * MAX_DELAY_S * float(rng.random())
    return RoadError(offset, (float(lean[0]), float(lean[1]), turn), round(delay, 3) if delayed else 0.0)


def disturb(log: Log, error: RoadError) -> Log:
    """Return a log whose road's LiDAR has an error; its points and their times stay."""
    lidar = log.lidars[ROAD_LIDAR]
    pose = np.array(lidar.mount_T_lidar)
    # Turned about itself, not about the origin of the map.
    turned = transform(rotation_from_rpy(*np.deg2rad(error.turn_deg)) @ pose[:3, :3], pose[:3, 3] + error.offset_m)
    late_ns = round(error.delay_s * NS_PER_S)
    stream = log.streams[ROAD_LIDAR]
    late = Stream(ROAD_LIDAR, stream.t_ns + late_ns, _later(stream.read, late_ns))
    return log.changed(
        lidars={**log.lidars, ROAD_LIDAR: replace(lidar, mount_T_lidar=turned)},
        streams={**log.streams, ROAD_LIDAR: late},
    )


def _later(read: Callable[[int], Any], late_ns: int) -> Callable[[int], Sweep]:
    def moved(i: int) -> Sweep:
        sweep: Sweep = read(i)
        t_ns = None if sweep.t_ns is None else sweep.t_ns + late_ns
        return replace(sweep, stamp_ns=sweep.stamp_ns + late_ns, t_ns=t_ns)

    return moved
