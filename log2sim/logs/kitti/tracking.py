"""The layout of the KITTI tracking benchmark: training/{image_02, velodyne, oxts, calib, label_02}/NNNN."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Stream
from log2sim.errors import LogError
from log2sim.geometry import Camera, PoseTrack, transform
from log2sim.input_files import is_present
from log2sim.links import require_links_inside
from log2sim.logs.digest import digest_of
from log2sim.logs.images import first_image_size, image_stream
from log2sim.logs.kitti import drive
from log2sim.logs.kitti.labels import DriveLabels, read_labels
from log2sim.logs.record_files import list_numbered_files

PERIOD_NS = 100_000_000
CAMERA_NUMBERS = (2, 3)
NO_STAMPS = "this layout has no stamps: 10 Hz is assumed for all streams, frame 0 at stamp 0"


class KittiTrackingReader:
    """Reader of the tracking layout; the root is the folder "training" or its parent."""

    name = "kitti-tracking"
    looks_for = "a folder training/ (or that folder) with calib/NNNN.txt and image_02/NNNN/"
    suffixes = ()

    def matches(self, path: Path) -> bool:
        """Return whether the folder holds a sequence of this layout."""
        return bool(self.sequences(path))

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the sequences, sorted."""
        base = _base(path)
        return sorted(p.stem for p in (base / "calib").glob("*.txt") if (base / "image_02" / p.stem).is_dir())

    def open(self, path: Path, sequence: str) -> Log:
        """Open a sequence."""
        require_links_inside(_base(path), path)
        return _Sequence(_base(path), sequence).log()


READER = KittiTrackingReader()


def _base(path: Path) -> Path:
    return path / "training" if (path / "training" / "calib").is_dir() else path


@dataclass(frozen=True)
class _Sequence:
    base: Path
    name: str

    def log(self) -> Log:
        rig = self._rig()
        cameras, streams = self._cameras(rig)
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
        notes = [NO_STAMPS, *_missing_records(streams, len(rows))]
        labels = self._labels(rig, track, notes)
        records = sorted(p for folder in streams for p in (self.base / folder / self.name).iterdir())
        calibration = drive.read_text(self.base / "calib" / f"{self.name}.txt")
        return Log(
            name=f"kitti-tracking-{self.name}",
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
            reference_camera="image_02",
            digest=digest_of([calibration, oxts, labels.text], records),
            notes=tuple(notes),
            calibrations=dict.fromkeys(streams, str(self.base / "calib" / f"{self.name}.txt")),
        )

    def _rig(self) -> drive.Rig:
        path = self.base / "calib" / f"{self.name}.txt"
        c = drive.read_calibration(path)
        projections = {}
        for k in CAMERA_NUMBERS:
            if (self.base / f"image_{k:02d}" / self.name).is_dir():
                projections[k] = drive.checked_projection(
                    drive.calibration_entry(c, path, (3, 4), f"P{k}"), f"{path}, entry 'P{k}'"
                )
        rect = drive.checked_rotation(
            drive.calibration_entry(c, path, (3, 3), "R0_rect", "R_rect"), f"{path}, entry 'R0_rect'"
        )
        links = []
        for keys in (("Tr_imu_to_velo", "Tr_imu_velo"), ("Tr_velo_to_cam", "Tr_velo_cam")):
            m = drive.calibration_entry(c, path, (3, 4), *keys)
            links.append(transform(drive.checked_rotation(m[:, :3], f"{path}, entry '{keys[0]}'"), m[:, 3]))
        return drive.rig_of(links[0], links[1], rect, projections)

    def _cameras(self, rig: drive.Rig) -> tuple[dict[str, Camera], dict[str, Stream]]:
        cameras, streams = {}, {}
        for number in rig.projections:
            files = self._files(f"image_{number:02d}", (".png", ".jpg", ".jpeg"))
            size_px = first_image_size(list(files.values()))
            camera = rig.camera(number, *size_px)
            cameras[camera.name] = camera
            streams[camera.name] = image_stream(camera.name, _nominal_stamps(files), list(files.values()), size_px)
        return cameras, streams

    def _files(self, folder: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
        files = list_numbered_files(self.base / folder / self.name, suffixes)
        if not files:
            raise LogError(
                f"{self.base / folder / self.name}: no records ({', '.join(suffixes)}); a stream needs at least one"
            )
        return files

    def _labels(self, rig: drive.Rig, track: PoseTrack, notes: list[str]) -> DriveLabels:
        path = self.base / "label_02" / f"{self.name}.txt"
        if not is_present(path):
            return DriveLabels()
        return read_labels(path, rig, track, lambda frame: frame * PERIOD_NS, notes)


def _missing_records(streams: Mapping[str, Stream], count: int) -> Iterator[str]:
    """Say which streams lack records of the frames that the IMU counts."""
    for name, stream in streams.items():
        missing = np.setdiff1d(np.arange(count), stream.t_ns // PERIOD_NS)
        if len(missing):
            yield f"{name}: {len(missing)} of {count} records are missing, first number {missing[0]:06d}"


def _nominal_stamps(files: dict[int, Path]) -> NDArray[np.int64]:
    return np.array(list(files), dtype=np.int64) * PERIOD_NS
