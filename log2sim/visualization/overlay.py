"""Pictures of one moment of a log: LiDAR points and labeled boxes on the images of its cameras, and from above."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from log2sim import geometry
from log2sim.datatypes import CATEGORIES, CATEGORY, Boxes3D, Labels, Log, Sweep
from log2sim.errors import ConfigError, RecordError
from log2sim.files.documents import refuse_existing
from log2sim.logs.excerpt import STAMP_TOLERANCE_NS
from log2sim.perception.detect.detectors import MAX_AGE_S, boxes_of_labels, interpolate_pairs, window_ns
from log2sim.perception.lidar.cloud import cloud_origin, compensation_of, sweep_to_map
from log2sim.perception.lidar.projection import poses_around, project_boxes_in_view, view_of
from log2sim.perception.records import RecordSource
from log2sim.perception.sync import synchronize
from log2sim.visualization.plot.layers import add_lines
from log2sim.visualization.plot.style import FONT, FRAME, INK, MUTED, PAPER, new_figure, printable_label, save_png
from log2sim.visualization.recording import corners_in_view, require_cameras


@dataclass(frozen=True, eq=False)
class SweepInMap:
    """One sweep in the map frame."""

    name: str  # of the LiDAR
    xyz: geometry.Array  # (N, 3), m, map frame
    middle_ns: int  # middle of its point times; its stamp where it has none
    motion: str  # how the motion of the sensor during the sweep was compensated


@dataclass(frozen=True, eq=False)
class Shot:
    """The image of one camera with what was projected into it."""

    camera: geometry.Camera
    t_ns: int  # stamp of the image
    image: NDArray[np.uint8] | None  # (H, W, 3) uint8 BGR none where it cannot be read
    # uv_px, depth_m: (N, 2), (N,) liDAR points in the image.
    uv_px: geometry.Array
    depth_m: geometry.Array
    boxes: tuple[tuple[geometry.Array, str], ...]  # edges of each 3D box in px, and its category
    image_boxes_px: geometry.Array  # (M, 4) labeled 2D boxes
    residuals_s: dict[str, float]  # middle of the sweep less the stamp of the image
    problem: str = ""  # why a part is missing; empty where nothing is


@dataclass(frozen=True, eq=False)
class OverlayMoment:
    """All sensors at one tick."""

    log: Log  # with standing poses where it has none
    t_ns: int
    at_s: float  # since the first tick
    shots: tuple[Shot, ...]
    sweeps: tuple[SweepInMap, ...]  # those nearest to the tick
    boxes: Boxes3D  # labels at the tick
    notes: tuple[str, ...]  # what is missing


def read_moment(
    log: Log,
    cameras: Sequence[str] = (),
    at_s: float | None = None,
    *,
    t_ns: int | None = None,
    labels: Callable[[int], Labels] | None = None,
) -> OverlayMoment:
    """Read the records of one tick.

    `cameras`: all of the log where it is empty. `at_s`: time of the tick since the first one, s; by default in the
    middle of those with the most records. `t_ns`: absolute stamp; the tick nearest to it is read, whatever `at_s` says.
    `labels`: returns for the stamp of the tick the 3D boxes that are drawn in place of those of the log. Raises
    `ConfigError` for an unknown camera, and for a time outside the log.
    """
    require_cameras(log, cameras)
    notes = []
    mounts = {*(c.mount for c in log.cameras.values()), *(lidar.mount for lidar in log.lidars.values())}
    if log.ego is None and "ego" in mounts:
        notes.append("the log has no poses: drawn as if the ego stood still")
        ends = [int(t) for stream in log.streams.values() for t in (stream.t_ns[0], stream.t_ns[-1])]
        stamps = np.array([min(ends), max(ends) + 1], dtype=np.int64)
        log = log.changed(ego=geometry.PoseTrack(stamps, np.repeat(np.eye(4)[None], 2, axis=0), max_gap_s=np.inf))
    schedule = synchronize(log, tuple(cameras) or tuple(log.cameras))
    seconds = (schedule.t_ns - schedule.t_ns[0]) / geometry.NS_PER_S
    if t_ns is not None:
        tick = int(np.argmin(np.abs(schedule.t_ns - t_ns)))
    elif at_s is None:
        rows = [*schedule.frames.values(), *(index[schedule.reference_row] for index in schedule.sweeps.values())]
        records = np.sum([index >= 0 for index in rows], axis=0)
        fullest = np.flatnonzero(records == records.max())
        tick = int(fullest[len(fullest) // 2])
    else:
        slack = 0.5 * float(np.diff(seconds).max(initial=0.0)) + 1e-9
        if not -slack <= at_s <= seconds[-1] + slack:
            known = f"the log has ticks from 0 to {seconds[-1]:.3f} s"
            raise ConfigError(f"--at {at_s:g}: {known}; choose a time between them")
        tick = int(np.argmin(np.abs(seconds - at_s)))
    t_ns = int(schedule.t_ns[tick])
    if labels is not None:
        log = log.changed(labels=labels(t_ns), image_labels={})
    loaded: dict[tuple[str, int], SweepInMap | None] = {}  # each sweep is read once

    def sweeps_of(row: int) -> tuple[SweepInMap, ...]:
        wanted = [(name, int(index[row, tick])) for name, index in schedule.sweeps.items()]
        for name, index in wanted:
            if index < 0 or (name, index) in loaded:
                continue
            loaded[name, index] = None
            try:
                sweep: Sweep = RecordSource(log).require(name, index)
            except RecordError as error:
                notes.append(str(error))
                continue
            if (mapped := sweep_to_map(log, name, sweep, compensate=True)) is None:
                notes.append(f"{name}: no ego pose at stamp {sweep.stamp_ns}")
                continue
            middle = sweep.stamp_ns
            if sweep.t_ns is not None and len(sweep.t_ns):
                middle = (int(sweep.t_ns.min()) + int(sweep.t_ns.max())) // 2
            loaded[name, index] = SweepInMap(name, mapped[0], middle, compensation_of(log, name, sweep))
        return tuple(found for key in wanted if (found := loaded.get(key)) is not None)

    frames = [(name, int(index[tick])) for name, index in schedule.frames.items()]
    shots = tuple(_shot(log, name, index, partial(sweeps_of, row)) for row, (name, index) in enumerate(frames))
    sweeps = sweeps_of(schedule.reference_row)
    at = float(t_ns - schedule.t_ns[0]) / geometry.NS_PER_S
    return OverlayMoment(log, t_ns, at, shots, sweeps, labels_at(log.labels, t_ns), tuple(notes))


def labels_at(labels: Labels | None, t_ns: int) -> Boxes3D:
    """Interpolate the labels of every track to a stamp; a track that begins or ends there is kept up to `MAX_AGE_S`."""
    if labels is None:
        return Boxes3D.empty()
    everything = boxes_of_labels(labels)
    near = np.flatnonzero(np.abs(labels.t_ns - t_ns) <= window_ns(labels.t_ns))
    near = near[np.argsort(labels.t_ns[near], kind="stable")]
    before, after = [], []
    for track in np.unique(labels.track_id[near]):
        rows = near[labels.track_id[near] == track]
        earlier, later = rows[labels.t_ns[rows] <= t_ns], rows[labels.t_ns[rows] > t_ns]
        ends = [*earlier[-1:], *later[:1]]
        if len(ends) == 2 or abs(int(labels.t_ns[ends[0]]) - t_ns) <= MAX_AGE_S * geometry.NS_PER_S:
            before.append(ends[0])
            after.append(ends[-1])
    first, second = np.array(before, dtype=np.intp), np.array(after, dtype=np.intp)
    alone = first == second
    pairs = interpolate_pairs(everything.take(first[~alone]), everything.take(second[~alone]), t_ns)
    out = Boxes3D.join([pairs, everything.take(first[alone])])
    return replace(out, t_ns=np.full(len(out), t_ns, dtype=np.int64))


def _shot(log: Log, name: str, index: int, read_sweeps: Callable[[], tuple[SweepInMap, ...]]) -> Shot:
    camera = log.cameras[name]
    empty = Shot(camera, 0, None, np.zeros((0, 2)), np.zeros(0), (), np.zeros((0, 4)), {})
    if index < 0:
        return replace(empty, problem="no image near this tick")
    t_ns = int(log.streams[name].t_ns[index])
    shot = replace(empty, t_ns=t_ns)
    if (labels := log.image_labels.get(name)) is not None:
        near = np.abs(labels.t_ns - t_ns) <= STAMP_TOLERANCE_NS
        shot = replace(shot, image_boxes_px=np.asarray(labels.box_px[near], dtype=np.float64))
    try:
        shot = replace(shot, image=RecordSource(log).require(name, index))
    except RecordError as error:
        shot = replace(shot, problem=str(error))
    if not log.map_T_sensor(name, t_ns)[1][0]:
        return replace(shot, problem="no ego pose at the stamp of the image")
    sweeps = read_sweeps()
    points = np.concatenate([s.xyz for s in sweeps]) if sweeps else np.zeros((0, 3))
    uv, depth, valid = geometry.project_moving(camera, points, poses_around(log, name, t_ns))
    residuals_s = {s.name: (s.middle_ns - t_ns) / geometry.NS_PER_S for s in sweeps}
    boxes, view, wires = labels_at(log.labels, t_ns), view_of(log, name, t_ns), []
    if view is not None:  # each box takes the pose of the line that shows its center
        shown = project_boxes_in_view(view, boxes.center_m, boxes.size_m, boxes.yaw_rad)
        for i in np.flatnonzero(shown.valid):
            corners = corners_in_view(view, shown.box_px[i], boxes.center_m[i], boxes.size_m[i], boxes.yaw_rad[i])
            wires.append((geometry.box_lines(camera, corners), str(boxes.category[i])))
    return replace(shot, uv_px=uv[valid], depth_m=depth[valid], boxes=tuple(wires), residuals_s=residuals_s)


# Colors of boxes by group, none of which the colors of depths have.
COLORS = {"vehicle": "#FFFFFF", "two_wheeler": "#FF4FD8", "pedestrian": "#00E5FF", "other": "#B0B0B0"}
IMAGE_BOX_COLOR = "#FFE000"
DEPTHS = "turbo_r"
MIN_DEPTH_M, MAX_DEPTH_M = 2.0, 100.0
# Images are sampled down to this width: a tile is not printed wider.
MAX_TILE_PX = 1100
MAX_POINTS = 60_000
TILE_IN, HEAD_IN, FOOT_IN, CAPTION_IN, SIDE_IN = 5.2, 0.4, 0.5, 0.36, 0.85
ABOVE_REACH_M, MAX_HEIGHT_M = 60.0, 3.0
MOTION = {
    "in the log": "compensated in the log", "no times": "not compensated: no point times", "at rest": "at rest",
    "moving": "compensated by point times",
}  # fmt: skip
DPI = 150


def write_overlay(moment: OverlayMoment, path: Path | str, *, overwrite: bool = False) -> None:
    """Write a moment as a .png.

    Raises `ConfigError` when the name has another suffix, the file exists and `overwrite` is False, or it cannot be
    written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: an overlay is written as .png, not '{path.suffix}'")
    refuse_existing(path, overwrite=overwrite)
    save_png(draw_moment(moment), path, DPI)


