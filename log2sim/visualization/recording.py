"""What cameras and LiDARs recorded, made small enough for one file."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim import geometry
from log2sim.datatypes import AgentTable, Log, Scenario
from log2sim.errors import ConfigError, LogError
from log2sim.geometry.boxes import EDGES, NEAR_M
from log2sim.perception.frames import read_pictures
from log2sim.perception.lidar.cloud import cloud_origin, estimate_ground, sweep_to_map
from log2sim.perception.lidar.projection import View, project_boxes_in_view, view_of
from log2sim.perception.records import RecordSource
from log2sim.perception.sync import sweep_middle_ns

MARGIN_S = 0.05  # records this far outside the scenario are taken too: half a tick of most logs
BACK_RAD = np.radians(150.0)  # cameras that are turned farther from the front than this look back


def require_cameras(log: Log, asked: Sequence[str]) -> None:
    """Raise `ConfigError` for a camera that a log does not have."""
    unknown = [name for name in asked if name not in log.cameras]
    if unknown:
        there = ", ".join(log.cameras) or "none"
        raise ConfigError(f"--cameras: no camera '{unknown[0]}'; the log has: {there}")


def require_overlap(log: Log, scenario: Scenario) -> None:
    """Raise `LogError` for a log that has no records during a scenario."""
    spans = [(int(s.t_ns[0]), int(s.t_ns[-1])) for s in log.streams.values() if len(s.t_ns)]
    if spans and not any(len(records_within(stream.t_ns, scenario)) for stream in log.streams.values()):
        first, last = min(span[0] for span in spans), max(span[1] for span in spans)
        end_ns = scenario.t0_ns + round(scenario.duration_s * geometry.NS_PER_S)
        raise LogError(
            f"{log.name}: its records are from stamp {first} to {last} ns, the scenario '{scenario.name}' from {scenario.t0_ns} "
            f"to {end_ns} ns; choose the log that the scenario was made of"
        )


def records_within(t_ns: NDArray[np.int64], scenario: Scenario) -> NDArray[np.int64]:
    """Return the indices of the records with stamps (F,) during a scenario."""
    margin_ns = round(MARGIN_S * geometry.NS_PER_S)
    end_ns = scenario.t0_ns + round(scenario.duration_s * geometry.NS_PER_S)
    return np.flatnonzero((t_ns >= scenario.t0_ns - margin_ns) & (t_ns <= end_ns + margin_ns)).astype(np.int64)


def take_at_rate(t_ns: NDArray[np.int64], index: NDArray[np.int64], rate_hz: float, start_ns: int) -> NDArray[np.int64]:
    """Return those of the records `index` (n,) of stamps (F,) that are nearest to the beats of a rate; all of slower sensors.

    Beats count from `start_ns`, so that the cameras of a rig show the same moments.
    """
    if len(index) < 2 or geometry.period_of(t_ns[index]) * rate_hz > 0.75:
        return index
    stamps, step_ns = t_ns[index], round(geometry.NS_PER_S / rate_hz)
    beats = np.arange(start_ns, stamps[-1] + step_ns // 2, step_ns, dtype=np.int64)
    return index[np.unique(geometry.nearest_index(stamps, beats))]


def take_evenly(count: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` of the numbers 0 to `count` - 1, evenly spaced, with the first and the last."""
    if count <= most:
        return np.arange(count, dtype=np.int64)
    return np.unique(np.rint(np.linspace(0, count - 1, max(most, 1))).astype(np.int64))


MIN_SHARE = 1 / 200  # of the height of a picture: smaller boxes would be dots in it
# Of the width of a picture, one pixel of the usual size: edges that a lens bends by less are drawn straight.
STRAIGHT_SHARE = 1 / 640
# Kinds of outlines: eight corners u, v in the order of `box_corners`, or segments u0, v0, u1, v1.
CORNERS, SEGMENTS = 1, 0


