"""The recorded world, seen by its LiDARs from where the ego drives now."""
