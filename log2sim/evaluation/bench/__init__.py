"""Error against run time of methods and settings on one log."""
