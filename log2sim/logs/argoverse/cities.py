"""Where the city frames of Argoverse 2 lie on Earth."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from log2sim.datatypes import MapFrame

CITY_IN_NAME = re.compile(r"____([A-Z]{3})(_city_|\.|$)")


@dataclass(frozen=True)
class City:
    """A city frame: UTM coordinates from an origin, heights from an unknown zero.

    Attributes
    ----------
    utm_zone : int
        North of the equator.
    east_m, north_m : float, m
        Of the origin, in UTM on WGS 84.
    """

    utm_zone: int
    east_m: float
    north_m: float


# The development kit states the origins as latitude and longitude (av2.geometry.utm); in UTM they are these multiples of 30 m,
# to 0.07 m in Palo Alto and 0.03 m elsewhere.
CITIES: Mapping[str, City] = {
    "ATX": City(14, 621_150.0, 3_349_890.0),
    "DTW": City(17, 320_670.0, 4_685_370.0),
    "MIA": City(17, 580_560.0, 2_850_960.0),
    "PAO": City(10, 576_480.0, 4_141_380.0),
    "PIT": City(17, 583_710.0, 4_477_260.0),
    "WDC": City(18, 323_460.0, 4_306_470.0),
}


def find_city(log: Path) -> str | None:
    """Return the three letters of the city in the names of a log's map files; None without any."""
    folder = log / "map"
    names = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
    found = [match[1] for match in map(CITY_IN_NAME.search, names) if match]
    return found[0] if found else None


def map_frame_of(city: str | None, offset_m: tuple[float, float, float], notes: list[str]) -> MapFrame:
    """Map frame whose origin is `offset_m` from that of a city's frame; only local where the city is not known."""
    place = CITIES.get(city or "")
    if place is None:
        why = "map/ has no file that names it" if city is None else f"'{city}' is none of {', '.join(CITIES)}"
        notes.append(f"the city of the log is not known ({why}): the position of the map on Earth is unknown")
        return MapFrame(offset_m=offset_m)
    from pyproj import Proj

    projection = f"+proj=utm +zone={place.utm_zone} +datum=WGS84 +units=m +no_defs"
    offset = (place.east_m + offset_m[0], place.north_m + offset_m[1], offset_m[2])
    longitude, latitude = Proj(projection)(offset[0], offset[1], inverse=True)
    return MapFrame(float(latitude), float(longitude), None, projection, offset)
