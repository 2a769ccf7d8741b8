"""What flows between the stages: logs, measurements, tracks and scenarios, as frozen records of columns."""

from __future__ import annotations

from log2sim.datatypes.agent import (
    COLOR_NAMES,
    MARGIN_S,
    MIN_TRUSTED_CONFIDENCE,
    STANDSTILL_DRIFT_M,
    STANDSTILL_MPS,
    Agent,
    AgentTable,
    Trajectory,
    Waypoints,
    explain_doubt,
    format_confidence,
    list_doubtful,
)
from log2sim.datatypes.categories import (
    CATEGORIES,
    CATEGORY,
    FIRST_SPEED_MPS,
    GROUP_OF,
    GROUPS,
    MAX_SIZE_M,
    MAX_SPEED_MPS,
    MIN_SIZE_M,
    RELATED_GROUPS,
    TYPICAL_SIZE_M,
    groups_of,
)
from log2sim.datatypes.detections import (
    Boxes3D,
    BoxEvidence,
    Detections,
    Measurements,
    Obstacles,
    OtherView,
    Rays,
    Track,
)
from log2sim.datatypes.findings import KINDS, Finding, Treatment
from log2sim.datatypes.log import (
    ENDS,
    ROAD,
    VEHICLE,
    Deferred,
    EgoVehicle,
    Frame,
    IgnoreRegions,
    ImageLabels,
    ImageRegions,
    Labels,
    LabelView,
    Lidar,
    Log,
    MapFrame,
    Span,
    Stream,
    Sweep,
    Tick,
    Turn,
    end_of,
    retime_spans,
    seen_from,
)
from log2sim.datatypes.scenario import (
    EGO,
    TAGS,
    VERSION,
    MapFeatures,
    MapLane,
    Marking,
    RoadBorder,
    Scenario,
    Signal,
    Tag,
    count_agents,
    count_categories,
)

__all__ = [
    "CATEGORIES", "CATEGORY", "COLOR_NAMES", "EGO", "ENDS", "FIRST_SPEED_MPS", "GROUPS",
    "GROUP_OF", "KINDS", "MARGIN_S", "MAX_SIZE_M", "MAX_SPEED_MPS", "MIN_SIZE_M",
    "MIN_TRUSTED_CONFIDENCE", "RELATED_GROUPS", "ROAD", "STANDSTILL_DRIFT_M", "STANDSTILL_MPS", "TAGS",
    "TYPICAL_SIZE_M", "VEHICLE", "VERSION", "Agent", "AgentTable", "BoxEvidence", "Boxes3D", "Deferred", "Detections",
    "EgoVehicle", "Finding", "Frame", "IgnoreRegions", "ImageLabels", "ImageRegions", "LabelView", "Labels", "Lidar",
    "Log", "MapFeatures", "MapFrame", "MapLane", "Marking", "Measurements", "Obstacles", "OtherView", "Rays",
    "RoadBorder", "Scenario", "Signal", "Span", "Stream", "Sweep", "Tag", "Tick", "Track", "Trajectory", "Treatment",
    "Turn", "Waypoints", "count_agents", "count_categories", "end_of", "explain_doubt", "format_confidence", "groups_of", "list_doubtful",
    "retime_spans", "seen_from",
]  # fmt: skip
