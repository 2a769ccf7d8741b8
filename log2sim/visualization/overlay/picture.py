"""One picture of a moment: a tile for each camera, and the points and boxes from above."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from log2sim.datatypes import CATEGORIES, CATEGORY
from log2sim.documents import refuse_existing, replaced
from log2sim.errors import ConfigError
from log2sim.geometry import Array, box_corners_bev
from log2sim.perception.lidar.cloud import cloud_origin
from log2sim.visualization.overlay.moment import Moment, Shot
from log2sim.visualization.plot.style import FONT, FRAME, INK, MUTED, PAPER, printable

COLORS = {"vehicle": "#FFFFFF", "two_wheeler": "#FF4FD8", "pedestrian": "#00E5FF", "other": "#B0B0B0"}
"""Colors of boxes by group, none of which the colors of depths have."""

IMAGE_BOX_COLOR = "#FFE000"
DEPTHS = "turbo_r"
MIN_DEPTH_M, MAX_DEPTH_M = 2.0, 100.0
# Images are sampled down to this width: a tile is not printed wider.
MAX_TILE_PX = 1100
MAX_POINTS = 60_000
TILE_IN, HEAD_IN, FOOT_IN, CAPTION_IN, SIDE_IN = 5.2, 0.4, 0.5, 0.36, 0.85
ABOVE_REACH_M, MAX_HEIGHT_M = 60.0, 3.0
MOTION = {
    "in the log": "compensated in the log",
    "no times": "not compensated: no point times",
    "at rest": "at rest",
    "moving": "compensated by point times",
}
DPI = 150


def write_overlay(moment: Moment, path: Path | str, *, overwrite: bool = False) -> None:
    """Write a moment as a .png.

    Raises
    ------
    ConfigError
        When the name has another suffix, the file exists and `overwrite` is False, or it cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: an overlay is written as .png, not '{path.suffix}'")
    refuse_existing(path, overwrite=overwrite)
    figure = draw_moment(moment)
    with replaced(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI, metadata={"Software": None})


def draw_moment(moment: Moment, *, box_name: str = "3D label") -> Figure:
    """Draw all cameras of a moment and, where it has sweeps or boxes, the view from above; the legend names the boxes."""
    count = len(moment.shots) + bool(moment.sweeps or len(moment.boxes.t_ns))
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    shares = [s.camera.height_px / s.camera.width_px for s in moment.shots]
    tile_in = TILE_IN if columns > 1 else 1.6 * TILE_IN
    picture_in = tile_in * (float(np.median(shares)) if shares else 1.0)
    width = columns * tile_in + SIDE_IN
    height = HEAD_IN + FOOT_IN + rows * (picture_in + CAPTION_IN)
    figure = Figure(figsize=(width, height), facecolor=PAPER)
    FigureCanvasAgg(figure)
    for k in range(count):
        row, column = divmod(k, columns)
        bottom_in = height - HEAD_IN - (row + 1) * (picture_in + CAPTION_IN)
        above = k == len(moment.shots)
        # The view from above is the last tile and takes what is left of its row.
        wide_in = (columns - column if above else 1) * tile_in - 0.12
        ax = figure.add_axes(
            ((column * tile_in + 0.06) / width, bottom_in / height, wide_in / width, picture_in / height)
        )
        caption = _draw_above(ax, moment, wide_in / picture_in) if above else _draw_shot(ax, moment.shots[k], moment)
        text = "\n".join(printable(line, 110) for line in caption)
        ax.set_title(text, fontsize=6.5, color=INK, family=FONT, parse_math=False, pad=3, loc="left")
    _draw_frame(figure, moment, box_name)
    return figure


def _draw_shot(ax: Axes, shot: Shot, moment: Moment) -> tuple[str, str]:
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
        ax.add_collection(LineCollection(list(lines), colors=INK, linewidths=1.9, alpha=0.6, zorder=3), autolim=False)
        ax.add_collection(LineCollection(list(lines), colors=color, linewidths=0.9, zorder=3.1), autolim=False)
    for u0, v0, u1, v1 in shot.image_boxes_px:
        ax.plot([u0, u1, u1, u0, u0], [v0, v0, v1, v1, v0], color=IMAGE_BOX_COLOR, lw=0.9, ls=(0, (3, 2)), zorder=4)
    return _caption(shot, moment)


