"""Simulated pictures: what is seen again, what was left out, who is taken out, put aside or added, and where none are made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from log2sim.datatypes import Log, Scenario
from log2sim.errors import ConfigError
from log2sim.logs.opening import open_log
from log2sim.resim.cameras import Pictures
from log2sim.resim.simulate import MASKS, Simulation, resimulate, with_sensors
from log2sim.resim.world import World, build_world
from log2sim.simulation.policy import Controls, Observation
from log2sim.simulation.runner import replay
from log2sim.synth import Scene, load_scene, synthesize

SCENES = Path(__file__).resolve().parents[1] / "samples" / "scenes"
CAMERA = "front"


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A second of a street with houses and cars, with a small camera and a LiDAR of fewer rays."""
    bare = load_scene(SCENES / "bare.toml")
    lidar = bare.lidar[0].model_copy(update={"azimuth_step_deg": 1.2})
    camera = next(c for c in bare.camera if c.name == CAMERA).model_copy(update={"size_px": (448, 260)})
    return bare.model_copy(update={"camera": (camera,), "lidar": (lidar,), "duration_s": 1.2})


@pytest.fixture(scope="module")
def recorded(scene: Scene) -> tuple[Log, Scenario]:
    return synthesize(scene, observe=False)


@pytest.fixture(scope="module")
def world(recorded: tuple[Log, Scenario]) -> World:
    log, truth = recorded
    return build_world(log, truth, list(log.lidars))


def psnr_db(a: np.ndarray, b: np.ndarray, where: np.ndarray | None = None) -> float:
    off = (a.astype(float) - b)[... if where is None else where]
    return float(10 * np.log10(255**2 / max((off**2).mean(), 1e-3)))


def without(scenario: Scenario, id: str) -> Scenario:
    return replace(scenario, agents=tuple(a for a in scenario.agents if a.id != id))


def rendered_without(scene: Scene, id: str, i: int) -> np.ndarray:
    rest = scene.model_copy(update={"agent": tuple(a for a in scene.agent if a.id != id)})
    return synthesize(rest, observe=False)[0].streams[CAMERA].read(i)


