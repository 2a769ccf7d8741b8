"""Reader of version 1 of the Waymo Open Dataset, and a segment of either version as a log.

The stamp of a sweep is that of the pose which defines the frame of its points, about the middle of the turn. Cameras are called
as in the data set; LiDARs get "LIDAR_" before their names, for both have a FRONT, a SIDE_LEFT and a SIDE_RIGHT.

Opening reads the lengths of the records and, of each frame, poses, stamps and the offsets of everything else; pictures, range
images and labels are skipped. The format is that of dataset.proto and label.proto (github.com/waymo-research/waymo-open-dataset).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, ImageLabels, Labels, Lidar, Log, MapFrame, Stream, Sweep
from log2sim.errors import LogError, RecordError
from log2sim.files.images import decode_image
from log2sim.files.inputs import require_link_inside
from log2sim.geometry import Camera, PoseTrack, RollingShutter, shift_poses, transform, whole_kilometers
from log2sim.logs.excerpt import digest_of
from log2sim.logs.records import sweep_of
from log2sim.logs.stamps import MAX_TIME_S, defer_notes, strictly_increasing
from log2sim.logs.waymo import messages, range_images, segment

# From OpenCV's axes to x forward, y left, z up.
CAMERA_T_OPENCV = transform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
# RollingShutterReadOutDirection of dataset.proto.
DIRECTIONS = {1: "down", 2: "right", 3: "up", 4: "left"}
# A Chrysler Pacifica, by its data sheet; the LiDARs at the bumpers of the sample are 5.23 m apart, 1.46 m ahead of the origin
# in the middle.
PACIFICA = EgoVehicle(size_m=(5.18, 2.02, 1.78), rear_axle_offset_m=1.45)
LASER_FRONT, LASER_REAR = 2, 5
MAX_BUMPER_MISMATCH_M = 0.3
# Frame.pose and the pose of the FRONT image are taken to be of one time; a larger distance between them is noted.
MAX_POSE_MISMATCH_M = 0.05

Stamps = NDArray[np.int64]


class Segment:
    """A segment of either version as a log, with its frames in the order of their stamps.

    Subclasses read its records, `image` as a JPEG, `ranges`, and where there are labels `boxes` in 3D and `image_boxes` of a camera;
    they count frames in the order in which they gave them here.
    """

    digest: str
    boxes: Callable[[], segment.BoxTable] | None = None
    image_boxes: Callable[[int], segment.BoxTable] | None = None
    image_boxes_are_projected = False  # whether they are the 3D labels projected into the images, not drawn in them
    pixel_poses_are_missing = False  # whether range images of the TOP LiDAR come without the poses that belong to them

    def __init__(
        self, name: str, path: Path, frames: list[segment.FrameRow], cameras: Mapping[int, segment.CameraCalibration],
        lasers: Mapping[int, segment.LaserCalibration], notes: list[str], details: Mapping[str, Any],
    ) -> None:  # fmt: skip
        self.name, self.path, self.cameras, self.lasers = name, path, cameras, lasers
        self.notes, self.details, self.given = notes, details, len(frames)
        stamps = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
        self.order = strictly_increasing(stamps, "frames", self.notes)
        self.frames = [frames[k] for k in self.order]
        self.times = segment.FrameTimes.of(self.frames, self.notes)
        world_T_vehicle = np.stack([frame.world_T_vehicle for frame in self.frames])
        self.offset_m = whole_kilometers(world_T_vehicle[:, :3, 3])
        self.map_T_vehicle = shift_poses(world_T_vehicle, self.offset_m)

    def image(self, frame: int, camera: int) -> bytes:
        """Read the JPEG of a camera; raises `RecordError`."""
        raise NotImplementedError

    def ranges(self, frame: int, laser: int) -> segment.RangeImages:
        """Read the range images of a LiDAR; raises `RecordError`."""
        raise NotImplementedError

    def where(self, frame: int) -> str:
        """Name a frame in errors."""
        raise NotImplementedError

    def log(self, format: str) -> Log:
        """Make a log of the segment; `LogError` when it has neither images nor points."""
        cameras, streams, image_ns = self._cameras()
        lidars, sweeps = self._lidars()
        if not cameras and not lidars:
            raise LogError(
                f"{self.path}: {len(self.frames)} frames with neither images nor range images that have a calibration"
            )
        # What the format lacks.
        notes, top = self.notes, f"LIDAR_{segment.LASERS[segment.TOP]}"
        if top in lidars:
            notes.append("no times of points: those of the TOP LiDAR are estimated from the column of the range image")
            if not len(self.lasers[segment.TOP].inclinations_rad):  # only the short-range LiDARs have even beams
                lacks = "the calibration lacks the inclinations of the TOP LiDAR's beams"
                notes.append(f"{lacks}: they are taken to be even between the lowest and the highest")
            if self.pixel_poses_are_missing:
                lacks = "the poses of the pixels are missing"
                notes.append(f"{lacks}: points of the TOP LiDAR are as measured, not compensated")
        if set(lidars) - {top}:
            notes.append("no times of points of the short-range LiDARs")
        if self.boxes is not None:
            lacks = "labels do not distinguish cars from trucks, buses and motorcycles"
            notes.append(f"{lacks}: all vehicles are read as cars")
        if self.image_boxes is not None:
            how = "3D labels projected into them" if self.image_boxes_are_projected else "boxes drawn in them"
            notes.append(f"labels of images are the {how}")
        vehicle, size = ego_vehicle_of(self.lasers), "that of a Chrysler Pacifica is assumed"
        if vehicle is not PACIFICA:
            size = "length by the LiDARs at its bumpers, the rest as a Pacifica's"
        notes.append(f"the size of the ego vehicle is not in the log: {size}")

        @cache
        def labels() -> Labels | None:
            if self.boxes is None:
                return None
            table = self._in_order(self.boxes())
            return range_images.labels_of(
                table, self.times, self.map_T_vehicle, self.lasers.get(segment.TOP), self.notes
            )

        image_labels = self._image_labels(cameras, image_ns)
        return Log(
            name=f"waymo-{self.name}",
            format=format,
            cameras=cameras,
            lidars=lidars,
            streams=streams | sweeps,
            ego=self._ego(),
            ego_vehicle=vehicle,
            map=MapFrame(offset_m=(float(self.offset_m[0]), float(self.offset_m[1]), float(self.offset_m[2]))),
            labels=None if self.boxes is None else labels,
            image_labels=image_labels,
            reference_camera=next(iter(cameras), None),
            digest=self.digest,
            notes=defer_notes(self.notes, labels, *(partial(image_labels.get, name) for name in image_labels)),
            calibrations=dict.fromkeys(streams | sweeps, f"{self.path}, its calibrations"),
            details=self.details,
        )

    def _cameras(self) -> tuple[dict[str, Camera], dict[str, Stream], dict[int, Stamps]]:
        """Cameras with images, their streams, and their stamp (F,) in each frame, -1 where there is none."""
        cameras, streams, image_ns = {}, {}, {}
        for number, name in segment.CAMERAS.items():
            calibration = self.cameras.get(number)
            rows = np.array([k for k, frame in enumerate(self.frames) if number in frame.images], dtype=np.intp)
            if calibration is None or not len(rows):
                if len(rows):
                    self.notes.append(f"{name}: {len(rows)} images left out: no calibration of this camera")
                elif calibration is not None:
                    self.notes.append(f"{name}: no images of this camera")
                continue
            frames = [self.frames[k] for k in rows]
            camera = camera_of(name, calibration, frames, number)
            untimed = sum(not frame.images[number].is_timed for frame in frames)
            if untimed:
                self.notes.append(
                    f"{name}: {untimed} of {len(rows)} images without the times of their exposure: those of their poses are taken"
                )
            stamps = [segment.plausible_stamp(f.images[number].middle_ns(), f.stamp_ns) for f in frames]
            t_ns = np.array([self.times.pose_ns[k] if s is None else s for k, s in zip(rows, stamps)], dtype=np.int64)
            keep = strictly_increasing(t_ns, name, self.notes)
            rows, t_ns = rows[keep], t_ns[keep]
            cameras[name], image_ns[number] = camera, np.full(len(self.frames), -1, dtype=np.int64)
            image_ns[number][rows] = t_ns
            streams[name] = self._image_stream(camera, number, rows, t_ns)
        return cameras, streams, image_ns

    def _image_stream(self, camera: Camera, number: int, rows: NDArray[np.intp], t_ns: Stamps) -> Stream:
        def encoded(i: int) -> bytes:
            return self.image(int(self.order[rows[i]]), number)

        def read(i: int) -> NDArray[np.uint8]:
            where = f"{self.where(int(self.order[rows[i]]))}, {camera.name} (stamp {t_ns[i]})"
            return decode_image(encoded(i), where, (camera.width_px, camera.height_px))

        return Stream(camera.name, t_ns, read, encoded)

    def _lidars(self) -> tuple[dict[str, Lidar], dict[str, Stream]]:
        """LiDARs with range images, and their streams."""
        lidars, streams = {}, {}
        for number, word in segment.LASERS.items():
            name, calibration = f"LIDAR_{word}", self.lasers.get(number)
            rows = np.array([k for k, frame in enumerate(self.frames) if number in frame.lasers], dtype=np.intp)
            if len(rows) and calibration is None:
                self.notes.append(f"{name}: {len(rows)} sweeps left out: no calibration of this LiDAR")
            if not len(rows) or calibration is None:
                continue
            keep = strictly_increasing(self.times.pose_ns[rows], name, self.notes)
            lidars[name] = Lidar(name, "ego", calibration.vehicle_T_lidar)
            streams[name] = self._sweep_stream(name, number, rows[keep])
        if not lidars:
            self.notes.append("the frames hold no range images: there are no sweeps")
        return lidars, streams

    def _sweep_stream(self, name: str, number: int, rows: NDArray[np.intp]) -> Stream:
        calibration, stamps = self.lasers[number], self.times.pose_ns[rows]

        def read(i: int) -> Sweep:
            row, stamp_ns = rows[i], int(stamps[i])
            images = self.ranges(int(self.order[row]), number)
            try:
                world_T_vehicle = self.frames[row].world_T_vehicle
                xyz_m, turn, intensity = range_images.points_of(images, calibration, world_T_vehicle)
            except messages.WireError as error:
                raise RecordError(f"{self.where(int(self.order[row]))}, {name} (stamp {stamp_ns}): {error}") from None
            # How the short-range LiDARs scan is not documented.
            offset_ns = self.times.at_turn(row, turn) - stamp_ns if number == segment.TOP else None
            compensated_ns = None if number == segment.TOP and self.pixel_poses_are_missing else stamp_ns
            return sweep_of(xyz_m, stamp_ns, offset_ns, "lidar", compensated_ns, intensity)

        return Stream(name, stamps, read)

    def _ego(self) -> PoseTrack:
        """Poses of the frames and of the images, each at its own time."""
        stamps, poses = [int(t) for t in self.times.pose_ns], list(self.map_T_vehicle)
        off_m = [0.0]
        for frame, own_ns, own in zip(self.frames, self.times.pose_ns, self.map_T_vehicle):
            for image in frame.images.values():
                stamp = segment.plausible_stamp(image.pose_ns(), frame.stamp_ns)
                if stamp is None or image.world_T_vehicle is None:
                    continue
                pose = shift_poses(image.world_T_vehicle, self.offset_m)
                if stamp == own_ns:
                    off_m.append(float(np.linalg.norm(pose[:3, 3] - own[:3, 3])))
                stamps.append(stamp)
                poses.append(pose)
        if max(off_m) > MAX_POSE_MISMATCH_M:
            self.notes.append(
                f"the pose that defines a frame is up to {max(off_m):.2f} m from that of the FRONT image, whose time it is taken to be"
            )
        # A frame's own pose comes first and stays: its points are made with it.
        t_ns, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
        return PoseTrack(t_ns, np.stack(poses)[first])

    def _image_labels(self, cameras: dict[str, Camera], image_ns: dict[int, Stamps]) -> Mapping[str, ImageLabels]:
        boxes = self.image_boxes
        if boxes is None:
            return {}
        number_of = {name: number for number, name in segment.CAMERAS.items()}

        def read(name: str) -> ImageLabels:
            number, camera = number_of[name], cameras[name]
            table = self._in_order(boxes(number))
            lost = table.lost + int((image_ns[number][table.frame] < 0).sum())
            if lost:
                self.notes.append(f"{lost} boxes in images of '{name}' are damaged or of no frame, and left out")
            return range_images.image_labels_of(table, image_ns[number], (camera.width_px, camera.height_px))

        return range_images.LabelsOnRequest(tuple(cameras), read)

    def _in_order(self, table: segment.BoxTable) -> segment.BoxTable:
        """Count the frames of a table in their order; drops rows of frames that are not used."""
        place = np.full(self.given, -1, dtype=np.int64)
        place[self.order] = np.arange(len(self.order))
        frame = place[table.frame]
        rows = np.flatnonzero(frame >= 0)
        return replace(table, frame=frame, lost=table.lost + len(frame) - len(rows)).take(rows)


def camera_of(name: str, calibration: segment.CameraCalibration, frames: list[segment.FrameRow], number: int) -> Camera:
    """Make a camera with OpenCV's axes; the readout is the median of its images in `frames`."""
    f_u, f_v, c_u, c_v, *lens = (float(v) for v in calibration.intrinsic)
    spans = [frame.images[number].readout_s() for frame in frames]
    known = [s for s in spans if s is not None]
    direction: Any = DIRECTIONS.get(calibration.direction)
    shutter = RollingShutter(direction, float(np.median(known))) if direction is not None and known else None
    K = np.array([[f_u, 0.0, c_u], [0.0, f_v, c_v], [0.0, 0.0, 1.0]])
    ego_T_cam = calibration.vehicle_T_camera @ CAMERA_T_OPENCV
    return Camera(name, calibration.width_px, calibration.height_px, K, "ego", ego_T_cam, "brown", tuple(lens), shutter)


