"""Compares markings, borders, lanes, colors and traffic lights with the truth."""
