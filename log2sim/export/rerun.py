"""Recordings for the Rerun viewer.

`<name>.rrd`: `/agents`, `/paths`, `/speed`, and with a log `/cameras` and `/lidar`, all over the log's own time. What was taken off
positions and why agents are doubtful stands in `/about`. The same scenario gives the same data and not the same bytes: Rerun draws
ids of its own for whatever it stores.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Log, Scenario, explain_doubt
from log2sim.errors import MissingExtra
from log2sim.export import viewers
from log2sim.export.exporters import Options, SampledMotion, file_name, near_origin
from log2sim.geometry import Array

TIMELINE = "time"
PATH_PX, OUTLINE_PX = 1.5, 1.0
# An entity, absolute stamps (T,) in ns or None for what holds all the time, and columns of T rows.
Part = tuple[tuple[str, ...], NDArray[np.int64] | None, Any]
options: tuple[str, ...] = ("log",)
loses = (
    "uncertainty and observed flags, times between steps of 0.1 s, colors (boxes are colored by category), stages; of a "
    "log: full resolution of pictures wider than 960 px, and points beyond 10,000 a sweep; positions are float32"
)


def write(scenario: Scenario, folder: Path, options: Options) -> None:
    """Write the recording."""
    try:
        import rerun
    except ImportError:
        raise MissingExtra("export to Rerun", "rerun") from None
    # Everything in space beside the cameras and the speeds.
    from rerun import blueprint

    cameras = () if options.log is None else options.log.cameras
    pictures = [blueprint.Spatial2DView(origin=f"/cameras/{n}", name=n) for n in cameras]
    speeds = blueprint.TimeSeriesView(origin="/speed", name="speed in m/s")
    aside = blueprint.Vertical(blueprint.Tabs(*pictures), speeds) if pictures else speeds
    space = blueprint.Spatial3DView(origin="/", name="scenario")
    layout = blueprint.Blueprint(blueprint.Horizontal(space, aside, column_shares=[3, 2]), collapse_panels=True)
    name = file_name(scenario.name)
    recording = rerun.RecordingStream("log2sim", recording_id=name)
    recording.save(folder / f"{name}.rrd", default_blueprint=layout)
    try:
        for entity, t_ns, columns in _parts(scenario, options.log):
            stamps = None if t_ns is None else t_ns.astype("datetime64[ns]")
            times = [] if stamps is None else [rerun.TimeColumn(TIMELINE, timestamp=stamps)]
            recording.send_columns(rerun.new_entity_path(list(entity)), times, columns)
    finally:
        recording.disconnect()


def _parts(scenario: Scenario, log: Log | None) -> Iterator[Part]:
    import rerun

    origin_m = near_origin(scenario).origin_m
    origin = np.array(origin_m)
    about = {"scenario": scenario.name, "position_offset_m": origin_m, "map": asdict(scenario.map)}
    about["doubtful"] = {a.id: explain_doubt(a) for a in scenario.doubtful}
    yield (), None, rerun.ViewCoordinates.columns(xyz=[rerun.ViewCoordinates.RIGHT_HAND_Z_UP])
    yield ("about",), None, rerun.TextDocument.columns(text=[json.dumps(about, indent=1)])
    t_ns, moves = viewers.agent_steps(scenario)
    for agent, move in moves:
        yield from _agent(agent, move, t_ns, origin)
    known: set[str] = set()
    for record in viewers.viewer_records(scenario, log) if log is not None else ():
        if isinstance(record, viewers.CameraFrame) and record.camera.name not in known:
            camera = record.camera
            known.add(camera.name)
            size = [[camera.width_px, camera.height_px]]
            yield ("cameras", camera.name), None, rerun.Pinhole.columns(image_from_camera=[camera.K], resolution=size)
        stamp = np.array([record.t_ns])
        if isinstance(record, viewers.UnreadableRecord):
            yield ("log", record.stream), stamp, rerun.TextLog.columns(text=[record.reason], level=["WARN"])
        elif isinstance(record, viewers.ThinnedSweep):
            points = rerun.Points3D.columns(positions=record.points_map - origin)
            yield ("lidar", record.lidar), stamp, points.partition([len(record.points_map)])
        else:
            yield from _picture(record, stamp, origin)


def _agent(agent: Agent, move: SampledMotion, stamps: NDArray[np.int64], origin: Array) -> Iterator[Part]:
    """Box and speed at every step of an agent's life, and its path."""
    import rerun

    w, rgb, alive = agent.waypoints, [viewers.rgb_of(agent)], np.flatnonzero(move.valid)
    t_ns, yaw = stamps[alive], move.yaw_rad[alive]
    nothing = np.zeros_like(yaw)
    boxes = rerun.Boxes3D.columns(
        centers=move.position_m[alive] - origin,
        half_sizes=np.tile(np.array(agent.size_m) / 2, (len(alive), 1)),
        quaternions=np.column_stack([nothing, nothing, np.sin(yaw / 2), np.cos(yaw / 2)]),
    )
    speed = np.sum(move.velocity_mps[alive] * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=1)
    yield ("agents", agent.id), None, rerun.Boxes3D.columns(colors=rgb, labels=[agent.id])
    yield ("agents", agent.id), t_ns, boxes
    if alive[-1] + 1 < len(stamps):
        yield ("agents", agent.id), stamps[alive[-1] + 1 :][:1], rerun.Clear.columns(is_recursive=[False])
    yield ("speed", agent.id), None, rerun.SeriesLines.columns(colors=rgb, names=[agent.id])
    yield ("speed", agent.id), t_ns, rerun.Scalars.columns(scalars=speed)
    ground = np.column_stack([w.x_m, w.y_m, w.z_m - agent.size_m[2] / 2]) - origin
    line = rerun.LineStrips3D.columns(strips=[ground], colors=rgb, radii=[rerun.Radius.ui_points(PATH_PX)])
    yield ("paths", agent.id), None, line


def _picture(record: viewers.CameraFrame, t_ns: NDArray[np.int64], origin: Array) -> Iterator[Part]:
    import rerun

    place = ("cameras", record.camera.name)
    if record.map_T_cam is not None:
        rotation, translation = record.map_T_cam[:3, :3], record.map_T_cam[:3, 3] - origin
        yield place, t_ns, rerun.Transform3D.columns(translation=[translation], mat3x3=[rotation])
    yield place, t_ns, rerun.EncodedImage.columns(blob=[record.jpeg], media_type=["image/jpeg"])
    lines = [line for _, outline in record.outlines for line in outline]
    if not lines:
        yield (*place, "boxes"), t_ns, rerun.Clear.columns(is_recursive=[False])
        return
    strips = rerun.LineStrips2D.columns(
        strips=lines,
        colors=[viewers.rgb_of(agent) for agent, outline in record.outlines for _ in outline],
        labels=[agent.id if k == 0 else "" for agent, outline in record.outlines for k in range(len(outline))],
        radii=[rerun.Radius.ui_points(OUTLINE_PX)] * len(lines),
    )
    yield (*place, "boxes"), t_ns, strips.partition([len(lines)])
