"""KITTI raw drives and the layout of its tracking benchmark.

A file label_02.txt in the drive holds its labels in the format of the tracking benchmark, whose sequences are such drives
frame by frame (sequence 0000 is drive 2011_09_26_0005). The layout of its object detection benchmark, training/{image_2, velodyne,
calib, label_2}, has single frames: those of a split become one log, in which the ego stands still and a frame is taken every 100 s,
so that nothing connects them: a log to detect in and to evaluate with, not to track in.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Stream, Sweep
from log2sim.errors import LogError
from log2sim.files.inputs import is_present, require_links_inside
from log2sim.geometry import Array, Camera, PoseTrack, apply, inverse, transform
from log2sim.logs.excerpt import digest_of
from log2sim.logs.kitti import labels as kitti_labels
from log2sim.logs.records import FolderReader, first_image_size, image_stream, list_numbered_files, read_sweep, sweep_of
from log2sim.logs.stamps import note_damaged_rows, strictly_increasing

CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
REFERENCE_CAMERAS = ("image_02", "image_00", "image_03", "image_01")
PATTERN = "*_drive_*_sync"
PICTURES = (".png", ".jpg", ".jpeg")
# A scanner begins a sweep where the one before ends; stamps of this share of a sweep are none that a clock's resolution explains.
MAX_OVERLAP = 0.1
_TIME = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2} [0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]{1,9})?")


class KittiRawReader(FolderReader):
    """Reader of KITTI raw drives; the root is a drive, its date folder or the parent of date folders."""

    name = "kitti"
    looks_for = "a folder DATE_drive_NNNN_sync with oxts/data, its date folder with calib_cam_to_cam.txt, or its parent"

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
        cam, velo, imu = calibrations = [kitti_labels.Calibration(file) for file in files]
        numbers = [k for k in range(4) if (drive / f"image_{k:02d}").is_dir()]
        rect = cam.rotation("R_rect_00")
        projections = {k: cam.projection(f"P_rect_{k:02d}") for k in numbers}
        velo_T_imu, cam_T_velo = (transform(c.rotation("R"), c.entry((3,), "T")) for c in (imu, velo))
        rig = kitti_labels.Rig.of(velo_T_imu, cam_T_velo, rect, projections)
        notes = list[str]()
        cameras, streams = dict[str, Camera](), dict[str, Stream]()
        for number in numbers:
            width, height = (round(v) for v in cam.entry((2,), f"S_rect_{number:02d}"))
            camera = rig.camera(number, width, height)
            t_ns, images, _ = _records(drive / camera.name, PICTURES, notes)
            cameras[camera.name] = camera
            streams[camera.name] = image_stream(camera.name, t_ns, images, (width, height))
        if (drive / "velodyne_points").is_dir():
            streams["velodyne"] = _sweeps(drive / "velodyne_points", notes)
        ego_t_ns, oxts, _ = _records(drive / "oxts", (".txt",), notes)
        records = [kitti_labels.parse_oxts(kitti_labels.read_text(file), str(file)) for file in oxts]
        for file, record in zip(oxts, records):
            if len(record) != 1:
                raise LogError(f"{file}: {len(record)} lines, expected one oxts record")
        poses, map_frame = kitti_labels.poses_from_oxts(np.concatenate(records))
        if not streams:
            raise LogError(f"{drive}: neither images (image_00 to image_03) nor velodyne_points in it")
        track = PoseTrack(ego_t_ns, poses)
        path, times = drive / "label_02.txt", drive / kitti_labels.CAMERA / "timestamps.txt"

        def stamp_of(frame: NDArray[np.int64]) -> NDArray[np.int64]:
            stamps = _stamps(times)
            strange = frame[(frame < 0) | (frame >= len(stamps))]
            if len(strange):
                has = f"{times} has {len(stamps)} lines"
                raise LogError(f"{path}: frame {strange[0]}, but {has}; is it of another drive?")
            return stamps[frame]

        labels = kitti_labels.read_labels(path, rig, track, stamp_of, notes)
        return kitti_labels.drive_log(
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
            count, advice = f"{len(rows)} of {len(numbers)}", "check timestamps_start.txt and timestamps_end.txt"
            notes.append(f"{folder.name}: {count} sweeps {what}, first number {numbers[rows[0]]:010d}; {advice}")
    return kitti_labels.sweep_stream(t_ns, begin, end, files)


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
    text = kitti_labels.read_text(path).rstrip()
    stamps = list[Any]()
    for k, line in enumerate(map(str.strip, text.split("\n") if text else ()), start=1):
        # A date alone, of a line that was cut, would be a time.
        whole = _TIME.fullmatch(line) is not None
        try:
            stamps.append(np.datetime64(line.replace(" ", "T") if whole else "NaT", "ns"))
        except (ValueError, OverflowError):
            stamps.append(np.datetime64("NaT"))
        if np.isnat(stamps[-1]):
            raise LogError(f"{path}, line {k}: '{line[:40]}', expected YYYY-MM-DD HH:MM:SS.nnnnnnnnn")
    return np.array(stamps, dtype="datetime64[ns]").astype(np.int64)


PERIOD_NS = 100_000_000


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
        c = kitti_labels.Calibration(base / "calib" / f"{sequence}.txt")
        numbers = [k for k in (2, 3) if (base / f"image_{k:02d}" / sequence).is_dir()]
        projections = {k: c.projection(f"P{k}") for k in numbers}
        rect = c.rotation("R0_rect", "R_rect")
        velo_T_imu, cam_T_velo = c.rigid("Tr_imu_to_velo", "Tr_imu_velo"), c.rigid("Tr_velo_to_cam", "Tr_velo_cam")
        rig = kitti_labels.Rig.of(velo_T_imu, cam_T_velo, rect, projections)
        cameras, streams = dict[str, Camera](), dict[str, Stream]()
        for number in numbers:
            files = _files(base / f"image_{number:02d}" / sequence, PICTURES)
            images = list(files.values())
            size_px = first_image_size(images)
            camera = rig.camera(number, *size_px)
            cameras[camera.name] = camera
            streams[camera.name] = image_stream(camera.name, _nominal_stamps(files), images, size_px)
        if (base / "velodyne" / sequence).is_dir():
            sweeps = _files(base / "velodyne" / sequence, (".bin",))
            t_ns, half = _nominal_stamps(sweeps), PERIOD_NS // 2
            streams["velodyne"] = kitti_labels.sweep_stream(t_ns, t_ns - half, t_ns + half, list(sweeps.values()))
        oxts_file = base / "oxts" / f"{sequence}.txt"
        oxts = kitti_labels.read_text(oxts_file)
        rows = kitti_labels.parse_oxts(oxts, str(oxts_file))
        if not len(rows):
            raise LogError(f"{oxts_file}: no records; a stream needs at least one")
        poses, map_frame = kitti_labels.poses_from_oxts(rows)
        track = PoseTrack(_nominal_stamps(range(len(rows))), poses)
        notes = ["this layout has no stamps: 10 Hz is assumed for all streams, frame 0 at stamp 0"]
        for name, stream in streams.items():
            missing = np.setdiff1d(np.arange(len(rows)), stream.t_ns // PERIOD_NS)
            if len(missing):
                count = f"{len(missing)} of {len(rows)} records"
                notes.append(f"{name}: {count} are missing, first number {missing[0]:06d}")
        label_file = base / "label_02" / f"{sequence}.txt"
        labels = kitti_labels.read_labels(label_file, rig, track, lambda frame: frame * PERIOD_NS, notes)
        records = sorted(p for folder in streams for p in (base / folder / sequence).iterdir())
        return kitti_labels.drive_log(
            rig, cameras, streams, track, labels, name=f"kitti-tracking-{sequence}", format=self.name, map=map_frame,
            reference_camera="image_02", digest=digest_of([c.text, oxts, labels.text], records),
            notes=tuple(notes), calibrations=dict.fromkeys(streams, str(c.path)),
        )  # fmt: skip


TRACKING_READER = KittiTrackingReader()


def _base(path: Path) -> Path:
    return path / "training" if (path / "training" / "calib").is_dir() else path


def _nominal_stamps(numbers: Iterable[int], period_ns: int = PERIOD_NS) -> NDArray[np.int64]:
    return np.array(list(numbers), dtype=np.int64) * period_ns


OBJECT_PERIOD_NS = 100_000_000_000
EGO_R_RECT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The ego has the axes of the rectified camera 0, in which labels stand upright."""
LIDAR_HEIGHT_M = 1.73
"""Of KITTI's car (Geiger et al., IJRR 2013, fig. 1), for frames whose calibration does not state it."""


