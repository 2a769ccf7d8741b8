"""Tracking of whole boxes on the KITTI tracking benchmark."""
