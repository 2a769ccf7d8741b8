"""Pictures of one moment of a log: LiDAR points and labeled boxes on the images of its cameras."""
