"""Maps of the ground as files: GeoTIFF, PNG with a world file, JPEG for a look; and PNG maps read again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MapFrame
from log2sim.documents import refuse_existing, replaced
from log2sim.errors import ConfigError, LogError
from log2sim.input_files import read_file
from log2sim.mapping.geokeys import (
    ASCII_PARAMETERS,
    DOUBLE_PARAMETERS,
    KEY_DIRECTORY,
    PIXEL_SCALE,
    TIEPOINT,
    geokeys_of,
)
from log2sim.mapping.ground_map import GroundMap
from log2sim.mapping.raster import MAX_CELLS

Layer = Literal["color", "intensity", "height"]
LAYERS: tuple[str, ...] = get_args(Layer)
SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
# Heights in a PNG count from this far below the lowest, so that 0 is left for cells without any.
HEIGHT_STEP_M = 0.01
NO_DATA = 42113  # tag of GDAL, which all programs for maps read
MAX_MAP_BYTES = 512 * 1024 * 1024
MAX_WORLD_FILE_BYTES = 4096
PNG_HEAD = b"\x89PNG\r\n\x1a\n"


def check_name(path: Path) -> None:
    """Raise `ConfigError` for a name that is of no format of maps."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{path}: a map is written as {', '.join(SUFFIXES)}, not '{path.suffix}'")


def world_file_of(path: Path) -> Path | None:
    """Return the name of the world file beside a map; None for formats that hold their place themselves."""
    endings = {".png": ".pgw", ".jpg": ".jgw", ".jpeg": ".jgw"}
    return path.with_suffix(endings[path.suffix.lower()]) if path.suffix.lower() in endings else None


def write_map(
    ground: GroundMap, path: Path, layer: Layer = "color", frame: MapFrame | None = None, *, overwrite: bool = False
) -> None:
    """Write a layer of a map, whole or not at all.

    Parameters
    ----------
    ground : GroundMap
    path : Path
        Ends in one of `SUFFIXES`.
    layer : {"color", "intensity", "height"}
        In a PNG heights are steps of `HEIGHT_STEP_M` from one below the lowest, 0 where unknown; in a GeoTIFF they are m.
    frame : MapFrame, optional
        Where the map lies on Earth; only a GeoTIFF holds it, see `write_world_file` for others.

    Raises
    ------
    ConfigError
        For another suffix, a file that exists and may not be replaced or cannot be written.
    """
    check_name(path)
    refuse_existing(path, overwrite=overwrite)
    encode: dict[str, Callable[[], bytes]] = {
        ".png": lambda: _encode(".png", _png_values(ground, layer)),
        ".jpg": lambda: _encode(".jpg", on_white(ground, layer)),
    }
    suffix = {".jpeg": ".jpg", ".tiff": ".tif"}.get(path.suffix.lower(), path.suffix.lower())
    with replaced(path) as temporary:
        if suffix == ".tif":
            _write_geotiff(ground, temporary, layer, frame or MapFrame())
        else:
            temporary.write_bytes(encode[suffix]())


def write_world_file(ground: GroundMap, path: Path, frame: MapFrame, *, overwrite: bool = False) -> None:
    """Write the world file beside a PNG or JPEG of a map."""
    refuse_existing(path, overwrite=overwrite)
    with replaced(path) as temporary:
        temporary.write_text(world_text(ground, frame), encoding="ascii")


def known_cells(ground: GroundMap, layer: Layer) -> NDArray[np.bool_]:
    """Return the mask (R, C) of the cells of which a layer says something."""
    if layer == "color":
        return ground.coverage
    return np.isfinite(ground.intensity if layer == "intensity" else ground.height_m)


def on_white(ground: GroundMap, layer: Layer) -> NDArray[np.uint8]:
    """Return a layer as a picture (R, C) or (R, C, 3) on white."""
    if layer != "color":
        values = ground.intensity if layer == "intensity" else _spread(ground.height_m)
        return np.where(np.isfinite(values), np.rint(255 * np.nan_to_num(values)), 255).astype(np.uint8)
    alpha = ground.alpha[..., None].astype(np.float32) / 255
    return np.asarray(np.rint(ground.color_bgr * alpha + 255 * (1 - alpha)).astype(np.uint8))


def world_text(ground: GroundMap, frame: MapFrame) -> str:
    """Six lines of a world file: the cell's edges and the center of the north-west cell in the coordinates of the projection."""
    d, (x0, _, _, y1) = ground.resolution_m, ground.extent_m
    x, y = x0 + frame.offset_m[0] + d / 2, y1 + frame.offset_m[1] - d / 2
    return "".join(f"{value!r}\n" for value in (d, 0.0, 0.0, -d, float(x), float(y)))


