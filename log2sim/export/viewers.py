"""What viewers show of a scenario and its log: boxes at equal steps, downscaled pictures, thinned sweeps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim import geometry
from log2sim.datatypes import Agent, Log, Scenario
from log2sim.errors import ConfigError, RecordError
from log2sim.export.exporters import SampledMotion, sample_steps, step_times
from log2sim.perception.lidar.cloud import sweep_to_map
from log2sim.perception.records import RecordSource

STEP_S = 0.1  # the lowest rate that readers of OSI traces accept, and smooth to watch
MAX_IMAGE_PX = 960  # wider images are downscaled, which keeps files of several cameras small
JPEG_QUALITY = 80
MAX_SWEEP_POINTS = 10_000
# Colors as red, green and blue in [0, 255].
EGO_RGB = (0, 158, 115)
RGB_OF_CATEGORY = {
    "car": (86, 180, 233), "truck": (0, 114, 178), "bus": (0, 70, 140), "motorcycle": (230, 159, 0), "cyclist": (230, 159, 0),
    "bicycle": (240, 228, 66), "pedestrian": (213, 94, 0), "other": (160, 160, 160),
}  # fmt: skip
# All agents at equal steps: absolute time (T,), ns, and each with its motion.
AgentSteps = tuple[NDArray[np.int64], tuple[tuple[Agent, SampledMotion], ...]]


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """A camera image with the boxes of agents."""

    t_ns: int
    camera: geometry.Camera  # of the size of the image
    map_T_cam: geometry.Array | None  # (4, 4) or None
    jpeg: bytes
    outlines: tuple[tuple[Agent, geometry.Array], ...]  # lines of each box, px


@dataclass(frozen=True, eq=False)
class ThinnedSweep:
    """A LiDAR sweep with fewer points."""

    t_ns: int
    lidar: str
    points_map: geometry.Array  # (N, 3); none where the pose of the LiDAR is not known


@dataclass(frozen=True)
class UnreadableRecord:
    """A record of the log that could not be read, and the reason."""

    t_ns: int
    stream: str
    reason: str


ViewerRecord = CameraFrame | ThinnedSweep | UnreadableRecord


def rgb_of(agent: Agent) -> tuple[int, int, int]:
    """Return the color of an agent."""
    return EGO_RGB if agent.id == "ego" else RGB_OF_CATEGORY[agent.category]


def agent_steps(scenario: Scenario) -> AgentSteps:
    """Sample every agent every `STEP_S`, from the first waypoint of any agent to the last."""
    ends = [(a.waypoints.t_s[0], a.waypoints.t_s[-1]) for a in scenario.agents]
    t_s = step_times(min(first for first, _ in ends), max(last for _, last in ends), STEP_S, len(ends))
    t_ns = scenario.t0_ns + np.round(t_s * geometry.NS_PER_S).astype(np.int64)
    return t_ns, tuple((agent, sample_steps(agent, t_s, STEP_S)) for agent in scenario.agents)


def ego_pose(agent: Agent, position_m: geometry.Array, yaw_rad: float) -> geometry.Array:
    """Return the ego frame (4, 4) of a box: at the rear axle, on the ground."""
    map_T_box = geometry.transform(geometry.rotation_from_rpy(0.0, 0.0, yaw_rad), position_m)
    return map_T_box @ geometry.transform(np.eye(3), [-agent.rear_axle_offset_m, 0.0, -agent.size_m[2] / 2])


def viewer_records(scenario: Scenario, log: Log) -> Iterator[ViewerRecord]:
    """Yield images and points of a log within the scenario's time, in order of time; each is read when requested.

    Raises `ConfigError` when the log has no record in that time.
    """
    start, stop = scenario.t0_ns, scenario.t0_ns + round(scenario.duration_s * geometry.NS_PER_S)
    index = [
        (t_ns, name, i)
        for name, stream in log.streams.items()
        if name in log.cameras or name in log.lidars
        for i, t_ns in enumerate(stream.t_ns.tolist())
        if start <= t_ns <= stop
    ]
    if not index:
        raise ConfigError(
            f"--log: log '{log.name}' has no picture and no sweep between {start} and {stop} ns, the time of scenario "
            f"'{scenario.name}'; give the log that it was made from"
        )
    records = RecordSource(log)
    for t_ns, name, i in sorted(index):
        try:
            record = records.require(name, i)
        except RecordError as error:
            yield UnreadableRecord(t_ns, name, str(error))
            continue
        if name in log.cameras:
            yield _camera_frame(scenario, log, log.cameras[name], t_ns, record)
        else:
            mapped = sweep_to_map(log, name, record.thinned(MAX_SWEEP_POINTS), compensate=True)
            yield ThinnedSweep(t_ns, name, np.zeros((0, 3)) if mapped is None else mapped[0])


def _camera_frame(
    scenario: Scenario, log: Log, camera: geometry.Camera, t_ns: int, image_bgr: NDArray[np.uint8]
) -> CameraFrame:
    import cv2
    import simplejpeg

    scale, small = min(1.0, MAX_IMAGE_PX / camera.width_px), camera
    if scale < 1.0:  # the center of the first pixel is (0, 0) in both sizes
        size, K = (round(camera.width_px * scale), round(camera.height_px * scale)), camera.K.copy()
        for axis, (new, old) in enumerate(zip(size, (camera.width_px, camera.height_px))):
            K[axis] *= new / old
            K[axis, 2] += (new / old - 1) / 2
        small = replace(camera, width_px=size[0], height_px=size[1], K=K)
        image_bgr = np.asarray(cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    jpeg = simplejpeg.encode_jpeg(np.ascontiguousarray(image_bgr), quality=JPEG_QUALITY, colorspace="BGR")
    poses, known = log.map_T_sensor(camera.name, t_ns)
    if not known[0]:
        return CameraFrame(t_ns, small, None, jpeg, ())
    outlines, t_s = [], (t_ns - scenario.t0_ns) / geometry.NS_PER_S
    for agent in scenario.others if small.mount == "ego" else scenario.agents:  # the ego is not in its own cameras
        at = agent.at(t_s)
        if at.valid[0]:
            corners = geometry.box_corners([at.x_m[0], at.y_m[0], at.z_m[0]], agent.size_m, at.yaw_rad)[0]
            lines = geometry.box_lines(small, geometry.apply(geometry.inverse(poses[0]), corners))
            if len(lines):
                outlines.append((agent, lines))
    return CameraFrame(t_ns, small, poses[0], jpeg, tuple(outlines))
