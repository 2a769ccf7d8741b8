"""LiDAR points inside detection boxes: clouds, ground, clusters, and the evidence for position, size and heading."""
