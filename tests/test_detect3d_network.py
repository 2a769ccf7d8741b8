"""LiDAR detectors from networks: the file and what it says of itself, and clouds through the whole chain, bad ones too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from lidar_networks import INFO, empty_maps, encode, info, write_network
from numpy.typing import ArrayLike, NDArray
from worlds import cloud_at

from log2sim.config import LidarConfig
from log2sim.datatypes import Log
from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.perception.detect3d import detectors, network
from log2sim.perception.detect3d.detectors import LidarDetector, NetworkDetector, create_lidar_detector
from log2sim.perception.detect3d.network import NetworkInfo
from log2sim.perception.lidar.cloud import Cloud

ORIGIN = np.array([5000.0, -300.0, 12.0])
LOG = Log("made", "log2sim", {}, {}, {})


def cloud_of(level: ArrayLike, *, slope: Sequence[float] = (0.0, 0.0), t_s: ArrayLike = 0.0, **changes: Any) -> Cloud:
    """A cloud of points (N, 3) relative to `ORIGIN` whose z is the height above a ground with a slope."""
    flat = np.asarray(level, np.float32).reshape(-1, 3)
    rise = (flat[:, :2] @ np.asarray(slope, np.float32))[:, None] * np.float32([0, 0, 1]) if any(slope) else 0.0
    return replace(cloud_at(flat + rise, flat[:, 2], t_s=t_s, origin=ORIGIN), **changes)


def solid(x: float, y: float, length: float = 4.0, width: float = 1.8, height: float = 1.5, yaw: float = 0.0) -> Array:
    """Points (N, 3) in a box that stands on the ground, 0.2 m within its faces, and a ground of 1 m cells around it."""
    axes = [np.linspace(-s / 2 + 0.2, s / 2 - 0.2, 8) for s in (length, width)] + [np.linspace(0.3, height - 0.2, 5)]
    u, v, z = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3).T
    inner = np.stack([x + u * np.cos(yaw) - v * np.sin(yaw), y + u * np.sin(yaw) + v * np.cos(yaw), z], axis=1)
    gx, gy = np.meshgrid(np.arange(-30.0, 31), np.arange(-30.0, 31))
    return np.concatenate([inner, np.stack([gx.ravel(), gy.ravel(), np.zeros(gx.size)], axis=1)])


@dataclass(frozen=True, eq=False)
class FixedNetwork:
    """A network that finds given boxes (x, y, z, length, width, height, yaw) wherever the grid is."""

    boxes: Sequence[tuple[str, Sequence[float]]]
    info: NetworkInfo
    seen: list[NDArray[np.float32]]

    def run(self, grid: NDArray[np.float32]) -> NDArray[np.float32]:
        self.seen.append(grid)
        maps = empty_maps(grid.shape[1] // 2, grid.shape[2] // 2)
        for category, box in self.boxes:
            encode(maps, box, category, low=self.low, cells=1)
        return maps

    @property
    def low(self) -> Array:
        return np.array([-32.0, -32.0])


def fixed(monkeypatch: pytest.MonkeyPatch, *boxes: tuple[str, Sequence[float]], **settings: Any) -> NetworkDetector:
    """A detector that finds the boxes, on a grid of always the same window."""
    chosen: dict[str, Any] = {"decode": "centers", "min_score": None, "info": info(), **settings}
    known = FixedNetwork(boxes, chosen["info"], [])
    monkeypatch.setattr(detectors, "grid_window", lambda *_, **__: (known.low, (256, 256)))
    return NetworkDetector("fixed", known, chosen["decode"], 40.0, chosen["min_score"])  # type: ignore[arg-type]


BOX = (10.0, 6.0, 0.75, 4.0, 1.8, 1.5, 0.6)


@pytest.mark.parametrize("decode", ["centers", "votes"])
def test_a_box_lands_in_the_map_with_its_points_and_their_time(
    decode: Literal["centers", "votes"], monkeypatch: pytest.MonkeyPatch
) -> None:
    level = solid(10, 6, yaw=0.6)
    inside = 8 * 8 * 5
    t_s = np.where(np.arange(len(level)) < inside, 0.03, -1.0)
    found = fixed(monkeypatch, ("truck", BOX), decode=decode).detect(cloud_of(level, t_s=t_s))
    np.testing.assert_allclose(found.center_m, [ORIGIN + BOX[:3]], atol=1e-4)
    np.testing.assert_allclose(found.size_m, [BOX[3:6]], rtol=1e-4)
    np.testing.assert_allclose(found.yaw_rad, [0.6], atol=1e-4)
    assert (found.category.tolist(), found.points.tolist()) == (["truck"], [inside])
    assert abs(int(found.t_ns[0]) - 10**18 - 30_000_000) < 1000
    assert found.heading_score[0] == pytest.approx(1.0, abs=1e-4)


def test_boxes_without_points_and_below_the_least_score_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud, empty = cloud_of(solid(10, 6, yaw=0.6)), (20.0, -6.0, *BOX[2:])
    assert len(fixed(monkeypatch, ("car", BOX), ("car", empty)).detect(cloud)) == 1
    strict = info(min_score={"vehicle": 0.99, "two_wheeler": 0.0, "pedestrian": 0.0})
    assert len(fixed(monkeypatch, ("car", BOX), info=strict).detect(cloud)) == 0
    assert len(fixed(monkeypatch, ("car", BOX), info=strict, min_score=0.5).detect(cloud)) == 1


@pytest.mark.parametrize("per_point", [0.5, -0.5])
def test_boxes_that_cannot_reach_the_least_score_are_left_out_early_and_no_others(
    per_point: float, tmp_path: Path
) -> None:
    weights = {group: [0, 1, 0, per_point, -0.3] for group in INFO["groups"]}
    path = taller_is_hotter(tmp_path, calibration=weights, min_score=dict.fromkeys(INFO["groups"], 0.6))
    rng = np.random.default_rng(0)
    cloud = cloud_of(rng.uniform(-40, 40, (3000, 3)) * [1, 1, 0.04])
    detector: Any = create_lidar_detector(f"lidar:{path}", LOG, LidarConfig())
    found = detector.detect(cloud)
    everything = detector.candidates(cloud)
    score = everything.boxes.score(detector.network.info, everything.terms)
    good = np.flatnonzero((everything.inside.count > 0) & (score >= 0.6))
    assert len(good) < len(detector.candidates(cloud, weak=False).boxes) < len(everything.boxes)
    np.testing.assert_allclose(found.score, np.sort(score[good])[::-1])


def taller_is_hotter(folder: Path, **changes: Any) -> Path:
    """A network for which a cell whose highest point is above 1.2 m is a car of 2.9 x 2.9 x 2 m in its middle."""
    weight, bias = np.zeros((25, 12)), np.zeros(25)
    weight[0, 0], bias[:3] = 40.0, [-24.0, -9.0, -9.0]
    bias[8:14] = 0, 0, 1.0, *np.log([2.9, 2.9, 2.0])
    bias[15], bias[17] = 1.0, 1.0
    return write_network(folder / "taller.onnx", {**INFO, **changes}, weight=weight, bias=bias)


@pytest.fixture
def detector(tmp_path: Path) -> LidarDetector:
    return create_lidar_detector(f"lidar:{taller_is_hotter(tmp_path)}", LOG, LidarConfig())


POLES = np.array([[8.1, 3.1], [-11.2, 14.3], [20.4, -17.3]])


def poles(turns: int = 0) -> Array:
    """Three people-sized heaps of points whose tops are 1.4 to 1.8 m high, turned by quarters around the sensor."""
    z = np.linspace(0.3, 1.4, 12)
    heaps = [np.column_stack([np.tile(p, (12, 1)), z + 0.2 * k]) for k, p in enumerate(POLES)]
    level = np.concatenate([*heaps, solid(0, 0, 0.5, 0.5, 0.6)])
    x, y = level[:, :2].T
    for _ in range(turns):
        x, y = -y, x
    return np.column_stack([x, y, level[:, 2]])


def test_a_network_from_a_file_finds_what_it_looks_for(detector: LidarDetector) -> None:
    found = detector.detect(cloud_of(poles()))
    assert detector.name == "lidar:taller.onnx"
    assert found.points.tolist() == [12, 12, 12]
    assert np.all(np.diff(found.score) < 0)
    nearest = found.center_m[::-1, :2] - ORIGIN[:2] - POLES
    assert np.abs(nearest).max() <= 0.25 + 1e-4


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_cloud_gives_turned_boxes(detector: LidarDetector, turns: int) -> None:
    found, turned = detector.detect(cloud_of(poles())), detector.detect(cloud_of(poles(turns)))
    x, y = (found.center_m - ORIGIN)[:, :2].T
    for _ in range(turns):
        x, y = -y, x
    # The window may begin at either of the two cells of a cell of the maps.
    np.testing.assert_allclose((turned.center_m - ORIGIN)[:, :2], np.stack([x, y], axis=1), atol=0.5)
    np.testing.assert_allclose(turned.score, found.score, rtol=1e-6)
    assert turned.points.tolist() == found.points.tolist()


def test_range_and_score_follow_the_settings(tmp_path: Path) -> None:
    path = taller_is_hotter(tmp_path)
    near = create_lidar_detector(f"lidar:{path}", LOG, LidarConfig(range_m=15.0)).detect(cloud_of(poles()))
    assert len(near) == 2
    sure = create_lidar_detector(f"lidar:{path}", LOG, LidarConfig(min_score=0.999)).detect(cloud_of(poles()))
    assert len(sure) == 2


@pytest.mark.parametrize(
    "level",
    [
        np.zeros((0, 3)),
        np.full((10, 3), np.nan),
        np.full((10, 3), np.inf),
        np.random.default_rng(0).uniform(-1, 1, (10, 3)),
        np.random.default_rng(0).uniform(20, 60, (50_000, 3)),
        np.full((1000, 3), 500.0),
        np.full((1000, 3), [10.0, 10.0, -3.0]),
    ],
    ids=["none", "nan", "inf", "ten", "sky", "far", "below"],
)
@pytest.mark.parametrize("decode", ["centers", "votes"])
def test_clouds_without_anything_to_find_give_no_boxes(level: Array, decode: str, tmp_path: Path) -> None:
    chosen = create_lidar_detector(f"lidar:{taller_is_hotter(tmp_path)}", LOG, LidarConfig(decode=decode))  # type: ignore[arg-type]
    assert len(chosen.detect(cloud_of(level))) == 0
    assert len(chosen.detect(cloud_of(level), [cloud_of(level)])) == 0


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, r"no entry 'log2sim\.lidar', a JSON document with cell_m"),
        ("{", r"'log2sim\.lidar'.*JSON"),
        ({k: v for k, v in INFO.items() if k != "stride"}, r"'stride' is missing"),
        ({**INFO, "version": 2}, r"'version' is 2, expected 1"),
        ({**INFO, "cell_m": -1.0}, r"'cell_m' is -1\.0, expected a number from 0\.05 to 2"),
        ({**INFO, "range_m": 1000.0}, r"'range_m' is 1000, expected at most 512 cells"),
        ({**INFO, "groups": ["vehicle", "vehicle"]}, r"'groups' has 'vehicle' twice or unknown"),
        ({**INFO, "categories": {**INFO["categories"], "vehicle": ["tank"]}}, r"'categories\.vehicle' is \['tank'\]"),
        ({**INFO, "calibration": {}}, r"'calibration\.vehicle' is missing or has not 5 numbers"),
        ({**INFO, "min_score": {"vehicle": 2.0}}, r"'min_score\.vehicle' is missing or no number from 0 to 1"),
        ({**INFO, "groups": ["vehicle"]}, r"output 'maps' is float32 \(1, 25, 32, 32\).*expected float32 \(1, 19, 32, 32\)"),
        ({**INFO, "stride": 4}, r"expected float32 \(1, 25, 16, 16\)"),
    ],
    ids=range(12),
)  # fmt: skip
def test_metadata_that_cannot_be_are_one_clear_line(metadata: Any, message: str, tmp_path: Path) -> None:
    path = write_network(tmp_path / "bad.onnx", metadata)
    with pytest.raises(ConfigError, match=message) as caught:
        create_lidar_detector(f"lidar:{path}", LOG, LidarConfig())
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_files_that_are_no_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file.onnx"
    with pytest.raises(ConfigError, match="no such file"):
        network.load_network(path)
    path.write_bytes(b"")
    with pytest.raises(ConfigError, match="0 bytes; expected an ONNX network"):
        network.load_network(path)
    path.write_bytes(b"not a network")
    with pytest.raises(ConfigError, match="not a network for clouds that ONNX Runtime can load"):
        network.load_network(path)
    monkeypatch.setattr(network, "MAX_FILE_BYTES", 5)
    with pytest.raises(ConfigError, match="13 bytes; expected an ONNX network for clouds of 1 to 5 bytes"):
        network.load_network(path)
