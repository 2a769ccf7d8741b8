"""The vehicle's sensors and those at the road in one coordinate system and on one clock."""