def outlines_in(log: Log, scenario: Scenario, camera: str, t_ns: int) -> list[list[int]]:
    """Project the agents of a scenario, but for the ego, into the frame of a camera at a stamp, the farthest first.

    `log`: with the poses that the scenario was made with. Returns whole pixels of the camera, after the agent's place among the
    `others`; see `CORNERS` and `SEGMENTS`. Empty where the pose of the camera is not known.
    """
    view = view_of(log, camera, t_ns)
    if view is None or not scenario.others:
        return []
    table = AgentTable.of(scenario.others, np.array([(t_ns - scenario.t0_ns) / geometry.NS_PER_S]), permanent=True)
    center, yaw, rows = table.center_m[:, 0], table.yaw_rad[:, 0], np.flatnonzero(table.present[:, 0])
    found = project_boxes_in_view(view, center[rows], table.size_m[rows], yaw[rows])
    height_px = found.box_px[:, 3] - found.box_px[:, 1]
    with np.errstate(invalid="ignore"):
        shown = np.flatnonzero(found.valid & (height_px >= MIN_SHARE * view.camera.height_px))
    out = []
    for i in shown[np.argsort(-found.range_m[shown], kind="stable")]:
        row = int(rows[i])
        corners = corners_in_view(view, found.box_px[i], center[row], table.size_m[row], yaw[row])
        kind, coordinates = ground_outline(view.camera, corners)
        if len(coordinates):
            out.append([row, kind, *np.rint(coordinates).astype(np.int64).ravel().tolist()])
    return out


def ground_outline(camera: geometry.Camera, corners_cam: geometry.Array) -> tuple[int, geometry.Array]:
    """Return the kind and the coordinates, px, of the outline of a box with corners (8, 3), m, cam frame.

    Corners where straight lines between them are right: all in front of the camera, and the lens bends no edge visibly.
    """
    if (corners_cam[:, 2] > NEAR_M).all():
        ends = corners_cam[np.array(EDGES)]
        uv = geometry.project(camera, np.concatenate([corners_cam, ends.mean(axis=1)]))[0]
        straight = uv[np.array(EDGES)].mean(axis=1)
        # Perspective moves the middle of an edge along it; what counts is its distance from the line.
        along = uv[np.array(EDGES)[:, 1]] - uv[np.array(EDGES)[:, 0]]
        off = uv[8:] - straight
        length = np.maximum(np.hypot(*along.T), 1e-9)
        bent = np.abs(along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0]) / length
        if np.isfinite(uv).all() and bent.max() <= STRAIGHT_SHARE * camera.width_px:
            return CORNERS, uv[:8]
    return SEGMENTS, geometry.box_lines(camera, corners_cam)


def corners_in_view(
    view: View, box_px: geometry.Array, center_m: geometry.Array, size_m: geometry.Array, yaw_rad: float
) -> geometry.Array:
    """Return the corners (8, 3), m, cam frame, of a box that is shown as `box_px` (4,), when the line of its middle is taken."""
    if view.cam_T_map_at is None:
        cam_T_map = geometry.inverse(view.map_T_cam)
    else:
        cam_T_map = view.cam_T_map_at(geometry.line_time_s(view.camera, box_px.reshape(2, 2).mean(axis=0)[None]))[0]
    return geometry.apply(cam_T_map, geometry.box_corners(center_m, size_m, yaw_rad)[0])


QUALITY = 72  # of JPEGs, of 100: at the sizes of a page, blocks are hardly seen


class Detail(NamedTuple):
    """What a page shows of a sensor: width of pictures, px, or edge of the cells that keep one point each, m; and how often."""

    size: float
    rate_hz: float


# Of pictures, from the best down; the first that fits is taken. Motion is followed at 5 a second, and people are seen at 400 px.
PICTURE_DETAILS = (
    Detail(960, 10), Detail(800, 10), Detail(640, 10), Detail(640, 5), Detail(480, 5), Detail(400, 5), Detail(400, 2),
    Detail(320, 2), Detail(320, 1), Detail(240, 1), Detail(240, 0.5), Detail(160, 0.5), Detail(160, 0.2),
)  # fmt: skip
PROBES = 3  # pictures of each camera that are encoded in all sizes, to estimate how many bytes the others will have
SAFETY = 1.1  # by how much a scene may have more bytes than its probes tell; what is still too much is thinned out
POSE_BYTES = 140  # of the pose of a camera: twelve numbers
OUTLINE_BYTES = 100  # of an outline in the page: sixteen numbers of up to four digits, mostly


