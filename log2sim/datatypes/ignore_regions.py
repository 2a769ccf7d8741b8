"""Ignore regions of a truth: parts of images, and of the scene, in which objects were left without labels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import ScenarioError
from log2sim.geometry import Array, Camera, rotation_from_quaternion, transform

QUATERNION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class LabelView:
    """The images of one camera in which objects were labeled.

    Attributes
    ----------
    camera : Camera
        Its mount is not used.
    t_s : (F,) float64, s
        Strictly increasing stamps since the start of the truth.
    translation_m : (F, 3) float64, m
        Of the camera in the map.
    rotation_wxyz : (F, 4) float64
        Unit quaternions of the camera in the map, scalar first.
    region_frame : (R,) int64
        Index into `t_s` of each region.
    region_px : (R, 4) float64, px
        u0, v0, u1, v1 of each part of an image without labels.
    """

    camera: Camera
    t_s: Array
    translation_m: Array
    rotation_wxyz: Array
    region_frame: NDArray[np.int64]
    region_px: Array

    @property
    def map_T_cam(self) -> Array:
        """Return the poses (F, 4, 4) of the camera."""
        return transform(rotation_from_quaternion(self.rotation_wxyz), self.translation_m)


@dataclass(frozen=True, eq=False)
class IgnoreRegions:
    """Where reconstructed objects are neither right nor false, because nothing was labeled there.

    Attributes
    ----------
    views : tuple of LabelView
        One for each labeled camera.
    outside_views : bool
        Whether objects outside all views were left without labels too.
    categories : tuple of str
        Categories that were left without labels everywhere.
    """

    views: tuple[LabelView, ...]
    outside_views: bool
    categories: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the part `unlabeled` of a document of `schemas/scenario-1.json`."""
        document = {"outside_views": self.outside_views, "views": [_view_to_dict(v) for v in self.views]}
        return {**document, "categories": list(self.categories)} if self.categories else document

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> IgnoreRegions:
        """Build them from the part `unlabeled` of a document that keeps the schema.

        Raises
        ------
        ScenarioError
            When columns do not fit each other.
        """
        views = tuple(_view_from_dict(v, f"unlabeled.views[{k}]") for k, v in enumerate(document["views"]))
        return cls(views, bool(document["outside_views"]), tuple(document.get("categories", ())))


def _view_to_dict(view: LabelView) -> dict[str, Any]:
    c = view.camera
    return {
        "camera": c.name,
        "intrinsics": {
            "width_px": int(c.width_px),
            "height_px": int(c.height_px),
            "fx_px": float(c.K[0, 0]),
            "fy_px": float(c.K[1, 1]),
            "cx_px": float(c.K[0, 2]),
            "cy_px": float(c.K[1, 2]),
            "distortion_model": c.distortion_model,
            "distortion": [float(d) for d in c.distortion],
        },
        "t_s": view.t_s.tolist(),
        "translation_m": view.translation_m.tolist(),
        "rotation_wxyz": view.rotation_wxyz.tolist(),
        "region_frame": view.region_frame.tolist(),
        "region_px": view.region_px.tolist(),
    }


def _view_from_dict(entry: Mapping[str, Any], where: str) -> LabelView:
    i = entry["intrinsics"]
    K = np.array([[i["fx_px"], 0.0, i["cx_px"]], [0.0, i["fy_px"], i["cy_px"]], [0.0, 0.0, 1.0]])
    model, lens = i.get("distortion_model", "none"), tuple(float(d) for d in i.get("distortion", ()))
    camera = Camera(entry["camera"], i["width_px"], i["height_px"], K, "map", np.eye(4), model, lens)
    t_s = np.array(entry["t_s"], dtype=np.float64)
    position = np.array(entry["translation_m"], dtype=np.float64).reshape(-1, 3)
    q = np.array(entry["rotation_wxyz"], dtype=np.float64).reshape(-1, 4)
    frame = np.array(entry["region_frame"], dtype=np.int64)
    box = np.array(entry["region_px"], dtype=np.float64).reshape(-1, 4)
    if not len(t_s) == len(position) == len(q):
        raise ScenarioError(
            f"{where}: {len(t_s)} stamps, {len(position)} translations, {len(q)} rotations; expected equal"
        )
    if len(frame) != len(box) or np.any(frame >= len(t_s)):
        raise ScenarioError(f"{where}: region_frame must hold one index of a stamp for each of the {len(box)} regions")
    if np.any(np.diff(t_s) <= 0):
        raise ScenarioError(f"{where}: t_s does not increase at index {int(np.argmax(np.diff(t_s) <= 0)) + 1}")
    if np.any(np.abs(np.linalg.norm(q, axis=1) - 1) > QUATERNION_TOLERANCE):
        raise ScenarioError(f"{where}: rotation_wxyz must hold unit quaternions, scalar first")
    return LabelView(camera, t_s, position, q, frame, box)
