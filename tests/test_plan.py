"""What a run leaves out, one test a rule, each with its reason."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.config import Config
from log2sim.datatypes import Lidar, Log
from log2sim.errors import ConfigError, LogError
from log2sim.geometry import Camera, PoseTrack, transform
from log2sim.plan import Decision, HomographyScope, Plan, Stage, make_plan, select_sensors


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


T_NS = np.arange(21, dtype=np.int64) * 100_000_000


def plan_of(log: Log | None = None, config: Config | None = None) -> Plan:
    log, config = log or make_log(), config or Config()
    return make_plan(log, config, select_sensors(log, config), T_NS)


def decided(stage: Stage, log: Log | None = None, *settings: str) -> tuple[bool, str]:
    found = plan_of(log, Config.load(settings=settings)).decision(stage)
    return found.kept, found.reason


def test_every_stage_is_decided_once_with_a_reason() -> None:
    decisions = plan_of(config=Config.load(settings=["detect.name=labels+lidar:labels"])).decisions
    # About the fusion of vehicle and road only logs with both say something.
    assert [d.stage for d in decisions] == [stage for stage in Stage if stage is not Stage.FUSION_OF_ENDS]
    in_sweeps = [Stage.DETECTION_IN_SWEEPS, Stage.FUSION_WITH_LIDAR, Stage.FUSION_OF_ENDS]
    assert [d.stage for d in plan_of().decisions] == [s for s in Stage if s not in in_sweeps]
    assert not plan_of().keeps(Stage.DETECTION_IN_SWEEPS)
    assert all(len(d.reason) > 5 for d in decisions)
    assert decisions[0].to_dict() == {"stage": "use of every LiDAR", "kept": True, "reason": "1 within range"}


def test_without_lidar_there_is_nothing_to_compensate() -> None:
    assert decided(Stage.MOTION_COMPENSATION, make_log(lidars=())) == (False, "the log has no LiDAR")


def test_without_poses_nothing_can_be_compensated() -> None:
    kept, reason = decided(Stage.MOTION_COMPENSATION, make_log(moved_m=None))
    assert not kept
    assert "no ego poses" in reason


@pytest.mark.parametrize("moved_m", [0.0, 0.049])
def test_an_ego_that_stands_needs_no_compensation(moved_m: float) -> None:
    kept, reason = decided(Stage.MOTION_COMPENSATION, make_log(moved_m=moved_m))
    assert not kept
    assert f"{moved_m * 100:.1f} cm" in reason


@pytest.mark.parametrize("moved_m", [0.051, 12.5])
def test_an_ego_that_moves_needs_compensation(moved_m: float) -> None:
    kept, reason = decided(Stage.MOTION_COMPENSATION, make_log(moved_m=moved_m))
    assert kept
    assert f"{moved_m:.1f} m" in reason


def test_boxes_of_the_log_need_no_pixel() -> None:
    assert not decided(Stage.IMAGE_DECODING, None, "detect.name=labels")[0]


def test_a_detector_needs_pixels() -> None:
    assert decided(Stage.IMAGE_DECODING, None, "detect.name=some.onnx")[0]


def test_a_homography_is_left_out_when_told_so() -> None:
    assert decided(Stage.HOMOGRAPHY, None, "topdown.method=off") == (False, "topdown.method=off")


def test_a_homography_is_kept_without_lidar_and_for_what_lidar_misses() -> None:
    assert plan_of(make_log(lidars=())).homography is HomographyScope.CAMERAS_IN_NEED
    assert plan_of().homography is HomographyScope.CAMERAS_IN_NEED
    assert plan_of(config=Config.load(settings=["topdown.method=off"])).homography is HomographyScope.NONE
    reasons = [decided(Stage.HOMOGRAPHY, log)[1] for log in (make_log(lidars=()), make_log())]
    assert "without LiDAR" in reasons[0]
    assert "without LiDAR points" in reasons[1]


def test_one_camera_needs_no_fusion() -> None:
    assert decided(Stage.FUSION, make_log(cameras=("front",))) == (
        False,
        "one camera; only duplicates of its detector are dropped",
    )
    assert not decided(Stage.FUSION, None, "cameras=left")[0]
    assert decided(Stage.FUSION) == (True, "2 cameras")


def test_tracking_is_always_kept() -> None:
    assert decided(Stage.TRACKING, make_log(cameras=("front",), lidars=(), moved_m=None), "detect.name=labels")[0]


def test_smoothing_is_left_out_when_told_so() -> None:
    assert decided(Stage.SMOOTHING, None, "smooth.enabled=false") == (False, "smooth.enabled=false")


def test_cameras_are_all_or_those_asked_for_in_their_order() -> None:
    assert plan_of().cameras == ("front", "left")
    assert plan_of(config=Config(cameras=("left", "front"))).cameras == ("left", "front")


def test_a_camera_that_the_log_lacks_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no camera 'frnt' \(did you mean 'front'\?\); the log has front, left"):
        select_sensors(make_log(), Config(cameras=("left", "frnt")))


def test_a_log_without_cameras_is_refused() -> None:
    with pytest.raises(LogError, match="drive: the log has no camera"):
        select_sensors(make_log(cameras=()), Config())


def test_a_variant_changes_one_decision() -> None:
    plan = plan_of()
    later = plan.variant(Decision(Stage.HOMOGRAPHY, False, "for a comparison"))
    assert not later.keeps(Stage.HOMOGRAPHY)
    assert plan.keeps(Stage.HOMOGRAPHY)
    assert [d for d in later.decisions if d.stage is not Stage.HOMOGRAPHY] == [
        d for d in plan.decisions if d.stage is not Stage.HOMOGRAPHY
    ]
