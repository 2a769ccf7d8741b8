"""Synthesis of a log and its exact truth from a scene, and its writing.

scene = load_scene("samples/crossing.toml")
log, truth = synthesize(scene, seed=1)          # records are rendered and cast when they are read
write_synthetic(scene, "samples/crossing", seed=1)
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Point
from shapely.geometry.base import BaseGeometry

from log2sim.datatypes import (
    Agent,
    EgoVehicle,
    ImageLabels,
    Labels,
    Lidar,
    Log,
    MapFeatures,
    MapFrame,
    MapLane,
    Marking,
    RoadBorder,
    Scenario,
    Stream,
    Sweep,
    Waypoints,
)
from log2sim.datatypes.color_names import name_of
from log2sim.errors import ConfigError
from log2sim.files.documents import check_folder
from log2sim.files.outputs import replaced_folder
from log2sim.geometry import (
    NS_PER_S,
    Array,
    Camera,
    PoseTrack,
    apply,
    box_corners,
    inverse,
    project,
    rotation_from_rpy,
    transform,
    wrap_angle,
)
from log2sim.synth import ground, raycast
from log2sim.synth.actors import Actor, ActorStates, MovingScene
from log2sim.synth.backdrop import Backdrop
from log2sim.synth.ground import Ground, GroundPlan
from log2sim.synth.light import Lamp, headlights, light_of, street_lights
from log2sim.synth.paint import GroundReflectance
from log2sim.synth.render import Body, SceneInstant, bodies_at, camera_of, frame_stamps, render, segment, signals_of
from log2sim.synth.scene import Road, Scene

CELL_M = 1.0
MAX_RANGE_M = 40.0
STEP_S = 0.5  # between instants that are looked at
MIN_DEPTH_M = 0.5

Cells = NDArray[np.int64]
Caster = Callable[[str, int], raycast.LabeledSweep]


def seen_ground(moving: MovingScene, cameras: Mapping[str, Camera], cast: Caster) -> dict[str, Any]:
    """Return the cells as runs along x: `cell_m`, and rows [column of the first cell, row, number of cells].

    Cell (i, j) reaches from (i, j) to (i + 1, j + 1) times `cell_m` in the map.
    """
    parts = []
    for camera_spec in moving.scene.camera:  # cells whose middles cameras show
        camera, stamps = cameras[camera_spec.name], frame_stamps(camera_spec, moving.scene)
        poses = moving.map_T_mount(camera.mount, stamps) @ camera.mount_T_cam
        parts += [_in_view(moving, camera, poses[i], int(stamps[i])) for i in _every(stamps)]
    for spec in moving.scene.lidar:  # cells that beams met
        for i in _every(raycast.sweep_stamps(spec, moving.scene)):
            labeled = cast(spec.name, int(i))
            on = (labeled.hit == raycast.GROUND) & (np.linalg.norm(labeled.sweep.xyz_m, axis=1) < MAX_RANGE_M)
            stamps = np.full(1, labeled.sweep.stamp_ns) if labeled.sweep.t_ns is None else labeled.sweep.t_ns[on]
            moments, column = np.unique(stamps, return_inverse=True)
            map_T_lidar = moving.map_T_mount(spec.mount, moments) @ raycast.mount_T_lidar(spec)
            xyz = labeled.sweep.xyz_m[on].astype(np.float64)
            at = np.einsum("nij,nj->ni", map_T_lidar[column, :3, :3], xyz) + map_T_lidar[column, :3, 3]
            parts.append(np.unique(np.floor(at[:, :2] / CELL_M).astype(np.int64), axis=0))
    cells = np.unique(np.concatenate([np.zeros((0, 2), np.int64), *parts]), axis=0)
    cells = cells[np.lexsort((cells[:, 0], cells[:, 1]))]
    new = np.ones(len(cells), dtype=bool)
    new[1:] = (np.diff(cells[:, 1]) != 0) | (np.diff(cells[:, 0]) != 1)
    first = np.flatnonzero(new)
    count = np.diff(np.append(first, len(cells)))
    return {"cell_m": CELL_M, "runs": np.column_stack([cells[first], count]).tolist()}


def _every(t_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Choose records at least `STEP_S` apart."""
    _, first = np.unique((t_ns - t_ns[:1]) // int(STEP_S * NS_PER_S), return_index=True)
    return np.asarray(first)


def _in_view(moving: MovingScene, camera: Camera, map_T_cam: Array, t_ns: int) -> Cells:
    eye = map_T_cam[:3, 3]
    reach = np.arange(-int(MAX_RANGE_M / CELL_M), int(MAX_RANGE_M / CELL_M) + 1)
    i, j = np.meshgrid(reach, reach)
    cells = np.column_stack([i.ravel(), j.ravel()]) + np.floor(eye[:2] / CELL_M).astype(np.int64)
    middle = np.column_stack([(cells + 0.5) * CELL_M, np.zeros(len(cells))])
    p = apply(inverse(map_T_cam), middle)
    ahead = p[:, 2] > MIN_DEPTH_M
    uv = np.full((len(p), 2), -1.0)
    uv[ahead] = p[ahead, :2] / p[ahead, 2:] @ camera.K[:2, :2].T + camera.K[:2, 2]
    inside = ahead & (uv >= 0).all(1) & (uv < [camera.width_px, camera.height_px]).all(1)
    inside &= np.linalg.norm(middle - eye, axis=1) < MAX_RANGE_M
    cells, middle = cells[inside], middle[inside]
    free = np.ones(len(cells), dtype=bool)
    ray = middle - eye
    # Poses and sizes (3,) of all that hides the ground.
    t_s, seen = moving.seconds(t_ns), moving.seen_from(camera.mount)
    boxes = [(actor.at(t_s).map_T_agent()[0], np.array(actor.spec.box_m)) for actor in seen]
    for building in moving.scene.building:
        turn, at = rotation_from_rpy(0.0, 0.0, np.deg2rad(building.yaw_deg)), [*building.center, building.size_m[2] / 2]
        boxes.append((transform(turn, np.array(at)), np.array(building.size_m)))
    for map_T_box, size in boxes:
        box_T_map = inverse(map_T_box)
        start = np.tile(apply(box_T_map, eye[None]), (len(ray), 1))
        hit = raycast.slab_distance(size, start, ray @ box_T_map[:3, :3].T)
        free &= ~(hit < 1.0)
    return cells[free]


MIN_PIECE_M = 0.05  # of a line; less is what rounding leaves
CIRCLE_SEGMENTS = 64  # a quarter of a circle; 1 mm off on one of 4 m
DIGITS = 9  # whole nanometers: exact enough, and the file stays small
TURNS = "lanes that turn in junctions are not listed"

Interval = tuple[float, float]


def map_features_of(scene: Scene) -> MapFeatures:
    """Say what is painted on the ground of a scene, where its roads end, and which lanes they have.

    A line is cut where another road, a crosswalk or a stretch without markings interrupts it; a piece goes from where its
    paint begins to where it ends. Worn lines are whole, removed ones are left out. A lane lies between the lines that are
    painted, else between the ends of its road; it is cut where another road crosses it.
    """
    plan = ground.GroundPlan.of(scene)
    markings: list[Marking] = []
    borders: list[RoadBorder] = []
    lanes: list[MapLane] = []
    for k, road in enumerate(plan.roads):
        lines = ground.road_lines(road, keeps_right=plan.keeps_right)
        own = [_pieces_of(line, area_of(plan.interruptions(k)), f"line_{k}_{n}") for n, line in enumerate(lines)]
        markings += [piece for pieces in own for piece in pieces]
        crossed = area_of([ground.Stroke(np.array(r.line), r.width_m) for n, r in enumerate(plan.roads) if n != k])
        sides: list[list[RoadBorder]] = []  # the ends of the road at its right and its left, as its line runs
        for name, side in (("right", -1), ("left", 1)):
            edge = ground.parallel(np.array(road.line), side * road.width_m / 2)
            kind = "curb" if road.sidewalk_m > 0 else "edge"
            left = _along(LineString(edge), LineString(edge).difference(crossed))
            free = [_on_ground(ground.stretch(edge, *interval)) for interval in left]
            sides.append([RoadBorder(f"border_{k}_{name}_{n}", kind, points) for n, points in enumerate(free)])
        borders += [piece for pieces in sides for piece in pieces]
        lanes += _lanes(road, k, plan.keeps_right, tuple(zip(lines, own)), sides, crossed)
    for k, zebra in enumerate(plan.zebras):
        stripes, whole = ground.crosswalk_stripes(zebra), LineString(np.array(zebra.line))
        ends = (whole.project(Point(p)) for p in (stripes[0].line[0], stripes[-1].line[-1]))
        middle = ground.stretch(np.array(zebra.line), *ends)
        edges = [ground.parallel(middle, side * zebra.width_m / 2) for side in (-1, 1)]
        outline = _on_ground(np.concatenate([edges[0], edges[1][::-1]]))
        markings.append(Marking(f"crosswalk_{k}", "crosswalk", outline, zebra.width_m, "white"))
    for k, stop in enumerate(plan.stop_lines):
        line = _on_ground(np.array(stop.line))
        markings.append(Marking(f"stop_line_{k}", "stop_line", line, stop.width_m, stop.color))
    for k, arrow in enumerate(plan.arrows):
        outline = ground.arrow_outline(arrow)
        turn = np.deg2rad(arrow.yaw_deg)
        across = outline @ np.array([-np.sin(turn), np.cos(turn)])
        markings.append(Marking(f"arrow_{k}", "other", _on_ground(outline), float(np.ptp(across)), "white"))
    return MapFeatures(tuple(markings), tuple(borders), tuple(lanes), (TURNS,) if len(plan.roads) > 1 else ())


def area_of(strokes: Sequence[ground.Stroke]) -> BaseGeometry:
    """Area of strokes as they are painted: square ends, round joints."""
    parts = []
    for stroke in strokes:
        for a, b in zip(stroke.line, stroke.line[1:]):
            if not np.array_equal(a, b):
                parts.append(LineString([a, b]).buffer(stroke.width_m / 2, cap_style="flat"))
        parts += [Point(p).buffer(stroke.width_m / 2, quad_segs=CIRCLE_SEGMENTS) for p in stroke.line[1:-1]]
    return shapely.union_all(parts)


def _along(whole: LineString, part: BaseGeometry) -> list[Interval]:
    """Parts of a line, as distances along it in ascending order."""
    pieces = [p for p in shapely.get_parts(part) if p.geom_type == "LineString" and p.length >= MIN_PIECE_M]
    ends = [[float(whole.project(Point(p.coords[n]))) for n in (0, -1)] for p in pieces]
    out: list[Interval] = []  # pieces that meet at a point of the line are one
    for begin, end in sorted((min(e), max(e)) for e in ends):
        if out and begin - out[-1][1] < 10**-DIGITS:
            out[-1] = (out[-1][0], end)
        else:
            out.append((begin, end))
    return out


def _pieces_of(line: ground.RoadLine, gaps: BaseGeometry, name: str) -> list[Marking]:
    """Cut a line where it is interrupted."""
    whole = LineString(line.line)
    painted = [_along(whole, LineString(dash).difference(gaps)) for dash in line.dashes if len(dash) > 1]
    dashes = [interval for intervals in painted for interval in intervals]
    out: list[Marking] = []
    for begin, end in _along(whole, whole.difference(gaps)):
        inside = [(a, b) for a, b in dashes if a >= begin - MIN_PIECE_M and b <= end + MIN_PIECE_M]
        if inside:
            points = ground.stretch(line.line, min(a for a, _ in inside), max(b for _, b in inside))
            out.append(Marking(f"{name}_{len(out)}", line.kind, _on_ground(points), line.width_m, line.color))
    return out


def _lanes(
    road: Road,
    number: int,
    keeps_right: bool,
    lines: Sequence[tuple[ground.RoadLine, list[Marking]]],
    borders: Sequence[list[RoadBorder]],
    crossed: BaseGeometry,
) -> list[MapLane]:
    """List the lanes of a road from its right to its left, in the directions in which they are driven.

    They are cut at other roads; the parts on them belong to junctions.
    """
    at = (np.arange(road.lanes + 1) / road.lanes - 0.5) * road.width_m  # how far to the left their boundaries lie
    # Markings, or borders, of each boundary for the lane at its right and the one at its left.
    sides: list[tuple[Sequence[Marking | RoadBorder], Sequence[Marking | RoadBorder]]] = []
    for boundary in range(road.lanes + 1):
        own = [(line, pieces) for line, pieces in lines if line.boundary == boundary]
        if own:
            a, b = np.array(road.line[:2])
            ahead = (b - a) / np.linalg.norm(b - a)
            left_m = [float((line.line[0] - a) @ [-ahead[1], ahead[0]]) for line, _ in own]
            at[boundary] = np.mean(left_m)
            # Of a double line each lane has the one that is nearer.
            sides.append((own[int(np.argmin(left_m))][1], own[int(np.argmax(left_m))][1]))
        else:
            border = borders[0] if boundary == 0 else borders[1] if boundary == road.lanes else []
            sides.append((border, border))
    first = 0 if keeps_right else road.backward_lanes
    forward = [first <= lane < first + road.lanes - road.backward_lanes for lane in range(road.lanes)]
    parts: list[list[MapLane]] = []
    for lane in range(road.lanes):
        middle = ground.parallel(np.array(road.line), float(at[lane : lane + 2].mean()))
        whole = LineString(middle)
        free = [(interval, False) for interval in _along(whole, whole.difference(crossed))]
        pieces = sorted([*free, *((interval, True) for interval in _along(whole, whole.intersection(crossed)))])
        names = [f"lane_{number}_{lane}_{n}" for n in range(len(pieces))]
        parts.append([])
        for n, ((begin, end), inside) in enumerate(pieces):
            points = ground.stretch(middle, begin, end)
            ends = names[max(n - 1, 0) : n], names[n + 1 : n + 2]
            right, left = (None, None) if inside else [_beside(points, s) for s in (sides[lane][1], sides[lane + 1][0])]
            if not forward[lane]:
                points, ends, right, left = points[::-1], ends[::-1], left, right
            width, junction = np.full(len(points), np.diff(at)[lane]), f"junction_{number}_{n}" if inside else None
            links: dict[str, Any] = {"predecessors": tuple(ends[0]), "successors": tuple(ends[1]), "junction": junction}
            parts[-1].append(MapLane(names[n], _on_ground(points), width, left=left, right=right, **links))
    out = []
    for lane, own_parts in enumerate(parts):
        for n, piece in enumerate(own_parts):
            beside: dict[str, Any] = {}
            # To the left as it is driven, then to the right; of lanes that lead against it the last one counts.
            for field, step in (("left_lane", 1), ("right_lane", -1)):
                other = lane + (step if forward[lane] else -step)
                if 0 <= other < road.lanes and len(parts[other]) == len(own_parts):
                    same = forward[other] == forward[lane]
                    beside[field if same else "opposite"] = parts[other][n].id
            out.append(replace(piece, **beside))
    return out


def _beside(points: Array, pieces: Sequence[Marking | RoadBorder]) -> str | None:
    """Find which piece runs along most of a lane, None without one."""
    lane = LineString(points)

    def shared_m(piece: Marking | RoadBorder) -> float:
        ends = [lane.project(Point(p)) for p in piece.points_m[[0, -1], :2]]
        return float(abs(ends[1] - ends[0]))

    best = max(pieces, key=shared_m, default=None)
    return best.id if best is not None and shared_m(best) > 0 else None


def _on_ground(points: Array) -> Array:
    return np.column_stack([np.round(points, DIGITS), np.zeros(len(points))])


MIN_UNOCCLUDED = 1 / 3
MIN_BOX_INSIDE = 0.5
MIN_LIDAR_POINTS = 20
MIN_LABEL_PX = 8.0  # a smaller box is no label


@dataclass(frozen=True, eq=False)
class FrameVisibility:
    """Visibility of the actors in one camera frame."""

    t_ns: int
    unoccluded: Array  # (A,): share of the silhouette that is visible
    inside: Array  # (A,): share of the projected box inside the image
    box_px: Array  # (A, 4), px: box of the visible part; NaN without one


def visibility_by_camera(
    moving: MovingScene, cameras: Mapping[str, Camera], backdrop: Backdrop
) -> dict[str, list[FrameVisibility]]:
    """Segment every frame of every camera."""
    out: dict[str, list[FrameVisibility]] = {}
    for spec in moving.scene.camera:
        camera = cameras[spec.name]
        out[spec.name] = []
        for t_ns in frame_stamps(spec, moving.scene):
            t_s = moving.seconds(t_ns)
            map_T_cam = moving.map_T_mount(camera.mount, np.array([t_ns]))[0] @ camera.mount_T_cam
            bodies = [Body.of(actor, t_s) for actor in moving.seen_from(spec.mount)]
            parts = segment(camera, map_T_cam, SceneInstant(backdrop, bodies))[: len(moving.actors)]
            unoccluded = np.array([0.0 if p is None else p.visible_px / p.silhouette_px for p in parts])
            boxes = np.array([np.full(4, np.nan) if p is None else p.box_px for p in parts]).reshape(-1, 4)
            # Of the rectangle around each projected 3D box; 0 unless all corners are ahead.
            inside = np.zeros(len(moving.actors))
            for k, actor in enumerate(moving.actors):
                state = actor.at(t_s)
                corners = box_corners(state.center_m, actor.spec.box_m, state.yaw_rad)[0]
                uv, _ = project(camera, apply(inverse(map_T_cam), corners))
                if np.all(np.isfinite(uv)):
                    low, high = uv.min(0), uv.max(0)
                    shown = np.minimum(high, [camera.width_px, camera.height_px]) - np.maximum(low, 0)
                    inside[k] = np.clip(shown, 0, None).prod() / (high - low).prod()
            out[spec.name].append(FrameVisibility(int(t_ns), unoccluded, inside, boxes))
    return out


def visible_at(
    t_ns: NDArray[np.int64],
    frames: Mapping[str, Sequence[FrameVisibility]],
    sweeps: Sequence[tuple[NDArray[np.int64], NDArray[np.intp]]],
    count: int,
) -> NDArray[np.bool_]:
    """Decide which of `count` actors are visible: mask (T, A) at stamps (T,).

    `sweeps`: of each LiDAR the middles of its sweeps (F,) and its points on each actor (F, A). An actor is visible when the frame of one camera and the sweep of one LiDAR nearest in time both show it well. Without
    cameras, or without LiDARs, the others decide.
    """
    by_camera = np.full((len(t_ns), count), not frames)
    for parts in frames.values():
        if parts:
            shown = np.array([(f.unoccluded >= MIN_UNOCCLUDED) & (f.inside >= MIN_BOX_INSIDE) for f in parts])
            by_camera |= shown[_nearest(np.array([f.t_ns for f in parts]), t_ns)]
    by_lidar = np.full_like(by_camera, not sweeps)
    for stamps, points in sweeps:
        if len(stamps):
            by_lidar |= (points >= MIN_LIDAR_POINTS)[_nearest(stamps, t_ns)]
    return np.asarray(by_camera & by_lidar)


def _nearest(stamps: NDArray[np.int64], t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.asarray(np.abs(stamps[None, :] - t_ns[:, None]).argmin(1))


def labels_2d(
    frames_by_camera: Mapping[str, list[FrameVisibility]], actors: tuple[Actor, ...]
) -> dict[str, ImageLabels]:
    """Boxes around the visible parts of agents that are at least a third unoccluded, by camera."""
    category = np.array([a.spec.category for a in actors])
    out = {}
    for name, frames in frames_by_camera.items():
        t_ns, boxes, categories = [], [], []
        for frame in frames:
            big = np.nan_to_num(frame.box_px[:, 2:] - frame.box_px[:, :2]).min(1) >= MIN_LABEL_PX
            rows = np.flatnonzero((frame.unoccluded >= MIN_UNOCCLUDED) & big)
            t_ns += [frame.t_ns] * len(rows)
            boxes.append(frame.box_px[rows])
            categories.append(category[rows])
        shown, kinds = np.concatenate(boxes).reshape(-1, 4), np.concatenate(categories).astype("<U16")
        out[name] = ImageLabels(np.array(t_ns, dtype=np.int64), shown, kinds)
    return out


def labels_3d(
    scene: Scene, frames_by_camera: Mapping[str, list[FrameVisibility]], actors: tuple[Actor, ...]
) -> Labels | None:
    """Boxes of all agents at the frames of the first camera, without one at the sweeps of the first LiDAR."""
    if not actors or not (scene.camera or scene.lidar):
        return None
    if scene.camera:
        t_ns = np.array([f.t_ns for f in frames_by_camera[scene.camera[0].name]], dtype=np.int64)
    else:
        t_ns = raycast.sweep_stamps(scene.lidar[0], scene)
    t_s = (t_ns - scene.start_ns) / NS_PER_S
    states = [a.at(t_s) for a in actors]
    ids, kinds = (np.repeat([getattr(a.spec, key) for a in actors], len(t_ns)) for key in ("id", "category"))
    return Labels(
        t_ns=np.tile(t_ns, len(actors)), track_id=ids, category=kinds,
        center_m=np.concatenate([s.center_m for s in states]), yaw_rad=np.concatenate([s.yaw_rad for s in states]),
        size_m=np.repeat([a.spec.box_m for a in actors], len(t_ns), axis=0), visible=None,
    )  # fmt: skip


TRUTH_STEP_S = 0.05
# Sweeps that were cast for the visibility of agents and are read next: memory for some hundred of 64 lines.
MAX_CACHED_BYTES, BYTES_PER_RAY = 400_000_000, 32
GNSS_CORRELATION_S = 2.0  # time constant of the errors of GNSS and IMU


def synthesize(scene: Scene, *, seed: int = 0, observe: bool = True) -> tuple[Log, Scenario]:
    """Make a log, whose records are rendered and cast when read, and its exact truth.

    In the log, `ego` has the errors of GNSS and IMU. A sweep's stamp is its end; its points are in the lidar frame at their
    own time. Record `i` of a sensor depends on the seed, the sensor's index in the scene and `i` alone. The truth has every
    agent and the ego ("ego") each 0.05 s; x, y, z of box centers. `visible` is true where one LiDAR sweep has 20 points or
    more on the agent and one camera shows a third or more of its silhouette, at least half of its box; without `observe`
    it is omitted, and so are the log's labels. Its map features are all that is painted, where roads end, and their lanes.
    """
    moving = MovingScene.of(scene)
    cameras = {spec.name: camera_of(spec) for spec in scene.camera}
    lidars = {spec.name: Lidar(spec.name, spec.mount, raycast.mount_T_lidar(spec)) for spec in scene.lidar}
    specs = {spec.name: (index, spec) for index, spec in enumerate(scene.lidar)}
    rays = max((len(raycast.ray_pattern(spec)[0]) for spec in scene.lidar), default=1)

    @lru_cache(maxsize=max(1, MAX_CACHED_BYTES // (BYTES_PER_RAY * rays)))
    def cast(name: str, i: int) -> raycast.LabeledSweep:
        index, spec = specs[name]
        stamp, rng = int(raycast.sweep_stamps(spec, scene)[i]), np.random.default_rng([seed, 4, index, i])
        return raycast.cast_sweep(spec, moving, stamp, rng, _ground_reflectance(scene, seed))

    def sweep_of(name: str, i: int) -> Sweep:
        return cast(name, i).sweep

    streams = _image_streams(moving, cameras, seed)
    for spec in scene.lidar:
        stamps = raycast.sweep_stamps(spec, scene)
        streams[spec.name] = Stream(spec.name, stamps, partial(sweep_of, spec.name))
    frames: dict[str, list[FrameVisibility]] = {}
    t_s = np.arange(0, scene.duration_s + 1e-9, TRUTH_STEP_S)
    visible = None
    if observe:
        frames = visibility_by_camera(moving, cameras, _backdrop(scene, seed))
        sweeps = []
        for spec in scene.lidar:
            stamps, count = streams[spec.name].t_ns, len(moving.actors)
            hits = (cast(spec.name, i).hit for i in range(len(stamps)))
            points = np.array([np.bincount(h[h >= 0], minlength=count) for h in hits]).reshape(len(stamps), count)
            sweeps.append((stamps - round(NS_PER_S / spec.rate_hz / 2), points))
        t_ns = scene.start_ns + np.rint(t_s * NS_PER_S).astype(np.int64)
        visible = visible_at(t_ns, frames, sweeps, len(moving.actors))
    truth = _truth(moving, t_s, visible, seed)
    if observe:
        truth = replace(truth, provenance={**truth.provenance, "seen_ground": seen_ground(moving, cameras, cast)})
    log = Log(
        name=scene.name, format="synthetic", cameras=cameras, lidars=lidars, streams=streams,
        ego=None if moving.ego is None else _measured_poses(moving.ego, scene, np.random.default_rng([seed, 1])),
        ego_vehicle=EgoVehicle() if scene.ego is None else EgoVehicle(scene.ego.size_m, scene.ego.rear_axle_offset_m),
        map=truth.map, labels=labels_3d(scene, frames, moving.actors) if observe else None,
        image_labels=labels_2d(frames, moving.actors) if observe else {},
        reference_camera=scene.camera[0].name if scene.camera else None, digest=_digest(scene, seed),
        notes=(f"synthetic, seed {seed}",),
    )  # fmt: skip
    return log, truth


def _image_streams(moving: MovingScene, cameras: dict[str, Camera], seed: int) -> dict[str, Stream]:
    scene, light = moving.scene, light_of(moving.scene.environment)

    def read(camera: Camera, index: int, t_ns: NDArray[np.int64], i: int) -> NDArray[np.uint8]:
        map_T_cam = moving.map_T_mount(camera.mount, t_ns[i : i + 1])[0] @ camera.mount_T_cam
        rng = np.random.default_rng([seed, 2, index, i])
        bodies = [Body.of(actor, moving.seconds(t_ns[i])) for actor in moving.seen_from(camera.mount)]
        bodies += bodies_at(scene, moving.seconds(t_ns[i]))
        lamps: list[Lamp] = []
        if light.lamps > 0:  # street lights around the camera, and the headlights of all that drives
            lamps += street_lights(scene.road, map_T_cam[:2, 3])
            for actor in moving.seen_from("map"):
                if actor.spec.vehicle and actor.path is not None:
                    pose = actor.at(moving.seconds(t_ns[i])).map_T_agent()[0]
                    pose[2, 3] = 0.0
                    lamps += headlights(pose, actor.spec.box_m[0] / 2, actor.spec.box_m[1])
        return render(camera, map_T_cam, SceneInstant(_backdrop(scene, seed), bodies, light, tuple(lamps)), rng)

    out = {}
    for index, spec in enumerate(scene.camera):
        stamps = frame_stamps(spec, scene)
        if len(stamps) == 0:
            raise ConfigError(
                f"camera '{spec.name}': no frame falls within {scene.duration_s:g} s; change its offset_s"
            )
        out[spec.name] = Stream(spec.name, stamps, partial(read, cameras[spec.name], index, stamps))
    return out


@lru_cache(maxsize=2)
def _backdrop(scene: Scene, seed: int) -> Backdrop:
    return Backdrop.of(scene, seed)


@lru_cache(maxsize=2)
def _ground_reflectance(scene: Scene, seed: int) -> GroundReflectance:
    return GroundReflectance(Ground(GroundPlan.of(scene), seed), light_of(scene.environment).wetness)


def _measured_poses(ego: Actor, scene: Scene, rng: np.random.Generator) -> PoseTrack:
    """Poses of GNSS and IMU: each coordinate with a first-order Gauss-Markov error."""
    count = int(np.floor(scene.duration_s * scene.gnss.rate_hz + 1e-9)) + 1
    t = np.arange(count) / scene.gnss.rate_hz
    sigma = np.array([scene.gnss.position_sigma_m] * 3 + [np.deg2rad(scene.gnss.angle_sigma_deg)] * 3)
    keep = np.exp(-1 / (scene.gnss.rate_hz * GNSS_CORRELATION_S))
    error = np.empty((count, 6))
    error[0] = rng.normal(0, 1, 6) * sigma
    for k in range(1, count):
        error[k] = keep * error[k - 1] + np.sqrt(1 - keep**2) * rng.normal(0, 1, 6) * sigma
    exact = ego.map_T_axle(t)
    turn = transform(rotation_from_rpy(error[:, 3], error[:, 4], error[:, 5]), np.zeros((count, 3)))
    poses = exact @ turn
    poses[:, :3, 3] = exact[:, :3, 3] + error[:, :3]
    return PoseTrack(scene.start_ns + np.rint(t * NS_PER_S).astype(np.int64), poses)


def _truth(moving: MovingScene, t_s: Array, visible: NDArray[np.bool_] | None, seed: int) -> Scenario:
    scene, agents = moving.scene, []
    if moving.ego is not None:
        waypoints, offset_m = _waypoints(t_s, moving.ego.at(t_s), None), moving.ego.offset_m
        agents.append(Agent("ego", "car", moving.ego.spec.box_m, waypoints, rear_axle_offset_m=offset_m))
    for index, actor in enumerate(moving.actors):
        spec, shown = actor.spec, None if visible is None else visible[:, index]
        agents.append(Agent(
            spec.id, spec.category, spec.box_m, _waypoints(t_s, actor.at(t_s), shown), static=actor.path is None,
            rear_axle_offset_m=spec.rear_axle_offset_m, color={"rgb": list(spec.color), "name": name_of(spec.color)},
        ))  # fmt: skip
    at = scene.origin
    place = f"+lat_0={at.latitude_deg!r} +lon_0={at.longitude_deg!r}"
    projection = f"+proj=tmerc {place} +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m"
    frame = MapFrame(at.latitude_deg, at.longitude_deg, at.altitude_m, projection)
    provenance = {"source": "synthetic", "seed": seed, "scene_digest": _digest(scene, seed)}
    return Scenario(
        scene.name, scene.start_ns, float(t_s[-1]), tuple(agents), frame, provenance=provenance,
        map_features=map_features_of(scene), signals=signals_of(scene),
    )  # fmt: skip


def _waypoints(t_s: Array, states: ActorStates, visible: NDArray[np.bool_] | None) -> Waypoints:
    # Whole nanoseconds and nanometers: exact enough, and the file stays small.
    t, x, y, z, yaw, speed = (np.round(c, 9) for c in (t_s, *states.center_m.T, states.yaw_rad, states.speed_mps))
    seen, sigma = np.ones(len(t_s), dtype=bool), np.zeros(len(t_s))
    return Waypoints(t, x, y, z, wrap_angle(yaw), speed, seen, sigma, visible=visible)


def _digest(scene: Scene, seed: int) -> str:
    return hashlib.sha256(f"{scene!r} {seed}".encode()).hexdigest()


TRUTH_FILE = "truth.json"


def write_synthetic(
    scene: Scene,
    out: Path | str,
    *,
    seed: int = 0,
    overwrite: bool = False,
    jpeg_quality: int = 85,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a scene's log as a native log folder with its truth as `truth.json` in it, whole or not at all.

    A folder `out` that is there already is replaced only with `overwrite`, and only if it is a log. `jpeg_quality`: 1 to
    100. `progress(done, total)` is called after each record.

    Raises `ConfigError` when the folder may not be replaced or cannot be written.
    """
    from log2sim.logs.native.writer import refuse_target, write_log

    target = Path(out)
    refuse_target(target, overwrite=overwrite)
    check_folder(target, overwrite=overwrite)
    log, truth = synthesize(scene, seed=seed)
    poses: Literal["gnss", "poses"] = scene.ego.poses if scene.ego is not None else "poses"
    with replaced_folder(target, overwrite=overwrite) as folder:
        write_log(log, folder, jpeg_quality=jpeg_quality, ego=poses, progress=progress)
        truth.save(folder / TRUTH_FILE)
