"""What came of a plan: what each stage did, from the counts that the stages return."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from log2sim.agents.simplify import TOLERANCE_M
from log2sim.datatypes import Agent, Measurements
from log2sim.perception.first_pass import Observations
from log2sim.perception.homography_stage import CameraHomography
from log2sim.plan import DESCRIBING, Decision, HomographyScope, Plan, Stage
from log2sim.stage_clock import StageClock


@dataclass(frozen=True, eq=False)
class RunOutputs:
    """What the stages of a finished run returned.

    Attributes
    ----------
    observations : Observations
    measurements : sequence of Measurements
        Fused, by tick.
    homographies : mapping of str to CameraHomography
        By camera.
    agents : tuple of Agent
        Without the ego.
    clock : StageClock
    """

    observations: Observations
    measurements: Sequence[Measurements]
    homographies: Mapping[str, CameraHomography]
    agents: tuple[Agent, ...]
    clock: StageClock


@dataclass(frozen=True)
class Outcome:
    """What a stage did.

    Attributes
    ----------
    decision : Decision
        As planned, or as the data turned out: a stage that was planned and had nothing to do was not kept.
    saved_s : float or None
        Seconds that leaving out (a part of) the stage saved, None where unknown.
    saved_how : str or None
        How `saved_s` was estimated.
    """

    decision: Decision
    saved_s: float | None = None
    saved_how: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return what is the same for the same log and settings, as scenario.json holds it."""
        return self.decision.to_dict()

    def to_report(self) -> dict[str, Any]:
        """Return the outcome with its seconds, as report.json holds it."""
        return {**self.to_dict(), "saved_s": self.saved_s, "saved_how": self.saved_how}


def stage_outcomes(plan: Plan, outputs: RunOutputs) -> tuple[Outcome, ...]:
    """Join the decisions of a plan with what the stages did, in the plan's order, but for those that describe the scenario."""
    found: Mapping[Stage, Callable[[Decision], Outcome]] = {
        Stage.MOTION_COMPENSATION: lambda d: _compensation(d, outputs.observations),
        Stage.DETECTION_IN_EVERY_FRAME: lambda d: _detection(d, plan.picture_stride, outputs),
        Stage.HOMOGRAPHY: lambda d: _homography(d, plan.homography, outputs.homographies),
        Stage.SMOOTHING_OF_STATIC_AGENTS: lambda d: _static(outputs.agents),
        Stage.WAYPOINT_AT_EVERY_TICK: lambda d: _waypoints(outputs.agents),
    }
    return tuple(found.get(d.stage, Outcome)(d) for d in plan.decisions if d.stage not in DESCRIBING)


def _compensation(planned: Decision, observations: Observations) -> Outcome:
    counts, total = observations.sweeps, sum(observations.sweeps.values())
    if not planned.kept or not total:
        return Outcome(planned)
    if counts["in the log"] == total:
        return Outcome(Decision(planned.stage, False, "the sweeps of the log are compensated already"))
    if counts["in the log"] + counts["no times"] == total:
        return Outcome(Decision(planned.stage, False, "the points have no times of their own"))
    if counts["at rest"]:
        reason = f"{planned.reason}; it stands still during {counts['at rest']} of {total} sweeps"
        return Outcome(Decision(planned.stage, counts["moving"] > 0, reason))
    return Outcome(planned)


def _detection(planned: Decision, picture_stride: int, outputs: RunOutputs) -> Outcome:
    observations, seconds = outputs.observations, outputs.clock.seconds
    skipped, detected = sum(observations.frames_skipped.values()), observations.frames_detected
    if planned.kept or not detected:
        return Outcome(planned)
    if not skipped:
        return Outcome(Decision(planned.stage, True, "no camera was empty long enough to skip a frame"))
    names = ", ".join(f"{name} {n}" for name, n in sorted(observations.frames_skipped.items()))
    reason = f"{skipped} of {skipped + detected} frames are between two in which nothing was found: {names}"
    if picture_stride > 1:
        reason = f"{planned.reason}; {skipped} of {skipped + detected} frames were not"
    each_s = (seconds.get("decode", 0.0) + seconds.get("detect", 0.0)) / max(detected, 1)
    how = f"estimated: {1e3 * each_s:.3g} ms a frame (measured on {detected}), times {skipped}"
    return Outcome(Decision(planned.stage, False, reason), round(skipped * each_s, 4), how)


def _homography(planned: Decision, scope: HomographyScope, homographies: Mapping[str, CameraHomography]) -> Outcome:
    if scope is HomographyScope.NONE:
        return Outcome(planned)
    if not homographies:
        return Outcome(Decision(planned.stage, False, "every detection has LiDAR points or no foot in the image"))
    return Outcome(Decision(planned.stage, True, f"{planned.reason}: {', '.join(homographies)}"))


def _static(agents: tuple[Agent, ...]) -> Outcome:
    static = sum(a.static for a in agents)
    reason = f"{static} of {len(agents)} agents are static: one pose for each" if static else "no agent is static"
    return Outcome(Decision(Stage.SMOOTHING_OF_STATIC_AGENTS, not static, reason))


def _waypoints(agents: tuple[Agent, ...]) -> Outcome:
    stage, left_out = Stage.WAYPOINT_AT_EVERY_TICK, sum(a.quality.get("waypoints_left_out", 0) for a in agents)
    if not left_out:
        return Outcome(Decision(stage, True, "no agent moves straight at constant speed"))
    total = left_out + sum(len(a.waypoints) for a in agents)
    reason = f"{left_out} of {total} lie within {TOLERANCE_M * 100:.0f} cm of the line between their neighbors"
    return Outcome(Decision(stage, False, reason))
