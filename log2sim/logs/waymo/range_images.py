"""Range images to points, and the labels of a segment.

Rows are beams from the highest to the lowest, columns directions from the rear over the left, the front and the right to the
rear, so that the TOP LiDAR, which turns clockwise, measures them from the first to the last.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ImageLabels, Labels
from log2sim.geometry import Array, apply, inverse, rotation_from_rpy, yaw_of
from log2sim.logs.stamps import compute_turn_share, note_left_out, select_spaced
from log2sim.logs.waymo.messages import BYTES, WireError, fields_of, range_image_parts, varints
from log2sim.logs.waymo.segment import TYPES, BoxTable, FrameTimes, LaserCalibration, RangeImages

# The TOP LiDAR has 64 x 2650 pixels of 4 channels, its poses have 6.
MAX_PIXELS = 1_000_000
MAX_CHANNELS = 16
MAX_MATRIX_BYTES = 64 * 1024 * 1024


def read_range_images(laser: bytes) -> RangeImages:
    """Decompress the range images of a Laser message of version 1.

    Raises `WireError` when they are damaged, too large or not of the layout (H, W, C).
    """
    returns, poses = [], None
    for number, ranges, pixel_poses in sorted(range_image_parts(laser)):
        if ranges:
            returns.append(read_matrix(ranges))
        if pixel_poses and number == 1:
            poses = read_matrix(pixel_poses)
    return checked(returns, poses)


def read_matrix(compressed: bytes) -> NDArray[np.float32]:
    """Decompress a MatrixFloat (H, W, C)."""
    decompressor = zlib.decompressobj()
    try:
        data = decompressor.decompress(compressed, MAX_MATRIX_BYTES)
    except zlib.error as error:
        raise WireError(f"a range image cannot be decompressed: {error}") from None
    if decompressor.unconsumed_tail:
        raise WireError(f"a range image unpacks to more than {MAX_MATRIX_BYTES} bytes")
    if not decompressor.eof:
        raise WireError("a range image is truncated")
    parts, dims = [], list[int]()
    for f in fields_of(data):
        if f.kind != BYTES:
            continue
        if f.number == 1:
            if (f.end - f.begin) % 4:
                raise WireError(f"a range image has {f.end - f.begin} bytes of values, expected floats of 4")
            parts.append(np.frombuffer(data[f.begin : f.end], "<f4"))
        elif f.number == 2:
            # A MatrixShape: its dimensions packed, or one field each.
            shape, dims = data[f.begin : f.end], []
            for g in fields_of(shape):
                if g.number == 1:
                    dims += varints(shape[g.begin : g.end]) if g.kind == BYTES else [g.value]
    return shaped(np.concatenate(parts) if parts else np.zeros(0, np.float32), dims)


def shaped(values: NDArray[Any], dims: list[int]) -> NDArray[np.float32]:
    """Return values as (H, W, C) float32; `WireError` when `dims` are not three or do not fit."""
    if len(dims) != 3 or not 0 < dims[2] <= MAX_CHANNELS or not 0 < dims[0] * dims[1] <= MAX_PIXELS or min(dims) <= 0:
        raise WireError(f"a range image has the shape {dims[:8]}, expected rows, columns, channels")
    if len(values) != dims[0] * dims[1] * dims[2]:
        raise WireError(f"a range image has {len(values)} values, expected {' x '.join(map(str, dims))}")
    return np.asarray(values, dtype=np.float32).reshape(dims)


def checked(returns: list[NDArray[np.float32]], poses: NDArray[np.float32] | None) -> RangeImages:
    """Return the range images of one LiDAR; `WireError` when there are none or their shapes differ."""
    shapes = {image.shape[:2] for image in returns}
    if len(shapes) != 1:
        raise WireError(f"range images of {len(shapes)} shapes, expected one or two returns of the same")
    if poses is not None and poses.shape != (*next(iter(shapes)), 6):
        raise WireError(f"poses of the pixels have the shape {poses.shape}, expected {(*next(iter(shapes)), 6)}")
    return RangeImages(tuple(returns), poses)


def points_of(
    images: RangeImages, laser: LaserCalibration, world_T_vehicle: Array
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32] | None]:
    """Turn the range images of one LiDAR into points (N, 3), m, of all returns, in the lidar's frame as it was at `world_T_vehicle`.

    Also the share (N,) of the turn, in [0, 1), at which the middle of each point's column was measured, and the intensities (N,), None
    where there are ranges only. After comments of RangeImage in dataset.proto: each pixel is taken to the world by the pose of the
    vehicle at its own time and back by `world_T_vehicle`, which defines the vehicle's frame. Range images without such poses are made
    of points in the vehicle's frame already.
    """
    height, width = images.returns[0].shape[:2]
    # Columns are even in the vehicle's frame, azimuths in the lidar's.
    yaw = np.arctan2(laser.vehicle_T_lidar[1, 0], laser.vehicle_T_lidar[0, 0])
    azimuth = np.pi - 2 * np.pi * (np.arange(width) + 0.5) / width - yaw
    inclination = row_inclinations(laser, height)
    has_intensity = min(image.shape[2] for image in images.returns) > 1
    parts, turns, intensities = [], [], []
    for image in images.returns:
        row, column = np.nonzero((image[..., 0] > 0) & np.isfinite(image[..., 0]))
        reach = image[row, column, 0].astype(np.float64)
        level = np.cos(inclination[row]) * reach
        xyz = np.stack(
            [np.cos(azimuth)[column] * level, np.sin(azimuth)[column] * level, np.sin(inclination)[row] * reach], axis=1
        )
        if images.poses is not None:
            # Points (N, 3) of the lidar's frame at their own times, in its frame at `world_T_vehicle`
            pixel_poses = images.poses[row, column]
            usable = np.asarray(np.isfinite(pixel_poses).all(axis=1))
            if not usable.all():
                raise WireError(f"{np.sum(~usable)} of {len(usable)} pixels with a range have no finite pose")
            roll, pitch, yaw, *position = pixel_poses.astype(np.float64).T
            # The difference of the large positions is taken first, so that it keeps its digits.
            from_pose = np.stack(position, axis=1) - world_T_vehicle[:3, 3]
            turned = np.einsum("nij,nj->ni", rotation_from_rpy(roll, pitch, yaw), apply(laser.vehicle_T_lidar, xyz))
            xyz = apply(inverse(laser.vehicle_T_lidar), (turned + from_pose) @ world_T_vehicle[:3, :3])
        parts.append(xyz.astype(np.float32))
        turns.append((column + 0.5) / width)
        if has_intensity:
            intensities.append(image[row, column, 1])
    return np.concatenate(parts), np.concatenate(turns), np.concatenate(intensities) if has_intensity else None


def row_inclinations(laser: LaserCalibration, height: int) -> Array:
    """Inclination (H,) rad of each row; `WireError` when the number of beams is another than that of rows."""
    beams = laser.inclinations_rad
    if not len(beams):
        low, high = laser.limits_rad
        beams = low + (np.arange(height) + 0.5) / height * (high - low)
    if len(beams) != height:
        raise WireError(f"a range image has {height} rows, the calibration {len(beams)} beams")
    return beams[::-1]


def turn_of(xyz_vehicle: Array, laser: LaserCalibration) -> Array:
    """Share (N,) of the turn, 0 to 1, after which a LiDAR scans points (N, 3), m, of the vehicle's frame."""
    return compute_turn_share(xyz_vehicle - laser.vehicle_T_lidar[:3, 3])


