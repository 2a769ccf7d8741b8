"""Maps of the ground as files: GeoTIFF, PNG with a world file, JPEG for a look.

After OGC GeoTIFF 1.1 (19-008r4): sections 7.1 (layout of the key directory) and C.2 (projected coordinate systems).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MapFrame
from log2sim.errors import ConfigError, LogError
from log2sim.files.documents import refuse_existing, replaced
from log2sim.files.inputs import read_file
from log2sim.road.ground_map import MAX_CELLS, GroundMap

# Tags.
PIXEL_SCALE, TIEPOINT, KEY_DIRECTORY, DOUBLE_PARAMETERS, ASCII_PARAMETERS = 33550, 33922, 34735, 34736, 34737
# Keys.
MODEL_TYPE, RASTER_TYPE, CITATION = 1024, 1025, 1026
GEOGRAPHIC_TYPE, GEODETIC_CITATION, DATUM, ANGULAR_UNITS, ELLIPSOID, SEMI_MAJOR, SEMI_MINOR, INVERSE_FLATTENING = (
    2048, 2049, 2050, 2054, 2056, 2057, 2058, 2059,
)  # fmt: skip
PROJECTED_TYPE, PROJECTED_CITATION, PROJECTION, METHOD, LINEAR_UNITS = 3072, 3073, 3074, 3075, 3076
USER_DEFINED, PROJECTED, PIXEL_IS_AREA, METERS, DEGREES, WGS84 = 32767, 1, 1, 9001, 9102, 4326
# Keys of parameters by their EPSG code, as the listed methods take them.
ORIGIN = {"8801": 3081, "8802": 3080, "8805": 3092, "8806": 3082, "8807": 3083}
METHODS: dict[str, tuple[int, dict[str, int]]] = {
    "Transverse Mercator": (1, ORIGIN),
    "Mercator (variant A)": (7, ORIGIN),
    "Lambert Conic Conformal (1SP)": (9, ORIGIN),
    "Azimuthal Equidistant": (12, {"8801": 3089, "8802": 3088, "8806": 3082, "8807": 3083}),
    "Modified Azimuthal Equidistant": (12, {"8801": 3089, "8802": 3088, "8806": 3082, "8807": 3083}),
}


@dataclass(frozen=True)
class GeoKeys:
    """Contents of the tags of a georeference."""

    directory: tuple[int, ...]
    doubles: tuple[float, ...]
    ascii: str
    problem: str | None = None  # why the keys say nothing about the place on Earth; None where they do


def geokeys_of(frame: MapFrame) -> GeoKeys:
    """Make the keys of a map frame, whose coordinates plus `offset_m` are those of its projection."""
    if frame.projection is None:
        return _directory(
            {MODEL_TYPE: USER_DEFINED, RASTER_TYPE: PIXEL_IS_AREA, CITATION: "local map, m"},
            "the log does not tell where its map lies on Earth",
        )
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    base: dict[int, int | float | str] = {MODEL_TYPE: PROJECTED, RASTER_TYPE: PIXEL_IS_AREA, CITATION: frame.projection}
    try:
        crs = CRS.from_user_input(frame.projection)
        code = crs.to_epsg()
    except CRSError:
        return _directory({**base, MODEL_TYPE: USER_DEFINED}, f"'{frame.projection[:80]}' is no known projection")
    if code is not None:
        return _directory({**base, PROJECTED_TYPE: code, LINEAR_UNITS: METERS})
    operation = crs.coordinate_operation
    if operation is None or operation.method_name not in METHODS:
        name = "none" if operation is None else operation.method_name
        return _directory({**base, MODEL_TYPE: USER_DEFINED}, f"GeoTIFF has no key for its projection ({name})")
    method, keys = METHODS[operation.method_name]
    parameters = {keys[p.code]: float(p.value) for p in operation.params if p.code in keys}
    projected = {PROJECTED_TYPE: USER_DEFINED, PROJECTION: USER_DEFINED, METHOD: method, LINEAR_UNITS: METERS}
    body: Any = crs.ellipsoid
    if "WGS 84" in body.name or "WGS84" in body.name:  # the datum, or the ellipsoid of an unnamed one
        return _directory({**base, GEOGRAPHIC_TYPE: WGS84, **projected, **parameters})
    round_one = body.inverse_flattening == 0
    shape = {SEMI_MINOR: body.semi_minor_metre} if round_one else {INVERSE_FLATTENING: body.inverse_flattening}
    geographic = {GEOGRAPHIC_TYPE: USER_DEFINED, DATUM: USER_DEFINED, ANGULAR_UNITS: DEGREES, ELLIPSOID: USER_DEFINED}
    shape = {SEMI_MAJOR: float(body.semi_major_metre)} | {k: float(v) for k, v in shape.items()}
    return _directory({**base, **geographic, **shape, **projected, **parameters})


def _directory(keys: dict[int, int | float | str], problem: str | None = None) -> GeoKeys:
    """Lay out keys in their order: whole numbers in the directory, others in the tables that it points to."""
    entries: list[int] = []
    doubles: list[float] = []
    text = ""
    for key, value in sorted(keys.items()):
        if isinstance(value, str):
            part = value.encode("ascii", "replace").decode().replace("|", "/") + "|"
            entries += [key, ASCII_PARAMETERS, len(part), len(text)]
            text += part
        elif isinstance(value, float):
            entries += [key, DOUBLE_PARAMETERS, 1, len(doubles)]
            doubles.append(value)
        else:
            entries += [key, 0, 1, value]
    return GeoKeys((1, 1, 0, len(entries) // 4, *entries), tuple(doubles), text, problem)


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

    `path`: ends in one of `SUFFIXES`. `layer`: {"color", "intensity", "height"}: in a PNG heights are steps of
    `HEIGHT_STEP_M` from one below the lowest, 0 where unknown; in a GeoTIFF they are m. `frame`: where the map lies on
    Earth; only a GeoTIFF holds it, see `write_world_file` for others.

    Raises `ConfigError` for another suffix, a file that exists and may not be replaced or cannot be written.
    """
    check_name(path)
    refuse_existing(path, overwrite=overwrite)
    suffix = path.suffix.lower()
    with replaced(path) as temporary:
        if suffix in (".tif", ".tiff"):
            _write_geotiff(ground, temporary, layer, frame or MapFrame())
            return
        known = known_cells(ground, layer)
        image: NDArray[Any]
        if suffix != ".png":
            image = on_white(ground, layer)
        elif layer == "color":
            image = np.dstack([ground.color_bgr, ground.alpha])
        elif layer == "intensity":
            gray = np.rint(255 * np.nan_to_num(ground.intensity)).astype(np.uint8)
            image = np.dstack([gray, gray, gray, np.where(known, 255, 0).astype(np.uint8)])
        else:
            image = np.zeros(known.shape, np.uint16)
            above = (ground.height_m[known] - lowest_m(ground)) / HEIGHT_STEP_M
            image[known] = np.clip(np.rint(above), 0, 65534).astype(np.uint16) + 1
        done, data = cv2.imencode(suffix, image)
        if not done:
            raise ConfigError(f"OpenCV cannot encode a picture of {image.shape[1]} x {image.shape[0]} px as {suffix}")
        temporary.write_bytes(data.tobytes())


