"""Order of stamps, times of spinning LiDARs, notes of readers, and geodetic coordinates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MapFrame
from log2sim.errors import LogError
from log2sim.geometry import NS_PER_S, Array, rotation_from_rpy, transform


def count_words(words: Iterable[str]) -> str:
    """List words with their numbers, the most frequent first: "car (12), bus (1)"."""
    counts = sorted(Counter(words).items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{word} ({count})" for word, count in counts)


def note_left_out(kinds: Iterable[str], no_road_users: Collection[str], notes: list[str]) -> None:
    """Note the labels that get no category: kinds that are left out on purpose, `no_road_users`, and kinds that are not known."""
    kinds = list(kinds)
    for reason, known in (("they are no road users", True), ("their kind is not known", False)):
        words = [kind for kind in kinds if (kind in no_road_users) == known]
        if words:
            notes.append(f"labels left out because {reason}: {count_words(words)}")


def note_damaged_rows(damaged: Sequence[str], total: int, notes: list[str]) -> None:
    """Note the rows of a text, of so many in `total`, that are damaged and left out; `LogError` when no row can be read."""
    if damaged and len(damaged) == total:
        raise LogError(damaged[0])
    if damaged:
        notes.append(f"{len(damaged)} of {total} rows of labels are damaged and left out, first: {damaged[0]}")


def defer_notes(notes: list[str], *readings: Callable[[], object]) -> Callable[[], tuple[str, ...]]:
    """Return a function that reads what adds to the notes, such as the labels, and then returns the notes."""

    def read() -> tuple[str, ...]:
        for reading in readings:
            reading()
        return tuple(notes)

    return read


# Unix times beyond this do not fit into int64 nanoseconds.
MAX_TIME_S = 9_000_000_000
# The longest scenario that its schema allows; the frames of KITTI's objects, put 100 s apart, last three quarters of it.
MAX_DISTANCE_NS = 10**15

# Sweeps last a tenth of a second; a time farther from the stamp of its sweep is damage, or of another clock.
MAX_POINT_OFFSET_NS = NS_PER_S


def checked_offset_ns(t_ns: NDArray[np.number], stamp_ns: int = 0) -> NDArray[np.int64]:
    """Compute the times (N,) of points relative to the stamp of their sweep; `ValueError` for any beyond `MAX_POINT_OFFSET_NS`.

    `stamp_ns`: what they count from; 0 for times that are relative to the stamp already.
    """
    # As integers of Python, which do not overflow.
    ends = [int(t) - stamp_ns for t in (t_ns.min(), t_ns.max())] if len(t_ns) else []
    for end in ends:
        if abs(end) > MAX_POINT_OFFSET_NS:
            raise ValueError(
                f"the time of a point is {end / NS_PER_S:.6g} s off the stamp of its sweep, expected at most "
                f"{MAX_POINT_OFFSET_NS / NS_PER_S:g} s"
            )
    return t_ns.astype(np.int64) - stamp_ns


def strictly_increasing(t_ns: NDArray[np.int64], what: str, notes: list[str]) -> NDArray[np.intp]:
    """Select rows (M,) of stamps (N,), sorted so that they strictly increase; of several rows with one stamp the first.

    Rows are left out whose stamps are farther than `MAX_DISTANCE_NS` from the middle one: a single stamp of 0 would make a
    log of decades. `notes` takes remarks on wrong, unsorted and repeated stamps; `what` names the records in them.
    """
    order = np.argsort(t_ns, kind="stable")
    # As floats: differences of int64 may overflow.
    distance_ns = np.abs(t_ns.astype(np.float64) - float(t_ns[order[len(order) // 2]])) if len(order) else np.zeros(0)
    far = distance_ns > MAX_DISTANCE_NS
    if far.any():
        notes.append(
            f"{what}: {int(far.sum())} of {len(t_ns)} records have stamps more than {MAX_DISTANCE_NS // NS_PER_S} s off the others, "
            f"first {t_ns[far][0]}; left out"
        )
        return np.flatnonzero(~far)[strictly_increasing(t_ns[~far], what, notes)]
    late = np.flatnonzero(t_ns[1:] < np.maximum.accumulate(t_ns)[:-1]) + 1
    if len(late):
        notes.append(f"{what}: {len(late)} of {len(t_ns)} records out of order, first at stamp {t_ns[late[0]]}; sorted")
    repeated = np.flatnonzero(np.diff(t_ns[order]) == 0) + 1
    if len(repeated):
        first = t_ns[order[repeated[0]]]
        notes.append(f"{what}: {len(repeated)} of {len(t_ns)} records repeat a stamp, first at stamp {first}; dropped")
    return np.delete(order, repeated)


def compute_turn_share(xy_lidar: Array, start_azimuth_rad: float = np.pi) -> Array:
    """Compute the share (N,) of a clockwise turn after which a LiDAR scans points (N, >= 2), m, from the LiDAR.

    The turn starts and ends in the direction `start_azimuth_rad`, counter-clockwise from x, in (-pi, pi].
    """
    turned = (start_azimuth_rad - np.arctan2(xy_lidar[:, 1], xy_lidar[:, 0])) / (2 * np.pi)
    return np.asarray(turned + (turned < 0))


def compute_scan_offset_ns(xy_lidar: Array, turn_ns: int) -> NDArray[np.int64]:
    """Compute the time (N,) at which a LiDAR scans points (N, >= 2), m, relative to the end of its turn, which it starts at -x."""
    return np.round((compute_turn_share(xy_lidar) - 1) * turn_ns).astype(np.int64)


# Between labels of one object.
MIN_STEP_NS = 20_000_000


def select_spaced(t_ns: NDArray[np.int64], track_id: NDArray[np.str_]) -> NDArray[np.intp]:
    """Select the rows (M,) that keep the stamps of each track, in the order of the turns, apart.

    An object that crosses the direction in which the turns start is scanned at the end of one turn and at the start of the
    next: what comes sooner than `MIN_STEP_NS` after the last one that was kept is dropped.
    """
    last: dict[str, int] = {}
    keep = []
    for row, (t, track) in enumerate(zip(t_ns.tolist(), track_id.tolist())):
        if track not in last or t - last[track] >= MIN_STEP_NS:
            last[track] = t
            keep.append(row)
    return np.array(keep, dtype=np.intp)


NORTH_STEP_DEG = 1e-5


def map_frame_of(map_frame: MapFrame, latitude_deg: float, longitude_deg: float, altitude_m: float) -> MapFrame:
    """Complete a map frame: the first fix becomes the origin where none is given, a transverse Mercator the projection."""
    if map_frame.latitude_deg is not None and map_frame.longitude_deg is not None:
        latitude_deg, longitude_deg = map_frame.latitude_deg, map_frame.longitude_deg
    altitude_m = altitude_m if map_frame.altitude_m is None else map_frame.altitude_m
    projection = map_frame.projection or transverse_mercator(latitude_deg, longitude_deg)
    return MapFrame(latitude_deg, longitude_deg, altitude_m, projection)


def transverse_mercator(latitude_deg: float, longitude_deg: float) -> str:
    """PROJ string of a transverse Mercator projection about an origin, on the WGS 84 ellipsoid, in m."""
    return f"+proj=tmerc +lat_0={latitude_deg!r} +lon_0={longitude_deg!r} +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs"


def poses_from_geodetic(map_frame: MapFrame, position: Array, attitude_rad: Array, *, where: str) -> Array:
    """Poses (N, 4, 4) in projected coordinates of `map_frame`, before its offset is subtracted.

    `position` (N, 3): latitude and longitude in deg, altitude in m. `attitude_rad` (N, 3): roll, pitch, and yaw counter-clockwise
    from true east, which is turned to the grid's east by the meridian convergence. Raises `LogError` that begins with `where` when
    PROJ does not know the projection or it does not reach the points.
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