def read_png_map(path: Path, frame: MapFrame) -> GroundMap:
    """Read the colors of a PNG map with its world file, in a map frame.

    Raises
    ------
    LogError
        When one of the files is missing, too large, damaged, or not north-up.
    """
    data = read_file(path, MAX_MAP_BYTES, LogError)
    if data[:8] != PNG_HEAD or len(data) < 33:
        raise LogError(f"{path}: is no PNG file; give a map that `log2sim map` wrote, or a log")
    columns, rows = (int.from_bytes(data[k : k + 4], "big") for k in (16, 20))
    if not 0 < columns * rows <= 4 * MAX_CELLS:
        raise LogError(f"{path}: {columns} x {rows} pixels, expected at most {4 * MAX_CELLS}")
    d, x, y = _read_world_file(path.with_suffix(".pgw"))
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8:
        raise LogError(f"{path}: is no PNG file of colors that can be decoded")
    image = np.asarray(image, dtype=np.uint8).reshape(rows, columns, -1)
    alpha = image[..., -1] if image.shape[2] in (2, 4) else np.full((rows, columns), 255, np.uint8)
    color = image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2)
    x0, y1 = x - d / 2 - frame.offset_m[0], y + d / 2 - frame.offset_m[1]
    nothing = np.full((rows, columns), np.nan, np.float32)
    return GroundMap(color, alpha, nothing, nothing, d, (x0, x0 + columns * d, y1 - rows * d, y1))


def _read_world_file(path: Path) -> tuple[float, float, float]:
    """Edge of a cell and center of the north-west one."""
    text = read_file(path, MAX_WORLD_FILE_BYTES, LogError, missing="no such file; it says where the map lies")
    try:
        values = [float(word) for word in text.decode("ascii").split()]
        d, turned, also, down, x, y = values
    except ValueError:
        raise LogError(f"{path}: expected six numbers of a world file") from None
    if not (np.isfinite(values).all() and d > 0 and turned == also == 0 and abs(d + down) < 1e-9 * d):
        raise LogError(
            f"{path}: the cells are {d:g} x {down:g} m, turned by {turned:g} and {also:g}; expected square ones, north up"
        )
    return d, x, y


def _spread(height_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Heights from 0, the lowest, to 1, the highest, without the last hundredth of both."""
    known = height_m[np.isfinite(height_m)]
    if not len(known):
        return height_m
    low, high = np.percentile(known, [1, 99])
    return np.asarray(np.clip((height_m - low) / max(high - low, HEIGHT_STEP_M), 0, 1), dtype=np.float32)


def _png_values(ground: GroundMap, layer: Layer) -> NDArray[Any]:
    if layer == "color":
        return np.dstack([ground.color_bgr, ground.alpha])
    known = known_cells(ground, layer)
    if layer == "intensity":
        gray = np.rint(255 * np.nan_to_num(ground.intensity)).astype(np.uint8)
        return np.dstack([gray, gray, gray, np.where(known, 255, 0).astype(np.uint8)])
    steps = np.zeros(known.shape, np.uint16)
    if known.any():
        above = (ground.height_m[known] - lowest_m(ground)) / HEIGHT_STEP_M
        steps[known] = np.clip(np.rint(above), 0, 65534).astype(np.uint16) + 1
    return steps


def lowest_m(ground: GroundMap) -> float:
    """Height of the step 1 of a PNG of heights, m: the lowest of the map."""
    known = np.isfinite(ground.height_m)
    return float(ground.height_m[known].min()) if known.any() else 0.0


def _encode(suffix: str, image: NDArray[Any]) -> bytes:
    done, data = cv2.imencode(suffix, image)
    if not done:
        raise ConfigError(f"OpenCV cannot encode a picture of {image.shape[1]} x {image.shape[0]} px as {suffix}")
    return bytes(data.tobytes())


def _write_geotiff(ground: GroundMap, path: Path, layer: Layer, frame: MapFrame) -> None:
    """Write a GeoTIFF, compressed; heights and intensities as float32 with NaN where they are not known."""
    import tifffile

    d, (x0, _, _, y1), keys = ground.resolution_m, ground.extent_m, geokeys_of(frame)
    corner = (x0 + frame.offset_m[0], y1 + frame.offset_m[1])
    tags: list[tuple[int, str, int, Any, bool]] = [
        (PIXEL_SCALE, "d", 3, (d, d, 0.0), True),
        (TIEPOINT, "d", 6, (0.0, 0.0, 0.0, *corner, 0.0), True),
        (KEY_DIRECTORY, "H", len(keys.directory), keys.directory, True),
        (ASCII_PARAMETERS, "s", 0, keys.ascii, True),
    ]
    if keys.doubles:
        tags.append((DOUBLE_PARAMETERS, "d", len(keys.doubles), keys.doubles, True))
    if layer == "color":
        data: NDArray[Any] = np.dstack([ground.color_bgr[..., ::-1], ground.alpha])
        how: dict[str, Any] = {"photometric": "rgb", "extrasamples": ["unassalpha"]}
    else:
        data = ground.intensity if layer == "intensity" else ground.height_m
        how = {"photometric": "minisblack"}
        tags.append((NO_DATA, "s", 0, "nan", True))
    rows = max(1, 2**20 // (data.itemsize * data[0].size))
    tifffile.imwrite(path, data, compression="zlib", rowsperstrip=rows, metadata=None, extratags=tags, **how)
