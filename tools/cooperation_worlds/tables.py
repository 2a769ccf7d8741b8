"""The figures of each test as a table in Markdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

NAMES = {
    "vehicle": "vehicle alone",
    "road": "road alone",
    "points": "both, points",
    "boxes": "both, boxes",
    "tracks": "both, tracks",
}


def range_table(figures: dict[str, Any]) -> str:
    """Test A."""
    bins = list(next(iter(figures.values()))["recall_by_distance"])
    head = ["", "range m", "recall at 30 m", *(f"{b} m" for b in bins)]
    rows = [
        [NAMES[w], f"{f['range_m']:.0f}", _n(f["recall_30m"]), *(_n(v) for v in f["recall_by_distance"].values())]
        for w, f in figures.items()
    ]
    return _table(head, rows)


def blind_area_table(figures: dict[str, Any]) -> str:
    """Test B."""
    head = [
        "", "known before contact s", "distance m", "least m", "20 m or more", "gained s", "2 s or more", "never known",
        "collisions, braking when known", "warned before contact s", "never warned", "collisions, braking when warned",
    ]  # fmt: skip
    rows = [
        [
            NAMES[w], _n(f["before_contact_s"]), f"{f['distance_m']:.1f}", f"{f['distance_least_m']:.1f}", _n(f["from_20_m"]),
            _n(f["gained_s"]), _n(f["gained_2_s"]), str(f["never"]), str(f["collisions"]), _n(f["warned_before_s"]),
            str(f["never_warned"]), str(f["collisions_warned"]),
        ]
        for w, f in figures.items()
    ]  # fmt: skip
    return _table(head, rows)


def overlap_table(figures: dict[str, Any]) -> str:
    """Test C."""
    head = [
        "",
        "of",
        "found",
        "overlap",
        "IoU",
        "over the better end",
        "over the better of each variant",
        "worse variants",
    ]
    rows = [
        [
            NAMES[w], of, _n(f["found"]), f"{f['overlap']:.3f}", f"{f['iou']:.3f}", f"{f['over_better_end']:+.3f}",
            f"{f['over_better_by_variant']:+.3f}", str(f["worse_variants"]),
        ]
        for of in ("boxes", "scenario")
        for w, f in figures[of].items()
    ]  # fmt: skip
    return _table(head, rows)


def ap_table(figures: dict[str, Any]) -> str:
    """AP in random traffic."""
    ways = list(next(iter(figures["ap"].values())))
    rows = [
        [kind, *("-" if ap[w] is None else f"{100 * ap[w]:.1f}" for w in ways)] for kind, ap in figures["ap"].items()
    ]
    rows += [[f"recall, vehicles {what}", *(_n(of[w]) for w in ways)] for what, of in figures["recall"].items()]
    share = f"{figures['vehicles']} vehicles, {100 * figures['hidden_from_vehicle']:.0f} % hidden from the vehicle"
    return _table(["AP BEV .5; people, two-wheelers .25", *(NAMES[w] for w in ways)], rows) + "\n\n" + share


def registration_table(figures: dict[str, Any]) -> str:
    """Errors of the pole's pose and clock."""
    rows = []
    for when in ("before", "after"):
        cells = [figures[f"{name}_{when}"] for name in ("offset_m", "turn_deg", "delay_s")]
        rows.append([when, *(f"{c['median']:.3f} / {c['p90']:.3f}" for c in cells)])
    table = _table(["median / 90 %", "position m", "angle deg", "clock s"], rows)
    return table + f"\n\nwithin 0.1 m and 0.3 deg: {_n(figures['within_target'])}; left out: {_n(figures['left_out'])}"


def _n(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    lines = [list(head), *(list(r) for r in rows)]
    marks = ["---", *["---:"] * (len(lines[0]) - 1)]
    return "\n".join("| " + " | ".join(line) + " |" for line in [lines[0], marks, *lines[1:]])


TABLE: dict[str, Callable[[dict[str, Any]], str]] = {
    "range": range_table,
    "blind_area": blind_area_table,
    "overlap": overlap_table,
    "ap": ap_table,
    "registration": registration_table,
}
