"""Image-to-ground homographies by time-aware RANSAC, and the baselines that they are compared with."""
