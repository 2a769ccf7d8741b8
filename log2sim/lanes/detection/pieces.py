"""Straight pieces of ridges, up to 2 m long."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.geometry import Array
from log2sim.lanes.detection.profiles import Pieces, measure_pieces, no_pieces
from log2sim.lanes.detection.ridges import RidgePoints
from log2sim.mapping.ground_map import GroundMap

HALF_PIECE_M = 1.0
ACROSS_M = 0.15  # half a coarse cell of error, and the bend of a curve of 6 m radius within a piece
MAX_TURN_RAD = np.deg2rad(20)  # the directions of ridge points are 15 deg apart
SHORT_M, MAX_SLANT_RAD = 1.0, np.deg2rad(8)
MIN_POINTS = 5
MIN_PIECE_M = 0.4
MIN_COVERED = 0.6  # share of a piece's length that has ridge points
CELL_M = 0.1  # distance of ridge points along a line
PROFILES_AT_ONCE = 4000  # bound of memory


def find_pieces(ground: GroundMap, points: RidgePoints) -> Pieces:
    """Fit straight pieces to ridge points and measure the profile across each."""
    lines = fit_lines(points)
    if not len(lines):
        return no_pieces(0)
    parts = [measure_pieces(ground, lines[k : k + PROFILES_AT_ONCE]) for k in range(0, len(lines), PROFILES_AT_ONCE)]
    pieces = Pieces(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Pieces)))
    pieces = pieces.take(np.isfinite(pieces.width_m) & (pieces.width_m > 0))
    return pieces.take(~_aslant(pieces))


def _aslant(pieces: Pieces) -> NDArray[np.bool_]:
    """Mask (N,) of short pieces that touch longer ones aslant: at the ends of paint, slanting filters respond too."""
    short = np.flatnonzero(pieces.length_m < SHORT_M)
    out = np.zeros(len(pieces), bool)
    if not len(short):
        return out
    near = cKDTree(pieces.xy).query_ball_point(pieces.xy[short], 2 * HALF_PIECE_M)
    for k, others in zip(short.tolist(), near):
        other = np.array([j for j in others if pieces.length_m[j] > 1.3 * pieces.length_m[k]], int)
        if not len(other):
            continue
        angle = pieces.direction[other]
        offset = pieces.xy[k] - pieces.xy[other]
        along = offset[:, 0] * np.cos(angle) + offset[:, 1] * np.sin(angle)
        across = offset[:, 1] * np.cos(angle) - offset[:, 0] * np.sin(angle)
        beyond = np.abs(along) - pieces.length_m[other] / 2 - pieces.length_m[k] / 2
        turn = np.abs((pieces.direction[k] - angle + np.pi / 2) % np.pi - np.pi / 2)
        reach = (pieces.width_m[other] + pieces.length_m[k]) / 2
        out[k] = np.any((np.abs(across) < reach) & (beyond < ACROSS_M) & (turn > MAX_SLANT_RAD))
    return out


def fit_lines(points: RidgePoints, cell_m: float = CELL_M) -> Array:
    """Fit lines to ridge points, the strongest first, each point to one: x, y, direction, length (N, 4).

    Points are `cell_m` apart along a line; all lengths are in proportion to that.
    """
    scale = cell_m / CELL_M
    if not len(points.xy_map):
        return np.zeros((0, 4))
    tree = cKDTree(points.xy_map)
    free = np.ones(len(points.xy_map), bool)
    lines = []
    for seed in np.argsort(-points.strength, kind="stable"):
        if not free[seed]:
            continue
        near = np.array(tree.query_ball_point(points.xy_map[seed], HALF_PIECE_M * scale))
        near = near[free[near]]
        free[seed] = False
        if len(near) < MIN_POINTS:
            continue
        line = _fit_line(points, int(seed), near, scale)
        if line is not None:
            lines.append(line[0])
            free[line[1]] = False
    return np.array(lines).reshape(-1, 4)


def _fit_line(points: RidgePoints, seed: int, near: NDArray[Any], scale: float) -> tuple[Array, NDArray[Any]] | None:
    """Fit a line through a seed to points near it; also the indices of those that it explains."""
    xy = points.xy_map[near] - points.xy_map[seed]
    turn = np.abs((points.direction[near] - points.direction[seed] + np.pi / 2) % np.pi - np.pi / 2)
    angle, center = float(points.direction[seed]), np.zeros(2)
    chosen = turn < MAX_TURN_RAD
    across_m, cell_m = ACROSS_M * scale, CELL_M * scale
    for width in (2 * across_m, across_m):
        along, across = _turned(xy - center, angle)
        member = chosen & (np.abs(across) < width)
        if np.count_nonzero(member) < MIN_POINTS:
            return None
        center = xy[member].mean(axis=0)
        off = xy[member] - center
        moments = off.T @ off  # of which only the directions are asked for
        angle = float(0.5 * np.arctan2(2 * moments[0, 1], moments[0, 0] - moments[1, 1]))
    along, across = _turned(xy - center, angle)
    member = chosen & (np.abs(across) < across_m)
    if np.count_nonzero(member) < MIN_POINTS:
        return None
    begin, end = along[member].min(), along[member].max()
    length = end - begin + cell_m
    covered = len(set(np.floor((along[member] - begin) / cell_m + 0.5).tolist())) * cell_m
    if length < MIN_PIECE_M * scale or covered < MIN_COVERED * length:
        return None
    middle = points.xy_map[seed] + center + (begin + end) / 2 * np.array([np.cos(angle), np.sin(angle)])
    explained = near[(np.abs(across) < 2 * across_m) & (along > begin - cell_m) & (along < end + cell_m)]
    return np.array([*middle, angle % np.pi, length]), explained


def _turned(xy: Array, angle: float) -> tuple[Array, Array]:
    c, s = np.cos(angle), np.sin(angle)
    return xy[:, 0] * c + xy[:, 1] * s, xy[:, 1] * c - xy[:, 0] * s
