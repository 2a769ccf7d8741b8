"""Export to OpenSCENARIO XML 1.0, 1.1 and 1.2 with an OpenDRIVE road."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.export.checks import require_start_as_in_scenario
from log2sim.export.exporters import Options
from log2sim.export.openscenario.entities import add_entity
from log2sim.export.openscenario.story import Revision, add_storyboard, agent_stories, start_poses
from log2sim.export.placement import ExportPlacement
from log2sim.export.roads.opendrive import add_road_file
from log2sim.export.xml_text import element, escaped, number, unique_names, write
from log2sim.geometry import Array

REVISIONS = {"1.0": Revision(0), "1.1": Revision(1), "1.2": Revision(2)}
NEWEST = "1.2"


class OpenScenario:
    """`scenario.xosc` and its road."""

    options: tuple[str, ...] = ("revision", "map")
    loses = (
        "states of traffic lights, confidences of lanes and markings, cameras, quality, stages and provenance; players take a"
        " cyclist for a bicycle and what is 'other' for a van (an import does not), and ScenarioRunner takes over no sizes"
    )

    def write(self, scenario: Scenario, folder: Path, options: Options) -> None:
        """Write the scenario and its road."""
        revision = REVISIONS.get(options.revision or NEWEST)
        if revision is None:
            known = ", ".join(REVISIONS)
            raise ConfigError(f"--revision {options.revision}: OpenSCENARIO XML is written as one of {known}")
        road, placement = add_road_file(scenario, folder, options.map)
        write(document(scenario, road, placement, revision), folder / "scenario.xosc")


EXPORTER = OpenScenario()


def document(scenario: Scenario, road: str, placement: ExportPlacement, revision: Revision) -> Element:
    """Return the document of a scenario whose road is in the file `road` beside it."""
    names = unique_names(a.id for a in scenario.agents)
    duration_s = max(scenario.duration_s, *(float(a.waypoints.t_s[-1]) for a in scenario.agents))
    stories = agent_stories(scenario.agents, names, duration_s, placement)
    require_start_as_in_scenario(scenario.agents, _boxes(scenario, start_poses(stories, revision)))
    root = element("OpenSCENARIO")
    element(
        "FileHeader", root,
        revMajor="1", revMinor=str(revision.minor), date=_date(scenario.t0_ns), author="log2sim", description=_title(scenario.name),
    )  # fmt: skip
    _add_parameters(root, scenario, placement)
    element("CatalogLocations", root)
    element("LogicFile", element("RoadNetwork", root), filepath=road)
    entities = element("Entities", root)
    for agent, name in zip(scenario.agents, names):
        add_entity(entities, agent, name, revision.minor)
    add_storyboard(root, stories, duration_s, revision)
    return root


def _boxes(scenario: Scenario, references: Array) -> Array:
    """Box centers and headings (A, 4) of agents whose reference points are at (A, 4)."""
    ahead_m = np.array([a.rear_axle_offset_m for a in scenario.agents])
    x, y, z, heading = references.T
    height_m = np.array([a.size_m[2] for a in scenario.agents])
    return np.column_stack([x + ahead_m * np.cos(heading), y + ahead_m * np.sin(heading), z + height_m / 2, heading])


def _add_parameters(root: Element, scenario: Scenario, placement: ExportPlacement) -> None:
    """Add what an import needs of the scenario as a whole; 1.0 and 1.1 have no properties without an agent."""
    values = {
        "log2sim_name": escaped(scenario.name),
        "log2sim_t0_ns": str(scenario.t0_ns),
        "log2sim_duration_s": number(scenario.duration_s, 9),
        "log2sim_map": escaped(json.dumps(vars(scenario.map))),
        "log2sim_origin_m": " ".join(number(v) for v in placement.origin_m),
    }
    if placement.target is not None:
        values["log2sim_projection"] = escaped(placement.target)
    parameters = element("ParameterDeclarations", root)
    for name, value in values.items():
        element("ParameterDeclaration", parameters, name=name, parameterType="string", value=value)


def _date(t0_ns: int) -> str:
    """When the scenario begins: the file's date too, so that the same scenario gives the same file."""
    try:
        moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=t0_ns // 1_000_000_000)
    except OverflowError:
        moment = datetime(1970, 1, 1, tzinfo=UTC)
    return moment.replace(tzinfo=None).isoformat(timespec="seconds")


def _title(name: str) -> str:
    """Return the scenario's name, escaped: a leading "CARLA:" would switch ScenarioRunner to left-handed axes."""
    return f"log2sim: {escaped(name)}"
