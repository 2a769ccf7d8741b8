"""Synthetic data: logs with exact truth from scene files, and random traffic seen by a fast simulated LiDAR."""

from __future__ import annotations

from log2sim.synth.scene import Scene, load_scene
from log2sim.synth.synthesis import synthesize, write_synthetic

__all__ = ["Scene", "load_scene", "synthesize", "write_synthetic"]
