"""What is told and corrected of a roadside unit: what is beyond doubt, large enough to matter, and makes both ends fit better."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from log2sim.calibration.twists import exp_of
from log2sim.cooperation.estimate import Estimate
from log2sim.cooperation.free_space import Visibility
from log2sim.cooperation.pose_fit import DELAY
from log2sim.cooperation.units import Unit
from log2sim.datatypes import Fault
from log2sim.geometry import Array

# What is certain is corrected if it matters: as much as agents are misplaced anyway, near the unit and 20 to 40 m away; stamps
# by as much at city speeds.
MIN_SHIFT_M, MIN_TURN_RAD, MIN_DELAY_S = 0.1, np.radians(0.3), 0.02
# Chance explains as much in one of 10^4 checks of six normal variables (chi-square) and of one.
MAX_CHANCE_CHI2, MIN_SIGMAS = 27.9, 4.0
# Nothing is verified that could be off by more than objects are apart.
MAX_SIGMA_M, MAX_SIGMA_RAD = 0.25, np.radians(1.0)
# Of upright points that the vehicle looked at, where a unit's pose is right; leaves, glass and what moved are seen through.
MAX_CONTRADICTING, MIN_LOOKED_AT = 0.5, 50
POSE = slice(0, DELAY)


@dataclass(frozen=True, eq=False)
class Findings:
    """What a unit is found to lack.

    Attributes
    ----------
    unit : Unit
    found : Estimate
    visibility : pair of Visibility or None
        Without and with the correction.
    """

    unit: Unit
    found: Estimate
    visibility: tuple[Visibility | None, Visibility | None]

    @property
    def sigma(self) -> Array:
        """Standard deviations (7,) of the estimate."""
        return np.asarray(np.sqrt(np.diag(self.found.covariance)))

    @cached_property
    def moved(self) -> bool:
        """Whether the pose is off for certain, by enough to matter, and both ends fit better with another."""
        values = self.found.values
        chi2 = float(values[POSE] @ np.linalg.solve(self.found.covariance[POSE, POSE], values[POSE]))
        large = np.linalg.norm(values[:3]) > MIN_SHIFT_M or np.linalg.norm(values[3:DELAY]) > MIN_TURN_RAD
        return bool(large and chi2 > MAX_CHANCE_CHI2 and self._fits_better)

    @cached_property
    def late(self) -> bool:
        """Whether the stamps are off for certain and by enough to matter."""
        objects = self.found.objects[1]
        delay_s = abs(float(self.found.values[DELAY]))
        seen = objects is not None and objects.moving > 0
        return seen and delay_s > max(MIN_DELAY_S, MIN_SIGMAS * self.sigma[DELAY])

    @property
    def _fits_better(self) -> bool:
        """Whether more points lie on surfaces and objects on each other with the correction."""
        structure = [0 if part is None else part.on_surface for part in self.found.structure]
        objects = [0.0 if part is None else part.gain for part in self.found.objects]
        return structure[1] + objects[1] > structure[0] + objects[0]

    @cached_property
    def verified(self) -> bool:
        """Whether the pose is known in the plane, in which agents are placed, as well as it must be."""
        plane = np.linalg.eigvalsh(self.found.covariance[:2, :2])[-1]
        return bool(np.sqrt(plane) < MAX_SIGMA_M and self.sigma[5] < MAX_SIGMA_RAD)

    @cached_property
    def contradicted(self) -> bool:
        """Whether the vehicle saw through most of what the unit sees upright, with and without the correction."""
        told = self.visibility[1 if self.moved else 0]
        if told is None or told.seen + told.seen_through < MIN_LOOKED_AT:
            return False
        return told.contradicting > MAX_CONTRADICTING

    @cached_property
    def applied(self) -> Array:
        """What is corrected (7,): all, or what is likeliest of one of both where the other is taken to be right."""
        values, covariance = self.found.values, self.found.covariance
        if self.contradicted or not (self.moved or self.late):
            return np.zeros(7)
        if self.moved and self.late:
            return values
        if self.moved:
            pose = values[POSE] - covariance[POSE, DELAY] / covariance[DELAY, DELAY] * values[DELAY]
            return np.append(pose, 0.0)
        delay = values[DELAY] - covariance[DELAY, POSE] @ np.linalg.solve(covariance[POSE, POSE], values[POSE])
        return np.append(np.zeros(DELAY), delay)

    @property
    def correction(self) -> Array:
        """The pose of what is corrected, (4, 4)."""
        return exp_of(self.applied[POSE])

    def faults(self) -> list[Fault]:
        """Describe what is wrong, and what cannot be said."""
        if self.contradicted:
            return [Fault("wrong_road_pose", name, self._contradiction(), "left_out") for name in self.unit.sensors]
        told, lidar, values = [], self.unit.lidars[0], self._values()
        if self.moved:
            told.append(Fault("road_pose", lidar, self._displacement(), "corrected", values=values))
        if self.late:
            told.append(Fault("road_clock", lidar, self._lateness(), "corrected", values=values))
        if not self.verified:
            told.append(Fault("unknown_road_pose", lidar, self._uncertainty(), "kept", values=values))
        return told

    def _displacement(self) -> str:
        shift, turn = np.linalg.norm(self.applied[:3]), np.degrees(np.linalg.norm(self.applied[3:DELAY]))
        return (
            f"its pose is {shift:.2f} m and {turn:.1f} degrees off the ego's map (sigma {max(self.sigma[:2]):.2f} m, "
            f"{np.degrees(self.sigma[5]):.2f} degrees of yaw), by {self._sources()}; corrected{self._company()}"
        )

    def _lateness(self) -> str:
        delay_s = float(self.applied[DELAY])
        return (
            f"its stamps are {abs(delay_s) * 1e3:.0f} ms {'late' if delay_s > 0 else 'early'} against the ego's clock "
            f"(sigma {self.sigma[DELAY] * 1e3:.0f} ms), by road users that both ends see move; corrected{self._company()}"
        )

    def _uncertainty(self) -> str:
        return (
            "its pose cannot be verified: the vehicle sees too little of what it sees "
            f"(sigma {max(self.sigma[:2]):.2f} m, {np.degrees(self.sigma[5]):.1f} degrees of yaw); kept"
        )

    def _contradiction(self) -> str:
        told = self.visibility[0]
        share = 0.0 if told is None else told.contradicting
        return (
            f"its pose cannot be trusted: the vehicle saw through {share:.0%} of the upright surfaces that it sees, and no "
            "pose within 0.5 m and 2 degrees makes both fit; left out"
        )

    def _sources(self) -> str:
        structure, objects = self.found.structure[1], self.found.objects[1]
        parts = [] if structure is None else [f"{structure.points} points on surfaces"]
        parts += [] if objects is None else [f"{objects.pairs} common road users"]
        return " and ".join(parts)

    def _company(self) -> str:
        others = self.unit.sensors[1:]
        return f", as {', '.join(others)} on the same pole" if others else ""

    def _values(self) -> dict[str, float]:
        values, sigma = self.found.values, self.sigma
        return {
            **{f"{name}_m": float(values[k]) for k, name in enumerate("xyz")},
            **{f"{name}_sigma_m": float(sigma[k]) for k, name in enumerate("xyz")},
            **{f"{name}_deg": float(np.degrees(values[3 + k])) for k, name in enumerate(("roll", "pitch", "yaw"))},
            **{f"{name}_sigma_deg": float(np.degrees(sigma[3 + k])) for k, name in enumerate(("roll", "pitch", "yaw"))},
            "delay_s": float(values[DELAY]),
            "delay_sigma_s": float(sigma[DELAY]),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the figures of the report: the estimate, what was done, and how well both ends fit before and after."""
        names = ("before", "after")
        return {
            "sensors": list(self.unit.sensors),
            "treatment": "left_out" if self.contradicted else "corrected" if self.applied.any() else "kept",
            "verified": self.verified,
            **self._values(),
            "structure": {n: None if s is None else _structure_figures(s) for n, s in zip(names, self.found.structure)},
            "objects": {n: None if o is None else _object_figures(o) for n, o in zip(names, self.found.objects)},
            "seen_through": {n: None if v is None else v.contradicting for n, v in zip(names, self.visibility)},
        }


def _structure_figures(part: Any) -> dict[str, float]:
    return {"points": part.points, "on_surface": part.on_surface / part.points, "residual_m": part.rms_m}


def _object_figures(part: Any) -> dict[str, float]:
    return {"pairs": part.pairs, "moving": part.moving, "residual_m": part.rms_m}
