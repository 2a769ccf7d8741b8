"""Stamps of the messages of a sensor: those of their headers, in order."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S
from log2sim.logs.ros.bag import STAMP, Topic, stamp_of
from log2sim.logs.stamps import strictly_increasing
from log2sim.logs.time_checks import Span, say_apart

# Delays between sensor and recorder are seconds at most; a larger one is another clock.
MAX_CLOCK_DIFFERENCE_S = 10.0
MIN_POSES = 2
# A topic of single goals or starting points is no trajectory.
MIN_COVERED_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Stamped:
    """Messages of a topic in the order of their stamps; F is their number.

    Attributes
    ----------
    t_ns : (F,) int64
        Strictly increasing.
    row : (F,) int
        Which message of the topic each is.
    delay_s : float or None
        Median from the header's stamp to the recorder's; None where the recorder's are used.
    """

    t_ns: NDArray[np.int64]
    row: NDArray[np.intp]
    delay_s: float | None


def stamp_messages(topic: Topic, heads: Sequence[bytes | None], notes: list[str], *, recorded: bool = False) -> Stamped:
    """Take the stamps from the first bytes of the messages of a topic; None of them where a message is damaged.

    Notes
    -----
    A damaged message keeps its place: it gets the recorder's stamp less the usual delay, so that reading it is what fails.
    """
    t_ns, known = np.zeros(len(topic), dtype=np.int64), np.zeros(len(topic), dtype=bool)
    for i, head in enumerate(heads):
        if head is not None and len(head) >= STAMP.stop:
            try:
                t_ns[i], known[i] = stamp_of(head, topic.encoding), True
            except struct.error:
                continue
    if recorded or not t_ns.any():
        if not recorded and known.any():
            notes.append(f"{topic.name}: its header stamps are all 0; those of the recorder are used")
        t_ns, known, delay_s = topic.recorded_ns, np.ones(len(topic), dtype=bool), None
    else:
        delay_ns = np.median(topic.recorded_ns[known] - t_ns[known])
        t_ns = np.where(known, t_ns, topic.recorded_ns - np.int64(delay_ns))
        delay_s = float(delay_ns) / NS_PER_S
    lost = int((~known).sum())
    if lost:
        notes.append(f"{topic.name}: {lost} of {len(topic)} messages are damaged, first at stamp {t_ns[~known][0]}")
    row, problems = strictly_increasing(t_ns, topic.name)
    notes += problems
    return Stamped(t_ns[row], row, delay_s)


def say_uncovered(t_ns: NDArray[np.int64], begin_ns: int, end_ns: int) -> str:
    """Say why poses at stamps (P,) ns do not cover the time of the sensors; "" where they do."""
    covered_ns = max(0, min(end_ns, int(t_ns[-1])) - max(begin_ns, int(t_ns[0]))) if len(t_ns) else 0
    if len(t_ns) >= MIN_POSES and covered_ns >= MIN_COVERED_SHARE * (end_ns - begin_ns):
        return ""
    poses, sensors = Span.of("poses", t_ns) if len(t_ns) else None, Span("frames and sweeps", begin_ns, end_ns)
    if poses is not None and poses.is_apart(sensors):
        return say_apart(poses, sensors)
    seconds = f"{covered_ns / NS_PER_S:.1f} of {(end_ns - begin_ns) / NS_PER_S:.1f} s"
    return f"it gives {len(t_ns)} poses in {seconds} of the sensors"


def note_other_clocks(delays_s: Mapping[str, float | None], notes: list[str]) -> None:
    """Note topics whose header stamps are of another clock than most, by their delay to the recorder."""
    known = {name: delay for name, delay in delays_s.items() if delay is not None}
    if not known:
        return
    # The middle one by size: of two, that of the recorder's clock.
    usual_s = sorted(known.values(), key=abs)[(len(known) - 1) // 2]
    for name, delay_s in known.items():
        if abs(delay_s - usual_s) > MAX_CLOCK_DIFFERENCE_S:
            notes.append(
                f"{name}: its header stamps are {delay_s - usual_s:.1f} s off those of the other topics, so its clock is "
                'not synchronized; with stamps = "recorded" in the settings those of the recorder are used'
            )
