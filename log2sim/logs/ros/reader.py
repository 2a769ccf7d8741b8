"""ROS 1 bags, ROS 2 bags and MCAP files as logs; which topic is which follows from message types and names, or from the settings."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import Lidar, Log, MapFrame
from log2sim.datatypes.log import camera_of
from log2sim.errors import ConfigError, LogError, RecordError
from log2sim.files import plugins
from log2sim.files.inputs import require_link_inside
from log2sim.geometry import NS_PER_S, Array, Camera, Mount, PoseTrack, RollingShutter, inverse
from log2sim.logs.records import FolderReader
from log2sim.logs.ros import frames as ego
from log2sim.logs.ros import messages
from log2sim.logs.ros import sensors as calibration
from log2sim.logs.ros.bag import NAME_BYTES, SUFFIXES, Bag, Topic, find_recordings
from log2sim.logs.ros.containers import printable
from log2sim.logs.ros.frames import BASE_FRAMES, FIXED_FRAMES, FoundPoses, FrameTree, PoseSources
from log2sim.logs.ros.sensors import COMPRESSED, camera_stream, lidar_stream

KINDS = {
    "sensor_msgs/msg/Image": "camera", **dict.fromkeys(messages.TYPES, "lidar"), COMPRESSED: "camera",
    "sensor_msgs/msg/PointCloud2": "lidar", "sensor_msgs/msg/CameraInfo": "camera info", "nav_msgs/msg/Odometry": "odometry",
    "sensor_msgs/msg/NavSatFix": "gnss", "sensor_msgs/msg/Imu": "imu", "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose", "tf2_msgs/msg/TFMessage": "tf", "tf/msg/tfMessage": "tf",
}  # fmt: skip
# Images and clouds that are computed from others, by words in their topics.
_DERIVED_IMAGE = re.compile(
    r"depth|disparity|mask|segment|label|debug|overlay|annotat|confidence|visuali[sz]|/theora|/h26"
)
_DERIVED_CLOUD = re.compile(
    r"map|obstacle|cluster|ground|filter|segment|object|debug|accumulat|global|local|feature|regist|voxel|radar|occupancy"
)
_TRANSPORT = re.compile(r"/(compressed|raw|image_transport)$")
_LAST_WORDS = re.compile(r"^(points?|point_?clouds?|clouds?|scan|image)(_?(raw|2|ex|rect|color|mono|packets))*$")


MAX_SENSOR_TOPICS = 1000
"""Of one kind among which the sensors are found by names, a comparison for every two; cars have some dozen sensors."""


@dataclass
class Roles:
    """What topics are used for: sensors by their name, with all topics filled in, other topics by kind, and why, by topic."""

    cameras: dict[str, messages.CameraTopic] = field(default_factory=dict)
    lidars: dict[str, messages.LidarTopic] = field(default_factory=dict)
    topics: dict[str, list[str]] = field(default_factory=dict)  # "camera info", "odometry", "pose", "gnss", "imu", "tf"
    reasons: dict[str, tuple[str, str]] = field(default_factory=dict)  # role and reason
    notes: list[str] = field(default_factory=list)


def assign_roles(bag: Bag, settings: messages.TopicSettings, file: Path | None) -> Roles:
    """Decide what each topic is used for.

    Raises `ConfigError` when the settings name a topic that is not there or of another type, `LogError` for more than
    `MAX_SENSOR_TOPICS` that no settings choose from.
    """
    roles = Roles()
    usable: dict[str, list[Topic]] = {}
    for name, topic in bag.topics.items():
        kind = KINDS.get(topic.msgtype)
        problem = (
            "it has no messages" if not len(topic) else None if kind is None else messages.find_layout_problem(topic)
        )
        if kind is None or problem:
            roles.reasons[name] = ("unused", problem or f"log2sim has no use for {topic.msgtype}")
            if kind and problem:
                roles.notes.append(f"{name}: not used: {problem}")
            elif "Video" in topic.msgtype:
                roles.notes.append(f"{name}: not used: {topic.msgtype} is video, which needs a decoder; record images")
            continue
        roles.reasons[name] = (kind, f"is {topic.msgtype}")
        usable.setdefault(kind, []).append(topic)
    roles.topics = {kind: [t.name for t in topics] for kind, topics in usable.items()}
    # Check that the topics of the settings exist and have messages of the right type
    poses = settings.poses
    kinds = ("odometry", "pose", "gnss", "tf") if poses.source in ("auto", "none") else (poses.source,)
    required: list[tuple[str, str, tuple[str, ...]]] = [
        *((f"cameras.{n}.topic", c.topic, ("camera",)) for n, c in settings.cameras.items()),
        *((f"lidars.{n}.topic", s.topic, ("lidar",)) for n, s in settings.lidars.items()),
    ]
    optional: list[tuple[str, str, tuple[str, ...]]] = [
        *((f"cameras.{n}.info", c.info, ("camera info",)) for n, c in settings.cameras.items()),
        ("poses.topic", poses.topic, kinds),
        ("poses.imu", poses.imu, ("imu",)),
    ]
    for key, name, expected in [*required, *(entry for entry in optional if entry[1])]:
        if name not in bag.topics:
            near = plugins.nearest(name, list(bag.topics))
            raise ConfigError(f"{file}: '{key}' is '{name}', but the recording has no such topic{near}")
        topic = bag.topics[name]
        problem = "it has no messages" if not len(topic) else None
        if KINDS.get(topic.msgtype) not in expected:
            types = ", ".join(t for t, k in KINDS.items() if k in expected)
            problem = f"it holds {topic.msgtype}, expected {types}"
        if problem or (problem := messages.find_layout_problem(topic)):
            raise ConfigError(f"{file}: '{key}' is '{name}', but {problem}")
    if settings.reference_camera and settings.cameras and settings.reference_camera not in settings.cameras:
        raise ConfigError(f"{file}: 'reference_camera' is '{settings.reference_camera}', which is not listed")
    for kind, listed in (("camera", settings.cameras), ("lidar", settings.lidars)):
        if len(usable.get(kind, ())) > MAX_SENSOR_TOPICS and not listed:
            raise LogError(
                f"{bag.place}: {len(usable[kind])} topics of the kind '{kind}', more than the {MAX_SENSOR_TOPICS} of which log2sim "
                "chooses; list those to use in the settings"
            )
    _assign_cameras(bag, usable.get("camera", []), settings, roles)
    _assign_lidars(bag, usable.get("lidar", []), settings, roles)
    return roles


def _assign_cameras(bag: Bag, topics: list[Topic], settings: messages.TopicSettings, roles: Roles) -> None:
    infos = roles.topics.get("camera info", [])
    roles.reasons |= dict.fromkeys(infos, ("unused", "no images belong to it"))
    chosen = dict(settings.cameras)
    if not chosen:
        groups: dict[str, list[Topic]] = {}
        for topic in _not_derived(topics, _DERIVED_IMAGE, "by its name no picture of a camera", roles):
            base = _TRANSPORT.sub("", topic.name)
            parent, _, last = base.rpartition("/")
            groups.setdefault(parent if last.startswith("image") and parent else base, []).append(topic)

        # Rectified before distorted, color before gray, as recorded before compressed, then many messages.
        def rank(topic: Topic) -> tuple[Any, ...]:
            name = topic.name.lower()
            return "rect" not in name, "mono" in name, topic.msgtype == COMPRESSED, -len(topic), name

        best = _best_of(groups, rank, "image of the same camera", roles)
        names = _short_names([_TRANSPORT.sub("", t.name) for t in best])
        chosen = {name: messages.CameraTopic(topic=topic.name) for name, topic in zip(names, best)}
    else:
        _drop_unlisted(topics, {c.topic for c in chosen.values()}, "camera", roles)
    origin = "by the settings" if settings.cameras else "by its type"
    for name, camera in chosen.items():
        topic = bag.topics[camera.topic]
        info = camera.info or ("" if camera.intrinsics else _find_info(bag, topic, infos))
        rectified = "rect" in camera.topic.lower() if camera.rectified is None else camera.rectified
        roles.cameras[name] = camera.model_copy(
            update={"info": info, "rectified": rectified, "frame": camera.frame or bag.frame_id(topic)}
        )
        calibration = f"calibrated by {info}" if info else "without CameraInfo"
        roles.reasons[camera.topic] = (f"camera {name}", f"{origin}, {calibration}")
        if info:
            roles.reasons[info] = (f"calibration of {name}", "named so" if camera.info else "same namespace or frame")


def _assign_lidars(bag: Bag, topics: list[Topic], settings: messages.TopicSettings, roles: Roles) -> None:
    chosen = dict(settings.lidars)
    if chosen:
        _drop_unlisted(topics, {s.topic for s in chosen.values()}, "lidar", roles)
    else:
        # Of the clouds in one frame the one that comes from the sensor.
        groups: dict[str, list[Topic]] = {}
        for topic in _not_derived(topics, _DERIVED_CLOUD, "by its name no cloud of a sensor", roles):
            frame = bag.frame_id(topic)
            if frame in FIXED_FRAMES:
                why = f"its points are in the fixed frame '{frame}', not in a sensor's"
                roles.reasons[topic.name] = ("unused", why)
            else:
                groups.setdefault(frame, []).append(topic)
        if set(groups) - set(BASE_FRAMES):
            for frame in set(groups) & set(BASE_FRAMES):
                for topic in groups.pop(frame):
                    why = f"its points are in '{frame}', so they are of several sensors"
                    roles.reasons[topic.name] = ("unused", why)
        best = _best_of(groups, lambda t: (-len(t), len(t.name), t.name), "cloud of the same frame", roles)
        names = [f"{n}_lidar" if n in roles.cameras else n for n in _short_names([t.name for t in best])]
        chosen = {name: messages.LidarTopic(topic=topic.name) for name, topic in zip(names, best)}
    for name, lidar in chosen.items():
        frame = lidar.frame or bag.frame_id(bag.topics[lidar.topic])
        roles.lidars[name] = lidar.model_copy(update={"frame": frame})
        origin = "by the settings" if name in settings.lidars else "by its type"
        roles.reasons[lidar.topic] = (f"lidar {name}", f"{origin}, in the frame '{frame}'")


def _drop_unlisted(topics: Iterable[Topic], listed: set[str], kind: str, roles: Roles) -> None:
    for topic in topics:
        if topic.name not in listed:
            roles.reasons[topic.name] = ("unused", f"the settings do not list it as a {kind}")


def _not_derived(topics: list[Topic], words: re.Pattern[str], why: str, roles: Roles) -> list[Topic]:
    """Leave out topics whose names show that they are computed from others; none where all names do."""
    kept = [topic for topic in topics if not words.search(topic.name.lower())]
    for topic in topics if kept else ():
        if topic not in kept:
            roles.reasons[topic.name] = ("unused", why)
    return kept or topics


def _best_of(groups: Mapping[str, list[Topic]], rank: Callable[[Topic], Any], what: str, roles: Roles) -> list[Topic]:
    best = []
    for group in groups.values():
        first, *others = sorted(group, key=rank)
        best.append(first)
        for other in others:
            roles.reasons[other.name] = ("unused", f"{what} as {first.name}")
    return sorted(best, key=lambda t: t.name)


def _find_info(bag: Bag, topic: Topic, infos: list[str]) -> str:
    """Find the CameraInfo of images: next to them, below them, or the only one of their frame."""
    base = _TRANSPORT.sub("", topic.name)
    parent = base.rpartition("/")[0]
    for name in (f"{parent}/camera_info", f"{base}/camera_info", f"{base}_info", f"{parent}/info"):
        if name in infos:
            return name
    below = [name for name in infos if name.startswith(f"{parent}/")] if parent else []
    frame = bag.frame_id(topic)
    same_frame = [name for name in infos if frame and bag.frame_id(bag.topics[name]) == frame]
    return next((names[0] for names in (below, same_frame) if len(names) == 1), "")


def _short_names(topics: list[str]) -> list[str]:
    """Names of sensors: as many of the last parts of their topics as distinguish them, without words such as "points"."""
    parts = []
    for topic in topics:
        words = [re.sub(r"[^A-Za-z0-9_-]", "_", word) for word in topic.split("/") if word]
        while len(words) > 1 and _LAST_WORDS.match(words[-1].lower()):
            words.pop()
        parts.append(words)
    names = []
    for words in parts:
        ends = (n for n in range(1, len(words)) if sum(other[-n:] == words[-n:] for other in parts) == 1)
        names.append("_".join(words[-next(ends, len(words)) :]))
    return [name if names.count(name) == 1 else "_".join(words) for name, words in zip(names, parts)]


MAX_LISTED = 8
# Delays between sensor and recorder are seconds at most; a larger one is another clock.
MAX_CLOCK_DIFFERENCE_S = 10.0


class RosReader(FolderReader):
    """Reader of ROS 1 bags, rosbag2 folders and databases, and MCAP files."""

    name = "ros"
    looks_for = "a ROS bag: a .bag, .db3 or .mcap file, a rosbag2 folder with metadata.yaml, or a folder of bags"
    suffixes = SUFFIXES
    find = staticmethod(find_recordings)

    def open(self, path: Path, sequence: str) -> Log:
        """Open a recording: its index, the stamps of its messages, its transforms and poses."""
        recording = self.find(path)[sequence]
        if path.is_dir():
            for bag in recording.files:
                require_link_inside(bag, path)
        settings, file = messages.read_settings(recording.settings)
        return _Opening(sequence, Bag(recording), settings, file).log()


READER = RosReader()


class _Opening:
    """One log while it is opened; collects notes."""

    def __init__(self, name: str, bag: Bag, settings: messages.TopicSettings, file: Path | None) -> None:
        self.name, self.bag, self.settings, self.file = name, bag, settings, file
        self.roles = roles = assign_roles(bag, settings, file)
        self.sensors: dict[str, messages.CameraTopic | messages.LidarTopic] = {**roles.lidars, **roles.cameras}
        # Topics that are read at once, with the number of bytes; None for whole messages. An IMU is read for the orientation that
        # fixes lack.
        kinds = ("tf", "odometry", "pose", "gnss") + (("imu",) if "gnss" in roles.topics else ())
        wanted: dict[str, int | None] = {s.topic: NAME_BYTES for s in self.sensors.values()}
        wanted |= dict.fromkeys({c.info for c in roles.cameras.values() if c.info})
        wanted |= dict.fromkeys(name for kind in kinds for name in roles.topics.get(kind, ()))
        self.messages = bag.collect(wanted)
        self.notes = [*bag.notes, *roles.notes]
        self.tree = FrameTree(str(bag.place))
        for topic in (bag.topics[name] for name in roles.topics.get("tf", ())):
            damaged = 0
            for i, raw in enumerate(self.messages[topic.name]):
                try:
                    self.tree.add(messages.decode_bytes(topic, raw or b"", bag.where(topic, i)).transforms)
                except RecordError:
                    damaged += 1
            if damaged:
                self.notes.append(f"{topic.name}: {damaged} of {len(topic)} messages are damaged and left out")
        if self.tree.refused:
            self.notes.append(f"{self.tree.refused} transforms are not finite or no rotations; left out")
        self.tree.add_static(settings.static_transforms)

    def log(self) -> Log:
        bag, roles, settings = self.bag, self.roles, self.settings
        if not self.sensors:
            topics = [f"{t.name} ({t.msgtype}, {len(t)})" for t in bag.topics.values()]
            more = f" and {len(topics) - MAX_LISTED} more" if len(topics) > MAX_LISTED else ""
            there = f"its topics are {', '.join(topics[:MAX_LISTED])}{more}" if topics else "it has no topics"
            raise LogError(f"{bag.place}: no images with CameraInfo and no point clouds in it; {there}")
        sensor_frames = [sensor.frame for sensor in self.sensors.values()]
        pose_frames = list[str]()  # whose poses the odometry topics give
        for name in roles.topics.get("odometry", ()):
            raw = next((raw for raw in self.messages[name] if raw is not None), None)
            if raw is not None:
                child = printable(messages.decode_bytes(bag.topics[name], raw, name).child_frame_id).lstrip("/")
                pose_frames += [child] if child else []
        base, why = ego.choose_base(self.tree, sensor_frames, pose_frames, settings.ego.base_frame)
        frame = ego.place_ego(base, settings.ego, self.tree, {c.frame for c in roles.cameras.values()})
        stamped = self._stamps()
        span_ns = min(int(s.t_ns[0]) for s in stamped.values()), max(int(s.t_ns[-1]) for s in stamped.values())
        found, considered = self._poses(base, span_ns)
        mounts = self._mounts(frame)
        cameras = self._cameras(mounts)
        lidars = {n: Lidar(n, *mounts[n]) for n in roles.lidars if n in mounts}
        streams = {n: camera_stream(bag, roles.cameras[n], stamped[n], c) for n, c in cameras.items()}
        streams |= {n: lidar_stream(bag, n, roles.lidars[n], stamped[n]) for n in lidars}
        if not streams:
            raise LogError(f"{bag.place}: none of its sensors can be used: {'; '.join(self.notes)}")
        if found is not None:
            others = [f"{c['source']} {c['topic']}" for c in considered if not c["used"]]
            instead = f"; others: {', '.join(others)}" if others else ""
            self.notes += [*found.notes, f"poses of '{base}' are from {found.source} {found.topic}{instead}"]
        elif settings.poses.source == "none":
            self.notes.append('poses of the recording are not used: the settings state source = "none"')
        elif base is not None:
            reasons = "; ".join(f"{c['topic']}: {c['reason']}" for c in considered)
            self.notes.append(f"no poses of '{base}' in the recording{': ' * bool(reasons)}{reasons}")
        self.notes += frame.notes
        reference = settings.reference_camera
        if reference is None:
            reference = max(cameras, key=lambda n: len(streams[n].t_ns), default=None)
        elif reference not in cameras:
            known = ", ".join(cameras) or "none"
            raise ConfigError(f"{self.file}: 'reference_camera' is '{reference}'; there are: {known}")

        measured = cache(partial(ego.measure_road, frame, lidars, streams))
        known_m = frame.ground_z_m
        places = dict.fromkeys(lidars, f"{bag.place}, transforms")
        for n in cameras:
            chosen = roles.cameras[n]
            places[n] = f"{bag.place}, {chosen.info}" if chosen.intrinsics is None else f"{self.file}"
        return Log(
            name=self.name,
            format=READER.name,
            cameras=cameras,
            lidars=lidars,
            streams=streams,
            ego=None if found is None else PoseTrack(found.t_ns, found.map_T_base @ frame.base_T_ego),
            ego_vehicle=frame.vehicle,
            map=MapFrame() if found is None else found.map,
            ground_z_ego_m=(lambda: measured()[0]) if known_m is None else known_m,
            reference_camera=reference,
            digest=bag.digest,
            notes=(lambda: (*self.notes, *measured()[1])) if known_m is None else tuple(self.notes),
            calibrations=places,
            details={
                "settings": None if self.file is None else self.file.name,
                "files": [container.path.name for container in bag.files],
                "topics": [
                    {"topic": name, "type": topic.msgtype, "messages": len(topic), "role": role, "reason": reason}
                    for name, topic in bag.topics.items()
                    for role, reason in (roles.reasons[name],)
                ],
                "base_frame": {"name": base, "reason": why},
                "poses": considered,
                "frames": self.tree.describe(),
            },
        )

    def _poses(self, base: str | None, span_ns: tuple[int, int]) -> tuple[FoundPoses | None, list[dict[str, Any]]]:
        wanted = self.settings.poses
        if base is None or wanted.source == "none":
            return None, []
        topics, given = self.roles.topics, self.settings.map
        sources = PoseSources(self.bag, topics, self.messages, self.tree, base, wanted, given, span_ns)
        found, considered = sources.find()
        if found is None and (wanted.source != "auto" or wanted.topic):
            reasons = "; ".join(f"{c['topic']}: {c['reason']}" for c in considered) or "the recording has no such topic"
            raise ConfigError(f"{self.file}: 'poses' asks for source '{wanted.source}', which gives none: {reasons}")
        return found, considered

    def _stamps(self) -> dict[str, messages.Stamped]:
        stamped, delays = {}, {}
        for name, sensor in self.sensors.items():
            topic = self.bag.topics[sensor.topic]
            recorded = sensor.stamps == "recorded"
            own = messages.stamp_messages(topic, self.messages[topic.name], self.notes, recorded=recorded)
            delays[topic.name] = own.delay_s
            stamped[name] = replace(own, t_ns=own.t_ns + round(sensor.offset_s * NS_PER_S))
        for kind in ("odometry", "pose", "gnss"):
            for name in self.roles.topics.get(kind, ()):
                delays[name] = messages.stamp_messages(self.bag.topics[name], self.messages[name], []).delay_s
        # Topics whose header stamps are of another clock than most, by their delay to the recorder.
        known = {name: delay for name, delay in delays.items() if delay is not None}
        # The middle one by size: of two, that of the recorder's clock.
        usual_s = sorted(known.values(), key=abs)[(len(known) - 1) // 2] if known else 0.0
        for name, delay_s in known.items():
            if abs(delay_s - usual_s) > MAX_CLOCK_DIFFERENCE_S:
                self.notes.append(
                    f"{name}: its header stamps are {delay_s - usual_s:.1f} s off those of the other topics, so its clock is "
                    'not synchronized; with stamps = "recorded" in the settings those of the recorder are used'
                )
        return stamped

    def _mounts(self, frame: ego.EgoFrame) -> dict[str, tuple[Mount, Array]]:
        """Pose of each sensor that has one, on the ego or, without a vehicle, in the map."""
        mounts: dict[str, tuple[Mount, Array]] = {}
        for name, sensor in self.sensors.items():
            if frame.base is None:
                in_map = self.tree.mount(self.tree.rigid_root(sensor.frame), sensor.frame)
                mounts[name] = ("map", np.eye(4) if in_map is None else in_map)
                continue
            base_T_sensor = self.tree.mount(frame.base, sensor.frame)
            if base_T_sensor is None:
                self.notes.append(
                    f"{sensor.topic}: left out, since no fixed transform leads from its frame '{sensor.frame}' to "
                    f"'{frame.base}'; give one as [[static_transforms]] in the settings"
                )
                continue
            mounts[name] = ("ego", inverse(frame.base_T_ego) @ base_T_sensor)
        return mounts

    def _cameras(self, mounts: dict[str, tuple[Mount, Array]]) -> dict[str, Camera]:
        cameras = {}
        frames = [c.frame for c in self.roles.cameras.values()]
        for name, chosen in self.roles.cameras.items():
            if name not in mounts:
                continue
            try:
                if chosen.intrinsics is not None:
                    cameras[name] = camera_of(name, chosen.intrinsics.model_dump(), *mounts[name])
                else:
                    stereo = frames.count(chosen.frame) > 1
                    cameras[name] = calibration.camera_from_info(
                        name, self._info(chosen), mounts[name], rectified=bool(chosen.rectified), stereo=stereo
                    )
                if chosen.rolling_shutter is not None:
                    shutter = RollingShutter(chosen.rolling_shutter.direction, chosen.rolling_shutter.readout_s)
                    cameras[name] = replace(cameras[name], rolling_shutter=shutter)
            except calibration.CalibrationProblem as problem:
                self.notes.append(
                    f"{chosen.topic}: left out: {problem}; give cameras.{name}.info or cameras.{name}.intrinsics in the settings"
                )
        return cameras

    def _info(self, chosen: messages.CameraTopic) -> Any:
        """First readable CameraInfo of a camera; a later one that differs is noted."""
        if not chosen.info:
            raise calibration.CalibrationProblem("no CameraInfo belongs to it by namespace or frame")
        topic, first, info = self.bag.topics[chosen.info], b"", None
        for i, raw in enumerate(self.messages[chosen.info]):
            if raw is None:
                continue
            try:
                # A header of constant length precedes the calibration.
                if info is None:
                    info, first = messages.decode_bytes(topic, raw, self.bag.where(topic, i)), raw[12:]
                elif raw[12:] != first:
                    self.notes.append(f"{chosen.info}: changes at message {i}; the first one is used throughout")
                    break
            except RecordError:
                continue
        if info is None:
            raise calibration.CalibrationProblem(f"no message of {chosen.info} can be read")
        return info
