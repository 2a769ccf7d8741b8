"""Error against run time of vehicle models: log2sim's steps beside Euler, RK4 and SciPy's integrators.

    python tools/bench.py vehicle --out vehicle.json

writes the figures and prints the table. Everyone integrates the same equations with the same
inputs (steering rate and acceleration as functions of time): the published single-track model of vehicle 2, a BMW 320i, and
the kinematic bicycle. Errors are the largest distance in m, every 0.1 s, to a converged solution. The published equations
are switched to the kinematic ones below 0.1 m/s, since they divide by the speed; log2sim's are not, so each is held against
the converged solution of its own, and the distance between the two is told. Times are of the processor, one thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from entry import parser_of
from scipy.integrate import odeint, solve_ivp

from benchmarks.table import markdown, timed
from log2sim.files.documents import write_json
from log2sim.geometry import Array, cos_sin
from log2sim.simulation.vehicles.parameters import published_parameters
from log2sim.simulation.vehicles.single_track import Chassis, Slips, StepInput, linear_displacement, linear_slips
from log2sim.simulation.vehicles.vehicle import GRAVITY_MPS2, along_arc

STORE_S = 0.1
STEPS_S = (0.001, 0.005, 0.01, 0.02, 0.05)
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
FLEET = 1000
PEERS = ("RK45", "LSODA", "Radau", "BDF")
KNOWN, ALONE, EACH = "log2sim, known inputs", "log2sim, one agent", f"log2sim, each of {FLEET}"
COMPARED = ((KNOWN, "LSODA"), (KNOWN, "LSODA (odeint)"), (ALONE, "LSODA, 20 ms at a time"), (EACH, "LSODA"))
LOST_M = 1e3  # a path that is off by more is no path


@dataclass(frozen=True)
class Row:
    """What one method came to in one case."""

    model: str
    case: str
    method: str
    setting: str
    error_m: float | None  # None where it gave up or was lost
    milliseconds: float


def solved(rates: Rates, case: Case, model: str, method: str, rtol: float, **options: Any) -> Array:
    """Positions (T, 2) every 0.1 s by an integrator of SciPy, NaN where it gave up."""
    t = np.linspace(0, case.duration_s, round(case.duration_s / STORE_S) + 1)
    found = solve_ivp(
        rates,
        (0, case.duration_s),
        start_of(case, model),
        method=method,
        rtol=rtol,
        atol=rtol / 100,
        t_eval=t,
        **options,
    )
    return found.y[:2].T if found.success else np.full((len(t), 2), np.nan)


def compiled(rates: Rates, case: Case, model: str, rtol: float) -> Array:
    """Positions (T, 2) every 0.1 s by SciPy's older wrapper of LSODA, whose loop over the steps is compiled."""
    t = np.linspace(0, case.duration_s, round(case.duration_s / STORE_S) + 1)
    start, end = start_of(case, model), [case.duration_s]

    def called(at: float, state: Array) -> list[float]:
        return rates(at, state.tolist())

    return odeint(called, start, t, tfirst=True, rtol=rtol, atol=rtol / 100, tcrit=end)[:, :2]


def restarted(rates: Rates, case: Case, model: str, h: float, rtol: float) -> Array:
    """Positions (T, 2) every 0.1 s by LSODA that knows the inputs of one control step at a time, as a simulation does."""
    state, every = start_of(case, model), round(STORE_S / h)
    out = [state[:2]]
    for k in range(round(case.duration_s / h)):
        state = solve_ivp(rates, (k * h, (k + 1) * h), state, method="LSODA", rtol=rtol, atol=rtol / 100).y[:, -1]
        if (k + 1) % every == 0:
            out.append(state[:2])
    return np.array(out)


