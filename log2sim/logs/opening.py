"""Open a folder or a file of recorded data as a `Log` with the reader of its format, and read all of it to list its problems."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np

from log2sim.datatypes import Log, Sweep
from log2sim.errors import ConfigError, Log2SimError, LogError, PluginError, RecordError
from log2sim.files import plugins
from log2sim.files.inputs import following_links, follows_links
from log2sim.logs.checks import drop_impossible_labels, list_calibration_problems, list_time_problems
from log2sim.logs.excerpt import summarize_stamps
from log2sim.logs.records import guard_log, translate_parser_errors


class Reader(Protocol):
    """Reader of one log format.

    To add a format, write a module with an object that has these members and register it: in `log2sim.files.plugins.BUILT_IN`,
    or in another distribution as an entry point of the group "log2sim.log".

    A `Log` returned by `open` fulfills this contract:

    - **Laziness.** `open` reads the index, calibration and poses. `Stream.read(i)` reads record i when it is called, from
      any thread, and raises `RecordError` when that record is broken. Where stamps or labels must be read from large
      files, they are deferred (`log2sim.datatypes.Deferred`).
    - **Poses** are kept at every stamp at which the log holds one, be it that of an image or of a sweep: `Log.ego` is the union.
      Its stamps may be 1 ns apart, so speeds are never differences of neighbors.
    - **Stamps.** All stamps are int64 nanoseconds of one clock. `Stream.t_ns` increases strictly;
      `log2sim.logs.stamps.strictly_increasing` sorts, drops repetitions and writes the notes. Fractions of seconds are
      converted with `round`, never through float32.
    - **Frames.** The map is local, x east, y north where that is known, z up, with coordinates small enough for float32
      (move whole kilometers to `MapFrame.offset_m`). The ego frame is x forward, y left, z up; its origin is below the
      middle of the rear axle, at `ground_z_ego_m` above the road. Cameras are x right, y down, z forward.
      `mount_T_sensor` takes points of the sensor to its mount, the ego or, at the roadside, the map.
    - **Sweeps.** `Sweep.stamp_ns` is the log's reference stamp, be it the start, the middle or the end of the turn. `t_ns` are the
      times at which points were measured, or None. In frame "lidar" each point is in the sensor's frame at its own time, and the
      motion of the ego is compensated downstream where there are times; with `compensated_ns` all points are in the sensor's frame
      as it was at that stamp, as data sets that compensate give them. Frame "map" is compensated too. Rows are finite, in m.
    - **Images** are (H, W, 3) uint8 BGR of the size of their calibration, never rotated. The stamp of an image is the middle of the
      exposure of its middle line where the log states it. `Camera.distortion_model` is "none" for rectified images;
      `Camera.rolling_shutter` says how lines are read. `Stream.encoded` gives the file of an image as the log holds it.
    - **Labels** are in the map frame with sizes as length, width, height, centers of boxes, categories of
      `log2sim.datatypes.CATEGORIES` and the stamp at which each object was measured, not that of the nearest frame.
      `Labels.cameras` restricts them to objects in view of these cameras.
    - **Errors.** An inconsistent log raises `LogError` that names file, record and what was expected; what the format lacks
      goes into `Log.notes`. `digest` is a SHA-256 over index and calibration and over names and sizes of the records.
    """

    @property
    def name(self) -> str:
        """Name that `--format` takes."""

    @property
    def looks_for(self) -> str:
        """What a folder of this format must contain, for messages."""

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Suffixes of files that are logs by themselves, in lower case (".bag"); none for formats that are folders."""

    def matches(self, path: Path) -> bool:
        """Return whether the folder or file is a sequence of this format or holds some, by names and magic bytes alone."""

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the sequences at `path`, sorted; one when it is itself a sequence. Never raises."""

    def open(self, path: Path, sequence: str) -> Log:
        """Open the sequence of that name."""


MAX_LISTED = 20
# From a picture to the folder of its log.
MAX_LEVELS_ABOVE = 4
MAX_FOLDERS_BELOW = 2000
"""That are looked into for logs before an error; a second's work at most."""


def open_log(
    path: Path | str,
    *,
    format: str = "auto",
    sequence: str | None = None,
    labels: Path | str | None = None,
    follow_links: bool | None = None,
) -> Log:
    """Open a log; only its index, calibration and poses are read, images and sweeps on request.

    `path`: a sequence, or a folder that holds one or several; the file itself for formats of one file, such as a ROS bag.
    `format`: name of a reader (`log2sim.files.plugins.names("log")` lists them), or "auto" to find it. `sequence`: which one of a
    root; needed only when it holds several. `labels`: file with true boxes that take the place of those of the log;
    `log2sim.logs.label_files` has the formats. `follow_links`: whether symbolic links may lead out of the log's folders; by
    default as in `log2sim.files.inputs.following_links`, else not.

    Raises `LogError` when the path is missing, no reader knows its layout, or its contents are inconsistent; `ConfigError` when the
    format is unknown, or the sequence is missing, unknown or ambiguous.
    """
    with following_links(follow_links):
        log = _open(Path(path), format, sequence)
        if labels is None:
            return log
        from log2sim.logs.label_files import replace_labels  # reads formats that the log is not of

        return replace_labels(log, Path(labels))