def _caption(shot: Shot, moment: Moment) -> tuple[str, str]:
    shutter = shot.camera.rolling_shutter
    first, second = [shot.camera.name], []
    if shot.t_ns:
        first.append(f"{shot.t_ns} ns ({(shot.t_ns - moment.t_ns) / 1e6:+.1f} ms)")
        second = [f"{name} {residual * 1e3:+.1f} ms" for name, residual in shot.residuals_s.items()]
        second.append(f"{len(shot.depth_m)} points, {len(shot.boxes)} boxes")
    if shutter is not None:
        first.append(f"lines {shutter.direction} in {shutter.readout_s * 1e3:.0f} ms")
    return " · ".join(first), " · ".join([*([shot.problem] if shot.problem else []), *second])


def _draw_above(ax: Axes, moment: Moment, aspect: float) -> tuple[str, str]:
    """Draw points and boxes from above, x to the right and y up as in the map, and return the caption."""
    origin, ground_z = cloud_origin(moment.log, moment.t_ns)
    reach = _reach(moment, origin)
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
    corners = box_corners_bev(boxes.center_m[:, :2] - origin[:2], boxes.size_m[:, 0], boxes.size_m[:, 1], boxes.yaw_rad)
    colors = [COLORS[CATEGORY[str(c)].group] for c in boxes.category]
    lines = LineCollection([_outline(c) for c in corners], colors=colors, linewidths=0.9, zorder=3)
    ax.add_collection(lines, autolim=False)
    for name in (*moment.log.lidars, *moment.log.cameras):
        at = moment.log.map_T_sensor(name, moment.t_ns)[0][0, :2, 3] - origin[:2]
        ax.plot(*at, "+", color="#FF5050", ms=5, mew=0.8, zorder=4)
    motion = [f"{s.name} {(s.middle_ns - moment.t_ns) / 1e6:+.1f} ms, {MOTION[s.motion]}" for s in moment.sweeps]
    return f"from above, in m from the ego or the sensors (+), {len(boxes.t_ns)} boxes", " · ".join(motion)


def _outline(corners: Array) -> Array:
    """Line (7, 2) around a box with corners (4, 2), and across its front to the center."""
    front = (corners[0] + corners[3]) / 2
    return np.array([front, *corners, corners[0], front, corners.mean(axis=0)])


def _reach(moment: Moment, origin: Array) -> float:
    """Half width of the view from above, m: most of the points and boxes, within limits."""
    far = [np.abs(s.xyz[:, :2] - origin[:2]).max(axis=1) for s in moment.sweeps]
    far.append(np.abs(moment.boxes.center_m[:, :2] - origin[:2]).max(axis=1))
    everything = np.concatenate(far)
    return float(np.clip(np.percentile(everything, 97) if len(everything) else 0.0, 15.0, ABOVE_REACH_M))


def _draw_frame(figure: Figure, moment: Moment, box_name: str) -> None:
    """Write the title, the scale of depths and the legend of boxes."""
    width, height = figure.get_size_inches()
    log = moment.log
    title = f"{log.name} ({log.format}), {moment.at_s:.3f} s after the first tick, stamp {moment.t_ns} ns"
    text: dict[str, Any] = {"family": FONT, "parse_math": False, "va": "top"}
    figure.text(0.06 / width, 1 - 0.08 / height, printable(title, 160), fontsize=9, color=INK, **text)
    notes = "; ".join(moment.notes)
    figure.text(0.06 / width, 1 - 0.27 / height, printable(notes, 220), fontsize=6.5, color="#C8102E", **text)
    _draw_legend(figure, box_name)
    if not moment.shots:
        return
    bar = figure.add_axes(((width - 0.6) / width, 0.25, 0.12 / width, 0.5))
    scale = figure.colorbar(ScalarMappable(LogNorm(MIN_DEPTH_M, MAX_DEPTH_M), DEPTHS), cax=bar)
    depths = (2, 5, 10, 20, 50, 100)
    scale.set_ticks(depths, labels=[str(d) for d in depths])
    bar.minorticks_off()
    bar.tick_params(labelsize=6.5, colors=MUTED, length=2)
    bar.set_title("depth, m", fontsize=6.5, color=MUTED, family=FONT)


def _draw_legend(figure: Figure, box_name: str) -> None:
    groups = list(dict.fromkeys(CATEGORY[c].group for c in CATEGORIES))
    handles = [Line2D([], [], color=COLORS[g], lw=1.6, label=f"{box_name}: {g.replace('_', '-')}") for g in groups]
    handles.append(Line2D([], [], color=IMAGE_BOX_COLOR, lw=1.6, ls=(0, (3, 2)), label="2D label"))
    figure.legend(
        handles=handles, loc="lower left", ncols=len(handles) + 1, fontsize=6.5, frameon=True, facecolor="#10151D",
        edgecolor=FRAME, labelcolor=PAPER, title="the front of a box is crossed out", title_fontsize=6.5, alignment="left",
    ).get_title().set_color(PAPER)  # fmt: skip