def draw_moment(moment: OverlayMoment, *, box_name: str = "3D label") -> Figure:
    """Draw all cameras of a moment and, where it has sweeps or boxes, the view from above; the legend names the boxes."""
    count = len(moment.shots) + bool(moment.sweeps or len(moment.boxes.t_ns))
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    shares = [s.camera.height_px / s.camera.width_px for s in moment.shots]
    tile_in = TILE_IN if columns > 1 else 1.6 * TILE_IN
    picture_in = tile_in * (float(np.median(shares)) if shares else 1.0)
    width = columns * tile_in + SIDE_IN
    height = HEAD_IN + FOOT_IN + rows * (picture_in + CAPTION_IN)
    figure = new_figure(width, height)
    for k in range(count):
        row, column = divmod(k, columns)
        bottom_in = height - HEAD_IN - (row + 1) * (picture_in + CAPTION_IN)
        above = k == len(moment.shots)
        # The view from above is the last tile and takes what is left of its row.
        wide_in = (columns - column if above else 1) * tile_in - 0.12
        left_in = column * tile_in + 0.06
        ax = figure.add_axes((left_in / width, bottom_in / height, wide_in / width, picture_in / height))
        caption = _draw_above(ax, moment, wide_in / picture_in) if above else _draw_shot(ax, moment.shots[k], moment)
        text = "\n".join(printable_label(line, 110) for line in caption)
        ax.set_title(text, fontsize=6.5, color=INK, family=FONT, parse_math=False, pad=3, loc="left")
    _draw_frame(figure, moment, box_name)
    return figure


