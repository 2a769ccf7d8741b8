"""Tracking in the map frame: forward assignment and stitching over occlusions."""
