"""Argoverse 2: logs of the sensor data set, and those of its LiDAR and map-change data sets, which have the same layout."""
