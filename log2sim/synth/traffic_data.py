"""Data of random traffic: KITTI's object layout, and logs that go on for some seconds.

Labels are in the frame of R0_rect * Tr_velo_to_cam, which is level: y points down along gravity, so boxes stand upright in it.
A camera that looks down has its tilt in P2, which then is the intrinsics times a rotation.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, ImageLabels, Labels, Lidar, Log, Stream, Sweep
from log2sim.errors import ConfigError
from log2sim.files.documents import check_folder, refuse_folder
from log2sim.files.outputs import replaced_folder
from log2sim.files.processes import map_in_processes
from log2sim.geometry import NS_PER_S, Array, Camera, PoseTrack, apply, inverse, rotation_from_rpy, transform
from log2sim.synth import traffic
from log2sim.synth.light import light_of
from log2sim.synth.polytope_caster import SensorState
from log2sim.synth.render import Visibility, render, segment
from log2sim.synth.scene import Environment
from log2sim.synth.synthesis import MIN_LABEL_PX, MIN_UNOCCLUDED
from log2sim.synth.traffic_picture import TrafficPainter

FOLDERS = {"image_2": ".png", "velodyne": ".bin", "calib": ".txt", "label_2": ".txt"}
TYPES = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian", "cyclist": "Cyclist"}
VAN, OTHER, DONT_CARE = "Van", "Misc", "DontCare"
MIN_VAN_HEIGHT_M = 2.1
# Less is a region to be ignored; a region of less than that is nothing.
MIN_KITTI_LABEL_PX, MIN_REGION_PX, MIN_VISIBLE = 12.0, 5.0, 0.1
# Least visible share of what counts as fully visible and as partly hidden; below it is largely hidden.
OCCLUSION_LIMITS = (0.8, 0.4)
BOX_GRID = 7  # points along each edge of a box, for the share of it in the picture
PNG_COMPRESSION = 1
# The IMU of KITTI's car: the LiDAR is so far ahead of it and to its left, it is so high above the ground.
LIDAR_FROM_IMU_M, IMU_HEIGHT_M = (0.81, -0.32), 0.93


def calibration_text(rig: traffic.Rig) -> str:
    """Write a calibration file: P0 to P3, R0_rect, Tr_velo_to_cam, Tr_imu_to_velo."""
    cam_R_level = (inverse(rig.map_T_cam)[:3, :3] @ rig.map_T_level[:3, :3]).round(12) + 0.0
    P = np.column_stack([rig.camera.K @ cam_R_level, np.zeros(3)])
    level_T_lidar = inverse(rig.map_T_level) @ rig.map_T_lidar
    # KITTI's IMU, by which readers know how high the LiDAR is above the ground.
    level = rig.map_T_level[:3, :3] @ traffic.FORWARD_R_CAM.T
    away = np.append(LIDAR_FROM_IMU_M, rig.lidar_height_m - IMU_HEIGHT_M)
    lidar_T_imu = inverse(transform(level.T @ rig.map_T_lidar[:3, :3], away))
    rows = {f"P{k}": P for k in range(4)}
    rows |= {"R0_rect": np.eye(3), "Tr_velo_to_cam": level_T_lidar[:3], "Tr_imu_to_velo": lidar_T_imu[:3]}
    return "".join(f"{name}: {' '.join(f'{v:.12e}' for v in np.ravel(values))}\n" for name, values in rows.items())


def label_text(objects: Sequence[traffic.TrafficObject], seen: Sequence[Visibility | None], rig: traffic.Rig) -> str:
    """Write a label file: road users, and as regions to be ignored those that are too small or hidden.

    Truncation is the share of the box outside the picture. Occlusion is 0 where 80 % or more of the silhouette are visible,
    1 where 40 %, 2 below. The 2D box surrounds the whole silhouette in the picture, hidden parts too, as KITTI's do.
    """
    labels, regions = [], []
    for item, visibility in zip(objects, seen):
        if not item.category or visibility is None:
            continue
        left, top, right, bottom = visibility.silhouette_box_px - [0, 0, 1, 1]
        share = visibility.visible_px / visibility.silhouette_px
        box_2d = f"{left:.2f} {top:.2f} {right:.2f} {bottom:.2f}"
        if bottom - top >= MIN_KITTI_LABEL_PX and share >= MIN_VISIBLE:
            labels.append(_label(item, share, box_2d, rig))
        elif bottom - top >= MIN_REGION_PX:
            regions.append(f"{DONT_CARE} -1 -1 -10 {box_2d} -1 -1 -1 -1000 -1000 -1000 -10\n")
    return "".join(labels + regions)


def _label(item: traffic.TrafficObject, share: float, box_2d: str, rig: traffic.Rig) -> str:
    level_T_map = inverse(rig.map_T_level)
    x, y, z = apply(level_T_map, item.position_m[None])[0]
    heading = level_T_map[:3, :3] @ np.array([np.cos(item.yaw_rad), np.sin(item.yaw_rad), 0.0])
    rotation = float(np.arctan2(-heading[2], heading[0]))
    alpha = (rotation - np.arctan2(x, z) + np.pi) % (2 * np.pi) - np.pi
    occlusion = int(np.sum(share < np.array(OCCLUSION_LIMITS)))
    length, width, height = item.size_m
    size = f"{height:.2f} {width:.2f} {length:.2f}"
    van = item.category == "car" and height >= MIN_VAN_HEIGHT_M
    return (
        f"{VAN if van else TYPES.get(item.category, OTHER)} {truncation(item, rig):.2f} {occlusion} {alpha:.2f} {box_2d} {size} "
        f"{x:.2f} {y:.2f} {z:.2f} {rotation:.2f}\n"
    )


def truncation(item: traffic.TrafficObject, rig: traffic.Rig) -> float:
    """Share of an object's box that lies outside the picture."""
    steps = np.linspace(-0.5, 0.5, BOX_GRID)
    grid = np.stack(np.meshgrid(steps, steps, steps + 0.5, indexing="ij"), -1).reshape(-1, 3) * item.size_m
    map_T_item = transform(rotation_from_rpy(0.0, 0.0, item.yaw_rad), item.position_m)
    points = apply(inverse(rig.map_T_cam) @ map_T_item, grid)
    ahead = points[:, 2] > 0.1
    depth = np.where(ahead, points[:, 2], 1.0)[:, None]
    uv = points[:, :2] / depth * np.diag(rig.camera.K)[:2] + rig.camera.K[:2, 2]
    inside = ahead & np.all((uv >= -0.5) & (uv < [rig.camera.width_px - 0.5, rig.camera.height_px - 0.5]), axis=1)
    return float(1 - inside.mean())


