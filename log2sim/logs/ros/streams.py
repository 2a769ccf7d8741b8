"""Streams of images and clouds; their messages are decoded when they are read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Stream, Sweep
from log2sim.geometry import NS_PER_S, Camera
from log2sim.logs.ros import livox
from log2sim.logs.ros.bag import Bag
from log2sim.logs.ros.clouds import DEFAULT_PERIOD_NS, sweep_from
from log2sim.logs.ros.messages import decode
from log2sim.logs.ros.pictures import encoded_from, image_from, image_from_compressed
from log2sim.logs.ros.roles import COMPRESSED
from log2sim.logs.ros.settings import CameraTopic, LidarTopic
from log2sim.logs.ros.stamping import Stamped


def camera_stream(bag: Bag, chosen: CameraTopic, stamped: Stamped, camera: Camera) -> Stream:
    """Stream of the images of a camera; of compressed ones also as files."""
    topic, size_px = bag.topics[chosen.topic], (camera.width_px, camera.height_px)
    compressed = topic.msgtype == COMPRESSED

    def read(i: int) -> NDArray[np.uint8]:
        row = int(stamped.row[i])
        convert = image_from_compressed if compressed else image_from
        return convert(decode(bag, topic, row), bag.where(topic, row), size_px)

    def encoded(i: int) -> bytes:
        row = int(stamped.row[i])
        return encoded_from(decode(bag, topic, row), bag.where(topic, row))

    return Stream(camera.name, stamped.t_ns, read, encoded if compressed else None)


def lidar_stream(bag: Bag, name: str, chosen: LidarTopic, stamped: Stamped) -> Stream:
    """Stream of the sweeps of a LiDAR."""
    topic, offset_ns = bag.topics[chosen.topic], round(chosen.offset_s * NS_PER_S)
    period_ns = float(np.median(np.diff(stamped.t_ns))) if len(stamped.t_ns) > 1 else DEFAULT_PERIOD_NS

    def read(i: int) -> Sweep:
        row, t_ns = int(stamped.row[i]), int(stamped.t_ns[i]) - offset_ns
        where = bag.where(topic, row)
        if topic.msgtype in livox.TYPES:
            sweep = livox.sweep_from_livox(bag.read(topic, row), topic.encoding, t_ns, chosen, where)
        else:
            sweep = sweep_from(decode(bag, topic, row), t_ns, period_ns, chosen, where)
        return _later(sweep, offset_ns)

    return Stream(name, stamped.t_ns, read)


def _later(sweep: Sweep, offset_ns: int) -> Sweep:
    """Move all stamps of a sweep."""
    if not offset_ns:
        return sweep
    t_ns = None if sweep.t_ns is None else sweep.t_ns + offset_ns
    compensated_ns = None if sweep.compensated_ns is None else sweep.compensated_ns + offset_ns
    return replace(sweep, stamp_ns=sweep.stamp_ns + offset_ns, t_ns=t_ns, compensated_ns=compensated_ns)
