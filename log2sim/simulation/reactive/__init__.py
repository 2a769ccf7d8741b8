"""Agents that keep to their own recorded ways and brake for what the log does not have there."""
