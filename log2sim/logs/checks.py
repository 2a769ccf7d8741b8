"""Checks of stamps, calibrations and labels of a whole log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels, Log
from log2sim.geometry import NS_PER_S, Camera, fold_radius, nearest_index, undistort
from log2sim.logs.excerpt import MAX_LABEL_DISTANCE_NS, STAMP_TOLERANCE_NS, reference_of
from log2sim.logs.records import MAX_POSITION_M

# As a scenario may state; a freight train is not longer.
MAX_SIZE_M = 1000.0


def find_possible(labels: Labels) -> NDArray[np.bool_]:
    """Mark (L,) the boxes of finite numbers that have a size and are on Earth."""
    sized = ((labels.size_m > 0) & (labels.size_m <= MAX_SIZE_M)).all(axis=1)
    return np.asarray(sized & (np.abs(labels.center_m) <= MAX_POSITION_M).all(axis=1) & np.isfinite(labels.yaw_rad))


def drop_impossible_labels(log: Log) -> Log:
    """Return the log without labels that no object can have.

    They are read when they are asked for; only then a note tells how many were left out.
    """
    left_out: list[int] = []

    def labels() -> Labels | None:
        given = log.labels
        possible = None if given is None else find_possible(given)
        left_out[:] = [0 if possible is None else int((~possible).sum())]
        return given if given is None or possible is None or possible.all() else given.take(possible)

    def notes() -> tuple[str, ...]:
        count = sum(left_out)
        words = f"{count} label{'s' * (count != 1)} left out: no object is so large or so far away, or it has no size"
        return (*log.notes, words) if count else log.notes

    return log.changed(labels=labels, notes=notes)


# In image widths: a field of view of 136 degrees without distortion, and lenses for photographs of the moon.
MIN_FOCAL_WIDTHS, MAX_FOCAL_WIDTHS = 0.2, 20.0
# Of the width and height, from an edge to the principal point: lenses are mounted over the middle of the sensor, and a crop that keeps
# less beside the axis is rare. A unit of image widths instead of px puts it into a corner.
MIN_PRINCIPAL_SHARE = 0.1
# No lens without distortion sees farther off its axis; a pixel beyond shows nothing.
MAX_RAY_DEGREES = 80.0
# Longer than any road vehicle with its trailers.
MAX_MOUNT_DISTANCE_M = 100.0
# Corners of wide lenses lie outside of the circle that the lens draws, where nothing keeps a fitted polynomial from folding.
MAX_FOLD_DEGREES = 70.0
# Fits of rational models reach thousands; the roots of much larger ones are not finite.
MAX_DISTORTION = 1e6
MAX_FOLDED_SHARE, MAX_USABLE_FOLDED_SHARE = 0.01, 0.5
GRID = 32


def list_calibration_problems(log: Log) -> list[str]:
    """List what is wrong with the calibrations of a log, one line each."""
    return [message for name in log.streams for message, _ in problems_of(log, name)]


def problems_of(log: Log, name: str) -> Iterator[tuple[str, bool]]:
    """Find values in the calibration of a sensor that none, or hardly one, can have.

    Yields a message, which names the sensor, where its calibration is, the field and its value, and whether nothing that is
    measured with it can be right; else it is only doubtful.
    """
    place = log.calibrations.get(name, log.name)
    camera = log.cameras.get(name)
    if camera is not None:
        where = f"{place}, camera '{name}'"
        yield from _pinhole(camera, where)
        yield from _distortion(camera, where)
        mount, mount_T_sensor = camera.mount, camera.mount_T_cam
    elif name in log.lidars:
        where, mount = f"{place}, LiDAR '{name}'", log.lidars[name].mount
        mount_T_sensor = log.lidars[name].mount_T_lidar
    else:
        return
    distance_m = float(np.linalg.norm(mount_T_sensor[:3, 3]))
    if mount == "ego" and not distance_m <= MAX_MOUNT_DISTANCE_M:
        x, y, z = mount_T_sensor[:3, 3].tolist()
        is_at = f"its mounting is {distance_m:.6g} m from the ego, at ({x:.6g}, {y:.6g}, {z:.6g}) m"
        expected = f"expected at most {MAX_MOUNT_DISTANCE_M:g} m, so check its unit and its frame"
        yield f"{where}: {is_at}; {expected}", True


def _pinhole(camera: Camera, where: str) -> Iterator[tuple[str, bool]]:
    for field, value_px in (("fx", camera.K[0, 0]), ("fy", camera.K[1, 1])):
        widths = float(value_px) / camera.width_px
        if not MIN_FOCAL_WIDTHS <= widths <= MAX_FOCAL_WIDTHS:
            expected = f"expected {MIN_FOCAL_WIDTHS:g} to {MAX_FOCAL_WIDTHS:g}, so check its unit and the image size"
            yield f"{where}: its focal length {field} is {value_px:.6g} px, {widths:.3g} image widths; {expected}", True
    limit = np.tan(np.radians(MAX_RAY_DEGREES))
    for field, axis, size_px in (("cx", 0, camera.width_px), ("cy", 1, camera.height_px)):
        value_px = float(camera.K[axis, 2])
        outside_px = max(-value_px, value_px - size_px, 0.0)
        inside = "beside the edge" if outside_px == 0.0 else f"{outside_px:.6g} px outside"
        # Fails for a value that is not a number.
        if not MIN_PRINCIPAL_SHARE <= value_px / size_px <= 1.0 - MIN_PRINCIPAL_SHARE:
            of = f"of images of {camera.width_px}x{camera.height_px} px"
            advice = "check its unit, and whether the images are cropped or scaled"
            is_impossible = bool(not outside_px <= limit * camera.K[axis, axis])
            yield f"{where}: its principal point {field} is {value_px:.6g} px, {inside} {of}; {advice}", is_impossible


def _distortion(camera: Camera, where: str) -> Iterator[tuple[str, bool]]:
    wrong = [value for value in camera.distortion if not abs(value) <= MAX_DISTORTION]
    if wrong:
        expected = f"expected numbers up to {MAX_DISTORTION:g}"
        yield f"{where}: its distortion has the coefficient {wrong[0]:.6g}, {expected}", True
    fold_deg = 90.0 if wrong or camera.rectified else float(np.degrees(np.arctan(fold_radius(camera))))
    if not fold_deg < MAX_FOLD_DEGREES:
        return
    u, v = ((np.arange(GRID) + 0.5) * size / GRID for size in (camera.width_px, camera.height_px))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    share = float(np.isnan(undistort(camera, pixels)).any(axis=1).mean())
    if share > MAX_FOLDED_SHARE:
        values = ", ".join(f"{value:.6g}" for value in camera.distortion)
        folds = f"folds the image at {fold_deg:.0f} degrees off the axis: {100 * share:.0f} % of the pixels have no ray"
        advice = "check the order and signs of the coefficients"
        message = f"{where}: its distortion ({camera.distortion_model}: {values}) {folds}; {advice}"
        yield message, share > MAX_USABLE_FOLDED_SHARE


# Streams of a second that has no record of another may still belong together: a log may hold one frame and one sweep.
MAX_APART_NS = NS_PER_S
# A run that is shorter than the log by less is worth no line: sensors start one after the other.
MIN_MISSING_NS = NS_PER_S
MIN_MISSING_SHARE = 0.01
# Both ends of a stream are off alike when they differ by no more than this share of the offset.
MAX_END_MISMATCH = 0.2
MAX_NAMES = 3
# The first Unix time with ten digits is of 2001; recordings that count from their start last no year.
MIN_UNIX_S, MAX_RELATIVE_S = 1e9, 3e7
SECONDS_OF_ZONES = 900
MAX_ZONE_S = 14 * 3600
# Seconds between clocks: leap seconds since 2017 (IERS Bulletin C 52 and later), epochs of GPS (1980) and NTP (1900) to Unix.
CLOCKS_S = {
    18: "GPS time against UTC",
    37: "TAI against UTC",
    19: "TAI against GPS time",
    315_964_800: "seconds since 1980, as of GPS, against Unix time",
    315_964_782: "seconds since 1980, as of GPS, against Unix time",
    2_208_988_800: "seconds since 1900, as of NTP, against Unix time",
}
UNITS = {10**3: "units that differ by 1000, such as ms and us", 10**6: "ms against ns", 10**9: "s against ns"}


@dataclass(frozen=True)
class Span:
    """First and last stamp of something."""

    words: str  # what it is, such as "ego poses"
    first_ns: int
    last_ns: int

    @classmethod
    def of(cls, words: str, t_ns: NDArray[np.int64]) -> Span:
        """Return the span of stamps (N,), at least one of them."""
        return cls(words, int(t_ns.min()), int(t_ns.max()))

    def is_apart(self, other: Span, distance_ns: int = MAX_APART_NS) -> bool:
        """Whether more than a distance lies between two spans."""
        return max(self.first_ns, other.first_ns) - min(self.last_ns, other.last_ns) > distance_ns


def list_time_problems(log: Log) -> list[str]:
    """List what is wrong with the stamps of a log, one line each; only stamps are read, and the labels."""
    # Report boxes in images, and regions without labels, whose stamp no frame has
    problems = []
    for what, by_camera in (("boxes", log.image_labels), ("ignored regions", log.ignored_regions)):
        for name, rows in by_camera.items():
            stream = log.streams.get(name)
            if stream is None or not len(rows.t_ns) or not len(stream.t_ns):
                continue
            frames = stream.t_ns
            off_ns = np.abs((frames[nearest_index(frames, rows.t_ns)] - rows.t_ns).astype(np.float64))
            lost = off_ns > STAMP_TOLERANCE_NS
            if not lost.any():
                continue
            line = f"{int(lost.sum())} of {len(lost)} {what} in images of '{name}' are at stamps of no frame, first {rows.t_ns[lost].min()}"
            spans = Span.of(what, rows.t_ns), Span.of("frames", frames)
            apart = f": {describe_gap(*spans)}" if spans[0].is_apart(spans[1]) else ""
            nearest = "" if apart or not lost.all() else f"; the nearest is {off_ns.min() / 1e6:.3g} ms off"
            problems.append(f"{line}{nearest}{apart}")
    return [*_other_clocks(log), *_reference_problem(log), *problems, *_label_problems(log)]


def describe_gap(one: Span, other: Span) -> str:
    """Say that two spans do not overlap, by how much, and which clocks would explain it."""

    def shown(t_ns: int) -> str:  # in s with ms, exactly
        sign, t_ms = "-" * (t_ns < 0), abs(t_ns) // 10**6
        return f"{sign}{t_ms // 1000}.{t_ms % 1000:03d}"

    hint = _explain(one, other)
    first, second = (f"{shown(span.first_ns)} to {shown(span.last_ns)} s" for span in (one, other))
    difference = f"{abs(one.first_ns - other.first_ns) / NS_PER_S:.6g} s{f': {hint}?' * bool(hint)}"
    return f"the {one.words} are from {first}, the {other.words} from {second}: they do not overlap (the difference is {difference})"


def _explain(one: Span, other: Span) -> str:
    """Name the usual mistake that would put two spans apart as they are; "" without one."""
    early, late = sorted((one, other), key=lambda span: span.first_ns)
    for factor, words in UNITS.items():
        if early.first_ns > 0 and abs(late.first_ns / (early.first_ns * factor) - 1) < 1e-3:
            return words
    if abs(early.first_ns) < MAX_RELATIVE_S * NS_PER_S and late.first_ns > MIN_UNIX_S * NS_PER_S:
        return "one counts from its start, the other is Unix time"
    difference_s = (late.first_ns - early.first_ns) / NS_PER_S
    offsets = dict(CLOCKS_S)
    zone_s = round(difference_s / SECONDS_OF_ZONES) * SECONDS_OF_ZONES
    if 0 < zone_s <= MAX_ZONE_S:
        offsets[zone_s] = f"{zone_s / 3600:g} h, a time zone"
    # By the distances of both ends when the later span is moved by an offset.
    moved = {s: (late.first_ns - s * NS_PER_S, late.last_ns - s * NS_PER_S) for s in offsets}
    misfit = {s: abs(first - early.first_ns) + abs(last - early.last_ns) for s, (first, last) in moved.items()}
    best = min(misfit, key=lambda seconds: misfit[seconds])
    length_ns = min(early.last_ns - early.first_ns, late.last_ns - late.first_ns)
    return offsets[best] if misfit[best] <= max(length_ns, MAX_APART_NS) else ""


def _other_clocks(log: Log) -> list[str]:
    """Report streams and poses whose times are far from those of most others."""
    found = [
        Span.of(f"{'frames' if name in log.cameras else 'sweeps'} of '{name}'", stream.t_ns)
        for name, stream in log.streams.items()
        if len(stream.t_ns)
    ]
    found += [] if log.ego is None else [Span.of("ego poses", log.ego.t_ns)]
    groups: list[tuple[list[str], Span]] = []
    for span in sorted(found, key=lambda span: span.first_ns):
        if groups and not groups[-1][1].is_apart(span):
            words, joined = groups.pop()
            ends = min(joined.first_ns, span.first_ns), max(joined.last_ns, span.last_ns)
            groups.append(([*words, span.words], Span("", *ends)))
        else:
            groups.append(([span.words], span))
    spans = []
    for words, span in groups:
        more = len(words) - MAX_NAMES
        rest = f" and {more} other stream{'s' * (more > 1)}" if more > 0 else ""
        spans.append(replace(span, words=", ".join(words[:MAX_NAMES]) + rest))
    most = max(range(len(groups)), key=lambda k: len(groups[k][0]), default=0)
    return [describe_gap(span, spans[most]) for k, span in enumerate(spans) if k != most]


def _reference_problem(log: Log) -> list[str]:
    """Report when the sensor whose records are the ticks begins late or ends early, since a run lasts as long as it does."""
    spans = {name: Span.of(name, s.t_ns) for name, s in log.streams.items() if len(s.t_ns)}
    reference = reference_of(log, [name for name in log.cameras if name in spans]) if spans else ""
    own = spans.pop(reference, None)
    if own is None or not spans:
        return []
    late_ns = np.array([own.first_ns - span.first_ns for span in spans.values()])
    early_ns = np.array([span.last_ns - own.last_ns for span in spans.values()])
    begin_ns, end_ns = max(int(late_ns.max()), 0), max(int(early_ns.max()), 0)
    length_ns = own.last_ns - own.first_ns
    whole_ns = length_ns + begin_ns + end_ns
    least_ns = max(MIN_MISSING_NS, MIN_MISSING_SHARE * whole_ns)
    parts = [
        f"{verb} {gap_ns / NS_PER_S:.1f} s {word}"
        for verb, word, gap_ns, gaps_ns in (
            ("begins", "after", begin_ns, late_ns),
            ("ends", "before", end_ns, early_ns),
        )
        if gap_ns >= least_ns and (gaps_ns >= least_ns).sum() * 2 >= len(spans)
    ]
    if not parts:
        return []
    # Off the others by the same time at both ends, as by another clock.
    first_ns = own.first_ns - int(np.median([span.first_ns for span in spans.values()]))
    last_ns = own.last_ns - int(np.median([span.last_ns for span in spans.values()]))
    least, shifted = min(abs(first_ns), abs(last_ns)), ""
    if least >= MIN_MISSING_NS and abs(first_ns - last_ns) <= MAX_END_MISMATCH * least:
        word = "late" if first_ns > 0 else "early"
        shifted = f" (both its ends are {abs(first_ns) / NS_PER_S:.1f} s {word}, as by another clock)"
    kind = "camera" if reference in log.cameras else "LiDAR"
    return [
        f"the reference {kind} '{reference}' {' and '.join(parts)} other sensors{shifted}: a run of its ticks lasts "
        f"{length_ns / NS_PER_S:.1f} s of the {whole_ns / NS_PER_S:.1f} s of the log"
    ]


def _label_problems(log: Log) -> list[str]:
    """Report 3D labels far from all records and poses; where records are missing, as in a partial download, poses suffice."""
    records = [stream.t_ns for stream in log.streams.values() if len(stream.t_ns)]
    if log.labels is None or not len(log.labels.t_ns) or not records:
        return []
    t_ns = log.labels.t_ns
    known = np.unique(np.concatenate([*records, *([] if log.ego is None else [log.ego.t_ns])]))
    far = np.abs((known[nearest_index(known, t_ns)] - t_ns).astype(np.float64)) > MAX_LABEL_DISTANCE_NS
    if not far.any():
        return []
    line = (
        f"{int(far.sum())} of {len(far)} labeled boxes are more than {MAX_LABEL_DISTANCE_NS / NS_PER_S:g} s off all frames, sweeps and "
        f"poses, first at stamp {t_ns[far].min()}"
    )
    spans = Span.of("labels", t_ns), Span.of("records", np.concatenate(records))
    return [f"{line}: {describe_gap(*spans)}" if spans[0].is_apart(spans[1]) else line]