STEP_S = 0.1
# Intelligent driver model (Treiber, Hennecke, Helbing 2000): usual values for city traffic.
ACCELERATION_MPS2, DECELERATION_MPS2, HEADWAY_S, STANDSTILL_M = 1.5, 2.5, 1.2, 1.5
MAX_BRAKING_MPS2 = 9.0
SIDE_MARGIN_M = 0.25
MAX_ROAD_ANGLE_RAD = 0.2  # between the sensor's car and a road that it follows
CAR_AHEAD_M = 0.3  # of the car's middle before its LiDAR


@dataclass(frozen=True, eq=False)
class TrafficRun:
    """A random scene over time."""

    scene: traffic.TrafficScene  # at time 0
    ego: traffic.TrafficObject | None  # the sensor's car; None at the roadside
    # (S, M) float64, m: way that each object, and as the last the sensor's car, has gone after each `STEP_S`
    distance_m: Array

    def at(self, t_s: float) -> traffic.TrafficScene:
        """Return the scene at a time since its begin."""
        position = min(max(t_s / STEP_S, 0.0), len(self.distance_m) - 1.000001)
        k = int(position)
        step = self.distance_m[k + 1] - self.distance_m[k]
        distance, speed = self.distance_m[k] + (position - k) * step, step / STEP_S
        objects = [_moved(o, d, v, self.scene) for o, d, v in zip(self.scene.objects, distance, speed)]
        if self.ego is None:
            return replace(self.scene, objects=tuple(objects))
        start = self.scene.sensor
        ego = _moved(self.ego, distance[-1], speed[-1], self.scene)
        turned = rotation_from_rpy(0.0, 0.0, ego.yaw_rad - self.ego.yaw_rad)
        heading = np.array([np.cos(ego.yaw_rad), np.sin(ego.yaw_rad)])
        xy = ego.position_m[:2] - CAR_AHEAD_M * heading
        # Springs take waves and kerbs, so the sensor follows the slope alone.
        x, y = np.append(xy, start.position_m[:2]).astype(np.float32).reshape(2, 2).T
        rise = np.diff(self.scene.surface.height(x, y))[0]
        sensor = SensorState(turned @ start.rotation, np.append(xy, start.position_m[2] - rise), speed[-1] * heading)
        kept = [replace(o, position_m=np.append(xy, -rise), yaw_rad=ego.yaw_rad, speed_mps=speed[-1]) if o.kind == "own car" else o
                for o in objects]  # fmt: skip
        return replace(self.scene, objects=tuple(kept), sensor=sensor)


