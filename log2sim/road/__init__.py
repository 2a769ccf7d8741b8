"""Markings and borders of roads, found in the map of the ground or in one picture."""
