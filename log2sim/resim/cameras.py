"""Pictures of the recorded world from elsewhere: each pixel taken from a recorded picture that shows what is seen there now.

The caster gives the depth of every few pixels (of nodes) and whose surface it is, the background's or an agent's, of the picture
that is wanted and of recorded ones. A point of the background is looked for where it stood, one of an agent where the agent was
then, and taken where the recorded picture shows the same owner at that depth. So what did not change comes from the picture of the
same moment, an agent that was moved brings its pictures with it, and what it hid comes from times at which the place was free.
Image-based rendering with depth proxies: Hedman et al., "Scalable Inside-Out Image-Based Rendering", SIGGRAPH Asia 2016.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Log, Scenario
from log2sim.errors import RecordError
from log2sim.geometry import (
    NS_PER_S,
    Array,
    Camera,
    apply,
    cross_slab,
    inverse,
    line_time_s,
    nearest_index,
    rotation_from_rpy,
    transform,
    undistort,
)
from log2sim.perception.records import RecordSource
from log2sim.resim.caster import first_hits, grid_of, meetings
from log2sim.resim.rays import Shots, rays_in_map
from log2sim.resim.surfels import Surfels
from log2sim.resim.world import World, alive, given_T_refined, mesh_of, place
from log2sim.road.pictures import View
from log2sim.synth.backdrop import Backdrop
from log2sim.synth.light import GAMMA, OVERCAST, RenderCamera
from log2sim.synth.paint import paint
from log2sim.synth.render import Body, SceneInstant, draw_bodies, draw_shadows
from log2sim.synth.scene import AgentSpec

Image = NDArray[np.uint8]

NODES = 224  # across a picture
FAR_M = 300.0  # of what no ray meets
MAX_GROUND_M = 60.0  # ahead, where level ground goes on that no LiDAR saw
# Around an agent, whose outline is not exact, its pixels bring a rim with them, and its shadow on the ground.
RIM_NODES, SHADOW_M = 2, 0.4
# Farther around its box and on the ground around it a picture may show the agent where it should not; there are others.
BESIDE_M, BESIDE_GROUND_M = 0.25, 1.2
SAME_DEPTH, SAME_DEPTH_M = 0.06, 0.25
# Recorded pictures that are tried: places in the order of distance, which grow so that some of another time are among them.
TRIED = (0, 1, 2, 3, 5, 8, 12, 18, 27, 40, 60)
# How much farther away counts, m: a picture of another camera, one that looks elsewhere, an hour later.
OTHER_CAMERA_M, M_PER_RAD, M_PER_S = 1.0, 1.0, 0.05
MIN_LEFT = 0.002  # of the nodes: no further picture is tried for fewer
DRAWN_SHARE = 0.6  # of an agent that no picture shows: then all of it is drawn
MAX_GAIN, COMPARED = 1.6, 800  # of the brightness of one picture relative to another, and points that tell it
ASPHALT = 0.13  # linear albedo
CAM_T_LEVEL = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # x forward, y left, z up, as the caster has it


@dataclass(frozen=True, eq=False)
class DepthMap:
    """What a picture shows at its nodes, h rows and w columns, `step` pixels apart from the first pixel on."""

    step: int
    owner: NDArray[np.int64]  # (h, w) 0 for the background, k + 1 for agent k of `ids`
    depth_m: Array  # (h, w) along the optical axis
    met: NDArray[np.bool_]  # (h, w) whether a surface is there; elsewhere the depth is guessed
    point: Array  # (h, w, 3) m, in the frame of the agent, or the map of the background
    # (h, w) 0, or k + 1 before the box of agent k or the ground around it, where its outline and shadow may be
    beside: NDArray[np.int64]
    ids: tuple[str, ...]

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Least and greatest depth around each node."""
        kernel = np.ones((3, 3), np.uint8)
        return np.asarray(cv2.erode(self.depth_m, kernel)), np.asarray(cv2.dilate(self.depth_m, kernel))


class Recorded(NamedTuple):
    """A recorded picture."""

    camera: str
    record: int
    t_ns: int


def nodes_of(camera: Camera) -> tuple[int, Array]:
    """Return the step, px, and the pixels (h, w, 2) of the nodes of a camera, the last ones at the border."""
    step = max(2, round(camera.width_px / NODES))
    sides = [np.append(np.arange(0.0, n - 1, step), n - 1.0) for n in (camera.height_px, camera.width_px)]
    v, u = np.meshgrid(*sides, indexing="ij")
    return step, np.stack([u, v], -1)


