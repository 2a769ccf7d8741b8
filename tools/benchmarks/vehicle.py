"""Error against run time of the single-track model: log2sim's steps beside Euler, RK4 and SciPy's integrators.

    python tools/bench.py vehicle

Everyone integrates the same equations with the same inputs (steering rate and acceleration as functions of time): the published model
of vehicle 2, a BMW 320i. Errors are the largest distance in m, every 0.1 s, to a converged solution. The published equations
are switched to the kinematic ones below 0.1 m/s, since they divide by the speed; log2sim's are not, so each is held against
the converged solution of its own, and the distance between the two is told. Times are of the processor, one thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import odeint, solve_ivp

from benchmarks.table import markdown, timed
from log2sim.geometry import Array, cos_sin
from log2sim.simulation.vehicles.single_track import Chassis, Slips, StepInput, linear_displacement, linear_slips
from log2sim.simulation.vehicles.vehicle import GRAVITY_MPS2, published_parameters

VEHICLE = published_parameters(2, rear_axle_offset_m=1.4)
CHASSIS = Chassis.of(VEHICLE)
SWITCH_MPS = 0.1  # below, the published equations are the kinematic ones
STANDSTILL_MPS = 1e-9  # stands for zero where the equations divide by the speed
STORE_S, STEPS_S, TOLERANCES = 0.1, (0.005, 0.01, 0.02, 0.05), (1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
PEERS = ("RK45", "LSODA", "Radau", "BDF")
FLEET, LOST_M = 1000, 1e3  # a path that is off by more is no path
KNOWN, ALONE, EACH = "log2sim, known inputs", "log2sim, one agent", f"log2sim, each of {FLEET}"
COMPARED = ((KNOWN, "LSODA"), (KNOWN, "LSODA (odeint)"), (ALONE, "LSODA, 20 ms at a time"), (EACH, "LSODA"))

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

    @property
    def t_s(self) -> Array:
        """Times (T,) at which positions are compared."""
        return np.linspace(0, self.duration_s, round(self.duration_s / STORE_S) + 1)

    @property
    def start(self) -> list[float]:
        """State at the begin."""
        share = float(VEHICLE.cg_to_rear_m[0] / VEHICLE.wheelbase_m[0])
        return [0.0, 0.0, self.steer_rad, self.speed_mps, 0.0, 0.0, math.atan(share * math.tan(self.steer_rad))]


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
            moved = [speed * math.cos(yaw + slip), speed * math.sin(yaw + slip), turned, accel]
            return [*moved, speed * math.cos(slip) * bend / wheelbase, grown / wheelbase, slip_rate]
        pace = speed if abs(speed) > STANDSTILL_MPS else STANDSTILL_MPS
        front = stiffness * (GRAVITY_MPS2 * to_rear - accel * height) * (steer - slip - to_front * yaw_rate / pace)
        rear = stiffness * (GRAVITY_MPS2 * to_front + accel * height) * (to_rear * yaw_rate / pace - slip)
        twist = (to_front * front - to_rear * rear) / inertia
        moved = [speed * math.cos(yaw + slip), speed * math.sin(yaw + slip), turned, accel]
        return [*moved, yaw_rate, twist, (front + rear) / pace - yaw_rate]

    return rates


# Positions (T, 2) every 0.1 s, NaN where a method gave up.


def solved(rates: Rates, case: Case, method: str, rtol: float, **options: Any) -> Array:
    """An integrator of SciPy."""
    tolerances = {"rtol": rtol, "atol": rtol / 100}
    found = solve_ivp(rates, (0, case.duration_s), case.start, method=method, t_eval=case.t_s, **tolerances, **options)
    return found.y[:2].T if found.success else np.full((len(case.t_s), 2), np.nan)


def compiled(rates: Rates, case: Case, rtol: float) -> Array:
    """SciPy's older wrapper of LSODA, whose loop over the steps is compiled."""
    tolerances = {"rtol": rtol, "atol": rtol / 100}
    called = lambda t, state: rates(t, state.tolist())  # noqa: E731
    return odeint(called, case.start, case.t_s, tfirst=True, tcrit=[case.duration_s], **tolerances)[:, :2]


def restarted(rates: Rates, case: Case, h: float, rtol: float) -> Array:
    """LSODA that knows the inputs of one control step at a time, as a simulation does."""
    state, out = case.start, []
    for k in range(round(case.duration_s / h)):
        out.append(state[:2])
        state = solve_ivp(rates, (k * h, (k + 1) * h), state, method="LSODA", rtol=rtol, atol=rtol / 100).y[:, -1]
    return np.array([*out, state[:2]])[:: round(STORE_S / h)]


def fixed(rates: Rates, case: Case, h: float, method: str) -> Array:
    """An explicit method with a fixed step."""
    state, out = np.array(case.start), []
    for k in range(round(case.duration_s / h)):
        out.append(state[:2])
        t, first = k * h, np.array(rates(k * h, state))
        if method == "Euler":
            state = state + h * first
        else:
            second = np.array(rates(t + h / 2, state + h / 2 * first))
            third = np.array(rates(t + h / 2, state + h / 2 * second))
            last = np.array(rates(t + h, state + h * third))
            state = state + h / 6 * (first + 2 * second + 2 * third + last)
        if not np.all(np.abs(state) < LOST_M):
            return np.full((len(case.t_s), 2), np.nan)
    return np.array([*out, state[:2]])[:: round(STORE_S / h)]


