"""Yaw and extents of points on rectangles that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import apart, scan, standing

from log2sim.perception.boxes import correct_yaws, extents, fit_yaw, rotate
from log2sim.perception.lidar.cloud import AzimuthIndex

QUARTER = np.pi / 2


def l_shape(length_m=4.4, width_m=1.85, count=120, noise_m=0.02, seed=0):
    """The near side and the rear of a box whose near rear corner is the origin, along +x and +y."""
    rng = np.random.default_rng(seed)
    on_length = rng.random(count) < length_m / (length_m + width_m)
    xy = np.where(
        on_length[:, None],
        np.stack([rng.uniform(0, length_m, count), np.zeros(count)], 1),
        np.stack([np.zeros(count), rng.uniform(0, width_m, count)], 1),
    )
    return xy + rng.normal(0, noise_m, (count, 2))


@pytest.mark.parametrize("yaw_deg", [0, 7, 15, 30, 44.5, 45, 46, 60, 89, 91, 179, 200, 271])
@pytest.mark.parametrize("sides", ["two", "long", "short"])
def test_yaw_of_a_rectangle_is_found_whatever_sides_are_seen(yaw_deg, sides):
    xy = l_shape()
    xy = {"two": xy, "long": xy[xy[:, 1] < 0.1], "short": xy[xy[:, 0] < 0.1]}[sides]
    yaw, contrast = fit_yaw(rotate(xy, np.deg2rad(yaw_deg)))
    assert apart(yaw, np.deg2rad(yaw_deg)) < np.deg2rad(1.5)
    assert 0 <= yaw < QUARTER
    assert contrast > 0.3


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(3))
def test_the_fit_turns_with_the_points(seed):
    rng = np.random.default_rng(seed)
    xy, first = l_shape(seed=seed), None
    for angle in rng.uniform(-np.pi, np.pi, 8):
        error = (fit_yaw(rotate(xy, angle))[0] - angle) % QUARTER
        first = error if first is None else first
        assert apart(error, first) < np.deg2rad(1.0)


def test_one_stray_point_does_not_turn_the_box():
    xy = rotate(np.vstack([l_shape(), [[-1.5, 3.5]]]), 0.4)
    assert apart(fit_yaw(xy)[0], 0.4) < np.deg2rad(1.5)


def test_extents_without_trim_are_the_exact_ends_along_and_across():
    corners = np.array([[0.0, 0], [4, 0], [4, 2], [0, 2], [1, 1]])
    low, high = extents(rotate(corners, 0.7), 0.7)
    np.testing.assert_allclose(low, [0, 0], atol=1e-12)
    np.testing.assert_allclose(high, [4, 2], atol=1e-12)


SENSOR = np.array([0.0, 0.0, 1.9], dtype=np.float32)


def ends_of(solids, of=0, only=None, **options):
    """Right and left end of one solid's points (or of those that `only` picks), as the index tells."""
    xyz, owner = scan(solids, **options)
    members = np.flatnonzero((owner == of) & (xyz[:, 2] > 0.2))
    if only is not None:
        members = members[only(xyz[members])]
    assert len(members) > 20
    index = AzimuthIndex.of(xyz.astype(np.float32), SENSOR, owner == -1)
    return index.ends_visible([members])[0].tolist()


WALL = standing(30.0, 0.0, 0.0, (0.5, 60.0, 4.0))


@pytest.mark.parametrize("behind", [[], [WALL]], ids=["ground behind", "wall behind"])
@pytest.mark.parametrize(("x", "y", "yaw"), [(12, 0, 0), (12, 4, 30), (20, -5, 90), (8, 3, -60)])
def test_both_ends_of_a_free_car_are_seen(x, y, yaw, behind):
    assert ends_of([standing(x, y, yaw), *behind]) == [True, True]


def test_the_turned_world_shows_the_same_ends():
    xyz, owner = scan([standing(12, 3, 40), standing(7, 2.4, 0, (0.5, 0.5, 3.0))])
    members = np.flatnonzero((owner == 0) & (xyz[:, 2] > 0.2))
    found = []
    for angle in np.linspace(-np.pi, np.pi, 13):
        c, s = np.cos(angle), np.sin(angle)
        turned = xyz @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        found.append(tuple(AzimuthIndex.of(turned.astype(np.float32), SENSOR, owner == -1).ends_visible([members])[0]))
    assert len(set(found)) == 1
    assert found[0] == (True, False)


def test_clusters_are_judged_alike_alone_and_together():
    """Clusters of very different sizes, one across the azimuth at which a turn begins, and two that share points."""
    pole = standing(-7, 1.6, 0, (0.4, 0.4, 3.0))
    occluder = standing(7, 0.9, 0, (1.0, 0.8, 3.0))
    solids = [standing(-12, 0, 10), pole, standing(14, 0, 90), occluder, standing(14, -9, 90), WALL]
    xyz, owner = scan(solids, azimuth_deg=(-180, 180))
    members = [np.flatnonzero((owner == k) & (xyz[:, 2] > 0.2)) for k in range(len(solids))]
    members = [one for one in [*members, np.union1d(members[0], members[1])] if len(one)]
    assert len(members) >= 5
    index = AzimuthIndex.of(xyz.astype(np.float32), SENSOR, owner == -1)
    alone = [index.ends_visible([one])[0].tolist() for one in members]
    assert index.ends_visible(members).tolist() == alone
    assert [True, True] in alone
    assert any(ends != [True, True] for ends in alone)


LENGTH_M, WIDTH_M, NOISE_M = 4.4, 1.85, 0.02


def side_points(rng, count, yaw_rad):
    """Points on the long and the short side of a rectangle far from the origin."""
    along = rng.random(count) < LENGTH_M / (LENGTH_M + WIDTH_M)
    x, y = rng.uniform(0, LENGTH_M, count) * along, rng.uniform(0, WIDTH_M, count) * ~along
    return rotate(np.stack([x, y], axis=1) + rng.normal(0, NOISE_M, (count, 2)), yaw_rad) + rng.uniform(-80, 80, 2)


def test_rough_yaws_are_corrected_where_enough_points_show_the_sides():
    rng = np.random.default_rng(4)
    yaw = np.array([0.3, -2.0, 1.1, 2.9])
    count = np.array([200, 400, 29, 90])
    points = np.concatenate([side_points(rng, n, angle) for n, angle in zip(count, yaw)])
    corrected = correct_yaws(points, count, yaw + 0.1)
    assert np.abs(corrected - yaw)[[0, 1, 3]].max() < np.deg2rad(1.5)
    assert corrected[2] == yaw[2] + 0.1
