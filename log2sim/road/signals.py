"""Traffic lights: where they are and which lamps shine when.

Each box is a ray, and its height says roughly how far away the housing is. The rays of a moving camera, or of several cameras,
cross; those of one that stands do not, and then the distance stays as unsure as the size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import linear_sum_assignment

from log2sim.datatypes import Log, Scenario, Signal
from log2sim.geometry import NS_PER_S, Array, undistort
from log2sim.perception.frames import LightBox

STATES = ("red", "red_yellow", "yellow", "green", "off")
# Hues of lamps in degrees (HSV), from EN 12368's chromaticities and what cameras make of them: the bounds lie between red (0 to
# 15), yellow (30 to 55) and green (130 to 185).
RED_HUES, YELLOW_HUES, GREEN_HUES = (330.0, 22.0), (22.0, 75.0), (95.0, 215.0)
# A lit lamp is brighter than its housing by at least this share of full scale, and has a color at least at its rim.
MIN_CONTRAST, MIN_SATURATION = 0.18, 0.35
# Lamps are in the middle of their housing: leaves and sky beside it are not looked at. Two lit lamps with their glare cover half of
# it; signs, cones, and rear lamps of vehicles shine all over.
SIDE_SHARE, MAX_LIT_SHARE = 0.22, 0.55
HOUSING_QUANTILE = 0.25  # a housing covers more than half of its box; the sky around it may be brighter than its lamps
# Share of a crop that a lamp covers: 0.1 of a box that fits; much less is a speck.
MIN_LAMP_SHARE = 0.012
# Middle of the lamps along the housing from its top, and how far off their light appears in a box that fits loosely.
PLACES, PLACE_SIGMA = (0.2, 0.5, 0.8), 0.25
UPRIGHT = 1.3  # height by width; other housings lie, or are round, and the place says nothing
# Probabilities of the colors that a lamp of each color shows: red and yellow lamps are alike where they are clipped.
SEEN_AS = np.array([[0.84, 0.14, 0.02], [0.2, 0.76, 0.04], [0.01, 0.05, 0.94]])
SEEN_SHARE, MIN_APART = 0.15, 0.15  # of what shines; of the housing's length
# One picture is wrong for reasons that the next ones share: what it says counts for no more than this, in nats.
MAX_EVIDENCE = 3.0
OFF_WHERE_LIT, LIT_WHERE_DARK = 0.03, 0.15


def lamp_evidence(crop_bgr: NDArray[np.uint8]) -> Array:
    """Return the log-likelihoods (S,) of `STATES`, up to a constant, of a crop (h, w, 3) around a box."""
    shares, places = find_lamps(crop_bgr)
    total = shares.sum()
    if total < MIN_LAMP_SHARE:
        log = np.full(len(STATES), np.log(LIT_WHERE_DARK))
        log[STATES.index("off")] = 0.0
        return log
    upright = crop_bgr.shape[0] > UPRIGHT * crop_bgr.shape[1]
    shares, log = shares / total, np.empty(len(STATES))
    for k, state in enumerate(STATES):
        lamps = {"red": [0], "red_yellow": [0, 1], "yellow": [1], "green": [2], "off": []}[state]
        if not lamps:
            log[k] = np.log(OFF_WHERE_LIT)
            continue
        log[k] = float(shares @ np.log(SEEN_AS[lamps].mean(axis=0)))
        if len(lamps) == 2:
            # Both shine, one below the other.
            apart = not upright or places[1] - places[0] > MIN_APART
            log[k] += 0.0 if min(shares[0], shares[1]) > SEEN_SHARE and apart else np.log(LIT_WHERE_DARK)
        for color in np.flatnonzero(shares > SEEN_SHARE) if upright else ():
            off = min(abs(places[color] - PLACES[lamp]) for lamp in lamps) / PLACE_SIGMA
            log[k] -= 0.5 * float(shares[color]) * off**2
    return np.asarray(np.maximum(log - log.max(), -MAX_EVIDENCE))


def find_lamps(crop_bgr: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Return how much of a crop shines red, yellow and green (3,), and the mean places (3,) from its top, NaN where nothing does."""
    edge = int(SIDE_SHARE * crop_bgr.shape[1])
    rgb = crop_bgr[:, edge : crop_bgr.shape[1] - edge, ::-1].astype(np.float64) / 255
    value = rgb.max(axis=2)
    chroma = value - rgb.min(axis=2)
    saturation = np.divide(chroma, value, out=np.zeros_like(value), where=value > 0)
    lit = value > np.quantile(value, HOUSING_QUANTILE) + MIN_CONTRAST
    colored = lit & (saturation > MIN_SATURATION)
    shares, places = np.zeros(3), np.full(3, np.nan)
    if lit.mean() > MAX_LIT_SHARE:
        return shares, places
    red, green, blue = np.moveaxis(rgb, 2, 0)
    safe, top = np.where(chroma > 0, chroma, 1.0), rgb.argmax(axis=2)
    by_top = [((green - blue) / safe) % 6, (blue - red) / safe + 2]
    hue = 60 * np.select([top == 0, top == 1], by_top, (red - green) / safe + 4)  # degrees
    color = np.full(hue.shape, -1)
    color[_between(hue, RED_HUES)], color[_between(hue, YELLOW_HUES)], color[_between(hue, GREEN_HUES)] = 0, 1, 2
    rows = (np.arange(len(rgb)) + 0.5) / len(rgb)
    weight = np.where(colored, chroma * value, 0.0)
    for k in range(3):
        part = np.where(color == k, weight, 0.0).sum(axis=1)
        shares[k] = part.sum() / rgb[..., 0].size
        if part.sum() > 0:
            places[k] = float(part @ rows / part.sum())
    return shares, places