def look(world: World, log: Log, scenario: Scenario, agents: Mapping[str, Surfels], name: str, t_ns: int) -> DepthMap:
    """Cast rays through the nodes of a camera, where it is in a log at a stamp, among the agents of a scenario."""
    camera = log.cameras[name]
    step, uv = nodes_of(camera)
    shape, uv = uv.shape[:2], uv.reshape(-1, 2)
    xy = undistort(camera, uv)
    usable = np.asarray(np.isfinite(xy).all(axis=1))
    ray = np.column_stack([np.where(usable[:, None], xy, 0), np.ones(len(xy))])
    length = np.linalg.norm(ray, axis=1)
    # Where the camera is when the line of each node is read.
    late_ns = np.rint(line_time_s(camera, uv) * NS_PER_S).astype(np.int64)
    moments, moment = np.unique(t_ns + late_ns, return_inverse=True)
    poses, valid = log.map_T_sensor(name, moments)
    middle = log.map_T_sensor(name, t_ns)[0][0]
    poses[~valid] = middle
    nothing = np.full(len(ray), np.nan, np.float32)
    level = Shots((ray @ CAM_T_LEVEL / length[:, None]).astype(np.float32), moments[moment], nothing, nothing)
    rays = rays_in_map(level, poses @ transform(CAM_T_LEVEL, np.zeros(3)), moment)
    placed = place(world, scenario, rays, agents, FAR_M)
    solid = replace(placed.surfels, share=(placed.surfels.share > 0.5).astype(np.float32))
    parts = meetings(rays, grid_of(rays), solid)
    hits = first_hits(parts, solid.material, len(ray), np.random.default_rng(0))
    met = np.isfinite(hits.range_m) & usable
    owner = np.where(met, np.searchsorted(placed.first[1:-1], hits.surfel, side="right"), 0).reshape(shape)
    towards = np.einsum("nij,nj->ni", poses[moment, :3, :3], ray)
    depth = np.where(met, hits.range_m / length, np.nan).reshape(shape)
    up, above_m = np.array([0.0, 0, 1]), middle[2, 3] - log.ground_z_ego_m
    if camera.mount == "ego":
        ego = middle @ inverse(camera.mount_T_cam)
        up, above_m = ego[:3, 2], float((middle[:3, 3] - ego[:3, 3]) @ ego[:3, 2]) - log.ground_z_ego_m
    depth = _without_gaps(depth, owner, (towards @ up).reshape(shape), above_m)
    # Discs are rough: surfaces are smooth, but what is thin stays.
    smooth = cv2.medianBlur(depth.astype(np.float32), 5).astype(np.float64)
    depth = np.where(np.abs(smooth - depth) < SAME_DEPTH * depth + SAME_DEPTH_M, smooth, depth)
    owner, depth, met = _with_rims(owner, depth, met.reshape(shape))
    # Outlines of the background are no more exact: what is beside something nearer goes with it.
    near = np.asarray(cv2.erode(np.where(owner == 0, depth, FAR_M), np.ones((3, 3), np.uint8)))
    depth = np.where((owner == 0) & (near * (1 + 2 * SAME_DEPTH) + SAME_DEPTH_M < depth), near, depth)
    points = poses[moment, :3, 3] + towards * depth.reshape(-1, 1)
    local = apply(inverse(given_T_refined(world, middle[:3, 3], t_ns)), points)
    flat, beside = owner.reshape(-1), np.zeros(len(points), np.int64)
    for k, id in enumerate(placed.ids):
        agent_T_map = inverse(pose_of(scenario, id, t_ns))
        own, half = apply(agent_T_map, points), np.array(scenario[id].size_m) / 2
        for low, high in (
            (-half - BESIDE_M, half + BESIDE_M),
            (-half - [BESIDE_GROUND_M, BESIDE_GROUND_M, 0.3], [*(half[:2] + BESIDE_GROUND_M), 0.3 - half[2]]),
        ):
            start = agent_T_map[:3, :3] @ middle[:3, 3] + agent_T_map[:3, 3]
            slabs = cross_slab(start, own - start, low, np.asarray(high))
            enter, leave = np.fmax.reduce(slabs[0], axis=1), np.fmin.reduce(slabs[1], axis=1)
            beside[(enter < 1) & (leave > enter) & (leave > 0)] = k + 1
        ground = (np.abs(own[:, :2]) < half[:2] + SHADOW_M).all(axis=1) & (np.abs(own[:, 2] + half[2]) < 0.3)
        flat[(flat == 0) & ground] = k + 1
        local[flat == k + 1] = own[flat == k + 1]
    return DepthMap(step, owner, depth, met, local.reshape(*shape, 3), beside.reshape(shape), placed.ids)


