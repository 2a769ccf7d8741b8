"""Whether the agents of a scenario can be true together: with each other, with the ego, and with the points of the LiDAR."""
