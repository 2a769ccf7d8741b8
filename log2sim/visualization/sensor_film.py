"""A film of sensors: what was recorded, above what the world of the log shows, above what happens now."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Scenario
from log2sim.files.documents import replaced
from log2sim.geometry import NS_PER_S, period_of
from log2sim.perception.records import RecordSource
from log2sim.resim.rays import angles_of
from log2sim.resim.simulate import Simulation
from log2sim.visualization.plot.encoding import FilmFile, Image

WIDTH_PX, HEIGHT_PX, TITLE_PX = 960, 120, 18  # of a sweep, and of the line above it
FULL_M = 40.0  # whose color is the last


def window_of(direction: NDArray[Any]) -> NDArray[Any]:
    """Return the least and greatest azimuth and elevation, rad (2, 2), of nearly all rays (N, 3)."""
    return np.asarray(np.quantile(np.stack(angles_of(direction), axis=1), (0.002, 0.998), axis=0).T)


def range_image(direction: NDArray[Any], range_m: NDArray[Any], window: NDArray[Any]) -> Image:
    """Draw ranges (N,), m, of rays (N, 3) within a window as (HEIGHT_PX, WIDTH_PX, 3) BGR: left is left, nearer ones on top."""
    low, high = window[:, 0], np.maximum(window[:, 1], window[:, 0] + 1e-6)
    column, row = ((high - np.stack(angles_of(direction), axis=1)) / (high - low) * (WIDTH_PX - 1, HEIGHT_PX - 1)).T
    inside = (row >= 0) & (row < HEIGHT_PX) & (column >= 0) & (column < WIDTH_PX)
    shown = np.flatnonzero(np.isfinite(range_m) & inside)
    shown = shown[np.argsort(-range_m[shown], kind="stable")]
    gray = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    near = 255 - 254 * np.clip(range_m[shown] / FULL_M, 0, 1)
    gray[row[shown].astype(int), column[shown].astype(int)] = near
    gray = np.asarray(cv2.dilate(gray, np.ones((3, 3), np.uint8)), np.uint8)
    return np.where(gray[..., None] > 0, cv2.applyColorMap(255 - gray, cv2.COLORMAP_TURBO), 0).astype(np.uint8)


def write_film(simulation: Simulation, source: Scenario, film: FilmFile) -> None:
    """Write a film of the first LiDAR, and the camera that looks ahead where pictures are simulated.

    `simulation`: of what happens now. `source`: of the log, seen again in the middle where it is another scenario.
    """
    name = next(n for n in simulation.sensors if n in simulation.log.lidars)
    t_ns = simulation.log.streams[name].t_ns
    fps = 1 / period_of(t_ns) if len(t_ns) > 1 else 1.0
    assert film.write is not None
    with replaced(film.path) as temporary:
        film.write(_frames(simulation, source, name), temporary, fps)


def _frames(simulation: Simulation, source: Scenario, name: str) -> Iterator[Image]:
    log, records = simulation.log, RecordSource(simulation.log)
    panels: dict[str, Simulation | None] = {"recorded": None}
    if simulation.scenario is not source:
        panels["simulated"] = replace(simulation, scenario=source)
        panels["what happens now"] = simulation
    else:
        panels["simulated"] = simulation
    cameras = [n for n in simulation.sensors if n in log.cameras and log.cameras[n].mount == "ego"]
    camera = max(cameras, key=lambda n: float(log.cameras[n].mount_T_cam[0, 2]), default=None)
    for i, stamp in enumerate(log.streams[name].t_ns.tolist()):
        if not all(p is None or p.driven.map_T_sensor(name, np.array([stamp]))[1].all() for p in panels.values()):
            continue
        shots = simulation.shots(name, i)
        window = window_of(shots.direction)
        parts: list[Any] = []
        for title, panel in panels.items():
            if panel is None:
                drawn = range_image(shots.direction, shots.range_m, window)
            else:
                points = panel.sweep(name, i).xyz_m
                range_m = np.linalg.norm(points, axis=1)
                drawn = range_image(points / range_m[:, None], range_m, window)
            parts += [title_line(f"{title}, {name}, {(stamp - source.t0_ns) / NS_PER_S:.1f} s"), drawn]
        if camera is not None:
            k = int(np.argmin(np.abs(log.streams[camera].t_ns - stamp)))
            at_ns = int(log.streams[camera].t_ns[k])
            pictures = [
                records.require(camera, k) if panel is None else panel.picture(camera, at_ns)[0]
                for panel in panels.values()
            ]
            width = WIDTH_PX // len(pictures)
            height = round(pictures[0].shape[0] * width / pictures[0].shape[1])
            small = [cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA) for p in pictures]
            parts += [title_line(", ".join(panels)), np.hstack(small)]
        yield np.vstack(parts)[..., ::-1]


def title_line(text: str) -> Image:
    """Return a white line with a text, (TITLE_PX, WIDTH_PX, 3)."""
    line = np.full((TITLE_PX, WIDTH_PX, 3), 255, np.uint8)
    cv2.putText(line, text, (6, TITLE_PX - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 30, 25), 1, cv2.LINE_AA)
    return line
