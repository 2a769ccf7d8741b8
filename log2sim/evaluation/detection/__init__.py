"""Detected 3D boxes against true ones: average precision, precision and recall, calibration of scores."""
