"""Rigid transforms, poses over time, cameras and oriented boxes; knows no stage of the method."""

from __future__ import annotations

from log2sim.geometry.box_projection import project_boxes
from log2sim.geometry.boxes import bev_iou, box_corners, box_corners_bev, box_iou, points_in_box, polygon_area
from log2sim.geometry.camera import NEAREST_DEPTH_M, Camera, Mount, box_lines, distort, fold_radius, project, undistort
from log2sim.geometry.poses import PoseTrack
from log2sim.geometry.transforms import (
    NS_PER_S,
    Array,
    apply,
    cos_sin,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
    slerp,
    transform,
    whole_kilometers,
    wrap_angle,
    yaw_of,
)

__all__ = [
    "NEAREST_DEPTH_M",
    "NS_PER_S",
    "Array",
    "Camera",
    "Mount",
    "PoseTrack",
    "apply",
    "bev_iou",
    "box_corners",
    "box_corners_bev",
    "box_iou",
    "box_lines",
    "cos_sin",
    "distort",
    "fold_radius",
    "inverse",
    "points_in_box",
    "polygon_area",
    "project",
    "project_boxes",
    "quaternion_from_rotation",
    "rotation_from_quaternion",
    "rotation_from_rpy",
    "slerp",
    "transform",
    "undistort",
    "whole_kilometers",
    "wrap_angle",
    "yaw_of",
]
