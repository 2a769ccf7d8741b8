"""Training of networks on simulated data, and on labeled logs: scenes, networks, fitting, export. Needs the extra `train`."""
