"""A driving log: its sensors, the streams of their records, ego poses and labels.

All types are frozen dataclasses of columns; no code changes an array that one of them holds. Letters in shapes: N points,
M boxes, L labels, T ticks, F records of a stream.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields, replace
from typing import Any, Generic, Literal, Self, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import ScenarioError
from log2sim.files import plugins
from log2sim.files.documents import short_repr
from log2sim.geometry import NS_PER_S, Array, Camera, Mount, PoseTrack, rotation_from_quaternion, transform

T = TypeVar("T")


class Deferred(Generic[T]):
    """A dataclass field that also takes a function of no arguments; it is called when the field is first read.

    So opening a log does not wait for large files that are not used. Without arguments the field has no default.
    """

    def __init__(self, *default: T) -> None:
        self._default = default

    def __set_name__(self, owner: type, name: str) -> None:
        """Remember the name of the field."""
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type) -> Self: ...

    @overload
    def __get__(self, instance: object, owner: type) -> T: ...

    def __get__(self, instance: object | None, owner: type) -> Any:
        """Return the value; of the class, the default."""
        if instance is None:
            if not self._default:
                raise AttributeError(self._name)
            return self._default[0]
        value = instance.__dict__[self._name]
        if callable(value):
            value = instance.__dict__[self._name] = value()
        return value

    def __set__(self, instance: object, value: T | Callable[[], T]) -> None:
        """Store the value or the function that makes it."""
        instance.__dict__[self._name] = value


# Rotations are stored with three decimals or more.
ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class LabelView:
    """The images of one camera in which objects were labeled."""

    camera: Camera  # its mount is not used
    t_s: Array  # (F,), s: strictly increasing stamps since the start of the truth
    translation_m: Array  # (F, 3), m: of the camera in the map
    rotation_wxyz: Array  # (F, 4): unit quaternions of the camera in the map, scalar first
    region_frame: NDArray[np.int64]  # (R,): index into `t_s` of each region
    region_px: Array  # (R, 4), px: u0, v0, u1, v1 of each part of an image without labels

    @property
    def map_T_cam(self) -> Array:
        """Return the poses (F, 4, 4) of the camera."""
        return transform(rotation_from_quaternion(self.rotation_wxyz), self.translation_m)


@dataclass(frozen=True, eq=False)
class IgnoreRegions:
    """Where reconstructed objects are neither right nor false, because nothing was labeled there."""

    views: tuple[LabelView, ...]  # one for each labeled camera
    outside_views: bool  # whether objects outside all views were left without labels too
    categories: tuple[str, ...] = ()  # categories that were left without labels everywhere

    def to_dict(self) -> dict[str, Any]:
        """Return the part `unlabeled` of a document of `schemas/scenario-1.json`."""
        columns = ("t_s", "translation_m", "rotation_wxyz", "region_frame", "region_px")
        views = [
            {"camera": v.camera.name, "intrinsics": intrinsics_to_dict(v.camera)}
            | {name: getattr(v, name).tolist() for name in columns}
            for v in self.views
        ]
        document: dict[str, Any] = {"outside_views": self.outside_views, "views": views}
        return {**document, "categories": list(self.categories)} if self.categories else document

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> IgnoreRegions:
        """Build them from a part of a document that keeps the schema; `ScenarioError` when columns do not fit each other."""
        views = tuple(_view_from_dict(v, f"unlabeled.views[{k}]") for k, v in enumerate(document["views"]))
        return cls(views, bool(document["outside_views"]), tuple(document.get("categories", ())))


def intrinsics_to_dict(camera: Camera) -> dict[str, Any]:
    """Return size, camera matrix and lens of a camera as an entry of a document."""
    K = camera.K
    return {
        "width_px": int(camera.width_px), "height_px": int(camera.height_px), "fx_px": float(K[0, 0]), "fy_px": float(K[1, 1]),
        "cx_px": float(K[0, 2]), "cy_px": float(K[1, 2]), "distortion_model": camera.distortion_model,
        "distortion": [float(d) for d in camera.distortion],
    }  # fmt: skip


def camera_of(name: str, intrinsics: Mapping[str, Any], mount: Mount, mount_T_cam: Array) -> Camera:
    """Return the camera of such an entry."""
    i, model = intrinsics, intrinsics.get("distortion_model", "none")
    K = np.array([[i["fx_px"], 0.0, i["cx_px"]], [0.0, i["fy_px"], i["cy_px"]], [0.0, 0.0, 1.0]])
    lens = tuple(float(d) for d in i.get("distortion", ()))
    return Camera(name, i["width_px"], i["height_px"], K, mount, mount_T_cam, model, lens)


def _view_from_dict(entry: Mapping[str, Any], where: str) -> LabelView:
    camera = camera_of(entry["camera"], entry["intrinsics"], "map", np.eye(4))
    t_s = np.array(entry["t_s"], dtype=np.float64)
    position = np.array(entry["translation_m"], dtype=np.float64).reshape(-1, 3)
    q = np.array(entry["rotation_wxyz"], dtype=np.float64).reshape(-1, 4)
    frame = np.array(entry["region_frame"], dtype=np.int64)
    box = np.array(entry["region_px"], dtype=np.float64).reshape(-1, 4)
    if not len(t_s) == len(position) == len(q):
        counts = f"{len(t_s)} stamps, {len(position)} translations, {len(q)} rotations"
        raise ScenarioError(f"{where}: {counts}; expected equal")
    if len(frame) != len(box) or np.any(frame >= len(t_s)):
        raise ScenarioError(f"{where}: region_frame must hold one index of a stamp for each of the {len(box)} regions")
    if np.any(np.diff(t_s) <= 0):
        raise ScenarioError(f"{where}: t_s does not increase at index {int(np.argmax(np.diff(t_s) <= 0)) + 1}")
    if np.any(np.abs(np.linalg.norm(q, axis=1) - 1) > ROTATION_TOLERANCE):
        raise ScenarioError(f"{where}: rotation_wxyz must hold unit quaternions, scalar first")
    return LabelView(camera, t_s, position, q, frame, box)


@dataclass(frozen=True, eq=False)
class Labels:
    """Labeled 3D boxes of a log in the map frame, one row a box and stamp."""

    __repr__ = short_repr

    t_ns: NDArray[np.int64]  # (L,): absolute stamps
    track_id: NDArray[np.str_]  # (L,)
    category: NDArray[np.str_]  # (L,)
    center_m: Array  # (L, 3), m: box centers
    size_m: Array  # (L, 3), m: length, width, height
    yaw_rad: Array  # (L,)
    # (L,): as the log states it; None where it states nothing and visibility is computed
    visible: NDArray[np.bool_] | None = None
    # The cameras in whose images alone objects were labeled; None when they were labeled all around
    cameras: tuple[str, ...] | None = None
    # (L,): the log's own word for the category, such as "Van"; None where the log has none of its own
    kind: NDArray[np.str_] | None = None
    # (L,): 0 fully visible, 1 partly occluded, 2 largely occluded, 3 unknown, as the log states it
    occlusion: NDArray[np.int64] | None = None
    # (F,): increasing stamps of all that was labeled, also where nothing was there; None where the log does not state it
    labeled_ns: NDArray[np.int64] | None = None
    # Categories that got no 3D boxes by the log's rules, such as bicycles without riders in KITTI
    never_labeled: tuple[str, ...] = ()

    def take(self, rows: NDArray[Any]) -> Labels:
        """Select rows."""
        of_all = ("cameras", "labeled_ns", "never_labeled")
        return replace(self, **{n: v[rows] for n, v in vars(self).items() if n not in of_all and v is not None})


@dataclass(frozen=True, eq=False)
class ImageLabels:
    """Labeled 2D boxes of one camera."""

    __repr__ = short_repr

    t_ns: NDArray[np.int64]  # (L,): absolute stamp of the frame
    box_px: Array  # (L, 4), px: u0, v0, u1, v1
    category: NDArray[np.str_]  # (L,)


@dataclass(frozen=True, eq=False)
class ImageRegions:
    """Parts of the images of one camera in which objects were left without labels."""

    __repr__ = short_repr

    t_ns: NDArray[np.int64]  # (L,): absolute stamp of the frame
    box_px: Array  # (L, 4), px: u0, v0, u1, v1


@dataclass(frozen=True, eq=False)
class Sweep:
    """One LiDAR sweep."""

    __repr__ = short_repr

    stamp_ns: int  # absolute time of the sweep
    xyz_m: NDArray[np.floating[Any]]  # (N, 3), m: finite points in `frame`
    frame: Literal["lidar", "map"] = "lidar"  # "lidar": the sensor's frame; "map": already motion-compensated
    # (N,): absolute stamps at which the points were measured; None when the log has none
    t_ns: NDArray[np.int64] | None = None
    # For the frame "lidar": stamp of the pose to which all points are compensated; None where each is at its own time
    compensated_ns: int | None = None
    # (N,): how strong each return is, on the scale of its LiDAR; NaN where the log does not tell. None where the log has none.
    intensity: NDArray[np.float32] | None = None

    def thinned(self, most: int) -> Sweep:
        """Return every second, third ... of the points, at most so many; all as they are where there are no more."""
        kept = slice(None, None, max(-(-len(self.xyz_m) // most), 1))
        t_ns = None if self.t_ns is None else self.t_ns[kept]
        intensity = None if self.intensity is None else self.intensity[kept]
        return replace(self, xyz_m=self.xyz_m[kept], t_ns=t_ns, intensity=intensity)


@dataclass(frozen=True, eq=False)
class Tick:
    """One synchronized moment of a log."""

    t_ns: int  # absolute stamp
    t_s: float  # since the first tick of the log
    # (H, W, 3) uint8 BGR by camera with a frame near the tick, decoded when asked for; `RecordError` for an unreadable one
    images: Mapping[str, NDArray[np.uint8]]
    sweeps: Mapping[str, Sweep]  # by LiDAR, likewise
    image_ns: Mapping[str, int]  # absolute stamps of the frames
    map_T_ego: Array | None  # (4, 4): pose of the ego; None where it is not known
    # (N, 3), m, map frame: of all sweeps, each point where the sensor was at its own time. Made when they are first asked for.
    points: Deferred[Array] = Deferred()

    def __repr__(self) -> str:
        """Return the time and the sensors, nothing of which is read."""
        return f"<Tick at {self.t_s:.3f} s: {', '.join([*self.images, *self.sweeps]) or 'no record'}>"


@dataclass(frozen=True, eq=False)
class Lidar:
    """A LiDAR and where it is mounted."""

    __repr__ = short_repr

    name: str
    mount: Mount  # frame that it is fixed in: on the vehicle or at the roadside
    mount_T_lidar: Array  # (4, 4)


@dataclass(frozen=True, eq=False)
class Stream:
    """The records of one sensor in the order of the log."""

    __repr__ = short_repr

    name: str  # of the sensor
    t_ns: Deferred[NDArray[np.int64]] = Deferred()  # (F,): absolute, increasing; may be a function that reads them
    # Returns record `i`: (H, W, 3) uint8 BGR of a camera, a `Sweep` of a LiDAR. Raises `RecordError` for a record that cannot be read.
    # Several threads may call it at once.
    read: Callable[[int], Any]  # type: ignore[misc]  # `t_ns` is a descriptor, it has no default
    # Returns the bytes of the file that the log holds of record `i`, of an image a JPEG or PNG: they, the stamp and the name of the
    # stream determine all that `read` returns. None where it holds none, or where reading takes no longer
    encoded: Callable[[int], bytes] | None = None


@dataclass(frozen=True)
class MapFrame:
    """Where the map frame lies on Earth: local x, y, z + `offset_m` are coordinates of `projection`."""

    latitude_deg: float | None = None  # of the map's origin; None when unknown
    longitude_deg: float | None = None
    altitude_m: float | None = None
    projection: str | None = None  # a PROJ string; None for a map that is only local
    # m: what was taken off large map coordinates so that the rest keeps its digits, in whole kilometers; where the coordinates of
    # the log do not count from the origin of `projection`, the distance between the two origins is added
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class EgoVehicle:
    """The ego's box."""

    size_m: tuple[float, float, float] = (4.6, 1.9, 1.6)  # length, width, height
    rear_axle_offset_m: float = 1.4  # from the ego's origin forward to the center of the box


