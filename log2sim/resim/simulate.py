"""Sweeps and pictures of the recorded world: where the ego of a scenario drives, among its agents; and a log of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.datatypes import EGO, Labels, Log, Scenario, Stream, Sweep, Waypoints
from log2sim.errors import ConfigError, LogError
from log2sim.files.outputs import replaced_folder
from log2sim.geometry import NS_PER_S, PoseTrack, nearest_index, rotation_from_rpy, wrap_angle, yaw_of
from log2sim.perception.records import RecordSource
from log2sim.resim.cameras import Image, Pictures
from log2sim.resim.caster import first_hits, grid_of, meetings
from log2sim.resim.rays import Shots, all_shots, poses_of, rays_in_map, recorded_shots
from log2sim.resim.sightings import with_sightings
from log2sim.resim.surfels import Surfels
from log2sim.resim.world import Progress, World, body_of, build_world, place
from log2sim.simulation.policy import Controls, Observation, Policy, reset_policy

TRUTH_FILE = "truth.json"
# An ego that stays this close to its recorded path is where it was: its poses are kept, with all their digits.
SAME_PATH_M, SAME_YAW_RAD = 0.02, np.deg2rad(0.2)
# Farther off its recorded path the ego sees mostly what nothing was recorded of.
MAX_OFF_PATH_M = 6.0
# At 3 m beside it pictures of `samples/crossing.toml` have lost 8 dB of those at half a meter, and 13 % of them is made up.
MAX_PICTURES_OFF_M = 3.0
# What no recorded picture shows is then as much as at 3 m beside the path.
TOLD_SHARE = 0.13
# Folder of a log: by camera a mask for each picture, white where no recorded picture shows what is there.
MASKS = "masks"
Masks = dict[str, tuple[bytes, float]]  # by name of its file, such a mask as PNG, and the share of it that is white


@dataclass(eq=False)
class Simulation:
    """The sensors of a log in a scenario."""

    log: Log  # recorded, with the poses of the scenario
    world: World
    scenario: Scenario  # what happens now
    seed: int = 0
    pictures: Pictures | None = None  # what pictures are made of; None where no camera is simulated
    sensors: tuple[str, ...] = ()  # those that are simulated; all where it is empty
    driven: Log = field(init=False)  # the same log with the ego's poses in the scenario
    agents: dict[str, Surfels] = field(init=False)  # by id: those of the world, bodies for those that were not recorded

    def __post_init__(self) -> None:
        """Make bodies, and find the path of the ego."""
        self.agents = {a.id: self.world.agents.get(a.id) or body_of(a) for a in self.scenario.others}
        self.driven = self.log.changed(ego=ego_poses(self.log, self.scenario))
        self.sensors = self.sensors or (*self.world.models, *(self.log.cameras if self.pictures else ()))

    def shots(self, name: str, i: int) -> Shots:
        """Return the rays of sweep `i` as they were sent."""
        recorded = recorded_shots(self.log, name, RecordSource(self.log).require(name, i))
        return all_shots(recorded, self.world.models[name].pattern)

    def sweep(self, name: str, i: int) -> Sweep:
        """Simulate sweep `i` of a LiDAR; every point is in the frame of the LiDAR at its own time."""
        stamp = int(self.log.streams[name].t_ns[i])
        return self.cast(name, self.shots(name, i), self.driven, stamp, np.random.default_rng([self.seed, i]))[0]

    def picture(self, name: str, t_ns: int) -> tuple[Image, NDArray[np.bool_]]:
        """Make the picture of a camera at a stamp, (H, W, 3) BGR, and the mask (H, W) of pixels that no recorded picture shows.

        Raises `ConfigError` where no camera is simulated, and where the ego is too far off the path that it recorded.
        """
        if self.pictures is None:
            raise ConfigError(f"image '{name}': no camera is simulated; simulate with its name in `sensors`")
        ego = None if self.driven.ego is None else self.driven.ego.at([t_ns])[0]
        if self.log.cameras[name].mount == "ego" and ego is not None:
            refuse_far(off_path_m(self.log, PoseTrack(np.array([t_ns]), ego)))
        return self.pictures.make(self.driven, self.scenario, self.agents, name, t_ns)

    def cast(
        self, name: str, shots: Shots, driven: Log, stamp_ns: int, rng: np.random.Generator
    ) -> tuple[Sweep, NDArray[np.int64]]:
        """Cast rays that leave the LiDAR where it is in a log; return the sweep and which of the rays its points are of."""
        model = self.world.models[name]
        poses, moment, valid = poses_of(driven, name, shots.t_ns)
        known = valid[moment]
        if not known.all():
            shots, moment = shots.take(known), moment[known]
        if not len(shots.t_ns):
            nothing = np.zeros((0, 3), np.float32)
            return Sweep(stamp_ns, nothing, t_ns=np.zeros(0, np.int64)), np.zeros(0, np.int64)
        rays = rays_in_map(shots, poses, moment)
        placed = place(self.world, self.scenario, rays, self.agents, model.max_range_m)
        parts = meetings(rays, grid_of(rays), placed.surfels)
        parts, material = with_sightings(
            parts,
            placed.surfels.material,
            first=placed.first,
            ids=placed.ids,
            rays=rays,
            scenario=self.scenario,
            sightings=self.world.sightings,
        )
        hits = first_hits(parts, material, len(shots.t_ns), rng)
        back = rng.random(len(shots.t_ns), dtype=np.float32) < hits.returned
        back &= hits.range_m < model.max_range_m
        # Ranges of sightings have their noise.
        noise_m = np.where(hits.surfel[back] < len(placed.surfels), np.float32(model.noise_m), np.float32(0))
        distance = hits.range_m[back] + noise_m * rng.standard_normal(int(back.sum()), dtype=np.float32)
        intensity = None
        if np.isfinite(model.intensity):
            intensity = np.clip(hits.intensity[back] * model.intensity, 0, model.max_intensity).astype(np.float32)
            intensity = np.rint(intensity) if model.whole else intensity
        sweep = Sweep(
            stamp_ns, shots.direction[back] * distance[:, None], "lidar", shots.t_ns[back], intensity=intensity
        )
        return sweep, np.flatnonzero(known)[back]


def with_sensors(policy: Policy, simulation: Simulation) -> Policy:
    """Return a policy of the ego that also sees: its observations have `sweep(name)` and `image(name)`, from where it drives now.

    Whoever steps a world by `open_world` gets such observations from `seeing`.
    """
    return _SeeingPolicy(policy, simulation)


def seeing(observation: Observation, simulation: Simulation) -> Observation:
    """Return an observation that also sees, as of `with_sensors`; a sweep is cast, a picture made, when it is asked for."""
    return replace(observation, look=partial(_look, simulation))


@dataclass(frozen=True, eq=False)
class _SeeingPolicy:
    inner: Policy
    simulation: Simulation

    def reset(self, scenario: Scenario) -> None:
        reset_policy(self.inner, scenario)

    def __call__(self, observation: Observation) -> Controls:
        return self.inner(seeing(observation, self.simulation))


def _look(simulation: Simulation, observation: Observation, kind: Literal["sweep", "image"], name: str) -> Any:
    """Look through a sensor, by the speeds of now where that takes time; a LiDAR sends the rays of the recorded sweep nearest in time."""
    log, source = simulation.log, simulation.scenario
    usable = [n for n in simulation.sensors if n in (log.lidars if kind == "sweep" else log.cameras)]
    if name not in usable:
        raise ConfigError(f"{kind} '{name}': no such sensor; simulated are {', '.join(usable) or 'none'}")
    now_ns = source.t0_ns + round(observation.t_s * NS_PER_S)

    def steady(x: float, y: float, z: float, yaw: float, vx: float, vy: float, speed: float) -> Waypoints:
        later_s, one = np.array([-1.0, 1.0]), np.ones(2)
        t_s, x_m, y_m = observation.t_s + later_s, x + vx * later_s, y + vy * later_s
        return Waypoints(t_s, x_m, y_m, z * one, yaw * one, speed * one, observed=one > 0, sigma_xy_m=0 * one)

    o, ego = observation.others, observation.ego
    columns = (o.x_m, o.y_m, o.z_m, o.yaw_rad, o.velocity_x_mps, o.velocity_y_mps, o.speed_mps)
    moving = {str(id): steady(*(float(c[k]) for c in columns)) for k, id in enumerate(o.id)}
    heading = ego.speed_mps * np.cos(ego.yaw_rad), ego.speed_mps * np.sin(ego.yaw_rad)
    moving[EGO] = steady(ego.x_m, ego.y_m, ego.z_m, ego.yaw_rad, *heading, ego.speed_mps)
    agents = tuple(replace(a, waypoints=moving[a.id], static=False) for a in source.agents if a.id in moving)
    present = replace(simulation, scenario=replace(source, agents=agents))
    if kind == "image":
        return present.picture(name, now_ns)[0]
    shots = simulation.shots(name, int(nearest_index(log.streams[name].t_ns, [now_ns])[0]))
    shots = replace(shots, t_ns=shots.t_ns + (now_ns - int(shots.t_ns.max())))
    return present.cast(name, shots, present.driven, now_ns, np.random.default_rng([simulation.seed, now_ns]))[0]


def ego_poses(log: Log, scenario: Scenario) -> PoseTrack | None:
    """Return where the ego drives: the recorded pose nearest to each place, moved there; those of the log where it stays.

    Height, pitch and roll are those of the road, so they are taken from where the ego was nearest.
    """
    if log.ego is None or scenario.ego is None:
        return log.ego
    ego, t_s = scenario.ego, (log.ego.t_ns - scenario.t0_ns) / NS_PER_S
    w = ego.waypoints
    there = (t_s >= w.t_s[0] - 0.2) & (t_s <= w.t_s[-1] + 0.2)
    if not there.any():
        raise ConfigError(f"scenario '{scenario.name}': its ego is not there during the log; nothing can be simulated")
    states = ego.trajectory.at(t_s)
    center, yaw = log.ego_centers(log.ego.map_T_ego), yaw_of(log.ego.map_T_ego[:, :3, :3])
    off = np.hypot(states.x_m - center[:, 0], states.y_m - center[:, 1])
    if off[there].max() < SAME_PATH_M and np.abs(wrap_angle(states.yaw_rad - yaw))[there].max() < SAME_YAW_RAD:
        return log.ego
    new = np.column_stack([states.x_m, states.y_m])[there]
    near = cKDTree(center[:, :2]).query(new)[1]
    turn = rotation_from_rpy(0.0, 0.0, wrap_angle(states.yaw_rad[there] - yaw[near]))
    poses = log.ego.map_T_ego[near].copy()
    poses[:, :3, 3] -= center[near]
    poses[:, :3, :] = turn @ poses[:, :3, :]
    poses[:, :3, 3] += np.column_stack([new, center[near, 2]])
    return PoseTrack(log.ego.t_ns[there], poses, log.ego.max_gap_s)


def off_path_m(log: Log, driven: PoseTrack | None) -> tuple[float, float]:
    """Return how far the ego goes off the path that it recorded, m, and when, s after the first pose."""
    if log.ego is None or driven is None:
        return 0.0, 0.0
    distance = cKDTree(log.ego.map_T_ego[:, :2, 3]).query(driven.map_T_ego[:, :2, 3])[0]
    worst = int(distance.argmax())
    return float(distance[worst]), float((driven.t_ns[worst] - log.ego.t_ns[0]) / NS_PER_S)


def refuse_far(off_m: tuple[float, float]) -> None:
    """Raise `ConfigError` where pictures would be too wrong, m off the path and when."""
    if off_m[0] > MAX_PICTURES_OFF_M:
        raise ConfigError(
            f"at {off_m[1]:.1f} s the ego is {off_m[0]:.1f} m off the path that it recorded; pictures are made up to "
            f"{MAX_PICTURES_OFF_M:g} m beside it: leave out the cameras"
        )


def simulated_log(simulation: Simulation, *, notes: Collection[str] = (), masks: Masks | None = None) -> Log:
    """Return the log that the sensors would have recorded; its records are made when they are read.

    `masks` takes those of the pictures that are read.
    """
    log, driven = simulation.log, simulation.driven
    streams = {}
    for name in simulation.sensors:
        t_ns = log.streams[name].t_ns
        known = np.flatnonzero(driven.map_T_sensor(name, t_ns)[1])
        streams[name] = Stream(name, t_ns[known], partial(_read, simulation, name, known, masks))
    cameras = {name: log.cameras[name] for name in simulation.sensors if name in log.cameras}
    return Log(
        name=f"{log.name}, simulated", format="simulated", cameras=cameras,
        lidars={name: log.lidars[name] for name in simulation.sensors if name in log.lidars}, streams=streams,
        ego=driven.ego, ego_vehicle=log.ego_vehicle, map=log.map,
        labels=labels_of(simulation.scenario, streams[simulation.sensors[0]].t_ns), ground_z_ego_m=log.ground_z_ego_m,
        reference_camera=log.reference_camera if log.reference_camera in cameras else None, digest=log.digest,
        notes=(f"simulated from log '{log.name}', seed {simulation.seed}", *simulation.world.notes, *notes),
    )  # fmt: skip


def _read(simulation: Simulation, name: str, known: NDArray[np.intp], masks: Masks | None, i: int) -> Sweep | Image:
    if name in simulation.log.lidars:
        return simulation.sweep(name, int(known[i]))
    image, unknown = simulation.picture(name, int(simulation.log.streams[name].t_ns[known[i]]))
    if masks is not None:
        png = cv2.imencode(".png", unknown.astype(np.uint8) * 255)[1].tobytes()
        masks[f"{name}/{i:06d}.png"] = png, float(unknown.mean())
    return image


def labels_of(scenario: Scenario, t_ns: NDArray[np.int64]) -> Labels:
    """Return the boxes of all agents but the ego at the stamps of sweeps."""
    t_s = (t_ns - scenario.t0_ns) / NS_PER_S
    rows: list[tuple[Any, ...]] = []
    for agent in scenario.others:
        w = agent.waypoints
        there = np.full(len(t_s), agent.is_permanent) | ((t_s >= w.t_s[0]) & (t_s <= w.t_s[-1]))
        at = agent.trajectory.at(t_s)
        rows += [
            (t_ns[k], agent.id, agent.category, (at.x_m[k], at.y_m[k], at.z_m[k]), agent.size_m, at.yaw_rad[k])
            for k in np.flatnonzero(there)
        ]
    rows.sort(key=lambda row: int(row[0]))
    columns = list(zip(*rows)) if rows else [()] * 6
    return Labels(
        np.array(columns[0], np.int64), np.array(columns[1], str), np.array(columns[2], str),
        np.array(columns[3], float).reshape(-1, 3), np.array(columns[4], float).reshape(-1, 3),
        np.array(columns[5], float), labeled_ns=t_ns,
    )  # fmt: skip


def resimulate(
    log: Log,
    source: Scenario,
    scenario: Scenario,
    out: Path | str,
    *,
    sensors: Collection[str] = (),
    cameras: bool = False,
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress = lambda *_: None,
    then: Callable[[Simulation], None] = lambda _: None,
) -> tuple[str, ...]:
    """Write what the sensors of a log would have recorded in a scenario as a native log folder with `truth.json`.

    Parameters
    ----------
    log : Log
        With the poses of `source`.
    source : Scenario
        Reconstructed from the log.
    scenario : Scenario
        What happens now: an edit or a replay of `source`, or itself.
    sensors : collection of str
        LiDARs and cameras; all LiDARs of the log where it is empty.
    cameras : bool
        All cameras of the log, too.
    then : callable
        Called with the simulation once its log is there, as for a film of it.

    Returns
    -------
    notes : tuple of str
        What the simulation does not know, for people.

    Raises
    ------
    ConfigError
        For an unknown sensor, when the ego drives too far off its recorded path for pictures, and when the folder may not be replaced.
    LogError
        For a log without LiDAR, and one of which no sweep can be read.
    """
    from log2sim.logs.native.writer import refuse_target, write_log

    refuse_target(Path(out), overwrite=overwrite)
    if cameras or any(name in log.cameras for name in sensors):
        refuse_far(off_path_m(log, ego_poses(log, scenario)))
    simulation = simulate(log, source, scenario, sensors=sensors, cameras=cameras, seed=seed, progress=progress)
    off_m, when_s = off_path_m(log, simulation.driven.ego)
    notes, of = list(simulation.world.notes), source.provenance.get("log")
    if isinstance(of, Mapping) and of.get("digest", log.digest) != log.digest:
        notes.append(
            f"scenario '{source.name}' was reconstructed from log '{of.get('name')}', whose data are not those of '{log.name}': "
            "where poses or agents differ, surfaces are wrong"
        )
    if source.provenance.get("edits"):
        notes.append(
            f"scenario '{source.name}' was edited, and where it removed or moved somebody the world shows who was recorded there; "
            "take the scenario before, and the edited one as what happens now (--replay)"
        )
    if off_m > MAX_OFF_PATH_M:
        notes.append(
            f"at {when_s:.1f} s the ego is {off_m:.1f} m from where anything was recorded; sweeps lack what was hidden"
        )
    masks: Masks = {}
    shares: dict[str, list[float]] = {}
    result = simulated_log(simulation, notes=notes[len(simulation.world.notes) :], masks=masks)
    with replaced_folder(Path(out), overwrite=overwrite) as folder:
        write_log(result, folder, progress=partial(progress, "simulate"))
        scenario.save(folder / TRUTH_FILE)
        for file, (data, share) in masks.items():
            (folder / MASKS / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / MASKS / file).write_bytes(data)
            shares.setdefault(file.rsplit("/", 1)[0], []).append(share)
    for name, made_up in shares.items():
        if max(made_up) > TOLD_SHARE:
            notes.append(
                f"no recorded picture shows {np.mean(made_up):.0%} of what {name} sees, of one picture {max(made_up):.0%}: "
                f"it is drawn or filled in, see {MASKS}/{name}"
            )
    then(simulation)
    return tuple(notes)


def simulate(
    log: Log,
    source: Scenario,
    scenario: Scenario,
    *,
    sensors: Collection[str] = (),
    cameras: bool = False,
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> Simulation:
    """Build the world of a log and return its sensors in a scenario; parameters and errors as of `resimulate`."""
    if not log.lidars:
        raise LogError(f"log '{log.name}': has no LiDAR, which tells how far away things are; nothing can be simulated")
    for name in sensors:
        if name not in log.lidars and name not in log.cameras:
            raise ConfigError(
                f"sensor '{name}' is not in the log; its LiDARs: {', '.join(log.lidars)}; its cameras: {', '.join(log.cameras) or 'none'}"
            )
    lidars = [name for name in log.lidars if not sensors or name in sensors]
    filmed = [name for name in log.cameras if cameras or name in sensors]
    if log.ego is None and any((log.cameras.get(n) or log.lidars[n]).mount == "ego" for n in [*lidars, *filmed]):
        raise LogError(f"log '{log.name}': has no poses of the ego; reconstruct with poses from its LiDAR first")
    ego_poses(log, scenario)  # an error, where the ego is not there, comes before the long work
    world = build_world(log, source, lidars or list(log.lidars), progress=progress)
    return Simulation(log, world, scenario, seed, Pictures(log, world, source) if filmed else None, (*lidars, *filmed))
