"""LiDAR odometry: poses of the ego from the sweeps of one LiDAR, registered one after the other with a map of the earlier ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.geometry import NS_PER_S, Array, transform
from log2sim.localization.ego_sweeps import EgoSweep, compensated, read_ego_sweep, share_of_motion
from log2sim.localization.registration import MIN_OVERLAP, Fit, SurfaceMap, motion_between

# Vehicles on roads brake with up to 10 m/s2; the rest is room for the error of two fits.
MAX_ACCELERATION_MPS2, MAX_JUMP_M = 12.0, 0.5
# The first motion is searched forward and backward in steps within which a fit finds its way, up to these speeds.
SEARCH_STEP_M, MAX_SPEED_MPS, MAX_REVERSE_MPS = 1.0, 50.0, 5.0
# A compensation by another motion than the one found is repeated from these differences over a sweep on.
REPEAT_FROM_M, REPEAT_FROM_RAD = 0.1, 0.005
MAX_COASTING_S = 1.0

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Odometry:
    """Poses of the ego by LiDAR odometry, in a frame of its own.

    Attributes
    ----------
    lidar : str
    t_ns : (P,) int64
        Increasing stamps.
    odom_T_ego : (P, 4, 4) float64
    overlap, residual, constraint : (P,) float64
        See `Fit`; NaN where the pose is only predicted.
    weakest : (P, 3) float64
        Direction of the weakest constraint, odometry frame.
    degenerate : (P,) bool
        Whether the sweep does not constrain some direction of the motion.
    predicted : (P,) bool
        Whether the sweep did not fit to the others and the pose is predicted by constant velocity.
    sweeps : int
        Number of sweeps in the log.
    problems : dict of str to int
        Sweeps that gave no pose of their own, by reason.
    """

    lidar: str
    t_ns: NDArray[np.int64]
    odom_T_ego: Array
    overlap: Array
    residual: Array
    constraint: Array
    weakest: Array
    degenerate: NDArray[np.bool_]
    predicted: NDArray[np.bool_]
    sweeps: int
    problems: dict[str, int]

    @property
    def path_m(self) -> float:
        """Length of the path, m."""
        return float(np.linalg.norm(np.diff(self.odom_T_ego[:, :3, 3], axis=0), axis=1).sum())


def run_odometry(
    log: Log, lidar: str, *, during_ns: tuple[int, int] | None = None, progress: Progress | None = None
) -> Odometry:
    """Estimate the motion of the ego from the sweeps of a LiDAR.

    Parameters
    ----------
    log : Log
    lidar : str
        One on the ego.
    during_ns : (int, int), optional
        First and last stamp of the sweeps to use; all by default.
    progress : callable, optional
        Called with (sweeps done, all sweeps).

    Raises
    ------
    LogError
        When no sweeps fit to each other.
    MissingExtra
        Where the library for registration is not installed.

    Notes
    -----
    Each sweep is compensated by the motion that is expected at constant velocity, and again by the one found where they
    differ. Sweeps that do not fit are bridged for `MAX_COASTING_S`; after that a new path begins, and the longest is kept.
    """
    t_ns = log.streams[lidar].t_ns
    index = np.arange(len(t_ns))
    if during_ns is not None:
        index = index[(t_ns >= during_ns[0]) & (t_ns <= during_ns[1])]
    run = _Run(SurfaceMap())
    for done, i in enumerate(index.tolist(), 1):
        run.add(read_ego_sweep(log, lidar, i))
        if progress is not None:
            progress(done, len(index))
    paths = [p for p in run.finished() if any(step.fit is not None for step in p)]
    if not paths:
        found = ", ".join(f"{reason}: {count}" for reason, count in run.problems.items()) or "too few sweeps"
        raise LogError(
            f"{log.name}: LiDAR odometry found no motion in the {len(index)} sweeps of '{lidar}' ({found}); expected at "
            "least two in succession that show the same surroundings"
        )
    best = max(paths, key=lambda p: p[-1].t_ns - p[0].t_ns)
    lost = sum(len(p) for p in paths) - len(best)
    problems = dict(run.problems) | ({"of another part of the drive": lost} if lost else {})
    return _odometry(lidar, best, len(index), problems)


@dataclass(frozen=True, eq=False)
class _Step:
    """A pose; `fit` is None where it is predicted, and at the first sweep of a path; `held` whether every direction is held."""

    t_ns: int
    pose: Array
    fit: Fit | None = None
    predicted: bool = False
    held: bool = True


@dataclass(eq=False)
class _Run:
    """State of the odometry from sweep to sweep.

    `path` is the current path, `motion` the last motion with its time `motion_s`; `first` the first sweep of a path until a
    second one fits to it.
    """

    map: SurfaceMap
    path: list[_Step] = field(default_factory=list)
    paths: list[list[_Step]] = field(default_factory=list)
    first: EgoSweep | None = None
    motion: Array = field(default_factory=lambda: np.eye(4))
    motion_s: float = 0.0
    problems: dict[str, int] = field(default_factory=dict)

    def add(self, sweep: EgoSweep | None) -> None:
        """Take the next sweep; None for one that cannot be read."""
        last_ns = self.path[-1].t_ns if self.path else None if self.first is None else self.first.t_ref_ns
        if sweep is None:
            self._count("unreadable or without a pose")
        elif last_ns is not None and sweep.t_ref_ns <= last_ns:
            self._count("stamp not after the one before")
        elif not self.path:
            self._begin(sweep)
        elif (sweep.t_ref_ns - self.path[-1].t_ns) / NS_PER_S > MAX_COASTING_S:
            self._break(sweep)
        else:
            self._follow(sweep)

    def finished(self) -> list[list[_Step]]:
        """Return all paths."""
        return [*self.paths, self.path] if self.path else self.paths

    def _count(self, reason: str) -> None:
        self.problems[reason] = self.problems.get(reason, 0) + 1

    def _begin(self, sweep: EgoSweep) -> None:
        """Find the first motion of a path by trying speeds; the first sweep stays as it is until then."""
        first = self.first
        self.first = sweep
        if first is None:
            return
        dt_s = (sweep.t_ref_ns - first.t_ref_ns) / NS_PER_S
        found = None if dt_s > MAX_COASTING_S else self._first_fit(first, sweep, dt_s)
        if found is None:
            self._count("no overlap with the sweep before")
            return
        fit, held = found
        self.path = [_Step(first.t_ref_ns, np.eye(4), held=held), _Step(sweep.t_ref_ns, fit.pose, fit, held=held)]
        self.motion, self.motion_s, self.first = fit.pose, dt_s, None

    def _first_fit(self, first: EgoSweep, sweep: EgoSweep, dt_s: float) -> tuple[Fit, bool] | None:
        """Fit two sweeps without a motion before them, and once more with this motion taken out of both; whether it is held."""
        reach = np.arange(-MAX_REVERSE_MPS * dt_s, MAX_SPEED_MPS * dt_s + SEARCH_STEP_M, SEARCH_STEP_M)
        shifts = reach[np.argsort(np.abs(reach))]
        best = None
        self.map = SurfaceMap()
        target, source = self.map.surfaces_of(first.xyz_m), self.map.surfaces_of(sweep.xyz_m)
        if target is None or source is None:
            return None
        self.map.insert(target, np.eye(4))
        for shift in shifts.tolist():
            fit = self.map.fit(source, transform(np.eye(3), np.array([shift, 0.0, 0.0])))
            if best is None or _rate(fit) > _rate(best):
                best = fit
        if best is None or best.overlap < MIN_OVERLAP:
            return None
        self.map = SurfaceMap()
        target = self.map.surfaces_of(compensated(first, best.pose, dt_s))
        source = self.map.surfaces_of(compensated(sweep, best.pose, dt_s))
        if target is None or source is None:
            return None
        self.map.insert(target, np.eye(4))
        fit = self.map.fit(source, best.pose)
        if fit.overlap < MIN_OVERLAP:
            return None
        held = self.map.holds(source, fit)
        self.map.insert(source, fit.pose)
        return fit, held

    def _follow(self, sweep: EgoSweep) -> None:
        """Register a sweep from the pose that constant velocity predicts."""
        last = self.path[-1]
        dt_s = (sweep.t_ref_ns - last.t_ns) / NS_PER_S
        expected = share_of_motion(self.motion, np.array([dt_s / self.motion_s]))[0]
        fit, surfaces = self._fit(sweep, expected, dt_s)
        if fit is None:
            self._count("too few points")
        elif fit.overlap < MIN_OVERLAP:
            self._count("no overlap with the sweeps before")
        elif not _is_possible(expected, motion_between(last.pose, fit.pose), dt_s):
            self._count("a motion that no vehicle makes")
        else:
            held = self.map.holds(surfaces, fit)
            self.map.insert(surfaces, fit.pose)
            self.path.append(_Step(sweep.t_ref_ns, fit.pose, fit, held=held))
            self.motion, self.motion_s = motion_between(last.pose, fit.pose), dt_s
            return
        registered = next(step for step in reversed(self.path) if not step.predicted)
        if (sweep.t_ref_ns - registered.t_ns) / NS_PER_S > MAX_COASTING_S:
            self._break(sweep)
        else:
            self.path.append(_Step(sweep.t_ref_ns, last.pose @ expected, predicted=True))
            self.motion, self.motion_s = expected, dt_s

    def _break(self, sweep: EgoSweep) -> None:
        """End the path at its last registered sweep and begin another one."""
        registered = max(k for k, step in enumerate(self.path) if not step.predicted)
        self.paths.append(self.path[: registered + 1])
        self.path, self.first, self.motion = [], sweep, np.eye(4)

    def _fit(self, sweep: EgoSweep, expected: Array, dt_s: float) -> tuple[Fit | None, object]:
        """Fit a sweep, and once more where the motion found differs from the one that was taken out of it."""
        last = self.path[-1].pose
        surfaces = self.map.surfaces_of(compensated(sweep, expected, dt_s))
        if surfaces is None:
            return None, None
        fit = self.map.fit(surfaces, last @ expected)
        found = motion_between(last, fit.pose)
        off = motion_between(expected, found)
        sweep_s = 0.0 if sweep.t_ns is None else float(np.ptp(sweep.t_ns)) / NS_PER_S
        moved_m, turned = np.linalg.norm(off[:3, 3]), np.linalg.norm(off[:3, :3] - np.eye(3)) / np.sqrt(2)
        if max(moved_m / REPEAT_FROM_M, turned / REPEAT_FROM_RAD) * sweep_s / dt_s < 1 or fit.overlap < MIN_OVERLAP:
            return fit, surfaces
        surfaces = self.map.surfaces_of(compensated(sweep, found, dt_s))
        return self.map.fit(surfaces, fit.pose), surfaces


def _rate(fit: Fit) -> float:
    """Rate a fit among those from several guesses: many points, near to their surfaces."""
    return fit.overlap / (1.0 + fit.residual)


def _is_possible(expected: Array, found: Array, dt_s: float) -> bool:
    """Return whether a vehicle can make the motion found instead of the one expected."""
    off_m = float(np.linalg.norm(found[:3, 3] - expected[:3, 3]))
    return off_m <= MAX_JUMP_M + 0.5 * MAX_ACCELERATION_MPS2 * dt_s * max(dt_s, 0.1)


def _odometry(lidar: str, path: list[_Step], sweeps: int, problems: dict[str, int]) -> Odometry:
    nan = np.full(3, np.nan)
    fits = [step.fit for step in path]

    def column(name: str) -> Array:
        return np.array([np.nan if fit is None else float(getattr(fit, name)) for fit in fits])

    return Odometry(
        lidar,
        np.array([step.t_ns for step in path], dtype=np.int64),
        np.stack([step.pose for step in path]),
        column("overlap"),
        column("residual"),
        column("constraint"),
        np.stack([nan if fit is None else fit.weakest for fit in fits]),
        np.array([not step.held for step in path]),
        np.array([step.predicted for step in path]),
        sweeps,
        problems,
    )
