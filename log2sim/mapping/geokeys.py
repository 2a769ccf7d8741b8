"""GeoTIFF keys of a map: where its cells lie on Earth, by an EPSG code or by the parameters of a projection.

After OGC GeoTIFF 1.1 (19-008r4): sections 7.1 (layout of the key directory) and C.2 (projected coordinate systems).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from log2sim.datatypes import MapFrame

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
    """Contents of the tags of a georeference.

    Attributes
    ----------
    directory : tuple of int
    doubles : tuple of float
    ascii : str
    problem : str or None
        Why the keys say nothing about the place on Earth; None where they do.
    """

    directory: tuple[int, ...]
    doubles: tuple[float, ...]
    ascii: str
    problem: str | None = None


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
    return _directory({**base, **_geographic(crs), **projected, **parameters})


def _geographic(crs: Any) -> dict[int, int | float | str]:
    """Keys of the ellipsoid; WGS 84 where that is the datum or the ellipsoid of an unnamed one."""
    body = crs.ellipsoid
    if "WGS 84" in body.name or "WGS84" in body.name:
        return {GEOGRAPHIC_TYPE: WGS84}
    round_one = body.inverse_flattening == 0
    shape = {SEMI_MINOR: body.semi_minor_metre} if round_one else {INVERSE_FLATTENING: body.inverse_flattening}
    return {
        GEOGRAPHIC_TYPE: USER_DEFINED, DATUM: USER_DEFINED, ANGULAR_UNITS: DEGREES, ELLIPSOID: USER_DEFINED,
        SEMI_MAJOR: float(body.semi_major_metre), **{k: float(v) for k, v in shape.items()},
    }  # fmt: skip


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
