"""A scenario and its log as messages of Foxglove's schemas, in protobuf."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log as LogMessage
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextAnnotation_pb2 import TextAnnotation
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from log2sim.datatypes import Agent, explain_doubt
from log2sim.export import viewers
from log2sim.geometry import NS_PER_S, Array, quaternion_from_rotation, transform

MAP = "map"
BOX_ALPHA, PATH_ALPHA = 0.6, 0.9
LABEL_ABOVE_M = 0.5
PATH_PX, OUTLINE_PX, TEXT_PX = 2.0, 2.0, 12.0
PLUMB_BOB = 5  # number of coefficients of this model; with more it is called rational
Message = tuple[int, str, Any]  # time in ns, topic and message


def scene_messages(steps: viewers.AgentSteps, origin: Array) -> Iterator[Message]:
    """Yield the paths, then at every step the present boxes and the ego's frame; positions less `origin` (3,)."""
    stamps, moves = steps
    first_ns, paths = int(stamps[0]), []
    for agent, _ in moves:
        w = agent.waypoints
        ground = np.column_stack([w.x_m, w.y_m, w.z_m - agent.size_m[2] / 2]) - origin
        line = LinePrimitive(
            type=LinePrimitive.LINE_STRIP, pose=_pose(np.zeros(3), 0.0), thickness=PATH_PX, scale_invariant=True,
            points=[Point3(x=x, y=y, z=z) for x, y, z in ground.tolist()], color=_color(agent, PATH_ALPHA),
        )  # fmt: skip
        paths.append(SceneEntity(timestamp=_stamp(first_ns), frame_id=MAP, id=agent.id, lines=[line]))
    yield first_ns, "/paths", SceneUpdate(entities=paths)
    for k, t_ns in enumerate(stamps.tolist()):
        here = [(a, m.position_m[k] - origin, float(m.yaw_rad[k])) for a, m in moves if m.valid[k]]
        gone = SceneEntityDeletion(timestamp=_stamp(t_ns), type=SceneEntityDeletion.ALL)
        yield t_ns, "/agents", SceneUpdate(deletions=[gone], entities=[_box(t_ns, *at) for at in here])
        for agent, position, yaw in here:
            if agent.id == "ego":
                yield t_ns, "/tf", _frame(t_ns, "ego", viewers.ego_pose(agent, position, yaw))


def record_messages(record: viewers.ViewerRecord, origin: Array) -> Iterable[Message]:
    """Return the messages of one record of the log."""
    if isinstance(record, viewers.UnreadableRecord):
        stamp, level = _stamp(record.t_ns), LogMessage.WARNING
        text = LogMessage(timestamp=stamp, level=level, name=record.stream, message=record.reason)
        return [(record.t_ns, "/log", text)]
    if isinstance(record, viewers.ThinnedSweep):
        data, real = (record.points_map - origin).astype("<f4").tobytes(), PackedElementField.FLOAT32
        columns = [PackedElementField(name=n, offset=4 * i, type=real) for i, n in enumerate("xyz")]
        cloud = PointCloud(
            timestamp=_stamp(record.t_ns), frame_id=MAP, pose=_pose(np.zeros(3), 0.0), point_stride=12, fields=columns, data=data,
        )  # fmt: skip
        return [(record.t_ns, f"/lidar/{record.lidar}", cloud)]
    return _picture(record, origin)


def _stamp(t_ns: int) -> Timestamp:
    return Timestamp(seconds=t_ns // NS_PER_S, nanos=t_ns % NS_PER_S)


def _color(agent: Agent, alpha: float) -> Color:
    r, g, b = (v / 255 for v in viewers.rgb_of(agent))
    return Color(r=r, g=g, b=b, a=alpha)


def _pose(position: Array, yaw_rad: float) -> Pose:
    x, y, z = position.tolist()
    turn = Quaternion(x=0.0, y=0.0, z=float(np.sin(yaw_rad / 2)), w=float(np.cos(yaw_rad / 2)))
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=turn)