@dataclass(frozen=True, eq=False)
class Log:
    """An opened log. The records of its streams are read on request; what is `Deferred` may be a function that reads it."""

    name: str
    format: str  # name of the reader
    cameras: Mapping[str, Camera]  # by name, as `lidars` and `streams`
    lidars: Mapping[str, Lidar]
    streams: Mapping[str, Stream]
    ego: PoseTrack | None = None  # None for a log of roadside sensors only
    ego_vehicle: EgoVehicle = field(default_factory=EgoVehicle)
    map: MapFrame = field(default_factory=MapFrame)
    labels: Deferred[Labels | None] = Deferred(None)
    image_labels: Mapping[str, ImageLabels] = field(default_factory=dict)  # by camera
    ignored_regions: Mapping[str, ImageRegions] = field(default_factory=dict)  # by camera
    ground_z_ego_m: Deferred[float] = Deferred(0.0)  # of the road in the ego frame; 0 when its origin is on the ground
    reference_camera: str | None = None  # the camera whose stamps make the ticks
    digest: str = ""  # SHA-256 over the log's index
    notes: Deferred[tuple[str, ...]] = Deferred(())  # remarks of the reader for the report
    calibrations: Mapping[str, str] = field(default_factory=dict)  # by sensor: where its calibration is, for messages
    # What only this format has, as JSON values, for `log2sim inspect`; for example the topics of a bag
    details: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return name, format and sensors in one line, without reading what is not read yet."""
        counts = [(len(self.cameras), "camera"), (len(self.lidars), "LiDAR")]
        parts = [f"{count} {noun}{'s' * (count != 1)}" for count, noun in counts if count]
        known = [t_ns for s in self.streams.values() if not callable(t_ns := vars(s)["t_ns"]) and len(t_ns)]
        known += [self.ego.t_ns] if self.ego is not None and not known else []
        if known:
            parts.append(f"{(max(int(t[-1]) for t in known) - min(int(t[0]) for t in known)) / NS_PER_S:.1f} s")
        return f"<Log {self.name!r:.80} ({self.format}): {', '.join(parts) or 'no sensors'}>"

    def _repr_html_(self) -> str | None:
        """Return what a notebook shows: the sensors, and a picture of each camera."""
        return plugins.html_or_none(self)

    def ticks(
        self, cameras: Sequence[str] = (), *, start_s: float | None = None, stop_s: float | None = None
    ) -> Sequence[Tick]:
        """Return the synchronized moments of the log; their pictures and sweeps are read when they are asked for.

        `cameras`: all of the log where it is empty. `start_s`, `stop_s`: keep the ticks in between, s after the first one.
        Raises `ConfigError` for an unknown camera, and where no tick is left; `LogError` for a log without cameras and LiDARs,
        or with stamps that do not increase.

        Examples
        --------
        >>> for tick in log.ticks():
        ...     print(tick.t_s, tick.images["front"].shape, len(tick.points))
        """
        ticks: Sequence[Tick] = plugins.call("ticks_of", self, tuple(cameras), start_s=start_s, stop_s=stop_s)
        return ticks

    def truth(self, cameras: Sequence[str] = ()) -> Any:
        """Return the labeled objects and the ego as a scenario, for `evaluate`, `plot` and a first look.

        `cameras`: that were used, what they show counts as visible; all of the log where it is empty. Returns a `Scenario`.
        Raises `LogError` for a log without labels.
        """
        return plugins.call("truth_of", self, cameras=tuple(cameras) or None)

    def show(self, when: float | Tick | None = None, *, camera: str | Sequence[str] = (), scenario: Any = None) -> Any:
        """Draw boxes and LiDAR points on the pictures of one moment.

        `when`: seconds after the first tick, or a tick of `ticks`; by default a moment in the middle. `camera`: one or several;
        all where it is empty. `scenario`: its agents are drawn in place of the labels of the log. Returns a
        `log2sim.visualization.notebook.Picture`, which a notebook shows, `save` writes, and whose `figure` is the figure.

        Raises `ConfigError` for an unknown camera, and for a time outside the log.
        """
        return plugins.call("show_log", self, when, camera=camera, scenario=scenario)

    def changed(self, **changes: Any) -> Log:
        """Return the log with other values of some fields; unlike `dataclasses.replace`, what is deferred stays deferred."""
        unknown = set(changes) - {f.name for f in fields(self)}
        if unknown:
            raise TypeError(f"a log has no field {', '.join(sorted(unknown))}")
        log = copy(self)
        log.__dict__.update(changes)
        return log

    def ego_centers(self, map_T_ego: Array) -> Array:
        """Compute the centers (N, 3), m, map frame, of the ego's box at ego poses (N, 4, 4)."""
        up_m = self.ground_z_ego_m + self.ego_vehicle.size_m[2] / 2
        center = map_T_ego @ np.array([self.ego_vehicle.rear_axle_offset_m, 0.0, up_m, 1.0])
        return np.asarray(center[:, :3])

    def map_T_sensor(self, name: str, t_ns: Any) -> tuple[Array, NDArray[np.bool_]]:
        """Interpolate the poses (N, 4, 4) of a camera or LiDAR at absolute stamps (N,), and whether they are known (N,).

        They always are for a sensor fixed in the map.
        """
        sensor = self.cameras.get(name) or self.lidars[name]
        mount_T_sensor = sensor.mount_T_cam if isinstance(sensor, Camera) else sensor.mount_T_lidar
        t = np.atleast_1d(np.asarray(t_ns, dtype=np.int64))
        if sensor.mount == "map":
            return np.repeat(mount_T_sensor[None], len(t), axis=0), np.ones(len(t), dtype=bool)
        if self.ego is None:
            return np.repeat(np.eye(4)[None], len(t), axis=0), np.zeros(len(t), dtype=bool)
        map_T_ego, valid = self.ego.at(t)
        return map_T_ego @ mount_T_sensor, valid