def run_of(scene: traffic.TrafficScene, duration_s: float) -> TrafficRun:
    """Let a scene run: arcs as at time 0, speeds by the intelligent driver model."""
    ego = None
    if scene.mount != "roadside":  # the sensor's own car
        R, position = scene.sensor.rotation, scene.sensor.position_m
        yaw = float(np.arctan2(R[1, 0], R[0, 0]))
        pace = float(np.hypot(*scene.sensor.velocity_mps))
        middle = np.append(position[:2] + CAR_AHEAD_M * np.array([np.cos(yaw), np.sin(yaw)]), 0.0)
        along = np.cos(yaw - scene.roads[0].yaw_rad)
        follows = abs(along) > np.cos(MAX_ROAD_ANGLE_RAD)
        turn = pace * scene.roads[0].curvature_per_m * float(np.sign(along)) if follows else 0.0
        ego = traffic.TrafficObject("car", middle, yaw, traffic.OWN_CAR_M, (), pace, turn)
    movers = [*scene.objects, *([] if ego is None else [ego])]
    count = int(np.ceil(duration_s / STEP_S)) + 2
    distance = np.zeros((count, len(movers)))
    wish = np.array([o.speed_mps for o in movers])
    speed = wish.copy()
    users = np.flatnonzero([bool(o.category) for o in movers])
    for k in range(1, count):
        distance[k] = distance[k - 1] + speed * STEP_S
        places = [_moved(movers[i], distance[k, i], speed[i], None) for i in users]
        rate = _acceleration(places, speed[users], wish[users])
        speed[users] = np.clip(speed[users] + rate * STEP_S, 0.0, np.maximum(wish[users], 0.0))
    return TrafficRun(scene, ego, distance)


def _moved(
    item: traffic.TrafficObject, distance_m: float, speed_mps: float, scene: traffic.TrafficScene | None
) -> traffic.TrafficObject:
    """Move an object along its arc; with a scene also up and down with the ground."""
    if item.speed_mps == 0 or item.kind == "own car":
        return item
    position, yaw = item.pose_at(distance_m / item.speed_mps)
    if scene is not None and item.category:
        position[2] = scene.surface.elevation(position)
    turn = item.turn_radps * speed_mps / item.speed_mps
    return replace(item, position_m=position, yaw_rad=yaw, speed_mps=speed_mps, turn_radps=turn)


def _acceleration(places: list[traffic.TrafficObject], speed: Array, wish: Array) -> Array:
    """Accelerations (M,) of road users that keep their distance to what is in their way."""
    xy = np.array([o.position_m[:2] for o in places]).reshape(-1, 2)
    yaw = np.array([o.yaw_rad for o in places])
    size = np.array([o.size_m[:2] for o in places]).reshape(-1, 2)
    heading = np.stack([np.cos(yaw), np.sin(yaw)], 1)
    offset = xy[None] - xy[:, None]
    ahead = np.einsum("ijk,ik->ij", offset, heading)
    aside = np.abs(offset[..., 1] * heading[:, None, 0] - offset[..., 0] * heading[:, None, 1])
    c, s = np.abs(np.cos(yaw[None] - yaw[:, None])), np.abs(np.sin(yaw[None] - yaw[:, None]))
    half_along, half_across = (c * size[:, 0] + s * size[:, 1]) / 2, (s * size[:, 0] + c * size[:, 1]) / 2
    gap = ahead - half_along - size[:, None, 0] / 2
    in_way = (ahead > 0) & (aside < half_across + size[:, None, 1] / 2 + SIDE_MARGIN_M)
    np.fill_diagonal(in_way, val=False)
    closing = speed[:, None] - speed[None] * np.cos(yaw[None] - yaw[:, None])
    approach = speed[:, None] * closing / (2 * np.sqrt(ACCELERATION_MPS2 * DECELERATION_MPS2))
    wanted = STANDSTILL_M + speed[:, None] * HEADWAY_S + approach
    pressure = np.where(in_way, (np.maximum(wanted, 0.0) / np.maximum(gap, 0.2)) ** 2, 0.0).max(1, initial=0.0)
    free = 1 - (speed / np.maximum(wish, 0.1)) ** 4
    return np.asarray(np.maximum(ACCELERATION_MPS2 * (free - pressure), -MAX_BRAKING_MPS2))


