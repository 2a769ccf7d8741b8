"""Export to MCAP files with Foxglove's messages, for Foxglove, Lichtblick and Rerun.

`<name>.mcap`: `/agents`, `/paths`, `/tf`, and with a log `/camera/<name>/...` and `/lidar/<name>`. Times are those of the log, to the
nanosecond. The metadata record "log2sim" holds the offset of the positions and why agents are doubtful.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from log2sim.datatypes import Scenario, explain_doubt
from log2sim.errors import MissingExtra, ScenarioError
from log2sim.export.exporters import Options, file_name, near_origin
from log2sim.export.viewers import agent_steps, viewer_records

if TYPE_CHECKING:
    from log2sim.export.foxglove import Message


options: tuple[str, ...] = ("log",)
loses = (
    "uncertainty and observed flags, times between steps of 0.1 s, colors (boxes are colored by category), stages; of a "
    "log: full resolution of pictures wider than 960 px, and points beyond 10,000 a sweep"
)


def write(scenario: Scenario, folder: Path, options: Options) -> None:
    """Write the file."""
    try:
        from mcap_protobuf.writer import Writer

        from log2sim.export import foxglove
    except ImportError:
        raise MissingExtra("export to MCAP", "mcap") from None
    steps = agent_steps(scenario)
    if steps[0][0] < 0:
        raise ScenarioError(f"scenario '{scenario.name}' starts before 1970, which MCAP has no stamps for")
    placement = near_origin(scenario)
    origin = np.array(placement.origin_m)
    parts: list[Iterable[Message]] = [foxglove.scene_messages(steps, origin)]
    if options.log is not None:
        parts.append(
            m for record in viewer_records(scenario, options.log) for m in foxglove.record_messages(record, origin)
        )
    with (folder / f"{file_name(scenario.name)}.mcap").open("wb") as file, Writer(file) as writer:
        about = {
            "position_offset_m": placement.origin_m,
            "doubtful": {a.id: explain_doubt(a) for a in scenario.doubtful},
        }
        about |= {f"map.{key}": value for key, value in asdict(scenario.map).items()}
        texts = {key: json.dumps(value) for key, value in about.items()}
        writer.add_metadata("log2sim", {"scenario": scenario.name, **texts})
        for t_ns, topic, message in heapq.merge(*parts, key=lambda m: m[0]):
            writer.write_message(topic, message, log_time=t_ns, publish_time=t_ns)
