"""Pictures a second and core of the renderer: python tools/bench.py render

Prints CPU time of one thread, for pictures of 960 x 600 px: of the sample scene, of the roadside scene in four kinds of light
and weather, and of random traffic, each picture of which is a new scene (its ground, shapes and colors made included).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from entry import SAMPLES

from log2sim.geometry import Camera
from log2sim.synth.light import light_of
from log2sim.synth.render import render
from log2sim.synth.scene import Environment, load_scene
from log2sim.synth.synthesis import synthesize
from log2sim.synth.traffic import rig_of
from log2sim.synth.traffic_data import TrafficSettings, draw_traffic
from log2sim.synth.traffic_picture import TrafficPainter

SIZE_PX = (960, 600)
CONDITIONS = (("noon", "clear"), ("overcast", "rain"), ("night", "clear"), ("dusk", "fog"))


def of_scene(path: Path, environment: Environment) -> Iterator[Callable[[], object]]:
    """Frames of all cameras of a scene, spread over its time."""
    scene = load_scene(path)
    cameras = tuple(c.model_copy(update={"size_px": SIZE_PX}) for c in scene.camera)
    changed = scene.model_copy(update={"camera": cameras, "lidar": (), "environment": environment})
    log, _ = synthesize(changed, seed=1, observe=False)
    order = [(name, i) for name, s in log.streams.items() for i in range(len(s.t_ns))]
    for k in np.random.default_rng(0).permutation(len(order)):
        name, index = order[k]
        yield lambda name=name, index=index: log.streams[name].read(index)


def of_traffic(environment: Environment) -> Iterator[Callable[[], object]]:
    """Pictures of random scenes."""
    for index in range(10_000):
        scene, _ = draw_traffic(TrafficSettings("vehicle", seed=1), index)
        rig = rig_of(scene)
        K = np.array([[600.0, 0, 479.5], [0, 600.0, 299.5], [0, 0, 1]])
        camera = Camera("wide", *SIZE_PX, K, "map", rig.map_T_cam)

        def picture(scene=scene, camera=camera, index=index) -> object:
            painter = TrafficPainter(scene, index)
            instant, _ = painter.instant(scene, light_of(environment), camera, camera.mount_T_cam)
            return render(camera, camera.mount_T_cam, instant, np.random.default_rng(index))

        yield picture


def measured(jobs: Iterator[Callable[[], object]], count: int) -> float:
    """Median CPU seconds a picture; the first two are not counted."""
    seconds = []
    for _, job in zip(range(count + 2), jobs):
        begin = time.process_time()
        job()
        seconds.append(time.process_time() - begin)
    return float(np.median(seconds[2:]))


def main(pictures: int = 20) -> None:
    """Print the table, of so many pictures a row."""
    cv2.setNumThreads(1)
    rows = {"samples/crossing.toml, noon": of_scene(SAMPLES / "crossing.toml", Environment())}
    for light, weather in CONDITIONS:
        environment = Environment(light=light, weather=weather)
        rows[f"samples/scenes/roadside.toml, {light}, {weather}"] = of_scene(
            SAMPLES / "scenes/roadside.toml", environment
        )
    rows["random traffic, a new scene each, noon"] = of_traffic(Environment())
    for name, jobs in rows.items():
        seconds = measured(jobs, pictures)
        print(f"{name:52s} {seconds:6.3f} s {1 / seconds:5.1f} pictures a second and core", flush=True)
