"""What a run leaves out, one test a rule, each with its reason."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.config import Config
from log2sim.datatypes import Lidar, Log
from log2sim.errors import ConfigError, LogError
from log2sim.geometry import Camera, PoseTrack, transform
from log2sim.plan import Plan, Step, make_plan


def make_log(
    cameras: tuple[str, ...] = ("front", "left"), lidars: tuple[str, ...] = ("top",), moved_m: float | None = 12.5
) -> Log:
    """A log without records; `moved_m` None for one without ego poses."""
    ego = None
    if moved_m is not None:
        position = np.array([[100.0, 50.0, 0.0], [100.0, 50.0 - moved_m, 0.0], [100.0, 50.0, 0.0]])
        ego = PoseTrack(np.array([0, 1, 2]) * 10**9, transform(np.eye(3), position))
    k = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    return Log(
        name="drive",
        format="log2sim",
        cameras={c: Camera(c, 640, 480, k, "ego", np.eye(4)) for c in cameras},
        lidars={name: Lidar(name, "ego", np.eye(4)) for name in lidars},
        streams={},
        ego=ego,
    )


def step(plan: Plan, stage: str) -> Step:
    (found,) = [s for s in plan.steps if s.stage == stage]
    return found


def decided(stage: str, log: Log | None = None, *settings: str, picture: bool = False) -> tuple[bool, str]:
    found = step(make_plan(log or make_log(), Config.load(settings=settings), picture=picture), stage)
    return found.kept, found.reason


def test_every_stage_is_decided_once_with_a_reason() -> None:
    plan = make_plan(make_log(), Config())
    stages = [s.stage for s in plan.steps]
    assert len(set(stages)) == len(stages)
    assert set(stages) == {
        "every LiDAR", "compensate", "decode images", "every frame", "homography", "fuse", "track", "smooth",
        "smooth parked agents", "every waypoint",
    }  # fmt: skip
    assert all(s.kept and len(s.reason) > 5 for s in plan.steps)
    assert plan.to_list() == [{"stage": s.stage, "kept": s.kept, "reason": s.reason} for s in plan.steps]


def test_without_lidar_there_is_nothing_to_compensate() -> None:
    assert decided("compensate", make_log(lidars=())) == (False, "the log has no LiDAR")


def test_without_poses_nothing_can_be_compensated() -> None:
    kept, reason = decided("compensate", make_log(moved_m=None))
    assert not kept
    assert "no ego poses" in reason


@pytest.mark.parametrize("moved_m", [0.0, 0.049])
def test_an_ego_that_stands_needs_no_compensation(moved_m: float) -> None:
    kept, reason = decided("compensate", make_log(moved_m=moved_m))
    assert not kept
    assert f"{moved_m * 100:.1f} cm" in reason


@pytest.mark.parametrize("moved_m", [0.051, 12.5])
def test_an_ego_that_moves_needs_compensation(moved_m: float) -> None:
    kept, reason = decided("compensate", make_log(moved_m=moved_m))
    assert kept
    assert f"{moved_m:.1f} m" in reason


def test_boxes_of_the_log_need_no_pixel() -> None:
    assert not decided("decode images", None, "detect.name=labels")[0]


def test_a_picture_needs_pixels_even_with_boxes_of_the_log() -> None:
    kept, reason = decided("decode images", None, "detect.name=labels", picture=True)
    assert kept
    assert "picture" in reason


def test_a_detector_needs_pixels() -> None:
    assert decided("decode images", None, "detect.name=some.onnx")[0]


def test_a_homography_is_left_out_when_told_so_picture_or_not() -> None:
    assert decided("homography", None, "topdown.method=off") == (False, "topdown.method=off")
    assert decided("homography", None, "topdown.method=off", picture=True) == (False, "topdown.method=off")


def test_a_homography_is_kept_for_a_picture_without_lidar_and_for_what_lidar_misses() -> None:
    assert decided("homography", picture=True) == (True, "a top-down picture is asked for")
    kept, reason = decided("homography", make_log(lidars=()))
    assert kept
    assert "without LiDAR" in reason
    kept, reason = decided("homography")
    assert kept
    assert "without LiDAR points" in reason


def test_one_camera_needs_no_fusion() -> None:
    assert decided("fuse", make_log(cameras=("front",))) == (
        False,
        "one camera sees no object twice; only doubles of its detector are dropped",
    )
    assert not decided("fuse", None, "cameras=left")[0]
    assert decided("fuse") == (True, "2 cameras")


def test_tracking_is_always_kept() -> None:
    assert decided("track", make_log(cameras=("front",), lidars=(), moved_m=None), "detect.name=labels")[0]


def test_smoothing_is_left_out_when_told_so() -> None:
    assert decided("smooth", None, "smooth.enabled=false") == (False, "smooth.enabled=false")


def test_cameras_are_all_or_those_asked_for_in_their_order() -> None:
    assert make_plan(make_log(), Config()).cameras == ("front", "left")
    assert make_plan(make_log(), Config(cameras=("left", "front"))).cameras == ("left", "front")


def test_a_camera_that_the_log_lacks_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no camera 'frnt' \(did you mean 'front'\?\); the log has front, left"):
        make_plan(make_log(), Config(cameras=("left", "frnt")))


def test_a_log_without_cameras_is_refused() -> None:
    with pytest.raises(LogError, match="drive: the log has no camera"):
        make_plan(make_log(cameras=()), Config())


def test_what_only_the_data_can_tell_changes_one_decision() -> None:
    plan = make_plan(make_log(), Config())
    later = plan.decided("homography", False, "every detection has LiDAR points")
    assert not later.keeps("homography")
    assert plan.keeps("homography")
    assert step(later, "homography").reason == "every detection has LiDAR points"
    assert [s for s in later.steps if s.stage != "homography"] == [s for s in plan.steps if s.stage != "homography"]
    assert later.cameras == plan.cameras