def test_what_happened_is_seen_again_as_it_was_recorded(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    t_ns = int(log.streams[CAMERA].t_ns[8])
    image, unknown = Pictures(log, world, truth).make(log, truth, world.agents, CAMERA, t_ns)
    same = (image == log.streams[CAMERA].read(8)).all(axis=2)
    assert same.mean() > 0.995
    assert unknown.mean() < 0.002


def test_pictures_that_were_left_out_come_back_better_than_the_nearest(
    recorded: tuple[Log, Scenario], world: World
) -> None:
    log, truth = recorded
    pictures = Pictures(log, world, truth, leave_out=lambda _, i: i % 4 == 2)
    for i in (6,):
        image, _ = Simulation(log, world, truth, 0, pictures).picture(CAMERA, int(log.streams[CAMERA].t_ns[i]))
        true, nearest = (log.streams[CAMERA].read(k) for k in (i, i - 1))
        assert psnr_db(image, true) > psnr_db(nearest, true) + 4


def test_who_is_removed_is_gone_and_the_street_behind_is_there(
    scene: Scene, recorded: tuple[Log, Scenario], world: World
) -> None:
    log, truth = recorded
    i, id = 9, "ahead_gray"
    there, gone = log.streams[CAMERA].read(i), rendered_without(scene, id, i)
    shown = np.abs(there.astype(int) - gone).max(axis=2) > 20
    simulation = Simulation(log, world, without(truth, id), 0, Pictures(log, world, truth))
    image, unknown = simulation.picture(CAMERA, int(log.streams[CAMERA].t_ns[i]))
    changed = cv2.dilate(shown.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert psnr_db(image, gone, changed) > psnr_db(there, gone, changed) + 2.5
    assert psnr_db(image, gone, changed & ~unknown) > psnr_db(there, gone, changed & ~unknown) + 3
    assert unknown[~changed].mean() < 0.02


def test_an_agent_without_pictures_is_drawn_and_told(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    (source,) = (a for a in truth.others if a.id == "ahead_gray")
    w = source.waypoints
    new = replace(
        source,
        id="new",
        color={"rgb": [20, 200, 40], "name": "green"},
        waypoints=replace(w, x_m=w.x_m - 3, y_m=w.y_m + 3),
    )
    added = replace(truth, agents=(*truth.agents, new))
    t_ns = int(log.streams[CAMERA].t_ns[8])
    pictures = Pictures(log, world, truth)
    before = Simulation(log, world, truth, 0, pictures).picture(CAMERA, t_ns)[0].astype(int)
    image, unknown = Simulation(log, world, added, 0, pictures).picture(CAMERA, t_ns)
    green = (image[..., 1] > image[..., 2] + 25) & (image[..., 1] > image[..., 0] + 25)
    assert (green & unknown).sum() > 50
    far = cv2.dilate(unknown.astype(np.uint8), np.ones((61, 61), np.uint8)) == 0
    assert (np.abs(image - before).max(axis=2)[far] <= 2).mean() > 0.98


def test_pictures_are_refused_far_off_the_path_and_nothing_is_written(
    recorded: tuple[Log, Scenario], tmp_path: Path
) -> None:
    log, truth = recorded
    ego = truth.ego
    assert ego is not None
    aside = replace(ego, waypoints=replace(ego.waypoints, y_m=ego.waypoints.y_m + 5))
    with pytest.raises(ConfigError, match="off the path"):
        resimulate(log, truth, replace(truth, agents=(aside, *truth.others)), tmp_path / "out", cameras=True)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_how_much_of_pictures_is_made_up_is_told(recorded: tuple[Log, Scenario], tmp_path: Path) -> None:
    """From 2 m aside and turned by 60 degrees, which no camera looked to."""
    log, truth = recorded
    short = log.changed(streams={k: replace(s, t_ns=s.t_ns[:2]) for k, s in log.streams.items()})
    ego = truth.ego
    assert ego is not None
    w = ego.waypoints
    turned = replace(ego, waypoints=replace(w, y_m=w.y_m + 2, yaw_rad=w.yaw_rad + np.deg2rad(60)))
    now = replace(truth, agents=(turned, *truth.others))
    (note,) = (n for n in resimulate(short, truth, now, tmp_path / "out", sensors=[CAMERA]) if "recorded picture" in n)
    masks = [
        cv2.imread(str(m), cv2.IMREAD_GRAYSCALE) > 0 for m in sorted((tmp_path / "out" / MASKS / CAMERA).iterdir())
    ]
    assert f"shows {np.mean(masks):.0%} of what {CAMERA} sees" in note
    assert np.mean(masks) > 0.4


@pytest.mark.slow
def test_a_log_with_pictures_has_a_mask_for_each(recorded: tuple[Log, Scenario], tmp_path: Path) -> None:
    log, truth = recorded
    short = log.changed(streams={k: replace(s, t_ns=s.t_ns[:4]) for k, s in log.streams.items()})
    resimulate(short, truth, truth, tmp_path / "out", sensors=[CAMERA])
    back = open_log(tmp_path / "out")
    assert list(back.cameras) == [CAMERA]
    assert not back.lidars
    assert psnr_db(back.streams[CAMERA].read(2), log.streams[CAMERA].read(2)) > 30
    masks = sorted((tmp_path / "out" / MASKS / CAMERA).iterdir())
    assert [m.name for m in masks] == [f"{i:06d}.png" for i in range(4)]
    assert cv2.imread(str(masks[0]), cv2.IMREAD_GRAYSCALE).shape == (260, 448)


def test_a_policy_looks_through_a_camera(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    images: list[np.ndarray] = []

    def drive(observation: Observation) -> Controls:
        if not images and observation.t_s >= 0.6:
            images.append(observation.image(CAMERA))
            with pytest.raises(ConfigError, match="sweep 'front': no such sensor"):
                observation.sweep(CAMERA)
        return Controls(0.0, 0.0)

    replay(truth, ego=with_sensors(drive, Simulation(log, world, truth, 0, Pictures(log, world, truth))), dt_s=0.1)
    nearest = int(np.abs(log.streams[CAMERA].t_ns - truth.t0_ns - 600_000_000).argmin())
    assert psnr_db(images[0], log.streams[CAMERA].read(nearest)) > 18
