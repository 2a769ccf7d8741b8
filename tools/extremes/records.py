"""Extremes of what a log records: places, stamps, clouds and images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from extremes.table import (
    FAR_M,
    LABELS,
    Outcome,
    Row,
    case,
    folder_of,
    known_and_finite,
    result_of,
    rows_changed,
    same,
    small_log,
    sound,
)
from log2sim import open_log, reconstruct
from log2sim.errors import LogError
from log2sim.report import Result


@case("map: UTM coordinates of 5e6 m", "as at the origin to 1e-6 m")
def far_away() -> Outcome:
    def move(row: Row) -> None:
        for column, shift in zip(("x_m", "y_m"), FAR_M):
            if column in row:
                row[column] = repr(float(row[column]) + float(shift))

    return same(result_of(lambda f: rows_changed(f, move)), 1e-6, tuple(FAR_M))


def later(shift_ns: int) -> Result:
    def shift(row: Row) -> None:
        row["t_ns"] = str(int(row["t_ns"]) + shift_ns)

    return result_of(lambda f: rows_changed(f, shift))


@case("stamps: of 6.7e18 ns", "as at 1.7e18 ns to 1e-9 m")
def large_stamps() -> Outcome:
    return same(later(5_000_000_000_000_000_000), 1e-9)


@case("stamps: negative, and zero among them", "as at 1.7e18 ns to 1e-9 m")
def negative_stamps() -> Outcome:
    return same(later(-int(sound().scenario.t0_ns) - 100_000_000), 1e-9)


INDICES = ("front/index.csv", "top/index.csv", "ego/poses.csv")


def with_lines(folder: Path, change: Callable[[list[str]], list[str]], names: tuple[str, ...] = INDICES) -> None:
    """Change the lines of some tables below their heads."""
    for name in names:
        head, *rows = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join([head, *change(rows)]) + "\n")


def put_in_order(change: Callable[[list[str]], list[str]], words: tuple[str, ...] = ("",)) -> Outcome:
    """The log gives the same scenario with its lines changed, and a note with one of some words."""
    with folder_of(lambda folder: with_lines(folder, change)) as folder:
        log = open_log(folder)
        outcome = same(reconstruct(log, LABELS), 1e-9)
    noted = sum(any(word in note for word in words) for note in log.notes)
    return replace(outcome, ok=outcome.ok and noted > 0, found=f"{outcome.found}, {noted} notes")


@case("stamps: every record twice", "repetitions left out and noted, the same scenario")
def repeated_stamps() -> Outcome:
    return put_in_order(
        lambda rows: [r for row in rows for r in (row, row)], ("repeat", "same stamp", "twice", "duplicate")
    )


@case("stamps: in reverse order", "put in order and noted, the same scenario")
def reversed_stamps() -> Outcome:
    return put_in_order(lambda rows: rows[::-1])


@case("stamps: a frame 1 us after another", "one tick each, nobody lost")
def microsecond_frame() -> Outcome:
    def double(rows: list[str]) -> list[str]:
        t_ns, image = rows[2].split(",", 1)
        return [*rows[:3], f"{int(t_ns) + 1000},{image}", *rows[3:]]

    result = result_of(lambda folder: with_lines(folder, double, INDICES[:1]))
    ok, found = known_and_finite(result, 3)
    increasing = all((np.diff(a.waypoints.t_s) > 0).all() for a in result.scenario.agents)
    return Outcome(ok and increasing and result.report["ticks"] == sound().report["ticks"] + 1, found)


@case("stamps: two frames a sweep", "nobody lost")
def slow_lidar() -> Outcome:
    result = result_of(lambda folder: with_lines(folder, lambda rows: rows[::2], INDICES[1:2]))
    return Outcome(*known_and_finite(result, 3))


# --- records


@case("cloud: NaN and inf points", "left out, the same scenario")
def bad_points() -> Outcome:
    def spoil(folder: Path) -> None:
        for file in (folder / "top").glob("*.npz"):
            with np.load(file) as data:
                columns = dict(data)
            for bad in (np.nan, np.inf, -np.inf):
                columns["xyz_m"] = np.concatenate([columns["xyz_m"], np.full((50, 3), bad, columns["xyz_m"].dtype)])
                for name in set(columns) - {"xyz_m"}:
                    columns[name] = np.concatenate([columns[name], columns[name][:50]])
            np.savez(file, **columns)

    return same(result_of(spoil), 1e-9)


@case("cloud: one sweep without points", "counted, the others do")
def empty_sweep() -> Outcome:
    def empty(folder: Path) -> None:
        file = sorted((folder / "top").glob("*.npz"))[2]
        np.savez(file, xyz_m=np.zeros((0, 3), np.float32), t_offset_ns=np.zeros(0, np.int64))

    result = result_of(empty)
    ok, found = known_and_finite(result, 2)
    count = result.report["unreadable"].get("top", {}).get("count", 0)
    return Outcome(ok and count == 1, f"{found}, {count} unreadable")


def cut_pictures(which: slice) -> Result:
    """Reconstruct the log with pictures that end in their middle."""

    def cut(folder: Path) -> None:
        for file in sorted((folder / "front").glob("*.jpg"))[which]:
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])

    return result_of(cut, decode_images=True)


@case("image: one cut in half", "counted, the others do")
def cut_image() -> Outcome:
    result = cut_pictures(slice(1, 2))
    ok, found = known_and_finite(result, 2)
    count = result.report["unreadable"].get("front", {}).get("count", 0)
    return Outcome(ok and count == 1, f"{found}, {count} unreadable")


@case("image: all cut in half", "refused, naming the stream")
def cut_images() -> Outcome:
    try:
        cut_pictures(slice(None))
    except LogError as error:
        return Outcome("stream 'front'" in str(error), "refused: stream 'front'")
    return Outcome(False, "accepted")


@case("frames: nobody in any", "the ego alone")
def nobody() -> Outcome:
    log = small_log()
    late = {n: replace(b, t_ns=b.t_ns + 10**15) for n, b in log.image_labels.items()}
    result = reconstruct(replace(log, image_labels=late), LABELS)
    return Outcome(
        [a.id for a in result.scenario.agents] == ["ego"], f"{len(result.scenario.others)} agents beside the ego"
    )