def ego_vehicle_of(lasers: Mapping[int, segment.LaserCalibration]) -> EgoVehicle:
    """Return the Pacifica, or a vehicle with the distance of the LiDARs at its bumpers as length where that differs."""
    if LASER_FRONT not in lasers or LASER_REAR not in lasers:
        return PACIFICA
    front_m, rear_m = (float(lasers[k].vehicle_T_lidar[0, 3]) for k in (LASER_FRONT, LASER_REAR))
    length_m, _, _ = PACIFICA.size_m
    if abs(front_m - rear_m - length_m) < MAX_BUMPER_MISMATCH_M or not 2.0 < front_m - rear_m < 15.0:
        return PACIFICA
    return EgoVehicle((front_m - rear_m, *PACIFICA.size_m[1:]), (front_m + rear_m) / 2)


SUFFIX = ".tfrecord"


class WaymoReader:
    """Reader of segments of version 1; the root is a file or a folder of files."""

    name = "waymo"
    looks_for = "a .tfrecord file of the Waymo Open Dataset (perception, version 1), or a folder of such files"
    suffixes = (SUFFIX,)

    def matches(self, path: Path) -> bool:
        """Return whether the file is a TFRecord file, or the folder holds some."""
        for file in _files(path):
            try:
                require_link_inside(file, path if path.is_dir() else file)
            except LogError:  # a link that must not be read, which opening it reports
                return True
            if messages.starts_like_tfrecord(file):
                return True
        return False

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the files without their suffix, sorted."""
        return [file.name.removesuffix(SUFFIX) for file in _files(path)]

    def open(self, path: Path, sequence: str) -> Log:
        """Open a segment; no picture, range image or label is read."""
        file = path if path.is_file() else path / f"{sequence}{SUFFIX}"
        require_link_inside(file, file if path.is_file() else path)
        return _SegmentFile(file).log(self.name)


READER = WaymoReader()


def _files(path: Path) -> list[Path]:
    try:
        files = [path] if path.is_file() else [file for file in path.glob(f"*{SUFFIX}") if file.is_file()]
    except OSError:
        return []
    return sorted(files, key=lambda file: file.name.removesuffix(SUFFIX))


class _SegmentFile(Segment):
    """The frames of the segment to which the first one of a file belongs; opening reads the index of each."""

    def __init__(self, path: Path) -> None:
        self.file = messages.RecordFile(path)
        # Usable frames: number of the record and index of each.
        self.record, self.index, frames = list[int](), list[messages.FrameIndex](), list[segment.FrameRow]()
        self.boxes_by_camera: dict[int, list[tuple[int, str, int, list[float]]]] | None = None
        name, context, left_out = "", b"", list[str]()
        cameras, lasers, stats = messages.read_calibration(context)
        for k in range(len(self.file.spans)):
            try:
                with self.file.window(k) as window:
                    index = messages.read_index(window)
                    own = messages.segment_name(window, index.context)
                    if not self.index:
                        name, context = own, messages.take_index(window, index.context)
                        cameras, lasers, stats = messages.read_calibration(context)
            except (messages.WireError, OSError) as error:
                left_out.append(f"record {k}: not a readable frame: {error}")
                continue
            if index.stamp_us is None or not 0 < index.stamp_us < MAX_TIME_S * 10**6:
                left_out.append(f"record {k}: timestamp_micros is {index.stamp_us}, expected microseconds since 1970")
            elif index.pose is None:
                left_out.append(f"record {k}: no rigid pose")
            elif own != name:
                expected = f"the file's first frame is of '{name}'; expected one segment a file"
                left_out.append(f"record {k}: of segment '{own}', {expected}")
            else:
                images = {number: times for number, (times, _) in index.images.items() if number in segment.CAMERAS}
                frames.append(segment.FrameRow(index.stamp_us * 1000, index.pose, images, tuple(index.lasers)))
                self.record.append(k)
                self.index.append(index)
        notes = [*self.file.notes]
        if left_out:
            notes.append(f"{len(left_out)} of {len(self.file.spans)} records left out; {left_out[0]}")
        if not frames:
            raise LogError(f"{path}: no usable frame; {'; '.join(notes) or 'the file is empty'}")
        zones = sum(f.no_label_zones > 0 for f in self.index)
        if zones:
            notes.append(f"{zones} of {len(frames)} frames have zones in which objects are not labeled")
        super().__init__(name, path, frames, cameras, lasers, notes, {**stats, "frames": len(frames)})
        self.boxes = self._boxes if any(f.labels for f in self.index) else None
        self.image_boxes_are_projected = any(f.projected_labels for f in self.index)
        drawn = any(f.camera_labels for f in self.index)
        self.image_boxes = self._image_boxes if self.image_boxes_are_projected or drawn else None
        records = [f"{f.stamp_us} {self.file.spans[k][1]}" for k, f in zip(self.record, self.index)]
        self.digest = digest_of([name, context.hex(), *records], [])

    def where(self, frame: int) -> str:
        return f"{self.path}: record {self.record[frame]}"

    def _data(self, frame: int, span: messages.Span) -> bytes:
        k, stamp_us = self.record[frame], self.index[frame].stamp_us
        return self.file.read(k, f"record {k}, stamp {stamp_us} us")[slice(*span)]

    def image(self, frame: int, camera: int) -> bytes:
        return self._data(frame, self.index[frame].images[camera][1])

    def ranges(self, frame: int, laser: int) -> segment.RangeImages:
        data = self._data(frame, self.index[frame].lasers[laser])
        try:
            return range_images.read_range_images(data)
        except messages.WireError as error:
            raise RecordError(f"{self.where(frame)}, LiDAR {laser}: {error}") from None

    def _boxes(self) -> segment.BoxTable:
        found, lost = self._read_all(lambda index: index.labels, lambda data: messages.read_box(data, 3))
        return _table([(frame, *box) for frame, box in found if box is not None], 3, lost)

    def _image_boxes(self, camera: int) -> segment.BoxTable:
        if self.boxes_by_camera is None:
            spans = (lambda f: f.projected_labels) if self.image_boxes_are_projected else (lambda f: f.camera_labels)
            found, self.lost_boxes = self._read_all(spans, messages.read_camera_labels)
            self.boxes_by_camera = {}
            for frame, (number, boxes) in found:
                self.boxes_by_camera.setdefault(number, []).extend((frame, *box) for box in boxes)
        # To which camera a message belonged that cannot be read is not known: all of them report the first one.
        lost, self.lost_boxes = self.lost_boxes, 0
        return _table(self.boxes_by_camera.get(camera, []), 2, lost)

    def _read_all(
        self, spans: Callable[[messages.FrameIndex], list[messages.Span]], parse: Callable[[bytes], Any]
    ) -> tuple[list[tuple[int, Any]], int]:
        """Parse messages of all frames: frame and content of each, and how many cannot be read."""
        out, lost = list[tuple[int, Any]](), 0
        for frame, (k, index) in enumerate(zip(self.record, self.index)):
            with self.file.window(k) as window:
                for span in spans(index):
                    try:
                        out.append((frame, parse(messages.take_index(window, span))))
                    except messages.WireError:
                        lost += 1
        return out, lost


def _table(rows: list[tuple[int, str, int, list[float]]], dimensions: int, lost: int) -> segment.BoxTable:
    """Make a table of rows: frame, id, type, and the numbers of a box."""
    frame, track_id, kind, box = zip(*rows) if rows else ((), (), (), ())
    boxes = np.array(box, dtype=np.float64).reshape(-1, 2 * dimensions + 1)
    return segment.BoxTable.of(frame, track_id, kind, boxes, lost)
