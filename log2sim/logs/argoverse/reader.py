"""Argoverse 2 logs: up to nine cameras, two LiDARs in one file a sweep, poses in a city's frame, boxes at 10 Hz.

What the user guide does not say was measured on a log of the validation split. Points are compensated to the stamp of
their sweep, its start: with that the elevations of a laser's points scatter by 0.003 to 0.005 degrees, with the end by 0.03
to 0.06. The ego's origin is 0.33 m above the road: planes fitted to the points within 9 m of two sweeps say 0.337 and 0.334,
the raster of ground heights below 68 poses 0.32 with a deviation of 0.03. The stamps of the poses, among them those of the
images, are those at which the LiDARs pass the axes of the cameras, to 1 ms; as exposures are centered on that (user guide),
the stamp of an image is the middle of its exposure. Shutters are global, and images are undistorted (user guide).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, Labels, Lidar, Log, Stream
from log2sim.errors import LogError
from log2sim.geometry import Array, Camera, PoseTrack
from log2sim.input_files import is_present, read_file
from log2sim.links import require_links_inside
from log2sim.logs.argoverse.cities import find_city, map_frame_of
from log2sim.logs.argoverse.labels import read_labels
from log2sim.logs.argoverse.poses import read_ego_track, read_mounts
from log2sim.logs.argoverse.sweeps import LIDARS, sweep_stream
from log2sim.logs.arrow.tables import LIMITS, read_columns
from log2sim.logs.arrow.values import Kind
from log2sim.logs.digest import digest_of
from log2sim.logs.images import MAX_IMAGE_PX, image_stream
from log2sim.logs.notes import defer_notes
from log2sim.logs.record_files import list_files, list_numbered_files

POSES = "city_SE3_egovehicle.feather"
MOUNTS, INTRINSICS = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"
ANNOTATIONS = "annotations.feather"
ROAD_Z_EGO_M = -0.33
# A Ford Fusion Hybrid, by its data sheet; that does not say how far it reaches behind the rear axle: 1.1 m is an estimate.
EGO_VEHICLE = EgoVehicle(size_m=(4.87, 1.85, 1.48), rear_axle_offset_m=1.335)
REFERENCE_CAMERA = "ring_front_center"
# A log below a folder of splits of a folder of data sets: argoverse2/sensor/val/LOG.
MAX_DEPTH = 3
MAX_FOLDERS = 20_000

INTRINSIC_COLUMNS: dict[str, Kind] = {
    "sensor_name": "text", "fx_px": "float", "fy_px": "float", "cx_px": "float", "cy_px": "float",
    "height_px": "int", "width_px": "int",
}  # fmt: skip


class ArgoverseReader:
    """Reader of Argoverse 2 logs; the root is a log, a split or a folder of splits."""

    name = "argoverse2"
    looks_for = f"a folder with {POSES} and calibration/, or a folder up to three levels above such folders"
    suffixes = ()

    def matches(self, path: Path) -> bool:
        """Return whether the folder is a log or holds some."""
        return next(_logs(path, MAX_DEPTH), None) is not None

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the logs, sorted; below other folders with these ("sensor/val/LOG")."""
        if _is_log(path):
            return [path.resolve().name]
        return sorted(log.relative_to(path).as_posix() for log in _logs(path, MAX_DEPTH))

    def open(self, path: Path, sequence: str) -> Log:
        """Open a log; no image, no sweep and no annotation is read."""
        folder = path if _is_log(path) else path / sequence
        require_links_inside(folder, path)
        return _Folder(folder).log()


READER = ArgoverseReader()


def _is_log(path: Path) -> bool:
    return (path / POSES).is_file() and (path / "calibration").is_dir()


def _logs(root: Path, depth: int) -> Iterator[Path]:
    """Find logs at and up to `depth` levels below a folder, not below logs nor in what is hidden or cannot be read."""
    folders, left = [(root, depth)], MAX_FOLDERS
    while folders and left:
        left -= 1
        path, below = folders.pop()
        if _is_log(path):
            yield path
        elif below:
            try:
                with os.scandir(path) as entries:
                    inside = [e.name for e in entries if not e.name.startswith(".") and e.is_dir()]
            except OSError:
                continue
            folders += [(path / name, below - 1) for name in inside]


