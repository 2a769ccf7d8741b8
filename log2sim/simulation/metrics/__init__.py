"""Metrics of a replay: tracking error, collisions, time to collision, post-encroachment time, comfort."""
