"""People and riders as a sweep saw them: limbs move, so that points of their whole life together make a body without legs.

A sighting is what the rays around an agent met, in its own frame. Rays that are cast near it end where their neighbors in the
picture of the sighting did, so that outlines are neither wider nor smoother than recorded. For bodies that do not change
their shape, surfels show more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.datatypes import GROUP_OF, Agent, Scenario
from log2sim.geometry import NS_PER_S, Array
from log2sim.resim.caster import Meetings
from log2sim.resim.rays import Floats, Rays
from log2sim.resim.surfels import Material

# Turned by 20 degrees a person shows a third of a width that was hidden. From 1.5 times as far the gaps are half as wide again.
MIN_TURN_COS, MAX_FARTHER = np.cos(np.deg2rad(20.0)), 1.5
AROUND_M = 0.35  # around the box, rays that passed the agent tell its outline
OUTLINE_CELLS = 3.0  # twice as many as rays are apart in a sighting from that far
PASSED, ENDED, HIDDEN, LOST = range(4)


@dataclass(frozen=True, eq=False)
class Sighting:
    """What rays around an agent met in one sweep."""

    t_s: float  # time of the scenario
    view_m: Array  # (3,) the sensor in the frame of the agent
    # (N, 3) in the frame of the agent: where rays ended on it; of others a point as far away as its middle
    point_m: Floats
    # (N,) whether the ray passed the agent, ended on it, was stopped before, or was lost where its neighbors ended on it
    state: NDArray[np.int8]
    intensity: Floats  # (N,) relative; NaN where unknown
    step_rad: float  # of azimuth, between rays
    # (L,) elevations of the lines of the LiDAR, increasing, which may be closer to each other where it looks far
    line_rad: Array

    @property
    def size(self) -> int:
        """Return the bytes that it takes."""
        return self.point_m.nbytes + self.state.nbytes + self.intensity.nbytes + self.line_rad.nbytes

    def angles(self, offset: Array | Floats) -> Array:
        """Return azimuth and elevation (N, 2) of vectors (N, 3) from a sensor, in steps between rays."""
        middle = np.arctan2(-self.view_m[1], -self.view_m[0])
        c, s = np.cos(middle), np.sin(middle)
        ahead, left = c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]
        elevation = np.arctan2(offset[:, 2], np.hypot(ahead, left))
        row = np.interp(elevation, self.line_rad, np.arange(len(self.line_rad)))
        return np.column_stack([np.arctan2(left, ahead) / self.step_rad, row])


def is_non_rigid(agent: Agent) -> bool:
    """Tell whether an agent changes its shape."""
    return GROUP_OF[agent.category] in ("pedestrian", "two_wheeler")


def sighting(
    t_s: float, view_m: Array, offset: Array, *, range_m: Floats, on: NDArray[np.bool_], intensity: Floats,
    half_m: Array, step_rad: float, line_rad: Array,
) -> Sighting | None:  # fmt: skip
    """Take what rays around an agent met; None where none ended on it.

    `view_m` (3,): the sensor in the frame of the agent. `offset` (N, 3): unit vectors of rays from there. `range_m` (N,): NaN
    where nothing came back. `on` (N,): whether the ray ended on the agent. `half_m` (3,): of its size. `step_rad`,
    `line_rad`: as of `Sighting`, with a line beyond each end.
    """
    away = float(np.linalg.norm(view_m))
    near = np.flatnonzero(on | (np.abs(view_m + away * offset) < half_m + AROUND_M).all(axis=1))
    range_m, on = range_m[near], on[near]
    back = np.isfinite(range_m)
    if not on.any():
        return None
    state = np.where(on, ENDED, np.where(range_m < away - np.hypot(*half_m[:2]), HIDDEN, PASSED)).astype(np.int8)
    length = np.where(on, range_m, away)[:, None]
    point = (view_m + length * offset[near]).astype(np.float32)
    seen = Sighting(t_s, view_m, point, state, intensity[near], step_rad, line_rad)
    at = seen.angles(offset[near])
    if not back.all():
        neighbor = cKDTree(at[back]).query(at[~back])[1]
        state[~back] = np.where(on[back][neighbor], LOST, PASSED)
    # Beyond the next rays, no outline is told.
    beside = np.isfinite(cKDTree(at[on]).query(at, distance_upper_bound=OUTLINE_CELLS)[0]) | (state == HIDDEN)
    return replace(seen, point_m=point[beside], state=state[beside], intensity=intensity[near][beside])


def frame_at(agent: Agent, t_s: float) -> tuple[Array, Array]:
    """Return the rotation from the map to an agent's frame (3, 3) and its middle (3,), m, in the map."""
    at = agent.trajectory.at(np.array([t_s]))
    c, s = np.cos(at.yaw_rad[0]), np.sin(at.yaw_rad[0])
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]), np.array([at.x_m[0], at.y_m[0], at.z_m[0]])


def choose_sighting(sightings: Sequence[Sighting], t_s: float, view_m: Array) -> Sighting | None:
    """Choose the one nearest in time of those that looked from a like side and not from much farther away."""
    away = float(np.linalg.norm(view_m))
    alike = []
    for s in sightings:
        other = float(np.linalg.norm(s.view_m))
        if other < MAX_FARTHER * away and s.view_m @ view_m > MIN_TURN_COS * away * other:
            alike.append(s)
    return min(alike, key=lambda s: abs(s.t_s - t_s), default=None)


