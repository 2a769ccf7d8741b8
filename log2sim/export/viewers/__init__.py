"""Logs and results for viewers: Foxglove's messages and Rerun's recordings."""
