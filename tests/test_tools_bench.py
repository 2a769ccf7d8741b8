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


def test_a_section_is_replaced_between_its_markers_and_nothing_else_changes(tmp_path: Path) -> None:
    from benchmarks.table import replace_section

    file = tmp_path / "B.md"
    replace_section(file, "one", "first")
    replace_section(file, "two", "second")
    file.write_text(file.read_text().replace("first", "by hand") + "\nTail.\n")
    replace_section(file, "one", "new")
    text = file.read_text()
    assert text.startswith("# Benchmarks")
    assert "by hand" not in text
    assert text.index("new") < text.index("second") < text.index("Tail.")
    assert text.count("<!-- bench one -->") == text.count("<!-- end one -->") == 1


def test_the_world_of_homographies_is_what_its_truth_says() -> None:
    from benchmarks.homography import FAR_M, NEAR_M, Case, camera, errors_m, limit, make_stream, mapped

    stream = make_stream(Case(noise_px=0.0, outliers=0.4, nod_deg=0.2), seed=1)
    again = make_stream(Case(noise_px=0.0, outliers=0.4, nod_deg=0.2), seed=1)
    np.testing.assert_array_equal(stream.uv, again.uv)
    assert (~stream.clean).reshape(40, 20).sum(axis=1).tolist() == [8] * 40
    own = np.concatenate(
        [mapped(np.linalg.inv(h), stream.uv[stream.tick == t]) for t, h in enumerate(stream.image_H_ground)]
    )
    off = np.hypot(*(own - stream.xy).T)
    assert np.median(off[stream.clean]) == pytest.approx(0.05 * 1.18, rel=0.15)  # the median of a Rayleigh distribution
    assert np.median(off[~stream.clean]) > 2.0
    assert errors_m(np.linalg.inv(stream.image_H_ground), stream, FAR_M).max() < 1e-9
    # A camera 2.1 m high that looks 2 degrees down sees its horizon at 640 - 2050 tan 2 degrees.
    far = mapped(camera(), np.array([[1e7, 0.0]]))
    np.testing.assert_allclose(far, [[960.0, 640.0 - 2050.0 * np.tan(np.radians(2.0))]], atol=1e-2)
    still = make_stream(Case(), seed=2)
    assert np.median(errors_m(limit(still, 1.0)[None], still, NEAR_M)) < 0.05


def test_maneuvers_are_integrals_of_their_velocities() -> None:
    from benchmarks.smoothing import STEP_S, errors, maneuver

    for name in ("lane change", "turn", "stop and go", "slalom"):
        truth = maneuver(name)
        slope = np.gradient(truth.xy, STEP_S, axis=0)[1:-1]
        assert np.abs(slope - truth.velocity[1:-1]).max() < 0.15
        assert errors((truth.xy, truth.velocity, truth.yaw, truth.curvature), truth) == [0.0] * 4
    assert maneuver("turn").yaw[-1] - maneuver("turn").yaw[0] == pytest.approx(np.pi / 2, abs=1e-3)
    assert np.hypot(*maneuver("stop and go").velocity.T).min() == 0.0


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
        if name == "zou2021":
            pytest.importorskip("torch")
        with pytest.raises(SystemExit, match="0"):
            run_named(folder, [name, "--help"])
        assert "usage" in capsys.readouterr().out


def test_every_tool_can_be_imported() -> None:
    pytest.importorskip("torch")
    modules = {".".join(path.relative_to(TOOLS).with_suffix("").parts) for path in TOOLS.rglob("*.py")}
    assert len(modules) > 50
    for name in modules:
        importlib.import_module(name.removesuffix(".__init__"))
