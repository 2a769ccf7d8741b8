"""What is reported and corrected of a roadside unit: what is beyond doubt, large enough to matter, and makes both ends fit better."""

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
# Chance explains as much in one of 100 checks of six normal variables, or of the three in the plane (chi-square), and in one of
# 300 of one. The sigmas of poses are bounds by what points have in common: on streets with houses, estimates are within a third.
MAX_CHANCE_CHI2, MAX_CHANCE_PLANE_CHI2, MIN_SIGMAS = 16.8, 11.3, 3.0
# Nothing is verified that could be off by more than objects are apart.
MAX_SIGMA_M, MAX_SIGMA_RAD = 0.25, np.radians(1.0)
# Of upright points that the vehicle looked at, the share that it saw through: in synthetic streets up to 3 % with a right pose,
# 7 % with an error of 0.5 m and 2 degrees, 17 to 77 % with larger ones.
MAX_CONTRADICTING, MAX_LEFT, MIN_LOOKED_AT = 0.2, 0.1, 50
# Of matched points, where both ends show one place; in synthetic streets 66 to 96 % of them lie on surfaces, of wrong ones 20 to 36 %.
MIN_ON_SURFACE = 0.5
POSE = slice(0, DELAY)
HEIGHT_AND_TILT, PLANE = [2, 3, 4], [0, 1, 5]


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
    def _looked_rows(self) -> list[int]:
        """The rows of the pose that both ends show: all, or height, roll and pitch where the ground alone ties them."""
        certain = self._chi2(PLANE) > MAX_CHANCE_PLANE_CHI2 and self._objects_agree
        return list(range(DELAY)) if self.verified or certain else HEIGHT_AND_TILT

    @property
    def _objects_agree(self) -> bool:
        """Whether several common objects fit better with the correction: one alone may be matched by mistake."""
        before, after = self.found.objects
        return after is not None and after.pairs > 1 and after.gain > (0.0 if before is None else before.gain)

    def _chi2(self, rows: list[int]) -> float:
        """How far some values are from 0, squared, in units of their covariance."""
        values = self.found.values[rows]
        return float(values @ np.linalg.solve(self.found.covariance[np.ix_(rows, rows)], values))

    def _likeliest(self, rows: list[int]) -> tuple[Array, Array]:
        """Return values (7,) of some rows and their covariance, if the others are right and so 0."""
        values, covariance, out = self.found.values, self.found.covariance, np.zeros(7)
        others = [k for k in range(7) if k not in rows]
        share = covariance[np.ix_(rows, others)] @ np.linalg.inv(covariance[np.ix_(others, others)])
        out[rows] = values[rows] - share @ values[others]
        return out, covariance[np.ix_(rows, rows)] - share @ covariance[np.ix_(others, rows)]

    @cached_property
    def moved(self) -> bool:
        """Whether the pose is off for certain, by enough to matter, and both ends fit better with another."""
        rows, values = self._looked_rows, self.found.values
        if len(rows) == DELAY:
            chi2 = self._chi2(rows)
        else:
            values, covariance = self._likeliest(rows)
            chi2 = float(values[rows] @ np.linalg.solve(covariance, values[rows]))
        large = np.linalg.norm(values[:3]) > MIN_SHIFT_M or np.linalg.norm(values[3:DELAY]) > MIN_TURN_RAD
        better = self._fits and self._fits_better and self._is_free(1, MAX_LEFT)
        return bool(large and chi2 > MAX_CHANCE_CHI2 and better)

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

    @property
    def _fits(self) -> bool:
        """Whether what is matched lies on each other."""
        structure = self.found.structure[1]
        return structure is None or structure.on_surface > MIN_ON_SURFACE * structure.points

    @cached_property
    def verified(self) -> bool:
        """Whether the pose is known in the plane, in which agents are placed, as well as it must be."""
        plane = np.linalg.eigvalsh(self.found.covariance[:2, :2])[-1]
        return bool(self._fits and np.sqrt(plane) < MAX_SIGMA_M and self.sigma[5] < MAX_SIGMA_RAD)

    @cached_property
    def contradicted(self) -> bool:
        """Whether the vehicle saw through most of what the unit sees upright, with and without the correction."""
        return not self._is_free(1 if self.moved else 0, MAX_CONTRADICTING)

    def _is_free(self, row: int, limit: float) -> bool:
        """Whether the vehicle saw through few of the unit's points without (0) or with (1) the correction."""
        looked = self.visibility[row]
        if looked is None or looked.seen + looked.seen_through < MIN_LOOKED_AT:
            return True
        return looked.contradicting <= limit

    @cached_property
    def applied(self) -> Array:
        """What is corrected (7,): all, or what is likeliest of a part where the rest is taken to be right."""
        rows = [*(self._looked_rows if self.moved else []), *([DELAY] if self.late else [])]
        if self.contradicted or not rows:
            return np.zeros(7)
        return self.found.values if len(rows) == len(self.found.values) else self._likeliest(rows)[0]

    @property
    def correction(self) -> Array:
        """The pose of what is corrected, (4, 4)."""
        return exp_of(self.applied[POSE])

    def faults(self) -> list[Fault]:
        """Describe what is wrong, and what cannot be said."""
        if self.contradicted:
            return [Fault("wrong_road_pose", name, self._contradiction(), "left_out") for name in self.unit.sensors]
        faults, lidar, values = [], self.unit.lidars[0], self._values()
        if self.moved:
            faults.append(Fault("road_pose", lidar, self._displacement(), "corrected", values=values))
        if self.late:
            faults.append(Fault("road_clock", lidar, self._lateness(), "corrected", values=values))
        if not self.verified:
            faults.append(Fault("unknown_road_pose", lidar, self._uncertainty(), "kept", values=values))
        return faults

    def _displacement(self) -> str:
        shift, turn = np.linalg.norm(self.applied[:3]), np.degrees(np.linalg.norm(self.applied[3:DELAY]))
        return (
            f"its pose is {shift:.2f} m and {turn:.1f} degrees off the ego's map (sigma {max(self.sigma[:2]):.2f} m, "
            f"{np.degrees(self.sigma[5]):.2f} degrees of yaw), by {self._sources()}; "
            f"{'corrected' if len(self._looked_rows) == DELAY else 'its height and tilt are corrected'}{self._company()}"
        )

    def _lateness(self) -> str:
        delay_s = float(self.applied[DELAY])
        return (
            f"its stamps are {abs(delay_s) * 1e3:.0f} ms {'late' if delay_s > 0 else 'early'} against the ego's clock "
            f"(sigma {self.sigma[DELAY] * 1e3:.0f} ms), by road users that both ends see move; corrected{self._company()}"
        )

    def _uncertainty(self) -> str:
        return (
            "its place in the plane cannot be verified: the vehicle sees too little of what it sees "
            f"(sigma {max(self.sigma[:2]):.2f} m, {np.degrees(self.sigma[5]):.1f} degrees of yaw); kept"
        )

    def _contradiction(self) -> str:
        looked = self.visibility[0]
        share = 0.0 if looked is None else looked.contradicting
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
