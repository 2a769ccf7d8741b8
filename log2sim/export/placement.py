"""Where positions of a scenario lie in the coordinates of an export: near its origin, or in those of the user's map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.datatypes import MapFrame, Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import Array, whole_kilometers, wrap_angle


@dataclass(frozen=True)
class Placement:
    """Turns local x, y, z, heading of a scenario into those of an export, and back.

    Local positions plus `offset_m` are coordinates of `projection`. Without a `target` they stay on these axes, with one
    they are projected anew; then `origin_m` is subtracted.
    """

    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    projection: str | None = None
    target: str | None = None

    def forward(self, states: Array) -> Array:
        """States (N, 4) x, y, z, heading of the scenario in the export."""
        origin: Array = np.array([*self.origin_m, 0.0])
        offset: Array = np.array([*self.offset_m, 0.0])
        if self.target is None:
            return states - origin
        return self._projected(states + offset, self.projection, self.target) - origin

    def back(self, states: Array) -> Array:
        """States (N, 4) of the export in the scenario."""
        origin: Array = np.array([*self.origin_m, 0.0])
        offset: Array = np.array([*self.offset_m, 0.0])
        if self.target is None:
            return states + origin
        return self._projected(states + origin, self.target, self.projection) - offset

    @staticmethod
    def _projected(states: Array, source: str | None, target: str | None) -> Array:
        """States in another projection; a heading turns by what a step of 1 m along it turns."""
        transformer = _transformer(str(source), str(target))
        x, y, z, heading = states.T
        east, north = transformer.transform(x, y)
        ahead = transformer.transform(x + np.cos(heading), y + np.sin(heading))
        turned = wrap_angle(np.arctan2(ahead[1] - north, ahead[0] - east) - heading)
        out = np.column_stack([east, north, z, heading + turned])
        if not np.isfinite(out).all():
            raise ConfigError(
                f"positions of the scenario have no coordinates in '{target}'; is this the map of the same place?"
            )
        return out


def near_origin(scenario: Scenario) -> Placement:
    """Subtract whole kilometers, none while all agents are near the map's origin, so that float32 keeps half a millimeter."""
    xyz = np.concatenate(
        [np.column_stack([a.waypoints.x_m, a.waypoints.y_m, a.waypoints.z_m]) for a in scenario.agents]
    )
    x, y, z = whole_kilometers(xyz)
    return Placement((float(x), float(y), float(z)))


def on_map(frame: MapFrame, projection: str | None, offset_m: tuple[float, float, float]) -> Placement:
    """Positions in the coordinates of a map: projected coordinates are its own plus its offset.

    Where either side lacks a projection, the scenario's local axes are taken for the map's.
    """
    if frame.projection is None or not projection:
        return Placement()
    if _words(frame.projection) == _words(projection):
        x, y, z = (float(m - s) for m, s in zip(offset_m, frame.offset_m))
        return Placement((x, y, z))
    return Placement(offset_m, frame.offset_m, frame.projection, projection)


def _words(projection: str) -> list[str]:
    """The parameters of a PROJ string in order, without those that only concern heights or name files."""
    return sorted(
        w for w in projection.split() if not w.startswith(("+geoidgrids", "+nadgrids", "+vunits", "+no_defs", "+type"))
    )


def _transformer(source: str, target: str) -> Any:
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    systems = []
    for text in (source, target):
        words = _words(text)
        if not any(w.startswith("+proj=") for w in words):
            raise ConfigError(f"'{text[:100]}' is no PROJ string, expected one such as +proj=utm +zone=32")
        try:
            systems.append(CRS.from_proj4(" ".join(words)))
        except ProjError as error:
            raise ConfigError(f"'{text[:100]}' is no projection: {error}") from None
    return Transformer.from_crs(systems[0], systems[1], always_xy=True)