def write_world_file(ground: GroundMap, path: Path, frame: MapFrame, *, overwrite: bool = False) -> None:
    """Write the world file beside a PNG or JPEG of a map."""
    refuse_existing(path, overwrite=overwrite)
    with replaced(path) as temporary:
        d, (x0, _, _, y1) = ground.resolution_m, ground.extent_m
        place = (x0 + frame.offset_m[0] + d / 2, y1 + frame.offset_m[1] - d / 2)
        temporary.write_text("".join(f"{float(v)!r}\n" for v in (d, 0, 0, -d, *place)), encoding="ascii")


def known_cells(ground: GroundMap, layer: Layer) -> NDArray[np.bool_]:
    """Return the mask (R, C) of the cells of which a layer says something."""
    if layer == "color":
        return ground.coverage
    return np.isfinite(ground.intensity if layer == "intensity" else ground.height_m)


def on_white(ground: GroundMap, layer: Layer) -> NDArray[np.uint8]:
    """Return a layer as a picture (R, C) or (R, C, 3) on white."""
    if layer != "color":
        values = ground.intensity if layer == "intensity" else ground.height_m
        if layer == "height" and np.isfinite(values).any():
            # From 0, the lowest, to 1, the highest, without the last hundredth of both.
            low, high = np.percentile(values[np.isfinite(values)], [1, 99])
            values = np.clip((values - low) / max(high - low, HEIGHT_STEP_M), 0, 1).astype(np.float32)
        return np.where(np.isfinite(values), np.rint(255 * np.nan_to_num(values)), 255).astype(np.uint8)
    alpha = ground.alpha[..., None].astype(np.float32) / 255
    return np.asarray(np.rint(ground.color_bgr * alpha + 255 * (1 - alpha)).astype(np.uint8))


def read_png_map(path: Path, frame: MapFrame) -> GroundMap:
    """Read the colors of a PNG map with its world file, in a map frame.

    Raises `LogError` when one of the files is missing, too large, damaged, or not north-up.
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


def lowest_m(ground: GroundMap) -> float:
    """Height of the step 1 of a PNG of heights, m: the lowest of the map."""
    known = np.isfinite(ground.height_m)
    return float(ground.height_m[known].min()) if known.any() else 0.0


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
