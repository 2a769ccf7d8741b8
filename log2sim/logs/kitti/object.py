"""The layout of the KITTI object detection benchmark: training/{image_2, velodyne, calib, label_2}, single frames.

The frames of a split become one log, in which the ego stands still and a frame is taken every 100 s, so that nothing connects
them: a log to detect in and to evaluate with, not to track in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Stream, Sweep
from log2sim.errors import LogError
from log2sim.files.inputs import is_present, require_links_inside
from log2sim.geometry import Array, Camera, PoseTrack, apply, inverse, transform
from log2sim.logs.excerpt import digest_of
from log2sim.logs.kitti import labels as drive
from log2sim.logs.kitti.labels import CAMERA, DriveLabels, LabelRows, labels_of_rows, parse_labels
from log2sim.logs.records import FolderReader, first_image_size, image_stream, list_numbered_files, read_sweep, sweep_of
from log2sim.logs.stamps import note_damaged_rows

SPLITS = ("training", "testing")
PERIOD_NS = 100_000_000_000
IMAGES = "image_2"
SINGLE_FRAMES = (
    "single frames: each is taken to be 100 s after the one before, and the ego to stand still; use detect and evaluate"
)
EGO_R_RECT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The ego has the axes of the rectified camera 0, in which labels stand upright."""
LIDAR_HEIGHT_M = 1.73
"""Of KITTI's car (Geiger et al., IJRR 2013, fig. 1), for frames whose calibration does not state it."""


class KittiObjectReader(FolderReader):
    """Reader of the object detection layout; the root is a split or the parent of splits."""

    name = "kitti-object"
    looks_for = "a folder training/ (or that folder) with velodyne/NNNNNN.bin and calib/NNNNNN.txt"

    def open(self, path: Path, sequence: str) -> Log:
        """Open a split."""
        split = self.find(path)[sequence]
        require_links_inside(split, path)
        return _Split(split).log()

    def find(self, path: Path) -> dict[str, Path]:
        """Find the splits at a folder by name."""
        path = path.resolve()
        places = [path, *(path / name for name in SPLITS)]
        return {p.name: p for p in places if (p / "calib").is_dir() and any((p / "velodyne").glob("*.bin"))}


READER = KittiObjectReader()


@dataclass(frozen=True, eq=False)
class _Calibration:
    """Calibration of one frame."""

    ego_T_rect: Array  # (4, 4): for an ego on the ground below the LiDAR of this frame
    rect_T_velo: Array  # (4, 4)
    P: Array  # (3, 4): from the rectified camera 0 to the image; may hold a rotation
    knows_ground: bool  # whether the height of the LiDAR is known from that of the IMU
    names_imu: bool  # whether the file has an entry for the IMU

    @classmethod
    def read(cls, path: Path) -> _Calibration:
        """Read a calibration file."""
        c = drive.read_calibration(path)
        rect = drive.calibration_entry(c, path, (3, 3), "R0_rect", "R_rect")
        P = drive.calibration_entry(c, path, (3, 4), "P2")
        if not np.linalg.det(P[:, :3]) > 0:
            raise LogError(
                f"{path}, entry 'P2': {P.tolist()} is singular or mirrors the image; expected intrinsics, or these and a rotation"
            )
        velo_T_imu = drive.rigid_entry(c, path, "Tr_imu_to_velo") if "Tr_imu_to_velo" in c else np.eye(4)
        knows_ground = not np.array_equal(velo_T_imu, np.eye(4))
        if not knows_ground:
            velo_T_imu = transform(np.eye(3), [0.0, 0.0, drive.EGO_T_IMU[2, 3] - LIDAR_HEIGHT_M])
        rect_R_cam = drive.checked_rotation(rect, f"{path}, entry 'R0_rect'")
        rect_T_velo = transform(rect_R_cam, np.zeros(3)) @ drive.rigid_entry(c, path, "Tr_velo_to_cam")
        velo_ego = (drive.EGO_T_IMU @ inverse(velo_T_imu))[:3, 3]
        ego_T_rect = transform(EGO_R_RECT, velo_ego - EGO_R_RECT @ rect_T_velo[:3, 3])
        return cls(ego_T_rect, rect_T_velo, P, knows_ground, "Tr_imu_to_velo" in c)

    def camera(self, width_px: int, height_px: int) -> Camera:
        """Make the camera."""
        K, cam_R_rect = intrinsics_and_rotation(self.P[:, :3])
        cam_T_rect = transform(cam_R_rect, np.linalg.solve(K, self.P[:, 3] / np.linalg.norm(self.P[2, :3])))
        return Camera(CAMERA, width_px, height_px, K, "ego", self.ego_T_rect @ inverse(cam_T_rect))


def intrinsics_and_rotation(M: Array) -> tuple[Array, Array]:
    """Split the left part (3, 3) of a projection, of positive determinant, into intrinsics and a rotation.

    RQ decomposition (Hartley and Zisserman, "Multiple View Geometry", A4.1.1), by QR of the reversed rows.
    """
    q, r = np.linalg.qr(M[::-1].T)
    K, rotation = r.T[::-1, ::-1], q.T[::-1]
    sign = np.sign(np.diag(K))
    K, rotation = K * sign, sign[:, None] * rotation
    return np.asarray(K / K[2, 2]), np.asarray(rotation)


