"""Camera motion: the path of the ego from rendered images against exact poses, and logs whose images do not show it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from localization_worlds import HOUSES
from worlds import tiny_log

from log2sim import Config, reconstruct
from log2sim.datatypes import ImageLabels, Log, Stream
from log2sim.errors import LogError
from log2sim.geometry import PoseTrack, inverse
from log2sim.localization.camera_motion import follow_camera
from log2sim.localization.choice import localize

CAMERA = {"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [640, 400], "pitch_deg": -6.0}
TURN = [[0.0, 0.0, 5.0], [8.0, 0.0, 5.0], [20.0, 6.0, 5.0]]


@cache
def street(nod_deg: float = 0.0) -> Log:
    """Eight meters along a street and around a bend, without LiDAR; the camera looks up by an angle more than its mount says."""
    ego = {"waypoints": TURN, "poses": "poses", "rounding_m": 10.0}
    buildings = [{**house, "center": [house["center"][0] + 5, house["center"][1]]} for house in HOUSES]
    log, _ = tiny_log(
        [],
        duration_s=1.6,
        ego=ego,
        camera=[{**CAMERA, "pitch_deg": CAMERA["pitch_deg"] + nod_deg}],
        lidar=[],
        building=buildings,
        observe=False,
    )
    return log


@cache
def frames() -> list[np.ndarray]:
    return [street().streams["front"].read(i) for i in range(len(street().streams["front"].t_ns))]


def filmed(change=lambda image, i: image) -> Log:
    """The street without poses, its images changed by a function of the image and its index."""
    stream = street().streams["front"]
    changed = Stream("front", stream.t_ns, lambda i: change(frames()[i], i))
    return replace(street(), ego=None, streams={"front": changed})


@pytest.mark.slow
def test_the_path_of_the_camera_is_that_of_the_ego_within_some_percent() -> None:
    found = follow_camera(filmed(), "front")
    true, _ = street().ego.at(found.t_ns)
    true = inverse(true[0]) @ true
    path_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    off_m = np.linalg.norm(found.start_T_ego[:, :2, 3] - true[:, :2, 3], axis=1)
    assert path_m > 6
    assert off_m.max() < 0.05 * path_m
    turned = inverse(true[-1]) @ found.start_T_ego[-1]
    assert abs(np.arctan2(turned[1, 0], turned[0, 0])) < np.deg2rad(2.0)
    assert not found.predicted.any()


def test_images_that_do_not_change_show_an_ego_that_stands() -> None:
    found = follow_camera(filmed(lambda image, i: frames()[0]), "front")
    np.testing.assert_array_equal(found.start_T_ego, np.tile(np.eye(4), (len(found.t_ns), 1, 1)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda image, i: image // 64, "images are too dark"),
        (lambda image, i: np.full_like(image, 128), "show too little of the road"),
    ],
    ids=["dark", "blank"],
)
def test_images_that_show_nothing_are_refused_in_one_line(change, words: str) -> None:
    with pytest.raises(LogError, match=words) as caught:
        localize(filmed(change), Config())
    assert "\n" not in str(caught.value)


def test_a_camera_of_unknown_height_has_no_scale() -> None:
    log = filmed()
    flat = replace(log.cameras["front"], mount_T_cam=np.eye(4))
    with pytest.raises(LogError, match=r"camera 'front' is mounted 0.00 m above the ground"):
        localize(replace(log, cameras={"front": flat}), Config())


@pytest.mark.slow
def test_a_scenario_of_a_camera_alone_holds_the_ego() -> None:
    nothing = ImageLabels(np.zeros(0, dtype=np.int64), np.zeros((0, 4)), np.zeros(0, dtype="<U16"))
    log = replace(filmed(), image_labels={"front": nothing})
    result = reconstruct(log, Config.load(detect={"name": "labels"}))
    assert result.scenario.ego.quality["source"] == "camera motion"
    assert result.scenario.provenance["poses"] == {"source": "camera"}
    assert isinstance(result.log.ego, PoseTrack)
