"""Small synthetic worlds with exact truth that tests of all stages can build on. Nothing is rendered before it is read."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes import TYPICAL_SIZE_M, Detections, Log, Measurements, Scenario, Waypoints
from log2sim.geometry import Array, Camera, Mount, apply, box_corners, inverse, rotation_from_rpy, transform
from log2sim.perception.boxes import fit_extents, place_boxes, top_of
from log2sim.perception.lidar.cloud import ON_GROUND_M, Cloud
from log2sim.synth.scene import Scene, scene_from_table
from log2sim.synth.synthesis import synthesize

CAR = {"id": "car", "category": "car", "size_m": [4.4, 1.8, 1.5], "waypoints": [[16.0, 2.0, 4.0], [40.0, 2.0, 4.0]]}
PARKED = {"id": "parked", "category": "car", "size_m": [4.2, 1.8, 1.5], "pose": [14.0, -4.0, 10.0]}
WALKER = {"id": "walker", "category": "pedestrian", "waypoints": [[12.0, 5.0, 1.4], [12.0, -5.0, 1.4]]}


def tiny_table(agents: list[dict[str, Any]] | None = None, **changes: Any) -> dict[str, Any]:
    """A scene as its TOML document: one street, one camera, one coarse LiDAR, the ego driving east at 3 m/s."""
    table: dict[str, Any] = {
        "name": "tiny",
        "duration_s": 1.0,
        "ego": {"waypoints": [[0.0, 0.0, 3.0], [20.0, 0.0, 3.0]], "poses": "poses"},
        "road": [{"line": [[-10.0, 0.0], [50.0, 0.0]], "width_m": 10.0}],
        "agent": [CAR, PARKED, WALKER] if agents is None else agents,
        "camera": [{"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [480, 300], "offset_s": 0.03}],
        "lidar": [
            {
                "name": "top",
                "position_m": [1.2, 0.0, 1.9],
                "channels": 24,
                "elevation_deg": [-18.0, 3.0],
                "azimuth_deg": [-60.0, 60.0],
                "azimuth_step_deg": 0.5,
                "range_m": 60.0,
            }
        ],
        "gnss": {"position_sigma_m": 0.0, "angle_sigma_deg": 0.0},
    }
    return {**table, **changes}


def tiny_toml(**changes: Any) -> str:
    """The scene file of `tiny_table`."""
    top, tables = [], []
    for key, value in tiny_table(**changes).items():
        rows = value if isinstance(value, list) and value and isinstance(value[0], dict) else [value]
        if not isinstance(rows[0], dict):
            top.append(f"{key} = {json.dumps(value)}")
        for row in rows if isinstance(rows[0], dict) else []:
            tables += [
                f"[[{key}]]" if rows is value else f"[{key}]",
                *(f"{k} = {json.dumps(v)}" for k, v in row.items()),
            ]
    return "\n".join(top + tables) + "\n"


def tiny_scene(agents: list[dict[str, Any]] | None = None, **changes: Any) -> Scene:
    """The scene of `tiny_table`."""
    return scene_from_table(tiny_table(agents, **changes))


def _read_only(read: Callable[[int], Any], i: int) -> Any:
    record = read(i)
    if isinstance(record, np.ndarray):
        record.setflags(write=False)
    return record


_MADE: dict[str, tuple[Log, Scenario]] = {}


def tiny_log(
    agents: list[dict[str, Any]] | None = None,
    *,
    seed: int = 0,
    noise_m: float = 0.02,
    observe: bool = True,
    **changes: Any,
) -> tuple[Log, Scenario]:
    """A log of about ten ticks in memory and its truth, in well under a second.

    `changes` replace whole entries of `tiny_table`; `noise_m` is the LiDAR's range noise (0 also turns dropouts and
    rounding off); without `observe` there are no labels and no `visible`. The last few logs and their records are made once.
    """
    key = repr((agents, seed, noise_m, observe, changes))
    if key not in _MADE:
        scene = tiny_scene(agents, **changes)
        calm = {"dropout": 0.0, "resolution_m": 0.0} if noise_m == 0 else {}
        lidars = tuple(spec.model_copy(update={"noise_m": noise_m, **calm}) for spec in scene.lidar)
        log, truth = synthesize(scene.model_copy(update={"lidar": lidars}), seed=seed, observe=observe)
        for stream in log.streams.values():
            object.__setattr__(stream, "read", cache(partial(_read_only, stream.read)))
        if len(_MADE) == 8:
            _MADE.pop(next(iter(_MADE)))
        _MADE[key] = log, truth
    return _MADE[key]


def waypoints(
    t_s: ArrayLike, x_m: ArrayLike = 0.0, y_m: ArrayLike = 0.0, z_m: ArrayLike = 0.0, yaw_rad: ArrayLike = 0.0, speed_mps: ArrayLike = 0.0,
    *, sigma_m: ArrayLike = 0.1, **columns: Any,
) -> Waypoints:  # fmt: skip
    """Waypoints (T,) that are all observed unless `columns` say otherwise; one value stands for all times."""
    t = np.asarray(t_s, dtype=np.float64)
    given = (x_m, y_m, z_m, yaw_rad, speed_mps, sigma_m)
    *state, sigma = (np.broadcast_to(np.asarray(v, dtype=np.float64), t.shape).copy() for v in given)
    return Waypoints(t, *state, **{"observed": np.ones(len(t), bool), "sigma_xy_m": sigma, **columns})


def cloud_at(
    xyz: ArrayLike, height: ArrayLike | None = None, *, t_s: ArrayLike = 0.0, stamp_ns: int = 10**18, origin: ArrayLike = (0.0, 0.0, 0.0),
    sensor: ArrayLike = (0.0, 0.0, 2.0), **columns: Any,
) -> Cloud:  # fmt: skip
    """A cloud of points (N, 3) about its origin; the ground is at z = 0 unless heights (N,) above it are given."""
    points = np.asarray(xyz, np.float32).reshape(-1, 3)
    above = points[:, 2] if height is None else np.asarray(height, np.float32)
    t = np.broadcast_to(np.asarray(t_s, np.float32), len(points)).copy()
    columns = {"ground": np.abs(above) <= ON_GROUND_M, "height": above, **columns}
    return Cloud(stamp_ns, np.asarray(origin, np.float64), points, t, np.asarray(sensor, np.float32), **columns)


@dataclass(frozen=True)
class Solid:
    """An upright box that a LiDAR can hit: center (3,), size (3,) length, width, height in m, yaw in rad."""

    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float] = (4.4, 1.85, 1.6)
    yaw_rad: float = 0.0


def standing(
    x_m: float, y_m: float, yaw_deg: float = 0.0, size_m: tuple[float, float, float] = (4.4, 1.85, 1.6)
) -> Solid:
    """A solid on the ground z = 0, of a typical car's size unless told otherwise."""
    return Solid((x_m, y_m, size_m[2] / 2), size_m, float(np.deg2rad(yaw_deg)))


