"""The recorded world: what stands in it as one set of surfels, and every agent as one in its own frame.

A point belongs to the agent in whose box it lies at its own time, so that an agent leaves no copy where it was. What no agent
of the scenario explains is found by the rays: a disc that rays pass through as often as not is one of a tree, a fence or an
edge and keeps that share; one that nearly all pass through was there for a moment only, and is taken out.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, MutableMapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.datatypes import GROUP_OF, Agent, Log, Scenario
from log2sim.errors import LogError, RecordError
from log2sim.files.arrays import DiskBackedMap
from log2sim.geometry import NS_PER_S, Array, PoseTrack, inverse
from log2sim.localization.pose_refinement import refine_poses
from log2sim.perception.records import RecordSource
from log2sim.resim.alignment import Alignment, moved
from log2sim.resim.caster import grid_of, meetings
from log2sim.resim.rays import (
    Floats,
    Pattern,
    Rays,
    Shots,
    all_shots,
    angles_of,
    find_pattern,
    poses_of,
    rays_in_map,
    recorded_shots,
)
from log2sim.resim.sightings import Sighting, frame_at, is_non_rigid, sighting, thinned
from log2sim.resim.surfels import (
    GRID_TILE_M,
    SurfelGrid,
    Surfels,
    Tile,
    Tiles,
    by_tile,
    joined,
    local_surface,
    no_surfels,
)
from log2sim.synth import shapes

# Around the box of an agent, whose edges are not exact: what is left out of the background, and what is taken for the agent.
LEFT_OUT_M, TAKEN_M = 0.35, 0.15
GROUND_M = 0.12  # above the bottom of a box; below that it may be the ground
HELD_S = 0.3  # before the first and after the last waypoint
COVERED_M = 0.25  # around a disc of an agent, where none is added
# Of each LiDAR, and of so much of its way, over which a place is seen well: enough rays for the share of each disc.
CHECKED_SWEEPS, CHECKED_WAY_M = 25, 100.0
SAME_SURFACE_M = 0.1  # across it, between where a ray met and where it should
MIN_SHARE = 0.2
SAME_PLACE_M = 0.5
# Ground around an agent, how far it may be off the bottom of its box, and the discs that go on with it.
AROUND_M, MAX_STEP_M, GROUND_DISC_M = 1.5, 0.4, 0.15
MOST_SIGHTINGS_BYTES = 256 << 20  # 64,000 sightings of 4 kB: ten minutes with ten people in sight all the time
# In memory: of surfaces while they are joined, and of rays that are counted.
GRIDS_BYTES, COUNTS_BYTES = 256 << 20, 64 << 20
AROUND_SWEEPS = 20  # what so many have added to is within reach, and the next ones will add to it
SIGHTINGS_EVERY = 50  # sweeps, after which they are counted
PRIOR_RAYS, PRIOR_UNSEEN = 2.0, 0.15  # that end on a disc before any is counted; share of them for one that nobody saw
BODY_DISC_M = 0.08  # radius of the discs of a body that nobody saw

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Model:
    """How a LiDAR measures."""

    pattern: Pattern
    noise_m: float
    intensity: float  # mean; surfels hold intensities relative to it, which makes those of several LiDARs alike
    max_intensity: float
    whole: bool  # whether intensities are whole numbers
    max_range_m: float


@dataclass(frozen=True, eq=False)
class World:
    """What a log shows of its surroundings."""

    shift_m: Array  # (3,): the background is in its own map less this
    # Poses of the ego by which agents are placed, and at the same stamps those by which surfaces lie on each other: the
    # background is in the map of the latter.
    given: PoseTrack | None
    refined: PoseTrack | None
    background: Tiles
    agents: Mapping[str, Surfels]  # by id, in the frame of the agent
    sightings: Mapping[str, list[Sighting]]  # of people and riders, by id
    alignments: Mapping[str, Alignment]  # of the others, by id
    models: Mapping[str, Model]  # by LiDAR
    notes: tuple[str, ...]  # what could not be seen


@dataclass(frozen=True, eq=False)
class Placed:
    """All surfels where they are while a sweep is recorded."""

    surfels: Surfels  # in the map less the shift of the rays; column by column in memory
    first: NDArray[np.int64]  # (A + 2,): where the surfels of the background and of each agent begin, and the end
    ids: tuple[str, ...]  # of these agents
    tiles: tuple[Tile, ...]  # of the background, one after the other


def alive(agent: Agent, t_s: Array) -> NDArray[np.bool_]:
    """Return when an agent is there; one that stands all the time is."""
    w = agent.waypoints
    there: NDArray[np.bool_] = (t_s >= w.t_s[0] - HELD_S) & (t_s <= w.t_s[-1] + HELD_S)
    return there | agent.is_permanent


def _is_near(agent: Agent, t_s: Array, here: Array, reach_m: float) -> bool:
    """Tell whether an agent may be there at some of the times (T,), within reach of a place (2,), m, of the map."""
    w = agent.waypoints
    if not agent.is_permanent and (w.t_s[0] - HELD_S > t_s.max() or w.t_s[-1] + HELD_S < t_s.min()):
        return False
    # Between two waypoints it is no farther from both than they are apart.
    way = np.hypot(np.diff(w.x_m), np.diff(w.y_m)).max(initial=0)
    reach_m += float(way) + float(np.hypot(*agent.size_m[:2])) + 2 * HELD_S * float(np.abs(w.speed_mps).max())
    return bool(np.hypot(w.x_m - here[0], w.y_m - here[1]).min() < reach_m)


def place(world: World, scenario: Scenario, rays: Rays, agents: Mapping[str, Surfels], reach_m: float) -> Placed:
    """Put the agents of a scenario within reach into the background, each disc where it is when the sensor looks there."""
    here = rays.origin[len(rays.origin) // 2] + rays.shift_m
    move = given_T_refined(world, here, int(rays.t_ns[0]))
    rotation = move[:3, :3].astype(np.float32)
    offset = (move[:3, :3] @ world.shift_m + move[:3, 3] - rays.shift_m).astype(np.float32)
    x_m, y_m, _ = np.linalg.inv(move[:3, :3]) @ (here - move[:3, 3]) - world.shift_m
    tiles, ids = world.background.near(float(x_m), float(y_m), reach_m), []
    parts = [no_surfels(), *(world.background[tile] for tile in tiles)]
    center = [rotation @ part.center_m.T + offset[:, None] for part in parts]
    normal = [rotation @ part.normal.T for part in parts]
    t_s = (rays.bin_ns - scenario.t0_ns) / NS_PER_S
    for agent in scenario.others:
        if agent.id not in agents or not _is_near(agent, t_s, here, reach_m):
            continue
        there = alive(agent, t_s)
        surfels, states = agents[agent.id], agent.trajectory.at(t_s)
        pose, z = np.column_stack([states.x_m, states.y_m, states.yaw_rad]) - [*rays.shift_m[:2], 0], states.z_m
        if agent.id in world.alignments:
            fit = world.alignments[agent.id].at(t_s, states.x_m, states.y_m)
            pose = np.column_stack([moved(np.column_stack([fit[:, :2], z]), pose)[:, :2], pose[:, 2] + fit[:, 2]])
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        table = np.stack([pose[:, 0], pose[:, 1], z - rays.shift_m[2], cos, sin]).astype(np.float32)
        local = surfels.center_m.T

        def placed(bins: NDArray[np.int64], table: Floats = table, local: Floats = local) -> Floats:
            x, y, up, c, s = table.take(bins, axis=1)
            return np.stack([c * local[0] - s * local[1] + x, s * local[0] + c * local[1] + y, local[2] + up])

        bins = rays.bins_toward(len(surfels), placed)
        points, (c, s) = placed(bins), table[3:].take(bins, axis=1)
        nx, ny, nz = surfels.normal.T
        turned, own = np.stack([c * nx - s * ny, s * nx + c * ny, nz]), there[bins]
        if not own.all():
            surfels, points, turned = surfels.take(own), points[:, own], turned[:, own]
        parts.append(surfels)
        center.append(points)
        normal.append(turned)
        ids.append(agent.id)
    first = np.cumsum([0, sum(len(p) for p in parts[: len(tiles) + 1]), *(len(p) for p in parts[len(tiles) + 1 :])])
    columns = (np.concatenate(of, axis=1).T for of in (center, normal))
    rest = (np.concatenate([vars(p)[name] for p in parts]) for name in ("radius_m", "intensity", "share", "returned"))
    return Placed(Surfels(*columns, *rest), first, tuple(ids), tuple(tiles))


def given_T_refined(world: World, here: Array, t_ns: int) -> Array:
    """Return the pose (4, 4) of the map of the background in that of the agents, as it was where a sensor is now, (3,) m."""
    if world.given is None or world.refined is None:
        return np.eye(4)
    distance = np.linalg.norm(world.given.map_T_ego[:, :3, 3] - here, axis=1)
    # Of several times at which it was there, the one nearest to now.
    late = np.where(distance < distance.min() + SAME_PLACE_M, np.abs(world.given.t_ns - t_ns), np.iinfo(np.int64).max)
    k = int(late.argmin())
    return np.asarray(world.given.map_T_ego[k] @ inverse(world.refined.map_T_ego[k]))


def build_world(
    log: Log,
    scenario: Scenario,
    lidars: Collection[str],
    *,
    leave_out: Callable[[str, int], bool] = lambda *_: False,
    progress: Progress = lambda *_: None,
) -> World:
    """Build the world from the sweeps of a log, which has the poses of the scenario that was reconstructed from it.

    `leave_out`: whether sweep `i` of a LiDAR is left out, to be compared with. Raises `LogError` where no sweep can be used.
    """
    models: dict[str, Model] = {}
    scale, top, whole = np.nan, 0.0, False
    grids: DiskBackedMap[Tile | str, SurfelGrid] = DiskBackedMap(
        SurfelGrid.arrays, SurfelGrid, GRIDS_BYTES, changing=True, rounds=AROUND_SWEEPS
    )
    alignments = {agent.id: Alignment(agent) for agent in scenario.others}
    sightings: dict[str, list[Sighting]] = {id: [] for id in alignments}
    refined = refine_poses(log, every_sweep=True)
    surveyed = log if refined is None else log.changed(ego=refined)
    shift: Array | None = None
    done, gone, total = 0, 0, sum(len(log.streams[name].t_ns) for name in lidars)
    for name in lidars:
        pattern, noise, far = find_pattern(log, name), [], 1.0
        for i in range(len(log.streams[name].t_ns)):
            done += 1
            progress("build the world", done, total)
            shots = None if leave_out(name, i) else _readable(log, name, i)
            if shots is None:
                continue
            if shift is None:
                shift = np.rint(log.map_T_sensor(name, shots.t_ns[:1])[0][0, :3, 3])
            if name not in models:
                known = shots.intensity[np.isfinite(shots.intensity)]
                scale = float(known.mean()) if len(known) and known.mean() > 0 else np.nan
                top, whole = float(known.max(initial=0)), bool((known == np.rint(known)).all())
            far = max(far, float(shots.range_m.max()))
            noise.append(
                _add_sweep(log, surveyed, scenario, name, shots, pattern, scale, shift, grids, alignments, sightings)
            )
            grids.spill()
            models[name] = Model(pattern, 0.0, scale, top, whole, far)
            if done % SIGHTINGS_EVERY == 0:
                gone += thinned(sightings, MOST_SIGHTINGS_BYTES)
        if name in models:
            level = float(np.nanmedian(noise)) if np.isfinite(noise).any() else 0.0
            models[name] = replace(models[name], noise_m=level, max_range_m=far)
    if shift is None:
        raise LogError(
            f"log '{log.name}': no sweep of {', '.join(lidars)} can be used; there is nothing to simulate from"
        )
    surfaces = {id: a.centered(grids[id].surfels() if id in grids else no_surfels()) for id, a in alignments.items()}
    agents = {agent.id: completed(agent, surfaces[agent.id]) for agent in scenario.others}
    unseen = [id for id, surfels in surfaces.items() if not len(surfels)]
    notes = [f"no point of {', '.join(unseen)} was recorded: each is a body of its category"] if unseen else []
    if gone:
        kept = sum(len(some) for some in sightings.values())
        notes.append(f"of {gone + kept} sightings of people and riders {kept} are kept, by side, distance and time")
    standing = Tiles()
    for key in list(grids):
        if isinstance(key, tuple):
            standing.add(grids.pop(key).surfels())
    for agent in scenario.others:
        if agent.static:
            standing.add(ground_below(agent, standing, shift))
    given = log.ego if refined is not None else None
    world = World(shift, given, refined, standing, agents, sightings, alignments, models, tuple(notes))
    # Discs reach beyond edges as far as they are wide; what is left of them then has its share.
    world = _weighed(log, scenario, world, leave_out, progress)
    for _ in range(2):
        world = _weighed(log, scenario, _changed(world, _trimmed), leave_out, progress)
    return _changed(world, lambda surfels: surfels.take(surfels.share > MIN_SHARE))


def _changed(world: World, change: Callable[[Surfels], Surfels]) -> World:
    """Return a world with other surfels; those of the background are changed in place."""
    for tile in list(world.background):
        world.background[tile] = change(world.background[tile])
    return replace(world, agents={id: change(surfels) for id, surfels in world.agents.items()})


def ground_below(agent: Agent, standing: Tiles, shift_m: Array) -> Surfels:
    """Go on with the ground around an agent that stands, which hides what is below it; nothing where there is no ground."""
    w, half = agent.waypoints, np.array(agent.size_m) / 2
    x, y = w.x_m[0] - shift_m[0], w.y_m[0] - shift_m[1]
    background = joined(standing[t] for t in standing.near(x, y, float(np.hypot(*half[:2])) + 2 * AROUND_M))
    c, s = np.cos(w.yaw_rad[0]), np.sin(w.yaw_rad[0])
    offset = background.center_m - (np.array([w.x_m[0], w.y_m[0], w.z_m[0] - half[2]]) - shift_m)
    along, across = c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]
    near = (np.abs(along) < half[0] + AROUND_M) & (np.abs(across) < half[1] + AROUND_M)
    near &= (np.abs(offset[:, 2]) < MAX_STEP_M) & (background.normal[:, 2] > 0.95)
    if near.sum() < 20:
        return no_surfels()
    columns = np.column_stack([along[near], across[near], np.ones(near.sum())])
    plane = np.linalg.lstsq(columns, offset[near, 2], rcond=None)[0]
    steps = [np.arange(-h, h + GROUND_DISC_M, GROUND_DISC_M) for h in half[:2]]
    cells = np.stack(np.meshgrid(*steps), -1).reshape(-1, 2)
    cells = cells[np.isinf(cKDTree(columns[:, :2]).query(cells, distance_upper_bound=GROUND_DISC_M)[0])]
    x, y = c * cells[:, 0] - s * cells[:, 1], s * cells[:, 0] + c * cells[:, 1]
    place = background.center_m[near][0] - offset[near][0]
    normal = np.array([-c * plane[0] + s * plane[1], -s * plane[0] - c * plane[1], 1.0])
    one = np.ones(len(cells), np.float32)
    return Surfels(
        (np.column_stack([x, y, cells @ plane[:2] + plane[2]]) + place).astype(np.float32),
        np.tile(normal / np.linalg.norm(normal), (len(cells), 1)).astype(np.float32),
        one * GROUND_DISC_M, one * np.median(background.intensity[near]), one, one,
    )  # fmt: skip


def _trimmed(surfels: Surfels) -> Surfels:
    """Make discs as large as the part of them that rays end on, and leave out those that rays pass through."""
    return replace(surfels, radius_m=surfels.radius_m * np.sqrt(surfels.share)).take(surfels.share > MIN_SHARE)


def _readable(log: Log, name: str, i: int) -> Shots | None:
    """Return the returns of a sweep; None of one that cannot be read, is empty, or whose pose is not known."""
    try:
        shots = recorded_shots(log, name, RecordSource(log).require(name, i))
    except RecordError:
        return None
    if not len(shots.t_ns) or not log.map_T_sensor(name, shots.t_ns[[0, -1]])[1].all():
        return None
    return shots


def _add_sweep(
    log: Log,
    surveyed: Log,
    scenario: Scenario,
    name: str,
    shots: Shots,
    pattern: Pattern,
    scale: float,
    shift: Array,
    grids: MutableMapping[Tile | str, SurfelGrid],
    alignments: Mapping[str, Alignment],
    sightings: Mapping[str, list[Sighting]],
) -> float:
    """Share out the points of a sweep to the background and the agents; return the noise of its ranges, m."""
    surface = local_surface(shots, pattern)
    poses, moment, _ = poses_of(log, name, shots.t_ns)
    rotation = poses[moment, :3, :3]
    points = np.einsum("nij,nj->ni", rotation, shots.direction * shots.range_m[:, None]) + poses[moment, :3, 3]
    normal = np.einsum("nij,nj->ni", rotation, surface.normal)
    intensity = (shots.intensity / scale).astype(np.float32)
    free = ~_on_ego(log, name, shots, points)
    t_s = (shots.t_ns - scenario.t0_ns) / NS_PER_S
    middle_s, people = np.array([t_s.mean()]), list[tuple[Agent, NDArray[np.intp]]]()
    here, far = poses[0, :3, 3], float(shots.range_m.max())
    for agent in scenario.others:
        if not _is_near(agent, t_s[[0, -1]], here, far):
            continue
        half = np.array(agent.size_m) / 2
        x, y, _, _, speed = (v[0] for v in agent.trajectory.at(middle_s))
        reach = np.hypot(half[0], half[1]) + LEFT_OUT_M + 0.2 * abs(speed)
        near = np.flatnonzero((np.abs(points[:, 0] - x) < reach) & (np.abs(points[:, 1] - y) < reach))
        near = near[alive(agent, t_s[near])]
        if not len(near):
            continue
        at = agent.trajectory.at(t_s[near])
        c, s = np.cos(at.yaw_rad), np.sin(at.yaw_rad)

        def local(v: Array, c: Array = c, s: Array = s) -> Array:
            return np.column_stack([c * v[:, 0] + s * v[:, 1], c * v[:, 1] - s * v[:, 0], v[:, 2]])

        inside = local(points[near] - np.column_stack([at.x_m, at.y_m, at.z_m]))
        out = (inside[:, 2] > GROUND_M - half[2]) & (np.abs(inside) < half + LEFT_OUT_M).all(axis=1)
        rows, inside, axes = near[out], inside[out], local(normal[near])[out]
        on_agent = free[rows]
        free[rows] = False
        if on_agent.any() and not is_non_rigid(agent):
            inside, axes = alignments[agent.id].fit(float(t_s[rows].mean()), inside, axes, on_agent)
        own_half = half + TAKEN_M
        if GROUP_OF[agent.category] == "two_wheeler":
            own_half[0] = half[0] + LEFT_OUT_M  # wheels have few points, so that boxes end before them
        taken = on_agent & (np.abs(inside) < own_half).all(axis=1)
        rows = rows[taken]
        if len(rows):
            axes = axes[taken].astype(np.float32)
            grids.setdefault(agent.id, SurfelGrid()).add(inside[taken], axes, surface.radius_m[rows], intensity[rows])
            if is_non_rigid(agent):
                people.append((agent, rows))
    if people:
        _add_sightings(log, scenario, name, all_shots(shots, pattern), pattern, scale, people, sightings)
    poses, moment, _ = poses_of(surveyed, name, shots.t_ns[free])
    rotation = poses[moment, :3, :3]
    points = np.einsum("nij,nj->ni", rotation, shots.direction[free] * shots.range_m[free, None])
    points += poses[moment, :3, 3] - shift
    normal = np.einsum("nij,nj->ni", rotation, surface.normal[free])
    normal, radius, intensity = normal.astype(np.float32), surface.radius_m[free], intensity[free]
    for tile, rows in by_tile(points, GRID_TILE_M):
        grids.setdefault(tile, SurfelGrid()).add(points[rows], normal[rows], radius[rows], intensity[rows])
    return surface.noise_m


def _add_sightings(
    log: Log,
    scenario: Scenario,
    name: str,
    shots: Shots,
    pattern: Pattern,
    scale: float,
    people: list[tuple[Agent, NDArray[np.intp]]],
    sightings: Mapping[str, list[Sighting]],
) -> None:
    """Add what the rays of a sweep, those that did not come back included, met around agents, of which rows of `shots` are."""
    poses, moment, _ = poses_of(log, name, shots.t_ns)
    direction = np.einsum("nij,nj->ni", poses[moment, :3, :3], shots.direction)
    intensity = (shots.intensity / scale).astype(np.float32)
    lines = pattern.elevation_rad if len(pattern.elevation_rad) else np.arange(-1.5, 1.5, pattern.gap_rad)
    lines = np.concatenate([[2 * lines[0] - lines[1]], lines, [2 * lines[-1] - lines[-2]]])
    # How much the LiDAR is tilted there.
    raised = angles_of(direction)[1] - angles_of(shots.direction @ pattern.level_R_sensor.T)[1]
    for agent, rows in people:
        middle = rows[len(rows) // 2]
        t_s = (int(shots.t_ns[middle]) - scenario.t0_ns) / NS_PER_S
        agent_R_map, center = frame_at(agent, t_s)
        view = agent_R_map @ (poses[moment[middle], :3, 3] - center)
        on = np.zeros(len(shots.t_ns), dtype=bool)
        on[rows] = True
        half = np.array(agent.size_m) / 2
        seen = sighting(
            t_s, view, direction @ agent_R_map.T, range_m=shots.range_m, on=on, intensity=intensity, half_m=half,
            step_rad=pattern.step_rad, line_rad=lines + np.median(raised[rows]),
        )  # fmt: skip
        if seen is not None:
            sightings[agent.id].append(seen)


def _on_ego(log: Log, name: str, shots: Shots, points: Array) -> NDArray[np.bool_]:
    """Find points on the ego itself, which go with it."""
    if log.ego is None:
        return np.zeros(len(points), dtype=bool)
    near = np.flatnonzero(shots.range_m < 8.0) if log.lidars[name].mount == "ego" else np.arange(len(points))
    moments, index = np.unique(shots.t_ns[near] // 1_000_000, return_inverse=True)
    poses, valid = log.ego.at(moments * 1_000_000)
    local = np.einsum("nji,nj->ni", poses[index, :3, :3], points[near] - poses[index, :3, 3])
    half = np.array(log.ego_vehicle.size_m) / 2
    off = np.abs(local - [log.ego_vehicle.rear_axle_offset_m, 0.0, log.ground_z_ego_m + half[2]])
    on = valid[index] & (off[:, :2] < half[:2] + 0.1).all(axis=1)
    on &= local[:, 2] > log.ground_z_ego_m + GROUND_M
    out = np.zeros(len(points), dtype=bool)
    out[near[on]] = True
    return out


def completed(agent: Agent, seen: Surfels) -> Surfels:
    """Mirror what was seen of an agent about its middle plane, and put a body where it was seen from neither side."""
    whole = seen
    flip = np.array([1, -1, 1], np.float32)
    mirrored = replace(seen, center_m=seen.center_m * flip, normal=seen.normal * flip)
    for more in (mirrored, body_of(agent)):
        if len(whole):
            far = np.isinf(cKDTree(whole.center_m).query(more.center_m, distance_upper_bound=COVERED_M)[0])
            more = more.take(far)
        whole = joined([whole, replace(more, share=np.full(len(more), PRIOR_UNSEEN, np.float32))])
    return whole


def _weighed(
    log: Log, scenario: Scenario, world: World, leave_out: Callable[[str, int], bool], progress: Progress
) -> World:
    """Count which rays end on each disc, pass through it or do not come back; leave out what is not there."""
    # Of each tile and agent, by disc: the rays that end on it, pass through it and do not come back.
    counts: DiskBackedMap[Tile | str, Array] = DiskBackedMap(lambda a: [a], np.array, COUNTS_BYTES, changing=True)
    # Whole agents: what `place` takes of them depends on the time.
    numbered = {k: replace(a, returned=np.arange(len(a), dtype=np.float32)) for k, a in world.agents.items()}
    for name, model in world.models.items():
        usable = [i for i in range(len(log.streams[name].t_ns)) if not leave_out(name, i)]
        poses, known = log.map_T_sensor(name, log.streams[name].t_ns[usable])
        way_m = float(np.linalg.norm(np.diff(poses[known, :3, 3], axis=0), axis=1).sum())
        many = round(CHECKED_SWEEPS * max(1.0, way_m / CHECKED_WAY_M))
        chosen = [usable[k] for k in np.unique(np.linspace(0, len(usable) - 1, many).astype(int))]
        for done, i in enumerate(chosen):
            progress(f"rays of {name} through the world", done + 1, len(chosen))
            shots = _readable(log, name, i)
            if shots is None:
                continue
            shots = all_shots(shots, model.pattern)
            poses, moment, _ = poses_of(log, name, shots.t_ns)
            rays = rays_in_map(shots, poses, moment)
            placed = place(world, scenario, rays, numbered, model.max_range_m)
            hit, passed, lost = found = np.zeros((3, len(placed.surfels)))
            nothing, nearest = np.isnan(shots.range_m), np.full(len(shots.t_ns), np.inf)
            lone = []
            for met in meetings(rays, grid_of(rays), placed.surfels):
                surfel, weight = met.surfel.astype(np.int64), met.weight.astype(np.float64)
                behind = (shots.range_m.take(met.ray) - met.range_m) * met.facing
                for of, where in ((hit, np.abs(behind) < SAME_SURFACE_M), (passed, behind > SAME_SURFACE_M)):
                    rows = np.flatnonzero(where)
                    np.add.at(of, surfel.take(rows), weight.take(rows))
                # Of a ray that did not come back, the first disc; of one that did, that on which it ended.
                rows = np.flatnonzero(nothing.take(met.ray))
                lone.append((met.ray.take(rows), met.range_m.take(rows), surfel.take(rows), weight.take(rows)))
                np.minimum.at(nearest, lone[-1][0], lone[-1][1].astype(np.float64))
            for ray, range_m, surfel, weight in lone:
                rows = np.flatnonzero(range_m == nearest.take(ray))
                np.add.at(lost, surfel.take(rows), weight.take(rows))
            end = 0
            for tile in placed.tiles:
                begin, end = end, end + len(world.background[tile])
                counts[tile] = counts.get(tile, 0) + found[:, begin:end]
            for id, begin, end in zip(placed.ids, placed.first[1:], placed.first[2:]):
                counts[id] = counts.get(id, np.zeros((3, len(numbered[id]))))
                counts[id][:, placed.surfels.returned[begin:end].astype(np.int64)] += found[:, begin:end]

    def judged(surfels: Surfels, key: Tile | str) -> Surfels:
        hit, passed, lost = counts.get(key, np.zeros((3, len(surfels))))
        prior = PRIOR_RAYS * surfels.share
        share, returned = (hit + prior) / (hit + passed + prior), (hit + PRIOR_RAYS) / (hit + lost + PRIOR_RAYS)
        return replace(surfels, share=share.astype(np.float32), returned=returned.astype(np.float32))

    for tile in list(world.background):
        world.background[tile] = judged(world.background[tile], tile)
    return replace(world, agents={id: judged(surfels, id) for id, surfels in world.agents.items()})


def mesh_of(agent: Agent) -> shapes.Mesh:
    """Return the body of an agent's category and size in its frame, with the shapes of `synth`."""
    size = (float(agent.size_m[0]), float(agent.size_m[1]), float(agent.size_m[2]))
    makers = {
        "car": lambda: shapes.car(size, "hatch"),
        "truck": lambda: shapes.truck(size),
        "bus": lambda: shapes.bus(size),
        "pedestrian": lambda: shapes.pedestrian(size, 0, bool(agent.static)),
    }
    return makers.get(agent.category, lambda: shapes.cyclist(size, 0))().fitted(size)


def body_of(agent: Agent) -> Surfels:
    """Return discs on the body of an agent, as far apart as they are wide."""
    mesh = mesh_of(agent)
    corner = mesh.vertices_m[mesh.faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    solid = area > 1e-8
    corner, normal, area = corner[solid], cross[solid] / (2 * area[solid, None]), area[solid]
    # As many points on a triangle as its area takes, spread by a low-discrepancy sequence of the whole body.
    total = np.cumsum(area) / BODY_DISC_M**2
    count = np.diff(np.floor(total), prepend=0).astype(np.int64)
    face = np.repeat(np.arange(len(corner)), count)
    n = np.arange(len(face)) + 1
    u, v = (n * 0.7548776662466927) % 1, (n * 0.5698402909980532) % 1  # Roberts' R2
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    a, b, c = corner[face].transpose(1, 0, 2)
    one = np.ones(len(face), np.float32)
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return Surfels(points.astype(np.float32), normal[face].astype(np.float32), one * BODY_DISC_M, one, one, one)
