"""Reactive agents: they keep to their logged paths and brake for agents that the log does not have there."""
