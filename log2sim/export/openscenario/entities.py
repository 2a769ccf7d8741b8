"""Agents as OpenSCENARIO entities: type, size about the rear axle, color, axles, and properties for an import."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import Agent
from log2sim.export.xml_text import element, escaped, number

PREFIX = "log2sim."
"""Prefix of the properties that only `log2sim import` reads."""


@dataclass(frozen=True)
class VehicleDefaults:
    """Values that OpenSCENARIO requires and scenarios do not contain; the limits are only wide enough for the scenario.

    Attributes
    ----------
    category : str
        OpenSCENARIO's vehicle category.
    wheel_diameter_m, max_steering_rad, max_speed_mps, max_acceleration_mps2 : float
    tracks : bool
        Whether an axle has two wheels.
    """

    category: str
    wheel_diameter_m: float
    max_steering_rad: float
    max_speed_mps: float
    max_acceleration_mps2: float
    tracks: bool = True


VEHICLE_DEFAULTS: Mapping[str, VehicleDefaults] = {
    "car": VehicleDefaults("car", 0.65, 0.6, 70.0, 10.0),
    "truck": VehicleDefaults("truck", 1.0, 0.7, 40.0, 8.0),
    "bus": VehicleDefaults("bus", 1.0, 0.7, 40.0, 8.0),
    "motorcycle": VehicleDefaults("motorbike", 0.6, 0.7, 80.0, 12.0, tracks=False),
    "cyclist": VehicleDefaults("bicycle", 0.68, 1.0, 20.0, 8.0, tracks=False),
    "bicycle": VehicleDefaults("bicycle", 0.68, 1.0, 20.0, 8.0, tracks=False),
    "other": VehicleDefaults("van", 0.65, 0.6, 70.0, 10.0),
}
PEDESTRIAN_MASS_KG = 75.0
# Wheelbase as a share of the length where the scenario has no rear axle, and track as a share of the width.
WHEELBASE_SHARE, TRACK_SHARE = 0.6, 0.85


def add_entity(parent: Element, agent: Agent, name: str, minor: int, *, external: bool = False) -> None:
    """Add the `ScenarioObject` of an agent for revision 1.`minor`; an `external` one is driven from outside."""
    scenario_object = element("ScenarioObject", parent, name=name)
    if agent.category == "pedestrian":
        about = {"model": "walker"} if minor == 0 else {}  # required by 1.0, deprecated since
        body = element(
            "Pedestrian", scenario_object, name=agent.category, mass=number(PEDESTRIAN_MASS_KG), pedestrianCategory="pedestrian", **about
        )  # fmt: skip
        _add_box(body, agent)
    else:
        kind = VEHICLE_DEFAULTS[agent.category]
        body = element("Vehicle", scenario_object, name=agent.category, vehicleCategory=kind.category)
        _add_box(body, agent)
        _add_limits(body, agent, kind)
    _add_properties(body, agent, minor)
    if external and minor > 0:
        controller = element("Controller", element("ObjectController", scenario_object), name="ExternalController")
        properties = element("Properties", controller)
        element("Property", properties, name="esminiController", value="ExternalController")
        element("Property", properties, name="useGhost", value="false")


def _add_box(parent: Element, agent: Agent) -> None:
    length, width, height = agent.size_m
    box = element("BoundingBox", parent)
    element("Center", box, x=number(agent.rear_axle_offset_m), y="0", z=number(height / 2))
    element("Dimensions", box, width=number(width), length=number(length), height=number(height))


def _add_limits(parent: Element, agent: Agent, kind: VehicleDefaults) -> None:
    length, width, _ = agent.size_m
    fastest = float(np.abs(agent.waypoints.speed_mps).max())
    acceleration = number(kind.max_acceleration_mps2)
    element(
        "Performance", parent, maxSpeed=number(max(kind.max_speed_mps, fastest)), maxAcceleration=acceleration, maxDeceleration=acceleration
    )  # fmt: skip
    wheelbase = 2 * agent.rear_axle_offset_m if agent.rear_axle_offset_m > 0 else WHEELBASE_SHARE * length
    shared = {
        "wheelDiameter": number(kind.wheel_diameter_m),
        "trackWidth": number(TRACK_SHARE * width if kind.tracks else 0.0),
        "positionZ": number(kind.wheel_diameter_m / 2),
    }
    axles = element("Axles", parent)
    element("FrontAxle", axles, maxSteering=number(kind.max_steering_rad), positionX=number(wheelbase), **shared)
    element("RearAxle", axles, maxSteering="0", positionX="0", **shared)


def _add_properties(parent: Element, agent: Agent, minor: int) -> None:
    """Add the properties that players use (`type` of ScenarioRunner, `color` in its form or esmini's), then those for an import."""
    w = agent.waypoints
    values = {"type": "ego_vehicle" if agent.id == "ego" else "simulation"}
    if agent.color is not None:
        rgb = [int(v) for v in agent.color["rgb"]]
        values["color"] = ",".join(map(str, rgb)) if minor == 0 else "#" + "".join(f"{v:02X}" for v in rgb)
        values[PREFIX + "color_name"] = escaped(str(agent.color["name"]))
    values |= {
        PREFIX + "id": escaped(agent.id),
        PREFIX + "category": agent.category,
        PREFIX + "static": str(agent.static).lower(),
        PREFIX + "confidence": number(agent.confidence),
        PREFIX + "speed_mps": " ".join(number(v, 4) for v in w.speed_mps),
        PREFIX + "sigma_xy_m": " ".join(number(v, 4) for v in w.sigma_xy_m),
        PREFIX + "observed": "".join("1" if v else "0" for v in w.observed),
    }
    for key in w.OPTIONAL_FLOATS:
        if (column := getattr(w, key)) is not None:
            values[PREFIX + key] = " ".join(number(v, 4) for v in column)
    if agent.doubts:
        values[PREFIX + "doubts"] = escaped(json.dumps([doubt.to_dict() for doubt in agent.doubts]))
    properties = element("Properties", parent)
    for name, value in values.items():
        element("Property", properties, name=name, value=value)