def _between(hue: Array, bounds: tuple[float, float]) -> NDArray[np.bool_]:
    low, high = bounds
    return np.asarray((hue >= low) & (hue < high) if low < high else (hue >= low) | (hue < high))


# Mean durations in s (RiLSA 2015 and MUTCD 2023: red and green of tens of seconds, yellow 3 to 6 s, red with yellow 1 to 2 s), and
# what follows: shares of the next states. What no program does happens still, where pictures or boxes are mixed up.
DURATION_S = {"red": 30.0, "red_yellow": 1.2, "yellow": 3.5, "green": 25.0, "off": 60.0}
FOLLOWS = {
    "red": {"green": 0.45, "red_yellow": 0.53, "off": 0.01, "yellow": 0.01},
    "red_yellow": {"green": 0.97, "red": 0.03},
    "yellow": {"red": 0.95, "off": 0.03, "green": 0.02},
    "green": {"yellow": 0.97, "red": 0.02, "off": 0.01},
    "off": {"yellow": 0.5, "red": 0.4, "green": 0.1},
}
# Without a picture a state is taken to last this long, half of the shortest that drivers see.
HOLD_S = 0.6
# A signal that shows the same before and after a gap has not changed meanwhile: away and back takes at least a shortest green (5 s)
# or a yellow and a red.
LEAST_CYCLE_S = 5.0
MIN_STATE_S = 0.25  # shorter changes are of single pictures


