"""2D detection of road users in camera frames: ONNX models, or the boxes that a log brings."""

from __future__ import annotations

from log2sim.perception.detect.detectors import Detector, create_detector

__all__ = ["Detector", "create_detector"]
