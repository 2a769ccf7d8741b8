"""The fused bird's-eye view: every camera's view of the ground on one raster of the map."""
