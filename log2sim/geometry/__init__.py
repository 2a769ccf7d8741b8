"""Rigid transforms, poses over time, cameras and oriented boxes; knows no stage of the method.

Transforms are named `dst_T_src` (4x4, float64) so that inner frames cancel: `map_T_cam = map_T_ego @ ego_T_cam`.
Frames: map (local ENU), ego (ISO 8855: x forward, y left, z up), cam (x right, y down, z forward). Quaternions are
scalar-first, yaw is counter-clockwise from +x in [-pi, pi).
"""

from __future__ import annotations

from log2sim.geometry.boxes import (
    ProjectedBoxes,
    box_corners,
    box_corners_bev,
    box_iou,
    box_lines,
    cross_slab,
    outline,
    overlap_of_smaller,
    points_in_box,
    project_boxes,
    rectangle_iou,
    rectangle_overlap,
    rectangles_overlap,
    separating_axes,
    upright_box_iou,
)
from log2sim.geometry.camera import (
    DISTORTION_LENGTHS,
    MIN_DEPTH_M,
    Camera,
    Mount,
    RollingShutter,
    apply_homography,
    distort,
    fold_radius,
    ground_homography,
    homography_jacobian,
    line_stamps_ns,
    line_time_s,
    project,
    project_moving,
    undistort,
)
from log2sim.geometry.polyline import SPACING_M, Polyline, Projection, crossings
from log2sim.geometry.statistics import (
    CHI2_2DOF_99,
    CHI2_2DOF_999,
    CHI2_4DOF_999,
    choose_pairs,
    fit_windows,
    median,
    runs_of,
    weighted_quantile,
)
from log2sim.geometry.transforms import (
    NS_PER_S,
    Array,
    PoseTrack,
    apply,
    cos_sin,
    inverse,
    nearest_index,
    nearest_rotation,
    period_of,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
    shift_poses,
    slerp,
    transform,
    whole_kilometers,
    wrap_angle,
    yaw_of,
)

__all__ = [
    "CHI2_2DOF_99", "CHI2_2DOF_999", "CHI2_4DOF_999", "DISTORTION_LENGTHS", "MIN_DEPTH_M", "NS_PER_S", "SPACING_M", "Array", "Camera", "Mount", "Polyline", "PoseTrack", "ProjectedBoxes",
    "Projection", "RollingShutter", "apply", "apply_homography", "box_corners", "box_corners_bev", "box_iou", "box_lines", "choose_pairs",
    "cos_sin", "cross_slab", "crossings", "distort", "fit_windows", "fold_radius", "ground_homography", "homography_jacobian", "inverse", "line_stamps_ns", "line_time_s",
    "median", "nearest_index", "nearest_rotation", "outline", "overlap_of_smaller", "period_of", "points_in_box", "project",
    "project_boxes", "project_moving", "quaternion_from_rotation", "rectangle_iou", "rectangle_overlap",
    "rectangles_overlap", "rotation_from_quaternion", "rotation_from_rpy", "runs_of", "separating_axes", "shift_poses", "slerp",
    "transform", "undistort", "upright_box_iou", "weighted_quantile", "whole_kilometers", "wrap_angle", "yaw_of",
]  # fmt: skip