class KittiObjectReader(FolderReader):
    """Reader of the object detection layout; the root is a split or the parent of splits."""

    name = "kitti-object"
    looks_for = "a folder training/ (or that folder) with velodyne/NNNNNN.bin and calib/NNNNNN.txt"

    def find(self, path: Path) -> dict[str, Path]:
        """Find the splits at a folder by name."""
        path = path.resolve()
        places = [path, path / "training", path / "testing"]
        return {p.name: p for p in places if (p / "calib").is_dir() and any((p / "velodyne").glob("*.bin"))}

    def open(self, path: Path, sequence: str) -> Log:
        """Open a split."""
        base = self.find(path)[sequence]
        require_links_inside(base, path)
        sweeps = list_numbered_files(base / "velodyne", (".bin",))
        places = {number: base / "calib" / f"{file.stem}.txt" for number, file in sweeps.items()}
        known: dict[str, _Frame] = {}  # by the text of their files; most frames share one
        frames = {number: _frame_of(place, known) for number, place in places.items()}
        first = next(iter(frames.values()))
        t_ns, files = _nominal_stamps(sweeps, OBJECT_PERIOD_NS), list(sweeps.values())

        def read(i: int) -> Sweep:
            """Read a sweep in the map frame, each by its own calibration, so that labels fit them."""
            sweep = read_sweep(files[i], int(t_ns[i]))
            map_T_velo = first.ego_T_rect @ frames[list(sweeps)[i]].rect_T_velo
            points = apply(map_T_velo, sweep.xyz_m.astype(np.float64))
            return sweep_of(points, sweep.stamp_ns, None, "map", intensity=sweep.intensity)

        streams, cameras = {"velodyne": Stream("velodyne", t_ns, read)}, dict[str, Camera]()
        images = list_numbered_files(base / "image_2", PICTURES)
        if images:
            size_px = first_image_size(list(images.values()))
            cameras[kitti_labels.CAMERA] = first.camera(*size_px)
            streams[kitti_labels.CAMERA] = image_stream(
                kitti_labels.CAMERA, _nominal_stamps(images, OBJECT_PERIOD_NS), list(images.values()), size_px
            )
        ego = PoseTrack(t_ns, np.repeat(np.eye(4)[None], len(t_ns), axis=0))
        notes = ["single frames: taken to be 100 s apart, and the ego to stand still; use detect and evaluate"]
        without = sorted(set(images) - set(sweeps))
        if without:
            notes.append(f"{len(without)} of {len(images)} images have no sweep, first number {without[0]:06d}")
        nameless = [number for number, frame in frames.items() if not frame.names_imu]
        if nameless:
            notes.append(
                f"{len(nameless)} of {len(t_ns)} calibrations have no entry 'Tr_imu_to_velo', first {nameless[0]:06d}.txt: "
                "the ego is put below the LiDAR there"
            )
        labels = _labels(base, sweeps, first, ego, notes)
        ground_z_m, boxes = 0.0, labels.boxes_3d
        if not first.knows_ground and boxes is not None and len(boxes.t_ns):
            ground_z_m = float(np.median(boxes.center_m[:, 2] - boxes.size_m[:, 2] / 2))
        others = sum(not np.allclose(frame.P, first.P, rtol=1e-2, atol=1e-3) for frame in frames.values())
        if others:
            notes.append(f"{others} of {len(t_ns)} frames have another P2 by more than 1 %; that of the first is used")
        return kitti_labels.drive_log(
            kitti_labels.Rig(first.ego_T_rect @ first.rect_T_velo, first.ego_T_rect, {}), cameras, streams, ego, labels,
            name=f"kitti-object-{base.name}", format=self.name, ground_z_ego_m=ground_z_m,
            reference_camera=kitti_labels.CAMERA if cameras else None, digest=digest_of([*known, labels.text], files),
            notes=tuple(notes), calibrations=dict.fromkeys(streams, str(next(iter(places.values())))),
        )  # fmt: skip