def pose_of(scenario: Scenario, id: str, t_ns: int) -> Array:
    """Return the pose (4, 4) of an agent in the map at a stamp."""
    x, y, z, yaw, _ = (float(v[0]) for v in scenario[id].trajectory.at(np.array([(t_ns - scenario.t0_ns) / NS_PER_S])))
    return np.asarray(transform(rotation_from_rpy(0.0, 0.0, yaw), np.array([x, y, z])))


def _without_gaps(depth: Array, owner: NDArray[np.int64], rise: Array, above_m: float) -> Array:
    """Guess the depth where nothing was met: the ground is level, and what stands goes on upward, as LiDARs see no higher.

    `depth` (h, w), m: NaN where nothing was met. `rise` (h, w): of the rays above the ground for each meter of depth.
    `above_m`: height of the camera above the ground.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.where(rise < 0, above_m / -rise, np.inf)
        stands = (above_m + rise * depth > 0.5) & (owner == 0)
    level[level > MAX_GROUND_M] = FAR_M
    out, below = depth.copy(), np.full(depth.shape[1], FAR_M)
    for row in range(len(depth) - 1, -1, -1):
        met = np.isfinite(depth[row])
        out[row] = np.where(met, depth[row], np.minimum(level[row], below))
        below = np.where(met & (owner[row] == 0), np.where(stands[row], depth[row], FAR_M), below)
    return out


def _with_rims(
    owner: NDArray[np.int64], depth: Array, met: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Let agents have the nodes of the background behind their outlines, too."""
    for _ in range(RIM_NODES):
        wide = np.pad(owner, 1), np.pad(depth, 1, constant_values=np.inf)
        own, far, has = owner.copy(), depth.copy(), met.copy()
        for down, right in ((0, 1), (2, 1), (1, 0), (1, 2)):
            part = slice(down, down + len(owner)), slice(right, right + owner.shape[1])
            taken = (own == 0) & (wide[0][part] > 0) & (wide[1][part] < depth)
            own[taken], far[taken], has[taken] = wide[0][part][taken], wide[1][part][taken], True
        owner, depth, met = own, far, has
    return owner, depth, met


