"""What a check of given poses finds and leaves."""

from __future__ import annotations

from dataclasses import dataclass

from log2sim.geometry import NS_PER_S, PoseTrack


@dataclass(frozen=True)
class Stretch:
    """A time in which poses were repaired or are not known.

    Attributes
    ----------
    kind : {"pose_jump", "frozen_poses", "gap", "skip", "copies"}
        A skip is a step that stays: the position may have jumped, or stamps may miss some time.
    first_ns, last_ns : int
        Stamps of the first and the last pose in question; of a gap those around it.
    shift_m, turn_rad : float
        By how much poses were moved at most.
    sigma_m : float
        Largest standard deviation of a repaired position that is used.
    unknown_s : float, s
        For how long no pose is known well enough.
    poses : int
        Number of poses in question.
    by : str
        What bridges it.
    """

    kind: str
    first_ns: int
    last_ns: int
    shift_m: float = 0.0
    turn_rad: float = 0.0
    sigma_m: float = 0.0
    unknown_s: float = 0.0
    poses: int = 0
    by: str = "the motion around"

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return (self.last_ns - self.first_ns) / NS_PER_S


@dataclass(frozen=True, eq=False)
class CheckedPoses:
    """Poses after the check.

    Attributes
    ----------
    track : PoseTrack
        The very poses that were given where nothing is wrong with them.
    stretches : tuple of Stretch
        In the order of time.
    moved : bool
        Whether given poses are not where they were, so that what was measured moves with them.
    """

    track: PoseTrack
    stretches: tuple[Stretch, ...]
    moved: bool = False
