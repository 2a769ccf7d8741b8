"""Where the ego was: the log's own poses, or others from LiDAR odometry or camera motion."""
