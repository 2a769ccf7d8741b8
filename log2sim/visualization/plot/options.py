"""What of a scenario a picture shows and how: range of time, part of the map, agents, size, and the frames of a film."""

from __future__ import annotations

from dataclasses import dataclass

from log2sim.errors import ConfigError

STILL, MOVING = (".png", ".svg", ".pdf"), (".gif", ".mp4", ".webm")
IN_PIXELS = (".png", *MOVING)
"""Kinds of pictures that have pixels."""

FPS = {".gif": 10.0, ".mp4": 25.0, ".webm": 25.0}
"""A .gif of more frames is large; films at the rate of the logs would jerk, and states between waypoints are known."""

MIN_FPS = 1.0
MAX_FPS = {".gif": 50.0, ".mp4": 120.0, ".webm": 120.0}
"""A .gif states the time of a frame in hundredths of a second, and browsers slow down those of one hundredth."""

MAX_REAL_TIME_S = {".gif": 30.0, ".mp4": 60.0, ".webm": 60.0}
"""What lasts longer is shown faster than real time unless the speed is given, and the picture says so."""

MIN_SIDE_PX, MAX_SIDE_PX = 240, 7680
MAX_SPEED = 1000.0
MIN_EXTENT_M = 1.0


@dataclass(frozen=True)
class PlotOptions:
    """What a picture shows and how; None stands for a choice that fits the scenario.

    Attributes
    ----------
    size_px : (width, height) or None
        Of pictures that have pixels.
    fps : float or None
        Frames of a film a second.
    speed : float or None
        How many times faster than real time a film plays.
    start_s, stop_s : float or None, s
        Range of the scenario's time.
    extent_m : (x0, y0, x1, y1) or None, m
        Two opposite corners of the part of the map, map frame. A picture of other proportions shows more of the map.
    agents : tuple of str or None
        Ids of the agents that are shown; None for all.
    label_static : bool
        Whether a still picture has the ids of static agents too, not of doubtful ones alone.
    """

    size_px: tuple[int, int] | None = None
    fps: float | None = None
    speed: float | None = None
    start_s: float | None = None
    stop_s: float | None = None
    extent_m: tuple[float, float, float, float] | None = None
    agents: tuple[str, ...] | None = None
    label_static: bool = False

    def require_fits(self, suffix: str, name: str) -> None:
        """Raise `ConfigError` when a file with this suffix and name has no such options, or a value is out of its limits."""
        moving = suffix in MOVING
        if moving and self.label_static:
            raise ConfigError(f"label_static: {name} is a film; only still pictures have the ids of static agents")
        for option, value in (("fps", self.fps), ("speed", self.speed)):
            if value is not None and not moving:
                raise ConfigError(f"{option}: {name} is a still picture; choose a name that ends in {_listed(MOVING)}")
        if self.fps is not None and not MIN_FPS <= self.fps <= MAX_FPS[suffix]:
            raise ConfigError(
                f"fps: {self.fps:g}, expected {MIN_FPS:g} to {MAX_FPS[suffix]:g} frames a second in a {suffix}"
            )
        if self.speed is not None and not 1 / MAX_SPEED <= self.speed <= MAX_SPEED:
            raise ConfigError(f"speed: {self.speed:g}, expected {1 / MAX_SPEED:g} to {MAX_SPEED:g} times real time")
        if self.size_px is not None:
            self._require_size(suffix, name)
        if self.extent_m is not None:
            x0, y0, x1, y1 = self.extent_m
            if not (abs(x1 - x0) >= MIN_EXTENT_M and abs(y1 - y0) >= MIN_EXTENT_M):
                shown = ",".join(f"{v:g}" for v in self.extent_m)
                raise ConfigError(
                    f"extent: {shown}, expected two corners X0,Y0,X1,Y1 at least {MIN_EXTENT_M:g} m apart in x and y"
                )

    def _require_size(self, suffix: str, name: str) -> None:
        width, height = self.size_px or (0, 0)
        if suffix not in IN_PIXELS:
            raise ConfigError(f"size: {name} has no pixels; choose a name that ends in {_listed(IN_PIXELS)}")
        if not (MIN_SIDE_PX <= width <= MAX_SIDE_PX and MIN_SIDE_PX <= height <= MAX_SIDE_PX):
            raise ConfigError(f"size: {width}x{height}, expected sides of {MIN_SIDE_PX} to {MAX_SIDE_PX} px")
        if suffix in (".mp4", ".webm") and (width % 2 or height % 2):
            raise ConfigError(f"size: {width}x{height}, expected even sides, which films have")


NO_OPTIONS = PlotOptions()


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Read a size such as "1280x720"; None stays None.

    Raises
    ------
    ConfigError
        For anything but two whole numbers with an x between them.
    """
    if text is None:
        return None
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() and len(part) < 6 for part in parts):
        raise ConfigError(f"size: '{text}', expected width and height in pixels such as 1280x720")
    return int(parts[0]), int(parts[1])


def parse_extent(text: str | None) -> tuple[float, float, float, float] | None:
    """Read two corners such as "-20,-10,60,40"; None stays None.

    Raises
    ------
    ConfigError
        For anything but four finite numbers.
    """
    if text is None:
        return None
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"extent: '{text}', expected two corners X0,Y0,X1,Y1 in m such as -20,-10,60,40") from None
    if not all(abs(v) < 1e9 for v in (x0, y0, x1, y1)):
        raise ConfigError(f"extent: '{text}', expected finite numbers of meters")
    return x0, y0, x1, y1


def parse_ids(text: str | None) -> tuple[str, ...] | None:
    """Read ids separated by commas; None stays None.

    Raises
    ------
    ConfigError
        When it names nobody.
    """
    if text is None:
        return None
    ids = tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    if not ids:
        raise ConfigError("agents: names nobody; give ids separated by commas, or leave it out to show all")
    return ids


def _listed(suffixes: tuple[str, ...]) -> str:
    return ", ".join(suffixes[:-1]) + f" or {suffixes[-1]}"
