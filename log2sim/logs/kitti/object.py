"""The layout of the KITTI object detection benchmark: training/{image_2, velodyne, calib, label_2}, single frames.

The frames of a split become one log, in which the ego stands still and a frame is taken every 100 s, so that nothing connects
them: a log to detect in and to evaluate with, not to track in.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Stream, Sweep
from log2sim.errors import LogError
from log2sim.files.inputs import is_present, require_links_inside
from log2sim.geometry import Array, Camera, PoseTrack, apply, inverse, transform
from log2sim.logs.excerpt import digest_of
from log2sim.logs.kitti.drives import PICTURES
from log2sim.logs.kitti.labels import (
    CAMERA,
    EGO_T_IMU,
    Calibration,
    DriveLabels,
    LabelRows,
    Rig,
    drive_log,
    labels_of_rows,
    parse_labels,
    poses_of_rect,
    read_text,
)
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

    def find(self, path: Path) -> dict[str, Path]:
        """Find the splits at a folder by name."""
        path = path.resolve()
        places = [path, *(path / name for name in SPLITS)]
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
        t_ns, files = _stamps(sweeps), list(sweeps.values())

        def read(i: int) -> Sweep:
            """Read a sweep in the map frame, each by its own calibration, so that labels fit them."""
            sweep = read_sweep(files[i], int(t_ns[i]))
            map_T_velo = first.ego_T_rect @ frames[list(sweeps)[i]].rect_T_velo
            points = apply(map_T_velo, sweep.xyz_m.astype(np.float64))
            return sweep_of(points, sweep.stamp_ns, None, "map", intensity=sweep.intensity)

        streams, cameras = {"velodyne": Stream("velodyne", t_ns, read)}, dict[str, Camera]()
        images = list_numbered_files(base / IMAGES, PICTURES)
        if images:
            size_px = first_image_size(list(images.values()))
            cameras[CAMERA] = first.camera(*size_px)
            streams[CAMERA] = image_stream(CAMERA, _stamps(images), list(images.values()), size_px)
        ego = PoseTrack(t_ns, np.repeat(np.eye(4)[None], len(t_ns), axis=0))
        notes = [SINGLE_FRAMES]
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
            # The median of the lower faces of labels.
            ground_z_m = float(np.median(boxes.center_m[:, 2] - boxes.size_m[:, 2] / 2))
        others = sum(not np.allclose(frame.P, first.P, rtol=1e-2, atol=1e-3) for frame in frames.values())
        if others:
            notes.append(f"{others} of {len(t_ns)} frames have another P2 by more than 1 %; that of the first is used")
        return drive_log(
            Rig(first.ego_T_rect @ first.rect_T_velo, first.ego_T_rect, {}), cameras, streams, ego, labels,
            name=f"kitti-object-{base.name}", format=self.name, ground_z_ego_m=ground_z_m,
            reference_camera=CAMERA if cameras else None, digest=digest_of([*known, labels.text], files),
            notes=tuple(notes), calibrations=dict.fromkeys(streams, str(next(iter(places.values())))),
        )  # fmt: skip


READER = KittiObjectReader()


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
        return Camera(CAMERA, width_px, height_px, K, "ego", self.ego_T_rect @ inverse(cam_T_rect))


def _frame_of(path: Path, known: dict[str, _Frame]) -> _Frame:
    text = read_text(path)
    if text in known:
        return known[text]
    c = Calibration(path)
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
        velo_T_imu = transform(np.eye(3), [0.0, 0.0, EGO_T_IMU[2, 3] - LIDAR_HEIGHT_M])
    rect_T_velo = transform(c.rotation("R0_rect", "R_rect"), np.zeros(3)) @ c.rigid("Tr_velo_to_cam")
    velo_ego = (EGO_T_IMU @ inverse(velo_T_imu))[:3, 3]
    ego_T_rect = transform(EGO_R_RECT, velo_ego - EGO_R_RECT @ rect_T_velo[:3, 3])
    known[text] = _Frame(ego_T_rect, rect_T_velo, P, knows_ground, names_imu)
    return known[text]


def _labels(base: Path, sweeps: Mapping[int, Path], first: _Frame, ego: PoseTrack, notes: list[str]) -> DriveLabels:
    """Read the labels of all frames; each object is a track of its own."""
    parts, texts, labeled, damaged = list[LabelRows](), [], [], list[str]()
    for number, file in sweeps.items():
        path = base / "label_2" / f"{file.stem}.txt"
        if is_present(path):
            texts.append(read_text(path))
            lines = [
                f"{number} {number}-{k} {line}" * bool(line.strip()) for k, line in enumerate(texts[-1].splitlines())
            ]
            parts.append(parse_labels("\n".join(lines), path, damaged))
            labeled.append(number)
    if not parts:
        return DriveLabels()
    rows = LabelRows(*(np.concatenate(columns) for columns in zip(*(vars(part).values() for part in parts))))
    note_damaged_rows(damaged, len(rows.frame) + len(damaged), notes)
    poses_at = poses_of_rect(ego, first.ego_T_rect)
    found = labels_of_rows(rows, poses_at, lambda frame: frame * PERIOD_NS, "\n".join(texts))
    assert found.boxes_3d is not None
    return replace(found, boxes_3d=replace(found.boxes_3d, labeled_ns=_stamps(labeled)))


def _stamps(numbers: Iterable[int]) -> NDArray[np.int64]:
    return np.array(list(numbers), dtype=np.int64) * PERIOD_NS
