"""Evidence for a candidate over the whole log: detections, rays, and whether anything moves like it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import AgentCandidate
from log2sim.agents.plausibility.box_table import BoxTable
from log2sim.agents.plausibility.free_space import RayCounts, count_rays
from log2sim.agents.plausibility.recording import Recording
from log2sim.agents.plausibility.structure import structure_shares
from log2sim.agents.plausibility.views import MAX_BASELINE_M, shown_in_images
from log2sim.agents.support import Support
from log2sim.datatypes import Measurements, Obstacles
from log2sim.geometry import Array

# A detection is never surer than this: 3 nats.
MAX_SCORE = 0.95
# Fewer rays at a tick say nothing.
MIN_TICK_RAYS = 8
# Nats of the rays of a tick: all of them end in what is there; more are not believed, since rays of one tick err alike.
RAY_NATS = 2.0
# Nats of a tick of a motion that no road user has.
MOTION_NATS = 1.0
# Agents times ticks that are looked at together; each takes about a hundred bytes.
MAX_CELLS = 400_000
# Rays toward a place before it is said that the LiDAR looks there.
MIN_LOOKING_RAYS = 30
# Fewer image boxes with points may each be wrong.
MIN_HEIGHTS = 3


def weigh(candidates: Sequence[AgentCandidate], recording: Recording) -> list[AgentCandidate]:
    """Return the candidates with what the LiDAR and the cameras say about them, and with all evidence for them.

    Notes
    -----
    Evidence is a sum over ticks of nats for the agent against nothing: of each detection by its score, of the rays by the
    share that goes through, and less for a motion that breaks the limits of road users.
    """
    weighed = list(candidates)
    order = sorted(range(len(candidates)), key=lambda k: float(candidates[k].agent.waypoints.t_s[0]))
    most = max(MAX_CELLS // max(len(recording.clouds), 1), 1)
    for first in range(0, len(order), most):
        rows = order[first : first + most]
        for k, candidate in zip(rows, _weigh_together([candidates[k] for k in rows], recording)):
            weighed[k] = candidate
    return weighed


def _weigh_together(candidates: Sequence[AgentCandidate], recording: Recording) -> list[AgentCandidate]:
    """Weigh candidates of which there are not too many."""
    agents, clouds, timeline = [c.agent for c in candidates], recording.clouds, recording.timeline
    solid, whole = count_rays(agents, clouds, timeline)
    in_structure, beside = structure_shares(agents, clouds, timeline)
    met = whole.inside + whole.through
    shown = (
        shown_in_images(BoxTable.of(agents, recording.t_s), recording) & (met >= whole.before) & (met >= MIN_TICK_RAYS)
    )
    weighed = []
    for k, candidate in enumerate(candidates):
        rays = int(whole.before[k].sum() + met[k].sum())
        pointless = bool(rays >= MIN_LOOKING_RAYS and not (candidate.track.measurements.points > 0).any())
        # Where points of it went to something beside it, rays still end in it.
        unreached = pointless and whole.inside[k].sum() <= rays / 2
        support = replace(
            _support(solid, k),
            in_structure=float(in_structure[k]),
            beside_structure=float(beside[k]),
            pointless=pointless,
            unreached=bool(unreached and _same_view(candidate, clouds)),
            shown_ticks=int(shown[k].sum()),
            detected_ticks=int(shown[k, candidate.track.tick].sum()),
            image_ticks=int(shown[k, candidate.track.tick[candidate.track.measurements.camera != ""]].sum()),
            image_height_share=image_height_share(candidate.track.measurements),
        )
        weighed.append(
            replace(candidate, support=support, evidence=_nats(candidate, solid.inside[k], solid.through[k]))
        )
    return weighed


def _support(rays: RayCounts, k: int) -> Support:
    """Sum the rays of one agent over its ticks, without those at which only the border of what hides it shows."""
    met = rays.inside[k] + rays.through[k]
    seen = (met > 0) & (met >= rays.before[k])
    return Support(
        inside=int(rays.inside[k, seen].sum()),
        through=int(rays.through[k, seen].sum()),
        before=int(rays.before[k].sum()),
        seen_ticks=int(seen.sum()),
    )


def image_height_share(m: Measurements) -> float | None:
    """Return the median height of the image boxes of a track at its distance over that of its points; None with few of both."""
    rows = ~m.truncated & (m.points > 0) & (m.top_m > m.bottom_m) & np.isfinite(m.height_px_m)
    return float(np.median(m.height_px_m[rows] / (m.top_m - m.bottom_m)[rows])) if rows.sum() >= MIN_HEIGHTS else None


def _same_view(candidate: AgentCandidate, clouds: Sequence[Obstacles | None]) -> bool:
    """Return whether the cameras that detect a candidate are where the LiDARs are."""
    track = candidate.track
    for tick, sensor in zip(track.tick.tolist(), track.measurements.sensor_m):
        cloud = clouds[tick]
        if cloud is not None:
            return bool(np.linalg.norm(sensor - cloud.origin - cloud.sensor) <= MAX_BASELINE_M)
    return False


def _nats(candidate: AgentCandidate, inside: NDArray[np.int64], through: NDArray[np.int64]) -> float:
    """Sum the evidence for one candidate, given its rays (T,)."""
    detections = -np.log1p(-MAX_SCORE * candidate.track.measurements.score).sum()
    met = inside + through
    decided = met >= MIN_TICK_RAYS
    rays: Array = RAY_NATS * (1 - 2 * through[decided] / met[decided])
    impossible = MOTION_NATS * len(candidate.agent.waypoints) if candidate.agent.doubts else 0.0
    return float(detections + rays.sum() - impossible)