START_NS = 1_700_000_000_000_000_000
CAMERA, LIDAR = "camera", "lidar"
CAMERA_RATE_HZ, POSE_RATE_HZ = 10.0, 50.0
REAR_AXLE_TO_LIDAR_M = 1.1  # forward, on the sensor's car
REAR_AXLE_OFFSET_M = 1.4
MAX_CACHED = 4


def log_of(
    scene: traffic.TrafficScene,
    environment: Environment,
    name: str,
    duration_s: float,
    seed: int,
    *,
    camera_rate_hz: float = CAMERA_RATE_HZ,
    image_labels: bool = True,
) -> Log:
    """Make a log whose records are rendered and cast when read; every record depends on the seed and its index alone.

    The map is the scene's level frame: its origin is on the ground below the LiDAR at the begin. Points of sweeps are in the map.
    Labels are given at the camera's stamps, for all road users around; those in images take most of the time.
    """
    run = run_of(scene, duration_s)
    rig = traffic.rig_of(scene)
    mount = "map" if scene.mount == "roadside" else "ego"
    mount_T_lidar, lidar_T_cam = rig.map_T_lidar, inverse(rig.map_T_lidar) @ rig.map_T_cam
    if mount == "ego":  # a rig that moves as one piece
        place = np.array([REAR_AXLE_TO_LIDAR_M, 0.0, float(scene.sensor.position_m[2])])
        mount_T_lidar = transform(np.eye(3), place)
        lidar_T_cam = transform(traffic.FORWARD_R_CAM, np.array(traffic.KITTI_OFFSET_M))
    camera = replace(rig.camera, name=CAMERA, mount=mount, mount_T_cam=mount_T_lidar @ lidar_T_cam)  # type: ignore[arg-type]
    film = _Film(run, environment, camera, lidar_T_cam, seed)
    # A sweep's middle lies within the log, and so do its first and last point.
    period = 1.0 / scene.lidar.rate_hz
    t_sweep = np.arange(period / 2, duration_s - period / 2 + 1e-9, period)
    t_image = np.arange(0.5 / camera_rate_hz, duration_s + 1e-9, 1.0 / camera_rate_hz)
    t_pose = np.arange(int(np.ceil(duration_s * POSE_RATE_HZ)) + 1) / POSE_RATE_HZ

    def sweep(i: int) -> Sweep:
        returns = run.at(float(t_sweep[i])).cast(np.random.default_rng([seed, 4, i]))
        t_ns = stamps_of(t_sweep[i] + returns.t_s.astype(np.float64))
        return Sweep(int(stamps_of(t_sweep[i : i + 1] + period / 2)[0]), returns.xyz_m, "map", t_ns)

    return Log(
        name=name,
        format="synthetic",
        cameras={CAMERA: camera},
        lidars={LIDAR: Lidar(LIDAR, mount, mount_T_lidar)},  # type: ignore[arg-type]
        streams={
            CAMERA: Stream(CAMERA, stamps_of(t_image), lambda i: film.image(float(t_image[i]), i)),
            LIDAR: Stream(LIDAR, stamps_of(t_sweep + period / 2), sweep),
        },
        ego=poses_of(run, mount_T_lidar, t_pose) if mount == "ego" else None,
        ego_vehicle=EgoVehicle(traffic.OWN_CAR_M, REAR_AXLE_OFFSET_M),
        labels=film.labels(t_image),
        image_labels={CAMERA: film.image_labels(t_image)} if image_labels else {},
        reference_camera=CAMERA,
        notes=(f"synthetic traffic, seed {seed}",),
    )


def stamps_of(t_s: Array) -> NDArray[np.int64]:
    """Return absolute stamps (F,) of times (F,), s."""
    stamps: NDArray[np.int64] = START_NS + np.rint(t_s * NS_PER_S).astype(np.int64)
    return stamps


def map_T_lidar_of(scene: traffic.TrafficScene) -> Array:
    """Return the pose of the LiDAR that records a scene."""
    return transform(scene.sensor.rotation, scene.sensor.position_m)