def fixed(rates: Rates, case: Case, model: str, h: float, method: str) -> Array:
    """Positions (T, 2) every 0.1 s by an explicit method with a fixed step."""
    state, every = np.array(start_of(case, model)), round(STORE_S / h)
    out = [state[:2]]
    for k in range(round(case.duration_s / h)):
        t = k * h
        first = np.array(rates(t, state))
        if method == "Euler":
            state = state + h * first
        else:
            second = np.array(rates(t + h / 2, state + h / 2 * first))
            third = np.array(rates(t + h / 2, state + h / 2 * second))
            last = np.array(rates(t + h, state + h * third))
            state = state + h / 6 * (first + 2 * second + 2 * third + last)
        if not np.all(np.abs(state) < LOST_M):
            return np.full((round(case.duration_s / STORE_S) + 1, 2), np.nan)
        if (k + 1) % every == 0:
            out.append(state[:2])
    return np.array(out)


def stepped(case: Case, model: str, h: float, agents: int) -> Array:
    """Positions (T, 2) every 0.1 s of log2sim, step by step as a simulation does it, for so many agents at once."""
    zero, every = np.zeros(agents), round(STORE_S / h)
    p = VEHICLE.take(np.zeros(agents, int))
    chassis = Chassis.of(p)
    x, y, yaw, slips = zero, zero, zero, Slips(zero, zero)
    steer, speed = zero + case.steer_rad, zero + case.speed_mps
    out = [(0.0, 0.0)]
    for k in range(round(case.duration_s / h)):
        turned, accel = case.inputs((k + 0.5) * h, math.exp)
        motion = StepInput(
            speed, speed + h * accel, h * (speed + h * accel / 2), steer, steer + h * turned / 2, steer + h * turned
        )
        if model == "kinematic":
            x, y, yaw = along_arc(x, y, yaw, motion.distance_m, np.tan(motion.mean_steer_rad) / p.wheelbase_m)
        else:
            before, slips = slips, linear_slips(slips, motion, p, chassis, h)
            chord, angle, turn = linear_displacement(before, slips, motion, p)
            cos, sin = cos_sin(yaw + angle)
            x, y, yaw = x + chord * cos, y + chord * sin, yaw + turn
        steer, speed = motion.steer1_rad, motion.speed1_mps
        if (k + 1) % every == 0:
            out.append((float(x[0]), float(y[0])))
    return np.array(out)


def known_ahead(case: Case, model: str, h: float) -> Array:
    """Positions (T, 2) every 0.1 s of log2sim for inputs known ahead: the same functions, their axis the steps in time."""
    turned, accel = case.inputs((np.arange(round(case.duration_s / h)) + 0.5) * h, np.exp)
    steer = np.concatenate([[case.steer_rad], case.steer_rad + h * np.cumsum(turned)])
    speed = np.concatenate([[case.speed_mps], case.speed_mps + h * np.cumsum(accel)])
    motion = StepInput(
        speed[:-1], speed[1:], h * (speed[:-1] + speed[1:]) / 2, steer[:-1], (steer[:-1] + steer[1:]) / 2, steer[1:]
    )
    if model == "kinematic":
        curvature = np.tan(motion.mean_steer_rad) / VEHICLE.wheelbase_m
        turn = motion.distance_m * curvature
        dx, dy, _ = along_arc(0.0 * turn, 0.0 * turn, np.cumsum(turn) - turn, motion.distance_m, curvature)
    else:
        slips = np.array(slip_course(motion, h)).T
        chord, angle, turn = linear_displacement(Slips(*slips[:, :-1]), Slips(*slips[:, 1:]), motion, VEHICLE)
        cos, sin = cos_sin(np.cumsum(turn) - turn + angle)
        dx, dy = chord * cos, chord * sin
    every = round(STORE_S / h)
    xy = np.concatenate([[[0.0, 0.0]], np.cumsum(np.stack([dx, dy], axis=1), axis=0)])
    return xy[::every]


