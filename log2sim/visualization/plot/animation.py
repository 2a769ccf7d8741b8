"""Animations: the layout of the still picture with moving boxes, each with a short tail."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb, to_rgba
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Scenario
from log2sim.documents import replaced
from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.visualization.plot import drawing, shapes
from log2sim.visualization.plot.collisions import new_collisions
from log2sim.visualization.plot.doubts import STRIPE_PT, box_stripes, is_doubted_at
from log2sim.visualization.plot.layout import SIDE_IN, TOP_IN, WIDTH_IN, FigureLayout
from log2sim.visualization.plot.predicted import DOTS, PredictedPaths, show_expected
from log2sim.visualization.plot.road_features import SignalLights
from log2sim.visualization.plot.roles import AgentRoles, centers_xy, paint_of
from log2sim.visualization.plot.scene import draw_base
from log2sim.visualization.plot.style import ALARM, FONT, INK, PAPER, halo
from log2sim.visualization.plot.time_series import TimelineCharts

FPS = 10
MAX_FRAMES = 300
"""A longer scenario is shown faster than real time, and the picture says so."""

TAIL_S = 1.5
TAIL_ALPHA, TRACK_ALPHA = 0.65, 0.22
"""Opacity of tails and of whole tracks."""

DPI = {".gif": 96, ".mp4": 128}

CLEAR = 255
"""Palette index of transparent pixels in a .gif; the lower ones are colors."""

SWATCH_PX = 100
"""Width of the swatches of agent colors that the palette is chosen with."""

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class FrameTiming:
    """How many frames an animation has and how far apart they are.

    Attributes
    ----------
    frames : int
    step_s : float, s
        Of the scenario from frame to frame.
    """

    frames: int
    step_s: float

    @property
    def speed_up(self) -> float:
        """Return how many times faster than real time it plays."""
        return self.step_s * FPS


def choose_frame_timing(duration_s: float) -> FrameTiming:
    """Choose real time, or as much faster as needed for at most `MAX_FRAMES` frames."""
    frames = min(max(round(duration_s * FPS), 0), MAX_FRAMES - 1) + 1
    return FrameTiming(frames, duration_s / (frames - 1) if frames > 1 else 1.0 / FPS)


def write_animation(
    scenario: Scenario,
    roles: AgentRoles,
    out_path: Path,
    *,
    replay: Any,
    truth: Scenario | None,
    background: drawing.Background | None,
    predicted: PredictedPaths | None,
    title: str | None,
) -> None:
    """Write a .gif or .mp4; parameters as in `tracks.plot_tracks`."""
    suffix = out_path.suffix.lower()
    layout, step_s, charts = draw_base(
        scenario,
        roles,
        replay=replay,
        truth=truth,
        background=background,
        title=title,
        moving=True,
        predicted=predicted,
    )
    drawing.draw_tracks(layout.ax, roles, layout.view, step_s, alpha=TRACK_ALPHA, faint=True)
    layout.figure.set_dpi(DPI[suffix])
    timing = choose_frame_timing(scenario.duration_s)
    artists = AnimatedArtists(layout, roles, replay, truth, timing, charts, predicted)
    artists.signals = SignalLights(layout.ax, scenario.signals)
    frames = _frames(layout, artists, timing)
    with replaced(out_path) as temporary:
        if suffix == ".gif":
            _write_gif(frames, temporary, [role.color for role in roles.movers] + [ALARM])
        else:
            _write_mp4(frames, temporary, out_path)


def _frames(layout: FigureLayout, artists: AnimatedArtists, timing: FrameTiming) -> Iterator[Image]:
    """Yield RGB frames (H, W, 3); static artists are drawn once."""
    canvas: Any = layout.canvas  # its methods have no type hints
    canvas.draw()
    background = canvas.copy_from_bbox(layout.figure.bbox)
    for k in range(timing.frames):
        canvas.restore_region(background)
        artists.show(k * timing.step_s)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


class AnimatedArtists:
    """The artists that change from frame to frame; `show` moves them and draws them onto the canvas."""

    def __init__(
        self,
        layout: FigureLayout,
        roles: AgentRoles,
        replay: Any,
        truth: Scenario | None,
        timing: FrameTiming,
        charts: TimelineCharts | None,
        predicted: PredictedPaths | None = None,
    ) -> None:
        self.predicted, self.signals = predicted, SignalLights(layout.ax, ())
        self.layout, self.roles, self.truth, self.timing, self.charts = layout, roles, truth, timing, charts
        if charts is not None:
            charts.start()
        self.collision_s, self.collision_xy_m = new_collisions(replay)
        self.collisions = drawing.draw_collisions(layout.ax, self.collision_xy_m, animated=True)
        driven = {a.id: a for a in replay.agents} if replay is not None else {}
        self.replayed = [(driven[r.agent.id], r) for r in roles.movers if r.agent.id in driven]
        hidden: dict[str, Any] = {"animated": True, "zorder": drawing.BOX}
        self.tails = LineCollection([], linewidths=2.0, capstyle="round", **hidden)
        self.boxes = PolyCollection([], edgecolors=PAPER, linewidths=0.7, **hidden)
        self.noses = PolyCollection([], linewidths=0, **hidden)
        self.hatches = LineCollection([], colors=PAPER, linewidths=STRIPE_PT, **hidden)
        self.truths = PolyCollection(
            [], facecolors="none", edgecolors=INK, linewidths=0.8, linestyles=[(0, (3, 2))], **hidden
        )
        self.driven = PolyCollection([], facecolors="none", linewidths=1.2, linestyles=[(0, (1, 1.2))], **hidden)
        self.predicted_paths = LineCollection([], **hidden, **DOTS)
        self.ellipses = PolyCollection([], linewidths=0.7, **hidden)
        self.collections = [
            self.ellipses, self.tails, self.predicted_paths, self.boxes, self.hatches, self.noses, self.truths, self.driven,
        ]  # fmt: skip
        for collection in self.collections:
            layout.ax.add_collection(collection, autolim=False)
        text: dict[str, Any] = {"family": FONT, "fontweight": "bold", "parse_math": False, "animated": True}
        self.labels = [
            layout.ax.text(
                0, 0, ("ego" if r.is_ego else r.label) + "?" * r.agent.is_doubtful, color=r.color, fontsize=6.5, path_effects=halo(), clip_on=True,
                ha="center", va="center", **text,
            )
            for r in roles.movers
        ]  # fmt: skip
        right, height = 1 - (SIDE_IN + 0.2) / WIDTH_IN, layout.figure.get_figheight()
        self.stamp = layout.figure.text(
            right, 1 - (TOP_IN - 0.16) / height, "", ha="right", fontsize=11, color=INK, **text
        )

    def show(self, t_s: float) -> None:
        """Draw the state at `t_s` over the static artists."""
        posed = [(r, _pose(r.agent, t_s)) for r in self.roles.movers]
        present = [(r, pose) for r, pose in posed if pose is not None]
        colors = [to_rgba(r.color, 1.0 if r.leading else 0.6) for r, _ in present]
        corners = [shapes.footprints(r.agent, pose[:2], pose[2])[0] for r, pose in present]
        self.boxes.set_verts(corners)
        self.boxes.set_facecolor(colors)
        self.noses.set_facecolor([paint_of(r.agent, to_rgba(PAPER, 0.85)) for r, _ in present])
        self.noses.set_verts(list(shapes.heading_triangles(np.array(corners))) if corners else [])
        doubted = [(r.agent, pose) for r, pose in present if is_doubted_at(r.agent, t_s)]
        self.hatches.set_segments([s for a, p in doubted for s in box_stripes(a, p[:2], p[2], self.layout.view)])
        self.tails.set_segments([_tail(r.agent, t_s) for r, _ in present])
        self.tails.set_color([to_rgba(r.color, TAIL_ALPHA) for r, _ in present])
        self._show_overlays(t_s)
        for collection in self.collections:
            self.layout.ax.draw_artist(collection)
        self.signals.show(t_s)
        for label, (role, pose) in zip(self.labels, posed):
            if role.leading and pose is not None:
                top = shapes.footprints(role.agent, pose[:2], pose[2])[0, :, 1].max()
                label.set_position((pose[0], top + 5.5 * self.layout.view.m_per_pt))
                self.layout.ax.draw_artist(label)
        self.collisions.set_data(*self.collision_xy_m[self.collision_s <= t_s + 1e-6].T)
        self.layout.ax.draw_artist(self.collisions)
        fast = "" if self.timing.speed_up < 1.05 else f"  (×{self.timing.speed_up:.1f})"
        self.stamp.set_text(f"t = {t_s:.1f} s{fast}")
        self.layout.figure.draw_artist(self.stamp)
        if self.charts is not None:
            self.charts.show(t_s)

    def _show_overlays(self, t_s: float) -> None:
        if self.predicted is not None:
            leading = [(role, self.predicted.at(role.agent.id, t_s)) for role in self.roles.movers if role.leading]
            expected = [(role, found) for role, found in leading if found is not None]
            show_expected(self.predicted_paths, expected)
            show_expected(self.ellipses, expected)
        if self.truth is not None:
            there = [(a, _pose(a, t_s)) for a in self.truth.agents]
            self.truths.set_verts([shapes.footprints(a, pose[:2], pose[2])[0] for a, pose in there if pose is not None])
        if self.replayed:
            verts, colors = [], []
            for driven, role in self.replayed:
                t = np.asarray(driven.t_s)
                if len(t) and t[0] - 1e-6 <= t_s <= t[-1] + 1e-6:
                    x, y = np.interp(t_s, t, driven.x_m), np.interp(t_s, t, driven.y_m)
                    yaw = np.interp(t_s, t, np.unwrap(driven.yaw_rad))
                    verts.append(shapes.footprints(role.agent, (x, y), yaw)[0])
                    colors.append(to_rgba(INK if not role.leading else role.color))
            self.driven.set_verts(verts)
            self.driven.set_edgecolor(colors)


def _pose(agent: Agent, t_s: float) -> Array | None:
    """Return x, y, yaw at a time; None outside the trajectory."""
    if len(agent.waypoints) == 1 and agent.static:
        return np.array([agent.waypoints.x_m[0], agent.waypoints.y_m[0], agent.waypoints.yaw_rad[0]])
    state = agent.at(t_s)
    return np.array([state.x_m[0], state.y_m[0], state.yaw_rad[0]]) if state.valid[0] else None


def _tail(agent: Agent, t_s: float) -> Array:
    """Return the positions (K, 2) of the last `TAIL_S` seconds."""
    t = agent.waypoints.t_s
    now = agent.at(t_s)
    chosen = centers_xy(agent)[(t >= t_s - TAIL_S) & (t <= t_s)]
    return np.concatenate([chosen, [[now.x_m[0], now.y_m[0]]]])


def _write_gif(frames: Iterator[Image], path: Path, colors: Sequence[str]) -> None:
    from PIL import Image as Pillow

    first = next(frames)
    palette = Pillow.fromarray(_with_swatches(first, colors)).quantize(CLEAR, dither=Pillow.Dither.NONE)

    def changes() -> Iterator[Any]:
        """Yield frames whose unchanged pixels are transparent, which makes the file several times smaller."""
        before = None
        for frame in itertools.chain([first], frames):
            now = np.asarray(Pillow.fromarray(frame).quantize(palette=palette, dither=Pillow.Dither.NONE))
            picture = Pillow.fromarray(now if before is None else np.where(now == before, np.uint8(CLEAR), now))
            picture.putpalette(palette.getpalette() or ())
            before = now
            yield picture

    pictures = changes()
    next(pictures).save(
        path, save_all=True, append_images=pictures, duration=round(1000 / FPS), loop=0, optimize=False, disposal=1,
        transparency=CLEAR,
    )  # fmt: skip


def _with_swatches(frame: Image, colors: Sequence[str]) -> Image:
    """Widen a frame by swatches of the agents' colors, since a palette is chosen by area."""
    full = np.array([to_rgb(color) for color in colors])
    mixes = [alpha * full + (1 - alpha) * np.array(to_rgb(PAPER)) for alpha in (1.0, TAIL_ALPHA, TRACK_ALPHA)]
    rgb = np.rint(255 * np.concatenate(mixes)).astype(np.uint8)
    row = np.arange(len(frame)) * len(rgb) // len(frame)
    return np.concatenate([frame, np.repeat(rgb[row][:, None], SWATCH_PX, axis=1)], axis=1)


def _write_mp4(frames: Iterator[Image], path: Path, requested: Path) -> None:
    import cv2

    first = next(frames)
    height, width = (n // 2 * 2 for n in first.shape[:2])  # the codec requires even sides
    path.touch()  # raises when the file cannot be written, which OpenCV would not report
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (width, height))
    try:
        if not writer.isOpened():
            raise ConfigError(f"{requested}: this OpenCV cannot write .mp4; choose a name that ends in .gif")
        writer.write(np.ascontiguousarray(first[:height, :width, ::-1]))
        for frame in frames:
            writer.write(np.ascontiguousarray(frame[:height, :width, ::-1]))
    finally:
        writer.release()
