"""Where traffic lights are: boxes of many frames become housings that stand in the map.

Each box is a ray, and its height says roughly how far away the housing is. The rays of a moving camera, or of several cameras,
cross; those of one that stands do not, and then the distance stays as unsure as the size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from log2sim.datatypes import Log
from log2sim.geometry import Array, undistort
from log2sim.perception.light_boxes import LightBox

# Longer side of a housing with three lamps: 0.9 to 1.0 m with lenses of 200 mm (EN 12368), 1.05 to 1.2 m with 300 mm (MUTCD).
SIDE_M, SIDE_SIGMA = 1.03, 0.22
# Errors of boxes: in pixels, and as a share of their height, and of the direction of the camera, which poses share for seconds.
PIXEL_SIGMA, SHARE_SIGMA, ANGLE_SIGMA_RAD = 1.5, 0.12, 0.003
# Chi-squared with 2 degrees of freedom beyond which a box is of another light, at 0.001; sizes that differ more are of others, too.
GATE, MAX_SIZE_RATIO = 13.8, 2.0
# Of a distance by LiDAR points: half of the depth of a housing, and what hangs beside it.
RANGE_SIGMA_M = 0.4
# Boxes often hold a part of a housing, whose middle is off by so much, or the board around it.
PART_M = 0.2
# Weights of old and new boxes: errors of poses last, so that many boxes from one place are not as sure as they are many.
SAME_PLACE_SHARE = 0.25
MERGE_M, MERGE_GATE = 1.2, 11.3
SAME_M = 0.5  # housings that hang side by side are no nearer
# Of the frames with a box of one, how many may have one of the other, too, where both are one housing.
MAX_SHARED = 0.15


@dataclass(eq=False)
class Housing:
    """A traffic light as far as it is known.

    Attributes
    ----------
    position : (3,) float64, m, map frame
    covariance : (3, 3) float64
    boxes : list of LightBox
    eyes : list of (3,) float64
        Where each was seen from.
    """

    position: Array
    covariance: Array
    boxes: list[LightBox] = field(default_factory=list)
    eyes: list[Array] = field(default_factory=list)

    @property
    def sigma_m(self) -> float:
        """Standard deviation along the axis on which it is largest."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


@dataclass(frozen=True, eq=False)
class _Sight:
    """A box as a ray in the map."""

    box: LightBox
    eye: Array
    ray: Array  # unit
    sigma_rad: float
    side_rad: float


def place_lights(log: Log, boxes: Sequence[LightBox]) -> list[Housing]:
    """Join boxes, in the order of their stamps, to housings with positions."""
    housings: list[Housing] = []
    frames: dict[tuple[int, str], list[LightBox]] = {}
    for box in boxes:
        frames.setdefault((box.t_ns, box.camera), []).append(box)
    for (t_ns, camera), seen in sorted(frames.items(), key=lambda item: item[0]):
        poses, known = log.map_T_sensor(camera, t_ns)
        if known[0]:
            _take_frame(log, housings, [_sight_of(log, box, poses[0]) for box in seen], poses[0])
    return _merged(housings)


