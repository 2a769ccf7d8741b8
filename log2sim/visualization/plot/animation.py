"""Animations: the layout of the still picture with moving boxes, each with a short tail."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.documents import replaced
from log2sim.visualization.plot import drawing
from log2sim.visualization.plot.animated_artists import AnimatedArtists
from log2sim.visualization.plot.encoding import FilmFile, Image, write_gif
from log2sim.visualization.plot.layout import FigureLayout
from log2sim.visualization.plot.options import FPS, MAX_REAL_TIME_S, PlotOptions
from log2sim.visualization.plot.overlays import Overlays
from log2sim.visualization.plot.roles import AgentRoles
from log2sim.visualization.plot.scene import draw_base
from log2sim.visualization.plot.selection import Span
from log2sim.visualization.plot.style import ALARM, TRACK_ALPHA

WIDTH_PX = {".gif": 960, ".mp4": 1280, ".webm": 1280}
"""Without a size of the user's."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class FrameTiming:
    """How many frames an animation has and how far apart they are.

    Attributes
    ----------
    frames : int
    step_s : float, s
        Of the scenario from frame to frame.
    start_s : float, s
        Time of the first frame.
    fps : float
        Frames that are shown a second.
    """

    frames: int
    step_s: float
    start_s: float = 0.0
    fps: float = FPS[".gif"]

    @property
    def speed_up(self) -> float:
        """Return how many times faster than real time it plays."""
        return self.step_s * self.fps


def choose_frame_timing(span: Span, options: PlotOptions, suffix: str) -> FrameTiming:
    """Choose the frames of a film: in real time, or faster where it would take longer than `MAX_REAL_TIME_S`."""
    fps = FPS[suffix] if options.fps is None else options.fps
    if suffix == ".gif":
        fps = 100 / round(100 / fps)  # a .gif states the time of a frame in hundredths of a second
    if options.speed is not None:
        frames = int(span.duration_s * fps / options.speed + 1e-6) + 1
        return FrameTiming(frames, options.speed / fps, span.start_s, fps)
    frames = max(round(min(span.duration_s, MAX_REAL_TIME_S[suffix]) * fps), 0) + 1
    return FrameTiming(frames, span.duration_s / (frames - 1) if frames > 1 else 1.0 / fps, span.start_s, fps)


def write_animation(
    scenario: Scenario, roles: AgentRoles, film: FilmFile, overlays: Overlays, progress: Progress
) -> None:
    """Write an animation frame by frame; none is kept."""
    suffix = film.path.suffix.lower()
    base = draw_base(scenario, roles, overlays, moving=True)
    layout = base.layout
    drawing.draw_tracks(layout.ax, roles, layout.view, base.step_s, alpha=TRACK_ALPHA, faint=True)
    layout.set_width_px((overlays.options.size_px or (WIDTH_PX[suffix], 0))[0])
    timing = choose_frame_timing(overlays.span_of(scenario), overlays.options, suffix)
    artists = AnimatedArtists(layout, roles, overlays, timing.speed_up, base.charts, scenario.signals)
    with replaced(film.path) as temporary:
        write = film.write or partial(write_gif, colors=[role.color for role in roles.movers] + [ALARM])
        write(draw_frames(layout, artists, timing, progress), temporary, timing.fps)


def draw_frames(
    layout: FigureLayout, artists: AnimatedArtists, timing: FrameTiming, progress: Progress
) -> Iterator[Image]:
    """Yield RGB frames (H, W, 3); static artists are drawn once."""
    canvas: Any = layout.canvas  # its methods have no type hints
    canvas.draw()
    background = canvas.copy_from_bbox(layout.figure.bbox)
    for k in range(timing.frames):
        canvas.restore_region(background)
        artists.show(timing.start_s + k * timing.step_s)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
        progress("draw", k + 1, timing.frames)
