"""Error metrics of a scenario against truth."""
