"""Mounts of the cameras of a rig from seams: rotations that make neighboring cameras show the road at one place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from log2sim.geometry import Array
from log2sim.perception.homography.rig import cam_of_ground, rotation_of
from log2sim.perception.homography.rig_feet import MOUNT_SIGMA_RAD
from log2sim.perception.homography.rig_fit import RigFit
from log2sim.perception.homography.seams import Seam

# The road is not a plane: cameras half a meter apart and 1.6 m high show 0.05 m of height 0.015 m apart. Together with what the
# road of one tick has in common with that of the next, this bounds what a seam says.
SEAM_SIGMA_M = 0.02
# Rounds of weighing seams by their errors, with the weights of a Cauchy distribution.
ROUNDS = 10


def fit_mounts(rig: RigFit, seams: Sequence[Seam]) -> dict[str, Array]:
    """Find rotations (3,), rad, of the mounts by camera that make seams vanish; those of the state where none tells.

    Notes
    -----
    Linear least squares with a normal prior of the mounts about the calibration, iteratively reweighted. Seams tell rotations
    against each other, the prior distributes them.
    """
    assert rig.state is not None
    names = list(rig.rig.cameras)
    value = np.concatenate([rig.state.mount[name] for name in names])
    rows, errors, whiten = [], [], []
    for seam in seams:
        if seam.place.first in names and seam.place.second in names:
            row = np.zeros((2, 3 * len(names)))
            for sign, name in ((-1.0, seam.place.first), (1.0, seam.place.second)):
                k = 3 * names.index(name)
                row[:, k : k + 3] = sign * moved_by_turn(rig, name, np.array(seam.place.center_m))
            rows.append(row)
            errors.append(seam.offset_m)
            whiten.append(np.linalg.inv(np.linalg.cholesky(seam.covariance + SEAM_SIGMA_M**2 * np.eye(2))))
    if not rows:
        return dict(rig.state.mount)
    slope, error = np.array(rows), np.array(errors)
    slope, error = np.array(whiten) @ slope, (np.array(whiten) @ error[:, :, None])[:, :, 0]
    step, prior = np.zeros(len(value)), np.full(len(value), MOUNT_SIGMA_RAD**-2.0)
    for _ in range(ROUNDS):
        left = error + slope @ step
        weight = 1.0 / (1.0 + (left**2).sum(axis=1) / 2)
        weighted = slope * weight[:, None, None]
        normal = np.einsum("nip,niq->pq", weighted, slope) + np.diag(prior)
        step = -np.linalg.solve(normal, np.einsum("nip,ni->p", weighted, error) + prior * value)
    return {name: value[3 * k : 3 * k + 3] + step[3 * k : 3 * k + 3] for k, name in enumerate(names)}


def moved_by_turn(rig: RigFit, name: str, xy: Array) -> Array:
    """Compute the derivatives (2, 3) of the ground position of a pixel that shows `xy` (2,) by a turn of its camera."""
    assert rig.state is not None
    turn = rotation_of(rig.state.mount[name])
    matrix = cam_of_ground(rig.rig.cameras[name], rig.state.plane, turn)
    point = matrix @ [*(xy - rig.rig.origin_m[:2]), 1.0]
    by_point = np.array([[1.0, 0.0, -point[0] / point[2]], [0.0, 1.0, -point[1] / point[2]]])
    return np.asarray(-np.linalg.solve(by_point @ matrix[:, :2], by_point @ np.cross(np.eye(3), point).T))


def with_mounts(rig: RigFit, mounts: Mapping[str, Array]) -> RigFit:
    """Return a fit with other mounts; obstacles are placed as before, since what their feet ask for is known without them."""
    assert rig.state is not None
    feet = {name: rig.state.feet[name] + rig.state.mount[name] - mounts[name] for name in mounts}
    return replace(rig, state=replace(rig.state, mount=mounts, feet=feet))
