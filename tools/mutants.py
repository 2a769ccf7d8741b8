"""Which single changes of the method the default test suite notices.

Each mutant replaces one expression in a copy of the checkout: a sign, an index, a factor or a comparison at the core of a
stage. A mutant that no test fails on shows behavior that nothing holds.

    python tools/mutants.py                      # all, two processes: about a minute each
    python tools/mutants.py --only gain,yaw --tests tests/test_track.py
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# Name, file below log2sim/, expression (which occurs once), replacement.
MUTANTS = (
    ("sync takes later frames", "perception/sync.py", "np.abs(residual_ns) <= tolerance_ns", "residual_ns <= tolerance_ns"),
    ("poses are not interpolated", "geometry/poses.py", "position[i] + fraction[:, None] * (position[k] - position[i])", "position[i]"),
    ("inverse of a transform", "geometry/transforms.py", "-(rt @ dst_T_src[..., :3, 3:])", "(rt @ dst_T_src[..., :3, 3:])"),
    ("sweeps are not compensated", "perception/lidar/cloud.py", "one_pose = not compensate or", "one_pose = True or"),
    ("ground without curvature", "perception/lidar/cloud.py", "x * x, x * y, y * y", "0 * x, 0 * x, 0 * y"),
    ("depth is not tested", "perception/homography/normalized.py", "ex[~(w > 0)] = np.inf", "ex[w == 0] = np.inf"),
    ("Sampson's covariance", "perception/homography/normalized.py", "area -= cuv * cuv", "area -= 0 * cuv"),
    ("unbounded loss", "perception/homography/ransac.py", "np.minimum(squared, CHI2_2DOF_99)", "np.minimum(squared, 1e9)"),
    ("homographies of one tick alone", "perception/homography/ransac.py", "for across in (False, True)", "for across in (False, False)"),
    ("a vehicle's length is its width", "perception/boxes.py", "return bool(across > along)", "return bool(across < along)"),
    ("ends of boxes", "perception/boxes.py", "low[k], high[k] = [low[k, 1], -high[k, 0]], [high[k, 1], -low[k, 0]]", "low[k], high[k] = low[k], high[k]"),
    ("one sweep, one object", "perception/fusion.py", "gated &= ~(from_sweep[:, None] & from_sweep)", "gated &= True"),
    ("cameras are not fused", "perception/fusion.py", "squared <= CHI2_2DOF_99 * determinant", "squared <= 0 * determinant"),
    ("Kalman gain", "tracking/forward.py", "gain @ (xy[:, :, None]", "0.5 * gain @ (xy[:, :, None]"),
    ("process noise", "tracking/forward.py", "(span**3 / 3)", "(span**3 / 30)"),
    ("weak detections start tracks", "tracking/forward.py", "fresh = strong.copy()", "fresh = np.ones_like(strong)"),
    ("gaps of tracks", "tracking/stitch.py", "-half_gap_s, noise)", "half_gap_s, noise)"),
    ("outliers count", "agents/smooth/fixed_interval.py", "problem = replace(problem, weight=weight)", "problem = replace(problem, weight=1 + 0 * weight)"),
    ("standing vehicles roll", "agents/smooth/fixed_interval.py", "still = np.isfinite(sigma)", "still = np.isfinite(sigma) & False"),
    ("sizes of whole sides", "agents/size.py", "error_of_all / (error_of_all + prior)", "prior / (error_of_all + prior)"),
    ("persons in one place", "agents/judge.py", "< SAME_PERSON_M", "< 0 * SAME_PERSON_M"),
    ("front and back", "agents/heading.py", "(0.0 if log_odds > 0 else np.pi)", "(0.0 if log_odds < 0 else np.pi)"),
    ("anti-windup", "simulation/follower.py", "(given == asked) | (error * wanted <= 0)", "(given == given)"),
    ("feed-forward of curvature", "simulation/follower.py", "wanted = row[4:6] + pull", "wanted = 0.5 * row[4:6] + pull"),
    ("gate of matches", "evaluation/metrics/comparison.py", "distance <= gates_m[a, None]", "distance <= 2 * gates_m[a, None]"),
    ("what is ahead is braked for late", "simulation/reactive.py", "(pace_mps - leader_mps) / (2 *", "(pace_mps - leader_mps) / (8 *"),
    ("sides of a reversed lane", "road/strips.py", "left=self.right, right=self.left", "left=self.left, right=self.right"),
    ("sweeps of odometry are not compensated", "localization/odometry.py", "share_of_motion(motion, share), np", "share_of_motion(motion, 0 * share), np"),
    ("switches of identity", "evaluation/metrics/comparison.py", "& (now != last)", "& (now > last)"),
    ("association of HOTA", "evaluation/metrics/evaluator.py", "np.divide(potential, union", "np.divide(potential, potential + union"),
    ("normals face the sensor", "localization/roadside_fit.py", "np.where(facing < 0, -1.0, 1.0)", "np.where(facing < 0, 1.0, 1.0)"),
    ("sigmas of predictions do not grow", "prediction/prediction.py", "** 2 + variance)", "** 2 + 0 * variance)"),
    ("centers of exported boxes", "export/openscenario/write.py", "x=number(agent.rear_axle_offset_m), y", "x=number(-agent.rear_axle_offset_m), y"),
    ("shifts to the side", "edit/motion.py", "y_m=w.y_m + offset * np.cos(yaw)", "y_m=w.y_m - offset * np.cos(yaw)"),
    ("hypotheses are not counted", "agents/hypotheses.py", "- np.log(count))", ")"),
    ("lit lamps", "road/signals.py", "log += 0.0 if", "log += 0.0 if True or"),
    ("pairs beyond a gap of time", "evaluation/metrics/comparison.py", "<= MAX_TRUTH_GAP_S) & table", "<= 9 * MAX_TRUTH_GAP_S) & table"),
)  # fmt: skip


def copy_with(mutant: tuple[str, str, str, str], folder: Path) -> Path:
    """Copy the checkout with one change; `shared` beside it stays reachable."""
    name, file, old, new = mutant
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


def main() -> int:
    """Print which mutants are caught and by which test; 1 where one is not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="words of names, with commas")
    parser.add_argument("--tests", nargs="*", default=["tests"])
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    words = [w for w in options.only.split(",") if w]
    missed = 0
    for mutant in (m for m in MUTANTS if not words or any(w in m[0] for w in words)):
        with tempfile.TemporaryDirectory() as folder:
            checkout, begin = copy_with(mutant, Path(folder)), time.monotonic()
            command = [sys.executable, "-m", "pytest", "-x", "--no-header", "-p", "no:cacheprovider", *options.tests]
            if options.jobs > 1:
                command += ["--numprocesses", str(options.jobs), "--dist", "loadfile"]
            run = subprocess.run(
                command, cwd=checkout, capture_output=True, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}
            )
            failed = [line.split(" ")[1] for line in run.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
            missed += not failed
            print(
                f"{mutant[0]:34} {time.monotonic() - begin:5.0f} s  {failed[0] if failed else 'NOT CAUGHT'}", flush=True
            )
    return min(missed, 1)


if __name__ == "__main__":
    sys.exit(main())