def _sight_of(log: Log, box: LightBox, map_T_cam: Array) -> _Sight:
    camera = log.cameras[box.camera]
    u0, v0, u1, v1 = box.box_px
    middle, corners = [(u0 + u1) / 2, (v0 + v1) / 2], [[u0, (v0 + v1) / 2], [u1, (v0 + v1) / 2]]
    if v1 - v0 >= u1 - u0:
        corners = [[(u0 + u1) / 2, v0], [(u0 + u1) / 2, v1]]
    rays = np.column_stack([undistort(camera, np.array([middle, *corners])), np.ones(3)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    side_rad = float(np.arccos(np.clip(rays[1] @ rays[2], -1, 1)))
    pixel_rad = side_rad / max(u1 - u0, v1 - v0)
    sigma = float(np.linalg.norm([PIXEL_SIGMA * pixel_rad, SHARE_SIGMA * side_rad, ANGLE_SIGMA_RAD]))
    return _Sight(box, map_T_cam[:3, 3], map_T_cam[:3, :3] @ rays[0], sigma, side_rad)


def _take_frame(log: Log, housings: list[Housing], sights: list[_Sight], map_T_cam: Array) -> None:
    """Give each sight of a frame to the housing that it fits best, or make a new one."""
    sights = [sight for sight in sights if np.isfinite(sight.ray).all() and sight.side_rad > 0]
    positions = np.array([housing.position for housing in housings]).reshape(-1, 3)
    covariances = np.array([housing.covariance for housing in housings]).reshape(-1, 3, 3)
    cost = np.array([_misfits(positions, covariances, sight) for sight in sights]).reshape(len(sights), len(housings))
    rows, columns = linear_sum_assignment(np.minimum(cost, 10 * GATE))
    taken = set()
    for row, column in zip(rows.tolist(), columns.tolist()):
        if cost[row, column] <= GATE:
            _update(housings[column], sights[row])
            taken.add(row)
    housings += [_new_housing(sight) for k, sight in enumerate(sights) if k not in taken]


def _misfits(positions: Array, covariances: Array, sight: _Sight) -> Array:
    """Return the squared Mahalanobis distances (H,) of directions of housings from a sight's; infinite for another size.

    `positions` (H, 3) and `covariances` (H, 3, 3) are those of the housings.
    """
    away = positions - sight.eye
    distance = np.linalg.norm(away, axis=1)
    ratio = sight.side_rad * distance / SIDE_M
    possible = (distance >= 1.0) & (away @ sight.ray > 0) & (ratio > 1 / MAX_SIZE_RATIO) & (ratio < MAX_SIZE_RATIO)
    misfits = np.full(len(positions), np.inf)
    away, distance = away[possible], distance[possible]
    across = _across(sight.ray)
    off = away @ across.T / distance[:, None]
    off_m = (sight.sigma_rad * distance) ** 2 + PART_M**2
    spread = across @ covariances[possible] @ across.T + np.eye(2) * off_m[:, None, None]
    directed = np.linalg.solve(spread / (distance**2)[:, None, None], off[..., None])[..., 0]
    misfits[possible] = (off * directed).sum(axis=1)
    return misfits


def _across(ray: Array) -> Array:
    """Return two unit vectors (2, 3) across a unit vector."""
    side = np.cross(ray, [0.0, 0.0, 1.0]) if abs(ray[2]) < 0.9 else np.cross(ray, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(side, ray)])


def _new_housing(sight: _Sight) -> Housing:
    ranged = _range_of(sight)
    distance, spread = (SIDE_M / sight.side_rad, SIDE_SIGMA) if ranged is None else (ranged, RANGE_SIGMA_M / ranged)
    covariance = (spread * distance) ** 2 * np.outer(sight.ray, sight.ray)
    covariance += (sight.sigma_rad * distance) ** 2 * (np.eye(3) - np.outer(sight.ray, sight.ray))
    return Housing(sight.eye + distance * sight.ray, covariance, [sight.box], [sight.eye])


def _update(housing: Housing, sight: _Sight) -> None:
    """Correct the position of a housing by the direction of a sight (Kalman 1960)."""
    away = housing.position - sight.eye
    distance = float(np.linalg.norm(away))
    across = _across(sight.ray)
    # From nearly the same direction as before a sight has nearly the same errors.
    last = housing.position - housing.eyes[-1]
    turned = float(np.arccos(np.clip(away @ last / (distance * np.linalg.norm(last)), -1, 1)))
    share = np.clip(turned / sight.sigma_rad, SAME_PLACE_SHARE**2, 1.0)
    noise = np.eye(2) * (sight.sigma_rad * distance) ** 2 / share
    gain = housing.covariance @ across.T @ np.linalg.inv(across @ housing.covariance @ across.T + noise)
    housing.position = housing.position - gain @ (across @ away)
    housing.covariance = (np.eye(3) - gain @ across) @ housing.covariance
    ranged = _range_of(sight)
    if ranged is not None:
        toward = housing.covariance @ sight.ray
        gain_along = toward / (sight.ray @ toward + RANGE_SIGMA_M**2 / share)
        off = sight.ray @ (sight.eye - housing.position) + ranged
        housing.position = housing.position + gain_along * off
        housing.covariance = housing.covariance - np.outer(gain_along, toward)
    housing.boxes.append(sight.box)
    housing.eyes.append(sight.eye)


def _range_of(sight: _Sight) -> float | None:
    """Return the distance by LiDAR points; None without, or where it is that of something else by the size."""
    ratio = sight.side_rad * sight.box.range_m / SIDE_M
    return sight.box.range_m if 1 / MAX_SIZE_RATIO < ratio < MAX_SIZE_RATIO else None


def _merged(housings: list[Housing]) -> list[Housing]:
    """Join housings that are one: hardly ever in the same frame, and where the same errors could put both."""
    kept: list[Housing] = []
    for housing in sorted(housings, key=lambda h: -len(h.boxes)):
        for other in kept:
            off = housing.position - other.position
            close = (
                off @ np.linalg.solve(housing.covariance + other.covariance + np.eye(3) * PART_M**2, off) < MERGE_GATE
            )
            both = {(b.t_ns, b.camera) for b in housing.boxes} & {(b.t_ns, b.camera) for b in other.boxes}
            few = len(both) <= MAX_SHARED * min(len(housing.boxes), len(other.boxes))
            apart = float(np.linalg.norm(off))
            if apart < SAME_M or (few and (close or apart < MERGE_M)):
                weight = [np.linalg.inv(h.covariance) for h in (other, housing)]
                other.covariance = np.linalg.inv(weight[0] + weight[1])
                other.position = other.covariance @ (weight[0] @ other.position + weight[1] @ housing.position)
                other.boxes, other.eyes = other.boxes + housing.boxes, other.eyes + housing.eyes
                break
        else:
            kept.append(housing)
    return kept
