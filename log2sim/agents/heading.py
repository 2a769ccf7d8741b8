"""Which end of a vehicle is its front: outlines, traffic and rows of parked vehicles, with what motion and boxes say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.evidence import is_confirmed
from log2sim.agents.moving import (
    COURSE_LOG_ODDS_PER_DETECTION,
    MAX_COURSE_LOG_ODDS,
    course_log_odds,
    heading_log_odds,
    motion_doubts,
)
from log2sim.agents.smooth.motion_model import UNKNOWN_YAW_RAD
from log2sim.datatypes import GROUP_OF, Finding, Track, Waypoints
from log2sim.datatypes.log_odds import log_odds_of, probability_of
from log2sim.geometry import Array, wrap_angle
from log2sim.perception.boxes import rotate, subsample, top_of

LOW = (
    -27, -23, -17, -19, 60, 109, 68, 69,
    -10, -2, -3, -10, 0, 39, 50, 90,
    20, 11, -3, 5, -5, 30, 65, 81,
    17, -2, 8, 7, -12, -33, 22, 120,
    -11, 1, -4, -5, 0, -50, -51, 18,
    10, -11, 11, 15, -9, 9, 14, 1,
    38,
)  # fmt: skip

LOW_IN_PART = (
    4, 30, -32, -28, 31, 38, 16, 35,
    14, 23, -30, -25, -30, 8, -17, 72,
    18, 20, -24, -17, -19, -5, 24, 65,
    1, 2, 3, -6, -33, -13, -8, 108,
    -10, 0, -13, 0, -3, -16, -3, 40,
    -2, 5, -2, -4, -1, -1, 42, 17,
    30,
)  # fmt: skip

TALL = (
    6, -38, -30, -4, 66, 77, 48, 63,
    -20, -5, -5, 13, 0, 14, 13, 6,
    35, 28, 16, 6, -8, -24, -28, -10,
    61, 1, 5, -9, 2, -6, -16, -20,
    -13, -5, 0, -9, 3, -6, 2, -14,
    -12, 0, -7, 2, 0, 27, 13, -17,
    39,
)  # fmt: skip

TALL_IN_PART = (
    -22, -16, -20, 8, 16, 33, 52, 34,
    -8, 4, 8, -2, -21, -1, 1, 6,
    13, 8, 5, -4, -16, -5, -17, -5,
    20, 7, 0, 0, -6, 2, -5, -9,
    3, -1, 0, 7, 0, -12, -14, -10,
    4, -3, 11, 1, 7, -9, -2, 0,
    19,
)  # fmt: skip


# Cells of the outline along the length and up.
LENGTH_CELLS, HEIGHT_CELLS = 12, 8
# Points from here on along the length, without a wider gap, belong to a vehicle whose box is too short, up to this share of it.
MAX_GAP_M, MAX_LONGER_SHARE = 0.25, 0.2
# Points over this share of the length show both ends, wherever the box is.
WHOLE_LENGTH_SHARE = 0.8
# Lower points may be ground, points farther beside the box are neighbors.
MIN_HEIGHT_M, BESIDE_M = 0.2, 0.2
# Fewer points show no outline.
MIN_POINTS = 12
# More measurements and points than the weights were fitted for would fill the outline with stray points.
MAX_MEASUREMENTS, MAX_POINTS_EACH = 8, 300
# Between the highest cars and the lowest trucks, buses and delivery vans.
TALL_M = 2.1
# Of outlines that are surer than this, one in fifty is wrong on random traffic whose boxes are those of tracks.
MAX_LOG_ODDS = 4.0
# The ends of trucks and buses have the same shape, so that the boxes of all sweeps err together: where they are surer than this, one in
# seventeen points the wrong way, of cars one in 400 (2,226 vehicles of 150 simulated logs; 2 and 4 fit nearly as well).
MAX_LOG_ODDS_OF_LARGE = 3.0
# Where less of the length shows, something hides the rest.
MIN_WHOLE_SHARE = 0.8
WEIGHTS = {(False, True): LOW, (False, False): LOW_IN_PART, (True, True): TALL, (True, False): TALL_IN_PART}


@dataclass(frozen=True, eq=False)
class Outline:
    """Which cells have points."""

    cells: NDArray[np.bool_]  # (`LENGTH_CELLS`, `HEIGHT_CELLS`): from back to front and from the ground up
    height_m: float  # of the highest points
    view: float  # cosine of the angle from the yaw to the mean viewpoint

    @property
    def kind(self) -> tuple[bool, bool]:
        """Whether the vehicle is tall, and whether most of its length shows."""
        return self.height_m > TALL_M, bool(self.cells.any(axis=1).mean() >= MIN_WHOLE_SHARE)

    @property
    def features(self) -> Array:
        """What the weights apply to (`LENGTH_CELLS` / 2 x `HEIGHT_CELLS` + 1,), opposite for a vehicle turned round."""
        swapped = self.cells.astype(np.float64) - self.cells[::-1]
        return np.append(swapped[: LENGTH_CELLS // 2].ravel(), self.view)


def outline_log_odds(track: Track, waypoints: Waypoints, t_s: Array, size_m: tuple[float, float, float]) -> float:
    """Return the log-odds that a vehicle's front is where its yaw points, by its LiDAR points; 0 for too few.

    `t_s`: (n,), s: times of the n measurements of the track since the start. `size_m`: (3,), m.

    A logistic regression on which cells of the outline have points, less the same with front and back swapped, so the
    log-odds of a vehicle that is turned round are exactly the opposite. `tools/fit.py outline` fits the weights to random
    vehicles seen by simulated LiDARs.
    """
    m = track.measurements
    rows = np.flatnonzero(m.kept_points)
    if len(rows) == 0:
        return 0.0
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MAX_MEASUREMENTS)).round().astype(np.intp)]
    x, y = (np.interp(t_s[rows], waypoints.t_s, column) for column in (waypoints.x_m, waypoints.y_m))
    yaw = np.interp(t_s[rows], waypoints.t_s, np.unwrap(waypoints.yaw_rad))
    ground_m = np.where(np.isfinite(m.bottom_m[rows]), m.bottom_m[rows], np.median(m.bottom_m[rows]))
    points, views = [], []
    for k, row in enumerate(rows.tolist()):
        xyz = subsample(m.cluster[row][:, :3], MAX_POINTS_EACH) - [x[k], y[k], ground_m[k]]
        points.append(np.column_stack([rotate(xyz[:, :2], -yaw[k]), xyz[:, 2]]))
        views.append(rotate(m.sensor_m[row, :2] - [x[k], y[k]], -yaw[k]))
    outline = outline_of(np.concatenate(points), np.array(size_m), np.mean(views, axis=0))
    if outline is None:
        return 0.0
    odds = float(outline.features @ WEIGHTS[outline.kind]) / 100
    return min(max(odds, -MAX_LOG_ODDS), MAX_LOG_ODDS)


def outline_of(xyz: Array, size_m: Array, view_m: Array) -> Outline | None:
    """Make the outline of the points of a vehicle; None for fewer than `MIN_POINTS` in its box.

    `xyz`: (N, 3), m: x along the length and y to the left from the center of the box, z from the ground. `size_m`: (3,):
    length, width, height. `view_m`: (2,), m: mean viewpoint, as the points.
    """
    length, width, height = size_m
    beside = (np.abs(xyz[:, 1]) < width / 2 + BESIDE_M) & (xyz[:, 2] > MIN_HEIGHT_M) & (xyz[:, 2] < height)
    x, up = xyz[beside, 0], xyz[beside, 2]
    back, front = -_end_of(-x, length), _end_of(x, length)
    inside = (x >= back) & (x <= front)
    if inside.sum() < MIN_POINTS:
        return None
    x, up = x[inside], up[inside]
    if np.ptp(x) >= WHOLE_LENGTH_SHARE * length:
        back, front = float(x.min()), float(x.max())
    top = top_of(up)
    cells = np.zeros((LENGTH_CELLS, HEIGHT_CELLS), dtype=bool)
    column = ((x - back) / (front - back) * LENGTH_CELLS).astype(np.intp)
    row = (up / top * HEIGHT_CELLS).astype(np.intp)
    cells[np.minimum(column, LENGTH_CELLS - 1), np.minimum(row, HEIGHT_CELLS - 1)] = True
    return Outline(cells, top, float(view_m[0] / max(float(np.hypot(*view_m)), 1.0)))


def _end_of(x: Array, length_m: float) -> float:
    """Return where a vehicle ends along an axis: at the end of its box, or of the points (n,) that go on from there."""
    end = length_m / 2
    beyond = np.sort(x[(x > end) & (x < end + MAX_LONGER_SHARE * length_m)])
    gaps = np.flatnonzero(np.diff(np.append(end, beyond)) > MAX_GAP_M)
    beyond = beyond[: gaps[0]] if len(gaps) else beyond
    return float(beyond[-1]) if len(beyond) else end


# Vehicles that meet on one road pass each other within the road's width, and farther to the side than vehicles of one lane.
ROAD_M, LANE_M = 20.0, 1.8
PATH_SAMPLES = 40
OPPOSITE_COS = -0.7
# Two thirds of the world's people and 72 % of its roads keep right (Lucas, "Which side of the road do they drive on?", 2005).
USUALLY_RIGHT = 0.72
# Log-odds of each pair that meets: one in twenty meets on a car park, or at a turn, or one of both overtakes.
MEETING_LOG_ODDS, MAX_SIDE_LOG_ODDS = 3.0, 6.0
# Probability that a vehicle standing next to the path of another one faces in the direction of that side: in its own lane (a
# queue), at the near curb, between it and the next lane (the lane may be of either direction), and beyond (unless the street is one-way).
IN_LANE, NEAR_CURB, NEXT_LANE, BEYOND = 0.97, 0.92, 0.7, 0.85
# A vehicle's center is in the lane of a path that is nearer than half the width left in a lane of 3.5 m plus half a car; the lane
# beyond the next begins one and a half lanes away.
IN_LANE_M, BEYOND_M = 1.2, 4.5
# Standard deviation of the yaw between a street and vehicles parked along it, and lengths over which a street is known to go on
# ahead and to the side: streets bend, and farther to the side is another street or a yard.
PARALLEL_SIGMA_RAD, AHEAD_M, STREET_M, ASIDE_M = 0.15, 25.0, 9.0, 3.0
# A path that far away belongs to the street with a probability of less than 1e-5.
FAR_M = 500.0


def side_log_odds(paths: Sequence[Array]) -> float:
    """Return the log-odds that traffic keeps to the right, from vehicles that meet each other.

    `paths`: (K, 3) each: x, y in m and heading in rad of each vehicle that moved, the ego among them.

    Each pair of vehicles of opposite headings has one vote: where the oncoming one passes on the left, traffic keeps
    right.
    """
    votes = 0.0
    thinned = [p[np.linspace(0, len(p) - 1, min(len(p), PATH_SAMPLES)).astype(np.intp)] for p in paths if len(p)]
    extents = np.array([[*p[:, :2].min(axis=0), *p[:, :2].max(axis=0)] for p in thinned]).reshape(-1, 4)
    apart = np.any(extents[:, None, :2] - extents[None, :, 2:] > ROAD_M, axis=2)
    for i, j in zip(*np.nonzero(np.triu(~(apart | apart.T), 1))):
        one, other = thinned[i], thinned[j]
        to = other[None, :, :2] - one[:, None, :2]
        c, s = np.cos(one[:, 2])[:, None], np.sin(one[:, 2])[:, None]
        left = c * to[..., 1] - s * to[..., 0]
        near = np.hypot(to[..., 0], to[..., 1]) < ROAD_M
        meets = near & (np.cos(one[:, None, 2] - other[None, :, 2]) < OPPOSITE_COS) & (np.abs(left) > LANE_M)
        if meets.any():
            votes += np.sign(np.median(left[meets]))
    evidence = np.clip(MEETING_LOG_ODDS * votes, -MAX_SIDE_LOG_ODDS, MAX_SIDE_LOG_ODDS)
    return float(log_odds_of(USUALLY_RIGHT) + evidence)


def street_log_odds(pose: Array, paths: Sequence[Array]) -> Array:
    """Return the log-odds (2,) that the street's direction where something stands is along its yaw, by the traffic next to it.

    The first is for traffic that keeps to the right, the second for the left.

    `pose`: (3,): x, y in m and yaw in rad. `paths`: (K, 3) each: as in `side_log_odds`.

    The mean over the paths, the nearer the heavier. A path says the less the farther it is and the less parallel, so nothing
    follows the traffic of another street.
    """
    passing = _passing_by(pose[:2], paths, float(pose[2]))
    left_m, heading_rad, belongs = (
        np.array([getattr(p, name) for p in passing], dtype=np.float64) for name in ("left_m", "heading_rad", "belongs")
    )
    weights = belongs / (1.0 + np.abs(left_m) / 2) ** 2
    total, sign = float(np.sum(weights)), np.where(np.cos(heading_rad - pose[2]) > 0, 1.0, -1.0)
    if total <= 0:
        return np.zeros(2)
    aside = np.stack([left_m, -left_m])
    across = np.where(aside < 0, NEAR_CURB, 1.0 - np.where(aside < BEYOND_M, NEXT_LANE, BEYOND))
    along = np.where(np.abs(aside) < IN_LANE_M, IN_LANE, across)
    return np.array([weights @ odds for odds in sign * log_odds_of(0.5 + belongs * (along - 0.5))]) / total


@dataclass(frozen=True)
class _Passing:
    """How a path passes a place."""

    left_m: float  # of the place, to the left of the path
    heading_rad: float  # of the path
    belongs: float  # probability that the place belongs to its street


def _passing_by(xy: Array, paths: Sequence[Array], yaw_rad: float | None) -> list[_Passing]:
    """Find how each path passes a place (2,), or something there with a yaw, which should be parallel."""
    found = []
    for path in paths:
        if len(path) == 0 or np.abs(path[:, :2] - xy).max(axis=1).min() > FAR_M:
            continue
        to = xy - path[:, :2]
        c, s = np.cos(path[:, 2]), np.sin(path[:, 2])
        ahead, left = to[:, 0] * c + to[:, 1] * s, -to[:, 0] * s + to[:, 1] * c
        turned = np.zeros(len(path)) if yaw_rad is None else np.sin(path[:, 2] - yaw_rad) / PARALLEL_SIGMA_RAD
        aside = np.maximum(np.abs(left) - STREET_M, 0.0)
        belongs = np.exp(-(turned**2) / 2 - np.abs(ahead) / AHEAD_M - aside / ASIDE_M)
        k = int(np.argmax(belongs))
        found.append(_Passing(float(left[k]), float(path[k, 2]), float(belongs[k])))
    return found


# Neighbors of one row: axes are parallel within three standard deviations of a parked car's yaw; bumper to bumper with room for one
# more car at most and in one line, or side by side in places 2.3 to 3 m wide; lanes are wider.
MAX_TURNED_RAD = 0.2
MAX_ROW_GAP_M, MAX_OUT_OF_LINE_M = 7.0, 1.3
MAX_BESIDE_M, MAX_AHEAD_M = 3.0, 3.0
# Share of a row that points alike. Along a street the law of most countries asks for it. In places across, 76 % of drivers pull
# forward into them (AAA, 2015).
ALIKE_ALONG, ALIKE_ACROSS = 0.93, 0.76


@dataclass(frozen=True, eq=False)
class Row:
    """Vehicles that stand in one row."""

    members: NDArray[np.int64]  # (R,)
    toward: Array  # (R,): 1 for those whose yaw is that of the first member within a right angle, -1 for the others
    alike: float  # probability that a member points in the direction of the row

    def joint(self, own: Array, street: Array) -> tuple[float, Array]:
        """Combine what is known of each of M vehicles with what is known of the street.

        `own`, `street`: (M,): log-odds that a vehicle points along its yaw, and that the street goes that way.

        Returns `log_likelihood`: of all that is known of the members, given what is known of the street; `chance`: (R,):
        probability that each member points along its yaw, given all.
        """
        # Everything below is in the direction of the first member: first column for it, second against it.
        known = probability_of(np.outer(self.toward * own[self.members], [1.0, -1.0]))
        way = probability_of(np.mean(self.toward * street[self.members]) * np.array([1.0, -1.0]))
        # Likelihood of each member, by the direction of the row.
        each = self.alike * known + (1 - self.alike) * known[:, ::-1]
        # Directions that all members together exclude would underflow.
        logs = np.log(way) + np.log(each).sum(axis=0)
        total = float(np.logaddexp(*logs))
        row = np.exp(logs - total)
        along = self.alike * known[:, 0] / each[:, 0] * row[0] + (1 - self.alike) * known[:, 0] / each[:, 1] * row[1]
        return total, np.where(self.toward > 0, along, 1 - along)


def find_rows(poses: Array, lengths_m: Array, stands: NDArray[np.int64]) -> list[Row]:
    """Group those of M vehicles that stand into rows; one without neighbors, or that moves, is a row of its own.

    `poses`: (M, 3): x, y in m and yaw in rad up to half turns. `lengths_m`: (M,). `stands`: (S,): which of them stand.
    """
    in_line, beside = np.zeros((2, len(poses), len(poses)), dtype=bool)
    standing = np.zeros(len(poses), dtype=bool)
    standing[stands] = True
    for i in stands:
        to = rotate(poses[:, :2] - poses[i, :2], -poses[i, 2])
        parallel = standing & (np.abs(np.sin(poses[:, 2] - poses[i, 2])) < np.sin(MAX_TURNED_RAD))
        gap = np.abs(to[:, 0]) - (lengths_m + lengths_m[i]) / 2
        in_line[i] = parallel & (gap < MAX_ROW_GAP_M) & (np.abs(to[:, 1]) < MAX_OUT_OF_LINE_M)
        beside[i] = parallel & (np.abs(to[:, 0]) < MAX_AHEAD_M) & (np.abs(to[:, 1]) < MAX_BESIDE_M) & ~in_line[i]
    lot: NDArray[np.bool_] = np.any(beside | beside.T, axis=1)
    # On a car park the next one in line is of the row opposite, nose to nose.
    linked, label = beside | (in_line & ~lot & ~lot[:, None]), np.arange(len(poses))
    for i, j in zip(*np.nonzero(linked)):
        label[label == label[j]] = label[i]
    rows = []
    for members in (np.flatnonzero(label == k) for k in np.unique(label)):
        toward = np.where(np.cos(poses[members, 2] - poses[members[0], 2]) > 0, 1.0, -1.0)
        rows.append(Row(members, toward, ALIKE_ACROSS if lot[members].any() else ALIKE_ALONG))
    return rows


def headings_of(rows: Sequence[Row], own: Array, street: Array, right: float) -> Array:
    """Return the probability (M,) that each vehicle points along its yaw.

    `own`: (M,): log-odds by what is known of each alone. `street`: (2, M): log-odds that the street goes that way, if traffic
    keeps right, and if it keeps left. `right`: log-odds that traffic keeps right, by other evidence.

    Exact: rows are independent given the side of traffic, and members of a row given its direction.
    """
    total, chance = np.array([right, -right]) / 2, np.zeros((2, len(own)))
    for side in range(2):
        for row in rows:
            log_likelihood, chance[side, row.members] = row.joint(own, street[side])
            total[side] += log_likelihood
    return np.asarray(probability_of(total[0] - total[1]) * chance[0] + probability_of(total[1] - total[0]) * chance[1])


# A vehicle whose track is lost is found again within this time, where it was; another one rarely takes its place that soon.
MAX_PAUSE_S, MAX_APART_M, MAX_CONTINUED_TURN_RAD = 3.0, 2.0, 0.3
SAME_VEHICLE = 0.95


def continued_log_odds(waypoints: Sequence[Waypoints], own: Array) -> Array:
    """Add to what is known of each of M candidates what is known of those that it continues, and that continue it.

    `own`: (M,): log-odds that each points along its yaw, by what is known of it alone.
    """
    first = np.array([[w.t_s[0], w.x_m[0], w.y_m[0], w.yaw_rad[0]] for w in waypoints]).reshape(-1, 4)
    last = np.array([[w.t_s[-1], w.x_m[-1], w.y_m[-1], w.yaw_rad[-1]] for w in waypoints]).reshape(-1, 4)
    gap = first[None] - last[:, None]
    follows = (gap[..., 0] > 0) & (gap[..., 0] < MAX_PAUSE_S) & (np.hypot(gap[..., 1], gap[..., 2]) < MAX_APART_M)
    follows &= np.abs(np.sin(gap[..., 3])) < np.sin(MAX_CONTINUED_TURN_RAD)
    toward = np.where(np.cos(gap[..., 3]) > 0, 1.0, -1.0) * follows
    links = toward + toward.T
    # What is known of the other counts as far as it is the same vehicle.
    along = 0.5 + SAME_VEHICLE * (probability_of(own) - 0.5)
    return np.asarray(own + links @ log_odds_of(along))


# Slower vehicles do not show the direction of traffic, nor do those that may drive in reverse.
MIN_FLOW_SPEED_MPS, MIN_FLOW_LOG_ODDS = 1.5, 3.0
# Weights of the log-odds of the LiDAR network and of the outline where both tell: they see the same points. Fitted to 1,034 standing
# vehicles in simulated logs; halves of these give 0.68 to 0.71 and 0.30 to 0.37.
NETWORK_WEIGHT, OUTLINE_WEIGHT = 0.7, 0.33
# A vehicle without a yaw is laid along a street that it rather belongs to than not.
MIN_STREET_SHARE = 0.5
# Less likely headings are doubted: of those that are, at least one in three is wrong.
MIN_HEADING_CONFIDENCE = 0.7


def decide_headings(candidates: Sequence[AgentCandidate], ego_path: Array, timeline: Timeline) -> list[AgentCandidate]:
    """Decide which end of the vehicles and two-wheelers is the front.

    Each keeps its yaw or is turned round as a whole. How likely its heading is goes to its quality as
    `heading_confidence`; an unlikely one is doubted, and so is what moves as nothing of its category does.

    `candidates`: with a yaw, known up to half a turn, and a speed along it. `ego_path`: (K, 3): x, y and heading of the ego.

    What is known of each alone (motion, boxes of a 3D detector, the outline of its points) is combined with the direction
    of traffic beside it and with its neighbors (`headings_of`), for traffic on either side of the road.
    """
    of = [k for k, c in enumerate(candidates) if GROUP_OF[c.agent.category] in ("vehicle", "two_wheeler")]
    road_users = [candidates[k] for k in of]
    alone = []
    for c in road_users:
        w, m = c.agent.waypoints, c.track.measurements
        t_s = timeline.seconds(m.t_ns)
        odds, limit = heading_log_odds(m, np.interp(t_s, w.t_s, np.unwrap(w.yaw_rad))), MAX_COURSE_LOG_ODDS
        if c.agent.category in ("truck", "bus"):
            odds = min(max(odds, -MAX_LOG_ODDS_OF_LARGE), MAX_LOG_ODDS_OF_LARGE)
        if GROUP_OF[c.agent.category] == "vehicle":
            outline = outline_log_odds(c.track, w, t_s, c.agent.size_m)
            both = bool(odds and outline)
            odds = NETWORK_WEIGHT * odds + OUTLINE_WEIGHT * outline if both else odds + outline
            limit = min(COURSE_LOG_ODDS_PER_DETECTION * len(m), limit)
        alone.append(odds if c.agent.static else odds + course_log_odds(w, limit))
    own = continued_log_odds([c.agent.waypoints for c in road_users], np.array(alone))
    # Tentative tracks may be clutter, which tells nothing of traffic and of rows.
    confirmed = [is_confirmed(c.track) for c in road_users]
    paths = []  # x, y and heading at the waypoints at which each shows the direction of traffic
    for c, odds, trusted in zip(road_users, own.tolist(), confirmed):
        w = c.agent.waypoints
        moving = (np.abs(w.speed_mps) > MIN_FLOW_SPEED_MPS) & (abs(odds) > MIN_FLOW_LOG_ODDS) & trusted
        yaw = w.yaw_rad[moving] + (0.0 if odds > 0 else np.pi)
        paths.append(np.stack([w.x_m[moving], w.y_m[moving], yaw], axis=1))
    for k, c in enumerate(road_users):
        # What stands and of whose yaw nothing is known is laid along the street.
        w, axis = c.agent.waypoints, c.geometry.yaw_rad
        if not c.agent.static or (axis is not None and np.isfinite(axis)):
            continue
        passing = _passing_by(np.array([w.x_m[0], w.y_m[0]]), [ego_path, *paths], None)
        surest = max(passing, key=lambda path: path.belongs, default=None)
        if surest is not None and surest.belongs >= MIN_STREET_SHARE:
            sigma = np.sqrt(surest.belongs * PARALLEL_SIGMA_RAD**2 + (1 - surest.belongs) * UNKNOWN_YAW_RAD**2)
            yaw_rad = np.full(len(w.t_s), wrap_angle(surest.heading_rad))
            w = replace(w, yaw_rad=yaw_rad, sigma_yaw_rad=np.full(len(w.t_s), sigma))
            road_users[k] = replace(c, agent=replace(c.agent, waypoints=w))
    middle = [(c.agent.waypoints, len(c.agent.waypoints) // 2) for c in road_users]
    poses = np.array([[w.x_m[k], w.y_m[k], w.yaw_rad[k]] for w, k in middle])
    street, ways = np.zeros((2, len(of))), [ego_path, *paths]
    low, high = (
        np.array([f(way[:, :2], axis=0, initial=none) for way in ways])
        for f, none in ((np.min, np.inf), (np.max, -np.inf))
    )
    for k, pose in enumerate(poses):
        if GROUP_OF[road_users[k].agent.category] == "two_wheeler":
            continue  # they are parked at any angle; those that ride have a course
        away_m = np.maximum(low - pose[:2], pose[:2] - high).max(axis=1)
        away_m[k + 1] = np.inf
        street[:, k] = street_log_odds(pose, [ways[i] for i in np.flatnonzero(away_m <= FAR_M).tolist()])
    stands = np.flatnonzero([c.agent.static and trusted for c, trusted in zip(road_users, confirmed)])
    rows = find_rows(poses, np.array([c.agent.size_m[0] for c in road_users]), stands)
    chance = headings_of(rows, own, street, side_log_odds([ego_path, *paths]))
    decided = list(candidates)
    for k, candidate, along in zip(of, road_users, chance.tolist()):
        agent, w, confidence = candidate.agent, candidate.agent.waypoints, max(along, 1 - along)
        if along < 0.5:
            w = replace(w, yaw_rad=wrap_angle(w.yaw_rad + np.pi), speed_mps=0.0 - w.speed_mps)  # never -0.0
        agent = replace(agent, waypoints=w, quality={**agent.quality, "heading_confidence": round(confidence, 3)})
        doubts = [Finding("heading_ambiguous")] if confidence < MIN_HEADING_CONFIDENCE else []
        decided[k] = replace(candidate, agent=agent).doubted(doubts)
    return [c.doubted(motion_doubts(c.agent.category, c.agent.waypoints)) for c in decided]
