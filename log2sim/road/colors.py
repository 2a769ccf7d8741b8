"""Colors of vehicles, named by a network in the pictures that show them best.

The network was trained on rendered vehicles alone (`tools/train.py colors`); its file describes itself under `METADATA_KEY`, the card
beside it tells seed, data, steps and figures.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import COLOR_NAMES, AgentTable, Log, Scenario
from log2sim.datatypes.color_names import to_rgb
from log2sim.errors import ConfigError
from log2sim.geometry import MIN_DEPTH_M, NS_PER_S, Array, Camera, inverse, project
from log2sim.perception.detect3d.network import open_session
from log2sim.perception.lidar.projection import project_boxes_in_view, view_of

Image = NDArray[np.uint8]

FILE = Path(__file__).with_name("weights") / "colors.onnx"
METADATA_KEY = "log2sim.colors"
MAX_BYTES = 4 * 1024**2
SIDE_PX = 48  # of the picture that the network sees
# Sides of what it sees relative to those of the vehicle's box: the road and what is beside tell the light.
CONTEXT = 1.3
LAB_SCALE = 30.0  # units of CIELAB of its outputs


@dataclass(frozen=True, eq=False)
class ColorNetwork:
    """Loaded network."""

    session: Any  # onnxruntime.InferenceSession
    scale: float  # of the logits of one picture, by which their softmax is calibrated
    power: float  # of the number of pictures of one vehicle, by which the sum of their logits is divided: their errors are alike

    def raw(self, crops: Sequence[Image]) -> Array:
        """Return logits of the names and the color in CIELAB by `LAB_SCALE`, (N, 13), of crops (48, 48, 3), BGR."""
        pictures = np.stack(crops)[..., ::-1].transpose(0, 3, 1, 2).astype(np.float32) / 255
        return np.asarray(self.session.run(["names"], {"picture": np.ascontiguousarray(pictures)})[0], np.float64)

    def decide(self, raw: Array) -> tuple[Array, Array]:
        """Join outputs (N, 13) for crops of one vehicle: its color (3,) in CIELAB, and the probability (K,) of each of `COLOR_NAMES`."""
        names = len(COLOR_NAMES)
        logits = self.scale * raw[:, :names].sum(axis=0) / len(raw) ** self.power
        share = np.exp(logits - logits.max())
        return np.median(raw[:, names:], axis=0) * LAB_SCALE, share / share.sum()


def open_color_network(path: Path) -> ColorNetwork:
    """Load a network; `ConfigError` where the file is none."""
    session = open_session(path, MAX_BYTES, "network of colors")
    try:
        info = json.loads(session.get_modelmeta().custom_metadata_map[METADATA_KEY])
        return ColorNetwork(session, float(info["scale"]), float(info["power"]))
    except (KeyError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: no network of colors: {error!r}") from None


@lru_cache(maxsize=1)
def shipped_network() -> ColorNetwork:
    """Load the network that comes with log2sim, once."""
    return open_color_network(FILE)


def crop(image_bgr: Image, box_px: Array) -> Image:
    """Cut a vehicle's box (4,), u0, v0, u1, v1, with its context out of a picture; edges go on beyond the picture's."""
    middle, half = (box_px[:2] + box_px[2:]) / 2, (box_px[2:] - box_px[:2]) / 2 * CONTEXT
    (u0, v0), (u1, v1) = np.floor(middle - half).astype(int), np.ceil(middle + half).astype(int)
    height, width = image_bgr.shape[:2]
    inner = image_bgr[max(v0, 0) : max(v1, 0), max(u0, 0) : max(u1, 0)]
    edges = max(-v0, 0), max(v1 - height, 0), max(-u0, 0), max(u1 - width, 0)
    if any(edges):
        inner = np.asarray(cv2.copyMakeBorder(inner, *edges, cv2.BORDER_REPLICATE), np.uint8)
    shrinks = min(inner.shape[:2]) > SIDE_PX
    return np.asarray(
        cv2.resize(inner, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8
    )


# Pictures in turn differ little: light and direction change over meters, which takes about this long.
MIN_STEP_S = 0.5
MAX_VIEWS = 8  # of an agent; more do not change a median
MIN_HEIGHT_PX = 20.0  # the smallest on which the network was trained
MAX_HIDDEN = 0.5  # share of the width; of what is hidden further the box shows another vehicle


def choose_views(log: Log, scenario: Scenario, wanted: Sequence[str]) -> dict[str, dict[int, list[str]]]:
    """Choose frames in which to look at agents, by their ids: by camera and index of the frame, the agents to look at there."""
    agents = scenario.others
    frames: list[tuple[str, int]] = []
    heights: list[Array] = []
    for name, camera in log.cameras.items():
        if name not in log.streams or not len(log.streams[name].t_ns):
            continue
        t_ns = log.streams[name].t_ns
        spaced = np.unique((t_ns - t_ns[0]) // round(MIN_STEP_S * NS_PER_S), return_index=True)[1]
        poses, known = log.map_T_sensor(name, t_ns[spaced])
        boxes = AgentTable.of(agents, (t_ns[spaced] - scenario.t0_ns) / NS_PER_S, permanent=True)
        for k in np.flatnonzero(known):
            frames.append((name, int(spaced[k])))
            heights.append(_clear_heights(camera, inverse(poses[k]), boxes.center_m[:, k], boxes.size_m))
    table = np.array(heights).reshape(len(frames), -1)
    views: dict[str, dict[int, list[str]]] = {}
    for row in [k for k, agent in enumerate(agents) if agent.id in set(wanted)] if frames else ():
        for k in np.argsort(-table[:, row], kind="stable")[:MAX_VIEWS].tolist():
            if table[k, row] >= MIN_HEIGHT_PX:
                name, index = frames[k]
                views.setdefault(name, {}).setdefault(index, []).append(agents[row].id)
    return views


def _clear_heights(camera: Camera, cam_T_map: Array, center: Array, size: Array) -> Array:
    """Return the heights (A,), px, of agents in a picture, times the share of their widths that nothing nearer hides; 0 outside."""
    points = center @ cam_T_map[:3, :3].T + cam_T_map[:3, 3]
    with np.errstate(invalid="ignore"):
        ahead = points[:, 2] > MIN_DEPTH_M
    uv = np.full((len(points), 2), np.nan)
    uv[ahead] = project(camera, points[ahead])[0]
    out = np.zeros(len(points))
    with np.errstate(invalid="ignore"):
        inside = (uv > 0).all(axis=1) & (uv[:, 0] < camera.width_px) & (uv[:, 1] < camera.height_px)
    depth = points[:, 2]
    rows = np.flatnonzero(inside)
    half = camera.K[0, 0] * (size[rows, 0] + size[rows, 1]) / 4 / depth[rows]
    left, right = uv[rows, 0] - half, uv[rows, 0] + half
    for k, row in enumerate(rows):
        hidden = 0.0
        nearer = (depth[rows] < depth[row]) & (left < right[k]) & (right > left[k])
        for j in np.flatnonzero(nearer):
            hidden = max(hidden, (min(right[k], right[j]) - max(left[k], left[j])) / (right[k] - left[k]))
        if hidden <= MAX_HIDDEN:
            out[row] = camera.K[1, 1] * size[row, 2] / depth[row] * (1 - hidden)
    return out


CATEGORIES = ("car", "truck", "bus")
SCENE_SAMPLES = 64  # along the longer side of the picture
MAX_GRAY_DIFFERENCE = 4  # between channels of a picture without color, by the errors of JPEG


class ColorSampler:
    """Looks at the vehicles of a scenario in chosen pictures and names their colors.

    `gray`: cameras whose pictures have no color.
    """

    def __init__(self, log: Log, scenario: Scenario) -> None:
        self._log, self._scenario = log, scenario
        self._vehicles = [a.id for a in scenario.others if a.category in CATEGORIES]
        self._views = choose_views(log, scenario, self._vehicles)
        self._boxes: dict[str, AgentTable] = {}
        self._network = shipped_network()
        self._looks: dict[str, list[Array]] = {}
        self.gray: set[str] = set()

    def frames(self) -> Mapping[str, NDArray[np.int64]]:
        """Return the indices of the frames that it wants, by camera."""
        return {name: np.array(sorted(frames), np.int64) for name, frames in self._views.items()}

    def add(self, camera: str, index: int, image_bgr: Image) -> None:
        """Look at the vehicles for which a frame was chosen."""
        stride = max(1, max(image_bgr.shape[:2]) // SCENE_SAMPLES)
        grid = image_bgr[stride // 2 :: stride, stride // 2 :: stride, ::-1]
        if np.ptp(grid.astype(np.int16), axis=-1).max(initial=0) <= MAX_GRAY_DIFFERENCE:
            self.gray.add(camera)
            return
        t_ns = int(self._log.streams[camera].t_ns[index])
        view, agents = view_of(self._log, camera, t_ns), self._views.get(camera, {}).get(index)
        if view is None or not agents:
            return
        if (
            camera not in self._boxes
        ):  # of all agents in the frames that it wants of a camera, made for all of them at once
            t_s = (self._log.streams[camera].t_ns[self.frames()[camera]] - self._scenario.t0_ns) / NS_PER_S
            self._boxes[camera] = AgentTable.of(self._scenario.others, t_s, permanent=True)
        boxes = self._boxes[camera]
        place = int(np.searchsorted(self.frames()[camera], index))
        rows = [next(k for k, other in enumerate(boxes.agents) if other.id == agent) for agent in agents]
        found = project_boxes_in_view(view, boxes.center_m[rows, place], boxes.size_m[rows], boxes.yaw_rad[rows, place])
        seen = np.flatnonzero(found.valid)
        if len(seen):
            raw = self._network.raw([crop(image_bgr, box) for box in found.box_px[seen]])
            for k, look in zip(seen.tolist(), raw):
                self._looks.setdefault(agents[k], []).append(look)

    def colors(self) -> dict[str, dict[str, Any]]:
        """Return the color of each vehicle that was seen, by id, as `Agent.color` holds it."""
        found = {}
        for agent, looks in self._looks.items():
            lab, probability = self._network.decide(np.array(looks))
            best = int(np.argmax(probability))
            found[agent] = {
                "rgb": [int(v) for v in to_rgb(lab)[0]],
                "name": COLOR_NAMES[best],
                "confidence": round(float(probability[best]), 3),
                "lab": [round(float(v), 2) for v in lab],
                "frames": len(looks),
            }
        return found

    def notes(self) -> tuple[str, ...]:
        """Say which vehicles have no color, and why."""
        missing = [agent for agent in self._vehicles if agent not in self._looks]
        if not missing:
            return ()
        reason = "no picture shows enough of them"
        if self.gray:
            reason += f"; pictures of {', '.join(sorted(self.gray))} are gray"
        return (f"no color of {len(missing)} of {len(self._vehicles)} vehicles: {reason}",)
