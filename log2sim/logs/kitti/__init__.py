"""KITTI: raw drives, the tracking layout and the object layout."""
