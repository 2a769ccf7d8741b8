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
)
from log2sim.datatypes.detections import (
    TUPLES,
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
    end_of,
    retime_spans,
    seen_from,
)
from log2sim.datatypes.map_features import (
    BORDER_KINDS,
    LANE_LINE_KINDS,
    LANE_ORIGINS,
    MARKING_KINDS,
    MapFeatures,
    MapLane,
    Marking,
    RoadBorder,
)
from log2sim.datatypes.scenario import (
    EGO,
    SIGNAL_STATES,
    TAGS,
    VERSION,
    Scenario,
    Signal,
    Tag,
    count_agents,
    count_categories,
)

__all__ = [
    "BORDER_KINDS", "CATEGORIES", "CATEGORY", "COLOR_NAMES", "EGO", "ENDS", "FIRST_SPEED_MPS", "GROUPS",
    "GROUP_OF", "KINDS", "LANE_LINE_KINDS", "LANE_ORIGINS", "MARGIN_S", "MARKING_KINDS", "MAX_SIZE_M", "MAX_SPEED_MPS", "MIN_SIZE_M",
    "MIN_TRUSTED_CONFIDENCE", "RELATED_GROUPS", "ROAD", "SIGNAL_STATES", "STANDSTILL_DRIFT_M", "STANDSTILL_MPS", "TAGS", "TUPLES",
    "TYPICAL_SIZE_M", "VEHICLE", "VERSION", "Agent", "AgentTable", "BoxEvidence", "Boxes3D", "Deferred", "Detections",
    "EgoVehicle", "Finding", "Frame", "IgnoreRegions", "ImageLabels", "ImageRegions", "LabelView", "Labels", "Lidar",
    "Log", "MapFeatures", "MapFrame", "MapLane", "Marking", "Measurements", "Obstacles", "OtherView", "Rays",
    "RoadBorder", "Scenario", "Signal", "Span", "Stream", "Sweep", "Tag", "Tick", "Track", "Trajectory", "Treatment",
    "Waypoints", "count_agents", "count_categories", "end_of", "explain_doubt", "format_confidence", "list_doubtful",
    "retime_spans", "seen_from",
]  # fmt: skip
