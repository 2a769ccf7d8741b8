"""Label tables of a native log folder."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import CATEGORIES, ImageLabels, ImageRegions, Labels
from log2sim.errors import LogError
from log2sim.geometry import Array
from log2sim.logs.native.csv_tables import CsvTable

SIZE_FIELDS = ("length_m", "width_m", "height_m")
BOX_3D_FIELDS = ("x_m", "y_m", "z_m", *SIZE_FIELDS, "yaw_rad")
BOX_3D_COLUMNS = {"t_ns": "int", "track_id": "str", "category": "str", **dict.fromkeys(BOX_3D_FIELDS, "float")}
BOX_3D_OPTIONAL = {"visible": "bool", "kind": "str", "occlusion": "int"}
LABELED_COLUMNS = {"t_ns": "int"}
OCCLUSIONS = (0, 1, 2, 3)
BOX_2D_FIELDS = ("u0_px", "v0_px", "u1_px", "v1_px")
REGION_COLUMNS = {"t_ns": "int", "camera": "str", **dict.fromkeys(BOX_2D_FIELDS, "float")}
BOX_2D_COLUMNS = {**REGION_COLUMNS, "category": "str"}


def boxes_3d(table: CsvTable) -> Labels:
    """Labels of a table with `BOX_3D_COLUMNS` and, optionally, some of `BOX_3D_OPTIONAL`."""
    _check_categories(table)
    size = table.stack(*SIZE_FIELDS)
    if np.any(size <= 0):
        row, column = np.argwhere(size <= 0)[0]
        raise LogError(f"{table.where(row, SIZE_FIELDS[column])}: {size[row, column]:g}, expected a size above 0")
    occlusion = table.columns.get("occlusion")
    if occlusion is not None and not np.isin(occlusion, OCCLUSIONS).all():
        row = int(np.argmin(np.isin(occlusion, OCCLUSIONS)))
        raise LogError(f"{table.where(row, 'occlusion')}: {occlusion[row]}, expected 0, 1, 2 or 3")
    return Labels(
        table["t_ns"],
        table["track_id"],
        table["category"],
        table.stack("x_m", "y_m", "z_m"),
        size,
        table["yaw_rad"],
        table.columns.get("visible"),
        kind=table.columns.get("kind"),
        occlusion=occlusion,
    )


def boxes_2d(table: CsvTable, cameras: set[str]) -> dict[str, ImageLabels]:
    """Labels by camera of a table with `BOX_2D_COLUMNS`."""
    _check_categories(table)
    box, rows = _boxes(table), _rows_by_camera(table, cameras)
    return {n: ImageLabels(table["t_ns"][r], box[r], table["category"][r]) for n, r in rows.items()}


def regions_2d(table: CsvTable, cameras: set[str]) -> dict[str, ImageRegions]:
    """Ignored regions by camera of a table with `REGION_COLUMNS`."""
    box, rows = _boxes(table), _rows_by_camera(table, cameras)
    return {n: ImageRegions(table["t_ns"][r], box[r]) for n, r in rows.items()}


def _boxes(table: CsvTable) -> Array:
    box = table.stack(*BOX_2D_FIELDS)
    empty = np.flatnonzero((box[:, 2] <= box[:, 0]) | (box[:, 3] <= box[:, 1]))
    if len(empty):
        raise LogError(f"{table.where(empty[0], 'u1_px,v1_px')}: the box is empty, expected u0 < u1 and v0 < v1")
    return box


def _rows_by_camera(table: CsvTable, cameras: set[str]) -> dict[str, NDArray[np.bool_]]:
    """Rows (N,) by camera, of cameras that have some."""
    unknown = np.flatnonzero(~np.isin(table["camera"], sorted(cameras)))
    if len(unknown):
        name = table["camera"][unknown[0]]
        raise LogError(
            f"{table.where(unknown[0], 'camera')}: no camera '{name}'; there are: {', '.join(sorted(cameras))}"
        )
    rows = {name: table["camera"] == name for name in sorted(cameras)}
    return {n: r for n, r in rows.items() if r.any()}


def _check_categories(table: CsvTable) -> None:
    unknown = np.flatnonzero(~np.isin(table["category"], CATEGORIES))
    if len(unknown):
        found = table["category"][unknown[0]]
        raise LogError(f"{table.where(unknown[0], 'category')}: '{found}', expected one of {', '.join(CATEGORIES)}")
