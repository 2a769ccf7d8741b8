"""Reactive agents: they keep to their paths and brake for agents that the scenario does not have there."""