@dataclass(frozen=True)
class _Folder:
    path: Path

    def log(self) -> Log:
        notes: list[str] = []
        ego, offset_m = read_ego_track(self.path / POSES, notes)
        mounts = read_mounts(self.path / MOUNTS)
        cameras, streams = self._cameras(mounts, notes)
        lidars, sweeps = self._lidars(mounts, notes)
        streams |= sweeps
        if not streams:
            raise LogError(f"{self.path / 'sensors'}: neither sweeps nor images; expected lidar/STAMP.feather")
        city = find_city(self.path)
        map_frame = map_frame_of(city, offset_m, notes)
        notes.append("stamps count from an unknown moment: only their differences are known")
        upper_lidar_xy = mounts.get("up_lidar", np.eye(4))[:2, 3]
        swept_ns = streams["up_lidar"].t_ns if "up_lidar" in streams else np.zeros(0, dtype=np.int64)
        labels = self._labels(ego, upper_lidar_xy, swept_ns, notes)
        return Log(
            name=f"argoverse2-{self.path.resolve().name}",
            format=READER.name,
            cameras=cameras,
            lidars=lidars,
            streams=streams,
            ego=ego,
            ego_vehicle=EGO_VEHICLE,
            map=map_frame,
            labels=labels,
            ground_z_ego_m=ROAD_Z_EGO_M,
            reference_camera=REFERENCE_CAMERA if REFERENCE_CAMERA in cameras else None,
            digest=self._digest(),
            notes=defer_notes(notes, labels),
            calibrations={n: str(self.path / (INTRINSICS if n in cameras else MOUNTS)) for n in streams},
            details={"city": city},
        )

    def _labels(
        self, ego: PoseTrack, upper_lidar_xy: Array, swept_ns: NDArray[np.int64], notes: list[str]
    ) -> Callable[[], Labels | None]:
        """Return a function that reads the labels once."""
        path = self.path / ANNOTATIONS
        if not is_present(path):
            notes.append(f"no labels: {ANNOTATIONS} is missing, as in test splits")
            return lambda: None
        notes.append("objects were labeled only within 5 m of the drivable area")
        return cache(partial(read_labels, path, ego, upper_lidar_xy, swept_ns, notes))

    def _digest(self) -> str:
        index = [self.path / name for name in (POSES, MOUNTS, INTRINSICS) if (self.path / name).is_file()]
        records = sorted(self.path.glob("*.feather")) + sorted((self.path / "sensors").rglob("*.*"))
        return digest_of([read_file(p, LIMITS.file_bytes, LogError).hex() for p in index], records)

    def _lidars(self, mounts: dict[str, Array], notes: list[str]) -> tuple[dict[str, Lidar], dict[str, Stream]]:
        t_ns, files = stamped_files(self.path / "sensors" / "lidar", ".feather", notes)
        if not files:
            notes.append("no sweeps: sensors/lidar/ holds none")
            return {}, {}
        missing = [name for name in LIDARS if name not in mounts]
        if missing:
            raise LogError(f"{self.path / MOUNTS}: no sensor '{missing[0]}'; expected {', '.join(LIDARS)}")
        lidars = {name: Lidar(name, "ego", mounts[name]) for name in LIDARS}
        return lidars, {name: sweep_stream(name, t_ns, files, mounts[name]) for name in LIDARS}

    def _cameras(self, mounts: dict[str, Array], notes: list[str]) -> tuple[dict[str, Camera], dict[str, Stream]]:
        root = self.path / "sensors" / "cameras"
        found = {p.name: stamped_files(p, ".jpg", notes) for p in sorted(root.iterdir())} if root.is_dir() else {}
        found = {name: (t_ns, files) for name, (t_ns, files) in found.items() if files}
        path = self.path / INTRINSICS
        if not found or not is_present(path):
            notes.append(
                f"images of {len(found)} cameras left out: {INTRINSICS} is missing"
                if found
                else "no images: sensors/cameras/ holds none"
            )
            return {}, {}
        cameras, streams = _read_cameras(path, mounts), {}
        for name, (t_ns, files) in found.items():
            if name not in cameras:
                notes.append(f"images of '{name}' left out: it is not in {INTRINSICS} and {MOUNTS}")
                continue
            size_px = cameras[name].width_px, cameras[name].height_px
            streams[name] = image_stream(name, t_ns, files, size_px)
        without = sorted(set(cameras) - set(streams))
        if without:
            notes.append(f"no images of {', '.join(without)}")
        return {name: cameras[name] for name in streams}, streams


def _read_cameras(path: Path, mounts: dict[str, Array]) -> dict[str, Camera]:
    """Cameras of `intrinsics.feather` that have a mount. Its k1, k2, k3 are those of the lens, which the images lack."""
    columns = read_columns(path, INTRINSIC_COLUMNS)
    cameras = {}
    for row, name in enumerate(columns["sensor_name"]):
        values = {key: float(columns[key][row]) for key in INTRINSIC_COLUMNS if key != "sensor_name"}
        sizes = (values["width_px"], values["height_px"], values["fx_px"], values["fy_px"])
        if not np.isfinite(list(values.values())).all() or min(sizes) <= 0 or sizes[0] * sizes[1] > MAX_IMAGE_PX:
            raise LogError(f"{path}, row {row} ('{name}'): {values}, expected a size in px and focal lengths above 0")
        K = np.array([[values["fx_px"], 0, values["cx_px"]], [0, values["fy_px"], values["cy_px"]], [0, 0, 1.0]])
        if name in mounts:
            cameras[str(name)] = Camera(str(name), int(sizes[0]), int(sizes[1]), K, "ego", mounts[name])
    return cameras


def stamped_files(folder: Path, suffix: str, notes: list[str]) -> tuple[NDArray[np.int64], list[Path]]:
    """Files of a folder whose names are stamps in ns, in their order; other names are noted."""
    stamped = list_numbered_files(folder, (suffix,))
    others = len(list_files(folder, (suffix,))) - len(stamped)
    if others:
        notes.append(f"{folder.name}: {others} files left out, their names are no stamps of their own")
    return np.array(list(stamped), dtype=np.int64), list(stamped.values())
