"""CARLA as an external simulator: the session with a server, the data of a scenario for it, and its assets."""
