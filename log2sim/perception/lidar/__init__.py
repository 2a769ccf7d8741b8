"""LiDAR points inside detection boxes: position, size and heading of the object."""
