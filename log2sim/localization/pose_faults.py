"""What is wrong with the given poses of a log, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Fault, Log
from log2sim.geometry import NS_PER_S
from log2sim.localization.checked_poses import Stretch
from log2sim.localization.given_poses import MIN_STEP_M, MIN_STEP_RAD

# At 3 m/s2, which is brisk driving, a line between poses this far apart is off by 0.25 m; poses of 2 Hz are usual.
MIN_SPARSE_S = float(np.sqrt(8 * 0.25 / 3.0))


def list_faults(log: Log, stretches: Sequence[Stretch], during_ns: tuple[int, int] | None) -> tuple[Fault, ...]:
    """List the faults of given poses, those of the time that is used and of which something is recorded.

    Parameters
    ----------
    log : Log
    stretches : sequence of Stretch
        In the order of time.
    during_ns : (int, int), optional
        First and last stamp that is used; None for all.
    """
    if log.ego is None or not stretches:
        return ()
    records = np.unique(np.concatenate([stream.t_ns for stream in log.streams.values()] or [log.ego.t_ns]))
    if during_ns is not None:
        records = records[(records >= during_ns[0]) & (records <= during_ns[1])]
    if not len(records):
        return ()
    ends_ns = int(log.ego.t_ns[0]), int(log.ego.t_ns[-1])
    relevant = [s for s in stretches if _concerns(s, records)]
    skips = [_skip(s, int(records[0])) for s in relevant if s.kind == "skip"]
    copies = [_copies(s, int(records[0])) for s in relevant if s.kind == "copies"]
    wrong = [s for s in relevant if s.kind not in ("gap", "skip", "copies")]
    # Where wrong poses are left out there is a gap, which is reported with them.
    gaps = [
        s
        for s in relevant
        if s.kind == "gap" and not any(w.first_ns < s.last_ns and s.first_ns < w.last_ns for w in wrong)
    ]
    repairs = [_repair(s, int(records[0]), ends_ns) for s in wrong]
    lost = [_lost(s, int(records[0])) for s in gaps if s.unknown_s > 0]
    sparse = [s for s in gaps if not s.unknown_s and s.duration_s >= MIN_SPARSE_S]
    found = [*copies, *repairs, *skips, *lost, *([_sparse(sparse, int(records[0]))] if sparse else [])]
    return tuple(sorted(found, key=lambda fault: fault.start_ns or 0))


def _concerns(stretch: Stretch, records: NDArray[np.int64]) -> bool:
    """Return whether something was recorded while poses are in question; of a gap between its ends."""
    margin = 1 if stretch.kind == "gap" else 0
    first, stop = np.searchsorted(records, [stretch.first_ns + margin, stretch.last_ns + 1 - margin])
    return bool(stop > first)


def _span(stretch: Stretch, start_ns: int) -> str:
    first, last = (max((t - start_ns) / NS_PER_S, 0.0) for t in (stretch.first_ns, stretch.last_ns))
    return f"from {first:.2f} to {last:.2f} s" if last > first else f"at {first:.2f} s"


def _repair(stretch: Stretch, start_ns: int, ends_ns: tuple[int, int]) -> Fault:
    """Describe a jump, or poses that froze."""
    if stretch.kind == "frozen_poses":
        what = f"the pose stays {_span(stretch, start_ns)} while the ego moves on by up to {stretch.shift_m:.1f} m"
        done = f"{stretch.by} bridges it"
    else:
        by = [f"{stretch.shift_m:.1f} m"] if stretch.shift_m >= MIN_STEP_M else []
        by += [f"{np.rad2deg(stretch.turn_rad):.1f} degrees"] if stretch.turn_rad >= MIN_STEP_RAD else []
        what = f"the poses {_span(stretch, start_ns)} are off the others by {' and '.join(by)}, which no vehicle moves so fast"
        done = "they are moved back"
        if stretch.first_ns == ends_ns[0] or stretch.last_ns == ends_ns[1]:
            done += " to those of the longer part, as which part is right does not show"
    if stretch.unknown_s:
        done += f"; for {stretch.unknown_s:.1f} s of it the pose is not known, and what was recorded then is left out"
    values = {
        "shift_m": round(stretch.shift_m, 3),
        "turn_rad": round(stretch.turn_rad, 4),
        "sigma_m": round(stretch.sigma_m, 3),
        "duration_s": round(stretch.duration_s, 3),
        "unknown_s": round(stretch.unknown_s, 3),
    }
    return Fault(
        stretch.kind,
        "ego",
        f"{what}: {done}",
        "left_out" if stretch.unknown_s else "corrected",
        stretch.first_ns,
        stretch.last_ns,
        values,
    )


def _copies(stretch: Stretch, start_ns: int) -> Fault:
    """Describe poses that repeat others."""
    message = (
        f"{stretch.poses} poses {_span(stretch, start_ns)} repeat the one before while the ego moves on by up to "
        f"{stretch.shift_m:.1f} m, as those of a slower source do: they are not used"
    )
    values = {"shift_m": round(stretch.shift_m, 3), "poses": float(stretch.poses)}
    return Fault("frozen_poses", "ego", message, "left_out", stretch.first_ns, stretch.last_ns, values)


def _skip(stretch: Stretch, start_ns: int) -> Fault:
    """Describe a step forward."""
    message = (
        f"the position steps by {stretch.shift_m:.1f} m {_span(stretch, start_ns)}, farther than a vehicle moves: it "
        "jumped, or the stamps miss some time, which does not show; used as it is"
    )
    values = {"shift_m": round(stretch.shift_m, 3)}
    return Fault("pose_jump", "ego", message, "kept", stretch.first_ns, stretch.last_ns, values)


def _lost(stretch: Stretch, start_ns: int) -> Fault:
    """Describe a gap that is too long to be bridged."""
    message = (
        f"no pose {_span(stretch, start_ns)}, too long for the motion around to bridge more than "
        f"{max(stretch.duration_s - stretch.unknown_s, 0.0):.1f} s of it: what was recorded in the rest is left out"
    )
    values = {"duration_s": round(stretch.duration_s, 3), "unknown_s": round(stretch.unknown_s, 3)}
    return Fault("sparse_poses", "ego", message, "left_out", stretch.first_ns, stretch.last_ns, values)


def _sparse(gaps: Sequence[Stretch], start_ns: int) -> Fault:
    """Describe gaps that are bridged."""
    by = "the ego's motion" if gaps[0].by == Stretch.by else gaps[0].by
    longest, sigma_m = max(s.duration_s for s in gaps), max(s.sigma_m for s in gaps)
    whole = Stretch("gap", gaps[0].first_ns, gaps[-1].last_ns)
    number = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
    message = (
        f"poses are up to {longest:.2f} s apart {_span(whole, start_ns)} ({number}): {by} interpolates them, "
        f"to {sigma_m:.2f} m (1 sigma)"
    )
    values = {"longest_s": round(longest, 3), "gaps": float(len(gaps)), "sigma_m": round(sigma_m, 3)}
    return Fault("sparse_poses", "ego", message, "corrected", whole.first_ns, whole.last_ns, values)
