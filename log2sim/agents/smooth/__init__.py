"""Fixed-interval smoothing of positions to trajectories that a vehicle could have driven."""

from __future__ import annotations

from log2sim.agents.smooth.motion_model import MotionModel, yaw_of_motion
from log2sim.agents.smooth.smoother import SmoothedTrack, smooth_track

__all__ = ["MotionModel", "SmoothedTrack", "smooth_track", "yaw_of_motion"]
