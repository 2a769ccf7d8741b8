"""Training of the LiDAR detector on simulated clouds: samples, network, targets, loss. Needs the extra `train`."""
