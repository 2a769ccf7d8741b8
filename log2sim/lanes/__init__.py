"""Markings, borders of roads, and lanes."""
