"""Which topic is which: by message types and names, or by the settings."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from log2sim.errors import ConfigError, LogError
from log2sim.files import plugins
from log2sim.logs.ros import messages
from log2sim.logs.ros.bag import Bag, Topic
from log2sim.logs.ros.frames import BASE_FRAMES
from log2sim.logs.ros.messages import CameraTopic, LidarTopic, TopicSettings, find_layout_problem

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CLOUD, CAMERA_INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo"
ODOMETRY, FIX, IMU = "nav_msgs/msg/Odometry", "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
KINDS = {
    IMAGE: "camera", **dict.fromkeys(messages.TYPES, "lidar"), COMPRESSED: "camera", CLOUD: "lidar", CAMERA_INFO: "camera info", ODOMETRY: "odometry",
    FIX: "gnss", IMU: "imu", **dict.fromkeys(POSES, "pose"), **dict.fromkeys(TRANSFORMS, "tf"),
}  # fmt: skip
FIXED_FRAMES = ("map", "world", "earth", "odom")
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

    cameras: dict[str, CameraTopic] = field(default_factory=dict)
    lidars: dict[str, LidarTopic] = field(default_factory=dict)
    topics: dict[str, list[str]] = field(default_factory=dict)  # "camera info", "odometry", "pose", "gnss", "imu", "tf"
    reasons: dict[str, tuple[str, str]] = field(default_factory=dict)  # role and reason
    notes: list[str] = field(default_factory=list)

    def table(self, bag: Bag) -> list[dict[str, Any]]:
        """Return topic, type, number of messages, role and reason of all topics."""
        return [
            {
                "topic": name, "type": topic.msgtype, "messages": len(topic), "role": self.reasons[name][0],
                "reason": self.reasons[name][1],
            }
            for name, topic in bag.topics.items()
        ]  # fmt: skip


def assign_roles(bag: Bag, settings: TopicSettings, file: Path | None) -> Roles:
    """Decide what each topic is used for.

    Raises `ConfigError` when the settings name a topic that is not there or of another type, `LogError` for more than
    `MAX_SENSOR_TOPICS` that no settings choose from.
    """
    roles = Roles()
    usable: dict[str, list[Topic]] = {}
    for name, topic in bag.topics.items():
        kind = KINDS.get(topic.msgtype)
        problem = "it has no messages" if not len(topic) else None if kind is None else find_layout_problem(topic)
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
    _check_named(bag, settings, file)
    for kind, listed in (("camera", settings.cameras), ("lidar", settings.lidars)):
        if len(usable.get(kind, ())) > MAX_SENSOR_TOPICS and not listed:
            raise LogError(
                f"{bag.place}: {len(usable[kind])} topics of the kind '{kind}', more than the {MAX_SENSOR_TOPICS} of which log2sim "
                "chooses; list those to use in the settings"
            )
    _assign_cameras(bag, usable.get("camera", []), settings, roles)
    _assign_lidars(bag, usable.get("lidar", []), settings, roles)
    return roles


def _check_named(bag: Bag, settings: TopicSettings, file: Path | None) -> None:
    """Check that the topics of the settings exist and have messages of the right type."""
    named: list[tuple[str, str, tuple[str, ...]]] = [
        (f"cameras.{n}.topic", c.topic, ("camera",)) for n, c in settings.cameras.items()
    ]
    named += [(f"cameras.{n}.info", c.info, ("camera info",)) for n, c in settings.cameras.items() if c.info]
    named += [(f"lidars.{n}.topic", s.topic, ("lidar",)) for n, s in settings.lidars.items()]
    poses = settings.poses
    kinds = ("odometry", "pose", "gnss", "tf") if poses.source in ("auto", "none") else (poses.source,)
    named += [("poses.topic", poses.topic, kinds)] if poses.topic else []
    named += [("poses.imu", poses.imu, ("imu",))] if poses.imu else []
    for key, name, expected in named:
        if name not in bag.topics:
            near = plugins.nearest(name, list(bag.topics))
            raise ConfigError(f"{file}: '{key}' is '{name}', but the recording has no such topic{near}")
        topic = bag.topics[name]
        kind = KINDS.get(topic.msgtype)
        problem = "it has no messages" if not len(topic) else None
        if kind not in expected:
            types = ", ".join(t for t, k in KINDS.items() if k in expected)
            problem = f"it holds {topic.msgtype}, expected {types}"
        if problem or (problem := find_layout_problem(topic)):
            raise ConfigError(f"{file}: '{key}' is '{name}', but {problem}")
    if settings.reference_camera and settings.cameras and settings.reference_camera not in settings.cameras:
        raise ConfigError(f"{file}: 'reference_camera' is '{settings.reference_camera}', which is not listed")


def _assign_cameras(bag: Bag, topics: list[Topic], settings: TopicSettings, roles: Roles) -> None:
    infos = roles.topics.get("camera info", [])
    for name in infos:
        roles.reasons[name] = ("unused", "no images belong to it")
    chosen = dict(settings.cameras)
    if not chosen:
        best = _one_per_camera(topics, roles)
        names = _short_names([_image_base(t.name) for t in best])
        chosen = {name: CameraTopic(topic=topic.name) for name, topic in zip(names, best)}
    else:
        _drop_unlisted(topics, {c.topic for c in chosen.values()}, "camera", roles)
    for name, camera in chosen.items():
        topic = bag.topics[camera.topic]
        info = camera.info or ("" if camera.intrinsics else _find_info(bag, topic, infos))
        rectified = "rect" in camera.topic.lower() if camera.rectified is None else camera.rectified
        roles.cameras[name] = camera.model_copy(
            update={"info": info, "rectified": rectified, "frame": camera.frame or bag.frame_id(topic)}
        )
        origin = "by the settings" if camera.topic in {c.topic for c in settings.cameras.values()} else "by its type"
        calibration = f"calibrated by {info}" if info else "without CameraInfo"
        roles.reasons[camera.topic] = (f"camera {name}", f"{origin}, {calibration}")
        if info:
            roles.reasons[info] = (f"calibration of {name}", "named so" if camera.info else "same namespace or frame")


def _assign_lidars(bag: Bag, topics: list[Topic], settings: TopicSettings, roles: Roles) -> None:
    chosen = dict(settings.lidars)
    if chosen:
        _drop_unlisted(topics, {s.topic for s in chosen.values()}, "lidar", roles)
    else:
        best = _one_per_frame(bag, topics, roles)
        names = [f"{n}_lidar" if n in roles.cameras else n for n in _short_names([t.name for t in best])]
        chosen = {name: LidarTopic(topic=topic.name) for name, topic in zip(names, best)}
    for name, lidar in chosen.items():
        frame = lidar.frame or bag.frame_id(bag.topics[lidar.topic])
        roles.lidars[name] = lidar.model_copy(update={"frame": frame})
        origin = "by the settings" if name in settings.lidars else "by its type"
        roles.reasons[lidar.topic] = (f"lidar {name}", f"{origin}, in the frame '{frame}'")


def _drop_unlisted(topics: Iterable[Topic], listed: set[str], kind: str, roles: Roles) -> None:
    for topic in topics:
        if topic.name not in listed:
            roles.reasons[topic.name] = ("unused", f"the settings do not list it as a {kind}")


def _one_per_camera(topics: list[Topic], roles: Roles) -> list[Topic]:
    """Of the images of one camera (raw, rectified, in color, compressed) the best."""
    groups: dict[str, list[Topic]] = {}
    for topic in _not_derived(topics, _DERIVED_IMAGE, "by its name no picture of a camera", roles):
        base = _image_base(topic.name)
        parent, _, last = base.rpartition("/")
        groups.setdefault(parent if last.startswith("image") and parent else base, []).append(topic)

    # Rectified before distorted, color before gray, as recorded before compressed, then many messages.
    def rank(topic: Topic) -> tuple[Any, ...]:
        name = topic.name.lower()
        return "rect" not in name, "mono" in name, topic.msgtype == COMPRESSED, -len(topic), name

    return _best_of(groups, rank, "image of the same camera", roles)


def _one_per_frame(bag: Bag, topics: list[Topic], roles: Roles) -> list[Topic]:
    """Of the clouds in one frame the one that comes from the sensor."""
    groups: dict[str, list[Topic]] = {}
    for topic in _not_derived(topics, _DERIVED_CLOUD, "by its name no cloud of a sensor", roles):
        frame = bag.frame_id(topic)
        if frame in FIXED_FRAMES:
            roles.reasons[topic.name] = ("unused", f"its points are in the fixed frame '{frame}', not in a sensor's")
        else:
            groups.setdefault(frame, []).append(topic)
    if set(groups) - set(BASE_FRAMES):
        for frame in set(groups) & set(BASE_FRAMES):
            for topic in groups.pop(frame):
                roles.reasons[topic.name] = ("unused", f"its points are in '{frame}', so they are of several sensors")
    return _best_of(groups, lambda t: (-len(t), len(t.name), t.name), "cloud of the same frame", roles)


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
    base = _image_base(topic.name)
    parent = base.rpartition("/")[0]
    for name in (f"{parent}/camera_info", f"{base}/camera_info", f"{base}_info", f"{parent}/info"):
        if name in infos:
            return name
    below = [name for name in infos if name.startswith(f"{parent}/")] if parent else []
    frame = bag.frame_id(topic)
    same_frame = [name for name in infos if frame and bag.frame_id(bag.topics[name]) == frame]
    return next((names[0] for names in (below, same_frame) if len(names) == 1), "")


def _image_base(name: str) -> str:
    return _TRANSPORT.sub("", name)


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
        kept = next(
            (n for n in range(1, len(words)) if sum(other[-n:] == words[-n:] for other in parts) == 1), len(words)
        )
        names.append("_".join(words[-kept:]))
    return [name if names.count(name) == 1 else "_".join(words) for name, words in zip(names, parts)]
