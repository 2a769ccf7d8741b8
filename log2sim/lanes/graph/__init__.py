"""Lanes between markings and along paths, linked to each other."""
