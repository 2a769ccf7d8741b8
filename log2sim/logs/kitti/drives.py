"""KITTI raw drives and the layout of its tracking benchmark.

A file label_02.txt in the drive holds its labels in the format of the tracking benchmark, whose sequences are such drives
frame by frame (sequence 0000 is drive 2011_09_26_0005).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Stream
from log2sim.errors import LogError
from log2sim.files.inputs import require_links_inside
from log2sim.geometry import Camera, PoseTrack, transform
from log2sim.logs.excerpt import digest_of
from log2sim.logs.kitti.labels import (
    CAMERA,
    Calibration,
    Rig,
    drive_log,
    parse_oxts,
    poses_from_oxts,
    read_labels,
    read_text,
    sweep_stream,
)
from log2sim.logs.records import FolderReader, first_image_size, image_stream, list_numbered_files
from log2sim.logs.stamps import strictly_increasing

CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
REFERENCE_CAMERAS = ("image_02", "image_00", "image_03", "image_01")
PATTERN = "*_drive_*_sync"
PICTURES = (".png", ".jpg", ".jpeg")
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

    def find(self, path: Path) -> dict[str, Path]:
        """Find the drives at a folder by name."""
        # A drive given as "." has its name only once it is resolved.
        path = path.resolve()
        places = [path, *path.glob(PATTERN), *path.glob(f"*/{PATTERN}")]
        return {p.name: p for p in places if (p / "oxts" / "data").is_dir() and p.match(PATTERN)}

    def open(self, path: Path, sequence: str) -> Log:
        """Open a drive."""
        drive = self.find(path)[sequence]
        files = [drive.parent / name for name in CALIBRATION]
        require_links_inside(drive, drive.parent, path, files=files)
        cam, velo, imu = calibrations = [Calibration(file) for file in files]
        numbers = [k for k in range(4) if (drive / f"image_{k:02d}").is_dir()]
        rect = cam.rotation("R_rect_00")
        projections = {k: cam.projection(f"P_rect_{k:02d}") for k in numbers}
        velo_T_imu, cam_T_velo = (transform(c.rotation("R"), c.entry((3,), "T")) for c in (imu, velo))
        rig = Rig.of(velo_T_imu, cam_T_velo, rect, projections)
        notes: list[str] = []
        streams: dict[str, Stream] = {}
        cameras: dict[str, Camera] = {}
        for number in numbers:
            width, height = cam.entry((2,), f"S_rect_{number:02d}")
            camera = rig.camera(number, round(width), round(height))
            t_ns, images, _ = _records(drive / camera.name, PICTURES, notes)
            cameras[camera.name] = camera
            streams[camera.name] = image_stream(camera.name, t_ns, images, (camera.width_px, camera.height_px))
        if (drive / "velodyne_points").is_dir():
            streams["velodyne"] = _sweeps(drive / "velodyne_points", notes)
        ego_t_ns, oxts, _ = _records(drive / "oxts", (".txt",), notes)
        records = [parse_oxts(read_text(file), str(file)) for file in oxts]
        for file, record in zip(oxts, records):
            if len(record) != 1:
                raise LogError(f"{file}: {len(record)} lines, expected one oxts record")
        poses, map_frame = poses_from_oxts(np.concatenate(records))
        if not streams:
            raise LogError(f"{drive}: neither images (image_00 to image_03) nor velodyne_points in it")
        track = PoseTrack(ego_t_ns, poses)
        path, times = drive / "label_02.txt", drive / CAMERA / "timestamps.txt"

        def stamp_of(frame: NDArray[np.int64]) -> NDArray[np.int64]:
            stamps = _stamps(times)
            strange = frame[(frame < 0) | (frame >= len(stamps))]
            if len(strange):
                raise LogError(
                    f"{path}: frame {strange[0]}, but {times} has {len(stamps)} lines; is it of another drive?"
                )
            return stamps[frame]

        labels = read_labels(path, rig, track, stamp_of, notes)
        return drive_log(
            rig, cameras, streams, track, labels, name=drive.name, format=self.name, map=map_frame,
            reference_camera=next((c for c in REFERENCE_CAMERAS if c in cameras), None),
            digest=digest_of([*(c.text for c in calibrations), labels.text], sorted(drive.glob("*/data/*"))),
            notes=tuple(notes), calibrations={n: str(files[0 if n in cameras else 1]) for n in streams},
        )  # fmt: skip


READER = KittiRawReader()


def _sweeps(folder: Path, notes: list[str]) -> Stream:
    t_ns, files, numbers = _records(folder, (".bin",), notes)
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
    return sweep_stream(t_ns, begin, end, files)


def _records(
    folder: Path, suffixes: tuple[str, ...], notes: list[str]
) -> tuple[NDArray[np.int64], list[Path], NDArray[np.intp]]:
    """Stamps, files and numbers of the records of a stream, in order; a record that is not there is a gap."""
    files = _files(folder / "data", suffixes)
    stamps = _stamps(folder / "timestamps.txt")
    numbers = np.array(list(files))
    if len(stamps) <= numbers.max():
        raise LogError(f"{folder}/timestamps.txt: {len(stamps)} lines, record {numbers.max()} has none")
    missing = len(stamps) - len(numbers)
    if missing:
        first = np.setdiff1d(np.arange(len(stamps)), numbers)[0]
        notes.append(f"{folder.name}: {missing} of {len(stamps)} records are missing, first at stamp {stamps[first]}")
    numbers = numbers[strictly_increasing(stamps[numbers], folder.name, notes)]
    return stamps[numbers], [files[n] for n in numbers.tolist()], numbers


def _files(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    files = list_numbered_files(folder, suffixes)
    if not files:
        raise LogError(f"{folder}: no records ({', '.join(suffixes)}); a stream needs at least one")
    return files


def _stamps(path: Path) -> NDArray[np.int64]:
    lines = read_text(path).rstrip().split("\n")
    stamps = np.zeros(len(lines) if lines != [""] else 0, dtype=np.int64)
    for k, line in enumerate(line.strip() for line in lines[: len(stamps)]):
        try:
            if _TIME.fullmatch(line) is None:
                raise ValueError  # a date alone, of a line that was cut, would be a time
            stamps[k] = np.array([line.replace(" ", "T")], dtype="datetime64[ns]").astype(np.int64)[0]
        except ValueError:
            stamps[k] = _NOT_A_TIME
        if stamps[k] == _NOT_A_TIME:
            raise LogError(f"{path}, line {k + 1}: '{line[:40]}', expected YYYY-MM-DD HH:MM:SS.nnnnnnnnn")
    return stamps


PERIOD_NS = 100_000_000
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
        base = _base(path)
        require_links_inside(base, path)
        c = Calibration(base / "calib" / f"{sequence}.txt")
        numbers = [k for k in (2, 3) if (base / f"image_{k:02d}" / sequence).is_dir()]
        projections = {k: c.projection(f"P{k}") for k in numbers}
        rect = c.rotation("R0_rect", "R_rect")
        velo_T_imu, cam_T_velo = (c.rigid(f"Tr_{link}", f"Tr_{link.replace('to_', '')}") for link in LINKS)
        rig = Rig.of(velo_T_imu, cam_T_velo, rect, projections)
        cameras, streams = dict[str, Camera](), dict[str, Stream]()
        for number in numbers:
            files = _files(base / f"image_{number:02d}" / sequence, PICTURES)
            size_px = first_image_size(list(files.values()))
            camera = rig.camera(number, *size_px)
            cameras[camera.name] = camera
            streams[camera.name] = image_stream(camera.name, _nominal_stamps(files), list(files.values()), size_px)
        if (base / "velodyne" / sequence).is_dir():
            sweeps = _files(base / "velodyne" / sequence, (".bin",))
            t_ns, half = _nominal_stamps(sweeps), PERIOD_NS // 2
            streams["velodyne"] = sweep_stream(t_ns, t_ns - half, t_ns + half, list(sweeps.values()))
        oxts_file = base / "oxts" / f"{sequence}.txt"
        oxts = read_text(oxts_file)
        rows = parse_oxts(oxts, str(oxts_file))
        if not len(rows):
            raise LogError(f"{oxts_file}: no records; a stream needs at least one")
        poses, map_frame = poses_from_oxts(rows)
        track = PoseTrack(_nominal_stamps(range(len(rows))), poses)
        notes = [NO_STAMPS]
        for name, stream in streams.items():
            missing = np.setdiff1d(np.arange(len(rows)), stream.t_ns // PERIOD_NS)
            if len(missing):
                notes.append(
                    f"{name}: {len(missing)} of {len(rows)} records are missing, first number {missing[0]:06d}"
                )
        label_file = base / "label_02" / f"{sequence}.txt"
        labels = read_labels(label_file, rig, track, lambda frame: frame * PERIOD_NS, notes)
        records = sorted(p for folder in streams for p in (base / folder / sequence).iterdir())
        return drive_log(
            rig, cameras, streams, track, labels, name=f"kitti-tracking-{sequence}", format=self.name, map=map_frame,
            reference_camera="image_02", digest=digest_of([c.text, oxts, labels.text], records),
            notes=tuple(notes), calibrations=dict.fromkeys(streams, str(c.path)),
        )  # fmt: skip


TRACKING_READER = KittiTrackingReader()
LINKS = ("imu_to_velo", "velo_to_cam")


def _base(path: Path) -> Path:
    return path / "training" if (path / "training" / "calib").is_dir() else path


def _nominal_stamps(numbers: Iterable[int]) -> NDArray[np.int64]:
    return np.array(list(numbers), dtype=np.int64) * PERIOD_NS