def scan(
    solids: Sequence[Solid],
    *,
    sensor: tuple[float, float, float] = (0.0, 0.0, 1.9),
    azimuth_deg: tuple[float, float] = (-45.0, 45.0),
    elevation_deg: tuple[float, float] = (-18.0, 4.0),
    steps: tuple[int, int] = (360, 48),
    slope: tuple[float, float] = (0.0, 0.0),
    noise_m: float = 0.0,
    seed: int = 0,
) -> tuple[Array, NDArray[np.intp]]:
    """First hits (N, 3) in the map frame of a fan of rays, and what each hit (N,): the solid's index, -1 the ground.

    The ground is the plane z = slope . (x, y). Rays that hit nothing within 90 m give no point.
    """
    azimuth, elevation = (np.deg2rad(np.linspace(*r, n)) for r, n in zip((azimuth_deg, elevation_deg), steps))
    a, e = (g.ravel() for g in np.meshgrid(azimuth, elevation, indexing="ij"))
    ray = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=1)
    start = np.asarray(sensor, dtype=np.float64)
    rise = ray[:, 2] - ray[:, :2] @ slope
    above = start[2] - start[:2] @ slope
    reach = [np.where(rise < 0, above / np.where(rise < 0, -rise, 1.0), np.inf)]
    reach += [_hit(start, ray, solid) for solid in solids]
    owner = np.argmin(reach, axis=0) - 1
    nearest_m = np.min(reach, axis=0)
    seen = nearest_m < 90.0
    nearest_m = nearest_m[seen] + np.random.default_rng(seed).normal(0.0, noise_m, int(seen.sum()))
    return start + ray[seen] * nearest_m[:, None], owner[seen]


