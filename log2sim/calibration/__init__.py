"""Offsets of clocks and rotations of mounts, estimated from a log, and their correction."""