def slip_course(motion: StepInput, h: float) -> list[tuple[float, float]]:
    """Slip angles at all ends of steps (K + 1): linear in those before, so unit slips tell the maps of all steps at once."""
    zero, one = np.zeros(len(motion.distance_m)), np.ones(len(motion.distance_m))
    units = ((zero, zero), (one, zero), (zero, one))
    rest, by_rear, by_front = (np.stack(linear_slips(Slips(*u), motion, VEHICLE, CHASSIS, h)) for u in units)
    rear, front, course = 0.0, 0.0, [(0.0, 0.0)]
    for (a, c), (b, d), (e, f) in zip((by_rear - rest).T.tolist(), (by_front - rest).T.tolist(), rest.T.tolist()):
        rear, front = a * rear + b * front + e, c * rear + d * front + f
        course.append((rear, front))
    return course


def methods(case: Case, model: str) -> Iterator[tuple[str, str, Callable[[], Array], int]]:
    """Name, setting, run and how many agents it moves, of all methods."""
    rates = kinematic_rates(case) if model == "kinematic" else single_track_rates(case, SWITCH_MPS)
    for h in STEPS_S:
        setting = f"{1000 * h:g} ms"
        yield KNOWN, setting, lambda h=h: known_ahead(case, model, h), 1
        yield ALONE, setting, lambda h=h: stepped(case, model, h, 1), 1
        yield EACH, setting, lambda h=h: stepped(case, model, h, FLEET), FLEET
        for name in ("Euler", "RK4"):
            yield name, setting, lambda h=h, name=name: fixed(rates, case, model, h, name), 1
    for rtol in TOLERANCES:
        yield "LSODA (odeint)", f"rtol {rtol:g}", lambda rtol=rtol: compiled(rates, case, model, rtol), 1
        yield "LSODA, 20 ms at a time", f"rtol {rtol:g}", lambda rtol=rtol: restarted(rates, case, model, 0.02, rtol), 1
        for name in PEERS:
            if not (name == "RK45" and case.speed_mps < 10 and model != "kinematic" and rtol < 1e-3):  # minutes
                yield name, f"rtol {rtol:g}", lambda rtol=rtol, name=name: solved(rates, case, model, name, rtol), 1


def measure(case: Case, model: str, repeats: int) -> tuple[list[Row], float]:
    """All methods in one case, and the distance in m between the converged paths with and without the switch."""
    own = kinematic_rates(case) if model == "kinematic" else single_track_rates(case, 0.0)
    theirs = kinematic_rates(case) if model == "kinematic" else single_track_rates(case, SWITCH_MPS)
    exact = solved(own, case, model, "Radau", 1e-10, max_step=0.01)
    switched = solved(theirs, case, model, "Radau", 1e-10, max_step=0.01)
    rows = []
    for method, setting, run, agents in methods(case, model):
        path, seconds = timed(run, repeats)
        reference = exact if method.startswith("log2sim") else switched
        error_m = float(np.hypot(*(path - reference).T).max())
        found = error_m if math.isfinite(error_m) else None
        rows.append(Row(model, case.name, method, setting, found, 1000 * seconds / agents))
    return rows, float(np.hypot(*(exact - switched).T).max())


def faster(rows: Sequence[Row], own: Row, peer: str) -> float | None:
    """How many times a run is faster than the peer at the same error, whose times are interpolated between its runs."""
    runs = sorted((math.log(r.error_m), math.log(r.milliseconds)) for r in rows if r.method == peer and r.error_m)
    errors, times = zip(*runs)
    if not own.error_m or not errors[0] <= math.log(own.error_m) <= errors[-1]:
        return None
    return math.exp(np.interp(math.log(own.error_m), errors, times)) / own.milliseconds