def stepped(case: Case, h: float, agents: int) -> Array:
    """log2sim, step by step as a simulation does it, for so many agents at once."""
    zero, p = np.zeros(agents), VEHICLE.take(np.zeros(agents, int))
    chassis, (x, y, yaw), slips = Chassis.of(p), (zero, zero, zero), Slips(zero, zero)
    steer, speed, out = zero + case.steer_rad, zero + case.speed_mps, [(0.0, 0.0)]
    for k in range(round(case.duration_s / h)):
        turned, accel = case.inputs((k + 0.5) * h, math.exp)
        way, ahead = h * (speed + h * accel / 2), steer + h * turned
        motion = StepInput(speed, speed + h * accel, way, steer, steer + h * turned / 2, ahead)
        before, slips = slips, linear_slips(slips, motion, p, chassis, h)
        chord, angle, turn = linear_displacement(before, slips, motion, p)
        cos, sin = cos_sin(yaw + angle)
        x, y, yaw = x + chord * cos, y + chord * sin, yaw + turn
        steer, speed = motion.steer1_rad, motion.speed1_mps
        out.append((float(x[0]), float(y[0])))
    return np.array(out)[:: round(STORE_S / h)]


def known_ahead(case: Case, h: float) -> Array:
    """log2sim for inputs known ahead: the same functions, their axis the steps in time."""
    turned, accel = case.inputs((np.arange(round(case.duration_s / h)) + 0.5) * h, np.exp)
    steer = np.concatenate([[case.steer_rad], case.steer_rad + h * np.cumsum(turned)])
    speed = np.concatenate([[case.speed_mps], case.speed_mps + h * np.cumsum(accel)])
    way, middle = h * (speed[:-1] + speed[1:]) / 2, (steer[:-1] + steer[1:]) / 2
    motion = StepInput(speed[:-1], speed[1:], way, steer[:-1], middle, steer[1:])
    slips = np.array(slip_course(motion, h)).T
    chord, angle, turn = linear_displacement(Slips(*slips[:, :-1]), Slips(*slips[:, 1:]), motion, VEHICLE)
    cos, sin = cos_sin(np.cumsum(turn) - turn + angle)
    xy = np.concatenate([[[0.0, 0.0]], np.cumsum(np.stack([chord * cos, chord * sin], axis=1), axis=0)])
    return xy[:: round(STORE_S / h)]


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


def methods(case: Case) -> Iterator[tuple[str, str, Callable[[], Array], int]]:
    """Name, setting, run and how many agents it moves, of all methods."""
    rates = single_track_rates(case, SWITCH_MPS)
    for h in STEPS_S:
        setting = f"{1000 * h:g} ms"
        yield KNOWN, setting, lambda h=h: known_ahead(case, h), 1
        yield ALONE, setting, lambda h=h: stepped(case, h, 1), 1
        yield EACH, setting, lambda h=h: stepped(case, h, FLEET), FLEET
        for name in ("Euler", "RK4"):
            yield name, setting, lambda h=h, name=name: fixed(rates, case, h, name), 1
    for rtol in TOLERANCES:
        yield "LSODA (odeint)", f"rtol {rtol:g}", lambda rtol=rtol: compiled(rates, case, rtol), 1
        yield "LSODA, 20 ms at a time", f"rtol {rtol:g}", lambda rtol=rtol: restarted(rates, case, 0.02, rtol), 1
        for name in PEERS:
            if not (name == "RK45" and case.speed_mps < 10 and rtol < 1e-3):  # minutes
                yield name, f"rtol {rtol:g}", lambda rtol=rtol, name=name: solved(rates, case, name, rtol), 1


# By method and setting: the error, m, NaN where it is lost, and milliseconds an agent.
Found = dict[tuple[str, str], tuple[float, float]]


def measure(case: Case, repeats: int) -> tuple[Found, float]:
    """All methods in one case, and the distance in m between the converged paths with and without the switch."""
    exact, switched = (
        solved(single_track_rates(case, v), case, "Radau", 1e-10, max_step=0.01) for v in (0.0, SWITCH_MPS)
    )
    found = {}
    for method, setting, run, agents in methods(case):
        path, seconds = timed(run, repeats)
        reference = exact if method.startswith("log2sim") else switched
        found[method, setting] = float(np.hypot(*(path - reference).T).max()), 1000 * seconds / agents
    return found, float(np.hypot(*(exact - switched).T).max())


def faster(found: Found, own: tuple[float, float], peer: str) -> str:
    """How many times a run is faster than the peer at the same error, whose times are interpolated between its runs."""
    runs = np.log(sorted(run for (method, _), run in found.items() if method == peer and run[0] > 0))
    if not own[0] > 0 or not runs[0, 0] <= math.log(own[0]) <= runs[-1, 0]:
        return "-"
    return f"{math.exp(np.interp(math.log(own[0]), *runs.T)) / own[1]:.2g}"


def main(repeats: int = 5) -> None:
    """Print both tables; times are medians of so many runs."""
    results: Sequence[tuple[Found, float]] = [measure(case, repeats) for case in CASES]
    rows = []
    for key in sorted({key: 0 for found, _ in results for key in found}, key=lambda k: k[0]):
        runs = [found.get(key) for found, _ in results]
        rows.append(
            [
                *key,
                *("-" if r is None else f"{'lost' if math.isnan(r[0]) else f'{r[0]:.1e}'}, {r[1]:.3g}" for r in runs),
            ]
        )
    print(markdown(["error in m, ms an agent", "setting", *(case.name for case in CASES)], rows))
    settings = [f"{1000 * h:g} ms" for h in STEPS_S]
    ratios = [
        [case.name, own, peer, *(faster(found, found[own, s], peer) for s in settings)]
        for case, (found, _) in zip(CASES, results)
        for own, peer in COMPARED
    ]
    print("\n" + markdown(["times faster at the same error", "method", "than", *settings], ratios))
    print("the switch at 0.1 m/s moves the paths by " + ", ".join(f"{apart:.1e} m" for _, apart in results))