def _box(t_ns: int, agent: Agent, position: Array, yaw_rad: float) -> SceneEntity:
    length, width, height = map(float, agent.size_m)
    above = position + np.array([0.0, 0.0, height / 2 + LABEL_ABOVE_M])
    about = {"category": agent.category, "static": str(agent.static).lower(), "confidence": f"{agent.confidence:g}"}
    if agent.is_doubtful:
        about["doubtful"] = explain_doubt(agent)
    name = TextPrimitive(
        pose=_pose(above, 0.0), billboard=True, font_size=TEXT_PX, scale_invariant=True, text=agent.id, color=_color(agent, 1.0),
    )  # fmt: skip
    cube = CubePrimitive(
        pose=_pose(position, yaw_rad), size=Vector3(x=length, y=width, z=height), color=_color(agent, BOX_ALPHA)
    )
    metadata = [KeyValuePair(key=key, value=value) for key, value in about.items()]
    return SceneEntity(timestamp=_stamp(t_ns), frame_id=MAP, id=agent.id, cubes=[cube], texts=[name], metadata=metadata)


def _frame(t_ns: int, child: str, map_T_child: Array) -> FrameTransform:
    (w, qx, qy, qz), (x, y, z) = quaternion_from_rotation(map_T_child[:3, :3]).tolist(), map_T_child[:3, 3].tolist()
    rotation = Quaternion(x=qx, y=qy, z=qz, w=w)
    translation = Vector3(x=x, y=y, z=z)
    return FrameTransform(
        timestamp=_stamp(t_ns), parent_frame_id=MAP, child_frame_id=child, translation=translation, rotation=rotation
    )


def _picture(record: viewers.CameraFrame, origin: Array) -> Iterator[Message]:
    name, t_ns = record.camera.name, record.t_ns
    stamp, topic = _stamp(t_ns), f"/camera/{name}"
    if record.map_T_cam is not None:
        yield t_ns, "/tf", _frame(t_ns, name, transform(record.map_T_cam[:3, :3], record.map_T_cam[:3, 3] - origin))
    camera = record.camera
    known = {"none": ("", 0), "fisheye": ("kannala_brandt", 4)}
    few = len(camera.distortion) <= PLUMB_BOB
    model, count = known.get(camera.distortion_model, ("plumb_bob", PLUMB_BOB) if few else ("rational_polynomial", 8))
    coefficients = [*camera.distortion, *[0.0] * count][:count]
    K, P = camera.K.ravel().tolist(), np.column_stack([camera.K, np.zeros(3)]).ravel().tolist()
    yield t_ns, f"{topic}/calibration", CameraCalibration(
        timestamp=stamp, frame_id=name, width=camera.width_px, height=camera.height_px, distortion_model=model,
        D=coefficients, K=K, R=np.eye(3).ravel().tolist(), P=P,
    )  # fmt: skip
    yield t_ns, f"{topic}/image", CompressedImage(timestamp=stamp, frame_id=name, data=record.jpeg, format="jpeg")
    lines, texts = [], []
    for agent, outline in record.outlines:
        uv, color = outline.reshape(-1, 2), _color(agent, 1.0)
        points, (u, v) = [Point2(x=u, y=v) for u, v in uv.tolist()], uv.min(axis=0).tolist()
        lines.append(PointsAnnotation(
            timestamp=stamp, type=PointsAnnotation.LINE_LIST, points=points, outline_color=color, thickness=OUTLINE_PX,
        ))  # fmt: skip
        place = Point2(x=u, y=v)
        label, size = agent.id, TEXT_PX
        texts.append(TextAnnotation(timestamp=stamp, position=place, text=label, font_size=size, text_color=color))
    yield t_ns, f"{topic}/boxes", ImageAnnotations(timestamp=stamp, points=lines, texts=texts)
