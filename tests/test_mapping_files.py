"""Maps as files: places read back from GeoTIFF keys and world files are those of the projection, found by pyproj."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyproj
import pytest
import tifffile

from log2sim.datatypes import MapFrame
from log2sim.errors import LogError
from log2sim.road.ground_map import GroundMap
from log2sim.road.map_files import geokeys_of, lowest_m, read_png_map, world_file_of, write_map, write_world_file

PROJECTIONS = {
    "kitti": "+proj=merc +R=6378137 +lon_0=8.4228 +k_0=0.6559113 +x_0=0 +y_0=-4117000.68 +units=m +no_defs",
    "nuscenes": "+proj=aeqd +R=6378137 +x_0=0 +y_0=0 +units=m +no_defs +lat_0=42.3368 +lon_0=-71.0578",
    "argoverse": "+proj=utm +zone=17 +datum=WGS84 +units=m +no_defs",
    "native": "+proj=tmerc +lat_0=49.01 +lon_0=8.43 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs",
}
# Origins near each of them, as logs take off whole kilometers.
OFFSETS = {"kitti": (1000.0, 2000.0, 0.0), "argoverse": (583000.0, 4477000.0, 0.0)}


def small_map(seed: int = 3) -> GroundMap:
    rng = np.random.default_rng(seed)
    height = rng.uniform(-1, 3, (40, 60)).astype(np.float32)
    height[:5] = np.nan
    intensity = rng.uniform(0, 1, (40, 60)).astype(np.float32)
    intensity[:, :4] = np.nan
    color = rng.integers(0, 256, (40, 60, 3)).astype(np.uint8)
    return GroundMap(color, np.full((40, 60), 255, np.uint8), height, intensity, 0.5, (-10.0, 20.0, 5.0, 25.0))


def crs_of(keys: dict[int, Any]) -> pyproj.CRS:
    """Read GeoTIFF keys by the text of the standard; a second way that shares nothing with the writer but the numbers."""
    if keys[3072] != 32767:
        return pyproj.CRS.from_epsg(keys[3072])
    body = "+ellps=WGS84" if keys[2048] == 4326 else f"+a={keys[2057]!r} +b={keys[2058]!r}"
    if keys[3075] == 12:
        return pyproj.CRS(f"+proj=aeqd +lat_0={keys[3089]!r} +lon_0={keys[3088]!r} {body} +units=m")
    name = {1: "tmerc", 7: "merc"}[keys[3075]]
    latitude = f"+lat_0={keys[3081]!r} " if name == "tmerc" else ""
    return pyproj.CRS(
        f"+proj={name} {latitude}+lon_0={keys[3080]!r} +k_0={keys[3092]!r} +x_0={keys[3082]!r} +y_0={keys[3083]!r} "
        f"{body} +units=m"
    )


def decoded(page: Any) -> dict[int, Any]:
    directory = page.tags[34735].value
    doubles = page.tags[34736].value if 34736 in page.tags else ()
    text = page.tags[34737].value
    keys: dict[int, Any] = {}
    for k in range(directory[3]):
        key, where, count, value = directory[4 + 4 * k : 8 + 4 * k]
        if where == 0:
            keys[key] = value
        elif where == 34736:
            keys[key] = doubles[value] if isinstance(doubles, tuple) else doubles
        else:
            keys[key] = text[value : value + count - 1]
    assert list(keys) == sorted(keys)
    return keys


@pytest.mark.parametrize("name", PROJECTIONS)
def test_a_point_of_a_geotiff_is_where_the_projection_puts_it(name: str, tmp_path: Path) -> None:
    frame = MapFrame(projection=PROJECTIONS[name], offset_m=OFFSETS.get(name, (0.0, 0.0, 0.0)))
    ground = small_map()
    write_map(ground, tmp_path / "m.tif", "color", frame)
    with tifffile.TiffFile(tmp_path / "m.tif") as file:
        page: Any = file.pages[0]
        keys, (sx, sy, _) = decoded(page), page.tags[33550].value
        _, _, _, x, y, _ = page.tags[33922].value
        np.testing.assert_array_equal(page.asarray()[..., :3][..., ::-1], ground.color_bgr)
    assert (keys[1024], keys[1025]) == (1, 1)
    column, row = 31.5, 7.5  # corners of cells count from 0
    place = x + column * sx, y - row * sy
    lon, lat = pyproj.Transformer.from_crs(crs_of(keys), crs_of(keys).geodetic_crs, always_xy=True).transform(*place)
    own = pyproj.CRS(frame.projection)
    mapped = ground.raster.xy_of(7, 31)[None][0] + frame.offset_m[:2]
    expected = pyproj.Transformer.from_crs(own, own.geodetic_crs, always_xy=True).transform(*mapped)
    assert abs(lon - expected[0]) < 1e-9
    assert abs(lat - expected[1]) < 1e-9


def test_a_png_and_its_world_file_are_read_back_to_the_same_place(tmp_path: Path) -> None:
    frame = MapFrame(projection=PROJECTIONS["kitti"], offset_m=(1000.0, 2000.0, 0.0))
    ground = small_map()
    write_map(ground, tmp_path / "m.png", "color", frame)
    world = world_file_of(tmp_path / "m.png")
    assert world is not None
    write_world_file(ground, world, frame)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.pgw", "m.png"]
    d, _, _, down, x, y = (float(line) for line in (tmp_path / "m.pgw").read_text().split())
    assert (d, down) == (0.5, -0.5)
    np.testing.assert_allclose(np.array([x, y]) - [1000, 2000], ground.raster.xy_of(0, 0))
    back = read_png_map(tmp_path / "m.png", frame)
    np.testing.assert_array_equal(back.color_bgr, ground.color_bgr)
    np.testing.assert_allclose(back.extent_m, ground.extent_m)


@pytest.mark.parametrize(
    ("world", "reason"),
    [(None, "where the map lies"), ("1 2 3", "six numbers"), ("0.5 0.1 0 -0.5 0 0", "north up"), ("0.5 0 0 -0.4 0 0", "square"), ("nan 0 0 nan 0 0", "square")],
)  # fmt: skip
def test_a_map_without_a_usable_world_file_is_refused(world: str | None, reason: str, tmp_path: Path) -> None:
    write_map(small_map(), tmp_path / "m.png")
    if world is not None:
        (tmp_path / "m.pgw").write_text(world)
    with pytest.raises(LogError, match=reason):
        read_png_map(tmp_path / "m.png", MapFrame())


@pytest.mark.parametrize(
    ("projection", "reason"),
    [(None, "does not tell"), ("+proj=nothing", "no known projection"), ("+proj=moll +lon_0=0", "no key")],
)
def test_without_a_place_on_earth_the_keys_say_so(projection: str | None, reason: str, tmp_path: Path) -> None:
    keys = geokeys_of(MapFrame(projection=projection))
    assert keys.problem is not None
    assert reason in keys.problem
    write_map(small_map(), tmp_path / "m.tif", "height", MapFrame(projection=projection))
    with tifffile.TiffFile(tmp_path / "m.tif") as file:
        assert decoded(file.pages[0])[1024] == 32767


def test_a_png_of_heights_has_steps_of_a_centimeter(tmp_path: Path) -> None:
    ground = small_map()
    write_map(ground, tmp_path / "h.png", "height")
    steps = cv2.imread(str(tmp_path / "h.png"), cv2.IMREAD_UNCHANGED)
    known = np.isfinite(ground.height_m)
    assert not steps[~known].any()
    np.testing.assert_allclose(lowest_m(ground) + 0.01 * (steps[known] - 1.0), ground.height_m[known], atol=0.0051)