def poses_of(run: TrafficRun, ego_T_lidar: Array, t_s: Array) -> PoseTrack:
    """Return the poses of the ego at times (F,), s."""
    poses = np.array([map_T_lidar_of(run.at(float(t))) @ inverse(ego_T_lidar) for t in t_s])
    return PoseTrack(stamps_of(t_s), poses)


class _Film:
    """Pictures and labels of a run."""

    def __init__(
        self, run: TrafficRun, environment: Environment, camera: Camera, lidar_T_cam: Array, seed: int
    ) -> None:
        self._run, self._camera, self._lidar_T_cam, self._seed = run, camera, lidar_T_cam, seed
        self._light = light_of(environment)
        self._painter = TrafficPainter(run.scene, seed)
        self._instant = lru_cache(maxsize=MAX_CACHED)(self._taken)

    def _taken(self, t_s: float) -> Any:
        scene = self._run.at(t_s)
        map_T_cam = map_T_lidar_of(scene) @ self._lidar_T_cam
        instant, seen = self._painter.instant(scene, self._light, self._camera, map_T_cam)
        return scene, map_T_cam, instant, seen

    def image(self, t_s: float, index: int) -> NDArray[np.uint8]:
        _, map_T_cam, instant, _ = self._instant(t_s)
        return render(self._camera, map_T_cam, instant, np.random.default_rng([self._seed, 2, index]))

    def labels(self, t_s: Array) -> Labels:
        """Boxes of all road users in space at times (F,)."""
        rows = [
            (stamp, f"user_{k}", o.category, o.position_m + np.array([0.0, 0.0, o.size_m[2] / 2]), o.size_m, o.yaw_rad)
            for t, stamp in zip(t_s, stamps_of(t_s))
            for k, o in enumerate(self._run.at(float(t)).objects)
            if o.category
        ]
        stamps, names, categories, centers, sizes, yaws = zip(*rows) if rows else ((),) * 6
        name, category = (np.array(column, dtype="<U16") for column in (names, categories))
        center, size, yaw = (np.array(column, dtype=np.float64) for column in (centers, sizes, yaws))
        return Labels(np.array(stamps, np.int64), name, category, center.reshape(-1, 3), size.reshape(-1, 3), yaw)

    def image_labels(self, t_s: Array) -> ImageLabels:
        """Boxes of the road users that the picture shows, at times (F,)."""
        flat: list[tuple[int, Array, str]] = []
        for t, stamp in zip(t_s, stamps_of(t_s)):
            scene, map_T_cam, instant, seen = self._instant(float(t))
            for k, part in zip(seen, segment(self._camera, map_T_cam, instant)):
                if part is None or not scene.objects[k].category:
                    continue
                big = float((part.box_px[2:] - part.box_px[:2]).min()) >= MIN_LABEL_PX
                if big and part.visible_px >= MIN_UNOCCLUDED * part.silhouette_px:
                    flat.append((int(stamp), part.box_px, scene.objects[k].category))
        stamps, boxes, categories = zip(*flat) if flat else ((),) * 3
        shown = np.array(boxes, dtype=np.float64).reshape(-1, 4)
        return ImageLabels(np.array(stamps, np.int64), shown, np.array(categories, dtype="<U16"))


MANIFEST = "traffic.json"
FORMAT, VERSION = "log2sim-traffic", 1
Layout = Literal["kitti", "log2sim"]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class TrafficSettings:
    """What to write."""

    mount: traffic.Mount  # "vehicle" or "roadside"
    scenes: int = 10
    seed: int = 0
    sensor: str | None = None  # name or TOML file of a LiDAR, "random", or None for the usual one of the mount
    layout: Layout = "kitti"  # "kitti" or "log2sim"
    duration_s: float = 5.0  # of each log; a scene in KITTI's layout is one frame
    light: str | None = None  # as in scene files; None draws them for each scene
    weather: str | None = None  # as in scene files; None draws them for each scene
    pictures: bool = True  # whether logs have a camera


