"""The waypoints of all agents as one table: of pandas, of xarray, or a Parquet file with units in its schema."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes.agent import Agent
from log2sim.documents import replaced
from log2sim.errors import MissingExtra

COLUMNS: dict[str, tuple[str, str]] = {
    "agent": ("", "id of the agent"),
    "category": ("", "category of the agent"),
    "t_s": ("s", "time since the start of the scenario"),
    "x_m": ("m", "center of the box, map frame, east"),
    "y_m": ("m", "center of the box, map frame, north"),
    "z_m": ("m", "center of the box, map frame, up"),
    "yaw_rad": ("rad", "heading, counter-clockwise from +x"),
    "speed_mps": ("m/s", "along the heading, negative when reversing"),
    "observed": ("", "false where a gap was filled"),
    "sigma_xy_m": ("m", "standard deviation of the position"),
    "sigma_yaw_rad": ("rad", "standard deviation of the heading, NaN where not known"),
    "sigma_speed_mps": ("m/s", "standard deviation of the speed, NaN where not known"),
    "length_m": ("m", "size of the agent"),
    "width_m": ("m", "size of the agent"),
    "height_m": ("m", "size of the agent"),
    "static": ("", "whether the agent never moves"),
    "confidence": ("1", "probability that the agent is right"),
    "doubts": ("", "flags of what speaks against the agent, joined by commas"),
}
"""Unit and meaning of each column."""

TEXTS, FLAGS = ("agent", "category", "doubts"), ("observed", "static")
PER_AGENT = ("category", "length_m", "width_m", "height_m", "static", "confidence", "doubts")


def columns_of(agents: Sequence[Agent]) -> dict[str, NDArray[Any]]:
    """Return the columns (R,) with one row for each agent and waypoint, in the order of the agents."""
    parts = [_columns_of(agent) for agent in agents]
    return {key: np.concatenate([part[key] for part in parts] or [_none(key)]) for key in COLUMNS}


def dataframe_of(agents: Sequence[Agent], about: Mapping[str, Any]) -> Any:
    """Return the columns as a pandas DataFrame; `about` becomes its `attrs`.

    Raises
    ------
    MissingExtra
        When pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise MissingExtra("to_dataframe", "dataframe") from None
    frame = pd.DataFrame(columns_of(agents))
    frame.attrs = dict(about)
    return frame


def dataset_of(agents: Sequence[Agent], about: Mapping[str, Any]) -> Any:
    """Return the columns as an xarray Dataset along agents (A,) and the times of all waypoints (T,); `about` becomes its `attrs`.

    Raises
    ------
    MissingExtra
        When xarray is not installed.
    """
    try:
        import xarray
    except ImportError:
        raise MissingExtra("to_xarray", "xarray") from None
    columns = columns_of(agents)
    t_s, tick = np.unique(columns["t_s"], return_inverse=True)
    counts = [len(agent.waypoints) for agent in agents]
    row = np.repeat(np.arange(len(agents)), counts)
    first = np.cumsum([0, *counts[:-1]]) if agents else np.zeros(0, dtype=np.intp)
    along: dict[str, Any] = {}
    for key, (unit, meaning) in COLUMNS.items():
        values, about_key = columns[key], {"units": unit, "description": meaning}
        if key in PER_AGENT:
            along[key] = ("agent", values[first], about_key)
        elif key not in ("agent", "t_s"):
            table = np.full((len(agents), len(t_s)), False if key in FLAGS else np.nan)
            table[row, tick] = values
            along[key] = (("agent", "t_s"), table, about_key)
    coordinates = {
        "agent": [agent.id for agent in agents],
        "t_s": ("t_s", t_s, {"units": "s", "description": COLUMNS["t_s"][1]}),
    }
    return xarray.Dataset(along, coords=coordinates, attrs=dict(about))


def write_parquet(agents: Sequence[Agent], about: Mapping[str, Any], path: Path) -> None:
    """Write the columns as a Parquet file whose schema states unit and meaning of each; `about` are its metadata.

    Raises
    ------
    MissingExtra
        When pyarrow is not installed.
    ConfigError
        When the file cannot be written.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise MissingExtra("to_parquet", "parquet") from None
    columns = columns_of(agents)
    kinds = {key: pa.string() if key in TEXTS else pa.bool_() if key in FLAGS else pa.float64() for key in COLUMNS}
    fields = [
        pa.field(key, kinds[key], nullable=False, metadata={"unit": unit, "description": meaning})
        for key, (unit, meaning) in COLUMNS.items()
    ]
    schema = pa.schema(fields, metadata={key: str(value) for key, value in about.items()})
    table = pa.table([pa.array(columns[key].tolist(), kinds[key]) for key in COLUMNS], schema=schema)
    with replaced(path) as temporary:
        pq.write_table(table, temporary)


def _columns_of(agent: Agent) -> dict[str, NDArray[Any]]:
    w, rows = agent.waypoints, len(agent.waypoints)
    length, width, height = agent.size_m
    doubts = ",".join(dict.fromkeys(doubt.flag for doubt in agent.doubts))
    same: dict[str, Any] = {
        "agent": agent.id, "category": agent.category, "length_m": length, "width_m": width, "height_m": height,
        "static": agent.static, "confidence": agent.confidence, "doubts": doubts, "sigma_yaw_rad": np.nan,
        "sigma_speed_mps": np.nan,
    }  # fmt: skip
    known = w.columns()
    return {key: known[key] if key in known else np.full(rows, same[key], dtype=_kind(key)) for key in COLUMNS}


def _kind(key: str) -> Any:
    return object if key in TEXTS else bool if key in FLAGS else np.float64


def _none(key: str) -> NDArray[Any]:
    return np.zeros(0, dtype=_kind(key))
