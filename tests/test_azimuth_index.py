"""Ends of clusters: what the rays beside an end reached tells whether it is the object's."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import scan, standing

from log2sim.perception.lidar.cloud import AzimuthIndex

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


def test_a_car_straight_behind_is_as_one_ahead():
    assert ends_of([standing(-12, 0, 10)], azimuth_deg=(135, 225)) == [True, True]
    pole = standing(-7, -0.9, 0, (0.6, 0.6, 3.0))
    # Seen from the sensor that looks back, -y is on the left.
    assert ends_of([standing(-12, 0, 10), pole], azimuth_deg=(135, 225)) == [True, False]


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