def write_traffic(
    settings: TrafficSettings, out: Path, *, overwrite: bool = False, progress: Progress | None = None, jobs: int = 1
) -> None:
    """Write random scenes below a folder, whole or not at all, by so many processes; the same settings write the same bytes.

    Raises `ConfigError` for an unknown sensor, KITTI's layout without pictures, or a folder that may not be replaced or written.
    """
    if settings.layout == "kitti" and not settings.pictures:
        raise ConfigError("KITTI's layout labels what pictures show; without pictures choose the layout log2sim")
    traffic.sensor_named(settings.sensor, settings.mount)
    refuse_folder(out, overwrite=overwrite, holding=MANIFEST, kind="data of random traffic")
    check_folder(out, overwrite=overwrite)
    with replaced_folder(out, overwrite=overwrite) as folder:
        scenes = []
        for scene in map_in_processes(partial(_write_scene, settings, folder), range(settings.scenes), jobs):
            scenes.append(scene)
            if progress is not None:
                progress(len(scenes), settings.scenes)
        if settings.layout == "kitti":
            # Lists of frames that readers of this layout look for: a random half for training, the other to validate.
            order = np.random.default_rng([settings.seed, 3]).permutation(settings.scenes)
            (folder / "ImageSets").mkdir()
            half = (settings.scenes + 1) // 2
            for name, rows in (("train", order[:half]), ("val", order[half:]), ("trainval", order)):
                lines = "".join(f"{k:06d}\n" for k in sorted(rows.tolist()))
                (folder / "ImageSets" / f"{name}.txt").write_text(lines, encoding="ascii")
        manifest = {"format": FORMAT, "version": VERSION, "mount": settings.mount, "layout": settings.layout}
        manifest |= {"seed": settings.seed, "sensor": settings.sensor, "scenes": scenes}
        (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")


def _write_scene(settings: TrafficSettings, folder: Path, index: int) -> dict[str, Any]:
    """Write one scene, and return its entry in the manifest."""
    from log2sim.logs.native.writer import write_log

    scene, environment = draw_traffic(settings, index)
    seed = int(np.random.default_rng([settings.seed, index, 2]).integers(2**31))
    if settings.layout == "kitti":
        write_frame(folder / "training", index, scene, environment, seed)
    else:
        name, pictures = f"scene_{index:06d}", settings.pictures
        log = log_of(scene, environment, name, settings.duration_s, seed, image_labels=pictures)
        if not pictures:
            sweeps = {lidar: log.streams[lidar] for lidar in log.lidars}
            log = log.changed(cameras={}, streams=sweeps, image_labels={}, reference_camera=None)
        write_log(log, folder / name)
    users = [o.category for o in scene.objects if o.category]
    counts = {category: users.count(category) for category in sorted(set(users))}
    about = {"environment": environment.model_dump(), "lidar": scene.lidar.name, "road_users": counts}
    return {"name": f"{index:06d}", **about}


def draw_traffic(settings: TrafficSettings, index: int) -> tuple[traffic.TrafficScene, Environment]:
    """Draw scene `index`; it depends on the seed and the index, not on how many there are."""
    rng, of_air = (np.random.default_rng([settings.seed, index, k]) for k in (0, 1))
    environment = traffic.draw_environment(of_air, settings.light, settings.weather)
    lidar = traffic.sensor_named(settings.sensor, settings.mount)
    return traffic.draw_scene(settings.mount, rng, lidar=lidar, weather=environment), environment


def write_frame(folder: Path, index: int, scene: traffic.TrafficScene, environment: Environment, seed: int) -> None:
    """Write picture, cloud, calibration and labels of a scene at time 0 below a folder such as `training`."""
    rig = traffic.rig_of(scene)
    painter = TrafficPainter(scene, seed)
    instant, seen = painter.instant(scene, light_of(environment), rig.camera, rig.map_T_cam)
    image = render(rig.camera, rig.map_T_cam, instant, np.random.default_rng([seed, 2]))
    parts = segment(rig.camera, rig.map_T_cam, instant)
    returns = scene.cast(np.random.default_rng([seed, 4]))
    points: Array = (returns.xyz_m - rig.map_T_lidar[:3, 3]) @ rig.map_T_lidar[:3, :3]
    cloud = np.column_stack([points, returns.intensity]).astype("<f4")
    encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])[1]
    labels = label_text([scene.objects[k] for k in seen], parts, rig)
    contents = (encoded.tobytes(), cloud.tobytes(), calibration_text(rig).encode("ascii"), labels.encode("ascii"))
    for (name, suffix), data in zip(FOLDERS.items(), contents, strict=True):
        path = folder / name / f"{index:06d}{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
