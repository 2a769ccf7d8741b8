"""A log of a random scene that goes on for some seconds: camera, LiDAR, poses of the ego, labels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, ImageLabels, Labels, Lidar, Log, Stream, Sweep
from log2sim.geometry import NS_PER_S, Array, Camera, PoseTrack, inverse, transform
from log2sim.synth.labels import MIN_LABEL_PX, MIN_UNOCCLUDED
from log2sim.synth.light import light_of
from log2sim.synth.render import Visibility, render, segment
from log2sim.synth.scene import Environment
from log2sim.synth.traffic import TrafficScene
from log2sim.synth.traffic_motion import CAR_SIZE_M, TrafficRun, run_of
from log2sim.synth.traffic_picture import TrafficPainter
from log2sim.synth.traffic_rig import mount_T_cam_of, rig_of

START_NS = 1_700_000_000_000_000_000
CAMERA, LIDAR = "camera", "lidar"
CAMERA_RATE_HZ, POSE_RATE_HZ = 10.0, 50.0
REAR_AXLE_TO_LIDAR_M = 1.1  # forward, on the sensor's car
REAR_AXLE_OFFSET_M = 1.4
MAX_CACHED = 4


def log_of(
    scene: TrafficScene,
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
    rig = rig_of(scene)
    mount = "map" if scene.mount == "roadside" else "ego"
    mount_T_lidar = _ego_T_lidar(scene) if mount == "ego" else rig.map_T_lidar
    lidar_T_cam = mount_T_cam_of(scene.mount, rig)
    camera = replace(rig.camera, name=CAMERA, mount=mount, mount_T_cam=mount_T_lidar @ lidar_T_cam)  # type: ignore[arg-type]
    film = _Film(run, environment, camera, lidar_T_cam, seed)
    # A sweep's middle lies within the log, and so do its first and last point.
    period = 1.0 / scene.lidar.rate_hz
    t_sweep = np.arange(period / 2, duration_s - period / 2 + 1e-9, period)
    t_image = np.arange(0.5 / camera_rate_hz, duration_s + 1e-9, 1.0 / camera_rate_hz)
    return Log(
        name=name,
        format="synthetic",
        cameras={CAMERA: camera},
        lidars={LIDAR: Lidar(LIDAR, mount, mount_T_lidar)},  # type: ignore[arg-type]
        streams={
            CAMERA: Stream(CAMERA, _stamps(t_image), lambda i: film.image(float(t_image[i]), i)),
            LIDAR: Stream(LIDAR, _stamps(t_sweep + period / 2), _sweeps(run, t_sweep, period, seed)),
        },
        ego=_poses(run, mount_T_lidar, duration_s) if mount == "ego" else None,
        ego_vehicle=EgoVehicle(CAR_SIZE_M, REAR_AXLE_OFFSET_M),
        labels=film.labels(t_image),
        image_labels={CAMERA: film.image_labels(t_image)} if image_labels else {},
        reference_camera=CAMERA,
        notes=(f"synthetic traffic, seed {seed}",),
    )


def _stamps(t_s: Array) -> NDArray[np.int64]:
    stamps: NDArray[np.int64] = START_NS + np.rint(t_s * NS_PER_S).astype(np.int64)
    return stamps


def _ego_T_lidar(scene: TrafficScene) -> Array:
    return transform(np.eye(3), np.array([REAR_AXLE_TO_LIDAR_M, 0.0, float(scene.sensor.position_m[2])]))


def _map_T_lidar(scene: TrafficScene) -> Array:
    return transform(scene.sensor.rotation, scene.sensor.position_m)


def _poses(run: TrafficRun, ego_T_lidar: Array, duration_s: float) -> PoseTrack:
    t_s = np.arange(int(np.ceil(duration_s * POSE_RATE_HZ)) + 1) / POSE_RATE_HZ
    poses = np.array([_map_T_lidar(run.at(float(t))) @ inverse(ego_T_lidar) for t in t_s])
    return PoseTrack(_stamps(t_s), poses)


def _sweeps(run: TrafficRun, t_s: Array, period_s: float, seed: int) -> Callable[[int], Sweep]:
    """Return the reader of sweeps whose middles are at times (F,); their stamps are their ends."""

    def read(i: int) -> Sweep:
        returns = run.at(float(t_s[i])).cast(np.random.default_rng([seed, 4, i]))
        t_ns = _stamps(t_s[i] + returns.t_s.astype(np.float64))
        return Sweep(int(_stamps(t_s[i : i + 1] + period_s / 2)[0]), returns.xyz_m, "map", t_ns)

    return read


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
        map_T_cam = _map_T_lidar(scene) @ self._lidar_T_cam
        instant, seen = self._painter.instant(scene, self._light, self._camera, map_T_cam)
        return scene, map_T_cam, instant, seen

    def image(self, t_s: float, index: int) -> NDArray[np.uint8]:
        _, map_T_cam, instant, _ = self._instant(t_s)
        return render(self._camera, map_T_cam, instant, np.random.default_rng([self._seed, 2, index]))

    def labels(self, t_s: Array) -> Labels:
        """Boxes of all road users in space at times (F,)."""
        rows: list[tuple[int, int, str, Array, tuple[float, float, float], float]] = []
        for t, stamp in zip(t_s, _stamps(t_s)):
            for k, item in enumerate(self._run.at(float(t)).objects):
                if item.category:
                    center = item.position_m + np.array([0.0, 0.0, item.size_m[2] / 2])
                    rows.append((int(stamp), k, item.category, center, item.size_m, item.yaw_rad))
        return Labels(
            t_ns=np.array([r[0] for r in rows], np.int64),
            track_id=np.array([f"user_{r[1]}" for r in rows], dtype="<U16"),
            category=np.array([r[2] for r in rows], dtype="<U16"),
            center_m=np.array([r[3] for r in rows]).reshape(-1, 3),
            size_m=np.array([r[4] for r in rows]).reshape(-1, 3),
            yaw_rad=np.array([r[5] for r in rows]),
        )

    def image_labels(self, t_s: Array) -> ImageLabels:
        """Boxes of the road users that the picture shows, at times (F,)."""
        flat: list[tuple[int, Array, str]] = []
        for t, stamp in zip(t_s, _stamps(t_s)):
            scene, map_T_cam, instant, seen = self._instant(float(t))
            for k, part in zip(seen, segment(self._camera, map_T_cam, instant)):
                if part is not None and scene.objects[k].category and _is_clear(part):
                    flat.append((int(stamp), part.box_px, scene.objects[k].category))
        boxes = np.array([f[1] for f in flat]).reshape(-1, 4)
        categories = np.array([f[2] for f in flat], dtype="<U16")
        return ImageLabels(np.array([f[0] for f in flat], np.int64), boxes, categories)


def _is_clear(part: Visibility) -> bool:
    big = float((part.box_px[2:] - part.box_px[:2]).min()) >= MIN_LABEL_PX
    return big and part.visible_px >= MIN_UNOCCLUDED * part.silhouette_px
