"""CARLA as the simulator: the conversation with a server, the data of a scenario for it, and its assets."""