# Vehicles are cars, trucks, buses and motorcycles.
CATEGORY_OF = {"vehicle": "car", "pedestrian": "pedestrian", "cyclist": "cyclist"}
NO_ROAD_USERS = {"sign"}
MAX_COORDINATE_M = 1e4


def labels_of(
    table: BoxTable, times: FrameTimes, map_T_vehicle: Array, top: LaserCalibration | None, notes: list[str]
) -> Labels:
    """Turn 3D boxes in the vehicle's frames, whose poses are `map_T_vehicle` (F, 4, 4), into labels in the map.

    A box fits the points where they were measured, and the TOP LiDAR scans different directions at different times: the box
    has the time of its direction, without that LiDAR the stamp of its frame's pose. The data set states no times of boxes; where it
    derives boxes from them (`camera_synced_box`) it calls them boxes at the start of the frame. On its sample the camera's label of
    a cyclist at 8.5 m/s is 13 px from the box at this time, 24 px from the box at the start; its box is 37 px wide.
    """
    if table.lost:
        notes.append(f"{table.lost} labels are damaged or of no frame, and left out")
    kind = _kinds(table)
    usable = (table.size > 0).all(axis=1) & np.isfinite(table.size).all(axis=1) & np.isfinite(table.heading_rad)
    usable &= (np.abs(table.center) < MAX_COORDINATE_M).all(axis=1)
    road_user = np.isin(kind, list(CATEGORY_OF))
    if (road_user & ~usable).any():
        notes.append(f"{np.sum(road_user & ~usable)} labels without a position or size left out")
    note_left_out(kind[~road_user].tolist(), NO_ROAD_USERS, notes)
    rows = np.flatnonzero(usable & road_user)
    table, kind = table.take(rows), kind[rows]
    t_ns = times.pose_ns[table.frame] if top is None else times.at_turn(table.frame, turn_of(table.center, top))
    order = np.argsort(t_ns, kind="stable")
    keep = order[select_spaced(t_ns[order], table.track_id[order])]
    table, kind, t_ns = table.take(keep), kind[keep], t_ns[keep]
    pose = map_T_vehicle[table.frame]
    turned = pose[:, :3, :3] @ rotation_from_rpy(0.0, 0.0, table.heading_rad)
    return Labels(
        t_ns, table.track_id, _categories(kind), apply(pose, table.center), table.size, yaw_of(turned),
        kind=kind, labeled_ns=times.pose_ns,
    )  # fmt: skip


