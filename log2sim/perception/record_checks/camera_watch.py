"""Which pictures of a camera show nothing, and which repeat an earlier one while the camera moves."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from log2sim.datatypes import Log
from log2sim.perception.record_checks.expected_change import expect_change
from log2sim.perception.record_checks.motion import motion_of
from log2sim.perception.record_checks.thumbnails import Thumbnail, changed_share, measure_change, shows_nothing

PictureState = Literal["live", "black", "frozen"]

# A copy that was compressed again differs by less than a gray level; motion that should change a picture by five
# differs clearly from that.
MIN_EXPECTED_LEVELS = 5.0
MAX_CHANGED_SHARE = 0.2
MAX_COPY_LEVELS = MAX_CHANGED_SHARE * MIN_EXPECTED_LEVELS
# A single step of the poses without motion in the picture may be a jump of the poses.
MIN_STEPS_WITHOUT_CHANGE = 2
# Pictures from one place tell whether a camera has noise: that so many pairs all differ in half of their cells, and the next
# not in a single one of thousands, is no chance.
MIN_STILL_PAIRS = 5
MIN_NOISY_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class _Picture:
    """A picture, and the stamp of the first in a row that are identical to it."""

    t_ns: int
    since_ns: int
    thumbnail: Thumbnail


@dataclass(eq=False)
class CameraWatch:
    """Judge the pictures of one camera in the order of their stamps.

    Attributes
    ----------
    log : Log
        Its poses tell how the camera moves.
    name : str
        Of the camera.
    states : dict of int to {"live", "black", "frozen"}
        What was found, by stamp, rising.
    """

    log: Log
    name: str
    states: dict[int, PictureState] = field(default_factory=dict)
    _last: _Picture | None = None
    _frozen: bool = False
    _steps_without_change: int = 0
    _still_shares: list[float] = field(default_factory=list)

    def judge(self, t_ns: int, thumbnail: Thumbnail, *, found: bool = False) -> PictureState:
        """Say whether a picture shows what is before the camera at its stamp, and remember it.

        Parameters
        ----------
        t_ns : int
        thumbnail : (h, w) float32
        found : bool
            Whether a detector found something in it: then it does show something.

        Notes
        -----
        Identical pictures are harmless as long as the camera has not moved since the first of them enough to change them: they
        show what it sees of all that stands. Pictures that are nearly identical are copies where the poses say at every step
        that they cannot be; poses that drift or scatter while the ego stands do not.
        """
        last = self._last
        if not found and shows_nothing(thumbnail):
            state: PictureState = "black"
        elif last is None or last.thumbnail.shape != thumbnail.shape:
            state, self._last = "live", _Picture(t_ns, t_ns, thumbnail)
        else:
            self._frozen = self._is_copy(last, t_ns, thumbnail)
            same = not changed_share(last.thumbnail, thumbnail)
            state = "frozen" if self._frozen else "live"
            self._last = _Picture(t_ns, last.since_ns if same else t_ns, thumbnail)
        self.states[t_ns] = state
        return state

    def assume_unchanged(self, t_ns: int) -> PictureState:
        """Return the state of a picture that was not looked at: that of the one before it."""
        self.states[t_ns] = next(reversed(self.states.values()), "live")
        return self.states[t_ns]

    def _is_copy(self, last: _Picture, t_ns: int, thumbnail: Thumbnail) -> bool:
        """Compare a picture with the one before it."""
        change = measure_change(last.thumbnail, thumbnail)
        share = changed_share(last.thumbnail, thumbnail)
        if change > MAX_CHANGED_SHARE * float(last.thumbnail.max() - last.thumbnail.min()):
            self._steps_without_change = 0
            return False  # no motion changes it by five times as much
        if self._frozen and change < MAX_COPY_LEVELS:
            return True
        before_ns = last.since_ns if share == 0 else last.t_ns
        motion = motion_of(self.log, self.name, before_ns, t_ns)
        expected = self._expected(before_ns, t_ns, last.thumbnail) if motion == "drives" else 0.0
        noisy = len(self._still_shares) >= MIN_STILL_PAIRS and min(self._still_shares) > MIN_NOISY_SHARE
        if share == 0 and (expected >= MAX_COPY_LEVELS or noisy):
            return True
        if motion == "stands":
            self._still_shares.append(share)
        without_change = expected >= MIN_EXPECTED_LEVELS and change < MAX_CHANGED_SHARE * expected
        self._steps_without_change = self._steps_without_change + 1 if without_change else 0
        return self._steps_without_change >= MIN_STEPS_WITHOUT_CHANGE

    def _expected(self, before_ns: int, after_ns: int, thumbnail: Thumbnail) -> float:
        """Return by how many levels a picture should change between two stamps; 0 where the poses are not known."""
        log, ego = self.log, self.log.ego
        poses, known = log.map_T_sensor(self.name, np.array([before_ns, after_ns]))
        if ego is None or not known.all():
            return 0.0
        map_T_ego = ego.at(after_ns)[0][0]
        ground_z_m = float((map_T_ego @ [0.0, 0.0, log.ground_z_ego_m, 1.0])[2])
        return expect_change(thumbnail, log.cameras[self.name], poses[0], poses[1], ground_z_m)
