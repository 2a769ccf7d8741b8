"""Which end of a vehicle is its front."""
