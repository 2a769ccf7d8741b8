"""Export to ground-truth traces of ASAM OSI, the Open Simulation Interface.

`<time>_gt_<OSI>_<protobuf>_<frames>_<name>.osi`: one `GroundTruth` every 0.1 s, stamped with absolute time. Parked vehicles are moving
objects too, as in the standard. `source_reference` holds the id and category of each agent, and what speaks against it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import Agent, MapFeatures, MapLane, Scenario
from log2sim.errors import MissingExtra
from log2sim.export.exporters import Options, SampledMotion, file_name
from log2sim.export.roads.network import MarkFinder, RoadMark
from log2sim.export.roads.opendrive import LIGHT_HEIGHT_M, LIGHT_WIDTH_M, edges_of, lanes
from log2sim.export.viewers import agent_steps
from log2sim.geometry import NS_PER_S, Array

BOUNDARY_TYPE = {"solid": "SOLID_LINE", "broken": "DASHED_LINE", "curb": "CURB", "none": "NO_LINE"}
BOUNDARY_COLOR = {"white": "WHITE", "yellow": "YELLOW", "standard": "UNKNOWN"}
# Color and mode by state; OSI has one lamp a light, so that red with yellow is written as yellow.
LIGHT = {
    "red": ("RED", "CONSTANT"), "red_yellow": ("YELLOW", "CONSTANT"), "yellow": ("YELLOW", "CONSTANT"), "green": ("GREEN", "CONSTANT"),
    "off": ("UNKNOWN", "OFF"), "unknown": ("UNKNOWN", "UNKNOWN"),
}  # fmt: skip


def _vector(osi: Any, xyz: Iterable[float]) -> Any:
    return osi.Vector3d(**{axis: float(v) for axis, v in zip("xyz", xyz)})


def _boundary(osi: Any, number: int, points: Array, mark: RoadMark) -> Any:
    kind = osi.LaneBoundary.Classification
    return osi.LaneBoundary(
        id=osi.Identifier(value=number),
        boundary_line=[osi.LaneBoundary.BoundaryPoint(position=_vector(osi, p), width=mark.width_m) for p in points],
        classification=kind(type=kind.Type[BOUNDARY_TYPE[mark.kind]], color=kind.Color[BOUNDARY_COLOR[mark.color]]),
    )


def _lane(osi: Any, lane: MapLane, number_of: dict[str, int], sides: Sequence[int]) -> Any:
    kind = osi.Lane.Classification
    inside = lane.junction is not None
    before, after = ([number_of[name] for name in names] for names in (lane.predecessors, lane.successors))
    # Every way through the lane; a side without lanes is left out, and so is the pairing where both are.
    ways_in, ways_out = [{"antecessor_lane_id": n} for n in before], [{"successor_lane_id": n} for n in after]
    pairs = [pair for a in ways_in or [{}] for b in ways_out or [{}] if (pair := {**a, **b})]
    sides_ids = (lane.left_lane, lane.right_lane)
    beside = [[] if name is None else [osi.Identifier(value=number_of[name])] for name in sides_ids]
    return osi.Lane(
        id=osi.Identifier(value=number_of[lane.id]),
        classification=kind(
            type=kind.Type.INTERSECTION if inside else kind.Type.DRIVING,
            subtype=kind.Subtype.UNKNOWN if inside else kind.Subtype.NORMAL,
            centerline=[_vector(osi, p) for p in lane.points_m],
            centerline_is_driving_direction=True,
            left_adjacent_lane_id=beside[0],
            right_adjacent_lane_id=beside[1],
            lane_pairing=[kind.LanePairing(**{k: osi.Identifier(value=n) for k, n in pair.items()}) for pair in pairs],
            left_lane_boundary_id=[osi.Identifier(value=sides[0])],
            right_lane_boundary_id=[osi.Identifier(value=sides[1])],
        ),
        source_reference=[osi.ExternalReference(type="io.log2sim.lane", identifier=[lane.id, lane.inferred_from])],
    )


def _marking(osi: Any, number: int, points: Array, color: str | None) -> Any:
    kind = osi.RoadMarking.Classification
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    length, width, _ = (high - low).tolist()
    paint = {"white": kind.Color.WHITE, "yellow": kind.Color.YELLOW}.get(color or "", kind.Color.UNKNOWN)
    return osi.RoadMarking(
        id=osi.Identifier(value=number),
        base=osi.BaseStationary(
            position=_vector(osi, middle),
            dimension=osi.Dimension3d(length=length, width=width, height=0.0),
            orientation=osi.Orientation3d(roll=0.0, pitch=0.0, yaw=0.0),
            base_polygon=[osi.Vector2d(x=x, y=y) for x, y, _ in (points - middle).tolist()],
        ),
        classification=kind(type=kind.Type.SYMBOLIC_TRAFFIC_SIGN, monochrome_color=paint),
    )


SOURCE = "io.log2sim.scenario"
AXLE_OF_HEIGHT = 0.2  # height of the wheel hubs above ground as a share of the vehicle's height; not measured
# Names in OSI's `MovingObject.VehicleClassification.Type`, whose types include the rider.
VEHICLE_TYPE = {
    "car": "CAR", "truck": "HEAVY_TRUCK", "bus": "BUS", "motorcycle": "MOTORCYCLE", "cyclist": "BICYCLE", "bicycle": "BICYCLE",
}  # fmt: skip
options: tuple[str, ...] = ()
loses = (
    "uncertainty and observed flags, whether vehicles are static, times between steps of 0.1 s, confidences of lanes and"
    " markings, cameras, stages"
)


def write(scenario: Scenario, folder: Path, options: Options) -> None:
    """Write the trace."""
    try:
        import betterosi
    except ImportError:
        raise MissingExtra("export to OSI", "osi") from None
    stamps, moves = agent_steps(scenario)
    # The fields that all frames share.
    major, minor, patch = map(int, betterosi.__version_osi__.split("."))
    head: dict[str, Any] = {
        "version": betterosi.InterfaceVersion(version_major=major, version_minor=minor, version_patch=patch),
        # From the coordinates of the trace to those of its projection.
        "proj_frame_offset": betterosi.GroundTruth.ProjFrameOffset(
            position=_vector(betterosi, scenario.map.offset_m), yaw=0.0
        ),
    }
    if scenario.map.projection is not None:
        head["proj_string"] = scenario.map.projection
    if scenario.ego is not None:
        head["host_vehicle_id"] = betterosi.Identifier(value=scenario.agents.index(scenario.ego) + 1)
    # What every frame repeats: lanes with their boundaries, and markings that are no lines, numbered after the agents.
    first = len(scenario.agents) + 1
    found, marks = lanes(scenario), MarkFinder(scenario)
    number_of = {lane.id: first + k for k, lane in enumerate(found)}
    ground: dict[str, list[Any]] = {"lane": [], "lane_boundary": []}
    for k, lane in enumerate(found):
        sides = [first + len(found) + 2 * k + side for side in (0, 1)]
        for number, points, name in zip(sides, edges_of(lane), (lane.left, lane.right)):
            ground["lane_boundary"].append(_boundary(betterosi, number, points, marks.mark(name)))
        ground["lane"].append(_lane(betterosi, lane, number_of, sides))
    free = first + 3 * len(found)
    painted = [m for m in (scenario.map_features or MapFeatures()).markings if not m.is_lane_line]
    ground["road_marking"] = [_marking(betterosi, free + k, m.points_m, m.color) for k, m in enumerate(painted)]
    # The file name that the standard prescribes, with the scenario's start time.
    start = datetime.fromtimestamp(scenario.t0_ns // NS_PER_S, UTC).strftime("%Y%m%dT%H%M%SZ")
    versions = betterosi.prepare_channel_metadata()
    keys = (betterosi.OSI_CHANNEL_OSI_VERSION_KEY, betterosi.OSI_CHANNEL_PROTOBUF_VERSION_KEY)
    standard, protobuf = (versions[key].replace(".", "") for key in keys)
    name = f"{start}_gt_{standard}_{protobuf}_{len(stamps)}_{file_name(scenario.name)}.osi"
    with betterosi.Writer(folder / name) as writer:
        for k, stamp_ns in enumerate(stamps.tolist()):
            alive = [(n, a, m) for n, (a, m) in enumerate(moves, start=1) if m.valid[k]]
            t_s = (stamp_ns - scenario.t0_ns) / NS_PER_S
            # The traffic lights of a scenario with their states at a time, numbered from `first` on
            kind = betterosi.TrafficLight.Classification
            out = []
            for number, signal in enumerate(scenario.signals, start=(free + len(painted))):
                color, mode = LIGHT[str(signal.at(np.array([t_s]))[0])]
                turn = betterosi.Orientation3d(roll=0.0, pitch=0.0, yaw=float(signal.heading_rad or 0.0))
                size = betterosi.Dimension3d(length=LIGHT_WIDTH_M, width=LIGHT_WIDTH_M, height=LIGHT_HEIGHT_M)
                out.append(betterosi.TrafficLight(
                    id=betterosi.Identifier(value=number),
                    base=betterosi.BaseStationary(position=_vector(betterosi, signal.position_m), dimension=size, orientation=turn),
                    classification=kind(color=kind.Color[color], mode=kind.Mode[mode], icon=kind.Icon.NONE, is_out_of_service=mode == "OFF"),
                    source_reference=[betterosi.ExternalReference(type="io.log2sim.signal", identifier=[signal.id])],
                ))  # fmt: skip
            writer.add(betterosi.GroundTruth(
                **head, **ground,
                traffic_light=out,
                timestamp=betterosi.Timestamp(seconds=stamp_ns // NS_PER_S, nanos=stamp_ns % NS_PER_S),
                moving_object=[_object(betterosi, n, a, m, k) for n, a, m in alive if not _stationary(a)],
                stationary_object=[_object(betterosi, n, a, m, k) for n, a, m in alive if _stationary(a)],
            ))  # fmt: skip


def _stationary(agent: Agent) -> bool:
    return agent.static and agent.category == "other"


def _object(osi: Any, number: int, agent: Agent, move: SampledMotion, k: int) -> Any:
    """Return an agent as a moving object or, where it is stationary, as a stationary one."""
    texts = [agent.id, agent.category, *(d.sentence for d in agent.doubts)]
    named: dict[str, Any] = {
        "id": osi.Identifier(value=number),
        "source_reference": [osi.ExternalReference(type=SOURCE, identifier=texts)],
    }
    if agent.color is not None:
        red, green, blue = (float(v) / 255 for v in agent.color["rgb"])
        named["color_description"] = osi.ColorDescription(rgb=osi.ColorRGB(red=red, green=green, blue=blue))
    length, width, height = map(float, agent.size_m)
    yaw = float(move.yaw_rad[k])
    placed = {
        "dimension": osi.Dimension3d(length=length, width=width, height=height),
        "position": _vector(osi, move.position_m[k]),
        # OSI's angles lie in (-pi, pi], ours in [-pi, pi).
        "orientation": osi.Orientation3d(roll=0.0, pitch=0.0, yaw=-yaw if yaw == -np.pi else yaw),
    }
    if _stationary(agent):
        kind = osi.StationaryObject.Classification
        still = osi.BaseStationary(**placed)
        return osi.StationaryObject(base=still, classification=kind(type=kind.Type.OTHER), **named)
    rates = {"velocity": move.velocity_mps[k], "acceleration": move.acceleration_mps2[k]}
    base = osi.BaseMoving(**placed, **{name: _vector(osi, (*rate, 0.0)) for name, rate in rates.items()})
    moving = osi.MovingObject
    if agent.category not in VEHICLE_TYPE:
        other = moving.Type.PEDESTRIAN if agent.category == "pedestrian" else moving.Type.OTHER
        return moving(base=base, **named, type=other)
    kind = moving.VehicleClassification
    to_rear = _vector(osi, (-agent.rear_axle_offset_m, 0.0, (AXLE_OF_HEIGHT - 0.5) * agent.size_m[2]))
    type_ = kind.Type[VEHICLE_TYPE[agent.category]]
    return moving(
        base=base, **named, type=moving.Type.VEHICLE,
        vehicle_attributes=moving.VehicleAttributes(bbcenter_to_rear=to_rear),
        vehicle_classification=kind(type=type_, role=kind.Role.CIVIL, has_trailer=False),
    )  # fmt: skip
