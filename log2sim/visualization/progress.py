"""How far a run is: the words for its stages, and a line that shows them in a notebook, a script or a plain log."""

from __future__ import annotations

import sys
import time

OPENING, VALIDATING = "open", "validate"
# What people read of a stage; a stage without words of its own shows its name.
WORDS = {
    OPENING: "opening the log",
    "odometry": "following the ego in LiDAR sweeps",
    "camera motion": "following the ego in pictures",
    "check cameras": "checking the mounts of cameras",
    "load": "loading the detectors",
    "detect and measure": "detecting and measuring",
    "track": "tracking",
    "smooth": "smoothing trajectories",
    "judge": "comparing agents with the recording",
    "pictures": "mapping the ground and reading colors",
    "lanes": "finding markings and lanes",
    "map: sweeps": "mapping the ground: LiDAR sweeps",
    "map: pictures": "mapping the ground: pictures",
    "replay": "simulating",
    "convert": "writing records",
    VALIDATING: "reading every record",
    "detect": "detecting",
    "synthesize": "rendering",
    "scenes": "rendering scenes",
    "count points": "counting points in boxes",
    "draw": "drawing",
    "page: pictures": "reading pictures",
    "page: sweeps": "reading LiDAR points",
    "evaluate": "comparing with the truth",
    "write": "writing",
}
WORDS_BEFORE_SENSORS = {"check ": "checking the clock and mount of ", "register ": "registering "}
REDRAWN_EVERY_S = 0.1
WIDTH = 72  # letters of the line, which cover those of the one before
_drawn_s = [-REDRAWN_EVERY_S]


def describe_stage(stage: str) -> str:
    """Return the words for a stage."""
    for start, words in WORDS_BEFORE_SENSORS.items():
        if stage not in WORDS and stage.startswith(start):
            return words + stage.removeprefix(start)
    return WORDS.get(stage, stage)


def show_progress(*state: str | int) -> None:
    """Show how far a run is, as what the functions of log2sim take for `progress`.

    A line on the standard output is written anew while a stage goes on, and stays when the stage is done. `state`: stage, steps done,
    all steps, or the last two; with 0 for all of them when a stage of unknown length begins.

    Examples
    --------
    >>> reconstruct(log, progress=show_progress)
    """
    *stage, done, total = state
    words = describe_stage(str(stage[0])) if stage else "done"
    now_s = time.monotonic()
    if total == 0:
        sys.stdout.write(f"\r{words:<{WIDTH}}\n")
    elif done == total or now_s - _drawn_s[0] >= REDRAWN_EVERY_S:
        _drawn_s[0] = now_s
        sys.stdout.write(f"\r{f'{words}: {done} of {total}':<{WIDTH}}" + "\n" * (done == total))
    sys.stdout.flush()
