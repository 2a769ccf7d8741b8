"""PandaSet sequences: six cameras, a spinning Pandar64 and a forward PandarGT, points and poses in one world frame.

What the data set does not document was measured on sequence 002. The pose of a sweep has x right, y forward, z up, and its
origin is 0.325 m above the road (fit of the road within 15 m, 0.319 to 0.337 m over 40 sweeps), as the rear axle does. The Pandar64 turns
clockwise and passes the rear at the stamp of the sweep. The PandarGT keeps its own time, up to 90 ms away from the
Pandar64's, so that a moving car is at two positions in one file (up to 1 m apart); hence two streams. No index states the
times of the PandarGT: they are those of its points, so its stamps are read from all sweeps, but only when they are used.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, Labels, Lidar, Log, MapFrame, Stream
from log2sim.documents import JSON_LIMIT_BYTES, read_json
from log2sim.errors import LogError
from log2sim.geometry import (
    NS_PER_S,
    Array,
    Camera,
    PoseTrack,
    inverse,
    nearest_rotation,
    rotation_from_quaternion,
    transform,
)
from log2sim.input_files import is_present, read_text
from log2sim.links import require_links_inside
from log2sim.logs.digest import digest_of
from log2sim.logs.images import first_image_size, image_stream
from log2sim.logs.notes import defer_notes
from log2sim.logs.pandaset.labels import read_labels
from log2sim.logs.pandaset.sweeps import LIDARS, SweepFiles
from log2sim.logs.pose_checks import MAX_POSITION_M, find_not_unit
from log2sim.logs.record_files import list_folders, list_numbered_files
from log2sim.logs.stamps import MAX_TIME_S, strictly_increasing
from log2sim.logs.time_checks import Span, say_apart

TABLE = ".pkl.gz"
ROAD_BELOW_POSE_M = 0.325
# From the ego frame (x forward, y left, origin on the road) to the frame of the data set's poses.
POSE_T_EGO = transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), [0.0, 0.0, -ROAD_BELOW_POSE_M])
# Fit of azimuth over time (x, y) and of the vertical field of view, -25 to +15 degrees (z), of the Pandar64's points.
EGO_T_PANDAR64 = transform(np.eye(3), [0.75, 0.0, 1.8 + ROAD_BELOW_POSE_M])
# The mount of the PandarGT is not documented; its points are in the map already, so the mount only sets where its rays start.
# A Chrysler Pacifica, by its data sheet.
EGO_VEHICLE = EgoVehicle(size_m=(5.18, 2.02, 1.78), rear_axle_offset_m=1.45)

# Camera poses that scatter more about the mount do not fit the ego poses.
MAX_MOUNT_SPREAD_M = 0.05
MIN_GNSS_TRACK_M = 20.0
MAX_GNSS_ANGLE_RAD = np.radians(1.0)


class PandaSetReader:
    """Reader of PandaSet sequences; the root is a sequence or a folder of sequences."""

    name = "pandaset"
    looks_for = "a folder with lidar/poses.json and camera/, or a folder of such folders"
    suffixes = ()

    def matches(self, path: Path) -> bool:
        """Return whether the folder is a sequence or holds some."""
        return bool(self.sequences(path))

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the sequences, sorted."""
        if _is_sequence(path):
            return [path.resolve().name]
        return [p.name for p in list_folders(path) if _is_sequence(p)]

    def open(self, path: Path, sequence: str) -> Log:
        """Open a sequence; no sweep and no cuboid is read."""
        folder = path if _is_sequence(path) else path / sequence
        require_links_inside(folder, path)
        return _Sequence(folder).log()


READER = PandaSetReader()


def _is_sequence(path: Path) -> bool:
    return (path / "lidar" / "poses.json").is_file() and (path / "camera").is_dir()