def _draw_shot(ax: Axes, shot: Shot, moment: OverlayMoment) -> tuple[str, str]:
    """Draw one camera and return its caption."""
    camera = shot.camera
    ax.set(xlim=(0, camera.width_px), ylim=(camera.height_px, 0), aspect="equal", facecolor=MUTED)
    ax.set_axis_off() if shot.image is not None else ax.set(xticks=[], yticks=[])
    if shot.image is not None:
        step = max(1, -(-camera.width_px // MAX_TILE_PX))
        shown = shot.image[::step, ::step, ::-1]
        ax.imshow(shown, extent=(0, camera.width_px, camera.height_px, 0), interpolation="antialiased", zorder=0)
    order = np.argsort(-shot.depth_m, kind="stable")[:: max(1, len(shot.depth_m) // MAX_POINTS)]
    ax.scatter(
        shot.uv_px[order, 0], shot.uv_px[order, 1], c=shot.depth_m[order], s=0.8, linewidths=0, cmap=DEPTHS,
        norm=LogNorm(MIN_DEPTH_M, MAX_DEPTH_M, clip=True), zorder=2,
    )  # fmt: skip
    for lines, category in shot.boxes:
        color = COLORS[CATEGORY[category].group]
        add_lines(ax, lines, colors=INK, linewidths=1.9, alpha=0.6, zorder=3)
        add_lines(ax, lines, colors=color, linewidths=0.9, zorder=3.1)
    for u0, v0, u1, v1 in shot.image_boxes_px:
        ax.plot([u0, u1, u1, u0, u0], [v0, v0, v1, v1, v0], color=IMAGE_BOX_COLOR, lw=0.9, ls=(0, (3, 2)), zorder=4)
    shutter = shot.camera.rolling_shutter
    first, second = [shot.camera.name], []
    if shot.t_ns:
        first.append(f"{shot.t_ns} ns ({(shot.t_ns - moment.t_ns) / 1e6:+.1f} ms)")
        second = [f"{name} {residual * 1e3:+.1f} ms" for name, residual in shot.residuals_s.items()]
        second.append(f"{len(shot.depth_m)} points, {len(shot.boxes)} boxes")
    if shutter is not None:
        first.append(f"lines {shutter.direction} in {shutter.readout_s * 1e3:.0f} ms")
    return " · ".join(first), " · ".join([*([shot.problem] if shot.problem else []), *second])


def _draw_above(ax: Axes, moment: OverlayMoment, aspect: float) -> tuple[str, str]:
    """Draw points and boxes from above, x to the right and y up as in the map, and return the caption."""
    origin, ground_z = cloud_origin(moment.log, moment.t_ns)
    far = [np.abs(s.xyz[:, :2] - origin[:2]).max(axis=1) for s in moment.sweeps]
    far.append(np.abs(moment.boxes.center_m[:, :2] - origin[:2]).max(axis=1))
    everything = np.concatenate(far)
    reach = float(np.clip(np.percentile(everything, 97) if len(everything) else 0.0, 15.0, ABOVE_REACH_M))
    ax.set(xlim=(-reach * aspect, reach * aspect), ylim=(-reach, reach), facecolor="#10151D")
    ax.tick_params(labelsize=5.5, colors=MUTED, length=2, direction="in", pad=-9)
    for sweep in moment.sweeps:
        local = sweep.xyz - [*origin[:2], ground_z]
        local = local[:: max(1, len(local) // (2 * MAX_POINTS))]
        size = float(np.clip(2e4 / max(len(local), 1), 0.35, 3.0))
        # The ground has the middle of the color map, which contrasts with the dark background.
        ax.scatter(
            local[:, 0], local[:, 1], c=local[:, 2], s=size, linewidths=0, cmap="viridis", zorder=2,
            vmin=-MAX_HEIGHT_M, vmax=MAX_HEIGHT_M,
        )  # fmt: skip
    boxes = moment.boxes
    corners = geometry.box_corners_bev(
        boxes.center_m[:, :2] - origin[:2], boxes.size_m[:, 0], boxes.size_m[:, 1], boxes.yaw_rad
    )
    colors = [COLORS[CATEGORY[str(c)].group] for c in boxes.category]
    # Around a box, and across its front to the center.
    fronts = [(c[0] + c[3]) / 2 for c in corners]
    lines = [np.array([front, *c, c[0], front, c.mean(axis=0)]) for c, front in zip(corners, fronts)]
    add_lines(ax, lines, colors=colors, linewidths=0.9, zorder=3)
    for name in (*moment.log.lidars, *moment.log.cameras):
        at = moment.log.map_T_sensor(name, moment.t_ns)[0][0, :2, 3] - origin[:2]
        ax.plot(*at, "+", color="#FF5050", ms=5, mew=0.8, zorder=4)
    motion = [f"{s.name} {(s.middle_ns - moment.t_ns) / 1e6:+.1f} ms, {MOTION[s.motion]}" for s in moment.sweeps]
    return f"from above, in m from the ego or the sensors (+), {len(boxes.t_ns)} boxes", " · ".join(motion)


def _draw_frame(figure: Figure, moment: OverlayMoment, box_name: str) -> None:
    """Write the title, the scale of depths and the legend of boxes."""
    width, height = figure.get_size_inches()
    log = moment.log
    title = f"{log.name} ({log.format}), {moment.at_s:.3f} s after the first tick, stamp {moment.t_ns} ns"
    text: dict[str, Any] = {"family": FONT, "parse_math": False, "va": "top"}
    figure.text(0.06 / width, 1 - 0.08 / height, printable_label(title, 160), fontsize=9, color=INK, **text)
    notes = "; ".join(moment.notes)
    figure.text(0.06 / width, 1 - 0.27 / height, printable_label(notes, 220), fontsize=6.5, color="#C8102E", **text)
    groups = list(dict.fromkeys(CATEGORY[c].group for c in CATEGORIES))
    handles = [Line2D([], [], color=COLORS[g], lw=1.6, label=f"{box_name}: {g.replace('_', '-')}") for g in groups]
    handles.append(Line2D([], [], color=IMAGE_BOX_COLOR, lw=1.6, ls=(0, (3, 2)), label="2D label"))
    figure.legend(
        handles=handles, loc="lower left", ncols=len(handles) + 1, fontsize=6.5, frameon=True, facecolor="#10151D",
        edgecolor=FRAME, labelcolor=PAPER, title="the front of a box is crossed out", title_fontsize=6.5, alignment="left",
    ).get_title().set_color(PAPER)  # fmt: skip
    if not moment.shots:
        return
    bar = figure.add_axes(((width - 0.6) / width, 0.25, 0.12 / width, 0.5))
    scale = figure.colorbar(ScalarMappable(LogNorm(MIN_DEPTH_M, MAX_DEPTH_M), DEPTHS), cax=bar)
    depths = (2, 5, 10, 20, 50, 100)
    scale.set_ticks(depths, labels=[str(d) for d in depths])
    bar.minorticks_off()
    bar.tick_params(labelsize=6.5, colors=MUTED, length=2)
    bar.set_title("depth, m", fontsize=6.5, color=MUTED, family=FONT)
