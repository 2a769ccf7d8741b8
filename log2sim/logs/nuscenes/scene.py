"""One scene of nuScenes: its samples, the records of its sensors and the ego poses of all of them."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError
from log2sim.geometry import Array, PoseTrack, rotation_from_quaternion, transform
from log2sim.links import inside
from log2sim.logs.nuscenes.tables import (
    DATA,
    SCENES,
    Record,
    Tables,
    numbers_of,
    quaternions_of,
    stamp_ns_of,
    text_of,
)
from log2sim.logs.stamps import strictly_increasing

# Names of sensors become names of files.
CHANNEL = re.compile(r"[A-Za-z0-9_-]{1,64}")


@dataclass(frozen=True, eq=False)
class Channel:
    """One sensor of a scene.

    Attributes
    ----------
    name : str
        Such as CAM_FRONT.
    modality : str
        "camera", "lidar" or "radar".
    calibration : Record
        Of calibrated_sensor.
    ego_T_sensor : (4, 4) float64
    records : list of Record
        Of sample_data, key frames and sweeps, by their stamps, with files or without.
    t_ns : (F,) int64
    """

    name: str
    modality: str
    calibration: Record
    ego_T_sensor: Array
    records: list[Record]
    t_ns: NDArray[np.int64]

    def present(self, root: Path, where: Path) -> tuple[list[Record], NDArray[np.int64], list[Path]]:
        """Select the records whose files are there: records, stamps (F,) and files."""
        files = [inside(root, text_of(record, "filename", where), str(where)) for record in self.records]
        rows = [k for k, file in enumerate(files) if file.is_file()]
        return [self.records[k] for k in rows], self.t_ns[rows], [files[k] for k in rows]


@dataclass(frozen=True, eq=False)
class Scene:
    """The records of one scene.

    Attributes
    ----------
    tables : Tables
    record : Record
        Of scene.
    notes : list of str
        Takes what is wrong with the stamps.
    """

    tables: Tables
    record: Record
    notes: list[str] = field(default_factory=list)

    @cached_property
    def samples(self) -> list[Record]:
        """Key frames by their stamps."""
        path = self.tables.path("sample")
        token = text_of(self.record, "token", self.tables.path(SCENES))
        samples = self.tables.matching("sample", "scene_token", [token])
        if not samples:
            raise LogError(f"{path}: no sample of scene '{self.record.get('name')}'; expected its key frames")
        by_token = {text_of(sample, "token", path): sample for sample in samples}
        if len(by_token) < len(samples):
            self.notes.append(
                f"sample.json: {len(samples) - len(by_token)} key frames are there twice; each counts once"
            )
        stated = self.record.get("nbr_samples")
        if isinstance(stated, int) and len(by_token) < stated:
            self.notes.append(
                f"sample.json: {stated - len(by_token)} of the {stated} key frames of the scene are missing"
            )
        return sorted(by_token.values(), key=lambda sample: stamp_ns_of(sample, path))

    @cached_property
    def data(self) -> list[Record]:
        """Records of all sensors, in the order of the table."""
        path = self.tables.path("sample")
        data = self.tables.matching(DATA, "sample_token", {text_of(s, "token", path) for s in self.samples})
        if not data:
            raise LogError(f"{self.tables.path(DATA)}: no record of scene '{self.record.get('name')}'")
        return data

    @cached_property
    def channels(self) -> dict[str, Channel]:
        """Sensors by name."""
        path = self.tables.path("calibrated_sensor")
        used = {text_of(record, "calibrated_sensor_token", self.tables.path(DATA)) for record in self.data}
        calibrated = self.tables.by_token("calibrated_sensor", used)
        sensors = self.tables.all_of("sensor")
        by_name: dict[str, list[tuple[Record, Record]]] = {}
        for record in self.data:
            calibration = calibrated[record["calibrated_sensor_token"]]
            sensor = sensors.get(text_of(calibration, "sensor_token", path))
            if sensor is None:
                raise LogError(
                    f"{self.tables.path('sensor')}: no record with token '{calibration['sensor_token'][:40]}', "
                    "which calibrated_sensor.json names"
                )
            name = text_of(sensor, "channel", self.tables.path("sensor"))
            if not CHANNEL.fullmatch(name):
                raise LogError(
                    f"{self.tables.path('sensor')}: channel {name[:40]!a}, expected letters, digits, _ and -"
                )
            by_name.setdefault(name, []).append((record, calibration | {"modality": sensor.get("modality")}))
        return {name: self._channel(name, by_name[name]) for name in sorted(by_name)}

    def _channel(self, name: str, rows: list[tuple[Record, Record]]) -> Channel:
        calibration = rows[0][1]
        same = [record for record, other in rows if other["token"] == calibration["token"]]
        if len(same) < len(rows):
            self.notes.append(f"{name}: {len(rows) - len(same)} records of another calibration left out")
        stamps = np.array([stamp_ns_of(r, self.tables.path(DATA)) for r in same], dtype=np.int64)
        order = np.argsort(stamps, kind="stable")  # tables have no order
        keep, problems = strictly_increasing(stamps[order], name)
        self.notes.extend(problems)
        return Channel(
            name,
            str(calibration["modality"]),
            calibration,
            _pose_of(calibration, self.tables.path("calibrated_sensor")),
            [same[k] for k in order[keep]],
            stamps[order[keep]],
        )

    @cached_property
    def ego(self) -> PoseTrack:
        """Ego poses at the stamps of all sensors, without an offset; those of one stamp are the same."""
        path = self.tables.path("ego_pose")
        tokens = {text_of(record, "ego_pose_token", self.tables.path(DATA)) for record in self.data}
        records = list(self.tables.by_token("ego_pose", tokens).values())
        stamps = np.array([stamp_ns_of(record, path) for record in records], dtype=np.int64)
        poses = transform(
            rotation_from_quaternion(quaternions_of(records, path)), numbers_of(records, "translation", (3,), path)
        )
        t_ns, first = np.unique(stamps, return_index=True)
        return PoseTrack(t_ns, poses[first])

    @cached_property
    def location(self) -> str:
        """Name of the city and its quarter; "" when log.json does not state it."""
        logs = self.tables.all_of("log")
        return str(logs.get(str(self.record.get("log_token")), {}).get("location", ""))


def _pose_of(record: Record, path: Path) -> Array:
    """Pose (4, 4) of a record with rotation and translation."""
    rotation = rotation_from_quaternion(quaternions_of([record], path)[0])
    return transform(rotation, numbers_of([record], "translation", (3,), path)[0])