OBJECT_READER = KittiObjectReader()


@dataclass(frozen=True, eq=False)
class _Frame:
    """Calibration of one frame."""

    ego_T_rect: Array  # (4, 4): for an ego on the ground below the LiDAR of this frame
    rect_T_velo: Array  # (4, 4)
    P: Array  # (3, 4): from the rectified camera 0 to the image; may hold a rotation
    knows_ground: bool  # whether the height of the LiDAR is known from that of the IMU
    names_imu: bool  # whether the file has an entry for the IMU

    def camera(self, width_px: int, height_px: int) -> Camera:
        """Split P into intrinsics and a rotation.

        RQ decomposition (Hartley and Zisserman, "Multiple View Geometry", A4.1.1), by QR of the reversed rows.
        """
        q, r = np.linalg.qr(self.P[::-1, :3].T)
        K, rotation = r.T[::-1, ::-1], q.T[::-1]
        sign = np.sign(np.diag(K))
        K, rotation = K * sign, sign[:, None] * rotation
        K = K / K[2, 2]
        cam_T_rect = transform(rotation, np.linalg.solve(K, self.P[:, 3] / np.linalg.norm(self.P[2, :3])))
        return Camera(kitti_labels.CAMERA, width_px, height_px, K, "ego", self.ego_T_rect @ inverse(cam_T_rect))


