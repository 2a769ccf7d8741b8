"""A driving log: its sensors, the streams of their records, ego poses and labels.

All types are frozen dataclasses of columns; no code changes an array that one of them holds. Letters in shapes: N points,
M boxes, L labels, T ticks, F records of a stream.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim import late_functions
from log2sim.datatypes.deferred import Deferred
from log2sim.datatypes.labels import ImageLabels, ImageRegions, Labels
from log2sim.datatypes.tick import Tick
from log2sim.geometry import NS_PER_S, Array, Camera, Mount, PoseTrack
from log2sim.numerals import short_repr


@dataclass(frozen=True, eq=False)
class Lidar:
    """A LiDAR and where it is mounted.

    Attributes
    ----------
    name : str
    mount : {"ego", "map"}
        Frame that it is fixed in: on the vehicle or at the roadside.
    mount_T_lidar : (4, 4) float64
    """

    __repr__ = short_repr

    name: str
    mount: Mount
    mount_T_lidar: Array


@dataclass(frozen=True, eq=False)
class Stream:
    """The records of one sensor in the order of the log.

    Attributes
    ----------
    name : str
        Of the sensor.
    t_ns : (F,) int64
        Absolute stamps, increasing; may be given as a function that reads them.
    read : callable
        Returns record `i`: (H, W, 3) uint8 BGR of a camera, a `Sweep` of a LiDAR. Raises `RecordError` for a record that
        cannot be read. Several threads may call it at once.
    encoded : callable or None
        Returns the image of record `i` as the bytes of a JPEG or PNG file, as the log holds it, which hold all that `read`
        returns; None where it holds none.
    """

    __repr__ = short_repr

    name: str
    t_ns: Deferred[NDArray[np.int64]] = Deferred()
    read: Callable[[int], Any]  # type: ignore[misc]  # `t_ns` is a descriptor, it has no default
    encoded: Callable[[int], bytes] | None = None


@dataclass(frozen=True)
class MapFrame:
    """Where the map frame lies on Earth: local x, y, z + `offset_m` are coordinates of `projection`.

    Attributes
    ----------
    latitude_deg, longitude_deg, altitude_m : float or None
        Of the map's origin; None when unknown.
    projection : str or None
        A PROJ string; None for a map that is only local.
    offset_m : (3,) tuple of float, m
        What was taken off large map coordinates so that the rest keeps its digits, in whole kilometers; where the coordinates of
        the log do not count from the origin of `projection`, the distance between the two origins is added.
    """

    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    projection: str | None = None
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class EgoVehicle:
    """The ego's box.

    Attributes
    ----------
    size_m : (3,) tuple of float, m
        Length, width, height.
    rear_axle_offset_m : float, m
        From the ego's origin forward to the center of the box.
    """

    size_m: tuple[float, float, float] = (4.6, 1.9, 1.6)
    rear_axle_offset_m: float = 1.4


@dataclass(frozen=True, eq=False)
class Log:
    """An opened log. The records of its streams are read on request.

    Attributes
    ----------
    name : str
    format : str
        Name of the reader.
    cameras, lidars : mapping of str to Camera, Lidar
    streams : mapping of str to Stream
        By the name of the sensor.
    ego : PoseTrack or None
        None for a log of roadside sensors only.
    ego_vehicle : EgoVehicle
    map : MapFrame
    labels : Labels or None
        May be given as a function that reads them.
    image_labels : mapping of str to ImageLabels
        By camera.
    ignored_regions : mapping of str to ImageRegions
        By camera: where `labels` are incomplete.
    ground_z_ego_m : float, m
        Height of the road in the ego frame; 0 when the ego's origin lies on the ground. May be given as a function.
    reference_camera : str or None
        The camera whose stamps make the ticks.
    digest : str
        SHA-256 over the log's index.
    notes : tuple of str
        Remarks of the reader for the report; may be given as a function.
    calibrations : mapping of str to str
        By sensor: where its calibration is, for messages.
    details : mapping of str to Any
        What only this format has, as JSON values, for `log2sim inspect`; for example the topics of a bag.
    """

    name: str
    format: str
    cameras: Mapping[str, Camera]
    lidars: Mapping[str, Lidar]
    streams: Mapping[str, Stream]
    ego: PoseTrack | None = None
    ego_vehicle: EgoVehicle = field(default_factory=EgoVehicle)
    map: MapFrame = field(default_factory=MapFrame)
    labels: Deferred[Labels | None] = Deferred(None)
    image_labels: Mapping[str, ImageLabels] = field(default_factory=dict)
    ignored_regions: Mapping[str, ImageRegions] = field(default_factory=dict)
    ground_z_ego_m: Deferred[float] = Deferred(0.0)
    reference_camera: str | None = None
    digest: str = ""
    notes: Deferred[tuple[str, ...]] = Deferred(())
    calibrations: Mapping[str, str] = field(default_factory=dict)
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
        return late_functions.html_or_none(self)

    def ticks(
        self, cameras: Sequence[str] = (), *, start_s: float | None = None, stop_s: float | None = None
    ) -> Sequence[Tick]:
        """Return the synchronized moments of the log; their pictures and sweeps are read when they are asked for.

        Parameters
        ----------
        cameras : sequence of str
            All of the log where it is empty.
        start_s, stop_s : float, optional
            Keeps the ticks in [start, stop] seconds after the first one.

        Raises
        ------
        ConfigError
            For an unknown camera, and where no tick is left.
        LogError
            For a log without cameras and LiDARs, or with stamps that do not increase.

        Examples
        --------
        >>> for tick in log.ticks():
        ...     print(tick.t_s, tick.images["front"].shape, len(tick.points))
        """
        ticks: Sequence[Tick] = late_functions.call("ticks_of", self, tuple(cameras), start_s=start_s, stop_s=stop_s)
        return ticks

    def truth(self, cameras: Sequence[str] = ()) -> Any:
        """Return the labeled objects and the ego as a scenario, for `evaluate`, `plot` and a first look.

        Parameters
        ----------
        cameras : sequence of str
            Cameras that were used: what they show counts as visible; all of the log where it is empty.

        Returns
        -------
        log2sim.Scenario

        Raises
        ------
        LogError
            For a log without labels.
        """
        return late_functions.call("truth_of", self, cameras=tuple(cameras) or None)

    def show(self, when: float | Tick | None = None, *, camera: str | Sequence[str] = (), scenario: Any = None) -> Any:
        """Draw boxes and LiDAR points on the pictures of one moment.

        Parameters
        ----------
        when : float or Tick, optional
            Seconds after the first tick, or a tick of `ticks`; by default a moment in the middle.
        camera : str or sequence of str
            One camera or several; all where it is empty.
        scenario : Scenario, optional
            Its agents are drawn in place of the labels of the log.

        Returns
        -------
        log2sim.visualization.notebook.show.Picture
            A notebook shows it; `save` writes it, `figure` is the figure.

        Raises
        ------
        ConfigError
            For an unknown camera, and for a time outside the log.
        """
        return late_functions.call("show_log", self, when, camera=camera, scenario=scenario)

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
        """Interpolate the pose of a sensor.

        Parameters
        ----------
        name : str
            A camera or LiDAR of this log.
        t_ns : int or (N,) int64
            Absolute stamps.

        Returns
        -------
        map_T_sensor : (N, 4, 4) float64
        valid : (N,) bool
            Whether the ego pose is known there; always True for a sensor fixed in the map.
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
class Frame:
    """One camera frame as a detector gets it.

    Attributes
    ----------
    camera : Camera
    t_ns : int
        Absolute stamp.
    image : callable
        Decodes the frame when called: (H, W, 3) uint8 BGR.
    encoded : callable or None
        Returns the file that `image` decodes, where the log holds one. Raises `RecordError` for one that cannot be read.
    """

    camera: Camera
    t_ns: int
    image: Callable[[], NDArray[np.uint8]]
    encoded: Callable[[], bytes] | None = None