@dataclass(frozen=True, eq=False)
class Turn:
    """Which tiles of a picture are to be searched: every second one, those between at the next turn, and those of some boxes."""

    number: int  # whether even or odd decides which tiles are due
    watched_px: Array  # (K, 4): u0, v0, u1, v1 of boxes whose tiles are searched at every turn


@dataclass(frozen=True, eq=False)
class Frame:
    """One camera frame as a detector gets it."""

    camera: Camera
    t_ns: int  # absolute stamp
    image: Callable[[], NDArray[np.uint8]]  # decodes the frame when called: (H, W, 3) uint8 BGR
    # Returns the file that `image` decodes, where the log holds one. Raises `RecordError` for one that cannot be read.
    encoded: Callable[[], bytes] | None = None
    turn: Turn | None = None  # None: the whole picture is to be searched


VEHICLE, ROAD = "vehicle", "road"
ENDS = (VEHICLE, ROAD)
"""The ends in the order of the columns of `seen_by`."""

Span = tuple[float, float]
"""First and last time, s."""


def end_of(sensor: Camera | Lidar) -> str:
    """Return the end that a sensor belongs to: the vehicle's if it is mounted on the ego, else the road's."""
    return VEHICLE if sensor.mount == "ego" else ROAD


def seen_from(end: str, count: int) -> NDArray[np.bool_]:
    """Return (count, 2) for rows that one end alone saw; no end for an empty name."""
    return np.tile([end == name for name in ENDS], (count, 1))


def retime_spans(
    observed_by: Mapping[str, tuple[Span, ...]], change: Callable[[float], float], *, begin_s: float = -np.inf
) -> dict[str, tuple[Span, ...]]:
    """Put the spans of each end elsewhere in time by `change`, s to s; what ends before `begin_s` is left out."""
    moved = {end: [(change(first), change(last)) for first, last in spans] for end, spans in observed_by.items()}
    return {end: tuple((max(a, begin_s), b) for a, b in spans if b >= begin_s) for end, spans in moved.items()}
