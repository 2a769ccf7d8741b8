"""3D boxes of road users in clouds: LiDAR networks by name, from the cloud to boxes with their points, or labels."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from log2sim.config import LIDAR_PREFIX, LidarConfig
from log2sim.datatypes import GROUPS, Boxes3D, Log
from log2sim.errors import ConfigError, Log2SimError, PluginError
from log2sim.files import plugins
from log2sim.files.plugins import DETECT_IN_CLOUD, require_members
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.detect.detectors import (
    ForeignDetector,
    find_wrong_name_or_score,
    interpolate_boxes,
    road_users,
)
from log2sim.perception.detect3d.box_points import PointsOfBoxes, bounding_reach, most_points, points_of_boxes
from log2sim.perception.detect3d.boxes import MIN_SCORE, LevelBoxes, decode_centers, decode_votes, sigmoid, suppress
from log2sim.perception.detect3d.network import (
    Network,
    digest_of,
    grid_window,
    ground_under,
    level_points,
    load_network,
    rasterize,
    stack_points,
    viewpoints_xy,
)
from log2sim.perception.detect3d.refinement import SUFFIX, Refinement, load_refinement
from log2sim.perception.lidar.cloud import ON_GROUND_M, Cloud


@dataclass(frozen=True, eq=False)
class LabelBoxDetector:
    """LiDAR detector that returns the labels of a log in which the cloud has points."""

    log: Log
    max_range_m: float = np.inf  # largest distance from the sensor along an axis, m; infinite without a limit
    name: str = "lidar:labels"

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        """Return the labels at the cloud's stamp with score 1, most points first, then nearest; `earlier` has no effect."""
        labels, window = self._labels
        if not len(labels.t_ns):
            return Boxes3D.empty()
        found = interpolate_boxes(labels, cloud.stamp_ns, window)
        local = found.center_m - cloud.origin
        away = np.abs(local[:, :2] - cloud.sensor[:2])
        near = np.all(away <= self.max_range_m, axis=1)
        found, local = found.take(np.flatnonzero(near)), local[near]
        # Points on the ground count for no box: a box whose lower face is 5 cm too low would gain hundreds.
        points = points_of_boxes(cloud.xyz, local, found.size_m, found.yaw_rad, ~cloud.ground).count
        seen = np.flatnonzero(points > 0)
        seen = seen[np.lexsort((np.hypot(*away[near][seen].T), -points[seen]))]
        return replace(found.take(seen), points=points[seen])

    @cached_property
    def _labels(self) -> tuple[Boxes3D, int]:
        """Labels of road users, and the time around a cloud in which to search them, ns."""
        labels = self.log.labels
        assert labels is not None
        return road_users(labels)


def create(log: Log, settings: LidarConfig) -> LabelBoxDetector:
    """Make the detector `lidar:labels`.

    Raises `ConfigError` when the log has no 3D labels.
    """
    if log.labels is None:
        others = ", ".join(f"lidar:{name}" for name in plugins.names("lidar_detector") if name != "labels")
        raise ConfigError(
            f"detector 'lidar:labels': log '{log.name}' ({log.format}) has no labeled 3D boxes; "
            f"choose another detector: {others}, or lidar: and the path of an ONNX file"
        )
    return LabelBoxDetector(log, settings.range_m or np.inf)


WEIGHTS = Path(__file__).parent / "weights"
# A network that finds less than half of most groups of road users is named as weak.
MIN_GROUP_RECALL = 0.5


def describe_weakness(name: str) -> str:
    """State what a shipped detector finds and turns round in simulated sweeps if it misses most groups of road users, else nothing.

    The figures are those of the JSON file next to its second stage.
    """
    file = WEIGHTS / f"{name.removeprefix(LIDAR_PREFIX)}.boxes.json"
    if not name.startswith(LIDAR_PREFIX) or name.endswith(".onnx") or not file.is_file():
        return ""
    card = json.loads(file.read_text(encoding="utf-8"))["simulated"]
    groups = {group: card[group] for group in GROUPS if group in card}
    if 2 * sum(row["recall"] < MIN_GROUP_RECALL for row in groups.values()) <= len(groups):
        return ""
    found = ", ".join(f"{row['recall']:.0%} of {group.replace('_', '-')}s" for group, row in groups.items())
    turned = ", ".join(f"{row['headings_flipped']:.0%}" for row in groups.values())
    return (
        f"{name} finds {found} within {card['max_range_m']:g} m in a simulated sweep at a score of {card['score']:g}; backwards "
        f"are {turned} of them, before the motion over several sweeps turns those that move"
    )


@dataclass(frozen=True, eq=False)
class Candidates:
    """Boxes of a cloud before the weak ones and those that overlap are left out."""

    boxes: LevelBoxes  # M LevelBoxes
    inside: PointsOfBoxes  # their points of the cloud above the ground
    terms: NDArray[np.float64]  # (5, M): see `LevelBoxes.terms`


# What the second stage is asked about: boxes of a lower score are hardly ever of road users.
MIN_FIRST_SCORE = 0.05