@dataclass(frozen=True)
class _Sequence:
    path: Path

    def log(self) -> Log:
        notes: list[str] = []
        lidar_t_ns, map_T_pose = _poses(self.path / "lidar")
        map_T_ego = map_T_pose @ POSE_T_EGO
        keep, problems = strictly_increasing(lidar_t_ns, "lidar/timestamps.json")
        notes += problems
        track = PoseTrack(lidar_t_ns[keep], map_T_ego[keep])
        cameras, streams = self._cameras(track, notes)
        kept = set(keep.tolist())  # records whose stamp is far off have no place among the others
        files = self._files("lidar", TABLE, len(lidar_t_ns), notes)
        sweeps = SweepFiles({k: file for k, file in files.items() if k in kept}, lidar_t_ns, notes)
        lidars = {lidar: Lidar(lidar, "ego", EGO_T_PANDAR64) for lidar in (LIDARS if sweeps.files else ())}
        streams |= {lidar: sweeps.stream(lidar) for lidar in lidars}
        if not streams:
            raise LogError(f"{self.path}: neither images nor sweeps are there; a log needs at least one record")
        cuboids = list_numbered_files(self.path / "annotations" / "cuboids", (TABLE,))
        cuboids = {k: file for k, file in cuboids.items() if k in kept or k >= len(lidar_t_ns)}
        map_T_lidar = map_T_ego @ EGO_T_PANDAR64

        @cache
        def labels() -> Labels | None:
            return read_labels(cuboids, lidar_t_ns, sweeps.gt_stamps, map_T_lidar, notes) if cuboids else None

        return Log(
            name=f"pandaset-{self.path.resolve().name}",
            format=READER.name,
            cameras=cameras,
            lidars=lidars,
            streams=streams,
            ego=track,
            ego_vehicle=EGO_VEHICLE,
            map=self._map_frame(map_T_pose, notes),
            labels=labels,
            reference_camera="front_camera" if "front_camera" in cameras else None,
            digest=digest_of(
                [read_text(self.path / "lidar" / "poses.json", JSON_LIMIT_BYTES, LogError)], self._records()
            ),
            calibrations={n: f"{self.path}/camera/{n}/intrinsics.json" for n in cameras},
            notes=defer_notes(notes, *(partial(sweeps.index, lidar) for lidar in lidars), labels),
        )

    def _records(self) -> list[Path]:
        return sorted(self.path.glob(f"*/*{TABLE}")) + sorted(self.path.glob("*/*/*.*"))

    def _files(self, folder: str, suffix: str, count: int, notes: list[str]) -> dict[int, Path]:
        """Find the records of a sensor by their number and note missing ones: they are gaps."""
        found = list_numbered_files(self.path / folder, (suffix,))
        files = {k: p for k, p in found.items() if k < count}
        if len(files) < len(found):
            notes.append(
                f"{folder}: {len(found) - len(files)} of {len(found)} records left out: there are stamps for {count}"
            )
        missing = sorted(set(range(count)) - set(files))
        if missing:
            notes.append(f"{folder}: {len(missing)} of {count} records are missing, first number {missing[0]:02d}")
        return files

    def _cameras(self, track: PoseTrack, notes: list[str]) -> tuple[dict[str, Camera], dict[str, Stream]]:
        cameras, streams = {}, {}
        for folder in list_folders(self.path / "camera"):
            if not is_present(folder / "intrinsics.json"):
                images = len(list_numbered_files(folder, (".jpg",)))
                if images:
                    notes.append(f"camera/{folder.name}: {images} images left out: it has no intrinsics.json")
                continue
            t_ns, map_T_cam = _poses(folder)
            files = self._files(f"camera/{folder.name}", ".jpg", len(t_ns), notes)
            if not files:
                continue
            width, height = first_image_size(list(files.values()))
            camera = Camera(
                folder.name, width, height, _intrinsics(folder), "ego", _mount(track, t_ns, map_T_cam, folder, notes)
            )
            numbers = np.array(list(files))
            keep, problems = strictly_increasing(t_ns[numbers], folder.name)
            notes += problems
            t_ns = t_ns[numbers[keep]]
            cameras[camera.name] = camera
            chosen = [files[int(n)] for n in numbers[keep]]
            streams[camera.name] = image_stream(camera.name, t_ns, chosen, (width, height))
        if not cameras:
            notes.append(
                "no images: camera/ has no folder with intrinsics.json, poses.json, timestamps.json and images"
            )
        return cameras, streams

    def _map_frame(self, map_T_pose: Array, notes: list[str]) -> MapFrame:
        """Georeference the map where the GNSS track is long enough to show that its axes are east and north."""
        path = self.path / "meta" / "gps.json"
        if not is_present(path):
            return MapFrame()
        fixes = read_json(path)
        try:
            geodetic = np.array([[f["lat"], f["long"], f["height"]] for f in fixes], dtype=np.float64).reshape(-1, 3)
        except (TypeError, KeyError, ValueError):
            raise LogError(f"{path}: expected a list of records with lat, long and height") from None
        if not len(geodetic) or not np.isfinite(geodetic).all() or np.abs(geodetic[:, 0]).max() >= 90:
            notes.append("meta/gps.json holds no usable fixes: the position of the map is unknown")
            return MapFrame()
        frame, reason = georeference(geodetic, map_T_pose[: len(geodetic), :3, 3], str(path))
        if reason:
            notes.append(f"{reason}: the map is only local and its north is not known")
        return frame