def _open(root: Path, format: str, sequence: str | None) -> Log:
    if not root.exists():
        raise LogError(f"{root}: no such folder; give the folder of a log, or its file")
    # Once: each asks which distributions are installed.
    readers, defects = _usable_readers() if format == "auto" else ({}, [])
    name = format if format != "auto" else _find_reader(root, readers, defects)
    reader: Reader = plugins.load("log", name) if format != "auto" else readers[name]
    if not _may_read(reader, root):
        raise LogError(f"{root}: is a file, which format '{name}' cannot be; expected {reader.looks_for}")
    with plugins.blaming("log", name):
        available = reader.sequences(root)
    if not available:
        raise LogError(f"{root}: holds no sequence of format '{name}'; expected {reader.looks_for}")
    if sequence is None and len(available) > 1:
        raise ConfigError(
            f"{root}: holds {len(available)} sequences; choose one with --sequence NAME: {_joined(available)}; "
            "`log2sim batch` takes them all"
        )
    chosen = available[0] if sequence is None else sequence
    if chosen not in available:
        hint = plugins.nearest(chosen, available)
        raise ConfigError(f"{root}: no sequence '{chosen}'{hint}; there are: {_joined(available)}")
    with translate_parser_errors(f"{root}: cannot be read as format '{name}'", LogError):
        with plugins.blaming("log", name):
            opened = reader.open(root, chosen)
        plugins.require_type("log", name, opened, Log)
        again = Reopening(str(root.absolute()), name, chosen, follows_links(), opened.digest)
        log = drop_impossible_labels(guard_log(opened, str(root), again))
    notes = list(defects)
    if format == "auto" and root.is_dir():  # of downloads, perhaps
        others = [other for other, some in readers.items() if other != name and _seems_to_match(other, some, root)]
        if others:
            notes.insert(0, f"{root} holds logs of other formats, too: {', '.join(others)}; --format chooses one")
    # Notes may wait for labels.
    return log.changed(notes=lambda: (*notes, *log.notes, *list_calibration_problems(log), *list_time_problems(log)))


@dataclass(frozen=True)
class Reopening:
    """Opens a log in another process, where the same folder has the same name, as it was opened in this one."""

    path: str
    format: str
    sequence: str
    follow_links: bool
    digest: str  # of the log

    def __call__(self) -> Log:
        """Return the log, which is opened once; `LogError` where another one is there."""
        return _reopened(self)


@lru_cache(maxsize=1)
def _reopened(place: Reopening) -> Log:
    log = open_log(place.path, format=place.format, sequence=place.sequence, follow_links=place.follow_links)
    if log.digest != place.digest:
        raise LogError(f"{place.path}: is another log than the one that this is to be a part of")
    return log


def find_reader(root: Path) -> str:
    """Name of the reader that matches a folder or file; `LogError` when none does."""
    return _find_reader(root, *_usable_readers())


def _find_reader(root: Path, readers: Mapping[str, Reader], defects: list[str]) -> str:
    for name, reader in readers.items():
        if _matches(name, reader, root):
            return name
    broken, below = "".join(f"; {defect}" for defect in defects), list[str]()
    if root.is_dir():  # the folder of many logs, where a short search finds some
        with suppress(Log2SimError, OSError):
            below = [str(log.path) for log in plugins.call("find_logs", root, max_folders=MAX_FOLDERS_BELOW)]
    if below:
        count = f"{len(below)} log{'s' * (len(below) != 1)} below"
        raise LogError(f"{root}: {count}: `log2sim batch` takes them all, other commands one of them: {_joined(below)}")
    above = ""  # the folder of the log, where a part of one was given
    for folder in list(root.absolute().parents)[:-1][:MAX_LEVELS_ABOVE]:
        holds = next((name for name, reader in readers.items() if _seems_to_match(name, reader, folder)), None)
        if holds is not None:
            above = f"; {folder}, which it is in, holds logs of the format '{holds}'"
            break
    if what := _file_of_ours(root):
        raise LogError(f"{root}: is {what}{broken}")
    if root.is_file():
        suffixes = ", ".join(f"*{suffix}" for reader in readers.values() for suffix in reader.suffixes)
        expected = f"give the folder of a log{', or a file ' * bool(suffixes)}{suffixes}"
        raise LogError(f"{root}: is a file of no known log format; {expected}{above}{broken}")
    with suppress(OSError):
        if not any(root.iterdir()):
            raise LogError(f"{root}: is an empty folder, not a log")
    known = "; ".join(f"{name} ({reader.looks_for})" for name, reader in readers.items())
    raise LogError(f"{root}: no known log format{above}; a log is one of: {known}. Force one with --format{broken}")


