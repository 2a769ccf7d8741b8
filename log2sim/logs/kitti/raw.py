"""KITTI raw drives (synchronized and rectified): DATE/DATE_drive_NNNN_sync with the calibration in DATE.

A file label_02.txt in the drive holds its labels in the format of the tracking benchmark, whose sequences are such drives
frame by frame (sequence 0000 is drive 2011_09_26_0005).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, MapFrame, Stream
from log2sim.errors import LogError
from log2sim.geometry import Array, Camera, PoseTrack, transform
from log2sim.input_files import is_present
from log2sim.links import require_links_inside
from log2sim.logs.digest import digest_of
from log2sim.logs.images import image_stream
from log2sim.logs.kitti import drive
from log2sim.logs.kitti.labels import CAMERA as LABELED_CAMERA
from log2sim.logs.kitti.labels import DriveLabels, read_labels
from log2sim.logs.record_files import list_numbered_files
from log2sim.logs.stamps import strictly_increasing

CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
REFERENCE_CAMERAS = ("image_02", "image_00", "image_03", "image_01")
PATTERN = "*_drive_*_sync"
LABELS = "label_02.txt"
# A scanner begins a sweep where the one before ends; stamps of this share of a sweep are none that a clock's resolution explains.
MAX_OVERLAP = 0.1
_NOT_A_TIME = np.iinfo(np.int64).min
_TIME = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2} [0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]{1,9})?")


class KittiRawReader:
    """Reader of KITTI raw drives; the root is a drive, its date folder or the parent of date folders."""

    name = "kitti"
    looks_for = (
        "a folder DATE_drive_NNNN_sync with oxts/data, its date folder with calib_cam_to_cam.txt, or their parent"
    )
    suffixes = ()

    def matches(self, path: Path) -> bool:
        """Return whether the folder holds a sequence of this layout."""
        return bool(self._drives(path))

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the sequences, sorted."""
        return sorted(self._drives(path))

    def open(self, path: Path, sequence: str) -> Log:
        """Open a sequence."""
        drive = self._drives(path)[sequence]
        require_links_inside(drive, drive.parent, path, files=[drive.parent / name for name in CALIBRATION])
        return _Drive(drive).log()

    def _drives(self, path: Path) -> dict[str, Path]:
        # A drive given as "." has its name only once it is resolved.
        path = path.resolve()
        places = [path, *path.glob(PATTERN), *path.glob(f"*/{PATTERN}")]
        return {p.name: p for p in places if (p / "oxts" / "data").is_dir() and p.match(PATTERN)}


READER = KittiRawReader()


@dataclass(frozen=True)
class _Drive:
    path: Path

    def log(self) -> Log:
        rig = self._rig()
        notes: list[str] = []
        streams: dict[str, Stream] = {}
        cameras: dict[str, Camera] = {}
        for number in rig.projections:
            self._add_camera(rig, number, cameras, streams, notes)
        if (self.path / "velodyne_points").is_dir():
            streams["velodyne"] = self._sweeps(notes)
        ego_t_ns, poses, map_frame = self._poses(notes)
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

    def _rig(self) -> drive.Rig:
        cam, velo, imu = (self.path.parent / name for name in CALIBRATION)
        c = drive.read_calibration(cam)
        rect = drive.checked_rotation(drive.calibration_entry(c, cam, (3, 3), "R_rect_00"), f"{cam}, entry 'R_rect_00'")
        projections = {}
        for k in range(4):
            if (self.path / f"image_{k:02d}").is_dir():
                key = f"P_rect_{k:02d}"
                projections[k] = drive.checked_projection(
                    drive.calibration_entry(c, cam, (3, 4), key), f"{cam}, entry '{key}'"
                )
        return drive.rig_of(_rigid(imu), _rigid(velo), rect, projections)

    def _add_camera(
        self, rig: drive.Rig, number: int, cameras: dict[str, Camera], streams: dict[str, Stream], notes: list[str]
    ) -> None:
        file = self.path.parent / CALIBRATION[0]
        width, height = drive.calibration_entry(drive.read_calibration(file), file, (2,), f"S_rect_{number:02d}")
        camera = rig.camera(number, round(width), round(height))
        t_ns, files, _ = self._records(camera.name, (".png", ".jpg", ".jpeg"), notes)
        cameras[camera.name] = camera
        streams[camera.name] = image_stream(camera.name, t_ns, files, (camera.width_px, camera.height_px))

    def _sweeps(self, notes: list[str]) -> Stream:
        folder = self.path / "velodyne_points"
        t_ns, files, numbers = self._records(folder.name, (".bin",), notes)
        begin, end = (_stamps(folder / f"timestamps_{k}.txt") for k in ("start", "end"))
        for name, stamps in (("start", begin), ("end", end)):
            if len(stamps) <= numbers.max():
                raise LogError(f"{folder}/timestamps_{name}.txt: {len(stamps)} lines, record {numbers.max()} has none")
        wrong = np.flatnonzero((begin[numbers] > t_ns) | (end[numbers] < t_ns))
        if len(wrong):
            notes.append(
                f"{folder.name}: {len(wrong)} of {len(numbers)} sweeps face forward at a stamp before their start or after their end, "
                f"first number {numbers[wrong[0]]:010d}; check timestamps_start.txt and timestamps_end.txt"
            )
        begin, end = begin[numbers], end[numbers]
        early = np.flatnonzero(end[:-1] - begin[1:] > MAX_OVERLAP * (end - begin)[:-1]) + 1
        if len(early):
            notes.append(
                f"{folder.name}: {len(early)} of {len(numbers)} sweeps begin while the one before still turns, first number "
                f"{numbers[early[0]]:010d}; check timestamps_start.txt and timestamps_end.txt"
            )
        return drive.sweep_stream(t_ns, begin, end, files)

    def _poses(self, notes: list[str]) -> tuple[NDArray[np.int64], Array, MapFrame]:
        t_ns, files, _ = self._records("oxts", (".txt",), notes)
        rows = []
        for file in files:
            record = drive.parse_oxts(drive.read_text(file), str(file))
            if len(record) != 1:
                raise LogError(f"{file}: {len(record)} lines, expected one oxts record")
            rows.append(record[0])
        poses, map_frame = drive.poses_from_oxts(np.array(rows))
        return t_ns, poses, map_frame

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
        keep, problems = strictly_increasing(stamps[numbers], name)
        notes += problems
        numbers = numbers[keep]
        return stamps[numbers], [files[n] for n in numbers.tolist()], numbers


def _rigid(path: Path) -> Array:
    calibration = drive.read_calibration(path)
    rotation = drive.checked_rotation(drive.calibration_entry(calibration, path, (3, 3), "R"), f"{path}, entry 'R'")
    return transform(rotation, drive.calibration_entry(calibration, path, (3,), "T"))


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