class Pictures:
    """The recorded pictures of a log, what each of them shows, and others made of them.

    `source`: what was reconstructed from the log. `leave_out`: whether picture `i` of a camera is left out, to be compared with.
    """

    def __init__(
        self, log: Log, world: World, source: Scenario, leave_out: Callable[[str, int], bool] = lambda *_: False
    ) -> None:
        self.log, self.world, self.source = log, world, source
        self.frames: list[Recorded] = []
        poses = []
        for name in log.cameras:
            t_ns = log.streams[name].t_ns
            map_T_cam, valid = log.map_T_sensor(name, t_ns)
            for i in np.flatnonzero(valid):
                if not leave_out(name, int(i)):
                    self.frames.append(Recorded(name, int(i), int(t_ns[i])))
                    poses.append(map_T_cam[i])
        self.map_T_cam = np.array(poses).reshape(-1, 4, 4)
        self.t_ns = np.array([f.t_ns for f in self.frames], dtype=np.int64)
        self.camera = np.array([f.camera for f in self.frames])
        self.seen = lru_cache(maxsize=160)(self._seen)
        self.image = lru_cache(maxsize=16)(self._image)
        self.gain = lru_cache(maxsize=4096)(self._gain)

    def _seen(self, frame: int) -> DepthMap:
        name, _, t_ns = self.frames[frame]
        return look(self.world, self.log, self.source, self.world.agents, name, t_ns)

    def _image(self, frame: int) -> Image | None:
        """Return a recorded picture (H, W, 3) BGR; None where it cannot be read."""
        try:
            return np.asarray(RecordSource(self.log).require(*self.frames[frame][:2]), np.uint8)
        except RecordError:
            return None

    def ranked(self, name: str, t_ns: int, map_T_cam: Array, id: str, map_T_agent: Array) -> Iterator[int]:
        """Yield recorded pictures from where the background ("") or an agent looks as from a pose of a camera, the most alike first."""
        place, axis = self.map_T_cam[:, :3, 3], self.map_T_cam[:, :3, 2]
        here, ahead = map_T_cam[:3, 3], map_T_cam[:3, 2]
        usable = np.ones(len(place), dtype=bool)
        if id:
            agent = self.source[id]
            t_s = (self.t_ns - self.source.t0_ns) / NS_PER_S
            x, y, z, yaw, _ = agent.trajectory.at(t_s)
            then = inverse(transform(rotation_from_rpy(0.0, 0.0, yaw), np.column_stack([x, y, z])))
            offset = np.column_stack([x, y, z]) - place
            distance = np.linalg.norm(offset, axis=1)
            wide = [
                np.hypot(c.width_px, c.height_px) / 2 / c.K[0, 0] for c in map(self.log.cameras.get, self.camera) if c
            ]
            off = np.arccos(np.clip(np.einsum("ni,ni->n", axis, offset) / np.maximum(distance, 0.1), -1, 1))
            usable = alive(agent, t_s) & (
                off < np.arctan(wide) + np.arctan2(np.linalg.norm(agent.size_m) / 2, distance)
            )
            place, axis = (
                np.einsum("nij,nj->ni", then[:, :3, :3], v) + s * then[:, :3, 3] for v, s in ((place, 1), (axis, 0))
            )
            now = inverse(map_T_agent)
            here, ahead = now[:3, :3] @ here + now[:3, 3], now[:3, :3] @ ahead
        away = np.linalg.norm(place - here, axis=1) + OTHER_CAMERA_M * (self.camera != name)
        away += M_PER_RAD * np.arccos(np.clip(axis @ ahead, -1, 1)) + M_PER_S * np.abs(self.t_ns - t_ns) / NS_PER_S
        order = np.argsort(np.where(usable, away, np.inf), kind="stable")[: int(usable.sum())]
        for rank in TRIED:
            if rank < len(order):
                yield int(order[rank])

    def find(
        self, frame: int, id: str, point: Array, met: NDArray[np.bool_], beside: NDArray[np.str_]
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Find points (N, 3) of the background ("") or an agent in a recorded picture; `beside` (N,): of which agents they are.

        Returns their pixels (N, 2), and whether the picture shows them and nothing before them (N,).
        """
        name, _, t_ns = self.frames[frame]
        seen, camera, map_T_cam = self.seen(frame), self.log.cameras[name], self.map_T_cam[frame]
        if id and id not in seen.ids:
            return np.zeros((len(point), 2)), np.zeros(len(point), dtype=bool)
        own = given_T_refined(self.world, map_T_cam[:3, 3], t_ns) if not id else pose_of(self.source, id, t_ns)
        uv, depth = View(camera, map_T_cam, t_ns, self.log).project(apply(own, point))
        with np.errstate(invalid="ignore"):
            inside = (uv > -0.01) & (uv < [camera.width_px - 0.99, camera.height_px - 0.99])
        shown = np.asarray(inside.all(axis=1))
        column, row = np.rint(np.where(shown[:, None], uv, 0) / seen.step).astype(np.int64).T
        shown &= seen.owner[row, column] == (seen.ids.index(id) + 1 if id else 0)
        if not id:
            other = np.array(["", *seen.ids])[seen.beside[row, column]]
            shown &= (other == "") | (other == beside)
        near, far = seen.bounds
        same = (depth > near[row, column] * (1 - SAME_DEPTH) - SAME_DEPTH_M) & (
            depth < far[row, column] * (1 + SAME_DEPTH) + SAME_DEPTH_M
        )
        # Of depths that are guessed the other one may be.
        return uv, shown & (same | ~(met | seen.met[row, column]))

    def _gain(self, frame: int, reference: int) -> Array:
        """Return by how much brighter each channel (3,) of a reference is than that of another picture of the same background."""
        seen, images = self.seen(reference), (self.image(frame), self.image(reference))
        rows = np.flatnonzero(((seen.owner == 0) & seen.met & (seen.beside == 0)).ravel())
        if frame == reference or not len(rows) or images[0] is None or images[1] is None:
            return np.ones(3)
        rows = rows[:: max(1, len(rows) // (4 * COMPARED))]
        uv, shown = self.find(
            frame, "", seen.point.reshape(-1, 3)[rows], np.ones(len(rows), dtype=bool), np.full(len(rows), "")
        )
        own = nodes_of(self.log.cameras[self.frames[reference].camera])[1].reshape(-1, 2)[rows]
        colors = []
        for image, at in ((images[0], uv[shown]), (images[1], own[shown])):
            column, row = np.clip(np.rint(at), 0, [image.shape[1] - 1, image.shape[0] - 1]).astype(np.int64).T
            colors.append(cv2.blur(image, (5, 5))[row, column].astype(np.float64))
        fair = ((np.minimum(*colors) > 10) & (np.maximum(*colors) < 245)).all(axis=1)
        if fair.sum() < 50:
            return np.ones(3)
        return np.asarray(np.clip(np.median(colors[1][fair] / colors[0][fair], axis=0), 1 / MAX_GAIN, MAX_GAIN))

    def make(
        self,
        log: Log,
        scenario: Scenario,
        agents: Mapping[str, Surfels],
        name: str,
        t_ns: int,
        drawn: frozenset[str] = frozenset(),
    ) -> tuple[Image, NDArray[np.bool_]]:
        """Make the picture of a camera, where it is in a log at a stamp, among the agents of a scenario.

        Returns the picture (H, W, 3), BGR, and the pixels (H, W) that no recorded one shows: they are drawn or filled in.
        """
        camera, map_T_cam = log.cameras[name], log.map_T_sensor(name, t_ns)[0][0]
        there = {id: surfels for id, surfels in agents.items() if id not in drawn}
        seen = look(self.world, log, scenario, there, name, t_ns)
        shape = seen.owner.shape
        owner, point, met = seen.owner.ravel(), seen.point.reshape(-1, 3), seen.met.ravel()
        beside = np.array(["", *seen.ids])[seen.beside.ravel()]
        nodes = nodes_of(camera)[1].reshape(-1, 2)
        source, flow = np.full(len(owner), -1), np.zeros((len(owner), 2), np.float32)
        for k in np.unique(owner):
            id = seen.ids[k - 1] if k else ""
            own = np.flatnonzero(owner == k)
            known = not id or id in {agent.id for agent in self.source.others}
            map_T_agent = pose_of(scenario, id, t_ns) if id else np.eye(4)
            for mirror in (np.ones(3), np.array([1.0, -1, 1]))[: 2 if id else 1]:
                for frame in self.ranked(name, t_ns, map_T_cam, id, map_T_agent) if known else ():
                    rows = own[source[own] < 0]
                    if len(rows) <= MIN_LEFT * len(own):
                        break
                    uv, shown = self.find(frame, id, point[rows] * mirror, met[rows], beside[rows])
                    rows = rows[shown]
                    source[rows], flow[rows] = frame, uv[shown] - nodes[rows]
            if id and (source[own] < 0).mean() > DRAWN_SHARE:
                return self.make(log, scenario, agents, name, t_ns, drawn | {id})
        same = (self.camera == name).nonzero()[0]
        reference = int(same[nearest_index(self.t_ns[same], [t_ns])[0]]) if len(same) else -1
        image, unknown = self._composed(camera, seen, source.reshape(shape), flow.reshape(*shape, 2), reference)
        bodies = [
            a for a in scenario.others if a.id in drawn and alive(a, np.array([(t_ns - scenario.t0_ns) / NS_PER_S]))[0]
        ]
        if bodies:
            image, covered = _draw(image, camera, map_T_cam, seen, [(a, pose_of(scenario, a.id, t_ns)) for a in bodies])
            unknown |= covered
        return image, unknown

    def _composed(
        self, camera: Camera, seen: DepthMap, source: NDArray[np.int64], flow: NDArray[np.float32], reference: int
    ) -> tuple[Image, NDArray[np.bool_]]:
        """Put together the pixels that nodes (h, w) take from recorded pictures, by how far they moved (h, w, 2), px."""
        v, u = (np.arange(n, dtype=np.float32) for n in (camera.height_px, camera.width_px))
        near = [np.rint(a / seen.step).astype(np.intp) for a in (v, u)]
        cell = [np.minimum((a / seen.step).astype(np.intp), n - 2) for a, n in zip((v, u), source.shape)]
        even = np.ones((source.shape[0] - 1, source.shape[1] - 1), dtype=bool)
        corners = [(slice(a, a - 1 or None), slice(b, b - 1 or None)) for a in (0, 1) for b in (0, 1)]
        for k in corners[1:]:
            even &= (source[k] == source[corners[0]]) & (seen.owner[k] == seen.owner[corners[0]])
        depths = np.stack([seen.depth_m[k] for k in corners])
        even &= depths.max(axis=0) < depths.min(axis=0) * (1 + 2 * SAME_DEPTH) + 2 * SAME_DEPTH_M
        image = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
        unknown = np.ones(image.shape[:2], dtype=bool)
        for frame in np.unique(source[source >= 0]):
            recorded = self.image(int(frame))
            if recorded is None:
                continue
            rows, columns = (np.flatnonzero((source == frame).any(axis=a)[n]) for a, n in ((1, near[0]), (0, near[1])))
            if not len(rows) or not len(columns):
                continue
            r, c = (slice(int(k[0]), int(k[-1]) + 1) for k in (rows, columns))
            own = (source == frame)[near[0][r]][:, near[1][c]]
            at = np.meshgrid(u[c] / seen.step, v[r] / seen.step)
            smooth = cv2.remap(flow, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            moved = np.where(even[cell[0][r]][:, cell[1][c], None], smooth, flow[near[0][r]][:, near[1][c]])
            x, y = moved[..., 0] + u[c], moved[..., 1] + v[r, None]
            taken: NDArray[Any] = cv2.remap(recorded, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            gain = self.gain(int(frame), reference) if reference >= 0 else np.ones(3)
            if (gain != 1).any():
                taken = np.clip(np.rint(taken * gain), 0, 255)
            image[r, c][own] = taken[own]
            unknown[r, c] &= ~own
        return _filled(image, unknown, seen.step), unknown


def _filled(image: Image, unknown: NDArray[np.bool_], step: int) -> Image:
    """Fill in pixels from around them (Telea, 2004), at the resolution of the nodes."""
    if not unknown.any() or unknown.all():
        return image
    size = (max(1, image.shape[1] // step), max(1, image.shape[0] // step))
    known = cv2.resize((~unknown).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    small = cv2.resize(image * ~unknown[..., None], size, interpolation=cv2.INTER_AREA).astype(np.float32)
    mean = np.clip(small / np.maximum(known, 1e-3)[..., None], 0, 255).astype(np.uint8)
    filled = cv2.inpaint(mean, (known < 0.5).astype(np.uint8), 3, cv2.INPAINT_TELEA)
    wide = cv2.resize(filled, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.where(unknown[..., None], wide, image), np.uint8)


def _draw(
    image: Image, camera: Camera, map_T_cam: Array, seen: DepthMap, agents: list[tuple[Agent, Array]]
) -> tuple[Image, NDArray[np.bool_]]:
    """Draw agents of which there is no picture with the bodies of `synth`, as bright as the ground is in the picture."""
    bodies = []
    for agent, pose in agents:
        rgb = tuple((agent.color or {}).get("rgb", (110, 110, 115)))
        look_ = AgentSpec.model_construct(category=agent.category, size_m=agent.size_m, color=rgb, shape="hatch")
        bodies.append(Body(mesh_of(agent), pose, agent.size_m, partial(paint, look_)))
    view, light = RenderCamera.of(camera, map_T_cam), OVERCAST
    instant = SceneInstant(cast(Backdrop, None), bodies, light)
    size = (camera.width_px, camera.height_px)
    wide = cv2.resize(
        seen.depth_m.astype(np.float32), None, fx=seen.step, fy=seen.step, interpolation=cv2.INTER_NEAREST
    )
    depth = np.asarray(wide[: size[1], : size[0]], np.float32)
    shade = np.ones((*depth.shape, 3), np.float32)
    draw_shadows(view, bodies, instant, shade, np.ones(depth.shape, dtype=bool))
    black, white = np.zeros_like(shade), np.ones_like(shade)
    draw_bodies(view, bodies, instant, black, depth.copy())
    draw_bodies(view, bodies, instant, white, depth.copy())
    linear = (image.astype(np.float32) / 255) ** GAMMA
    lower = linear[linear.shape[0] * 2 // 3 :].reshape(-1, 3)
    gain = np.clip(np.median(lower, axis=0) / (ASPHALT * light.on_ground()), 0.1, 4)
    kept = np.clip(white - black, 0, 1)
    out = np.clip(linear * shade * kept + black * gain, 0, 1) ** (1 / GAMMA) * 255
    return np.asarray(np.rint(out), np.uint8), kept[..., 0] < 0.5
