"""Coordinates of an export: near its origin, or those of the user's map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.datatypes import MapFrame, Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import Array, whole_kilometers, wrap_angle


@dataclass(frozen=True)
class ExportPlacement:
    """Converts x, y, z, heading between a scenario and an export.

    Positions of the scenario plus `offset_m` are coordinates of `projection`. With a `target` they are projected into
    it, else they stay on their axes; then `origin_m` is subtracted.

    Attributes
    ----------
    origin_m, offset_m : (3,) tuple of float, m
    projection, target : str or None
        PROJ strings.
    """

    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    projection: str | None = None
    target: str | None = None

    def forward(self, states: Array) -> Array:
        """Convert states (N, 4) x, y, z, heading from the scenario to the export."""
        origin: Array = np.array([*self.origin_m, 0.0])
        offset: Array = np.array([*self.offset_m, 0.0])
        if self.target is None:
            return states - origin
        return self._projected(states + offset, self.projection, self.target) - origin

    def back(self, states: Array) -> Array:
        """Convert states (N, 4) from the export to the scenario."""
        origin: Array = np.array([*self.origin_m, 0.0])
        offset: Array = np.array([*self.offset_m, 0.0])
        if self.target is None:
            return states + origin
        return self._projected(states + origin, self.target, self.projection) - offset

    @staticmethod
    def _projected(states: Array, source: str | None, target: str | None) -> Array:
        """Project states; a heading turns by as much as a step of 1 m along it."""
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


def near_origin(scenario: Scenario) -> ExportPlacement:
    """Subtract whole kilometers, none while all agents are near the map's origin, so that float32 keeps half a millimeter."""
    xyz = np.concatenate(
        [np.column_stack([a.waypoints.x_m, a.waypoints.y_m, a.waypoints.z_m]) for a in scenario.agents]
    )
    x, y, z = whole_kilometers(xyz)
    return ExportPlacement((float(x), float(y), float(z)))


def on_map(frame: MapFrame, projection: str | None, offset_m: tuple[float, float, float]) -> ExportPlacement:
    """Place positions on a map, whose projected coordinates are its own plus its offset.

    Where either side lacks a projection, the scenario's axes are taken to be those of the map.
    """
    if frame.projection is None or not projection:
        return ExportPlacement()
    if _proj_parameters(frame.projection) == _proj_parameters(projection):
        x, y, z = (float(m - s) for m, s in zip(offset_m, frame.offset_m))
        return ExportPlacement((x, y, z))
    return ExportPlacement(offset_m, frame.offset_m, frame.projection, projection)


def geo_reference(projection: str) -> str:
    """Return a PROJ string with the same coordinates in the words that esmini reads, too; others stay as they are.

    Notes
    -----
    esmini requires lat_0 and lon_0, and knows neither R, south, no_defs nor type. UTM is the transverse Mercator projection
    about the middle of its zone, a sphere of radius R has both axes R, and PROJ takes 0 for an origin that is not given.
    """
    words = dict(w.partition("=")[::2] for w in projection.split() if w.split("=")[0] not in ("+no_defs", "+type"))
    if words.get("+proj") == "utm" and words.get("+zone", "").isdecimal():
        middle_deg, false_northing = 6 * int(words.pop("+zone")) - 183, 10_000_000 if "+south" in words else 0
        words.pop("+south", None)
        words |= {"+proj": "tmerc", "+lat_0": "0", "+lon_0": str(middle_deg), "+k": "0.9996", "+x_0": "500000"}
        words["+y_0"] = str(false_northing)
    if "+R" in words:
        words["+a"] = words["+b"] = words.pop("+R")
    if "+proj" in words:
        words = {"+lat_0": "0", "+lon_0": "0"} | words
    return " ".join(f"{name}={value}" if value else name for name, value in words.items())


def _proj_parameters(projection: str) -> list[str]:
    """Return the parameters of a PROJ string in order, without those for heights and file names."""
    words = geo_reference(projection).split()
    return sorted(w for w in words if not w.startswith(("+geoidgrids", "+nadgrids", "+vunits")))


def _transformer(source: str, target: str) -> Any:
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    systems = []
    for text in (source, target):
        words = _proj_parameters(text)
        if not any(w.startswith("+proj=") for w in words):
            raise ConfigError(f"'{text[:100]}' is no PROJ string, expected one such as +proj=utm +zone=32")
        try:
            systems.append(CRS.from_proj4(" ".join(words)))
        except ProjError as error:
            raise ConfigError(f"'{text[:100]}' is no projection: {error}") from None
    return Transformer.from_crs(systems[0], systems[1], always_xy=True)
