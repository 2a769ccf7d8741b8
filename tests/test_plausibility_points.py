"""What the points of the LiDAR say about agents: rays that end in them, pass through or stop before, and long surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_plausibility_conflicts import agent, candidate
from worlds import rows_at

from log2sim.agents.candidate import Support, Timeline
from log2sim.agents.evidence import (
    Ending,
    Recording,
    classify_rays,
    count_rays,
    weigh,
)
from log2sim.agents.judge import decide, missing_nats
from log2sim.datatypes import Log, Obstacles, Rays, Track
from log2sim.geometry import NS_PER_S
from log2sim.perception.sync import Schedule

SENSOR = np.array([0.0, 0.0, 1.9])
CAR = (4.4, 1.8, 1.5)
ORIGIN = np.array([4e5, 5e6, 30.0])
TIMELINE = Timeline(np.arange(5) * NS_PER_S, 0)


def classify(start, end, yaw=0.0, size=CAR):
    """The ending of one ray about a box whose center is the origin."""
    start, end = np.array([start], dtype=float), np.array([end], dtype=float)
    return Ending(classify_rays(start, end - start, np.array([yaw]), np.array([size]))[0][0])


@pytest.mark.parametrize(
    ("end_x_m", "ending"),
    # The near side is at -2.2 m, the solid part starts 0.3 m behind it; the far side is at 2.2 m.
    [(-5.0, Ending.BEFORE), (-2.2, Ending.INSIDE), (0.0, Ending.INSIDE), (2.2, Ending.INSIDE), (8.0, Ending.THROUGH)],
)
def test_a_ray_ends_before_in_or_behind_a_box(end_x_m, ending) -> None:
    assert classify((-20.0, 0.0, -0.2), (end_x_m, 0.0, -0.2)) is ending


def fan(wall_x_m, *, things=(), t_s=0.0):
    """Rays every 0.5 degrees from `SENSOR` to upright rectangles at x with y from and to, else a wall, else the flat ground."""
    azimuth, slope = (np.deg2rad(a).ravel() for a in np.meshgrid(np.arange(-60, 60.1, 0.5), np.arange(-15, 2.1, 0.5)))
    slope = np.tan(slope)
    reach = np.full(len(azimuth), wall_x_m) / np.cos(azimuth)
    reach = np.where(slope < 0, np.minimum(reach, SENSOR[2] / np.maximum(-slope, 1e-9)), reach)
    for x, y0, y1, top in things:
        at = x / np.cos(azimuth)
        y, z = at * np.sin(azimuth), SENSOR[2] + slope * at
        reach = np.where((y > y0) & (y < y1) & (z > 0) & (z < top) & (at < reach), at, reach)
    end = np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), SENSOR[2] + slope * reach])
    n = len(end)
    rays = Rays(
        end.astype(np.float32), np.full(n, t_s, np.float32), np.zeros(n, np.uint8),
        SENSOR[None].astype(np.float32), np.zeros((1, 3), np.float32),
    )  # fmt: skip
    return Obstacles(0, ORIGIN, end[:0].astype(np.float32), rays.t_s[:0], SENSOR.astype(np.float32), rays)


def over_map(built):
    w = built.waypoints
    return replace(built, waypoints=replace(w, x_m=w.x_m + ORIGIN[0], y_m=w.y_m + ORIGIN[1], z_m=w.z_m * 0 + 30.75))


def clouds(cloud):
    return [replace(cloud, stamp_ns=int(t)) for t in TIMELINE.t_ns]


def counted(built, cloud):
    counts, _ = count_rays([over_map(built)], clouds(cloud), TIMELINE)
    return [int(v.sum()) // 5 for v in counts]


def test_rays_that_go_on_to_ground_and_wall_behind_say_that_a_place_is_empty() -> None:
    inside, through, before = counted(agent(12.0), fan(40.0))
    assert (inside, before) == (0, 0)
    # They descend by 5.5 to 7 degrees from 1.9 m to 0.4 and 0.8 m, over 5 degrees of azimuth: 3 times 10 rays.
    assert through >= 20


def test_rays_that_end_at_the_back_of_a_car_support_it() -> None:
    inside, through, before = counted(agent(12.0), fan(40.0, things=[(9.8, -0.9, 0.9, 1.5)]))
    assert inside >= 20
    assert (through, before) == (0, 0)


def test_an_agent_through_whose_place_nearly_all_rays_pass_is_refuted() -> None:
    support = Support(inside=10, through=90, seen_ticks=9)
    assert decide(replace(candidate(agent(5.0)), support=support), 0.9) is None
    # The rays of two ticks, or few ones, may be chance; a box that is too large has something in it.
    for other in ({"seen_ticks": 2}, {"inside": 1, "through": 9}, {"inside": 40}):
        assert decide(replace(candidate(agent(5.0)), support=replace(support, **other)), 0.9) is not None


def with_support(**figures):
    return replace(candidate(agent(5.0)), support=Support(**figures))


def test_the_evidence_of_missing_detections_is_a_ratio_of_likelihoods():
    # 10 of 40 at a rate of 0.9 against 0.05; forty ticks that err alike count as 40 / (1 + 39 / 2) independent ones.
    mean = 0.25 * np.log(0.05 / 0.9) + 0.75 * np.log(0.95 / 0.1)
    assert missing_nats(Support(shown_ticks=40, detected_ticks=10), 0.9) == pytest.approx(mean * 40 / 20.5)
    # A detector that finds half of all misses more, so that missing says less.
    assert missing_nats(Support(shown_ticks=40, detected_ticks=10), 0.5) < 0
    assert missing_nats(Support(shown_ticks=3, detected_ticks=0), 0.9) == 0
    assert missing_nats(Support(shown_ticks=40, detected_ticks=0), 0.0) == 0


def test_what_no_ray_reaches_is_refuted_and_what_has_no_point_doubted():
    assert decide(with_support(unreached=True), 0.9) is None
    (doubt,) = decide(with_support(pointless=True), 0.9)
    assert doubt.kind == "hardly_observed"


VAN, BACK, CORNER = (9.8, -3.0, 3.0, 2.5), (17.8, -0.9, 0.9, 1.5), (17.8, 0.4, 0.9, 1.5)


@pytest.mark.parametrize(
    ("thing", "points", "pointless", "unreached"),
    [
        # Images show a car where the LiDAR sees a van before it, or look past its corner once.
        (VAN, [0, 0, 0, 0, 0], True, True),
        (VAN, [0, 0, 0, 30, 0], False, False),
        # Of some rays that reach its place most go on.
        (CORNER, [0, 0, 0, 0, 0], True, True),
        # Its points are those of what stands beside it, but rays end in it.
        (BACK, [0, 0, 0, 0, 0], True, False),
        (BACK, [9, 9, 9, 9, 9], False, False),
    ],
)
def test_where_the_lidar_looks_an_object_has_points(thing, points, pointless, unreached):
    car = over_map(agent(20.0))
    found = rows_at(np.array([[20.0, 0.0]] * 5) + ORIGIN[:2], "car", points=np.array(points), camera="front")
    found = replace(found, t_ns=TIMELINE.t_ns, sensor_m=np.tile(ORIGIN + SENSOR, (5, 1)))
    seen = replace(candidate(car), track=Track("car", np.arange(5), found))
    recording = Recording(
        Log("one", "none", {}, {}, {}),
        Schedule("front", TIMELINE.t_ns, {}, {}, {}),
        clouds(fan(40.0, things=[thing])),
        TIMELINE,
    )
    (weighed,) = weigh([seen], recording)
    assert (weighed.support.pointless, weighed.support.unreached) == (pointless, unreached)
    assert (decide(weighed, 0.9) is None) is unreached


"""Axes of a camera that looks along x."""
