"""Map of the ground: pictures and sweeps of a log on one raster."""
