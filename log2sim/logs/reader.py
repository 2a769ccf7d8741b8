"""Protocol of log readers."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from log2sim.datatypes import Log


class Reader(Protocol):
    """Reader of one log format.

    To add a format, write a module with an object that has these members and register it: in `registry.BUILT_IN["log"]`,
    or in another distribution as an entry point of the group "log2sim.log".

    Attributes
    ----------
    name : str
        Name that `--format` takes.
    looks_for : str
        What a folder of this format must contain, for messages.
    suffixes : tuple of str
        Of files that are logs by themselves, in lower case (".bag"); none for formats that are folders.

    Notes
    -----
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
        """What a folder of this format must contain."""

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Suffixes of files that are logs by themselves."""

    def matches(self, path: Path) -> bool:
        """Return whether the folder or file is a sequence of this format or holds some, by names and magic bytes alone."""

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the sequences at `path`, sorted; one when it is itself a sequence. Never raises."""

    def open(self, path: Path, sequence: str) -> Log:
        """Open the sequence of that name."""