@dataclass(frozen=True, eq=False)
class _Split:
    base: Path

    @cached_property
    def sweeps(self) -> dict[int, Path]:
        """Files by number of frame."""
        return list_numbered_files(self.base / "velodyne", (".bin",))

    def log(self) -> Log:
        known: dict[str, _Calibration] = {}  # by the text of their files; most frames share one
        calibrations = {}
        for number, file in self.sweeps.items():
            path = self.base / "calib" / f"{file.stem}.txt"
            text = drive.read_text(path)
            if text not in known:
                known[text] = _Calibration.read(path)
            calibrations[number] = known[text]
        first = next(iter(calibrations.values()))
        t_ns = _stamps(self.sweeps)
        streams = {"velodyne": self._velodyne(t_ns, [calibrations[n] for n in self.sweeps], first)}
        cameras = {}
        images = list_numbered_files(self.base / IMAGES, (".png", ".jpg", ".jpeg"))
        if images:
            size_px = first_image_size(list(images.values()))
            cameras[CAMERA] = first.camera(*size_px)
            streams[CAMERA] = image_stream(CAMERA, _stamps(images), list(images.values()), size_px)
        ego = PoseTrack(t_ns, np.repeat(np.eye(4)[None], len(t_ns), axis=0))
        notes = [SINGLE_FRAMES]
        without = sorted(set(images) - set(self.sweeps))
        if without:
            notes.append(f"{len(without)} of {len(images)} images have no sweep, first number {without[0]:06d}")
        nameless = [number for number, c in calibrations.items() if not c.names_imu]
        if nameless:
            notes.append(
                f"{len(nameless)} of {len(t_ns)} calibrations have no entry 'Tr_imu_to_velo', first {nameless[0]:06d}.txt: "
                "the ego is put below the LiDAR there"
            )
        labels = self._labels(first, ego, notes)
        ground_z_m, boxes = 0.0, labels.boxes_3d
        if not first.knows_ground and boxes is not None and len(boxes.t_ns):
            # The median of the lower faces of labels.
            ground_z_m = float(np.median(boxes.center_m[:, 2] - boxes.size_m[:, 2] / 2))
        others = sum(not np.allclose(c.P, first.P, rtol=1e-2, atol=1e-3) for c in calibrations.values())
        if others:
            notes.append(f"{others} of {len(t_ns)} frames have another P2 by more than 1 %; that of the first is used")
        return Log(
            name=f"kitti-object-{self.base.name}",
            format=READER.name,
            cameras=cameras,
            lidars={"velodyne": drive.Rig(first.ego_T_rect @ first.rect_T_velo, first.ego_T_rect, {}).lidar()},
            streams=streams,
            ego=ego,
            ego_vehicle=drive.EGO_VEHICLE,
            labels=labels.boxes_3d,
            image_labels=labels.boxes_2d,
            ignored_regions=labels.ignored,
            ground_z_ego_m=ground_z_m,
            reference_camera=CAMERA if cameras else None,
            digest=digest_of([*known, labels.text], self.sweeps.values()),
            notes=tuple(notes),
            calibrations=dict.fromkeys(
                streams, str(self.base / "calib" / f"{next(iter(self.sweeps.values())).stem}.txt")
            ),
        )

    def _velodyne(self, t_ns: NDArray[np.int64], calibrations: list[_Calibration], first: _Calibration) -> Stream:
        """Stream of the sweeps in the map frame, each by its own calibration, so that labels fit them."""
        files = list(self.sweeps.values())

        def read(i: int) -> Sweep:
            sweep = read_sweep(files[i], int(t_ns[i]))
            points = apply(first.ego_T_rect @ calibrations[i].rect_T_velo, sweep.xyz_m.astype(np.float64))
            return sweep_of(points, sweep.stamp_ns, None, "map", intensity=sweep.intensity)

        return Stream("velodyne", t_ns, read)

    def _labels(self, first: _Calibration, ego: PoseTrack, notes: list[str]) -> DriveLabels:
        """Read the labels of all frames; each object is a track of its own."""
        parts, texts, labeled, damaged = [], [], [], list[str]()
        for number, file in self.sweeps.items():
            path = self.base / "label_2" / f"{file.stem}.txt"
            if is_present(path):
                text = drive.read_text(path)
                lines = [
                    f"{number} {number}-{k} {line}" if line.strip() else "" for k, line in enumerate(text.splitlines())
                ]
                parts.append(parse_labels("\n".join(lines), path, damaged))
                texts.append(text)
                labeled.append(number * PERIOD_NS)
        if not parts:
            return DriveLabels()
        rows = LabelRows(
            *(np.concatenate([getattr(p, k) for p in parts]) for k in ("frame", "track_id", "type", "values"))
        )
        note_damaged_rows(damaged, len(rows.frame) + len(damaged), notes)
        found = labels_of_rows(
            rows, drive.poses_of_rect(ego, first.ego_T_rect), lambda frame: frame * PERIOD_NS, "\n".join(texts)
        )
        assert found.boxes_3d is not None
        return replace(found, boxes_3d=replace(found.boxes_3d, labeled_ns=np.array(labeled, dtype=np.int64)))


def _stamps(files: Mapping[int, Path]) -> NDArray[np.int64]:
    return np.array(list(files), dtype=np.int64) * PERIOD_NS