def encode_small(image_bgr: NDArray[np.uint8], width_px: int) -> bytes:
    """Encode a picture as a JPEG that is at most `width_px` wide."""
    shrink = min(width_px / image_bgr.shape[1], 1.0)
    if shrink < 1:
        height_px = max(round(image_bgr.shape[0] * shrink), 1)
        image_bgr = np.asarray(cv2.resize(image_bgr, (width_px, height_px), interpolation=cv2.INTER_AREA), np.uint8)
    done, data = cv2.imencode(".jpg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1])
    return bytes(data.tobytes()) if done else b""


def picture_document(
    log: Log,
    scenario: Scenario,
    cameras: tuple[str, ...],
    *,
    budget_bytes: int,
    reader: RecordSource,
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Return the pictures of cameras within a budget, with the outlines of the agents in them.

    `budget_bytes`: of the pictures and outlines as text in a page. Returns "cameras": for each name, size in px, calibration, times
    in s, JPEGs as base64, poses and outlines; "ahead": which of them looks ahead; "agents": ids that outlines refer to;
    "width_px", "rate_hz" and "bytes" as chosen. Cameras without a picture during the scenario are left out. Raises
    `ConfigError` when not even one small picture of each camera fits.
    """
    within = {name: records_within(log.streams[name].t_ns, scenario) for name in cameras if name in log.streams}
    within = {name: index for name, index in within.items() if len(index)}
    # The estimated bytes in a page of a picture of each camera, by width; none for cameras that cannot be read.
    widths = sorted({int(detail.size) for detail in PICTURE_DETAILS})
    probes: dict[str, dict[float, float]] = {}
    for name, index in within.items():
        sizes: dict[int, list[int]] = {width: [] for width in widths}
        for i in index[take_evenly(len(index), PROBES)].tolist():
            image = reader.get(name, i)
            if image is not None:
                shown = OUTLINE_BYTES * len(outlines_in(log, scenario, name, int(log.streams[name].t_ns[i])))
                for width in widths:
                    sizes[width].append((4 * -(-len(encode_small(image, width)) // 3)) + shown + POSE_BYTES)
        if sizes[widths[0]]:
            probes[name] = {width: SAFETY * float(np.mean(found)) for width, found in sizes.items()}
    known = {name: within[name] for name in probes}
    what = "pictures", "one of each camera", ", or choose fewer cameras with --cameras"
    detail, chosen = _fit(log, scenario.t0_ns, known, probes, PICTURE_DETAILS, budget_bytes, what)
    width_px = int(detail.size)
    jpegs: dict[str, dict[int, bytes]] = {name: {} for name in chosen}
    for camera, i, picture in read_pictures(reader, chosen, progress, least_px=width_px):
        jpegs[camera][i] = encode_small(picture, width_px)
    entries = {name: _entry(log, scenario, name, jpegs[name]) for name in chosen}
    entries = {name: entry for name, entry in entries.items() if entry["t_s"]}
    used = [log.cameras[name] for name in entries]
    forward = [camera.mount_T_cam[0, 2] if camera.mount == "ego" else -2.0 for camera in used]
    while (total := sum(map(_bytes_of, entries.values()))) > budget_bytes:  # evenly over the time
        for entry in entries.values():
            kept = take_evenly(len(entry["t_s"]), int(0.97 * len(entry["t_s"]) * budget_bytes / total)).tolist()
            entry |= {key: [entry[key][k] for k in kept] for key in ("t_s", "jpeg", "outlines", "cam_T_map")}
        if all(len(entry["t_s"]) <= 1 for entry in entries.values()):
            break
    return {
        "cameras": list(entries.values()),
        "ahead": int(np.argmax(forward)) if forward else 0,
        "agents": [agent.id for agent in scenario.others],
        "width_px": min(width_px, max((camera.width_px for camera in used), default=0)),
        "rate_hz": detail.rate_hz,
        "bytes": sum(map(_bytes_of, entries.values())),
    }


def _fit(
    log: Log,
    start_ns: int,
    within: Mapping[str, NDArray[np.int64]],
    probes: Mapping[str, Mapping[float, float]],
    details: Sequence[Detail],
    budget_bytes: int,
    what: tuple[str, str, str],
) -> tuple[Detail, dict[str, NDArray[np.int64]]]:
    """Choose the best detail that fits, and the records of each sensor, whose bytes by size are `probes`.

    `what`: names of all records and of one moment, and what else could be done where not even that fits.
    """
    for detail in details:
        chosen = {n: take_at_rate(log.streams[n].t_ns, index, detail.rate_hz, start_ns) for n, index in within.items()}
        if sum(len(index) * probes[n][detail.size] for n, index in chosen.items()) <= budget_bytes:
            return detail, chosen
    moment = sum(probe[detail.size] for probe in probes.values())
    most = int(budget_bytes / moment) if moment else 0
    if most < 1:
        noun, one, otherwise = what
        raise ConfigError(
            f"--max-mb: {budget_bytes / 1e6:.2f} MB are left for {noun}, and {one} has {moment / 1e6:.2f} MB; give more{otherwise}"
        )
    return detail, {name: index[take_evenly(len(index), most)] for name, index in chosen.items()}


def _entry(log: Log, scenario: Scenario, name: str, jpeg: Mapping[int, bytes]) -> dict[str, Any]:
    camera, t_ns = log.cameras[name], log.streams[name].t_ns
    order = sorted(index for index, data in jpeg.items() if data)
    map_T_cam, known = log.map_T_sensor(name, t_ns[order])
    reach = geometry.fold_radius(camera)
    return {
        "name": name,
        "size_px": [camera.width_px, camera.height_px],
        # For what is pulled in a picture; rolling shutters are left out.
        "K": [float(camera.K[0, 0]), float(camera.K[1, 1]), float(camera.K[0, 2]), float(camera.K[1, 2])],
        "model": camera.distortion_model,
        "distortion": list(map(float, camera.distortion)),
        "reach": reach if np.isfinite(reach) else 1e6,
        "cam_T_map": [
            np.round(geometry.inverse(m)[:3].ravel(), 7).tolist() if k else None for m, k in zip(map_T_cam, known)
        ],
        "t_s": [round((int(t_ns[i]) - scenario.t0_ns) / geometry.NS_PER_S, 4) for i in order],
        "jpeg": [base64.b64encode(jpeg[i]).decode() for i in order],
        "outlines": [outlines_in(log, scenario, name, int(t_ns[i])) for i in order],
    }


def _bytes_of(entry: Mapping[str, Any]) -> int:
    """Return the bytes of the pictures of a camera and their outlines in a page."""
    numbers = sum(len(str(row).replace(" ", "")) for key in ("outlines", "cam_T_map") for row in entry[key])
    return sum(map(len, entry["jpeg"])) + numbers + 12 * len(entry["t_s"])


UNIT_M = 0.05  # of stored positions: a pixel of a screen that shows 50 m
REACH_M = 120.0  # points farther from the ego, or from the middle of the sensors, are left out
# Above the ground: what is higher, such as trees and bridges, would cover the road from above.
MIN_HEIGHT_M, MAX_HEIGHT_M = -1.0, 5.0
HEIGHT_UNIT_M = (MAX_HEIGHT_M - MIN_HEIGHT_M) / 255
MAX_APART_S = 0.1  # between the sweeps of several LiDARs that are shown as one
# From the best down; the first that fits is taken. People are still seen as a point or two at 0.4 m.
POINT_DETAILS = (
    Detail(0.15, 10), Detail(0.25, 10), Detail(0.4, 10), Detail(0.4, 5), Detail(0.6, 5), Detail(0.6, 2), Detail(1.0, 2),
    Detail(1.0, 1), Detail(1.0, 0.5), Detail(1.0, 0.2),
)  # fmt: skip
POINT_PROBES, POINT_SAFETY = 3, 1.15
BYTES_OF_ENTRY = 60  # time and origin of a sweep in the page


@dataclass(frozen=True, eq=False)
class PointsAbove:
    """Points of one moment."""

    t_ns: int
    origin: tuple[int, int]  # (2,) tuple of, m map position that the points are relative to
    xy_m: geometry.Array  # (N, 2) relative to `origin`
    height_m: geometry.Array  # (N,) above the ground
    intensity: geometry.Array  # (N,) NaN where it is not known


def point_document(
    log: Log, scenario: Scenario, budget_bytes: int, reader: RecordSource, progress: Callable[[int, int], None]
) -> dict[str, Any] | None:
    """Return the points of a log's LiDARs within a budget; None where there are none during the scenario.

    Returns "t_s", "origin_m" and "points" of each moment, the last as `pack_recording` packs them; "unit_m"; "height_m", the lowest
    height and the step of a byte; "intensity", whether there is any; "cell_m", "rate_hz" and "bytes" as chosen. Raises `ConfigError`
    when not even one sweep fits.
    """
    lidars = [n for n in log.lidars if n in log.streams and len(records_within(log.streams[n].t_ns, scenario))]
    if not lidars:
        return None
    main = max(lidars, key=lambda name: len(records_within(log.streams[name].t_ns, scenario)))
    around = partial(_points_around, log, reader, {name: sweep_middle_ns(log, name) for name in lidars}, main)
    within = records_within(log.streams[main].t_ns, scenario)
    probes = [p for i in take_evenly(len(within), POINT_PROBES) if (p := around(int(within[i]))) is not None]
    if not probes:
        return None
    known = np.concatenate([p.intensity[np.isfinite(p.intensity)] for p in probes])
    bright = max(float(np.percentile(known, 98)), 0.0) if len(known) else 0.0
    sizes = {}
    for cell_m in dict.fromkeys(detail.size for detail in POINT_DETAILS):
        mean = np.mean([len(pack_recording(p, cell_m, bright)) for p in probes])
        sizes[cell_m] = POINT_SAFETY * float(mean) + BYTES_OF_ENTRY
    what = "LiDAR points", "one sweep", ""
    detail, by_name = _fit(log, scenario.t0_ns, {main: within}, {main: sizes}, POINT_DETAILS, budget_bytes, what)
    chosen = by_name[main]
    moments: list[tuple[PointsAbove, str]] = []
    for done, i in enumerate(chosen.tolist()):
        if (points := around(i)) is not None:
            moments.append((points, pack_recording(points, detail.size, bright)))
        progress(done + 1, len(chosen))
    while (total := sum(len(text) + BYTES_OF_ENTRY for _, text in moments)) > budget_bytes and len(moments) > 1:
        moments = [moments[k] for k in take_evenly(len(moments), int(0.97 * len(moments) * budget_bytes / total))]
    return {
        "t_s": [round((points.t_ns - scenario.t0_ns) / geometry.NS_PER_S, 4) for points, _ in moments],
        "origin_m": [list(points.origin) for points, _ in moments], "points": [text for _, text in moments],
        "unit_m": UNIT_M, "height_m": [MIN_HEIGHT_M, HEIGHT_UNIT_M], "intensity": bright > 0, "cell_m": detail.size,
        "rate_hz": detail.rate_hz, "bytes": total,
    }  # fmt: skip


def pack_recording(points: PointsAbove, cell_m: float, bright: float) -> str:
    """Keep the highest point of each cell and pack the rest as base64 of a zlib stream.

    For N points in rows of cells from south to north, each from west to east: low bytes of the steps in x (N), their high
    bytes, the same of y, heights and intensities as bytes. Steps are in `UNIT_M`, modulo 2**16, the first from 0. Small steps
    in planes of bytes deflate to less than half.
    """
    cells = np.floor(points.xy_m / cell_m).astype(np.int64)
    order = np.lexsort((points.height_m, cells[:, 0], cells[:, 1]))
    cells = cells[order]
    last = np.append(np.any(np.diff(cells, axis=0) != 0, axis=1), True) if len(order) else np.zeros(0, dtype=bool)
    kept = order[last]
    whole = np.rint(points.xy_m[kept] / UNIT_M).astype(np.int64)
    steps = np.diff(whole, axis=0, prepend=[[0, 0]]).astype(np.uint16)
    height = np.clip(np.rint((points.height_m[kept] - MIN_HEIGHT_M) / HEIGHT_UNIT_M), 0, 255)
    intensity = np.clip(np.nan_to_num(points.intensity[kept]) / (bright or 1.0) * 255, 0, 255)
    planes = [steps[:, 0] & 255, steps[:, 0] >> 8, steps[:, 1] & 255, steps[:, 1] >> 8, height, intensity]
    return base64.b64encode(zlib.compress(np.concatenate(planes).astype(np.uint8).tobytes(), 9)).decode()


def _points_around(
    log: Log, reader: RecordSource, middle_ns: Mapping[str, int], main: str, index: int
) -> PointsAbove | None:
    """Return the points of all LiDARs around a sweep of one; None where it cannot be read or has no known pose.

    `middle_ns`: of each LiDAR, from the stamp of a sweep to its middle. Kept is what is near and neither under the ground nor high above it.
    """
    t_ns = int(log.streams[main].t_ns[index]) + middle_ns[main]
    xyz, intensity = [], []
    for name, to_middle_ns in middle_ns.items():
        stamps = log.streams[name].t_ns + to_middle_ns
        nearest = index if name == main else int(geometry.nearest_index(stamps, t_ns)[0])
        if abs(int(stamps[nearest]) - t_ns) > MAX_APART_S * geometry.NS_PER_S:
            continue
        sweep = reader.get(name, nearest)
        mapped = None if sweep is None else sweep_to_map(log, name, sweep, compensate=True)
        if sweep is None or mapped is None:
            if name == main:
                return None
            continue
        xyz.append(mapped[0])
        none = np.full(len(mapped[0]), np.nan)
        intensity.append(none if sweep.intensity is None else np.asarray(sweep.intensity, dtype=np.float64))
    middle, ground_z = cloud_origin(log, t_ns)
    origin = np.rint(middle[:2])
    local = np.concatenate(xyz) - [*origin, 0.0]
    near = np.flatnonzero(np.abs(local[:, :2]).max(axis=1) <= REACH_M)
    local = local[near]
    height = local[:, 2] - estimate_ground(local, middle[:2] - origin, ground_z).at(local[:, :2])
    kept = np.flatnonzero((height >= MIN_HEIGHT_M) & (height <= MAX_HEIGHT_M))
    at = (int(origin[0]), int(origin[1]))
    return PointsAbove(t_ns, at, local[kept, :2], height[kept], np.concatenate(intensity)[near][kept])


POINT_SHARE = 0.3  # of the budget, for points, where there are pictures too; what they leave is for the pictures
# Of a page with pictures: mail and chat programs take so much, and a phone still opens it.
DEFAULT_MAX_BYTES = 40_000_000


@dataclass(frozen=True, eq=False)
class Recorded:
    """What to take of a log, and how much of it."""

    log: Log  # with the poses that the scenario was made with
    max_bytes: int = DEFAULT_MAX_BYTES  # of the whole page
    cameras: tuple[str, ...] = ()  # whose pictures to take; those that the scenario was made with where it is empty
    # Called as `progress(stage, done, total)` while records are read.
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None


def recording_document(scenario: Scenario, recorded: Recorded, budget_bytes: int) -> dict[str, Any]:
    """Return the pictures and points of a log for a page, within a budget.

    Returns "pictures" and "points", see `picture_document` and `point_document`, None where there are none, and
    "notes": what was chosen, in sentences. Raises `ConfigError` for an unknown camera, or when the budget is too small
    for a single moment. Raises `LogError` when none of the records asked for can be read.
    """
    log, report = recorded.log, recorded.progress
    reader = RecordSource(log)
    # The cameras to show, from left to right: those asked for, else those that the scenario was made with, else all
    require_cameras(log, recorded.cameras)
    used = tuple(str(c["name"]) for c in scenario.cameras if c.get("used") and c["name"] in log.cameras)

    def place(name: str) -> tuple[int, float]:  # those that look back come after the others, then those at the road
        x, y = log.cameras[name].mount_T_cam[:2, 2]
        azimuth = float(np.arctan2(y, x))
        return (int(abs(azimuth) > BACK_RAD), -azimuth) if log.cameras[name].mount == "ego" else (2, 0.0)

    cameras = tuple(sorted(recorded.cameras or used or log.cameras, key=place))
    share = POINT_SHARE if cameras else 1.0
    points = point_document(
        log, scenario, int(share * budget_bytes), reader, lambda done, total: report("page: sweeps", done, total)
    )
    left, pictures = budget_bytes - (0 if points is None else points["bytes"]), None
    if cameras:
        pictures = picture_document(
            log, scenario, cameras, budget_bytes=left, reader=reader,
            progress=lambda done, total: report("page: pictures", done, total),
        )  # fmt: skip
    reader.require_some()
    seen, hit = (f"no {what}: the log has none during the scenario" for what in ("pictures", "LiDAR points"))
    if pictures is not None and pictures["cameras"]:
        count, cameras_shown = sum(len(c["t_s"]) for c in pictures["cameras"]), len(pictures["cameras"])
        noun = f"{count} picture{'s' * (count != 1)} of {cameras_shown} camera{'s' * (cameras_shown != 1)}"
        seen = f"{noun}, {pictures['width_px']} px wide, {_rate_and_size(pictures)}"
    else:
        pictures = None
    if points is not None:
        noun = f"LiDAR points of {len(points['t_s'])} sweep{'s' * (len(points['t_s']) != 1)}"
        hit = f"{noun}, one in {points['cell_m']:g} m, {_rate_and_size(points)}"
    return {"pictures": pictures, "points": points, "notes": [seen, hit]}


def _rate_and_size(part: dict[str, Any]) -> str:
    return f"up to {part['rate_hz']:g} a second: {part['bytes'] / 1e6:.1f} MB"
