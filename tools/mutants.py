"""Which single changes of the method the default test suite notices.

Each mutant replaces one expression in a copy of the checkout: a sign, an index, a factor or a comparison at the core of a
stage. A mutant that no test fails on shows behavior that nothing holds.

    python tools/mutants.py                      # all, each with the files of tests named beside it: seconds each
    python tools/mutants.py --only gain,yaw --tests tests      # words of names, with commas; with the whole default suite
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from entry import run as run_command

ROOT = Path(__file__).resolve().parents[1]

# Name, file below log2sim/, expression (which occurs once), replacement, files of tests that hold it.
MUTANTS = (
    ("sync takes later frames", "perception/sync.py", "np.abs(residual_ns) <= tolerance_ns", "residual_ns <= tolerance_ns", "sync"),
    ("poses are not interpolated", "geometry/transforms.py", "position[i] + fraction[:, None] * (position[k] - position[i])", "position[i]", "geometry"),
    ("inverse of a transform", "geometry/transforms.py", "-(rt @ dst_T_src[..., :3, 3:])", "(rt @ dst_T_src[..., :3, 3:])", "geometry_properties"),
    ("sweeps are not compensated", "perception/lidar/cloud.py", "one_pose = not compensate or", "one_pose = True or", "ground sync"),
    ("ground without curvature", "perception/lidar/cloud.py", "x * x, x * y, y * y", "0 * x, 0 * x, 0 * y", "ground"),
    ("depth is not tested", "perception/homography/normalized.py", "~((w > 0) & (own > cvv))", "~(own > cvv)", "homography_ransac homography"),
    ("Sampson's covariance", "perception/homography/normalized.py", "own = cvv - cuv", "own = cvv - 0 * cuv", "homography_ransac homography"),
    ("unbounded loss", "perception/homography/normalized.py", "np.minimum(self.squared, CHI2_2DOF_99)", "np.minimum(self.squared, 1e9)", "homography_ransac homography"),
    ("homographies of one tick alone", "perception/homography/fit.py", "(True,) if k else (False, True)", "(False, False)", "homography_ransac homography"),
    ("a vehicle's length is its width", "perception/boxes.py", "middle[:, 1] > middle[:, 0]", "middle[:, 1] < middle[:, 0]", "fusion size measure"),
    ("ends of boxes", "perception/boxes.py", "low[swapped], high[swapped] = (", "_ = (", "size fusion measure"),
    ("one sweep, one object", "perception/fusion.py", 'possible &= ~((rows.camera[:, None] == "") & (rows.camera == ""))', "possible &= True", "fusion"),
    ("cameras are not fused", "perception/fusion.py", "squared <= CHI2_2DOF_99 * determinant", "squared <= 0 * determinant", "fusion"),
    ("Kalman gain", "tracking/forward.py", "gain @ off[..., None]", "0.5 * gain @ off[..., None]", "track"),
    ("process noise", "tracking/forward.py", "(span**3 / 3)", "(span**3 / 30)", "track"),
    ("weak detections start tracks", "tracking/forward.py", "fresh = strong.copy()", "fresh = np.ones_like(strong)", "track"),
    ("gaps of tracks", "tracking/tracker.py", "-half_gap_s, noise[one])", "half_gap_s, noise[one])", "track"),
    ("outliers count", "agents/smooth/fixed_interval.py", "problem = replace(problem, weight=weight)", "problem = replace(problem, weight=1 + 0 * weight)", "smooth"),
    ("standing vehicles roll", "agents/smooth/fixed_interval.py", "still = np.isfinite(sigma)", "still = np.isfinite(sigma) & False", "smooth"),
    ("sizes of whole sides", "agents/size.py", "(1 - partial) * np.exp", "0 * np.exp", "size"),
    ("persons in one place", "agents/judge.py", "< SAME_PERSON_M", "< 0 * SAME_PERSON_M", "plausibility_conflicts"),
    ("turns of tiles", "perception/detect/onnx_detector.py", "+ turn.number) % 2", "+ 0 * turn.number) % 2", "detect_boxes"),
    ("front and back", "agents/heading.py", "(0.0 if odds > 0 else np.pi)", "(0.0 if odds < 0 else np.pi)", "heading"),
    ("anti-windup", "simulation/reference.py", "(given == asked) | (error * wanted <= 0)", "(given == given)", "replay_follow"),
    ("feed-forward of curvature", "simulation/reference.py", "wanted = row[4:6] + pull", "wanted = 0.5 * row[4:6] + pull", "replay_follow replay_extremes"),
    ("gate of matches", "evaluation/metrics/comparison.py", "distance <= gates_m[a, None]", "distance <= 2 * gates_m[a, None]", "metrics_correctness"),
    ("what is ahead is braked for late", "simulation/reactive.py", "(pace_mps - leader_mps) / (2 *", "(pace_mps - leader_mps) / (8 *", "replay_reactive"),
    ("sides of a reversed lane", "road/lane_graph.py", "left=self.right, right=self.left", "left=self.left, right=self.right", "lanes"),
    ("sweeps of odometry are not compensated", "localization/odometry.py", "share_of_motion(motion, share), np", "share_of_motion(motion, 0 * share), np", "localization"),
    ("switches of identity", "evaluation/metrics/comparison.py", "& (now != last)", "& (now > last)", "metrics_evaluate"),
    ("association of HOTA", "evaluation/metrics/evaluator.py", "np.divide(potential, union", "np.divide(potential, potential + union", "metrics_tracking"),
    ("normals face the sensor", "localization/roadside_fit.py", "np.where(facing < 0, -1.0, 1.0)", "np.where(facing < 0, 1.0, 1.0)", "cooperation"),
    ("sigmas of predictions do not grow", "simulation/prediction/prediction.py", "** 2 + variance)", "** 2 + 0 * variance)", "prediction"),
    ("centers of exported boxes", "export/openscenario/write.py", "x=number(agent.rear_axle_offset_m), y", "x=number(-agent.rear_axle_offset_m), y", "export_openscenario import"),
    ("shifts to the side", "edit/edits.py", "y_m=w.y_m + offset * np.cos(yaw)", "y_m=w.y_m - offset * np.cos(yaw)", "edit"),
    ("hypotheses are not counted", "agents/hypotheses.py", "- np.log(count))", ")", "hypotheses"),
    ("yellow lines by brightness alone", "road/lane_course.py", "for values in (flat.paint, flat.yellow)", "for values in (flat.paint, flat.paint)", "lane_markings"),
    ("lanes off the road", "road/lane_course.py", "and _is_road(flat, line.offset_m, left.offset_m)", "", "lane_markings"),
    ("edges of bright ground as lines", "road/lines.py", "if sources := sources_of(member):", "if (sources := sources_of(member)) is not None:", "lane_markings"),
    ("lit lamps", "road/signals.py", "log[k] += 0.0 if", "log[k] += 0.0 if True or", "traffic_lights"),
    ("points beyond a gap of time", "evaluation/metrics/comparison.py", "<= MAX_TRUTH_GAP_S) & table", "<= 2 * MAX_TRUTH_GAP_S) & table", "metrics_evaluate"),
    ("boxes between labels", "evaluation/detection/truth.py", "stamps[partner] - stamps[nearest]", "stamps[partner] + stamps[nearest]", "detection_files"),
    ("cells that were seen", "evaluation/road.py", "low[:, 1] + cell_m", "low[:, 1] - cell_m", "evaluate_lanes"),
    ("held-out feet", "evaluation/bench/scores.py", "feet.uv[:, None] - uv", "feet.uv[:, None] + uv", "bench"),
    ("halves of pairs", "files/packing.py", "code < 0xE000", "code >= 0xE000", "packing"),
    ("figures by range", "evaluation/metrics/table.py", 'found["by_range"] or {}', 'found["by_range"] and {}', "metrics_evaluate"),
)  # fmt: skip


def copy_with(mutant: tuple[str, ...], folder: Path) -> Path:
    """Copy the checkout with one change; `shared` beside it stays reachable."""
    name, file, old, new = mutant[:4]
    checkout = folder / "checkout"
    ignored = shutil.ignore_patterns(".*", "out", "build", "__pycache__", "*.egg-info")
    shutil.copytree(ROOT, checkout, ignore=ignored)
    if (ROOT.parent / "shared").exists():
        (folder / "shared").symlink_to(ROOT.parent / "shared")
    path = checkout / "log2sim" / file
    text = path.read_text()
    if text.count(old) != 1:
        raise SystemExit(f"{name}: {file} holds {old!r} {text.count(old)} times, expected once")
    path.write_text(text.replace(old, new))
    return checkout


def main(only: str = "", tests: list[str] = [], jobs: int = os.cpu_count() or 1) -> int:
    """Print which mutants are caught and by which test; 1 where one is not."""
    words = [w for w in only.split(",") if w]
    missed = 0
    for mutant in (m for m in MUTANTS if not words or any(w in m[0] for w in words)):
        with tempfile.TemporaryDirectory() as folder:
            checkout, begin = copy_with(mutant, Path(folder)), time.monotonic()
            files = tests or [f"tests/test_{name}.py" for name in mutant[4].split()]
            command = [sys.executable, "-m", "pytest", "-x", "--no-header", "-p", "no:cacheprovider", *files]
            if tests and jobs > 1:
                command += ["--numprocesses", str(jobs), "--dist", "loadfile"]
            env = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
            run = subprocess.run(command, cwd=checkout, capture_output=True, text=True, env=env)
            failed = [line.split(" ")[1] for line in run.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
            missed += not failed
            noticed = failed[0] if failed else "NOT CAUGHT"
            print(f"{mutant[0]:34} {time.monotonic() - begin:5.0f} s  {noticed}", flush=True)
    return min(missed, 1)


if __name__ == "__main__":
    run_command(main, __doc__)