def ratios(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """How many times each run of log2sim is faster than LSODA that knows as much of the inputs, at the same error."""
    out = []
    for method, peer in COMPARED:
        for own in (r for r in rows if r.method == method):
            same = [r for r in rows if (r.model, r.case) == (own.model, own.case)]
            entry = {"model": own.model, "case": own.case, "method": method, "peer": peer, "setting": own.setting}
            out.append({**entry, "ratio": faster(same, own, peer)})
    return out


def table(rows: list[Row]) -> str:
    """Error in m and milliseconds an agent: a row for every method and setting, a column for every case."""
    cases = list(dict.fromkeys(r.case for r in rows))
    cells = {
        (r.method, r.setting, r.case): f"{'lost' if r.error_m is None else f'{r.error_m:.1e}'}, {r.milliseconds:.3g}"
        for r in rows
    }
    order = dict.fromkeys((r.method, r.setting) for r in sorted(rows, key=lambda r: r.method))
    body = [[m, s, *(cells.get((m, s, c), "-") for c in cases)] for m, s in order]
    return markdown(["method", "setting", *cases], body)


def main(arguments: list[str] | None = None) -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args(arguments)
    rows, apart = [], {}
    for model, cases in (("single-track", CASES), ("kinematic", CASES[:1])):
        done: list[Row] = []
        for case in cases:
            found, apart[f"{model}: {case.name}"] = measure(case, model, arguments.repeats)
            done += found
        print(f"{model}: error in m, ms an agent\n\n{table(done)}\n")
        rows += done
    compared = ratios(rows)
    settings = ("5 ms", "10 ms", "20 ms", "50 ms")
    body: dict[tuple[str, str, str], list[str]] = {}
    for entry in compared:
        if entry["setting"] in settings:
            cell = "-" if entry["ratio"] is None else f"{entry['ratio']:.2g}"
            key = f"{entry['model']}: {entry['case']}", entry["method"], entry["peer"]
            body.setdefault(key, []).append(cell)
    print("times faster at the same error, by step\n")
    print(markdown(["case", "method", "than", *settings], [[*key, *cells] for key, cells in sorted(body.items())]))
    print("the switch at 0.1 m/s moves the path by " + ", ".join(f"{v:.1e} m ({k})" for k, v in apart.items()))
    document = {"rows": [asdict(r) for r in rows], "switch_moves_m": apart, "faster_than_lsoda": compared}
    write_json(arguments.out, document)


VEHICLE = published_parameters(2, rear_axle_offset_m=1.4)
CHASSIS = Chassis.of(VEHICLE)
SWITCH_MPS = 0.1  # below, the published equations are the kinematic ones
STANDSTILL_MPS = 1e-9  # stands for zero where the equations divide by the speed

Inputs = Callable[[Any, Callable[[Any], Any]], tuple[Any, Any]]
Rates = Callable[[float, Any], Any]


@dataclass(frozen=True)
class Case:
    """A maneuver: speed and steering angle at its begin, and inputs(t, exp) -> steering rate, acceleration."""

    name: str
    speed_mps: float
    steer_rad: float
    duration_s: float
    inputs: Inputs


def bump(t: Any, at_s: float, over_s: float, exp: Callable[[Any], Any]) -> Any:
    return exp(-(((t - at_s) / over_s) ** 2))


def rise(t: Any, at_s: float, over_s: float, exp: Callable[[Any], Any]) -> Any:
    return 1 / (1 + exp(-(t - at_s) / over_s))


def swing(size: float, at_s: tuple[float, float, float], over_s: float) -> Callable[[Any, Callable[[Any], Any]], Any]:
    """Steering rate of a lane change: to one side, over to the other, and back."""

    def rate(t: Any, exp: Callable[[Any], Any]) -> Any:
        first, second, third = (bump(t, at, over_s, exp) for at in at_s)
        return size * (first - 2 * second + third)

    return rate


def stop_and_go(t: Any, exp: Callable[[Any], Any]) -> tuple[Any, Any]:
    braking = rise(t, 0.5, 0.05, exp) * rise(-t, -3.14, 0.02, exp)
    return 0.05 * bump(t, 5.5, 0.5, exp), 2.0 * rise(t, 5.0, 0.05, exp) - 3.0 * braking


CASES = (
    Case("swerve and brake, 25 m/s", 25.0, 0.0, 4.0,
         lambda t, exp: (swing(0.28, (0.8, 1.5, 2.2), 0.25)(t, exp), -5.0 * rise(t, 1.2, 0.05, exp))),
    Case("lane change, 15 m/s", 15.0, 0.0, 6.0, lambda t, exp: (swing(0.06, (1.5, 2.6, 3.7), 0.35)(t, exp), 0 * t)),
    Case("brake to stop, wait, go", 8.0, 0.0, 8.0, stop_and_go),
    Case("from rest at 0.2 rad", 0.0, 0.2, 5.0, lambda t, exp: (0 * t, 1.5 + 0 * t)),
)  # fmt: skip


def single_track_rates(case: Case, switch_mps: float) -> Rates:
    """The published equations; states x, y, steering angle, speed, yaw, yaw rate, slip angle of the center of gravity."""
    to_rear, to_front, wheelbase = (
        float(v[0]) for v in (VEHICLE.cg_to_rear_m, CHASSIS.cg_to_front_m, VEHICLE.wheelbase_m)
    )
    inertia, height = float(VEHICLE.gyration_m2[0]), float(VEHICLE.cg_height_m[0])
    stiffness = float(VEHICLE.friction[0] * VEHICLE.front_stiffness_1prad[0]) / wheelbase

    def rates(t: float, state: Any) -> list[float]:
        _, _, steer, speed, yaw, yaw_rate, slip = state
        turned, accel = case.inputs(t, math.exp)
        if abs(speed) < switch_mps:
            bend, share = math.tan(steer), to_rear / wheelbase
            slip = math.atan(share * bend)
            slip_rate = share * turned / (math.cos(steer) ** 2 * (1 + (share * bend) ** 2))
            grown = accel * math.cos(slip) * bend - speed * math.sin(slip) * slip_rate * bend
            grown += speed * math.cos(slip) * turned / math.cos(steer) ** 2
            rolled = speed * math.cos(slip) * bend / wheelbase
            course = yaw + slip
            return [
                speed * math.cos(course),
                speed * math.sin(course),
                turned,
                accel,
                rolled,
                grown / wheelbase,
                slip_rate,
            ]
        pace = speed if abs(speed) > STANDSTILL_MPS else STANDSTILL_MPS
        front = stiffness * (GRAVITY_MPS2 * to_rear - accel * height) * (steer - slip - to_front * yaw_rate / pace)
        rear = stiffness * (GRAVITY_MPS2 * to_front + accel * height) * (to_rear * yaw_rate / pace - slip)
        twist = (to_front * front - to_rear * rear) / inertia
        course = yaw + slip
        return [
            speed * math.cos(course), speed * math.sin(course), turned, accel,
            yaw_rate, twist, (front + rear) / pace - yaw_rate,
        ]  # fmt: skip

    return rates


def kinematic_rates(case: Case) -> Rates:
    """The kinematic bicycle; states x, y of the rear axle, steering angle, speed, yaw."""
    wheelbase = float(VEHICLE.wheelbase_m[0])

    def rates(t: float, state: Any) -> list[float]:
        _, _, steer, speed, yaw = state
        turned, accel = case.inputs(t, math.exp)
        return [speed * math.cos(yaw), speed * math.sin(yaw), turned, accel, speed * math.tan(steer) / wheelbase]

    return rates


def start_of(case: Case, model: str) -> list[float]:
    share = float(VEHICLE.cg_to_rear_m[0] / VEHICLE.wheelbase_m[0])
    state = [0.0, 0.0, case.steer_rad, case.speed_mps, 0.0]
    return state if model == "kinematic" else [*state, 0.0, math.atan(share * math.tan(case.steer_rad))]
