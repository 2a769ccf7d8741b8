"""Write data of random traffic: synchronized pictures and clouds with labels, as KITTI's object layout or as log folders."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from log2sim.documents import check_folder
from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.output_folders import replaced_folder
from log2sim.synth.kitti_layout import KittiFrame, calibration_text, label_text
from log2sim.synth.light import light_of, weather_of
from log2sim.synth.render import render, segment
from log2sim.synth.scene import Environment
from log2sim.synth.traffic import Mount, TrafficScene
from log2sim.synth.traffic_log import log_of
from log2sim.synth.traffic_picture import TrafficPainter
from log2sim.synth.traffic_random import draw_scene
from log2sim.synth.traffic_rig import draw_environment, rig_of, sensor_named

MANIFEST = "traffic.json"
FORMAT, VERSION = "log2sim-traffic", 1
Layout = Literal["kitti", "log2sim"]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class TrafficSettings:
    """What to write.

    Attributes
    ----------
    mount : str
        "vehicle" or "roadside".
    scenes : int
    seed : int
    sensor : str or None
        Name or TOML file of a LiDAR, "random", or None for the usual one of the mount.
    layout : str
        "kitti" or "log2sim".
    duration_s : float
        Of each log; a scene in KITTI's layout is one frame.
    light, weather : str or None
        As in scene files; None draws them for each scene.
    pictures : bool
        Whether logs have a camera.
    """

    mount: Mount
    scenes: int = 10
    seed: int = 0
    sensor: str | None = None
    layout: Layout = "kitti"
    duration_s: float = 5.0
    light: str | None = None
    weather: str | None = None
    pictures: bool = True


def write_traffic(
    settings: TrafficSettings, out: Path, *, overwrite: bool = False, progress: Progress | None = None
) -> None:
    """Write random scenes below a folder, whole or not at all; the same settings write the same bytes.

    Raises
    ------
    ConfigError
        For an unknown sensor, KITTI's layout without pictures, or when the folder may not be replaced or cannot be written.
    """
    if settings.layout == "kitti" and not settings.pictures:
        raise ConfigError("KITTI's layout labels what pictures show; without pictures choose the layout log2sim")
    sensor_named(settings.sensor, settings.mount)
    _refuse(out, overwrite=overwrite)
    check_folder(out, overwrite=overwrite)
    write = _write_frame if settings.layout == "kitti" else _write_log
    with replaced_folder(out, overwrite=overwrite) as folder:
        scenes = []
        for index in range(settings.scenes):
            scene, environment = draw_traffic(settings, index)
            write(settings, scene, environment, folder, index)
            scenes.append(_description(scene, environment, index))
            if progress is not None:
                progress(index + 1, settings.scenes)
        if settings.layout == "kitti":
            _write_splits(folder, settings)
        (folder / MANIFEST).write_text(json.dumps(_manifest(settings, scenes), indent=1) + "\n", encoding="utf-8")


def draw_traffic(settings: TrafficSettings, index: int) -> tuple[TrafficScene, Environment]:
    """Draw scene `index`; it depends on the seed and the index, not on how many there are."""
    environment = draw_environment(np.random.default_rng([settings.seed, index, 1]), settings.light, settings.weather)
    lidar = sensor_named(settings.sensor, settings.mount)
    rng = np.random.default_rng([settings.seed, index, 0])
    return draw_scene(settings.mount, rng, lidar=lidar, weather=weather_of(environment)), environment


def frame_of(scene: TrafficScene, environment: Environment, seed: int) -> KittiFrame:
    """Take picture, cloud and labels of a scene at time 0."""
    rig = rig_of(scene)
    painter = TrafficPainter(scene, seed)
    instant, seen = painter.instant(scene, light_of(environment), rig.camera, rig.map_T_cam)
    image = render(rig.camera, rig.map_T_cam, instant, np.random.default_rng([seed, 2]))
    parts = segment(rig.camera, rig.map_T_cam, instant)
    returns = scene.cast(np.random.default_rng([seed, 4]))
    lidar_T_map = rig.map_T_lidar[:3, :3].T
    points: Array = (returns.xyz_m - rig.map_T_lidar[:3, 3]) @ lidar_T_map.T
    labels = label_text([scene.objects[k] for k in seen], parts, rig)
    return KittiFrame(
        image, np.column_stack([points, returns.intensity]).astype(np.float32), calibration_text(rig), labels
    )


def _write_frame(
    settings: TrafficSettings, scene: TrafficScene, environment: Environment, root: Path, index: int
) -> None:
    frame_of(scene, environment, _scene_seed(settings, index)).write(root / "training", index)


def _write_log(
    settings: TrafficSettings, scene: TrafficScene, environment: Environment, root: Path, index: int
) -> None:
    from log2sim.logs.native.writer import write_log

    name = _scene_name(index)
    seed = _scene_seed(settings, index)
    log = log_of(scene, environment, name, settings.duration_s, seed, image_labels=settings.pictures)
    if not settings.pictures:
        sweeps = {name: log.streams[name] for name in log.lidars}
        log = log.changed(cameras={}, streams=sweeps, image_labels={}, reference_camera=None)
    write_log(log, root / name)


def _scene_seed(settings: TrafficSettings, index: int) -> int:
    return int(np.random.default_rng([settings.seed, index, 2]).integers(2**31))


def _scene_name(index: int) -> str:
    return f"scene_{index:06d}"


def _write_splits(root: Path, settings: TrafficSettings) -> None:
    """Write the lists of frames that readers of KITTI's layout look for: a random half for training, the other to validate."""
    order = np.random.default_rng([settings.seed, 3]).permutation(settings.scenes)
    folder = root / "ImageSets"
    folder.mkdir()
    half = (settings.scenes + 1) // 2
    for name, rows in (("train", order[:half]), ("val", order[half:]), ("trainval", order)):
        (folder / f"{name}.txt").write_text("".join(f"{k:06d}\n" for k in sorted(rows.tolist())), encoding="ascii")


def _description(scene: TrafficScene, environment: Environment, index: int) -> dict[str, Any]:
    users = [o.category for o in scene.objects if o.category]
    return {
        "name": f"{index:06d}",
        "environment": environment.model_dump(),
        "lidar": scene.lidar.name,
        "road_users": {category: users.count(category) for category in sorted(set(users))},
    }


def _manifest(settings: TrafficSettings, scenes: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "mount": settings.mount,
        "layout": settings.layout,
        "seed": settings.seed,
        "sensor": settings.sensor,
        "scenes": scenes,
    }


def _refuse(out: Path, *, overwrite: bool) -> None:
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not overwrite:
        raise ConfigError(f"{out}: exists already; choose another name or pass --overwrite")
    if not (out / MANIFEST).is_file():
        raise ConfigError(f"{out}: exists and is no data of random traffic, so it is not replaced; choose another name")