def image_labels_of(table: BoxTable, stamps_ns: NDArray[np.int64], size_px: tuple[int, int]) -> ImageLabels:
    """Turn boxes of one camera's images into labels, cut at the border of the image.

    `stamps_ns` (F,): of the camera's image in each frame; negative where there is none.
    """
    kind = _kinds(table)
    box = np.concatenate([table.center - table.size / 2, table.center + table.size / 2], axis=1)
    box = np.clip(box, 0, np.tile(np.asarray(size_px, dtype=np.float64), 2))
    t_ns = stamps_ns[table.frame]
    with np.errstate(invalid="ignore"):
        whole = np.isfinite(box).all(axis=1) & (box[:, 2:] > box[:, :2]).all(axis=1)
    rows = np.flatnonzero(whole & (t_ns >= 0) & np.isin(kind, list(CATEGORY_OF)))
    return ImageLabels(t_ns[rows], box[rows], _categories(kind[rows]))


class LabelsOnRequest(Mapping[str, ImageLabels]):
    """Image labels by camera that `read` reads when one camera's are first used."""

    def __init__(self, cameras: Collection[str], read: Callable[[str], ImageLabels]) -> None:
        self._cameras, self._read = tuple(cameras), read
        self._found: dict[str, ImageLabels] = {}
        self._lock = Lock()

    def __getitem__(self, camera: str) -> ImageLabels:
        """Return the labels of a camera."""
        if camera not in self._cameras:
            raise KeyError(camera)
        with self._lock:
            if camera not in self._found:
                self._found[camera] = self._read(camera)
            return self._found[camera]

    def __reduce__(self) -> Any:
        """Read all of them for another process."""
        return dict, (dict(self),)

    def __iter__(self) -> Iterator[str]:
        """Return the cameras."""
        return iter(self._cameras)

    def __len__(self) -> int:
        """Return the number of cameras."""
        return len(self._cameras)


def _kinds(table: BoxTable) -> NDArray[np.str_]:
    return np.array([TYPES.get(int(k), "unknown") for k in table.kind], dtype=np.str_)


def _categories(kind: NDArray[np.str_]) -> NDArray[np.str_]:
    return np.array([CATEGORY_OF[str(word)] for word in kind], dtype="<U16")
