"""Tracks become agents: size, trajectory, confirmation, and the ego."""
