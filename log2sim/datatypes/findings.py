"""What is doubtful or wrong in a run, of agents, sensors, clocks, mounts, poses and records, and the sentence of each kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

Treatment = Literal["left_out", "corrected", "kept"]


class Kind(NamedTuple):
    """The sentence of a kind of findings, and which numbers it carries."""

    # Format of the numbers and of `other`, `when`, `done`; where the kind has several cases, one for each.
    words: str | Mapping[str, str]
    numbers: tuple[str, ...] = ()  # with units; `at_s`: when it is worst, which the sentence ends with
    option: str = ""  # of the command line, which corrects it


FIX = "--fix-calibration"
SPAN, TURN = ("count", "total"), ("yaw_deg", "yaw_sigma_deg")
ROTATION = tuple(f"{name}{unit}" for name in ("roll", "pitch", "yaw") for unit in ("_deg", "_sigma_deg"))
TRANSLATION = tuple(f"{name}{unit}" for name in "xyz" for unit in ("_m", "_sigma_m"))
ROAD_POSE = (*TRANSLATION, *ROTATION, "delay_s", "delay_sigma_s", "shift_m", "turn_deg", "points", "pairs")
REPAIR = ("shift_m", "turn_rad", "sigma_m", "duration_s", "unknown_s", "poses")
UNKNOWN = "; for {unknown_s:.1f} s of it the pose is not known, and what was recorded then is left out"
FITS, NOT_OWN = "edges that the LiDAR sees fit its images with", "and not with its own; {done}"
OFF_OTHERS = (
    "the poses {when} are off the others by {shift_m:.1f} m and {turn_deg:.1f} degrees, which no vehicle "
    "moves so fast: they are moved to the others"
)
STAYS = "the pose stays {when} while the ego moves on by up to {shift_m:.1f} m: {other} bridges it"
BY_MOTION = (
    "its mount in the calibration is turned by roll {roll_deg:+.2f}, pitch {pitch_deg:+.2f}, yaw "
    "{yaw_deg:+.2f} degrees (sigma {roll_sigma_deg:.2f}, {pitch_sigma_deg:.2f}, {yaw_sigma_deg:.2f}) against the "
    "motion of the ego"
)
BY_EDGES = (
    "its mount in the calibration is turned by yaw {yaw_deg:+.2f} degrees (sigma {yaw_sigma_deg:.2f}) "
    "against edges that {other} sees too"
)
OFF_MAP = (
    "the pose of its pole is {shift_m:.2f} m and {turn_deg:.1f} degrees off the ego's map (sigma "
    "{x_sigma_m:.2f}, {y_sigma_m:.2f} m, {yaw_sigma_deg:.2f} degrees of yaw), by {points:.0f} points on surfaces and "
    "{pairs:.0f} common road users; "
)

AGENT_KINDS: Mapping[str, Kind] = {
    "acceleration": Kind("accelerates at {most_mps2:.0f} m/s2", ("most_mps2", "at_s")),
    "lateral_acceleration": Kind("accelerates sideways at {most_mps2:.0f} m/s2", ("most_mps2", "at_s")),
    "curvature": Kind("turns on a circle of {radius_m:.1f} m", ("radius_m", "at_s")),
    "jerk": Kind("jerks at {most_mps3:.0f} m/s3", ("most_mps3", "at_s")),
    "speed": Kind("moves at {most_mps:.0f} m/s {when}", ("most_mps",)),
    "reversing": Kind("reverses at up to {most_mps:.1f} m/s {when}", ("most_mps",)),
    "sideways": Kind("slides across its length {when}"),
    "jump": Kind("measured up to {residual_m:.1f} m off its path {when}", ("residual_m",)),
    "passes_through": Kind({"": "passes through {other}", "static": "stands in {other}"}, ("at_s",)),
    "in_ego": Kind("touches the ego", ("at_s",)),
    "empty": Kind("{through_share:.0%} of the LiDAR's rays pass through its place", ("through_share",)),
    "hardly_observed": Kind("LiDAR rays go toward it and it has no points"),
    "unlikely_size": Kind("is longer than the {limit_m:.1f} m of the longest {other}", ("limit_m",)),
    "heading_ambiguous": Kind("front and back may be swapped"),
}
"""The kinds that speak against an agent; a scenario file calls them flags."""

SENSOR_KINDS: Mapping[str, Kind] = {
    "frozen_images": Kind("pictures repeat an earlier one: {count:.0f} of {total:.0f} {when}; they are not used", SPAN),
    "black_images": Kind(
        "pictures show nothing (black, covered, of one color): {count:.0f} of {total:.0f} {when}; they are not used",
        SPAN,
    ),
    "missing_images": Kind(
        "no pictures {when} (gaps: {gaps:.0f}, the longest of {longest_s:.2f} s)", ("gaps", "longest_s")
    ),
    "repeated_sweeps": Kind("sweeps repeat an earlier one: {count:.0f} of {total:.0f} {when}; they are not used", SPAN),
    "missing_sweeps": Kind(
        "no sweeps {when} (gaps: {gaps:.0f}, the longest of {longest_s:.2f} s)", ("gaps", "longest_s")
    ),
    "sparse_sweeps": Kind(
        {
            "some": "sweeps have at most {most_points:.0f} points where {usual_points:.0f} are usual: "
            "{count:.0f} of {total:.0f} {when}",
            "all": "sweeps have next to no points, at most {most_points:.0f}",
        },
        (*SPAN, "most_points", "usual_points"),
    ),
    "pose_jump": Kind(
        {
            "kept": "the position steps by {shift_m:.1f} m {when}, farther than a vehicle moves: it jumped, or the stamps miss "
            "some time, which does not show; used as it is",
            "corrected": OFF_OTHERS,
            "left_out": OFF_OTHERS + UNKNOWN,
        },
        REPAIR,
    ),
    "frozen_poses": Kind(
        {
            "copies": "{poses:.0f} poses {when} repeat the one before while the ego moves on by up to {shift_m:.1f} m, as those "
            "of a slower source do: they are not used",
            "corrected": STAYS,
            "left_out": STAYS + UNKNOWN,
        },
        REPAIR,
    ),
    "sparse_poses": Kind(
        {
            "corrected": "poses are up to {longest_s:.2f} s apart {when} (gaps: {gaps:.0f}): {other} interpolates them, to "
            "{sigma_m:.2f} m (1 sigma)",
            "left_out": "no pose {when}, too long for the motion around to bridge: what was recorded in {unknown_s:.1f} s of it is "
            "left out",
        },
        ("longest_s", "gaps", "sigma_m", "duration_s", "unknown_s"),
    ),
    "time_offset": Kind(
        "stamps are off by {offset_ms:+.0f} ms (+: late) against the poses of the ego (sigma {offset_sigma_ms:.0f} ms), by which what "
        "the sensor sees is up to {moved_m:.1f} m out of place; {done}",
        ("offset_s", "offset_sigma_s", "pose_error_m", "moved_m"),
        "--fix-time",
    ),
    "unknown_offset": Kind(
        "stamps are not corrected: the ego's motion does not show whether they are off, which takes that it speeds up, brakes or "
        "turns"
    ),
    "lidar_rotation": Kind(
        {
            "mount": BY_MOTION + "; {done}",
            "heading": BY_MOTION
            + ", or the heading of the poses is, by which the ego drives {course_deg:+.2f} degrees off its own "
            "axis; {done}",
            "edges": "its mount in the calibration is turned by yaw {yaw_deg:+.2f} degrees (sigma {yaw_sigma_deg:.2f}) against "
            "edges that {other} see too, all of them alike, so that they are what is turned to fit; {done}",
        },
        (*ROTATION, "course_deg", "pose_error_m"),
        FIX,
    ),
    "lidar_translation": Kind(
        "its mount in the calibration, or the ego's origin, is {x_m:+.2f} m too far forward, {y_m:+.2f} m left, {z_m:+.2f} m up "
        "(sigma {x_sigma_m:.2f}, {y_sigma_m:.2f}, {z_sigma_m:.2f}) by how the ego turns; {done}",
        TRANSLATION,
        FIX,
    ),
    "unknown_rotation": Kind(
        {
            "motion": "the mount is not corrected: the ego's motion does not show whether it is turned",
            "edges": "the mount is not corrected: the edges that {other} sees do not show whether it is turned",
        }
    ),
    "camera_rotation": Kind(
        {"camera": BY_EDGES + "; {done}", "either": BY_EDGES + ", or the mount of {other} is; {done}"}, TURN, FIX
    ),
    "swapped_cameras": Kind(
        {
            "edges": "sees {other}'s points: " + FITS + " the mount of {other} " + NOT_OWN,
            "exchanged": "its mount is that of {other}, whose images fit edges that the LiDAR sees with it " + NOT_OWN,
            "flow": "sees {other}'s points: they move in its images as with the mount of {other} and against its own; {done}",
        },
        (),
        FIX,
    ),
    "wrong_mount": Kind(
        {
            "inverted": "its mount in the calibration is inverted: " + FITS + " the inverse " + NOT_OWN,
            "turned": "its images are turned by {turn_deg:.0f} degrees: "
            + FITS
            + " its mount turned about the optical axis "
            + NOT_OWN,
        },
        ("turn_deg",),
        FIX,
    ),
    "road_pose": Kind(
        {"all": OFF_MAP + "corrected", "height_and_tilt": OFF_MAP + "its height and tilt are corrected"}, ROAD_POSE
    ),
    "road_clock": Kind(
        "the stamps of its pole are off by {delay_ms:+.0f} ms (+: late) against the ego's clock (sigma {delay_sigma_ms:.0f} ms), by "
        "road users that both ends see move; corrected",
        ROAD_POSE,
    ),
    "unknown_road_pose": Kind(
        "its place in the plane is known no better than to a sigma of {x_sigma_m:.2f}, {y_sigma_m:.2f} m and {yaw_sigma_deg:.1f} degrees "
        "of yaw: the vehicle sees too little of what it sees",
        ROAD_POSE,
    ),
    "unknown_road_clock": Kind(
        "its clock is known no better than to a sigma of {delay_sigma_ms:.0f} ms against the ego's: both ends see too little that moves",
        ROAD_POSE,
    ),
    "wrong_road_pose": Kind(
        "its pose cannot be trusted: the vehicle saw through {through_share:.0%} of the upright surfaces that it sees, and no pose "
        "within 0.5 m and 2 degrees makes both fit; left out",
        ("through_share",),
    ),
}
"""The kinds that concern a sensor, its clock or mount, or the ego's poses: the faults of a report."""

