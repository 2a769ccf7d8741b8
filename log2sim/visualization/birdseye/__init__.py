"""Bird's-eye view: cameras mapped onto one raster of the ground by inverse perspective mapping."""