def thinned(of: Mapping[str, list[Sighting]], most_bytes: int) -> int:
    """Halve the sightings of those who have most, in place, until all of them take half of so many bytes; return how many go.

    Nothing goes while they take less. Of each, those stay that differ most from each other: by side, by distance, and, as
    limbs move, by time, of which the whole life counts as much as a side that is no longer alike (farthest-point sampling,
    Gonzalez 1985). Its first and its only sighting stay.
    """
    size = {id: sum(s.size for s in some) for id, some in of.items()}
    gone, left = 0, sum(size.values())
    while left > most_bytes / 2 and (gone or left > most_bytes):
        id = max(size, key=lambda i: size[i] if len(of[i]) > 1 else 0)
        some = of[id]
        if len(some) < 2:
            break
        away = np.linalg.norm([s.view_m for s in some], axis=1)
        t_s = np.array([s.t_s for s in some])
        side = np.array([s.view_m for s in some]) / away[:, None] / np.sqrt(2 - 2 * MIN_TURN_COS)
        far = np.log(away) / np.log(MAX_FARTHER)
        place = np.column_stack([side, far, (t_s - t_s[0]) / max(float(np.ptp(t_s)), 1e-9)])
        kept, apart = [0], np.linalg.norm(place - place[0], axis=1)
        while len(kept) < (len(some) + 1) // 2:
            kept.append(int(apart.argmax()))
            apart = np.minimum(apart, np.linalg.norm(place - place[kept[-1]], axis=1))
            apart[kept] = -1  # of two that are alike in all either may stay, once
        gone += len(some) - len(kept)
        some[:] = [some[k] for k in sorted(kept)]
        left -= size[id]
        size[id] = sum(s.size for s in some)
        left += size[id]
    return gone


def with_sightings(
    parts: Sequence[Meetings], material: Material, *, first: NDArray[np.int64], ids: Sequence[str], rays: Rays,
    scenario: Scenario, sightings: Mapping[str, Sequence[Sighting]],
) -> tuple[list[Meetings], Material]:  # fmt: skip
    """Let rays end on people and riders as in their sightings; where those were hidden, on their discs.

    `first` (A + 2,) are the first discs of the background and of the agents `ids`, and the end. After the discs comes one that
    stops nothing, for the rays that would meet those of a body, then one for each ray that ends on a sighting.
    """
    passed, total = len(material), len(material) + 1
    parts, discs = list(parts), [material, Material(*(np.zeros(1, np.float32) for _ in range(3)))]
    # By disc whether its agent is seen as in a sighting, and by agent the rays that end on its discs nevertheless.
    seen, behind = np.zeros(passed + 1, bool), dict[int, NDArray[np.bool_]]()
    t_s = (rays.bin_ns - scenario.t0_ns) / NS_PER_S
    for k, id in enumerate(ids):
        some = sightings.get(id, ())
        if not some:
            continue
        agent = scenario[id]

        def center_at(bins: NDArray[np.int64], agent: Agent = agent) -> Array:
            return (frame_at(agent, float(t_s[bins[0]]))[1] - rays.shift_m)[:, None]

        bin = int(rays.bins_toward(1, center_at)[0])
        agent_R_map, center = frame_at(agent, float(t_s[bin]))
        center -= rays.shift_m
        sensor = -rays.bin_T_map[bin, :3, :3].T @ rays.bin_T_map[bin, :3, 3]
        view = agent_R_map @ (sensor - center)
        away, reach = float(np.linalg.norm(view)), float(np.linalg.norm(np.array(agent.size_m) / 2 + AROUND_M))
        chosen = choose_sighting(some, float(t_s[bin]), view)
        if chosen is None or away < 2 * reach:
            continue
        toward = ((center - sensor) / away).astype(np.float32)
        ray = np.flatnonzero(rays.direction @ toward > np.sqrt(1 - (reach / away) ** 2))
        # In the picture from here; rays that nothing was sent beside of passed.
        offset = chosen.point_m - view
        scale = max(1.0, float(np.linalg.norm(chosen.view_m)) / away)
        distance, near = cKDTree(chosen.angles(offset)).query(
            chosen.angles(rays.direction[ray] @ agent_R_map.T.astype(np.float32)), distance_upper_bound=scale
        )
        state = np.append(chosen.state, np.int8(PASSED))[near]
        seen[first[k + 1] : first[k + 2]] = True
        if (state == HIDDEN).any():
            behind[k] = np.zeros(len(rays.direction), bool)
            behind[k][ray[state == HIDDEN]] = True
        stops = (state == ENDED) | (state == LOST)
        ray, near = ray[stops], near[stops]
        one = np.ones(len(ray), np.float32)
        distance = np.linalg.norm(offset[near], axis=1).astype(np.float32)
        parts.append(Meetings(ray, np.arange(total, total + len(ray), dtype=np.int32), distance, one, one))
        total += len(ray)
        discs.append(Material(chosen.intensity[near], one, (chosen.state[near] == ENDED).astype(np.float32)))
    for met in parts if seen.any() else []:
        rows = np.flatnonzero(seen.take(met.surfel, mode="clip"))
        if not len(rows):
            continue
        ray, surfel = met.ray.take(rows), met.surfel.take(rows)
        stays = np.zeros(len(rows), bool)
        for k, hidden in behind.items():
            stays |= (surfel >= first[k + 1]) & (surfel < first[k + 2]) & hidden.take(ray)
        met.surfel[rows[~stays]] = passed
    return parts, Material.join(discs)
