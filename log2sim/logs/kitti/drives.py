"""KITTI raw drives and the layout of its tracking benchmark.

A file label_02.txt in the drive holds its labels in the format of the tracking benchmark, whose sequences are such drives
frame by frame (sequence 0000 is drive 2011_09_26_0005).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Stream
from log2sim.errors import LogError
from log2sim.files.inputs import is_present, require_links_inside
from log2sim.geometry import Array, Camera, PoseTrack, transform
from log2sim.logs.excerpt import digest_of
from log2sim.logs.kitti import labels as drive
from log2sim.logs.kitti.labels import CAMERA as LABELED_CAMERA
from log2sim.logs.kitti.labels import DriveLabels, read_labels
from log2sim.logs.records import FolderReader, first_image_size, image_stream, list_numbered_files
from log2sim.logs.stamps import strictly_increasing

CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
REFERENCE_CAMERAS = ("image_02", "image_00", "image_03", "image_01")
PATTERN = "*_drive_*_sync"
LABELS = "label_02.txt"
# A scanner begins a sweep where the one before ends; stamps of this share of a sweep are none that a clock's resolution explains.
MAX_OVERLAP = 0.1
_NOT_A_TIME = np.iinfo(np.int64).min
_TIME = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2} [0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]{1,9})?")


class KittiRawReader(FolderReader):
    """Reader of KITTI raw drives; the root is a drive, its date folder or the parent of date folders."""

    name = "kitti"
    looks_for = (
        "a folder DATE_drive_NNNN_sync with oxts/data, its date folder with calib_cam_to_cam.txt, or their parent"
    )

    def open(self, path: Path, sequence: str) -> Log:
        """Open a sequence."""
        drive = self.find(path)[sequence]
        require_links_inside(drive, drive.parent, path, files=[drive.parent / name for name in CALIBRATION])
        return _Drive(drive).log()

    def find(self, path: Path) -> dict[str, Path]:
        """Find the drives at a folder by name."""
        # A drive given as "." has its name only once it is resolved.
        path = path.resolve()
        places = [path, *path.glob(PATTERN), *path.glob(f"*/{PATTERN}")]
        return {p.name: p for p in places if (p / "oxts" / "data").is_dir() and p.match(PATTERN)}


READER = KittiRawReader()


@dataclass(frozen=True)
class _Drive:
    path: Path

    def log(self) -> Log:
        cam, velo, imu = (self.path.parent / name for name in CALIBRATION)
        c = drive.read_calibration(cam)
        numbers = [k for k in range(4) if (self.path / f"image_{k:02d}").is_dir()]
        rect = drive.rotation_entry(c, cam, "R_rect_00")
        projections = {k: drive.projection_entry(c, cam, f"P_rect_{k:02d}") for k in numbers}
        rig = drive.rig_of(_rigid(imu), _rigid(velo), rect, projections)
        notes: list[str] = []
        streams: dict[str, Stream] = {}
        cameras: dict[str, Camera] = {}
        for number in numbers:
            width, height = drive.calibration_entry(c, cam, (2,), f"S_rect_{number:02d}")
            camera = rig.camera(number, round(width), round(height))
            t_ns, files, _ = self._records(camera.name, (".png", ".jpg", ".jpeg"), notes)
            cameras[camera.name] = camera
            streams[camera.name] = image_stream(camera.name, t_ns, files, (camera.width_px, camera.height_px))
        if (self.path / "velodyne_points").is_dir():
            streams["velodyne"] = self._sweeps(notes)
        ego_t_ns, oxts, _ = self._records("oxts", (".txt",), notes)
        records = [drive.parse_oxts(drive.read_text(file), str(file)) for file in oxts]
        for file, record in zip(oxts, records):
            if len(record) != 1:
                raise LogError(f"{file}: {len(record)} lines, expected one oxts record")
        poses, map_frame = drive.poses_from_oxts(np.concatenate(records))
        if not streams:
            raise LogError(f"{self.path}: neither images (image_00 to image_03) nor velodyne_points in it")
        track = PoseTrack(ego_t_ns, poses)
        labels = self._labels(rig, track, notes)
        texts = [drive.read_text(self.path.parent / name) for name in CALIBRATION]
        return Log(
            name=self.path.name,
            format=READER.name,
            cameras=cameras,
            lidars={"velodyne": rig.lidar()} if "velodyne" in streams else {},
            streams=streams,
            ego=track,
            ego_vehicle=drive.EGO_VEHICLE,
            map=map_frame,
            labels=labels.boxes_3d,
            image_labels=labels.boxes_2d,
            ignored_regions=labels.ignored,
            reference_camera=next((c for c in REFERENCE_CAMERAS if c in cameras), None),
            digest=digest_of([*texts, labels.text], sorted(self.path.glob("*/data/*"))),
            notes=tuple(notes),
            calibrations={n: str(self.path.parent / CALIBRATION[0 if n in cameras else 1]) for n in streams},
        )

    def _sweeps(self, notes: list[str]) -> Stream:
        folder = self.path / "velodyne_points"
        t_ns, files, numbers = self._records(folder.name, (".bin",), notes)
        begin, end = (_stamps(folder / f"timestamps_{k}.txt") for k in ("start", "end"))
        for name, stamps in (("start", begin), ("end", end)):
            if len(stamps) <= numbers.max():
                raise LogError(f"{folder}/timestamps_{name}.txt: {len(stamps)} lines, record {numbers.max()} has none")
        begin, end = begin[numbers], end[numbers]
        wrong = np.flatnonzero((begin > t_ns) | (end < t_ns))
        early = np.flatnonzero(end[:-1] - begin[1:] > MAX_OVERLAP * (end - begin)[:-1]) + 1
        for rows, what in (
            (wrong, "face forward at a stamp before their start or after their end"),
            (early, "begin while the one before still turns"),
        ):
            if len(rows):
                notes.append(
                    f"{folder.name}: {len(rows)} of {len(numbers)} sweeps {what}, first number {numbers[rows[0]]:010d}; check "
                    "timestamps_start.txt and timestamps_end.txt"
                )
        return drive.sweep_stream(t_ns, begin, end, files)

    def _labels(self, rig: drive.Rig, track: PoseTrack, notes: list[str]) -> DriveLabels:
        path, times = self.path / LABELS, self.path / LABELED_CAMERA / "timestamps.txt"
        if not is_present(path):
            return DriveLabels()
        stamps = _stamps(times)

        def stamp_of(frame: NDArray[np.int64]) -> NDArray[np.int64]:
            strange = frame[(frame < 0) | (frame >= len(stamps))]
            if len(strange):
                raise LogError(
                    f"{path}: frame {strange[0]}, but {times} has {len(stamps)} lines; is it of another drive?"
                )
            return stamps[frame]

        return read_labels(path, rig, track, stamp_of, notes)

    def _records(
        self, name: str, suffixes: tuple[str, ...], notes: list[str]
    ) -> tuple[NDArray[np.int64], list[Path], NDArray[np.intp]]:
        """Stamps, files and numbers of the records of a stream, in order; a record that is not there is a gap."""
        folder = self.path / name
        files = list_numbered_files(folder / "data", suffixes)
        if not files:
            raise LogError(f"{folder}/data: no records ({', '.join(suffixes)}); a stream needs at least one")
        stamps = _stamps(folder / "timestamps.txt")
        numbers = np.array(list(files))
        if len(stamps) <= numbers.max():
            raise LogError(f"{folder}/timestamps.txt: {len(stamps)} lines, record {numbers.max()} has none")
        missing = len(stamps) - len(numbers)
        if missing:
            first = np.setdiff1d(np.arange(len(stamps)), numbers)[0]
            notes.append(f"{name}: {missing} of {len(stamps)} records are missing, first at stamp {stamps[first]}")
        keep = strictly_increasing(stamps[numbers], name, notes)
        numbers = numbers[keep]
        return stamps[numbers], [files[n] for n in numbers.tolist()], numbers


def _rigid(path: Path) -> Array:
    calibration = drive.read_calibration(path)
    return transform(
        drive.rotation_entry(calibration, path, "R"), drive.calibration_entry(calibration, path, (3,), "T")
    )


def _stamps(path: Path) -> NDArray[np.int64]:
    lines = drive.read_text(path).split("\n")
    while lines and not lines[-1].strip():
        lines.pop()
    stamps = np.zeros(len(lines), dtype=np.int64)
    for k, line in enumerate(lines):
        try:
            if _TIME.fullmatch(line.strip()) is None:
                raise ValueError  # a date alone, of a line that was cut, would be a time
            stamps[k] = np.array([line.strip().replace(" ", "T")], dtype="datetime64[ns]").astype(np.int64)[0]
        except ValueError:
            stamps[k] = _NOT_A_TIME
        if stamps[k] == _NOT_A_TIME:
            raise LogError(f"{path}, line {k + 1}: '{line.strip()[:40]}', expected YYYY-MM-DD HH:MM:SS.nnnnnnnnn")
    return stamps


PERIOD_NS = 100_000_000
CAMERA_NUMBERS = (2, 3)
NO_STAMPS = "this layout has no stamps: 10 Hz is assumed for all streams, frame 0 at stamp 0"


class KittiTrackingReader(FolderReader):
    """Reader of the tracking layout; the root is the folder "training" or its parent."""

    name = "kitti-tracking"
    looks_for = "a folder training/ (or that folder) with calib/NNNN.txt and image_02/NNNN/"

    def find(self, path: Path) -> dict[str, Path]:
        """Find the calibrations of sequences at a folder by name."""
        base = _base(path)
        return {p.stem: p for p in (base / "calib").glob("*.txt") if (base / "image_02" / p.stem).is_dir()}

    def open(self, path: Path, sequence: str) -> Log:
        """Open a sequence."""
        require_links_inside(_base(path), path)
        return _Sequence(_base(path), sequence).log()


TRACKING_READER = KittiTrackingReader()


def _base(path: Path) -> Path:
    return path / "training" if (path / "training" / "calib").is_dir() else path


@dataclass(frozen=True)
class _Sequence:
    base: Path
    name: str

    def log(self) -> Log:
        path = self.base / "calib" / f"{self.name}.txt"
        c = drive.read_calibration(path)
        numbers = [k for k in CAMERA_NUMBERS if (self.base / f"image_{k:02d}" / self.name).is_dir()]
        projections = {k: drive.projection_entry(c, path, f"P{k}") for k in numbers}
        rect = drive.rotation_entry(c, path, "R0_rect", "R_rect")
        keys = (("Tr_imu_to_velo", "Tr_imu_velo"), ("Tr_velo_to_cam", "Tr_velo_cam"))
        velo_T_imu, cam_T_velo = (drive.rigid_entry(c, path, *names) for names in keys)
        rig = drive.rig_of(velo_T_imu, cam_T_velo, rect, projections)
        cameras, streams = dict[str, Camera](), dict[str, Stream]()
        for number in numbers:
            files = self._files(f"image_{number:02d}", (".png", ".jpg", ".jpeg"))
            size_px = first_image_size(list(files.values()))
            camera = rig.camera(number, *size_px)
            cameras[camera.name] = camera
            streams[camera.name] = image_stream(camera.name, _nominal_stamps(files), list(files.values()), size_px)
        if (self.base / "velodyne" / self.name).is_dir():
            sweeps = self._files("velodyne", (".bin",))
            t_ns = _nominal_stamps(sweeps)
            streams["velodyne"] = drive.sweep_stream(
                t_ns, t_ns - PERIOD_NS // 2, t_ns + PERIOD_NS // 2, list(sweeps.values())
            )
        oxts_file = self.base / "oxts" / f"{self.name}.txt"
        oxts = drive.read_text(oxts_file)
        rows = drive.parse_oxts(oxts, str(oxts_file))
        if not len(rows):
            raise LogError(f"{oxts_file}: no records; a stream needs at least one")
        poses, map_frame = drive.poses_from_oxts(rows)
        track = PoseTrack(np.arange(len(rows), dtype=np.int64) * PERIOD_NS, poses)
        notes = [NO_STAMPS]
        for name, stream in streams.items():
            missing = np.setdiff1d(np.arange(len(rows)), stream.t_ns // PERIOD_NS)
            if len(missing):
                notes.append(
                    f"{name}: {len(missing)} of {len(rows)} records are missing, first number {missing[0]:06d}"
                )
        label_file, labels = self.base / "label_02" / f"{self.name}.txt", DriveLabels()
        if is_present(label_file):
            labels = read_labels(label_file, rig, track, lambda frame: frame * PERIOD_NS, notes)
        files_of_records = sorted(p for folder in streams for p in (self.base / folder / self.name).iterdir())
        return Log(
            name=f"kitti-tracking-{self.name}",
            format=TRACKING_READER.name,
            cameras=cameras,
            lidars={"velodyne": rig.lidar()} if "velodyne" in streams else {},
            streams=streams,
            ego=track,
            ego_vehicle=drive.EGO_VEHICLE,
            map=map_frame,
            labels=labels.boxes_3d,
            image_labels=labels.boxes_2d,
            ignored_regions=labels.ignored,
            reference_camera="image_02",
            digest=digest_of([drive.read_text(path), oxts, labels.text], files_of_records),
            notes=tuple(notes),
            calibrations=dict.fromkeys(streams, str(path)),
        )

    def _files(self, folder: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
        files = list_numbered_files(self.base / folder / self.name, suffixes)
        if not files:
            raise LogError(
                f"{self.base / folder / self.name}: no records ({', '.join(suffixes)}); a stream needs at least one"
            )
        return files


def _nominal_stamps(files: dict[int, Path]) -> NDArray[np.int64]:
    return np.array(list(files), dtype=np.int64) * PERIOD_NS
