"""People at the far end of a LiDAR with 32 layers: few points, and the image tells the rest."""

from __future__ import annotations

import numpy as np
import pytest
from test_measure import boxes, cloud_of, measure_view, view_ahead
from worlds import scan, standing

PERSON = (0.4, 0.4, 1.75)
# As the one of nuScenes: 32 layers from -30.7 to 10.7 degrees, one third of a degree around.
COARSE = {"azimuth_deg": (-20.0, 20.0), "elevation_deg": (-30.67, 10.67), "steps": (121, 32)}


def measured(solids, shown, *, category="pedestrian", **options):
    """Rows of the solids at the indices `shown`, and how many points each has."""
    world, owner = scan(solids, **COARSE | options)
    view = view_ahead()
    rows = measure_view(view, boxes(view, [solids[k] for k in shown], [category] * len(shown)), cloud_of(world))
    return rows, [int(((owner == k) & (world[:, 2] > 0.25)).sum()) for k in shown]


@pytest.mark.parametrize(("far", "fewest"), [((0.0, 0.0), 2), ((-0.4, 0.7), 0)])
def test_people_with_few_points_are_placed_as_far_as_their_points(far, fewest):
    people = [standing(x + far[0], y + far[1], 0, PERSON) for x, y in ((22, 5), (25, 0), (28, -6), (31, 3))]
    after, count = measured(people, range(4), noise_m=0.02, steps=(61, 22))
    seen = np.array(count) >= 2
    assert seen.sum() >= 3
    assert (after.source[seen] == "lidar").all()
    error = after.center_m[seen, :2] - np.array([p.center_m[:2] for p in people])[seen]
    assert np.hypot(*error.T).max() < 0.5
    squared = [e @ np.linalg.solve(c, e) for e, c in zip(error, after.covariance[seen])]
    assert max(squared) < 13.8  # 99.9 %, two degrees of freedom
    new = seen & np.array([len(cluster) == 0 for cluster in after.cluster])
    assert new.sum() >= fewest
    assert np.abs(after.bottom_m[new]).max(initial=0.0) < 0.05
    assert (after.points[new] >= 2).all()


def test_a_vehicle_is_not_placed_by_few_points():
    far = standing(26, -4, 0, PERSON)
    for category, placed in (("pedestrian", "lidar"), ("car", "")):
        rows, count = measured([far], [0], category=category, noise_m=0.02, steps=(61, 22))
        assert 2 <= count[0] <= 3
        assert rows.source.tolist() == [placed]


def test_a_picture_on_a_wall_a_fence_or_a_pole_is_no_body():
    person = standing(26, 1, 0, PERSON)
    for other in (standing(26, 1, 0, (0.3, 6.0, 2.5)), standing(26, 1, 0, (0.2, 0.2, 4.0))):
        world, _ = scan([other], **COARSE)
        view = view_ahead()
        rows = measure_view(view, boxes(view, [person], ["pedestrian"]), cloud_of(world))
        assert all(len(rows.cluster[k]) > 0 for k in np.flatnonzero(rows.source == "lidar"))


def test_people_side_by_side_hide_no_one_as_a_wall_does():
    people = [standing(24, y, 0, PERSON) for y in (-0.9, 0.0, 0.9)]
    after, count = measured(people, range(3), noise_m=0.01)
    assert min(count) >= 2
    assert (after.source == "lidar").all()
    assert np.abs(after.center_m[:, 1] - [-0.9, 0.0, 0.9]).max() < 0.3