@dataclass(frozen=True, eq=False)
class NetworkDetector:
    """Detector from a network and settings."""

    name: str
    network: Network
    decode: Literal["centers", "votes"]  # see `LidarConfig`
    range_m: float  # largest distance from the sensor along x and along y, m
    min_score: float | None  # lowest score of a box; None for the network's own of each group
    refinement: Refinement | None = None  # second stage, for boxes at centers

    @property
    def cache_key(self) -> str:
        """All that its boxes depend on besides the clouds."""
        digests = " ".join(digest_of(of.path) for of in (self.network, self.refinement) if of is not None)
        return f"{digests} {self.decode} {self.range_m} {self.min_score}"

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        """Detect road users in one cloud, best score first; points of `earlier` clouds make the grid denser."""
        found = self.candidates(cloud, earlier, weak=False)
        boxes, points = found.boxes, found.inside.count
        info = self.network.info if self.refinement is None else self.refinement.info
        score = sigmoid(boxes.heat) if self.decode == "votes" else boxes.score(info, found.terms)
        # What holds no point is nothing that the LiDAR saw.
        good = np.flatnonzero((points > 0) & (score >= self._least(boxes)))
        kept = good[suppress(boxes.rectangles[good], score[good], boxes.group[good])]
        boxes, inside = boxes.take(kept), found.inside.take(kept)
        center = boxes.center_m + cloud.origin
        center[:, 2] += ground_under(boxes.center_m[:, :2], inside, cloud)
        t_ns = cloud.stamp_ns + np.round(inside.mean(cloud.t_s) * NS_PER_S).astype(np.int64)
        return Boxes3D(
            t_ns, center, boxes.size_m, boxes.yaw_rad, boxes.heading_score, boxes.category, score[kept], points[kept]
        )

    def candidates(self, cloud: Cloud, earlier: Sequence[Cloud] = (), *, weak: bool = True) -> Candidates:
        """Find all boxes that may be road users, of those on one peak or cluster the strongest.

        `weak`: whether boxes that cannot reach the least score are among them.

        The calibration of a network is fitted to the terms of these.
        """
        info, sensors = self.network.info, viewpoints_xy(cloud)
        xyz, index = level_points(cloud, self.range_m)
        stacked = np.concatenate([xyz, stack_points(cloud, earlier, self.range_m)]) if earlier else xyz
        # The square that holds what is in range of all viewpoints, as large as the network's grid at most.
        center, reach_m = sensors[0], self.range_m
        if len(sensors) > 1:
            first, last = sensors.min(axis=0), sensors.max(axis=0)
            center, reach_m = (first + last) / 2, min(reach_m + float((last - first).max()) / 2, info.max_range_m)
        low, shape = grid_window(stacked[:, :2], cell_m=info.cell_m, range_m=reach_m, center=center)
        grid = rasterize(stacked, cell_m=info.cell_m, low=low, shape=shape)
        maps = self.network.run(grid)
        if self.decode == "votes":
            boxes = decode_votes(maps, grid, info, low)
        else:
            boxes = decode_centers(maps, info, low)
            if not weak:
                # Counting points takes longest: for those alone that reach the least score with as many as possible or none.
                counts, reach = np.rint(np.exp(3 * grid[3])) - 1, bounding_reach(boxes.size_m, boxes.yaw_rad)
                most = most_points(counts, low, info.cell_m, boxes.center_m[:, :2], reach)
                range_m = ranges_m(boxes, sensors)
                best = np.maximum(*(boxes.score(info, boxes.terms(points, range_m)) for points in (most, 0 * most)))
                least = self._least(boxes)
                boxes = boxes.take(best >= (least if self.refinement is None else np.minimum(least, MIN_FIRST_SCORE)))
            without = boxes.score(info, boxes.terms(np.zeros(len(boxes)), ranges_m(boxes, sensors)))
            boxes = boxes.take(suppress(boxes.rectangles, without, boxes.group, across=False))
        above = np.flatnonzero(xyz[:, 2] > ON_GROUND_M)
        xyz, index = xyz.T.take(above, axis=1).T, index.take(above)  # values of one coordinate still side by side
        if self.refinement is not None:
            boxes, inside = self.refinement.refine(boxes, xyz, sensors)
        else:
            inside = points_of_boxes(xyz, boxes.center_m, boxes.size_m, boxes.yaw_rad)
        inside = replace(inside, point=index.take(inside.point))
        return Candidates(boxes, inside, boxes.terms(inside.count, ranges_m(boxes, sensors)))

    def _least(self, found: LevelBoxes) -> NDArray[np.float64]:
        """Return the least score (M,) that each box needs."""
        if self.min_score is not None:
            return np.full(len(found), self.min_score)
        if self.decode == "votes":
            return np.full(len(found), MIN_SCORE)
        info = self.network.info
        return np.array([info.min_score[group] for group in info.groups])[found.group]


