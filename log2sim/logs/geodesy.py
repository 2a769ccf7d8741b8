"""Conversion between geodetic coordinates and the local map, by PROJ."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.datatypes import MapFrame
from log2sim.errors import LogError
from log2sim.geometry import Array, rotation_from_rpy, transform

NORTH_STEP_DEG = 1e-5


def map_frame_of(map_frame: MapFrame, latitude_deg: float, longitude_deg: float, altitude_m: float) -> MapFrame:
    """Complete a map frame: the first fix becomes the origin where none is given, a transverse Mercator the projection."""
    given = map_frame.latitude_deg is not None and map_frame.longitude_deg is not None
    latitude = map_frame.latitude_deg if map_frame.latitude_deg is not None and given else latitude_deg
    longitude = map_frame.longitude_deg if map_frame.longitude_deg is not None and given else longitude_deg
    altitude = map_frame.altitude_m if map_frame.altitude_m is not None else altitude_m
    return MapFrame(latitude, longitude, altitude, map_frame.projection or transverse_mercator(latitude, longitude))


def transverse_mercator(latitude_deg: float, longitude_deg: float) -> str:
    """PROJ string of a transverse Mercator projection about an origin, on the WGS 84 ellipsoid, in m."""
    return f"+proj=tmerc +lat_0={latitude_deg!r} +lon_0={longitude_deg!r} +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs"


def poses_from_geodetic(map_frame: MapFrame, position: Array, attitude_rad: Array, *, where: str) -> Array:
    """Poses (N, 4, 4) in projected coordinates of `map_frame`, before its offset is subtracted.

    Yaw is counter-clockwise from true east and is turned to the grid's east by the meridian convergence.

    Parameters
    ----------
    map_frame : MapFrame
    position : (N, 3) float64
        Latitude and longitude in deg, altitude in m.
    attitude_rad : (N, 3) float64, rad
        Roll, pitch, yaw.
    where : str
        Names the projection in messages.

    Raises
    ------
    LogError
        When the projection is not one that PROJ knows or does not reach the points; begins with `where`.
    """
    forward = _projection(map_frame, where)
    latitude_deg, longitude_deg, altitude_m = (np.ascontiguousarray(c) for c in position.T)
    roll_rad, pitch_rad, yaw_rad = attitude_rad.T
    x, y = forward(longitude_deg, latitude_deg)
    north_x, north_y = forward(longitude_deg, latitude_deg + NORTH_STEP_DEG)
    if not (np.isfinite(x).all() and np.isfinite(north_x).all()):
        raise LogError(f"{where}: the projection '{map_frame.projection}' does not reach the GNSS fixes of the log")
    convergence = np.arctan2(-(north_x - x), north_y - y)
    z = altitude_m - (map_frame.altitude_m or 0.0)
    return transform(rotation_from_rpy(roll_rad, pitch_rad, yaw_rad + convergence), np.stack([x, y, z], axis=-1))


def geodetic_from_map(map_frame: MapFrame, xyz_m: Array, where: str) -> tuple[Array, Array, Array, Array]:
    """Latitude, longitude (deg), altitude (m) and grid convergence (rad), each (N,), of local points (N, 3)."""
    forward = _projection(map_frame, where)
    x, y, z = (np.asarray(xyz_m) + map_frame.offset_m).T
    longitude, latitude = forward(x, y, inverse=True)
    north_x, north_y = forward(longitude, latitude + NORTH_STEP_DEG)
    return latitude, longitude, z + (map_frame.altitude_m or 0.0), np.arctan2(-(north_x - x), north_y - y)


def _projection(map_frame: MapFrame, where: str) -> Any:
    from pyproj import Proj
    from pyproj.exceptions import ProjError

    try:
        projection = Proj(map_frame.projection)
    except ProjError:
        raise LogError(f"{where}: '{map_frame.projection}' is not a projection that PROJ knows") from None
    if projection.crs.is_geographic:
        raise LogError(f"{where}: '{map_frame.projection}' has degrees, not meters; give a projected one")
    return projection
