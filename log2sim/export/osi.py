"""Export to ground-truth traces of ASAM OSI, the Open Simulation Interface, through betterosi."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import Agent, MapFrame, Scenario
from log2sim.errors import MissingExtra
from log2sim.export.exporters import Options
from log2sim.export.osi_map import static_map, traffic_lights
from log2sim.export.sampling import SampledMotion, file_name
from log2sim.export.viewers.playback import agent_steps
from log2sim.geometry import NS_PER_S

SOURCE = "io.log2sim.scenario"
AXLE_OF_HEIGHT = 0.2  # height of the wheel hubs above ground as a share of the vehicle's height; not measured

# Names in OSI's `MovingObject.VehicleClassification.Type`, whose types include the rider.
VEHICLE_TYPE = {
    "car": "CAR", "truck": "HEAVY_TRUCK", "bus": "BUS", "motorcycle": "MOTORCYCLE", "cyclist": "BICYCLE", "bicycle": "BICYCLE",
}  # fmt: skip


class Osi:
    """`<time>_gt_<OSI>_<protobuf>_<frames>_<name>.osi`: one `GroundTruth` every 0.1 s, stamped with absolute time.

    Parked vehicles are moving objects too, as in the standard. `source_reference` holds the id and category of each
    agent, and what speaks against it.
    """

    options: tuple[str, ...] = ()
    loses = (
        "uncertainty and observed flags, whether vehicles are static, times between steps of 0.1 s, confidences of lanes and"
        " markings, cameras, stages"
    )

    def write(self, scenario: Scenario, folder: Path, options: Options) -> None:
        """Write the trace."""
        try:
            import betterosi
        except ImportError:
            raise MissingExtra("export to OSI", "osi") from None
        steps = agent_steps(scenario)
        head = _head(betterosi, scenario)
        ground = static_map(betterosi, scenario, first=len(scenario.agents) + 1)
        with betterosi.Writer(folder / _trace_name(betterosi, scenario, len(steps.t_ns))) as writer:
            for k, stamp_ns in enumerate(steps.t_ns.tolist()):
                alive = [(n, a, m) for n, (a, m) in enumerate(steps.moves, start=1) if m.valid[k]]
                truth = betterosi.GroundTruth(
                    **head,
                    lane=ground.lanes,
                    lane_boundary=ground.boundaries,
                    road_marking=ground.markings,
                    traffic_light=traffic_lights(
                        betterosi, scenario, ground.next_id, (stamp_ns - scenario.t0_ns) / NS_PER_S
                    ),
                    timestamp=betterosi.Timestamp(seconds=stamp_ns // NS_PER_S, nanos=stamp_ns % NS_PER_S),
                    moving_object=[_moving(betterosi, n, a, m, k) for n, a, m in alive if not _stationary(a)],
                    stationary_object=[_still(betterosi, n, a, m, k) for n, a, m in alive if _stationary(a)],
                )
                writer.add(truth)


def _stationary(agent: Agent) -> bool:
    return agent.static and agent.category == "other"


def _trace_name(osi: Any, scenario: Scenario, frames: int) -> str:
    """Return the file name that the standard prescribes, with the scenario's start time."""
    start = datetime.fromtimestamp(scenario.t0_ns // NS_PER_S, UTC).strftime("%Y%m%dT%H%M%SZ")
    versions = osi.prepare_channel_metadata()
    keys = (osi.OSI_CHANNEL_OSI_VERSION_KEY, osi.OSI_CHANNEL_PROTOBUF_VERSION_KEY)
    standard, protobuf = (versions[key].replace(".", "") for key in keys)
    return f"{start}_gt_{standard}_{protobuf}_{frames}_{file_name(scenario.name)}.osi"


def _head(osi: Any, scenario: Scenario) -> dict[str, Any]:
    """Return the fields that all frames share."""
    major, minor, patch = map(int, osi.__version_osi__.split("."))
    head: dict[str, Any] = {
        "version": osi.InterfaceVersion(version_major=major, version_minor=minor, version_patch=patch),
        "proj_frame_offset": _offset(osi, scenario.map),
    }
    if scenario.map.projection is not None:
        head["proj_string"] = scenario.map.projection
    if scenario.ego is not None:
        head["host_vehicle_id"] = osi.Identifier(value=scenario.agents.index(scenario.ego) + 1)
    return head


def _offset(osi: Any, frame: MapFrame) -> Any:
    """Return the offset from the coordinates of the trace to those of its projection."""
    x, y, z = frame.offset_m
    return osi.GroundTruth.ProjFrameOffset(position=osi.Vector3d(x=x, y=y, z=z), yaw=0.0)


def _place(osi: Any, agent: Agent, move: SampledMotion, k: int) -> dict[str, Any]:
    """Return size and pose of the bounding box. OSI's angles lie in (-pi, pi], ours in [-pi, pi)."""
    length, width, height = map(float, agent.size_m)
    x, y, z = move.position_m[k].tolist()
    yaw = float(move.yaw_rad[k])
    return {
        "dimension": osi.Dimension3d(length=length, width=width, height=height),
        "position": osi.Vector3d(x=x, y=y, z=z),
        "orientation": osi.Orientation3d(roll=0.0, pitch=0.0, yaw=-yaw if yaw == -np.pi else yaw),
    }


def _identity(osi: Any, number: int, agent: Agent) -> dict[str, Any]:
    reference = osi.ExternalReference(
        type=SOURCE, identifier=[agent.id, agent.category, *(d.reason for d in agent.doubts)]
    )
    identity: dict[str, Any] = {"id": osi.Identifier(value=number), "source_reference": [reference]}
    if agent.color is not None:
        red, green, blue = (float(v) / 255 for v in agent.color["rgb"])
        identity["color_description"] = osi.ColorDescription(rgb=osi.ColorRGB(red=red, green=green, blue=blue))
    return identity


def _moving(osi: Any, number: int, agent: Agent, move: SampledMotion, k: int) -> Any:
    (vx, vy), (ax, ay) = move.velocity_mps[k].tolist(), move.acceleration_mps2[k].tolist()
    base = osi.BaseMoving(
        **_place(osi, agent, move, k),
        velocity=osi.Vector3d(x=vx, y=vy, z=0.0),
        acceleration=osi.Vector3d(x=ax, y=ay, z=0.0),
    )
    return osi.MovingObject(base=base, **_identity(osi, number, agent), **_kind(osi, agent))


def _kind(osi: Any, agent: Agent) -> dict[str, Any]:
    moving = osi.MovingObject
    if agent.category not in VEHICLE_TYPE:
        return {"type": moving.Type.PEDESTRIAN if agent.category == "pedestrian" else moving.Type.OTHER}
    kind = moving.VehicleClassification
    axle_z = (AXLE_OF_HEIGHT - 0.5) * agent.size_m[2]
    to_rear = osi.Vector3d(x=-float(agent.rear_axle_offset_m), y=0.0, z=float(axle_z))
    return {
        "type": moving.Type.VEHICLE,
        "vehicle_attributes": moving.VehicleAttributes(bbcenter_to_rear=to_rear),
        "vehicle_classification": kind(
            type=kind.Type[VEHICLE_TYPE[agent.category]], role=kind.Role.CIVIL, has_trailer=False
        ),
    }


def _still(osi: Any, number: int, agent: Agent, move: SampledMotion, k: int) -> Any:
    kind = osi.StationaryObject.Classification
    return osi.StationaryObject(
        base=osi.BaseStationary(**_place(osi, agent, move, k)),
        classification=kind(type=kind.Type.OTHER),
        **_identity(osi, number, agent),
    )


EXPORTER = Osi()
