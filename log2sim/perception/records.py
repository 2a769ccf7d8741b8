"""Records read and checked: which pictures show nothing or repeat, which sweeps repeat, and what is missing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from copy import copy, deepcopy
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Finding, Log, Sweep, Treatment
from log2sim.errors import LogError, RecordError
from log2sim.files.images import decode_image
from log2sim.geometry import MIN_DEPTH_M, NS_PER_S

Motion = Literal["drives", "stands", "unclear"]

# Positions of a standing ego scatter, drift by centimeters a second, and its yaw by GNSS alone is any; only net motion over
# a second tells that it drives. What brakes to a stop has been this near to its place for a second only after it stands.
WINDOW_S = 1.0
MIN_DRIVEN_M = 1.0
MAX_STANDING_M = 0.05


def motion_of(log: Log, name: str, since_ns: int, t_ns: int) -> Motion:
    """Return whether a sensor has moved by a meter, or by no more than poses scatter, within a second or since an earlier stamp."""
    sensor = log.cameras.get(name) or log.lidars[name]
    if sensor.mount == "map":
        return "stands"
    if log.ego is None:
        return "unclear"
    wanted_ns = min(since_ns, t_ns - round(WINDOW_S * NS_PER_S))
    before_ns = max(wanted_ns, int(log.ego.t_ns[0]))
    poses, known = log.map_T_sensor(name, np.array([before_ns, t_ns]))
    if not known.all():
        return "unclear"
    moved_m = float(np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3]))
    if moved_m >= MIN_DRIVEN_M:
        return "drives"
    return "stands" if moved_m < MAX_STANDING_M and before_ns == wanted_ns else "unclear"


# Faults of one sensor nearer to each other than this are reported as one, and more than so many all together.
JOINED_S = 1.0
MAX_SPANS = 3
# Busy recorders drop a record now and then. Longer than this, and than so many periods, a stream is interrupted.
MIN_GAP_S = 0.5
MIN_GAP_PERIODS = 3.0
# Fewer records have no usual period.
MIN_STAMPS = 3


def _spans(t_ns: NDArray[np.int64], at_fault: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Group the rows of records (F,) at fault, rising in time: those near each other, or all where they are many."""
    rows = np.flatnonzero(at_fault)
    cuts = np.flatnonzero(np.diff(t_ns[rows]) > JOINED_S * NS_PER_S) + 1
    return np.split(rows, cuts if len(cuts) < MAX_SPANS else cuts[:0]) if len(rows) else []


# Cells along the longer side. A cell of a camera for vehicles covers about a hundred pixels, whose noise averages out.
CELLS = 128
# The last reduction averages at least this many by this many values, rounded to whole gray levels by those before it.
FINE_FACTOR = 4
# Of the differences of all cells the 95 % quantile tells whether two pictures differ: stamps written into a picture and few
# moving objects do not change it, noise of every cell does.
CHANGE_QUANTILE = 0.95
# Cells of a coarser copy along each side of a fine one, for what is larger than noise.
COARSE_FACTOR = 4
# Of sums over independent noise the variance falls with the number of cells, within a factor of 2 by chance and by the
# blocks of 8 pixels in which JPEG codes.
MAX_NOISE_RATIO = 2.0
# Standard deviation of rounding to 8 bits; a street in fog that hides everything beyond 15 m has more structure.
MIN_STRUCTURE_LEVELS = 0.29
# One cell of thousands is this many standard deviations off once in 10^5 pictures of noise; a lamp at night is more.
OUTSTANDING_SIGMAS = 6.0
MIN_OUTSTANDING_LEVELS = 4.0
# Coefficients of the Laplacian, whose sum of squares scales its variance on independent noise.
LAPLACIAN_NORM = 20.0

Thumbnail = NDArray[np.float32]


