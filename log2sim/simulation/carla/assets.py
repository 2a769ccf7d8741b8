"""Assets of CARLA: its blueprints with the sizes of their boxes, and the one nearest to an agent.

The sizes are those that a CARLA 0.9.16 server reports for spawned actors (length, width, height, rounded to
centimeters), as published in tools/carla/snapshots/blueprints_0.9.16.json of the Scenic project. CARLA's boxes include
mirrors, riders and sometimes more: the bus is 3.9 m wide. Police cars, taxis and ambulances are left out, since a
scenario's category car does not tell them apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from log2sim.datatypes import Agent

Size = tuple[float, float, float]


@dataclass(frozen=True)
class Asset:
    """A blueprint and the difference of its size from the agent's.

    Attributes
    ----------
    blueprint : str
    size_m : (3,) tuple of float, m
        Length, width, height.
    error_m : (3,) tuple of float, m
        Size of the blueprint less that of the agent.
    """

    blueprint: str
    size_m: Size
    error_m: Size


CARS: Mapping[str, Size] = {
    "vehicle.audi.a2": (3.71, 1.79, 1.55),
    "vehicle.audi.etron": (4.86, 2.03, 1.65),
    "vehicle.audi.tt": (4.18, 1.99, 1.39),
    "vehicle.bmw.grandtourer": (4.61, 2.24, 1.67),
    "vehicle.chevrolet.impala": (5.36, 2.03, 1.41),
    "vehicle.citroen.c3": (3.99, 1.85, 1.62),
    "vehicle.dodge.charger_2020": (5.01, 1.88, 1.53),
    "vehicle.ford.mustang": (4.72, 1.89, 1.30),
    "vehicle.jeep.wrangler_rubicon": (3.87, 1.91, 1.88),
    "vehicle.lincoln.mkz_2017": (4.90, 2.13, 1.51),
    "vehicle.lincoln.mkz_2020": (4.89, 1.84, 1.49),
    "vehicle.mercedes.coupe": (5.03, 2.15, 1.65),
    "vehicle.mercedes.coupe_2020": (4.67, 1.81, 1.44),
    "vehicle.micro.microlino": (2.21, 1.48, 1.38),
    "vehicle.mini.cooper_s": (3.81, 1.97, 1.48),
    "vehicle.mini.cooper_s_2021": (4.55, 2.10, 1.77),
    "vehicle.nissan.micra": (3.63, 1.85, 1.50),
    "vehicle.nissan.patrol": (4.60, 1.93, 1.85),
    "vehicle.nissan.patrol_2021": (5.57, 2.15, 2.05),
    "vehicle.seat.leon": (4.19, 1.82, 1.47),
    "vehicle.tesla.model3": (4.79, 2.16, 1.49),
    "vehicle.toyota.prius": (4.51, 2.01, 1.52),
}
VANS: Mapping[str, Size] = {
    "vehicle.mercedes.sprinter": (5.92, 1.99, 2.56),
    "vehicle.volkswagen.t2": (4.48, 2.07, 2.04),
    "vehicle.volkswagen.t2_2021": (4.44, 1.77, 1.99),
}
TRUCKS: Mapping[str, Size] = {
    "vehicle.carlamotors.carlacola": (5.20, 2.63, 2.47),
    "vehicle.carlamotors.european_hgv": (7.94, 2.89, 3.46),
    "vehicle.carlamotors.firetruck": (8.47, 2.89, 3.83),
    "vehicle.tesla.cybertruck": (6.27, 2.39, 2.10),
}
BUSES: Mapping[str, Size] = {"vehicle.mitsubishi.fusorosa": (10.27, 3.94, 4.25)}
MOTORCYCLES: Mapping[str, Size] = {
    "vehicle.harley-davidson.low_rider": (2.35, 0.77, 1.65),
    "vehicle.kawasaki.ninja": (2.04, 0.80, 1.52),
    "vehicle.vespa.zx125": (1.82, 0.87, 1.59),
    "vehicle.yamaha.yzf": (2.19, 0.87, 1.53),
}
BICYCLES: Mapping[str, Size] = {
    "vehicle.bh.crossbike": (1.51, 0.87, 1.61),
    "vehicle.diamondback.century": (1.66, 0.58, 1.62),
    "vehicle.gazelle.omafiets": (1.84, 0.66, 1.78),
}

# The box of a walker is its capsule; adults, older and younger children have one size each.
_SMALL, _CHILDREN = ("0009", "0010", "0011", "0048", "0049"), ("0012", "0013", "0014")


def _walker(number: str) -> Size:
    if number in _SMALL:
        return (0.50, 0.50, 1.10)
    return (0.38, 0.38, 1.30) if number in _CHILDREN else (0.38, 0.38, 1.86)


WALKERS: Mapping[str, Size] = {f"walker.pedestrian.{k:04}": _walker(f"{k:04}") for k in range(1, 53)}
PROPS: Mapping[str, Size] = {
    "static.prop.barrel": (0.46, 0.47, 0.81),
    "static.prop.busstop": (3.88, 1.89, 2.74),
    "static.prop.clothcontainer": (1.24, 1.89, 1.81),
    "static.prop.constructioncone": (0.34, 0.34, 0.59),
    "static.prop.container": (1.93, 1.01, 1.71),
    "static.prop.glasscontainer": (1.95, 2.01, 1.79),
    "static.prop.kiosk_01": (1.63, 1.65, 3.25),
    "static.prop.plantpot04": (4.97, 0.74, 0.12),
    "static.prop.shoppingcart": (0.67, 1.21, 1.08),
    "static.prop.streetbarrier": (1.21, 0.37, 1.07),
    "static.prop.trafficcone01": (0.88, 0.88, 1.13),
    "static.prop.trafficwarning": (2.37, 2.87, 3.57),
    "static.prop.trashbag": (0.38, 0.43, 0.70),
    "static.prop.trashcan03": (0.63, 0.55, 0.93),
    "static.prop.vendingmachine": (0.87, 1.10, 2.11),
}

BY_CATEGORY: Mapping[str, Mapping[str, Size]] = {
    "car": {**CARS, **VANS},
    "truck": {**TRUCKS, "vehicle.mercedes.sprinter": VANS["vehicle.mercedes.sprinter"]},
    "bus": {**BUSES, "vehicle.mercedes.sprinter": VANS["vehicle.mercedes.sprinter"]},
    "motorcycle": MOTORCYCLES,
    "cyclist": BICYCLES,
    "bicycle": BICYCLES,  # CARLA has none without a rider
    "pedestrian": WALKERS,
    "other": PROPS,
}


def nearest_assets(agent: Agent, *, turn: int = 0, count: int = 3) -> tuple[Asset, ...]:
    """Return the blueprints of an agent's category nearest in size (Euclidean over the three lengths), nearest first.

    Among blueprints of one size, such as CARLA's adults, the `turn`-th comes first, so that not all look the same.
    """
    offers: dict[Size, list[str]] = {}
    for blueprint, size_m in BY_CATEGORY[agent.category].items():
        offers.setdefault(size_m, []).append(blueprint)
    assets = []
    for size_m in sorted(offers, key=lambda s: math.dist(s, agent.size_m)):
        same = offers[size_m]
        error_m = tuple(round(a - b, 3) for a, b in zip(size_m, agent.size_m))
        assets += [Asset(same[(turn + k) % len(same)], size_m, error_m) for k in range(len(same))]  # type: ignore[arg-type]
    return tuple(assets[:count])