RUN_KINDS: Mapping[str, Kind] = {
    "planar_motion": Kind("camera motion is planar, and some percent of its path may be wrong"),
    "predicted_poses": Kind("{other}: {count:.0f} of {total:.0f} poses are predicted", SPAN),
    "degenerate_sweeps": Kind(
        "LiDAR odometry: {count:.0f} of {total:.0f} sweeps show too little that holds one direction of motion", SPAN
    ),
    "sweeps_without_pose": Kind("LiDAR odometry: sweeps that gave no pose: {other}"),
    "moved_ego": Kind("sensors fixed in the map stay there, labels move with the ego: they may not fit to each other"),
    "unreadable": Kind("{count:.0f} records could not be read, first: {other}", ("count",)),
    "frames_without_pose": Kind("{count:.0f} frames skipped, since no ego pose is known at their stamps", ("count",)),
    "not_cached": Kind("the first pass is not kept for later runs: {other}"),
}
"""The kinds that concern estimated poses, records and the cache, which a report has in places of their own."""

KINDS: Mapping[str, Kind] = {**AGENT_KINDS, **SENSOR_KINDS, **RUN_KINDS}


@dataclass(frozen=True)
class Finding:
    """Something that is doubtful or wrong in a run."""

    kind: str  # one of `KINDS`; of a file, any
    subject: str = ""  # camera or LiDAR, "ego" for poses, "cache"; empty for an agent, which holds its findings itself
    # Whether the run does not use the records or poses in question, uses corrected ones, or uses them as they are
    treatment: Treatment = "kept"
    start_s: float | None = None  # when it holds; None for the whole log or the whole life of an agent
    end_s: float | None = None
    values: Mapping[str, float] = field(default_factory=dict, hash=False)  # numbers of the kind, by name with unit
    other: str = ""  # what the subject was compared with, such as the agent that it passes through
    case: str = ""  # which sentence of its kind fits; without, that of its treatment
    text: str | None = None  # the sentence, of a file, which does not hold what it is made of

    def __post_init__(self) -> None:
        """Refuse numbers that its kind does not name, and an unknown kind without a sentence; `ValueError`."""
        if self.text is None and (self.kind not in KINDS or set(self.values) - set(KINDS[self.kind].numbers)):
            wrong = "no such kind, or it has no such numbers"
            raise ValueError(f"finding '{self.kind}' with {sorted(self.values)}: {wrong}")

    def __str__(self) -> str:
        """Return subject and sentence."""
        return f"{self.subject}: {self.sentence}" if self.subject else self.sentence

    @property
    def sentence(self) -> str:
        """One line for people: what was found, when, and what was done about it."""
        if self.text is not None:
            return self.text
        kind, values, digits = KINDS[self.kind], self.values, 2 if self.subject else 1
        words = kind.words if isinstance(kind.words, str) else kind.words.get(self.case) or kind.words[self.treatment]
        done = {
            "corrected": "corrected",
            "left_out": f"not used, unless {kind.option} corrects it",
            "kept": f"not corrected, which {kind.option} does",
        }
        as_read = {f"{name[:-1]}ms": 1e3 * value for name, value in values.items() if name.endswith("_s")}
        as_read |= {f"{name[:-3]}deg": float(np.degrees(v)) for name, v in values.items() if name.endswith("_rad")}
        first, last = (f"{max(t_s or 0.0, 0.0):.{digits}f}" for t_s in (self.start_s, self.end_s))
        when = f"at {first} s" if first == last else f"from {first} to {last} s"
        at = f" at {values['at_s']:.1f} s" if "at_s" in values else ""
        return words.format(**as_read, **values, other=self.other, when=when, done=done[self.treatment]) + at

    def holds(self, t_s: Array) -> NDArray[np.bool_]:
        """Return whether it holds at times (T,)."""
        start = -np.inf if self.start_s is None else self.start_s
        end = np.inf if self.end_s is None else self.end_s
        return np.asarray((t_s >= start) & (t_s <= end))

    def retimed(self, change: Callable[[float], float]) -> Finding:
        """Return the finding of a trajectory whose times are put elsewhere by `change`, s to s; a sentence of a file stays."""
        start_s, end_s = (None if t_s is None else change(t_s) for t_s in (self.start_s, self.end_s))
        at = {name: change(self.values[name]) for name in ("at_s",) if name in self.values}
        return replace(self, start_s=start_s, end_s=end_s, values={**self.values, **at})

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of `schemas/report-1.json` `faults`; of an agent, that of its doubts in `schemas/scenario-1.json`."""
        during = {"start_s": self.start_s, "end_s": self.end_s}
        if not self.subject:
            return {"flag": self.kind, "reason": self.sentence, **during}
        about = {"kind": self.kind, "sensor": self.subject, "message": self.sentence, "treatment": self.treatment}
        return {**about, **during, "values": dict(self.values)}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Finding:
        """Read the doubt of an agent that keeps the schema."""
        return cls(entry["flag"], start_s=entry.get("start_s"), end_s=entry.get("end_s"), text=entry["reason"])
