"""Reconstructions of recorded logs in the formats of others, as the software of those reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from export_worlds import peer
from peer_checks import commonroad_finds, metadrive_replays, omega_prime_has_everybody, overlaps

from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import Log, Scenario
from log2sim.export.exporters import Options, export

pytestmark = [pytest.mark.peers, pytest.mark.slow, pytest.mark.real]


@pytest.fixture(scope="module", params=["pandaset/002", "kitti_tracking"])
def log(request: pytest.FixtureRequest, real_data: Path) -> Log:
    for name in ("metadrive", "commonroad", "omega_prime", "rerun"):
        peer(name)  # skips before anything is reconstructed in vain
    return open_log(real_data / request.param)


@pytest.fixture(scope="module")
def scenario(log: Log) -> Scenario:
    return reconstruct(log, Config.load(detect={"name": "labels"})).scenario


def test_metadrive_replays_it(scenario: Scenario, tmp_path: Path) -> None:
    assert metadrive_replays(scenario, tmp_path) < 1e-4


def test_commonroad_reads_it_and_agrees_on_collisions(scenario: Scenario, tmp_path: Path) -> None:
    found, boxes, _ = commonroad_finds(scenario, tmp_path)
    assert all("greater than the maximum value allowed ('0')" in text for text in found["complaints"])  # late arrivals
    assert found["arrived"]
    assert all(found["lanelets_valid"])
    assert all(found["ego_on_lanelet"])
    assert found["collisions"] == overlaps(scenario, boxes)


def test_omega_prime_validates_it(scenario: Scenario, tmp_path: Path) -> None:
    pytest.importorskip("betterosi")
    omega_prime_has_everybody(scenario, tmp_path)


def test_rerun_opens_it_with_all_pictures_and_sweeps(log: Log, scenario: Scenario, tmp_path: Path) -> None:
    pytest.importorskip("mcap_protobuf")
    run = peer("rerun")
    (file,) = export(scenario, "mcap", tmp_path, Options(log=log))
    report = run("-m", "rerun", "mcap", "check", file)
    assert all(f"/camera/{name}/boxes" in report for name in log.cameras)
    seconds = max(float(np.ptp(stream.t_ns)) / 1e9 for stream in log.streams.values())
    assert file.stat().st_size < 10e6 * seconds
