"""nuScenes, version 1.0 of the tables: scenes of 20 s with six cameras at 12 Hz and a LiDAR at 20 Hz, labeled at 2 Hz.

The stamp of an image is the trigger of its exposure, that of a sweep the end of its turn. Every record has an ego pose
of its own. Those of can_bus are the same ones (to 1 mm on scene-0103) at 50 Hz without roll and pitch, so they are not
read; neither is radar.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, Labels, Lidar, Log, MapFrame, Stream
from log2sim.errors import LogError
from log2sim.files.images import MAX_IMAGE_PX
from log2sim.geometry import NS_PER_S, Camera, PoseTrack, shift_poses, whole_kilometers
from log2sim.logs.excerpt import digest_of
from log2sim.logs.kitti.labels import EARTH_RADIUS_M
from log2sim.logs.nuscenes.scene import (
    DATA,
    SCENES,
    Channel,
    Record,
    Scene,
    Tables,
    numbers_of,
    read_labels,
    read_sweep,
)
from log2sim.logs.records import FolderReader, first_image_size, image_stream, list_folders
from log2sim.logs.stamps import defer_notes

REFERENCE_CAMERA = "CAM_FRONT"
LABELED_LIDAR = "LIDAR_TOP"
# A Renault Zoe by its data sheet: wheelbase 2.588 m, overhangs 0.839 m in front and 0.657 m behind.
EGO_VEHICLE = EgoVehicle(size_m=(4.084, 1.73, 1.562), rear_axle_offset_m=1.385)
# South-western corners of the maps, which are the origins of their coordinates, latitude and longitude, and the sphere
# on which the nuScenes devkit converts positions (export_poses).
MAP_ORIGIN_DEG = {
    "boston-seaport": (42.336849169438615, -71.05785369873047),
    "singapore-onenorth": (1.2882100868743724, 103.78475189208984),
    "singapore-hollandvillage": (1.2993652317780957, 103.78217697143555),
    "singapore-queenstown": (1.2782562240223188, 103.76741409301758),
}
# A smaller range of heights means that the log has none: a drive on real ground has more.
MAX_FLAT_M = 0.001


class NuScenesReader(FolderReader):
    """Reader of nuScenes; the root holds folders of tables (v1.0-mini), or is one."""

    name = "nuscenes"
    looks_for = "a folder of tables with scene.json and sample_data.json (v1.0-mini), or the folder that holds it"

    def matches(self, path: Path) -> bool:
        """Return whether the folder holds tables, or is a folder of tables."""
        return bool(_versions(path))

    def find(self, path: Path) -> dict[str, tuple[Tables, str]]:
        """Find tables and name of the scenes at a folder, with the version in front of the name where there are several.

        A list of scenes that cannot be read counts as one, so that opening it raises why.
        """
        versions, scenes = _versions(path), {}
        for tables in map(Tables, versions):
            version = tables.folder.name
            try:
                names = [record["name"] for record in tables.read(SCENES, "name")]
            except LogError:
                names = [version]
            scenes.update({f"{version}/{n}" if len(versions) > 1 else n: (tables, n) for n in names})
        return scenes

    def open(self, path: Path, sequence: str) -> Log:
        """Open a scene; the tables are read but for the annotations, no image and no sweep."""
        tables, name = self.find(path)[sequence]
        record = next(record for record in tables.read(SCENES, "name") if record["name"] == name)
        return _open(Scene(tables, record))


READER = NuScenesReader()


def _versions(path: Path) -> list[Path]:
    """Folders of tables at a path."""
    found = [p for p in (path, *list_folders(path)) if all((p / f"{name}.json").is_file() for name in (SCENES, DATA))]
    return [path] if path in found else found


def _open(scene: Scene) -> Log:
    notes, tables, ego = scene.notes, scene.tables, scene.ego
    offset_m = whole_kilometers(ego.map_T_ego[:, :3, 3])
    map_T_ego = shift_poses(ego.map_T_ego, offset_m)
    track = PoseTrack(ego.t_ns, map_T_ego)
    cameras, lidars, streams, files = _sensors(scene, track)
    if np.ptp(map_T_ego[:, 2, 3]) < MAX_FLAT_M:
        climb = np.degrees(np.abs(np.arcsin(np.clip(map_T_ego[:, 2, 0], -1, 1))).max())
        lacks = f"ego poses have no height (z is constant) though they pitch by up to {climb:.1f} degrees"
        notes.append(f"{lacks}: the map is as flat as the log states it")
    # The records with files may last much shorter than the scene.
    of_scene = [c.t_ns for c in scene.channels.values() if c.modality in ("camera", "lidar")]
    there = [stream.t_ns for stream in streams.values()]
    whole_s, there_s = (float(max(t[-1] for t in s) - min(t[0] for t in s)) / NS_PER_S for s in (of_scene, there))
    if there_s < whole_s - 1.0:
        notes.append(
            f"images and sweeps that are there last {there_s:.1f} s of the {whole_s:.1f} s of the scene; "
            "labels and ego poses cover all of it, a scenario only that part"
        )
    place = MAP_ORIGIN_DEG.get(scene.location)
    x, y, z = offset_m.tolist()
    map_frame = MapFrame(offset_m=(x, y, z))
    if place is None:
        notes.append(f"log.json: location {scene.location[:40]!a} is not known: the map is only local")
    else:
        sphere = f"+proj=aeqd +R={EARTH_RADIUS_M:.0f} +x_0=0 +y_0=0 +units=m +no_defs"
        map_frame = MapFrame(*place, None, f"{sphere} +lat_0={place[0]!r} +lon_0={place[1]!r}", (x, y, z))

    @cache
    def labels() -> Labels | None:
        channels = {name: c for name, c in scene.channels.items() if c.modality == "lidar"}
        lidar = channels.get(LABELED_LIDAR) or next(iter(channels.values()), None)
        return read_labels(scene, lidar, offset_m, notes)

    index = [scene.record, scene.samples, scene.data, [c.calibration for c in scene.channels.values()]]
    poses = [ego.t_ns.tobytes().hex(), ego.map_T_ego.tobytes().hex()]
    return Log(
        name=f"nuscenes-{scene.record['name']}",
        format=READER.name,
        cameras=cameras,
        lidars=lidars,
        streams=streams,
        ego=track,
        ego_vehicle=EGO_VEHICLE,
        map=map_frame,
        labels=labels,
        reference_camera=REFERENCE_CAMERA if REFERENCE_CAMERA in cameras else None,
        digest=digest_of([json.dumps(index, sort_keys=True), *poses], files),
        notes=defer_notes(notes, labels),
        calibrations=dict.fromkeys(streams, str(tables.path("calibrated_sensor"))),
        details={
            "tables": tables.folder.resolve().name,
            "scene": {key: str(scene.record.get(key, "")) for key in ("name", "description")},
            "location": scene.location,
            "key_frames": len(scene.samples),
        },
    )


def _sensors(
    scene: Scene, track: PoseTrack
) -> tuple[dict[str, Camera], dict[str, Lidar], dict[str, Stream], list[Path]]:
    cameras, lidars, streams = dict[str, Camera](), dict[str, Lidar](), dict[str, Stream]()
    root, unused, missing, used = scene.tables.folder.resolve().parent, list[str](), 0, list[Path]()
    for name, channel in scene.channels.items():
        if channel.modality not in ("camera", "lidar"):
            unused.append(name)
            continue
        records, t_ns, files = channel.present(root, scene.tables.path(DATA))
        lost = len(channel.records) - len(files)
        missing += lost
        if lost:
            left_out = "; the sensor is left out" if not files else ""
            scene.notes.append(f"{name}: {lost} of {len(channel.records)} records are missing{left_out}")
        if not files:
            continue
        used += files
        if channel.modality == "camera":
            cameras[name] = _camera(channel, records[0], files, scene.tables.path("calibrated_sensor"))
            streams[name] = image_stream(name, t_ns, files, (cameras[name].width_px, cameras[name].height_px))
        else:
            lidars[name] = Lidar(name, "ego", channel.ego_T_sensor)
            streams[name] = _sweep_stream(channel, track, t_ns, files)
    if not streams:
        there = f"none of the {missing} images and sweeps of scene '{scene.record['name']}' is there"
        raise LogError(f"{root}: {there}; unpack samples/ and sweeps/ next to the folder of the tables")
    if unused:
        scene.notes.append(f"not read, as log2sim makes no use of radar: {', '.join(unused)}")
    return cameras, lidars, streams, used


def _camera(channel: Channel, record: Record, files: list[Path], path: Path) -> Camera:
    K = numbers_of([channel.calibration], "camera_intrinsic", (3, 3), path)[0]
    if not (K[0, 0] > 0 and K[1, 1] > 0 and K[2].tolist() == [0, 0, 1]):
        expected = "expected positive focal lengths and a last row 0 0 1"
        raise LogError(f"{path}: {channel.name}: camera_intrinsic is {K.tolist()}, {expected}")
    width, height = record.get("width"), record.get("height")
    stated = all(isinstance(v, int) and 0 < v <= MAX_IMAGE_PX for v in (width, height))
    width, height = (width, height) if stated else first_image_size(files)
    return Camera(channel.name, int(width or 0), int(height or 0), K, "ego", channel.ego_T_sensor)


def _sweep_stream(channel: Channel, track: PoseTrack, t_ns: NDArray[np.int64], files: list[Path]) -> Stream:
    return Stream(channel.name, t_ns, lambda i: read_sweep(files[i], int(t_ns[i]), track, channel.ego_T_sensor))
