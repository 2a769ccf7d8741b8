"""Warnings of collisions with the ego, from what the sensors at chosen ends have observed."""