def ranges_m(boxes: LevelBoxes, sensors: Array) -> Array:
    """Compute the distances (M,), m, of centers from the nearest of the sensors at (V, 2) in the plane."""
    away = boxes.center_m[:, None, :2] - sensors
    return np.asarray(np.hypot(away[..., 0], away[..., 1]).min(axis=1))


def open_network(path: Path, settings: LidarConfig, *, name: str) -> NetworkDetector:
    """Make a detector of a network's file, and of that of its second stage where there is one of the same name with `SUFFIX`.

    Raises `ConfigError`: a file that is no usable network, or a range that its grid cannot cover.
    """
    network = load_network(path)
    limit = network.info.max_range_m
    if settings.range_m > limit:
        raise ConfigError(
            f"lidar.range_m {settings.range_m:g}: {path} has cells of {network.info.cell_m:g} m, with which a grid covers "
            f"up to {limit:g} m"
        )
    range_m, second = settings.range_m or network.info.range_m, path.with_suffix(SUFFIX)
    refines = settings.decode == "centers" and second.is_file()
    refinement = load_refinement(second, network.info) if refines else None
    return NetworkDetector(name, network, settings.decode, range_m, settings.min_score or None, refinement)


def create_vehicle(log: Log, settings: LidarConfig) -> NetworkDetector:
    """Make the detector `lidar:vehicle`, for LiDARs on vehicles."""
    return open_shipped("vehicle", settings)


def create_roadside(log: Log, settings: LidarConfig) -> NetworkDetector:
    """Make the detector `lidar:roadside`, for LiDARs beside the road."""
    return open_shipped("roadside", settings)


def open_shipped(name: str, settings: LidarConfig) -> NetworkDetector:
    """Make a detector of a network that is part of the package.

    Raises `ConfigError` when its file is missing.
    """
    path = WEIGHTS / f"{name}.onnx"
    if not path.is_file():
        raise ConfigError(
            f"detector 'lidar:{name}': its network {path} is missing; install log2sim anew, or give lidar: and the path of "
            "another ONNX file"
        )
    return open_network(path, settings, name=f"lidar:{name}")


MEMBERS = ("name", "detect")


class LidarDetector(Protocol):
    """Detector of road users in one cloud."""

    @property
    def name(self) -> str:
        """Name in the provenance of a scenario."""
        ...

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        """Detect road users in one cloud, best score first; deterministic, and may be called from threads.

        `cloud`: all LiDARs of one moment. `earlier`: of moments before; their points make the grid denser, but count for no box.
        """
        ...


def create_lidar_detector(name: str, log: Log, settings: LidarConfig) -> LidarDetector:
    """Make a detector for the clouds of a log.

    `name`: "lidar:" and a registered name ("vehicle", "roadside", "labels", plug-ins of others) or the path of an `.onnx`
    file. `log`: the log whose clouds it will see; `labels` takes its boxes from there. `settings`: decoding, range and
    lowest score.

    Raises `ConfigError`: an unknown name, or a file that is no usable network; `MissingExtra`: the detector's package is
    not installed.
    """
    if not name.startswith(LIDAR_PREFIX):
        raise ConfigError(
            f"LiDAR detector '{name}': expected a name that begins with '{LIDAR_PREFIX}', such as lidar:vehicle"
        )
    rest = name.removeprefix(LIDAR_PREFIX)
    if rest.lower().endswith(".onnx"):
        return open_network(Path(rest), settings, name=f"{LIDAR_PREFIX}{Path(rest).name}")
    try:
        create = plugins.load("lidar_detector", rest)
    except PluginError:
        raise
    except ConfigError as error:
        raise ConfigError(f"{error}, or {LIDAR_PREFIX} and the path of an ONNX file (ending in .onnx)") from None
    with plugins.blaming("lidar_detector", rest):
        detector: LidarDetector = create(log, settings)
    if plugins.is_built_in("lidar_detector", rest):
        return detector
    return CheckedLidarDetector(detector, plugins.plugin_label("lidar_detector", rest))


class CheckedLidarDetector(ForeignDetector):
    """A detector of somebody else; what it raises and what it returns is checked.

    Raises `PluginError` when it lacks a member of `LidarDetector`, or its `detect` cannot be called.
    """

    def __post_init__(self) -> None:
        """Check the members."""
        require_members(self.inner, MEMBERS, DETECT_IN_CLOUD, self.source)

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        """Detect road users in one cloud.

        Raises `PluginError` when the detector raises something, or returns no `Boxes3D` of known categories.
        """
        try:
            found = self.inner.detect(cloud, earlier)
        except (Log2SimError, MemoryError):
            raise
        except Exception as error:
            raise PluginError(f"{self.source}: cloud at {cloud.stamp_ns}: {plugins.exception_line(error)}") from error
        if not isinstance(found, Boxes3D):
            raise PluginError(f"{self.source}: detect returned {type(found).__name__}, expected Boxes3D")
        defect = find_wrong_name_or_score(found.category, found.score)
        if defect is not None:
            raise PluginError(f"{self.source}: cloud at {cloud.stamp_ns}: {defect}")
        return found