def georeference(geodetic: Array, xyz_map: Array, where: str) -> tuple[MapFrame, str]:
    """Map frame of GNSS fixes (N, 3) in deg and m at positions (N, 3) in the map, and why it has no projection if so; `where` names the fixes in errors.

    The map's axes count as east and north only if the track reaches 20 m and the best rotation is below 1 degree.
    """
    from log2sim.logs.geodesy import geodetic_from_map, poses_from_geodetic, transverse_mercator

    n = min(len(geodetic), len(xyz_map))
    latitude, longitude, altitude = (float(v) for v in geodetic[0])
    local = MapFrame(latitude, longitude, altitude)
    if np.linalg.norm(np.ptp(xyz_map[:, :2], axis=0)) < MIN_GNSS_TRACK_M:
        return local, f"the ego moves less than {MIN_GNSS_TRACK_M:g} m"
    first = MapFrame(latitude, longitude, altitude, transverse_mercator(latitude, longitude))
    east_north = poses_from_geodetic(first, geodetic[:n], np.zeros((n, 3)), where=where)[:, :2, 3]
    a, b = xyz_map[:n, :2] - xyz_map[:n, :2].mean(0), east_north - east_north.mean(0)
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    if abs(turn) > MAX_GNSS_ANGLE_RAD:
        return local, f"GNSS and map differ by {np.degrees(turn):.1f} degrees"
    shift = np.append(
        east_north.mean(0) - xyz_map[:n, :2].mean(0), np.mean(geodetic[:n, 2] - altitude - xyz_map[:n, 2])
    )
    origin = [float(v[0]) for v in geodetic_from_map(first, shift[None], where)]
    return MapFrame(origin[0], origin[1], origin[2], transverse_mercator(origin[0], origin[1])), ""


def _poses(folder: Path) -> tuple[NDArray[np.int64], Array]:
    """Stamps (N,) int64 ns and poses (N, 4, 4) of a sensor in the world."""
    stamps, poses = read_json(folder / "timestamps.json"), read_json(folder / "poses.json")
    if not isinstance(stamps, list) or not isinstance(poses, list) or len(stamps) != len(poses) or not stamps:
        raise LogError(f"{folder}: timestamps.json and poses.json must be lists of the same length, and not empty")
    try:
        q = np.array([[p["heading"][k] for k in "wxyz"] for p in poses], dtype=np.float64)
        position = np.array([[p["position"][k] for k in "xyz"] for p in poses], dtype=np.float64)
    except (TypeError, KeyError, ValueError) as problem:
        raise LogError(
            f"{folder}/poses.json: expected records of position x, y, z and heading w, x, y, z: {problem}"
        ) from None
    wrong = np.flatnonzero(~(np.abs(position) <= MAX_POSITION_M).all(axis=1))
    if len(wrong):
        raise LogError(
            f"{folder}/poses.json: record {wrong[0]}: position {position[wrong[0]].tolist()}, expected finite numbers up to "
            f"{MAX_POSITION_M:g} m"
        )
    bad = find_not_unit(q)
    if len(bad):
        raise LogError(
            f"{folder}/poses.json: record {bad[0]}: heading {q[bad[0]].tolist()}, expected a unit quaternion"
        )
    return _stamps_ns(stamps, folder / "timestamps.json"), transform(rotation_from_quaternion(q), position)


def _stamps_ns(stamps: list[Any], path: Path) -> NDArray[np.int64]:
    """Return stamps (N,) int64 ns of what a file states, in s."""
    for k, stamp in enumerate(stamps):
        if not isinstance(stamp, (int, float)) or isinstance(stamp, bool) or not abs(stamp) < MAX_TIME_S:
            raise LogError(f"{path}: record {k}: {str(stamp)[:40]!a}, expected a stamp in seconds below {MAX_TIME_S:g}")
    return np.round(np.array(stamps, dtype=np.float64) * NS_PER_S).astype(np.int64)


def _intrinsics(folder: Path) -> Array:
    path = folder / "intrinsics.json"
    try:
        fx, fy, cx, cy = (float(read_json(path)[k]) for k in ("fx", "fy", "cx", "cy"))
    except (TypeError, KeyError, ValueError):
        raise LogError(f"{path}: expected the numbers fx, fy, cx, cy") from None
    if fx <= 0 or fy <= 0:
        raise LogError(f"{path}: fx {fx:g}, fy {fy:g}, expected focal lengths above 0")
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _mount(track: PoseTrack, t_ns: NDArray[np.int64], map_T_cam: Array, folder: Path, notes: list[str]) -> Array:
    """Mount `ego_T_cam` (4, 4) of a camera from its poses in the world: medians over its frames.

    Notes
    -----
    With the ego interpolated at the camera's own stamps, single frames of sequence 002 differ from it by 1 to 5 mm and
    0.006 to 0.027 degrees (RMS by camera); with the pose of the sweep of the same number it would be up to 96 mm.
    """
    map_T_ego, known = track.at(t_ns)
    if not known.any():
        apart = say_apart(Span.of("ego poses", track.t_ns), Span.of("frames", t_ns))
        raise LogError(f"{folder}/timestamps.json and lidar/timestamps.json: {apart}")
    ego_T_cam = inverse(map_T_ego[known]) @ map_T_cam[known]
    translation = np.median(ego_T_cam[:, :3, 3], axis=0)
    rotation = nearest_rotation(np.median(ego_T_cam[:, :3, :3], axis=0))
    spread_m = float(np.median(np.linalg.norm(ego_T_cam[:, :3, 3] - translation, axis=1)))
    if spread_m > MAX_MOUNT_SPREAD_M:
        notes.append(f"{folder.name}: its poses and the ego's do not fit together, typically by {spread_m:.2f} m")
    return transform(rotation, translation)