def _file_of_ours(path: Path) -> str:
    """Say what a file of log2sim is that is no log; empty for others."""
    if path.suffix == ".toml" and path.is_file():
        return "a TOML file, not a log; `log2sim synth` renders scenes"
    with suppress(OSError), path.open("rb") as file:
        if kind := re.match(rb'\s*\{\s*"(\w+)_version"', file.read(100)):
            return f"a {kind[1].decode().replace('_', '-')} file of log2sim, not a log"
    return ""


def _usable_readers() -> tuple[dict[str, Reader], list[str]]:
    """Load all readers; a broken plug-in is told, and does not keep logs of other formats from being opened."""
    readers: dict[str, Reader] = {}
    defects = []
    for name in plugins.names("log"):
        try:
            readers[name] = plugins.load("log", name)
        except PluginError as error:
            defects.append(str(error))
    return readers, defects


def _matches(name: str, reader: Reader, root: Path) -> bool:
    """Return whether a reader may read a path and matches it."""
    with plugins.blaming("log", name):
        return bool(_may_read(reader, root) and reader.matches(root))


def _seems_to_match(name: str, reader: Reader, root: Path) -> bool:
    """Return the same where it is only a remark, which no broken plug-in of another package must keep from being made."""
    with suppress(PluginError):
        return _matches(name, reader, root)
    return False


def is_log_file(path: Path) -> bool:
    """Return whether a file has a suffix of a format of which a file is a log."""
    return path.is_file() and any(_may_read(reader, path) for reader in _usable_readers()[0].values())


def _may_read(reader: Reader, root: Path) -> bool:
    return root.is_dir() or root.suffix.lower() in reader.suffixes


def _joined(names: list[str]) -> str:
    more = len(names) - MAX_LISTED
    return ", ".join(names[:MAX_LISTED]) + (f" and {more} more" if more > 0 else "")


MAX_POINT_DISTANCE_M = 1000.0


def validate_log(
    path: Path | str | Log,
    *,
    format: str = "auto",
    sequence: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """List the problems of a log, one line each; all records are read.

    `path`, `format`, `sequence`: as for `open_log`; or an open log. `progress`: called as `progress(done, total)` after
    each record. Raises `LogError` when the log cannot be opened at all.
    """
    log = path if isinstance(path, Log) else open_log(path, format=format, sequence=sequence)
    log.labels  # noqa: B018  what is wrong with them is noted when they are read
    # Notes on other formats say what the format lacks; those on native logs say what is wrong with stamps and labels.
    problems = list(log.notes) if log.format == "log2sim" else []
    total = sum(len(s.t_ns) for s in log.streams.values())
    done = 0
    for stream in log.streams.values():
        bad = 0
        for i in range(len(stream.t_ns)):
            try:
                record = stream.read(i)
            except RecordError as error:
                bad += 1
                problems.append(f"stream '{stream.name}': {error}")
            else:
                where = f"stream '{stream.name}', stamp {stream.t_ns[i]}"
                if isinstance(record, Sweep) and not len(record.xyz_m):
                    problems.append(f"{where}: the sweep has no points")
                elif isinstance(record, Sweep) and record.frame == "lidar":
                    most_m = float(np.abs(record.xyz_m).max())
                    if most_m > MAX_POINT_DISTANCE_M:
                        problems.append(f"{where}: a point is {most_m:.0f} m from the LiDAR; are the units meters?")
            done += 1
            if progress is not None:
                progress(done, total)
        if bad == len(stream.t_ns):
            problems.append(f"stream '{stream.name}': none of its {bad} records can be read")
    on_ego = [n for n in log.streams if (log.cameras.get(n) or log.lidars[n]).mount == "ego"]
    if log.ego is None and on_ego:
        missing = f"the log has no poses of the ego, on which {', '.join(on_ego)} are mounted"
        return [*problems, f"{missing}; reconstruct estimates them"]
    for name, stream in log.streams.items():
        known = log.map_T_sensor(name, stream.t_ns)[1]
        if not known.all():
            count, first = f"{np.sum(~known)} of {len(known)} records", stream.t_ns[np.argmin(known)]
            problems.append(f"stream '{name}': no ego pose for {count}, first at stamp {first}")
    return problems


def list_gaps(log: Log) -> list[str]:
    """List the streams in which records seem to be missing, by the steps between their stamps, one line each."""
    lines = []
    for name, stream in log.streams.items():
        summary = summarize_stamps(stream.t_ns)
        if summary["gaps"]:
            longest = max(summary["gaps"], key=lambda gap: float(gap["length_s"]))
            count = len(summary["gaps"])
            lines.append(
                f"stream '{name}': {count} gap{'s' * (count > 1)} in its records at {summary['rate_hz']:g} Hz, the longest of "
                f"{longest['length_s']:g} s after stamp {longest['after_ns']}"
            )
    return lines
