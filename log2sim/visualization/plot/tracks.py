"""Top-down pictures of a scenario: stills, and animations with moving boxes, each with a short tail."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba

from log2sim.datatypes import ENDS, Agent, Scenario, Signal
from log2sim.errors import ConfigError
from log2sim.files.documents import refuse_existing, replaced
from log2sim.geometry import Array
from log2sim.road.ground_map import GroundMap
from log2sim.simulation.expected_motion import ends_of
from log2sim.visualization.plot import layers, selection, viewport
from log2sim.visualization.plot.encoding import FilmFile, Image, choose_film_file, write_gif
from log2sim.visualization.plot.layout import SIDE_IN, TOP_IN, FigureLayout, MovingLabels, draw_labels
from log2sim.visualization.plot.scene import draw_base, draw_moving
from log2sim.visualization.plot.selection import FPS, MAX_REAL_TIME_S, PlotOptions, TimeRange
from log2sim.visualization.plot.style import ALARM, END_COLOR, FONT, INK, PAPER, TAIL_ALPHA, TRACK_ALPHA
from log2sim.visualization.plot.time_series import TimelineCharts
from log2sim.visualization.plot.viewport import AgentRoles, assign_view_roles, centers_xy, paint_of

TAIL_S = 1.5
REAL_TIME = 1.05  # faster playing is said


class AnimatedArtists:
    """The artists that change from frame to frame; `show` moves them and draws them onto the canvas."""

    def __init__(
        self,
        layout: FigureLayout,
        roles: AgentRoles,
        overlays: layers.Overlays,
        speed_up: float,
        charts: TimelineCharts | None,
        signals: Sequence[Signal],
    ) -> None:
        self.layout, self.roles, self.overlays, self.speed_up, self.charts = layout, roles, overlays, speed_up, charts
        if charts is not None:
            charts.start()
        self.signals = layers.SignalLights(layout.ax, signals)
        self.labels = MovingLabels(layout.ax, layout.view, roles)
        self.collision_s, self.collision_xy_m = layers.new_collisions(overlays.replay)
        self.collisions = layers.draw_collisions(layout.ax, self.collision_xy_m, animated=True)
        driven = {a.id: a for a in overlays.replay.agents} if overlays.replay is not None else {}
        self.replayed = [(driven[r.agent.id], r) for r in roles.movers if r.agent.id in driven]
        hidden: dict[str, Any] = {"animated": True, "zorder": layers.BOX}
        self.tails = LineCollection([], linewidths=2.0, capstyle="round", **hidden)
        self.boxes = PolyCollection([], edgecolors=PAPER, linewidths=0.7, **hidden)
        self.noses = PolyCollection([], linewidths=0, **hidden)
        self.hatches = LineCollection([], colors=PAPER, linewidths=layers.STRIPE_PT, **hidden)
        dashes: dict[str, Any] = {"linewidths": 0.8, "linestyles": [(0, (3, 2))]}
        self.truths = PolyCollection([], facecolors="none", edgecolors=INK, **dashes, **hidden)
        self.driven = PolyCollection([], facecolors="none", linewidths=1.2, linestyles=[(0, (1, 1.2))], **hidden)
        self.predicted_paths = LineCollection([], **hidden, **layers.DOTS)
        self.ellipses = PolyCollection([], linewidths=0.7, **hidden)
        self.collections = [
            self.ellipses, self.tails, self.predicted_paths, self.boxes, self.hatches, self.noses, self.truths, self.driven,
        ]  # fmt: skip
        for collection in self.collections:
            self.layout.ax.add_collection(collection, autolim=False)
        width, height = layout.figure.get_size_inches()
        self.stamp = layout.figure.text(
            1 - (SIDE_IN + 0.2) / width, 1 - (TOP_IN - 0.16) / height, "", ha="right", fontsize=11, color=INK,
            family=FONT, fontweight="bold", parse_math=False, animated=True,
        )  # fmt: skip

    def show(self, t_s: float) -> None:
        """Draw the state at `t_s` over the static artists."""
        posed = [(role, _pose(role.agent, t_s)) for role in self.roles.movers]
        present = [(role, pose) for role, pose in posed if pose is not None]
        corners = [viewport.footprints(role.agent, pose[:2], pose[2])[0] for role, pose in present]
        self.boxes.set_verts(corners)
        self.boxes.set_facecolor([to_rgba(role.color, 1.0 if role.leading else 0.6) for role, _ in present])
        self.noses.set_facecolor([paint_of(role.agent, to_rgba(PAPER, 0.85)) for role, _ in present])
        self.noses.set_verts(list(viewport.heading_triangles(np.array(corners))) if corners else [])
        doubted = [(role.agent, pose) for role, pose in present if layers.is_doubted_at(role.agent, t_s)]
        self.hatches.set_segments([s for a, p in doubted for s in layers.box_stripes(a, p[:2], p[2], self.layout.view)])
        tails = []
        for role, pose in present:
            t = role.agent.waypoints.t_s
            behind = centers_xy(role.agent)[(t >= t_s - TAIL_S) & (t <= t_s)]
            tails.append(np.concatenate([behind, [pose[:2]]]))
        self.tails.set_segments(tails)
        self.tails.set_color([to_rgba(role.color, TAIL_ALPHA) for role, _ in present])
        if (predicted := self.overlays.predicted) is not None:
            leading = [(role, predicted.at(role.agent.id, t_s)) for role in self.roles.movers if role.leading]
            expected = [(role, found) for role, found in leading if found is not None]
            layers.show_expected(self.predicted_paths, self.ellipses, expected)
        if self.overlays.truth is not None:
            there = [(a, _pose(a, t_s)) for a in self.overlays.truth.agents]
            true = [viewport.footprints(a, pose[:2], pose[2])[0] for a, pose in there if pose is not None]
            self.truths.set_verts(true)
        driven, colors = [], []
        for replayed, role in self.replayed:
            t = np.asarray(replayed.t_s)
            if len(t) and t[0] - 1e-6 <= t_s <= t[-1] + 1e-6:
                x, y, yaw = (np.interp(t_s, t, c) for c in (replayed.x_m, replayed.y_m, np.unwrap(replayed.yaw_rad)))
                driven.append(viewport.footprints(role.agent, (x, y), yaw)[0])
                colors.append(to_rgba(INK if not role.leading else role.color))
        self.driven.set_verts(driven)
        self.driven.set_edgecolor(colors)
        for collection in self.collections:
            self.layout.ax.draw_artist(collection)
        self.signals.show(t_s)
        self.labels.show([(role, c, float(pose[3])) for (role, pose), c in zip(present, corners)])
        self.collisions.set_data(*self.collision_xy_m[self.collision_s <= t_s + 1e-6].T)
        self.layout.ax.draw_artist(self.collisions)
        fast = "" if 1 / REAL_TIME < self.speed_up < REAL_TIME else f"  (×{self.speed_up:.2g})"
        self.stamp.set_text(f"t = {t_s:.1f} s{fast}")
        self.layout.figure.draw_artist(self.stamp)
        if self.charts is not None:
            self.charts.show(t_s)


def _pose(agent: Agent, t_s: float) -> Array | None:
    """Return x, y, yaw, speed at a time; None outside the trajectory."""
    if len(agent.waypoints) == 1 and agent.static:
        return np.array([agent.waypoints.x_m[0], agent.waypoints.y_m[0], agent.waypoints.yaw_rad[0], 0.0])
    s = agent.at(t_s)
    return np.concatenate([s.x_m, s.y_m, s.yaw_rad, s.speed_mps]) if s.valid[0] else None


WIDTH_PX = {".gif": 960, ".mp4": 1280, ".webm": 1280}  # without a size of the user's
Progress = Callable[[str, int, int], None]


def choose_frames(span: TimeRange, options: PlotOptions, suffix: str) -> tuple[int, float, float]:
    """Return the number of frames of a film, the step from one to the next, s of the scenario, and the frames a second.

    In real time, or faster where it would take longer than `MAX_REAL_TIME_S`.
    """
    fps = FPS[suffix] if options.fps is None else options.fps
    if suffix == ".gif":
        fps = 100 / round(100 / fps)  # a .gif states the time of a frame in hundredths of a second
    if options.speed is not None:
        return int(span.duration_s * fps / options.speed + 1e-6) + 1, options.speed / fps, fps
    frames = max(round(min(span.duration_s, MAX_REAL_TIME_S[suffix]) * fps), 0) + 1
    return frames, span.duration_s / (frames - 1) if frames > 1 else 1.0 / fps, fps


def write_animation(
    scenario: Scenario, roles: AgentRoles, film: FilmFile, overlays: layers.Overlays, progress: Progress
) -> None:
    """Write an animation frame by frame; none is kept."""
    suffix = film.path.suffix.lower()
    layout, step_s, charts, _ = draw_base(scenario, roles, overlays, moving=True)
    layers.draw_tracks(layout.ax, roles, layout.view, step_s, alpha=TRACK_ALPHA, faint=True)
    layout.set_width_px((overlays.options.size_px or (WIDTH_PX[suffix], 0))[0])
    span = overlays.span_of(scenario)
    count, frame_s, fps = choose_frames(span, overlays.options, suffix)
    artists = AnimatedArtists(layout, roles, overlays, frame_s * fps, charts, scenario.signals)

    def frames() -> Iterator[Image]:  # RGB (H, W, 3); static artists are drawn once
        canvas: Any = layout.figure.canvas  # its methods have no type hints
        canvas.draw()
        background = canvas.copy_from_bbox(layout.figure.bbox)
        for k in range(count):
            canvas.restore_region(background)
            artists.show(span.start_s + k * frame_s)
            yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
            progress("draw", k + 1, count)

    with replaced(film.path) as temporary:
        write = film.write or partial(write_gif, colors=[role.color for role in roles.movers] + [ALARM])
        write(frames(), temporary, fps)


def plot_tracks(
    scenario: Scenario,
    out_path: Path | str,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: GroundMap | None = None,
    predict_s: float | None = None,
    options: selection.PlotOptions = selection.NO_OPTIONS,
    overwrite: bool = False,
    dpi: int = 200,
    progress: Any = lambda stage, done, total: None,
) -> Path:
    """Draw a scenario from above into a file: a still for .png, .svg and .pdf, an animation for .gif, .mp4 and .webm.

    `replay`: drawn over the scenario; charts below the map show commands and errors of the ego, else of the agent
    farthest from its path. `truth`: brought to the scenario's start and map. `background`: a picture of the ground in
    the map frame, drawn below everything. `predict_s`: for how long predictions of the leading movers are drawn.
    `options`: size, range of time, part of the map, agents, and the frames of a film. `dpi`: dots per inch of a .png
    without a size, which is 10 inches wide then. `progress`: `progress(stage, done, total)` is called for every frame
    of an animation. Returns the file that was written: a .webm where an .mp4 was asked for and H.264 is not installed.
    Raises `ConfigError` when the name has another suffix, an option does not fit, `predict_s` is no horizon of
    predictions, the file exists and `overwrite` is False, or it cannot be written. Raises `ScenarioError` when the
    truth's map has another projection.
    """
    film = resolve_picture(Path(out_path))
    suffix = film.path.suffix.lower()
    options.require_fits(suffix, film.path.name)
    refuse_existing(film.path, overwrite=overwrite)
    whole = scenario
    scenario, replay = selection.select_shown(scenario, replay, options)
    span = selection.choose_span(scenario, options)
    shown_truth = None if truth is None else selection.cut_scenario(truth.aligned_to(scenario), span)
    predicted = None if predict_s is None else layers.PredictedPaths(scenario, predict_s)
    shown_replay = selection.cut_replay(replay, span, scenario)
    overlays = layers.Overlays(shown_replay, shown_truth, background, predicted, span, options)
    scenario = selection.cut_scenario(scenario, span)
    roles = assign_view_roles(scenario, whole)
    if suffix in selection.MOVING:
        write_animation(scenario, roles, film, overlays, progress)
    else:
        layout = still(scenario, roles, overlays)
        # The same scenario gives the same bytes: no random element names, no dates.
        left_out: Any = {{".svg": "Date", ".pdf": "CreationDate", ".png": "Software"}[suffix]: None}
        dots = layout.figure.dpi if options.size_px else dpi
        with replaced(film.path) as temporary, matplotlib.rc_context({"svg.hashsalt": "log2sim"}):
            layout.figure.savefig(temporary, format=suffix.removeprefix("."), dpi=dots, metadata=left_out)
    return film.path


def still(scenario: Scenario, roles: AgentRoles, overlays: layers.Overlays) -> FigureLayout:
    """Draw a still picture."""
    layout, step_s, _, labels = draw_base(scenario, roles, overlays)
    ax, replay = layout.ax, overlays.replay
    draw_moving(ax, roles, layout.view, step_s, truth=overlays.truth, replay=replay, ghosts=True)
    for end in ENDS if len(ends_of(scenario)) > 1 else ():  # beside the tracks of movers that one end alone observed
        aside_m, z = layers.BESIDE_PT * layout.view.m_per_pt, layers.TRACK - 0.2
        lines = [line for role in roles.movers for line in layers.lines_of(role.agent, end, aside_m)]
        layers.add_lines(ax, lines, colors=END_COLOR[end], linewidths=layers.WIDTH_PT, capstyle="butt", zorder=z)
    layers.draw_warnings(ax, replay)
    if overlays.predicted is not None:
        layers.draw_predictions(ax, roles, overlays.predicted)
    draw_labels(ax, labels)
    if overlays.options.size_px is not None:
        layout.set_width_px(overlays.options.size_px[0])
    return layout


def resolve_picture(requested: Path) -> FilmFile:
    """Tell which file is written for a name, and for an animation how.

    Raises `ConfigError` when no picture ends in its suffix.
    """
    suffix = requested.suffix.lower()
    if suffix not in selection.STILL + selection.MOVING:
        raise ConfigError(
            f"{requested}: a picture's name must end in {', '.join(selection.STILL)} (still) or {', '.join(selection.MOVING)} (moving), "
            f"not in '{requested.suffix}'"
        )
    return choose_film_file(requested) if suffix in (".mp4", ".webm") else FilmFile(requested)