def shrink(image: NDArray[np.uint8]) -> Thumbnail:
    """Return the gray means of the cells of an image (H, W, 3) BGR: (h, w) float32, levels from 0 to 255."""
    # Halving is many times as fast as any other reduction; what it rounds averages out in the last one.
    while max(image.shape) >= 2 * FINE_FACTOR * CELLS:
        height, width = (n - n % 2 for n in image.shape[:2])
        image = cv2.resize(image[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    height, width = image.shape[:2]
    scale = min(CELLS / max(height, width), 1.0)
    cells = (max(round(width * scale), 1), max(round(height * scale), 1))
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    return np.asarray(cv2.resize(gray, cells, interpolation=cv2.INTER_AREA))


def quantile_of_change(change: NDArray[np.float32]) -> float:
    """Return by how many gray levels two pictures differ, given the changes of all cells: their 95 % quantile; 0 without cells."""
    values = change.ravel()
    if not len(values):
        return 0.0
    k = int(CHANGE_QUANTILE * (len(values) - 1))
    return float(np.partition(values, k)[k])


def shows_nothing(thumbnail: Thumbnail) -> bool:
    """Return whether a picture holds nothing but noise and a smooth shade: black, of one color, saturated, or covered.

    What a scene shows is as strong in a coarse copy as in a fine one, since images of scenes have the same contrast at every
    scale (Field, J. Opt. Soc. Am. A 4, 1987); independent noise falls with the number of cells averaged. Second
    differences leave out the shade of a covered lens. A scene at night has at least one cell that stands out, a lamp.
    """
    height, width = (n // COARSE_FACTOR for n in thumbnail.shape)
    if min(height, width) < 3:
        return bool(np.ptp(thumbnail) < MIN_STRUCTURE_LEVELS)
    blocks = thumbnail[: height * COARSE_FACTOR, : width * COARSE_FACTOR]
    coarse = blocks.reshape(height, COARSE_FACTOR, width, COARSE_FACTOR).mean(axis=(1, 3))
    # The Laplacian at the inner cells, scaled to the standard deviation of independent noise.
    fine_detail, coarse_detail = (
        (
            (a[:-2, 1:-1] + a[2:, 1:-1] + a[1:-1, :-2] + a[1:-1, 2:] - 4 * a[1:-1, 1:-1]) / np.sqrt(LAPLACIAN_NORM)
        ).astype(np.float64)
        for a in (thumbnail, coarse)
    )
    noise = float((fine_detail**2).mean()) / COARSE_FACTOR**2
    if float((coarse_detail**2).mean()) > max(MAX_NOISE_RATIO * noise, MIN_STRUCTURE_LEVELS**2):
        return False
    size = np.abs(fine_detail)
    sigma = float(np.median(size)) / 0.6745
    return bool(size.max() <= OUTSTANDING_SIGMAS * sigma + MIN_OUTSTANDING_LEVELS)


# What is not ground is assumed as far away as this, so that no more motion is expected than there is at least; houses and
# trees along a road are nearer.
FAR_M = 50.0


def expect_change(picture: Thumbnail, log: Log, name: str, before_ns: int, after_ns: int) -> float:
    """Return by how many gray levels a picture (h, w) of a camera changes between two stamps where nothing but the camera moves.

    That is the 95 % quantile over the cells; 0 where the poses are not known. The distortion of the lens is left out; it changes
    where things are in a picture, not how far they move.

    Every cell of the later picture is followed to flat ground or to `FAR_M`, and from there to the earlier picture. A picture
    without texture, as in fog, is expected not to change.
    """
    camera, (poses, known) = log.cameras[name], log.map_T_sensor(name, np.array([before_ns, after_ns]))
    if log.ego is None or not known.all():
        return 0.0
    map_T_before, map_T_after = poses
    ground_z_m = (log.ego.at(after_ns)[0][0] @ [0.0, 0.0, log.ground_z_ego_m, 1.0])[2]
    height, width = picture.shape
    K = np.diag([width / camera.width_px, height / camera.height_px, 1.0]) @ camera.K
    v, u = np.mgrid[0.5:height, 0.5:width]
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ (map_T_after[:3, :3] @ np.linalg.inv(K)).T
    above_m = map_T_after[2, 3] - ground_z_m
    far = FAR_M / np.linalg.norm(rays, axis=1)
    down = rays[:, 2] * far < -above_m
    reach = np.where(down, np.divide(-above_m, rays[:, 2], out=far.copy(), where=down), far)
    points = rays * reach[:, None] + (map_T_after[:3, 3] - map_T_before[:3, 3])
    seen = points @ (K @ map_T_before[:3, :3].T).T
    front = seen[:, 2] > MIN_DEPTH_M
    at = np.full((len(points), 2), -10.0)
    np.divide(seen[:, :2], seen[:, 2:], out=at, where=front[:, None])
    inside = ((at >= 0) & (at <= [width, height])).all(axis=1)
    flow = (at - 0.5).astype(np.float32).reshape(height, width, 2)
    moved = cv2.remap(picture, flow[..., 0], flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return quantile_of_change(np.abs(moved - picture).ravel()[inside])


# Points are the same within a cell. Ranges of LiDARs scatter by 1 cm and more and their azimuths by several, so that hardly a
# point of another sweep is in the same cell, even where nothing moves; copies rounded to millimeters mostly are.
CELL_M = 0.01
# Hashes of a sketch; the share of common points errs by 1 / sqrt(this), 3 %.
SKETCH_SIZE = 1024
SLICES, MIN_SLICED_POINTS = 8, 4096
# Rays that hit flat ground do so at the same distance wherever the ego is, and those that hit the ego itself always do.
MIN_HEIGHT_M, MIN_DISTANCE_M = 0.3, 3.0
AXIS_BITS = 21


@dataclass(frozen=True, eq=False)
class SweepSketch:
    """What is kept of a sweep to compare it with others."""

    points: int  # how many it has
    obstacles: int  # how many of those that were looked at are above the ground and beyond the ego
    # (K,): the smallest hashes of the cells of its obstacle points, sorted, at most `SKETCH_SIZE`
    hashes: NDArray[np.uint64]


def sketch_sweep(log: Log, name: str, sweep: Sweep) -> SweepSketch:
    """Return the sketch of a sweep of a LiDAR.

    Of many points those are looked at whose cells along x are of one slice in `SLICES`, the same in every sweep.

    The finalizer of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014) spreads neighboring cells evenly over the hashes.
    """
    xyz, lidar = sweep.xyz_m, log.lidars[name]
    if len(xyz) > SLICES * MIN_SLICED_POINTS:
        xyz = xyz.take(np.flatnonzero(np.floor(xyz[:, 0] / CELL_M).astype(np.int64) & (SLICES - 1) == 0), axis=0)
    if lidar.mount != "map":
        # Well above flat ground under the ego, and not on the ego; all points of a LiDAR that stands.
        above_ground_m = float(lidar.mount_T_lidar[2, 3]) - log.ground_z_ego_m
        if sweep.frame == "lidar":
            up, position = lidar.mount_T_lidar[2, :3], np.zeros(3)
        else:
            map_T_lidar, known = log.map_T_sensor(name, sweep.stamp_ns)
            up, position = np.array([0.0, 0.0, 1.0]), map_T_lidar[0][:3, 3] if known[0] else np.median(xyz, axis=0)
        kind = xyz.dtype.type
        height = xyz @ up.astype(kind) + kind(above_ground_m - up @ position)
        x, y = (xyz[:, axis] - kind(position[axis]) for axis in range(2))
        xyz = xyz[(height > MIN_HEIGHT_M) & (x * x + y * y > MIN_DISTANCE_M**2)]
    i = np.floor(xyz / CELL_M).astype(np.int64).astype(np.uint64) & np.uint64((1 << AXIS_BITS) - 1)
    z = (i[:, 0] << np.uint64(2 * AXIS_BITS)) | (i[:, 1] << np.uint64(AXIS_BITS)) | i[:, 2]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    hashes = z ^ (z >> np.uint64(31))
    few = 4 * SKETCH_SIZE  # points share cells, mostly two at a time
    chosen = np.unique(np.partition(hashes, few)[:few] if len(hashes) > few else hashes)
    smallest = chosen[:SKETCH_SIZE] if len(chosen) >= SKETCH_SIZE else np.unique(hashes)[:SKETCH_SIZE]
    return SweepSketch(len(sweep.xyz_m), len(xyz), smallest)


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


@dataclass(eq=False)
class CameraWatch:
    """Judge the pictures of one camera in the order of their stamps."""

    log: Log  # its poses tell how the camera moves
    name: str  # of the camera
    states: dict[int, PictureState] = field(default_factory=dict)  # what was found, by stamp, rising
    # The last picture, its stamp, and that of the first in a row that are identical to it
    _last: tuple[Thumbnail, int, int] | None = None
    _frozen: bool = False
    _steps_without_change: int = 0
    _still_shares: list[float] = field(default_factory=list)

    def judge(self, t_ns: int, thumbnail: Thumbnail, *, found: bool = False) -> PictureState:
        """Say whether a picture shows what is before the camera at its stamp, and remember it.

        `thumbnail`: (h, w). `found`: whether a detector found something in it: then it does show something.

        Identical pictures are harmless as long as the camera has not moved since the first of them enough to change them: they
        show what it sees of all that stands. Pictures that are nearly identical are copies where the poses say at every step
        that they cannot be; poses that drift or scatter while the ego stands do not.
        """
        if t_ns in self.states:
            return self.states[t_ns]
        if not found and shows_nothing(thumbnail):
            return self.states.setdefault(t_ns, "black")
        since_ns, copy = t_ns, False
        if self._last is not None and self._last[0].shape == thumbnail.shape:
            before, last_ns, last_since_ns = self._last
            change, share = quantile_of_change(np.abs(thumbnail - before)), float((before != thumbnail).mean())
            since_ns = t_ns if share else last_since_ns
            if change > MAX_CHANGED_SHARE * float(before.max() - before.min()):
                self._steps_without_change = 0  # no motion changes it by five times as much
            elif self._frozen and change < MAX_COPY_LEVELS:
                copy = True
            else:
                before_ns = last_ns if share else last_since_ns
                motion = motion_of(self.log, self.name, before_ns, t_ns)
                drives = motion == "drives"
                expected = expect_change(before, self.log, self.name, before_ns, t_ns) if drives else 0.0
                noisy = len(self._still_shares) >= MIN_STILL_PAIRS and min(self._still_shares) > MIN_NOISY_SHARE
                copy = share == 0 and (expected >= MAX_COPY_LEVELS or noisy)
                if not copy:
                    if motion == "stands":
                        self._still_shares.append(share)
                    unchanged = expected >= MIN_EXPECTED_LEVELS and change < MAX_CHANGED_SHARE * expected
                    self._steps_without_change = self._steps_without_change + 1 if unchanged else 0
                    copy = self._steps_without_change >= MIN_STEPS_WITHOUT_CHANGE
            self._frozen = copy
        self._last = thumbnail, t_ns, since_ns
        return self.states.setdefault(t_ns, "frozen" if copy else "live")


# A sweep that has this share of its obstacle points in common with another is a copy of it: rounded to millimeters one has
# nine in ten on each axis, and noise of a LiDAR leaves one in ten where nothing moves.
MIN_COPIED_SHARE = 0.6
# Where nothing tells how much sweeps of this LiDAR usually have in common, only exact copies count.
MIN_IDENTICAL_SHARE = 0.95
# Motion of the LiDAR by ten cells moves all points of structures to other cells.
MIN_MOTION_M = 10 * CELL_M
# So many pairs of sweeps tell how much they usually have in common.
MIN_PAIRS = 5
MAX_USUAL_SHARE = 0.3
# Fewer obstacle points do not tell copies from chance.
MIN_OBSTACLES = 20


@dataclass(eq=False)
class LidarWatch:
    """Judge the sweeps of one LiDAR in the order of their stamps."""

    log: Log  # its poses tell how the LiDAR moves
    name: str  # of the LiDAR
    repeated: dict[int, bool] = field(default_factory=dict)  # whether a sweep repeats an earlier one, by stamp, ns
    points: dict[int, int] = field(default_factory=dict)  # number of points, by stamp
    # The last sweep, and the stamp of the first in a row that have their points in common with it
    _last: tuple[SweepSketch, int] | None = None
    _shares: dict[Motion, list[float]] = field(default_factory=lambda: {"stands": [], "drives": [], "unclear": []})

    def is_repeated(self, t_ns: int, sketch: SweepSketch) -> bool:
        """Return whether a sweep repeats the one before it, and remember it.

        A LiDAR that stands in a synthetic world without noise gives the same points again and again, and rightly so. Hence a
        sweep is a copy where the LiDAR moved meanwhile, or where its sweeps are known to differ even from one place.
        """
        if t_ns in self.repeated:
            return self.repeated[t_ns]
        self.points[t_ns] = sketch.points
        since_ns, copy = t_ns, False
        if self._last is not None and min(sketch.obstacles, self._last[0].obstacles) >= MIN_OBSTACLES:
            before, last_since_ns = self._last
            # The share of the obstacle points that both have. The smallest hashes are a sample of all cells, the same for both
            # (Broder, "On the resemblance and containment of documents", 1997). With the Jaccard index J of two sets of one size the
            # share is 2 J / (1 + J).
            either = np.union1d(before.hashes, sketch.hashes)[: max(len(before.hashes), len(sketch.hashes))]
            shared = np.intersect1d(before.hashes, sketch.hashes, assume_unique=True)
            jaccard = float(np.isin(either, shared, assume_unique=True).mean()) if len(either) else 0.0
            share, motion = 2 * jaccard / (1 + jaccard), motion_of(self.log, self.name, last_since_ns, t_ns)
            if motion == "drives":  # only where all points of structures are in other cells
                poses, _ = self.log.map_T_sensor(self.name, np.array([last_since_ns, t_ns]))
                moved_m = np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3])
                motion = "drives" if moved_m > MIN_MOTION_M else "unclear"
            copy = motion == "drives" and share >= MIN_IDENTICAL_SHARE
            if share >= MIN_COPIED_SHARE:
                since_ns = last_since_ns
                # Sweeps may be known to have few points in common: even from one place, or while the LiDAR drives as now.
                known = [self._shares["stands"], self._shares["drives"] if motion == "drives" else []]
                copy |= any(len(of) >= MIN_PAIRS and float(np.median(of)) < MAX_USUAL_SHARE for of in known)
            if not copy:
                self._shares[motion].append(share)
        self._last = sketch, since_ns
        self.repeated[t_ns] = copy
        return copy


# What sweeps of this LiDAR usually have: this quantile of the numbers of points, so that many with none do not lower it.
USUAL_QUANTILE = 0.9
# Next to no points: the ground alone gives most points of a sweep, so no change of the scenery takes nine of ten away.
MAX_SPARSE_SHARE = 0.1
# With fewer points than this a LiDAR shows no object farther than some meters.
MIN_USUAL_POINTS = 100


@dataclass(frozen=True, eq=False)
class Look:
    """What is kept of a record to judge it."""

    sensor: str
    t_ns: int
    shown: Thumbnail | SweepSketch | None  # None of a picture that was not decoded
    found: bool  # whether a detector found something in it
    state: str  # "live", "black", "frozen" or, of a sweep, "repeated", as far as it was known then


# States that a watch takes along to another process: no record of a tick is this many earlier than another.
STATES_SENT = 64


class RecordWatch:
    """Judge pictures and sweeps as they are read, each once.

    Another process gets what it needs to go on, and `attach` gives it the log.
    """

    def __init__(self, log: Log) -> None:
        self._log = log
        self.cameras = {name: CameraWatch(log, name) for name in log.cameras}
        self.lidars = {name: LidarWatch(log, name) for name in log.lidars}

    def __getstate__(self) -> dict[str, Any]:
        """Return the watches without the log and with their last states."""

        def last(states: dict[int, Any]) -> dict[int, Any]:
            return dict(list(states.items())[-STATES_SENT:])

        no_log: Any = None
        cameras = {n: replace(w, log=no_log, states=last(w.states)) for n, w in self.cameras.items()}
        lidars = {
            n: replace(w, log=no_log, repeated=last(w.repeated), points=last(w.points)) for n, w in self.lidars.items()
        }
        return {"cameras": cameras, "lidars": lidars}

    def copied(self) -> RecordWatch:
        """Return a watch that goes on from here by itself."""
        other, shared = RecordWatch(self._log), {id(self._log): self._log}
        other.cameras, other.lidars = deepcopy(self.cameras, shared), deepcopy(self.lidars, shared)
        return other

    def attach(self, log: Log) -> None:
        """Give the log to a watch that came from another process."""
        for watch in (self, *self.cameras.values(), *self.lidars.values()):
            setattr(watch, "_log" if watch is self else "log", log)

    def known(self, sensor: str) -> dict[int, Any]:
        """Return what was found so far of a sensor's records, by stamp."""
        if sensor in self.cameras:
            return dict(self.cameras[sensor].states)
        return dict(self.lidars[sensor].repeated) if sensor in self.lidars else {}

    def judge(self, look: Look) -> str:
        """Return the state of a record, which is judged if it was not yet; records of a sensor come in the order of their stamps."""
        if isinstance(look.shown, SweepSketch):
            return "repeated" if self.lidars[look.sensor].is_repeated(look.t_ns, look.shown) else "live"
        camera = self.cameras[look.sensor]
        if look.shown is None:
            # A picture that was not looked at is as the one before it.
            return camera.states.setdefault(look.t_ns, next(reversed(camera.states.values()), "live"))
        return camera.judge(look.t_ns, look.shown, found=look.found)

    def is_live(self, camera: str, t_ns: int, image: NDArray[np.uint8]) -> bool:
        """Return whether a picture (H, W, 3) shows what is there, as it was judged before, or else now."""
        known = self.cameras[camera].states.get(t_ns)
        return (known or self.cameras[camera].judge(t_ns, shrink(image))) == "live"

    def faults(self, sensors: Iterable[str], start_ns: int, end_ns: int) -> tuple[Finding, ...]:
        """List what was found, one for each span of each sensor, and what is missing of some sensors between two stamps."""
        found: list[Finding] = []

        def add(kind: str, name: str, t_ns: NDArray[np.int64], rows: NDArray[np.intp], **more: Any) -> None:
            start_s, end_s = ((t_ns[rows[[0, -1]]] - start_ns) / NS_PER_S).tolist()
            values = {"count": float(len(rows)), "total": float(rows[-1] - rows[0] + 1)} | more.get("values", {})
            treatment: Treatment = "kept" if kind == "sparse_sweeps" else "left_out"
            found.append(Finding(kind, name, treatment, start_s, end_s, values, case=more.get("case", "")))

        for camera in self.cameras.values():
            t_ns = np.array(sorted(camera.states), dtype=np.int64)
            states = np.array([camera.states[t] for t in t_ns.tolist()])
            for kind, state in (("frozen_images", "frozen"), ("black_images", "black")):
                for rows in _spans(t_ns, states == state):
                    add(kind, camera.name, t_ns, rows)
        for lidar in (lidar for lidar in self.lidars.values() if lidar.points):
            t_ns = np.array(sorted(lidar.points), dtype=np.int64)
            repeated, points = (np.array([of[t] for t in t_ns.tolist()]) for of in (lidar.repeated, lidar.points))
            for rows in _spans(t_ns, repeated):
                add("repeated_sweeps", lidar.name, t_ns, rows)
            usual = float(np.quantile(points, USUAL_QUANTILE))
            some = usual >= MIN_USUAL_POINTS
            for rows in _spans(t_ns, points < MAX_SPARSE_SHARE * usual) if some else [np.arange(len(t_ns))]:
                values = {"most_points": float(points[rows].max())} | ({"usual_points": usual} if some else {})
                add("sparse_sweeps", lidar.name, t_ns, rows, values=values, case="some" if some else "all")
        for name in sensors:
            t_ns = self._log.streams[name].t_ns
            if len(t_ns) < MIN_STAMPS:
                continue
            around = np.concatenate([[start_ns], t_ns[(t_ns > start_ns) & (t_ns < end_ns)], [end_ns]])
            shortest_ns = max(MIN_GAP_PERIODS * float(np.median(np.diff(t_ns))), MIN_GAP_S * NS_PER_S)
            gaps = np.flatnonzero(np.diff(around) > shortest_ns)
            for rows in [gaps] if len(gaps) > MAX_SPANS else gaps[:, None]:
                start_s, end_s = ((around[[rows[0], rows[-1] + 1]] - start_ns) / NS_PER_S).tolist()
                values = {"gaps": float(len(rows)), "longest_s": float(np.diff(around)[rows].max()) / NS_PER_S}
                kind = "missing_images" if name in self.cameras else "missing_sweeps"
                found.append(Finding(kind, name, "kept", start_s, end_s, values))
        return tuple(found)


# A picture is shrunk where it is wider than asked for by more than this: less is not worth the time.
MAX_OVERSIZE = 4 / 3


class RecordSource:
    """The records of a log: the one door to them for all stages, which counts those that cannot be read and judges what they show.

    `log`: an opened log keeps the sweeps that were read last, so that stages which look at the same ones share them.
    `watch`: which records repeat others or show nothing, also as stages before found it.

    `read`: how many records of each stream were read. `failed`: messages of the records that could not be read, by stream.
    `looks`: dict of (str, int) to Look: what was judged, by sensor and stamp, in this order.
    """

    def __init__(self, log: Log, watch: RecordWatch | None = None) -> None:
        self.log = log
        self.read = Counter[str]()
        self.failed: dict[str, list[str]] = {}
        self.watch = RecordWatch(log) if watch is None else watch
        self.looks: dict[tuple[str, int], Look] = {}

    def of(self, log: Log) -> RecordSource:
        """Return the source of the same records in a log with other poses or mounts, which counts and judges along with this one."""
        other = copy(self)
        other.log = log
        return other

    def require(self, stream: str, index: int) -> Any:
        """Read a record: a picture (H, W, 3) uint8 BGR, or a `Sweep`; raise `RecordError` when it cannot be read."""
        try:
            record = self.log.streams[stream].read(index)
            if isinstance(record, Sweep) and not len(record.xyz_m):
                raise RecordError(f"sweep at stamp {record.stamp_ns} has no finite point")
        except RecordError as error:
            self.add({}, {stream: [str(error)]})
            raise
        self.read[stream] += 1
        return record

    def get(self, stream: str, index: int) -> Any | None:
        """Read a record; None when it cannot be read."""
        try:
            return self.require(stream, index)
        except RecordError:
            return None

    def picture(self, camera: str, index: int, least_px: int, *, gray: bool = False) -> NDArray[np.uint8] | None:
        """Read a picture at a width, px, from a least one to a third more, if it is wider: (H, W, 3) BGR or (H, W); None if it cannot be.

        A JPEG is decoded at that size, in two thirds of the time of the whole.
        """
        image: NDArray[np.uint8] | None = None
        stream = self.log.streams[camera]
        width_px, height_px = self.log.cameras[camera].width_px, self.log.cameras[camera].height_px
        if stream.encoded is not None and (gray or least_px < width_px):
            with suppress(RecordError):  # which is told when it is read whole
                file = stream.encoded(index)
                image = decode_image(file, camera, (width_px, height_px), least_px=least_px, gray=gray)
                self.read[camera] += 1
        if image is None:
            image = self.get(camera, index)
            if image is None:
                return None
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8) if gray else image
        scale = least_px / image.shape[1]
        if scale < 1 / MAX_OVERSIZE:
            image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        return image

    def add(self, read: Mapping[str, int], failed: Mapping[str, Sequence[str]]) -> None:
        """Add what another source of the log counted; a record that was requested again failed again."""
        self.read.update(read)
        for stream, problems in failed.items():
            known = self.failed.setdefault(stream, [])
            known += [problem for problem in problems if problem not in known]

    def is_live(self, sensor: str, index: int, shown: Thumbnail | SweepSketch | None, *, found: bool = False) -> bool:
        """Judge a record by what is kept of it: whether it shows what is there."""
        look = Look(sensor, int(self.log.streams[sensor].t_ns[index]), shown, found, "")
        state = self.watch.judge(look)
        self.looks[sensor, look.t_ns] = replace(look, state=state)
        return state == "live"

    def require_some(self) -> None:
        """Raise `LogError` for a stream of which records were requested and none could be read."""
        for stream, problems in self.failed.items():
            if not self.read.get(stream):
                raise LogError(
                    f"stream '{stream}': none of the {len(problems)} records asked for can be read, "
                    f"the first because {problems[0]}. Mend or remove the stream; `log2sim validate` lists all problems"
                )

    def summary(self) -> dict[str, Any]:
        """Summarize the unreadable records for the report: count and first message by stream."""
        return {s: {"count": len(p), "first": p[0]} for s, p in sorted(self.failed.items())}
