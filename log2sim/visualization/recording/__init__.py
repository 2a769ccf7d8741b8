"""What cameras and LiDARs recorded, made small enough for one file: pictures with the boxes of agents, and points."""
