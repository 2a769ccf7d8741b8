"""ROS 1 bags, ROS 2 bags and MCAP files as logs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import Lidar, Log, MapFrame, Stream
from log2sim.datatypes.log import camera_of
from log2sim.errors import ConfigError, LogError, RecordError
from log2sim.files.inputs import require_link_inside
from log2sim.geometry import NS_PER_S, Array, Camera, Mount, PoseTrack, RollingShutter, inverse
from log2sim.logs.records import FolderReader
from log2sim.logs.ros import frames as ego
from log2sim.logs.ros import sensors as calibration
from log2sim.logs.ros.bag import NAME_BYTES, SUFFIXES, Bag, Recording, Topic, find_recordings
from log2sim.logs.ros.containers import printable
from log2sim.logs.ros.frames import FrameTree
from log2sim.logs.ros.messages import (
    CameraTopic,
    LidarTopic,
    Stamped,
    TopicSettings,
    decode_bytes,
    note_other_clocks,
    read_settings,
    stamp_messages,
)
from log2sim.logs.ros.poses import FoundPoses, PoseSources
from log2sim.logs.ros.roles import FIXED_FRAMES, Roles, assign_roles
from log2sim.logs.ros.sensors import camera_stream, lidar_stream

MAX_LISTED = 8


class RosReader(FolderReader):
    """Reader of ROS 1 bags, rosbag2 folders and databases, and MCAP files."""

    name = "ros"
    looks_for = "a ROS bag: a .bag, .db3 or .mcap file, a rosbag2 folder with metadata.yaml, or a folder of bags"
    suffixes = SUFFIXES

    def find(self, path: Path) -> dict[str, Recording]:
        """Find the recordings at a path by name."""
        return find_recordings(path)

    def open(self, path: Path, sequence: str) -> Log:
        """Open a recording: its index, the stamps of its messages, its transforms and poses."""
        recording = self.find(path)[sequence]
        if path.is_dir():
            for bag in recording.files:
                require_link_inside(bag, path)
        settings, file = read_settings(recording.settings)
        return _Opening(sequence, Bag(recording), settings, file).log()


READER = RosReader()


class _Opening:
    """One log while it is opened; collects notes."""

    def __init__(self, name: str, bag: Bag, settings: TopicSettings, file: Path | None) -> None:
        self.name, self.bag, self.settings, self.file = name, bag, settings, file
        self.roles: Roles = assign_roles(bag, settings, file)
        self.messages = bag.collect(self._wanted())
        self.notes = [*bag.notes, *self.roles.notes]
        self.tree = FrameTree(str(bag.place))
        for topic in self.roles.topics.get("tf", ()):
            self._add_transforms(bag.topics[topic])
        if self.tree.refused:
            self.notes.append(f"{self.tree.refused} transforms are not finite or no rotations; left out")
        self.tree.add_static(settings.static_transforms)

    def log(self) -> Log:
        sensors = list(self._sensors().values())
        if not sensors:
            topics = [f"{t.name} ({t.msgtype}, {len(t)})" for t in self.bag.topics.values()]
            more = f" and {len(topics) - MAX_LISTED} more" if len(topics) > MAX_LISTED else ""
            there = f"its topics are {', '.join(topics[:MAX_LISTED])}{more}" if topics else "it has no topics"
            raise LogError(f"{self.bag.place}: no images with CameraInfo and no point clouds in it; {there}")
        base, why = ego.choose_base(
            self.tree, [s.frame for s in sensors], self._pose_frames(), FIXED_FRAMES, self.settings.ego.base_frame
        )
        frame = ego.place_ego(base, self.settings.ego, self.tree, {c.frame for c in self.roles.cameras.values()})
        stamped = self._stamps()
        span_ns = min(int(s.t_ns[0]) for s in stamped.values()), max(int(s.t_ns[-1]) for s in stamped.values())
        found, considered = self._poses(base, span_ns)
        mounts = self._mounts(frame)
        cameras = self._cameras(mounts)
        lidars = {n: Lidar(n, *mounts[n]) for n in self.roles.lidars if n in mounts}
        streams = {n: camera_stream(self.bag, self.roles.cameras[n], stamped[n], c) for n, c in cameras.items()}
        streams |= {n: lidar_stream(self.bag, n, self.roles.lidars[n], stamped[n]) for n in lidars}
        if not streams:
            raise LogError(f"{self.bag.place}: none of its sensors can be used: {'; '.join(self.notes)}")
        self._note_poses(found, considered, base)
        self.notes += frame.notes

        measured = cache(partial(ego.measure_road, frame, lidars, streams))
        known_m = frame.ground_z_m
        place, chosen = self.bag.place, self.roles.cameras
        places = dict.fromkeys(lidars, f"{place}, transforms")
        for n in cameras:
            places[n] = f"{place}, {chosen[n].info}" if chosen[n].intrinsics is None else f"{self.file}"
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
            reference_camera=self._reference_camera(cameras, streams),
            digest=self.bag.digest,
            notes=(lambda: (*self.notes, *measured()[1])) if known_m is None else tuple(self.notes),
            calibrations=places,
            details={
                "settings": None if self.file is None else self.file.name,
                "files": [container.path.name for container in self.bag.files],
                "topics": self.roles.table(self.bag),
                "base_frame": {"name": base, "reason": why},
                "poses": considered,
                "frames": self.tree.describe(),
            },
        )

    def _sensors(self) -> dict[str, CameraTopic | LidarTopic]:
        return {**self.roles.lidars, **self.roles.cameras}

    def _wanted(self) -> dict[str, int | None]:
        """Topics that are read at opening, with the number of bytes; None for whole messages."""
        roles = self.roles
        heads: dict[str, int | None] = {s.topic: NAME_BYTES for s in self._sensors().values()}
        infos = {c.info for c in roles.cameras.values() if c.info}
        # An IMU is read for the orientation that fixes lack.
        kinds = ("tf", "odometry", "pose", "gnss") + (("imu",) if "gnss" in roles.topics else ())
        return heads | dict.fromkeys([*infos, *(name for kind in kinds for name in roles.topics.get(kind, ()))])

    def _add_transforms(self, topic: Topic) -> None:
        damaged = 0
        for i, raw in enumerate(self.messages[topic.name]):
            try:
                self.tree.add(decode_bytes(topic, raw or b"", self.bag.where(topic, i)).transforms)
            except RecordError:
                damaged += 1
        if damaged:
            self.notes.append(f"{topic.name}: {damaged} of {len(topic)} messages are damaged and left out")

    def _pose_frames(self) -> list[str]:
        """Frames whose poses the odometry topics give."""
        frames = []
        for name in self.roles.topics.get("odometry", ()):
            raw = next((raw for raw in self.messages[name] if raw is not None), None)
            if raw is not None:
                message = decode_bytes(self.bag.topics[name], raw, name)
                frames.append(printable(message.child_frame_id).lstrip("/"))
        return [frame for frame in frames if frame]

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

    def _note_poses(self, found: FoundPoses | None, considered: list[dict[str, Any]], base: str | None) -> None:
        if found is not None:
            self.notes += found.notes
            others = [f"{c['source']} {c['topic']}" for c in considered if not c["used"]]
            instead = f"; others: {', '.join(others)}" if others else ""
            self.notes.append(f"poses of '{base}' are from {found.source} {found.topic}{instead}")
        elif self.settings.poses.source == "none":
            self.notes.append('poses of the recording are not used: the settings state source = "none"')
        elif base is not None:
            reasons = "; ".join(f"{c['topic']}: {c['reason']}" for c in considered)
            self.notes.append(f"no poses of '{base}' in the recording{': ' * bool(reasons)}{reasons}")

    def _stamps(self) -> dict[str, Stamped]:
        stamped, delays = {}, {}
        for name, sensor in self._sensors().items():
            topic = self.bag.topics[sensor.topic]
            recorded = sensor.stamps == "recorded"
            stamped[name] = stamp_messages(topic, self.messages[topic.name], self.notes, recorded=recorded)
            delays[topic.name] = stamped[name].delay_s
            offset_ns = round(sensor.offset_s * NS_PER_S)
            stamped[name] = replace(stamped[name], t_ns=stamped[name].t_ns + offset_ns)
        for kind in ("odometry", "pose", "gnss"):
            for name in self.roles.topics.get(kind, ()):
                topic = self.bag.topics[name]
                delays[name] = stamp_messages(topic, self.messages[name], []).delay_s
        note_other_clocks(delays, self.notes)
        return stamped

    def _mounts(self, frame: ego.EgoFrame) -> dict[str, tuple[Mount, Array]]:
        """Pose of each sensor that has one, on the ego or, without a vehicle, in the map."""
        mounts: dict[str, tuple[Mount, Array]] = {}
        for name, sensor in self._sensors().items():
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

    def _info(self, chosen: CameraTopic) -> Any:
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
                    info, first = decode_bytes(topic, raw, self.bag.where(topic, i)), raw[12:]
                elif raw[12:] != first:
                    self.notes.append(
                        f"{chosen.info}: changes at message {i}; the first calibration is used throughout"
                    )
                    break
            except RecordError:
                continue
        if info is None:
            raise calibration.CalibrationProblem(f"no message of {chosen.info} can be read")
        return info

    def _reference_camera(self, cameras: dict[str, Camera], streams: dict[str, Stream]) -> str | None:
        wanted = self.settings.reference_camera
        if wanted is None:
            return max(cameras, key=lambda name: len(streams[name].t_ns), default=None)
        if wanted not in cameras:
            raise ConfigError(
                f"{self.file}: 'reference_camera' is '{wanted}'; there are: {', '.join(cameras) or 'none'}"
            )
        return wanted
