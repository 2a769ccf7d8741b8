"""Image-to-ground homographies by time-aware RANSAC, and its baselines."""
