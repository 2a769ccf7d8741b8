"""The document of a page: agents, map features, predictions and background as short columns of integers."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim import datatypes
from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.road.ground_map import GroundMap
from log2sim.simulation.expected_motion import ends_of
from log2sim.simulation.prediction.prediction import DEFAULT_METHOD, predict_scenario
from log2sim.visualization.plot.layers import lane_arrows, lane_outline, shown_spans
from log2sim.visualization.plot.viewport import assign_view_roles, is_moving

# Columns are stored as whole numbers of 0.1 ms, mm, 0.1 mrad and mm/s; standard deviations of cm, mrad and cm/s; predictions of
# cm and mrad.
SCALES = {
    "t_s": 1e4, "x_m": 1e3, "y_m": 1e3, "yaw_rad": 1e4, "speed_mps": 1e3, "vx_mps": 1e3, "vy_mps": 1e3,
    "sigma_xy_m": 1e2, "sigma_yaw_rad": 1e3, "sigma_speed_mps": 1e2,
    "dx_m": 1e2, "dy_m": 1e2, "course_rad": 1e3, "along_m": 1e2, "across_m": 1e2,
}  # fmt: skip


def second_differences(values: ArrayLike, scale: float) -> list[int]:
    """Compute second differences (T,) of a column in whole units of 1 / `scale`; two cumulative sums restore it exactly."""
    whole = np.rint(np.asarray(values, dtype=np.float64) * scale).astype(np.int64)
    return list(np.diff(whole, n=2, prepend=[0, 0]).tolist())


# Points of a line that lie so near to the line through the others are left out; a browser shows no less than 2.5 mm.
TOLERANCE_M = 0.02


def feature_columns(scenario: datatypes.Scenario) -> dict[str, Any]:
    """Return faces and arrows of lanes, lines and areas of markings, borders, and traffic lights; empty where there are none."""
    features = scenario.map_features or datatypes.MapFeatures()
    return {
        "lanes": [
            {"outline": _columns(lane_outline(lane)), "arrows": [_columns(a) for a in lane_arrows(lane)]}
            for lane in features.lanes
        ],
        "borders": [_columns(border.points_m) for border in features.borders],
        "markings": [
            {
                **_columns(m.points_m), "kind": m.kind, "yellow": m.color == "yellow", "width_m": round(m.width_m, 3),
                "doubtful": m.confidence < datatypes.MIN_TRUSTED_CONFIDENCE,
            }
            for m in features.markings
        ],
        "signals": [
            {
                "id": s.id, "at_m": [round(float(v), 2) for v in s.position_m[:2]], "t_s": [round(float(t), 3) for t in s.t_s],
                "state": [str(state) for state in s.state],
            }
            for s in scenario.signals
        ],
        "sensors": [
            {k: round(float(sensor[k]), 3) for k in ("x_m", "y_m", "yaw_rad", "fov_rad", "range_m")}
            for sensor in scenario.sensors
        ],
        "notes": list(features.notes),
    }  # fmt: skip


def _columns(points_m: Array) -> dict[str, list[int]]:
    """Return x and y of points (N, 2 or more) without those that lie on the line through the others."""
    from skimage.measure import approximate_polygon

    kept = approximate_polygon(np.asarray(points_m)[:, :2], TOLERANCE_M)
    return {key: second_differences(column, SCALES[key]) for key, column in zip(("x_m", "y_m"), kept.T)}


# A page shows a new prediction five times a second, which looks steady and takes half as much room as one at every
# tick.
EVERY_TICKS = 2
MAX_PREDICTIONS = 1_000_000  # of all agents together: 30 MB of a page for 3 s each


def predicted_columns(scenario: datatypes.Scenario, horizon_s: float) -> dict[str, dict[str, Any]]:
    """Predict agents while they move: by agent, paths relative to where it was, and the ellipse at their ends.

    Raises `ConfigError` for a horizon that predictions do not have, or more predictions than a browser can be expected
    to hold.
    """
    found = predict_scenario(scenario, horizon_s, methods=(DEFAULT_METHOD,))
    table, forecast = found.table, found.forecasts[DEFAULT_METHOD]
    moves = np.abs(table.velocity_mps[found.row, found.tick]) >= datatypes.STANDSTILL_MPS
    shown = moves & (found.tick % EVERY_TICKS == 0)
    if shown.sum() > MAX_PREDICTIONS:
        raise ConfigError(
            f"{shown.sum()} predictions are more than the {MAX_PREDICTIONS} that a page can hold; take fewer agents, such as "
            f"with `log2sim edit --only`, or leave predictions out"
        )
    out = {}
    for agent in scenario.agents:
        rows = found.rows_of(agent.id)
        rows = rows[shown[rows]]
        if len(rows):
            way = forecast.position_m[rows] - table.position_m[found.row[rows], found.tick[rows], None]
            along, across = forecast.sigma_m[rows, -1].T
            course = np.unwrap(np.angle(forecast.course[rows, -1]))
            columns = {"course_rad": course, "along_m": along, "across_m": across}
            out[agent.id] = {
                "t_s": second_differences(table.t_s[found.tick[rows]], SCALES["t_s"]),
                "dx_m": [second_differences(column, SCALES["dx_m"]) for column in way.real.T],
                "dy_m": [second_differences(column, SCALES["dy_m"]) for column in way.imag.T],
                **{name: second_differences(column, SCALES[name]) for name, column in columns.items()},
            }
    return out


# A screen shows no more, and a browser decodes it in an instant.
MAX_EDGE_PX = 2400
# Of the picture; half the edge has about a quarter of the bytes.
MAX_BYTES = 3_000_000
QUALITY = 75  # of 100; artifacts are invisible below the tracks


def embed(picture: GroundMap) -> dict[str, Any] | None:
    """Return the picture as a data URL with its extent, x0, x1, y0, y1, m; None where it shows nothing.

    Cut to what it shows; WebP, since that has opacity and every browser shows it.
    """
    seen = picture.alpha > 0
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if not len(rows):
        return None
    part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    image = _shrunk(np.dstack([picture.image_bgr[part], picture.alpha[part]]), MAX_EDGE_PX)
    x0, x1, y0, y1 = picture.extent_m
    dx, dy = (x1 - x0) / seen.shape[1], (y1 - y0) / seen.shape[0]
    extent = [x0 + part[1].start * dx, x0 + part[1].stop * dx, y1 - part[0].stop * dy, y1 - part[0].start * dy]
    data = _encode(image)
    while len(data) > MAX_BYTES:
        image = _shrunk(image, max(image.shape[:2]) // 2)
        data = _encode(image)
    source = "data:image/webp;base64," + base64.b64encode(data).decode()
    return {"source": source, "extent_m": [round(float(v), 3) for v in extent]}


def _encode(image: NDArray[np.uint8]) -> bytes:
    done, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return bytes(data.tobytes()) if done else b""


def _shrunk(image: NDArray[np.uint8], edge_px: int) -> NDArray[np.uint8]:
    """Return a picture whose longer edge has at most so many pixels."""
    shrink = min(edge_px / max(image.shape[:2]), 1.0)
    if shrink == 1:
        return image
    return np.asarray(cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA), dtype=np.uint8)


WAYPOINT_COLUMNS = ("t_s", "x_m", "y_m", "speed_mps")
SIGMAS = ("sigma_xy_m", *datatypes.Waypoints.OPTIONAL_FLOATS)
# sRGB of usual paints by the names of `COLOR_NAMES`.
PAINTS = {
    "black": (25, 25, 27), "white": (238, 238, 236), "gray": (105, 106, 108), "silver": (180, 182, 184), "red": (165, 25, 30),
    "blue": (30, 65, 150), "green": (30, 100, 55), "yellow": (235, 200, 40), "brown": (95, 65, 45), "orange": (230, 110, 30),
}  # fmt: skip
MAX_ROWS = 3_000_000  # waypoints of all layers together; a page with this many has about 50 MB


def page_document(
    scenario: datatypes.Scenario,
    *,
    truth: datatypes.Scenario | None = None,
    replay: Any = None,
    predict_s: float | None = None,
    background: GroundMap | None = None,
    metrics: Sequence[tuple[str, str]] = (),
) -> dict[str, Any]:
    """Assemble the document of a page: name, span of time and a layer each for scenario, truth and replay.

    With `predict_s`, s, movers of the scenario also hold where they were expected to go for as long.
    `background` is a map of the ground to show below everything, `metrics` are titles and texts.

    Raises `ConfigError` when there are more waypoints than a browser can be expected to hold, or for a horizon that
    predictions do not have. Raises `ScenarioError` when the truth's map has another projection.
    """
    layers = {"scenario": list(_scenario(scenario))}
    if truth is not None:
        true = truth.aligned_to(scenario).agents
        layers["truth"] = [_entry(a, a.waypoints, stationary=not is_moving(a), static=a.static) for a in true]
    if replay is not None:
        there = [(a, a.driver == "static") for a in replay.agents if len(a.t_s)]
        layers["replay"] = [_entry(a, a, stationary=stands, static=stands) for a, stands in there]
    if predict_s is not None:
        predicted = predicted_columns(scenario, predict_s)
        for entry in layers["scenario"]:
            entry |= {"predicted": predicted[entry["id"]]} if entry["id"] in predicted else {}
    rows = sum(len(e["t_s"]) for layer in layers.values() for e in layer)
    if rows > MAX_ROWS:
        raise ConfigError(
            f"{rows} waypoints are more than the {MAX_ROWS} that a page can hold; take fewer agents, "
            f"such as with `log2sim edit --only`"
        )
    shown_entries = [e for name in ("scenario", "replay") for e in layers.get(name, ())]
    times = [np.cumsum(np.cumsum(e["t_s"])) / SCALES["t_s"] for e in shown_entries]
    collisions, shown = [], list(metrics)
    warned: dict[str, Any] = {"title": "", "events": []}
    if replay is not None:
        from log2sim.simulation.metrics.all_metrics import summarize
        from log2sim.simulation.warnings import count_warnings, describe_briefly, describe_warning

        keys = ("t_s", "until_s", "agents", "belongs_to")
        collisions = [{k: event[k] for k in keys} for event in replay.metrics.get("collisions", ())]
        shown.append(("Replay", summarize(replay)))
        if replay.warnings is not None:
            warned["title"] = count_warnings(replay.warnings)
            warned["events"] = [
                {
                    "agent": w.agent, "driver": w.driver, "t_s": w.begin_s, "spans": [list(span) for span in w.spans_s],
                    "brief": describe_briefly(w), "text": describe_warning(w, replay.warnings),
                }
                for w in replay.warnings.events
            ]  # fmt: skip
    m = scenario.map
    known = m.latitude_deg is not None and m.longitude_deg is not None
    return {
        "name": scenario.name,
        "begin_s": min([0.0, *(float(t_s[0]) for t_s in times)]),
        "end_s": max([scenario.duration_s, *(float(t_s[-1]) for t_s in times)]),
        "origin": (f"{m.latitude_deg:.5f}°, {m.longitude_deg:.5f}°" if known else None),
        "north": m.projection is not None,
        "layers": layers,
        "features": feature_columns(scenario),
        "background": None if background is None else embed(background),
        "events": collisions,
        "warnings": warned,
        "metrics": [[title, text] for title, text in shown],
        "recording": None,
        "studio": {
            "t0_ns": scenario.t0_ns, "map_offset_m": list(m.offset_m), "log": scenario.name, "categories": list(datatypes.CATEGORIES),
            "paints": {name: list(rgb) for name, rgb in PAINTS.items()}, "corrections": [],
        },
        "scales": SCALES,
    }  # fmt: skip


def _scenario(scenario: datatypes.Scenario) -> Iterator[dict[str, Any]]:
    """Yield the scenario's agents in the order of the pictures' legend: movers with their colors, then stationary ones."""
    roles, tell_ends = assign_view_roles(scenario), len(ends_of(scenario)) > 1
    marks: list[dict[str, Any]] = [
        {"ego": True} if role.is_ego else {"color": role.color, "leading": role.leading} for role in roles.movers
    ]
    shown = [(role.agent, False, mark) for role, mark in zip(roles.movers, marks)]
    for agent, stationary, mark in (*shown, *((agent, True, {}) for agent in roles.stationary)):
        entry = _entry(agent, agent.waypoints, stationary=stationary, static=stationary and agent.static)
        if agent.color is not None:
            confidence = agent.color.get("confidence")
            sure = "" if confidence is None else f" ({confidence:.2f})"
            entry["paint"] = {"rgb": list(agent.color["rgb"]), "text": f"{agent.color['name']}{sure}"}
        # How far it can be trusted; what nobody knows is left out.
        points = agent.quality.get("points_median")
        sigmas = {key: getattr(agent.waypoints, key) for key in SIGMAS}
        doubts = list(agent.doubts)
        if not doubts and agent.is_doubtful:
            doubts.append(datatypes.Finding("confidence", text=datatypes.explain_doubt(agent)))
        entry |= mark | {
            "confidence": round(agent.confidence, 4),
            "doubts": [[doubt.sentence, doubt.start_s, doubt.end_s, doubt.kind] for doubt in doubts],
            "doubted": [[t if np.isfinite(t) else None for t in span] for span in shown_spans(agent)],
            **({"points": round(float(points), 1)} if isinstance(points, int | float) else {}),
            **({"source": source} if (source := _source(agent)) else {}),
            **{k: second_differences(c, SCALES[k]) for k, c in sigmas.items() if c is not None and np.any(c > 0)},
        }
        # In which spans, s, each end observed it; nothing where that is not known, as of the ego.
        spans = {end: [[round(t, 3) for t in s] for s in found] for end, found in agent.observed_by.items() if found}
        yield entry | ({"observed_by": spans} if spans and tell_ends else {})


def _source(agent: datatypes.Agent) -> str:
    """Say from what an agent was reconstructed, as far as its `quality` tells."""
    quality = agent.quality
    if isinstance(stated := quality.get("source"), str):
        return stated
    detections, cameras, sweeps = (quality.get(key) for key in ("detections", "without_lidar", "lidar_only"))
    if not isinstance(detections, int):
        return ""
    parts = [f"{detections} detection{'s' * (detections != 1)}"]
    parts += [f"{cameras} of them placed by camera"] if isinstance(cameras, int) and cameras else []
    return ", ".join([*parts, *([f"{sweeps} more by LiDAR alone"] if isinstance(sweeps, int) and sweeps else [])])


def _entry(agent: Any, columns: Any, *, stationary: bool, static: bool) -> dict[str, Any]:
    """Make the entry of an agent of any layer.

    `columns` are its waypoints or the rows of a replay; `stationary` ones are drawn in muted colors.
    """
    entry = {
        "id": agent.id,
        "category": agent.category,
        "group": datatypes.GROUP_OF[agent.category],
        "size_m": [round(float(v), 3) for v in agent.size_m],
        "stationary": stationary,
        "permanent": static and len(columns.t_s) == 1,  # one pose during the whole scenario
        **{k: second_differences(getattr(columns, k), scale) for k, scale in SCALES.items() if k in WAYPOINT_COLUMNS},
        "yaw_rad": second_differences(np.unwrap(columns.yaw_rad), SCALES["yaw_rad"]),
    }
    if not isinstance(agent, datatypes.Agent):
        return entry
    way, gap = agent.trajectory, ~(columns.observed[:-1] & columns.observed[1:])
    return {
        **entry,
        "vx_mps": second_differences(way.velocity_x_mps, SCALES["vx_mps"]),
        "vy_mps": second_differences(way.velocity_y_mps, SCALES["vy_mps"]),
        "jumps": np.flatnonzero(way.discontinuous).tolist(),  # steps over which the spline does
        "z_m": second_differences(columns.z_m, SCALES["x_m"]),
        # First and last waypoint of each run of segments that are not observed at both ends, one after the other.
        "filled": np.flatnonzero(np.diff(gap.astype(np.int8), prepend=0, append=0)).tolist(),
    }
