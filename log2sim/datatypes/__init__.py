"""What flows between the stages: logs, measurements, tracks and scenarios, as frozen records of columns."""

from __future__ import annotations

from log2sim.datatypes.agent import COLOR_NAMES, Agent
from log2sim.datatypes.agent_counts import say_agents, say_categories
from log2sim.datatypes.boxes3d import Boxes3D
from log2sim.datatypes.categories import (
    CATEGORIES,
    CATEGORY,
    GROUP_OF,
    GROUPS,
    MAX_SIZE_M,
    MAX_SPEED_MPS,
    MIN_SIZE_M,
    TYPICAL_SIZE_M,
)
from log2sim.datatypes.deferred import Deferred
from log2sim.datatypes.doubtful import list_doubtful, say_confidence, why_doubtful
from log2sim.datatypes.doubts import FLAGS, MIN_TRUSTED_CONFIDENCE, Doubt
from log2sim.datatypes.ends import ENDS, ROAD, VEHICLE, Span, end_of, retime_spans, seen_from
from log2sim.datatypes.faults import FAULT_KINDS, Fault, Treatment
from log2sim.datatypes.ignore_regions import IgnoreRegions, LabelView
from log2sim.datatypes.labels import ImageLabels, ImageRegions, Labels
from log2sim.datatypes.log import EgoVehicle, Frame, Lidar, Log, MapFrame, Stream
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
from log2sim.datatypes.measurements import TUPLES, BoxEvidence, Detections, Measurements, OtherView
from log2sim.datatypes.obstacles import Obstacles
from log2sim.datatypes.rays import Rays
from log2sim.datatypes.scenario import EGO, VERSION, Scenario
from log2sim.datatypes.signals import SIGNAL_STATES, Signal
from log2sim.datatypes.tick import Sweep, Tick
from log2sim.datatypes.tracks import Track
from log2sim.datatypes.trajectory import STANDSTILL_DRIFT_M, STANDSTILL_MPS, Trajectory
from log2sim.datatypes.waypoints import Waypoints

__all__ = [
    "BORDER_KINDS",
    "CATEGORIES",
    "CATEGORY",
    "COLOR_NAMES",
    "EGO",
    "ENDS",
    "FAULT_KINDS",
    "FLAGS",
    "GROUPS",
    "GROUP_OF",
    "LANE_LINE_KINDS",
    "LANE_ORIGINS",
    "MARKING_KINDS",
    "MAX_SIZE_M",
    "MAX_SPEED_MPS",
    "MIN_SIZE_M",
    "MIN_TRUSTED_CONFIDENCE",
    "ROAD",
    "SIGNAL_STATES",
    "STANDSTILL_DRIFT_M",
    "STANDSTILL_MPS",
    "TUPLES",
    "TYPICAL_SIZE_M",
    "VEHICLE",
    "VERSION",
    "Agent",
    "BoxEvidence",
    "Boxes3D",
    "Deferred",
    "Detections",
    "Doubt",
    "EgoVehicle",
    "Fault",
    "Frame",
    "IgnoreRegions",
    "ImageLabels",
    "ImageRegions",
    "LabelView",
    "Labels",
    "Lidar",
    "Log",
    "MapFeatures",
    "MapFrame",
    "MapLane",
    "Marking",
    "Measurements",
    "Obstacles",
    "OtherView",
    "Rays",
    "RoadBorder",
    "Scenario",
    "Signal",
    "Span",
    "Stream",
    "Sweep",
    "Tick",
    "Track",
    "Trajectory",
    "Treatment",
    "Waypoints",
    "end_of",
    "list_doubtful",
    "retime_spans",
    "say_agents",
    "say_categories",
    "say_confidence",
    "seen_from",
    "why_doubtful",
]
