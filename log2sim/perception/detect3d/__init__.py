"""3D detection of road users in clouds: networks on a bird's-eye-view grid, or the boxes that a log brings."""

from __future__ import annotations

from log2sim.perception.detect3d.detectors import LidarDetector, create_lidar_detector

__all__ = ["LidarDetector", "create_lidar_detector"]
