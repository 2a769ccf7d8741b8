"""A gymnasium environment in which an agent drives the ego of a scenario (extra `gym`).

import gymnasium, log2sim.simulation.env
env = gymnasium.make("log2sim/Scenario-v0", scenario="scenario.json")
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.errors import MissingExtra
from log2sim.geometry import Array, box_corners_bev, rectangles_overlap, wrap_angle
from log2sim.simulation.policy import Controls, EgoState, Observation
from log2sim.simulation.runner import open_world

try:
    import gymnasium
    from gymnasium.spaces import Box, Dict
except ImportError as error:
    raise MissingExtra("log2sim.simulation.env", "gym") from error

ID = "log2sim/Scenario-v0"

PATH_EVERY_M, PATH_ROWS = 5, 10
# Bounds of the observation space: no road user is faster, brakes harder or is larger.
MAX_SPEED_MPS, MAX_ACCEL_MPS2, MAX_LENGTH_M, MAX_WIDTH_M = 80.0, 15.0, 60.0, 10.0
PATH_BOUND_M = 60.0  # the last row of the path is 50 m ahead, and the ego is at most `LOST_M` off the path

# Costs of a step, in meters of progress.
OFF_PATH_PER_M_S = 0.2
COLLISION = 100.0
LOST_M = 15.0  # distance from the path at which an episode ends

PICTURE_PX, PICTURE_M = 400, 80.0

ObservationArrays = dict[str, Any]


class ScenarioEnv(gymnasium.Env[ObservationArrays, Any]):
    """Drive the ego of a scenario among its other agents.

    Action, `Box(-1, 1, (2,))` float32: the pedal (full brake to full throttle) and the steering (full lock right to full
    lock left), as shares of the vehicle's limits `accel_limits_mps2` and `max_steer_rad`.

    Observation, a dictionary of float32 boxes; values are clipped to their bounds:

    - `ego` (5,): speed in m/s, acceleration in m/s2, steering angle in rad, offset from the path of the scenario in m
      (left positive), heading against it in rad.
    - `path` (10, 3): the path of the scenario 5, 10, ... 50 m ahead: forward, left in m of the ego's box center and the
      scenario's speed.
    - `others` (max_others, 7): nearest first: forward, left in m, velocity forward, left in m/s (of the other, on the ego's
      axes), heading against the ego's in rad, length, width in m. Rows without an agent are 0.
    - `others_mask` (max_others,) int8: 1 where a row has an agent.

    Reward of a step: progress along the path of the scenario in m, less 0.2 per second and meter of offset from it,
    less 100 for a collision; `info["reward"]` holds the terms. The episode terminates with a collision or at the end of
    the path of the scenario, and is truncated when the scenario's time is over, or when the ego is more than 15 m off
    the path. The environment is deterministic; the seed has no effect.

    `dt_s`: simulation step. `hold_s`: how long each action holds, a multiple of `dt_s`. `agents` in {"reactive", "scenario"}
    or ids: behavior of the other agents; see `log2sim.simulation.runner.replay`. `sight_m`: range within which
    others are observed. `max_others`: rows for the nearest others. `render_mode` in {"rgb_array"}, optional.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | Path | str,
        *,
        dt_s: float = 0.02,
        hold_s: float = 0.1,
        agents: str | Collection[str] = "reactive",
        sight_m: float = 60.0,
        max_others: int = 16,
        render_mode: str | None = None,
    ) -> None:
        self.scenario = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
        self.world = open_world(self.scenario, dt_s=dt_s, agents=agents, sight_m=sight_m)
        self.render_mode, self._steps = render_mode, max(1, round(hold_s / dt_s))
        self._observation: Observation
        self._begun = False
        ego = self.world.ego
        assert ego is not None  # without an ego `open_world` refuses a scenario
        p = ego.parameters
        self.accel_limits_mps2 = float(p.max_brake_mps2[0]), float(p.max_throttle_mps2[0])
        self.max_steer_rad = float(p.max_steer_rad[0])
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)
        self._rows = max_others
        bounds = {
            "ego": [MAX_SPEED_MPS, MAX_ACCEL_MPS2, np.pi / 2, LOST_M, np.pi],
            "path": [[PATH_BOUND_M, PATH_BOUND_M, MAX_SPEED_MPS]] * PATH_ROWS,
            "others": [[sight_m, sight_m, MAX_SPEED_MPS, MAX_SPEED_MPS, np.pi, MAX_LENGTH_M, MAX_WIDTH_M]] * max_others,
        }
        self._bounds = {k: np.array(v, np.float32) for k, v in bounds.items()}
        spaces: dict[str, Any] = {k: Box(-v, v) for k, v in self._bounds.items()}
        self.observation_space = Dict({**spaces, "others_mask": Box(0, 1, (max_others,), np.int8)})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationArrays, dict[str, Any]]:
        """Start the scenario again, at the time when the ego appears."""
        super().reset(seed=seed)
        self.world.restart()
        while not self.world.ego_lives:
            self.world.advance()
        self._observation, self._begun = self.world.observe(), True
        return self._shown(), {"t_s": self._observation.t_s}

    def step(self, action: Any) -> tuple[ObservationArrays, float, bool, bool, dict[str, Any]]:
        """Hold an action for `hold_s`; `ValueError` when it is not two finite numbers."""
        if not self._begun:
            raise gymnasium.error.ResetNeeded("the episode has not begun: call reset() before step()")
        values = np.asarray(action, dtype=np.float64)
        if values.shape != (2,) or not np.isfinite(values).all():
            raise ValueError(f"action {action!r}: expected two finite numbers from -1 to 1, pedal and steering")
        pedal, wheel = np.clip(values, -1.0, 1.0).tolist()
        brake, throttle = self.accel_limits_mps2
        before_m, begin_s = self._observation.path.progress_m, self._observation.t_s
        self.world.steer(Controls(pedal * (throttle if pedal > 0 else brake), wheel * self.max_steer_rad))
        collides = over = False
        for _ in range(self._steps):
            self.world.advance()
            over = self.world.done or not self.world.ego_lives
            if not self.world.ego_lives:
                break
            self._observation = self.world.observe()
            o, ego = self._observation.others, self._observation.ego
            own = np.broadcast_to([ego.length_m, ego.width_m], (len(o), 2))
            size = np.stack([o.length_m, o.width_m], axis=1)
            yaw = np.full(len(o), ego.yaw_rad)
            level = np.abs(o.z_m - ego.z_m) < (o.height_m + ego.height_m) / 2
            overlap = rectangles_overlap(o.x_m - ego.x_m, o.y_m - ego.y_m, yaw, o.yaw_rad, own, size)
            collides = bool((level & overlap).any())
            if collides or over:
                break
        observation = self._observation
        offset_m = float(_path_errors(observation)[0])
        parts = {
            "progress": observation.path.progress_m - before_m,
            "off_path": -OFF_PATH_PER_M_S * abs(offset_m) * (observation.t_s - begin_s),
            "collision": -COLLISION * collides,
        }
        arrived = bool(np.isnan(observation.path.t_s[1]))
        truncated = not (collides or arrived) and (over or abs(offset_m) > LOST_M)
        info = {"t_s": observation.t_s, "collision": collides, "reward": parts}
        return self._shown(), float(sum(parts.values())), collides or arrived, truncated, info

    def render(self) -> Any:
        """Draw the surroundings of the ego from above, (400, 400, 3) uint8, its front to the right; None without render mode."""
        if not self._begun or self.render_mode != "rgb_array":
            return None
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import PolyCollection
        from matplotlib.figure import Figure

        path, ego, o = self._observation.path, self._observation.ego, self._observation.others
        figure = Figure(figsize=(PICTURE_PX / 100, PICTURE_PX / 100), dpi=100)
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(-PICTURE_M / 2, PICTURE_M / 2), ylim=(-PICTURE_M / 2, PICTURE_M / 2), aspect="equal")
        axes.axis("off")
        axes.plot(*_in_ego_frame(ego, path.x_m, path.y_m), color="#9aa5b1", linewidth=1.5)
        centers = np.stack(_in_ego_frame(ego, o.x_m, o.y_m), axis=1)
        others = box_corners_bev(centers.reshape(-1, 2), o.length_m, o.width_m, o.yaw_rad - ego.yaw_rad)
        axes.add_collection(PolyCollection(list(others), facecolor="#7aa6c2", edgecolor="#33566b"))
        own = box_corners_bev([[0.0, 0.0]], ego.length_m, ego.width_m, 0.0)
        axes.add_collection(PolyCollection(list(own), facecolor="#1f2933"))
        canvas.draw()  # type: ignore[no-untyped-call]
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]

    def _shown(self) -> ObservationArrays:
        """Convert the observation to arrays within the bounds of their spaces."""
        observation, ego, count = self._observation, self._observation.ego, self._rows
        ahead, way, o = np.arange(1, PATH_ROWS + 1) * PATH_EVERY_M, observation.path, observation.others
        path = (*_in_ego_frame(ego, way.x_m[ahead], way.y_m[ahead]), way.speed_mps[ahead])
        velocity, turn = _in_ego_axes(ego, o.velocity_x_mps, o.velocity_y_mps), wrap_angle(o.yaw_rad - ego.yaw_rad)
        columns = (*_in_ego_frame(ego, o.x_m, o.y_m), *velocity, turn, o.length_m, o.width_m)
        near = np.stack(columns, axis=1)[:count]
        others = np.zeros((count, 7))
        others[: len(near)] = near
        arrays = {
            "ego": np.array([ego.speed_mps, ego.accel_mps2, ego.steer_rad, *_path_errors(observation)]),
            "path": np.stack(path, axis=1),
            "others": others,
        }
        shown = {k: np.clip(v.astype(np.float32), -self._bounds[k], self._bounds[k]) for k, v in arrays.items()}
        return {**shown, "others_mask": (np.arange(count) < len(near)).astype(np.int8)}


def _in_ego_axes(ego: EgoState, x: Array, y: Array) -> tuple[Array, Array]:
    """Rotate vectors (N,), (N,) from map axes to forward and left of the ego."""
    cos, sin = np.cos(ego.yaw_rad), np.sin(ego.yaw_rad)
    return x * cos + y * sin, y * cos - x * sin


def _in_ego_frame(ego: EgoState, x_m: Array, y_m: Array) -> tuple[Array, Array]:
    """Transform points (N,), (N,) from the map to forward and left of the ego's box center."""
    return _in_ego_axes(ego, x_m - ego.x_m, y_m - ego.y_m)


def _path_errors(observation: Observation) -> tuple[Array, Array]:
    """Return the ego's offset to the left of its path in m, and its heading relative to it in rad."""
    x, y, yaw = observation.path.x_m[0], observation.path.y_m[0], observation.path.yaw_rad[0]
    dx, dy = observation.ego.x_m - x, observation.ego.y_m - y
    return dy * np.cos(yaw) - dx * np.sin(yaw), wrap_angle(observation.ego.yaw_rad - yaw)


gymnasium.register(ID, entry_point="log2sim.simulation.env:ScenarioEnv")