def _frame_of(path: Path, known: dict[str, _Frame]) -> _Frame:
    text = kitti_labels.read_text(path)
    if text in known:
        return known[text]
    c = kitti_labels.Calibration(path)
    names_imu = "Tr_imu_to_velo" in c.values
    c.entry((3, 3), "R0_rect", "R_rect")
    P = c.entry((3, 4), "P2")
    if not np.linalg.det(P[:, :3]) > 0:
        raise LogError(
            f"{path}, entry 'P2': {P.tolist()} is singular or mirrors the image; expected intrinsics, or these and a rotation"
        )
    velo_T_imu = c.rigid("Tr_imu_to_velo") if names_imu else np.eye(4)
    knows_ground = not np.array_equal(velo_T_imu, np.eye(4))
    if not knows_ground:
        velo_T_imu = transform(np.eye(3), [0.0, 0.0, kitti_labels.EGO_T_IMU[2, 3] - LIDAR_HEIGHT_M])
    rect_T_velo = transform(c.rotation("R0_rect", "R_rect"), np.zeros(3)) @ c.rigid("Tr_velo_to_cam")
    velo_ego = (kitti_labels.EGO_T_IMU @ inverse(velo_T_imu))[:3, 3]
    ego_T_rect = transform(EGO_R_RECT, velo_ego - EGO_R_RECT @ rect_T_velo[:3, 3])
    known[text] = _Frame(ego_T_rect, rect_T_velo, P, knows_ground, names_imu)
    return known[text]


def _labels(
    base: Path, sweeps: Mapping[int, Path], first: _Frame, ego: PoseTrack, notes: list[str]
) -> kitti_labels.DriveLabels:
    """Read the labels of all frames; each object is a track of its own."""
    parts, texts, labeled, damaged = list[kitti_labels.LabelRows](), [], [], list[str]()
    for number, file in sweeps.items():
        path = base / "label_2" / f"{file.stem}.txt"
        if is_present(path):
            texts.append(kitti_labels.read_text(path))
            lines = enumerate(texts[-1].splitlines())
            numbered = (f"{number} {number}-{k} {line}" * bool(line.strip()) for k, line in lines)
            parts.append(kitti_labels.parse_labels("\n".join(numbered), path, damaged))
            labeled.append(number)
    if not parts:
        return kitti_labels.DriveLabels()
    rows = kitti_labels.LabelRows.join(parts)
    note_damaged_rows(damaged, len(rows.frame) + len(damaged), notes)
    poses_at = kitti_labels.poses_of_rect(ego, first.ego_T_rect)
    found = kitti_labels.labels_of_rows(rows, poses_at, lambda frame: frame * OBJECT_PERIOD_NS, "\n".join(texts))
    assert found.boxes_3d is not None
    return replace(found, boxes_3d=replace(found.boxes_3d, labeled_ns=_nominal_stamps(labeled, OBJECT_PERIOD_NS)))