def most_probable_states(t_s: Array, evidence: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the most probable course of states (T,), and the probability (T,) of each given all pictures.

    `t_s`: (T,): increasing times of pictures; equal ones are of several cameras. `evidence`: (T, S): log-likelihoods of
    `STATES`.

    Viterbi (1967) for the course, forward-backward (Rabiner 1989) for the probabilities, with the transitions of a Markov process
    in continuous time.
    """
    count = len(STATES)
    rates = np.zeros((count, count))  # of changes per s, from each state to each
    for k, state in enumerate(STATES):
        for following, share in FOLLOWS[state].items():
            rates[k, STATES.index(following)] = share / DURATION_S[state]
        rates[k, k] = -rates[k].sum()
    gaps = np.round(np.diff(t_s), 3).tolist()
    of_gap = {gap: expm(rates * gap) for gap in set(gaps)}
    steps = [of_gap[gap] for gap in gaps]
    best, origin = np.zeros((len(t_s), count)), np.zeros((len(t_s), count), np.intp)
    best[0] = evidence[0]
    forward, backward = np.zeros((len(t_s), count)), np.ones((len(t_s), count))
    likelihood = np.exp(evidence - evidence.max(axis=1, keepdims=True))
    forward[0] = likelihood[0] / likelihood[0].sum()
    for k, step in enumerate(steps):
        paths = best[k][:, None] + np.log(np.maximum(step, 1e-12))
        origin[k + 1] = paths.argmax(axis=0)
        best[k + 1] = paths.max(axis=0) + evidence[k + 1]
        forward[k + 1] = (forward[k] @ step) * likelihood[k + 1]
        forward[k + 1] /= forward[k + 1].sum()
    for k in range(len(steps) - 1, -1, -1):
        backward[k] = steps[k] @ (likelihood[k + 1] * backward[k + 1])
        backward[k] /= backward[k].sum()
    course = np.zeros(len(t_s), np.intp)
    course[-1] = int(best[-1].argmax())
    for k in range(len(steps), 0, -1):
        course[k - 1] = origin[k, course[k]]
    posterior = forward * backward
    posterior /= posterior.sum(axis=1, keepdims=True)
    return course, posterior[np.arange(len(t_s)), course]


def changes_of(t_s: Array, course: NDArray[np.intp]) -> tuple[Array, list[str]]:
    """Return times (K,), s, and states from each time on: a course at times (T,) with "unknown" where no picture tells."""
    times, states = [float(t_s[0])], [STATES[course[0]]]
    for k in range(1, len(t_s)):
        state, gap = STATES[course[k]], t_s[k] - t_s[k - 1]
        if gap > (LEAST_CYCLE_S if state == states[-1] else 2 * HOLD_S):
            times += [float(t_s[k - 1] + HOLD_S), float(t_s[k] - HOLD_S / 2)]
            states += ["unknown", state]
        elif state != states[-1]:
            times.append(float(t_s[k - 1] + t_s[k]) / 2)
            states.append(state)
    times.append(float(t_s[-1] + HOLD_S))
    states.append("unknown")
    kept = [k for k in range(len(times)) if k + 1 == len(times) or times[k + 1] - times[k] >= MIN_STATE_S]
    merged = [k for n, k in enumerate(kept) if n == 0 or states[k] != states[kept[n - 1]]]
    return np.array([times[k] for k in merged]), [states[k] for k in merged]


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
    """A traffic light as far as it is known."""

    position: Array  # (3,), m, map frame
    covariance: Array  # (3, 3)
    boxes: list[LightBox] = field(default_factory=list)
    eyes: list[Array] = field(default_factory=list)  # where each was seen from

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
        if not known[0]:
            continue
        # Each sight of a frame is given to the housing that it fits best, or makes a new one.
        sights = [_sight_of(log, box, poses[0]) for box in seen]
        sights = [sight for sight in sights if np.isfinite(sight.ray).all() and sight.side_rad > 0]
        positions = np.array([housing.position for housing in housings]).reshape(-1, 3)
        covariances = np.array([housing.covariance for housing in housings]).reshape(-1, 3, 3)
        cost = np.array([_misfits(positions, covariances, s) for s in sights]).reshape(len(sights), len(housings))
        taken = set()
        for row, column in zip(*linear_sum_assignment(np.minimum(cost, 10 * GATE))):
            if cost[row, column] <= GATE:
                _update(housings[column], sights[row])
                taken.add(row)
        for sight in (sight for k, sight in enumerate(sights) if k not in taken):
            ranged, along = _range_of(sight), np.outer(sight.ray, sight.ray)
            distance = SIDE_M / sight.side_rad if ranged is None else ranged
            spread = SIDE_SIGMA if ranged is None else RANGE_SIGMA_M / ranged
            covariance = (spread * distance) ** 2 * along + (sight.sigma_rad * distance) ** 2 * (np.eye(3) - along)
            housings.append(Housing(sight.eye + distance * sight.ray, covariance, [sight.box], [sight.eye]))
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
            spread = housing.covariance + other.covariance + np.eye(3) * PART_M**2
            close = off @ np.linalg.solve(spread, off) < MERGE_GATE
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


# Fewer boxes are as likely of something else that is red or green: single false boxes do not repeat in one place.
MIN_BOXES = 3
# Middles of housings above the road: pedestrians' signals begin at 2.1 m, those above lanes at 5 to 7 m.
HEIGHT_M, HEIGHT_MARGIN_M = (1.9, 9.0), 0.2
# Where the distance is less sure than this, no place is stated.
MAX_SIGMA_M = 8.0
# What is likelier wrong than right is not stated.
MIN_CONFIDENCE = 0.5
# Of pictures with a lit lamp.
MIN_LIT_SHARE = 0.4
# From so many boxes on, a light is as sure as their scores; half as sure from a third of it.
SURE_BOXES = 6.0


def find_signals(log: Log, scenario: Scenario, boxes: Sequence[LightBox]) -> tuple[tuple[Signal, ...], str]:
    """Find the traffic lights among boxes of frames.

    Returns `signals`: ordered by when they are first seen; `seen`: how many there are, and how many places of boxes
    were left out, in words.
    """
    if not boxes:
        return (), "no traffic light seen"
    signals: list[Signal] = []
    housings = sorted(place_lights(log, boxes), key=lambda housing: min(box.t_ns for box in housing.boxes))
    for housing in housings:
        # Seen often enough, placed well enough, and where signals hang.
        if len(housing.boxes) < MIN_BOXES or housing.sigma_m > MAX_SIGMA_M:
            continue
        ground_z = 0.0  # of the road where the vehicle was nearest to the housing
        if log.ego is not None:
            poses = log.ego.at(np.array([box.t_ns for box in housing.boxes]))[0]
            away = np.linalg.norm(poses[:, :2, 3] - housing.position[:2], axis=1)
            ground_z = float(poses[int(np.nanargmin(away)), 2, 3]) + log.ground_z_ego_m
        height = housing.position[2] - ground_z
        margin = HEIGHT_MARGIN_M + float(np.sqrt(housing.covariance[2, 2]))
        if HEIGHT_M[0] - margin <= height <= HEIGHT_M[1] + margin:
            signal = _signal(f"signal_{len(signals) + 1}", housing, scenario)
            signals += [] if signal is None else [signal]
    text = f"{len(signals)} traffic light{'' if len(signals) == 1 else 's'}"
    if left_out := len(housings) - len(signals):
        text += f"; {left_out} places left out: seen too rarely, placed too roughly, not where signals hang, no lamp lit, or too unsure"
    return tuple(signals), text


def _signal(name: str, housing: Housing, scenario: Scenario) -> Signal | None:
    """Return the signal of a housing; None where lamps are lit in too few of its pictures, or too unsure."""
    order = sorted(range(len(housing.boxes)), key=lambda k: (housing.boxes[k].t_ns, housing.boxes[k].camera))
    boxes = [housing.boxes[k] for k in order]
    t_s = np.array([(box.t_ns - scenario.t0_ns) / NS_PER_S for box in boxes])
    evidence = np.array([lamp_evidence(box.crop) for box in boxes])
    course, probability = most_probable_states(t_s, evidence)
    lit = evidence.argmax(axis=1) != STATES.index("off")
    # Dark from everywhere is more often a housing's back, or a tree, than a signal that is off.
    times, states = changes_of(t_s, course)
    if lit.mean() < MIN_LIT_SHARE or set(states) <= {"off", "unknown"}:
        return None
    heading = None  # the mean direction from which lamps were seen lit
    if lit.any():
        away = np.array([housing.eyes[k] for k, shines in zip(order, lit) if shines])[:, :2] - housing.position[:2]
        x, y = (away / np.linalg.norm(away, axis=1, keepdims=True)).mean(axis=0)
        heading = float(np.arctan2(y, x))
    score = float(np.mean([box.score for box in boxes]))
    repeated = 1 - (1 - score) ** (len(boxes) / SURE_BOXES * 2)
    confidence = repeated * float(probability.mean())
    if confidence < MIN_CONFIDENCE:
        return None
    return Signal(
        id=name,
        position_m=housing.position,
        heading_rad=heading,
        t_s=times,
        state=np.array(states),
        sigma_m=housing.sigma_m,
        confidence=round(confidence, 3),
        cameras=tuple(sorted({box.camera for box in boxes})),
    )