def _hit(start: Array, ray: Array, solid: Solid) -> Array:
    """Distance (N,) along rays to a solid by the slab method, inf where it is missed."""
    turn = rotation_from_rpy(0.0, 0.0, -solid.yaw_rad)
    origin, along = turn @ (start - solid.center_m), ray @ turn.T
    half = np.asarray(solid.size_m) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half - origin) / along, (half - origin) / along
    enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def camera_ahead(
    name: str = "front", *, mount: Mount = "map", at: tuple[float, float, float] = (0.0, 0.0, 1.6), yaw_rad: float = 0.0
) -> Camera:
    """A camera without distortion, 1200 x 600 px and 81 degrees wide, that looks level along a yaw."""
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    mount_T_cam = transform(rotation_from_rpy(0.0, 0.0, yaw_rad) @ axes, np.asarray(at))
    k = np.array([[700.0, 0.0, 600.0], [0.0, 700.0, 300.0], [0.0, 0.0, 1.0]])
    return Camera(name, 1200, 600, k, mount, mount_T_cam)


def apart(yaw_rad: float, other_rad: float, period_rad: float = np.pi / 2) -> float:
    """Smallest difference of two angles up to multiples of a period."""
    return abs((yaw_rad - other_rad + period_rad / 2) % period_rad - period_rad / 2)


def outline_px(camera: Camera, map_T_cam: Array, solid: Solid) -> Array:
    """The exact 2D box (4,) of a solid that lies wholly in front of the camera, cut at the image's border."""
    corners = apply(inverse(map_T_cam), box_corners(solid.center_m, solid.size_m, solid.yaw_rad)[0])
    uv = corners[:, :2] / corners[:, 2:] * [camera.K[0, 0], camera.K[1, 1]] + camera.K[:2, 2]
    wide = np.array([camera.width_px, camera.height_px])
    return np.concatenate([np.clip(uv.min(axis=0), 0, wide), np.clip(uv.max(axis=0), 0, wide)])


def measured_row(
    cluster,
    sensor=(0.0, 0.0, 1.9),
    category="car",
    *,
    camera="a",
    score=0.9,
    bottom_m=0.0,
    ends_visible=(False, False),
    t_ns=0,
    **columns,
):
    """Measure one object from its points (n, 3) in the map; `columns` replace others of the row."""
    detections = Detections(np.array([[10.0, 20, 30, 40]]) + score, np.array([score]), np.array([category], "<U16"))
    row = Measurements.unplaced(detections, t_ns=t_ns, camera=camera, sensor_m=np.asarray(sensor, dtype=float))
    cluster, typical = np.asarray(cluster, dtype=float), np.array(TYPICAL_SIZE_M[category])
    yaw, low, high = fit_extents((cluster - sensor)[:, :2], typical)
    evidence = {
        "cluster": (cluster,), "points": np.array([len(cluster)]), "yaw_rad": np.array([yaw]), "low_m": low[None],
        "high_m": high[None], "ends_visible": np.array([ends_visible]), "bottom_m": np.array([bottom_m]),
        "top_m": np.array([top_of(cluster[:, 2])]), "height_px_m": np.array([1.6]),
    }  # fmt: skip
    return place_boxes(replace(row, **evidence | columns))


def rows_at(xy, category="car", *, sigma_m=0.5, source="topdown", camera="a", score=0.9, t_ns=0, **columns):
    """Measure objects at positions (M, 2) on flat ground without LiDAR points; `columns` replace others of the rows."""
    xy = np.asarray(xy, dtype=float)
    m = len(xy)
    names = np.broadcast_to(np.array(category, dtype="<U16"), m).copy()
    height = np.array([TYPICAL_SIZE_M[str(c)][2] for c in names]).reshape(m)
    detections = Detections(np.zeros((m, 4)), np.full(m, score), names)
    rows = Measurements.unplaced(detections, t_ns=0, camera="", sensor_m=np.zeros(3))
    known = {
        "t_ns": np.broadcast_to(t_ns, m).astype(np.int64), "camera": np.broadcast_to(np.array(camera, "<U16"), m).copy(),
        "center_m": np.column_stack([xy, height / 2]), "covariance": np.tile(np.eye(2) * sigma_m**2, (m, 1, 1)),
        "source": np.broadcast_to(np.array(source, dtype="<U16"), m).copy(), "bottom_m": np.zeros(m),
    }  # fmt: skip
    return replace(rows, **known | columns)
