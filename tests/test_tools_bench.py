"""The benchmark of single estimators: its worlds, its scores, and sections of a file that it leaves alone."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow

TOOLS = Path(__file__).resolve().parents[1] / "tools"


@pytest.fixture(autouse=True)
def _tools_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))


def test_log2sim_and_plain_numpy_find_the_same_points_in_boxes() -> None:
    from benchmarks.projection import make_boxes, make_sweep, make_views, with_log2sim, with_numpy, with_opencv

    rng, views = np.random.default_rng(0), make_views()
    xyz, boxes = make_sweep(6400, rng), [make_boxes(rng) for _ in views]
    ours = with_log2sim(np.ascontiguousarray(xyz.T), views, boxes)
    plain, cv = with_numpy(np.float64, xyz, views, boxes), with_opencv(xyz, views, boxes)
    np.testing.assert_allclose(cv, plain, atol=1e-6)
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(plain))
    assert np.nanmedian(np.abs(np.subtract(ours, plain))) < 1e-3


def test_one_command_lists_the_benchmarks_runs_them_and_refuses_unknown_ones(
    capsys: pytest.CaptureFixture[str],
) -> None:
    from entry import commands_in, run_named

    assert run_named("benchmarks", []) == 0
    listed = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    assert {"agents", "lanes", "large_vehicles", "homography"} <= {name for name, _ in listed}
    assert all(len(title) > 10 for _, title in listed)
    assert run_named("benchmarks", ["tracks"]) == 2
    assert {"kitti", "confidence"} <= set(commands_in("fits"))


@pytest.mark.parametrize("folder", ["benchmarks", "fits"])
def test_every_command_says_what_it_takes(folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    from entry import commands_in, run_named

    for name in commands_in(folder):
        with pytest.raises(SystemExit, match="0"):
            run_named(folder, [name, "--help"])
        assert "usage" in capsys.readouterr().out


def test_every_tool_can_be_imported() -> None:
    pytest.importorskip("torch")
    modules = {".".join(path.relative_to(TOOLS).with_suffix("").parts) for path in TOOLS.rglob("*.py")}
    assert len(modules) > 50
    for name in modules:
        importlib.import_module(name.removesuffix(".__init__"))
